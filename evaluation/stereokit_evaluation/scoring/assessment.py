"""All scores of one disparity map of one frame: KITTI's, the general measures, and those of the frame's benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring import eth3d, middlebury
from stereokit_evaluation.scoring.kitti import Score, score
from stereokit_evaluation.scoring.measures import Measures, measure_map

__all__ = ["Assessment", "Official", "assess", "average_official"]

Official = Mapping[str, Mapping[str, Mapping[str, float] | None]]
"""Figures by the benchmark's own rules: of the map (``"dense"``, ``"sparse"``), then of the pixels (``"nonocc"``,
``"all"``)."""


@dataclass(frozen=True)
class Assessment:
    """The scores of one map.

    Attributes
    ----------
    score : Score
        As the KITTI 2015 development kit counts.
    measures : Measures
        Further figures, by set of pixels.
    official : mapping or None
        By the rules of the frame's benchmark, None if it has none of its own. "dense" is the map as the method returns
        it, "sparse" that of measured pixels alone.
    """

    score: Score = field(default_factory=Score)
    measures: Measures = field(default_factory=Measures)
    official: Official | None = None


def assess(
    frame: Frame,
    truth: Mapping[str, NDArray[Any] | None],
    disparity: NDArray[np.float32],
    measured: NDArray[np.bool_] | None = None,
) -> Assessment:
    """Return the scores of a map.

    Parameters
    ----------
    frame : Frame
    truth : mapping
        Its maps ``"noc"``, ``"occ"`` and ``"objects"``, None where there is none.
    disparity : (H, W) float32
        Pixels; NaN, infinite or negative where unknown.
    measured : (H, W) bool, optional
        Known pixels by default.

    Raises
    ------
    InputError
        If a map is not two-dimensional or the sizes differ.
    """
    counts = score(disparity, **truth, measured=measured)
    measures = measure_map(disparity, noc=truth["noc"], occ=truth["occ"], measured=measured)
    return Assessment(counts, measures, _official(frame, truth, disparity, measured))


def average_official(benchmark: str, figures: Mapping[str, Official | None]) -> dict[str, Any] | None:
    """Return the average of a benchmark's table, None where no pair counts.

    Parameters
    ----------
    benchmark : {"middlebury", "eth3d"}
    figures : mapping
        Attribute `Assessment.official` by the name of the pair.
    """
    average = {"middlebury": middlebury.weighted_average, "eth3d": eth3d.average}[benchmark]
    table = {
        kind: {
            pixels: average({name: entry[kind][pixels] for name, entry in figures.items() if entry is not None})
            for pixels in ("nonocc", "all")
        }
        for kind in ("dense", "sparse")
    }
    return table if any(values for part in table.values() for values in part.values()) else None


def _official(
    frame: Frame,
    truth: Mapping[str, NDArray[Any] | None],
    disparity: NDArray[np.float32],
    measured: NDArray[np.bool_] | None,
) -> Official | None:
    reference, noc = truth["occ"], truth["noc"]
    if frame.benchmark is None or reference is None:
        return None
    mask = None if noc is None else np.isfinite(noc)
    known = np.where(np.isfinite(disparity), disparity, np.float32(np.nan))
    maps = {"dense": known, "sparse": known if measured is None else np.where(measured, known, np.float32(np.nan))}

    def figures(estimate: NDArray[np.float32], chosen: NDArray[np.bool_] | None) -> dict[str, float] | None:
        assert frame.benchmark is not None
        if frame.benchmark.name == "eth3d":
            return eth3d.score_pair(estimate, reference, chosen)
        return middlebury.score_pair(
            estimate,
            reference,
            chosen,
            ndisp=frame.max_disparity,
            integer=frame.benchmark.integer,
            size=middlebury.relative_size(frame.name, reference.shape[1]),
        )

    return {
        kind: {"nonocc": None if mask is None else figures(estimate, mask), "all": figures(estimate, None)}
        for kind, estimate in maps.items()
    }
