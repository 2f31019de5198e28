"""The data sets of one study: parsed from the command line, loaded, selected from, and merged again for the report."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean

import numpy as np

from stereokit.errors import OptionError
from stereokit_evaluation.data.datasets import DATASETS, dataset_names, load_frames, select_frames
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.data.splits import split
from stereokit_evaluation.scoring.runner import Result, Skipped
from stereokit_evaluation.study.configurations import merged
from stereokit_evaluation.study.run import Study, StudyRow

__all__ = ["DEFAULT_DISPARITIES", "DataPart", "load_part", "merge_studies", "parse_data", "spread_frames"]

DEFAULT_DISPARITIES = 128
"""The range where neither the user nor the data set has one."""


@dataclass(frozen=True)
class DataPart:
    """One data set of a study.

    Attributes
    ----------
    name : str
        Unique in the study.
    dataset : str
        ``"kitti2015"``
    root : Path or None
    frames : list of Frame
        Those that are measured.
    split : str or None
        The part of KITTI 2015.
    warnings : list of str
    levels : int
        Disparities to search.
    """

    name: str
    dataset: str
    root: Path | None
    frames: list[Frame]
    split: str | None = None
    warnings: list[str] = field(default_factory=list)
    levels: int = DEFAULT_DISPARITIES


def parse_data(texts: Sequence[str]) -> list[tuple[str, str, Path | None]]:
    """Return the name, the data set and the folder of each ``DATA:DIR`` or ``NAME=DATA:DIR``; ``scenes`` has no folder.

    The name is that of the data set if none is there; a second one gets a number: ``"folder"``, ``"folder-2"``.

    Raises
    ------
    OptionError
        If a part is missing, or two have one name.
    """
    parts: list[tuple[str, str, Path | None]] = []
    for text in texts:
        head, _, folder = (part.strip() for part in text.partition(":"))
        own, separator, dataset = (part.strip() for part in head.rpartition("="))
        if dataset not in DATASETS and dataset != "scenes":
            raise OptionError(f"data must be NAME:DIR with a name of {', '.join(dataset_names())}, got {text!r}")
        if not folder and dataset != "scenes":
            raise OptionError(f"data must be NAME:DIR, got {text!r} without a folder")
        if separator and not re.fullmatch(r"[A-Za-z0-9_.+-]+", own):
            raise OptionError(f"data must have names of letters, digits, _, ., + and -, got {text!r}")
        times = sum(dataset == other for _, other, _ in parts)
        name = own or (dataset if not times else f"{dataset}-{times + 1}")
        if name in (other for other, _, _ in parts):
            raise OptionError(f"data must have different names, got {name!r} twice")
        parts.append((name, dataset, Path(folder) if folder else None))
    return parts


def load_part(
    name: str,
    dataset: str,
    root: Path | None,
    *,
    split_name: str | None = None,
    selection: str | None = None,
    count: int = 20,
    max_frames: int | None = None,
    max_disparity: int | None = None,
) -> DataPart:
    """Return a data set of a study.

    Parameters
    ----------
    name, dataset, root
        As in `DataPart`.
    split_name : str, optional
        Of KITTI 2015.
    selection : str, optional
        Names or numbers of frames.
    count : int
        Number of synthetic scenes.
    max_frames : int, optional
        At most so many, evenly spaced.
    max_disparity : int, optional
        Disparities; by default the largest that the frames ask for.

    Raises
    ------
    UnknownNameError, OptionError, FileError
        If there are no such frames.
    """
    frames = load_frames(dataset, root, count=count)
    if dataset == "scenes":
        frames[0].load_left()  # fails here if the package that draws them is missing
    part, warnings = None, []
    if dataset == "kitti2015":
        part, frames, warning = split(frames, split_name)
        warnings = [warning] if warning else []
    selected = spread_frames(select_frames(frames, selection), max_frames)
    suggested = max((f.max_disparity for f in selected if f.max_disparity is not None), default=DEFAULT_DISPARITIES)
    levels = suggested if max_disparity is None else max_disparity
    return DataPart(name, dataset, root, selected, part, warnings, levels)


def spread_frames(frames: Sequence[Frame], count: int | None) -> list[Frame]:
    """Return at most `count` of the frames, evenly spaced, the first and the last among them."""
    if count is None or count >= len(frames):
        return list(frames)
    places = np.linspace(0, len(frames) - 1, count) if count > 1 else [0]
    return [frames[round(float(place))] for place in places]


def merge_studies(parts: Sequence[DataPart], studies: Sequence[Study]) -> tuple[Study, list[Frame]]:
    """Return one study over the frames of all data sets, and the frames; each is called ``DATA/NAME``.

    Counts are pooled over all frames; the times are means over data sets of their medians. A row that is missing from
    one data set is missing.

    Parameters
    ----------
    parts, studies
        One study for each part, of the same rows.
    """
    frames = {part.name: {frame.name: _named(part, frame) for frame in part.frames} for part in parts}
    whole = Study(
        skipped=[
            Skipped(f"{part.name}/{skip.name}", skip.reason)
            for part, study in zip(parts, studies, strict=True)
            for skip in study.skipped
        ],
        reused=sum(study.reused for study in studies),
        computed=sum(study.computed for study in studies),
        interrupted=any(study.interrupted for study in studies),
    )
    for rows in zip(*(study.rows for study in studies), strict=True):
        whole.rows.append(_merged_row(parts, rows))
    return whole, [frame for part in frames.values() for frame in part.values()]


def _merged_row(parts: Sequence[DataPart], rows: Sequence[StudyRow]) -> StudyRow:
    by_frame = {
        f"{part.name}/{frame.name}": (row.configuration, frame)
        for part, row in zip(parts, rows, strict=True)
        for frame in part.frames
    }
    configuration = merged(rows[0].configuration, by_frame)
    failed = sum(row.failed for row in rows)
    missing = next(
        (f"{part.name}: {row.missing}" for part, row in zip(parts, rows, strict=True) if row.missing is not None), None
    )
    if missing is not None:
        return StudyRow(configuration, Result(), {}, missing, failed)
    scored = tuple(
        replace(frame, name=f"{part.name}/{frame.name}", scene=f"{part.name}/{frame.scene or frame.name}")
        for part, row in zip(parts, rows, strict=True)
        for frame in row.result.frames
    )
    ms = _mean_ms([row.ms for row in rows if row.ms])
    return StudyRow(configuration, Result(scored), ms, failed=failed)


def _mean_ms(times: Sequence[Mapping[str, float]]) -> dict[str, float]:
    names = list(times[0]) if times else []
    return {name: fmean(part[name] for part in times if name in part) for name in names}


def _named(part: DataPart, frame: Frame) -> Frame:
    return replace(frame, name=f"{part.name}/{frame.name}")
