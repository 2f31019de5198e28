"""Intervals of a study's figures by scene, and differences between its rows: which is better, and is it chance."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from stereokit_evaluation.scoring.measures import FIGURES, Errors
from stereokit_evaluation.scoring.runner import Scored
from stereokit_evaluation.scoring.statistics import Comparison, Sums, compare, interval
from stereokit_evaluation.study.run import StudyRow

__all__ = ["COMPARED", "best_row", "compare_rows", "comparisons", "intervals", "scene_names", "scene_sums"]

COMPARED = ("d1", "bad-1", "bad-2", "epe")
"""The figures that rows are compared by."""

_WITH_INTERVALS = tuple(name for name in FIGURES if name != "density")


def scene_names(frames: Sequence[Scored]) -> list[str]:
    """Return the scenes of frames in order, each once; a frame without one is a scene of its own."""
    return list(dict.fromkeys(_scene(frame) for frame in frames))


def scene_sums(frames: Sequence[Scored], figure: str, pixels: str = "main") -> Sums:
    """Return a figure's sums by scene.

    Parameters
    ----------
    frames : sequence of Scored
    figure : str
        One of `stereokit_evaluation.scoring.measures.FIGURES`.
    pixels : str
        The set of pixels.
    """
    scenes = dict.fromkeys(scene_names(frames), Errors())
    for frame in frames:
        scenes[_scene(frame)] += getattr(frame.measures, pixels)
    rule = FIGURES[figure]
    above = np.array([rule.numerator(errors) for errors in scenes.values()], np.float64)
    below = np.array([rule.denominator(errors) for errors in scenes.values()], np.float64)
    return Sums(above, below, rule.factor, rule.root)


def intervals(row: StudyRow) -> dict[str, list[float] | None]:
    """Return the bootstrap interval of each figure of the main pixels, None with fewer than two scenes."""
    ends = {name: interval(scene_sums(row.result.frames, name)) for name in _WITH_INTERVALS}
    return {name: None if pair is None else list(pair) for name, pair in ends.items()}


def compare_rows(first: StudyRow, second: StudyRow, figure: str) -> Comparison | None:
    """Return the difference of two rows of one study, first minus second, None where nothing was scored."""
    return compare(scene_sums(first.result.frames, figure), scene_sums(second.result.frames, figure))


def comparisons(rows: Sequence[StudyRow]) -> list[dict[str, Any]]:
    """Return the comparison of each pair of rows by each figure of `COMPARED`, for JSON."""
    scored = [row for row in rows if row.missing is None and row.result.frames]
    entries = []
    for figure in COMPARED:
        sums = [scene_sums(row.result.frames, figure) for row in scored]
        for (first, one), (second, other) in combinations(zip(scored, sums, strict=True), 2):
            result = compare(one, other)
            if result is not None:
                names = {"first": first.configuration.name, "second": second.configuration.name}
                entries.append({**names, "figure": figure, **vars(result)})
    return entries


def best_row(rows: Sequence[StudyRow], figure: str = "d1") -> StudyRow | None:
    """Return the row with the lowest figure of the main pixels, None where nothing was scored."""
    values = [(value, row) for row in rows if (value := row.result.measures.main.figure(figure)) is not None]
    return min(values, key=lambda pair: pair[0])[1] if values else None


def _scene(frame: Scored) -> str:
    return frame.name if frame.scene is None else frame.scene
