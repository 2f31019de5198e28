"""The accuracies that the README and the documentation print, measured by today's code.

``python -m stereokit_evaluation.commands.doc_figures --data DATA -o docs/figures.json`` measures all of them in some
minutes; tests compare the pages with that file, and a few of its figures with the code. DATA has the folders
``kitti2015`` and ``middlebury``; refiners tuned to KITTI need the package ``stereokit-kitti-weights``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from stereokit import Matcher, __version__
from stereokit.io import check_output, write_bytes
from stereokit.matching import METHODS
from stereokit_evaluation.bench.baselines import BASELINES, HH, THREE_WAY, padded
from stereokit_evaluation.commands.regions import scene_masks
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.common.scripts import exit_status
from stereokit_evaluation.data.datasets import load_frames, select_frames
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.runner import Matching, Result, run
from stereokit_evaluation.study.configurations import baseline, build, title
from stereokit_evaluation.study.regions import measure_regions

__all__ = ["Measurement", "main", "measure", "measure_by_region", "measurements", "region_names"]

VALIDATION = "0-3,34-40"
"""Frames of two whole drives of KITTI 2015 on which nothing was tuned."""

_LEVELS = 128
_MIDDLEBURY = ("cones", "teddy", "Motorcycle")
_TUNED = ("cnn", "stereovae", "pyramid")  # to KITTI: 24 of its frames here are of their training
_SCENES = 20
_SCENE_REGIONS = ("seen", "occluded", "background", "object", "textureless", "specular", "brightness", "ordinary")
_KITTI_REGIONS = ("above 32 px", "16 to 32 px", "8 to 16 px", "below 8 px", "flat", "weak", "textured")
_SETTINGS = {"original": "", "linear": " half", **{name: f" half {name}" for name in (*_TUNED, "stereokit")}}


@dataclass(frozen=True)
class Measurement:
    """One figure of the pages.

    Attributes
    ----------
    name : str
        Its key in the file: the pairs, the measure, the method.
    dataset : str
    frames : str or None
        As ``--frames`` takes them; None is all.
    measure : {"D1", "bad-2"}
        Percent, over the pixels that both cameras see.
    method : str
        ``"S1"`` to ``"S4"``, or a baseline's name.
    scale : float
    refiner : str or None
    """

    name: str
    dataset: str
    frames: str | None
    measure: str
    method: str
    scale: float = 1.0
    refiner: str | None = None


def measurements() -> Iterator[Measurement]:
    """Yield all figures that the pages print."""
    for part, frames in (("kitti2015", None), ("kitti2015 validation", VALIDATION)):
        for method in METHODS:
            yield Measurement(f"{part}, D1, {method}", "kitti2015", frames, "D1", method)
            yield Measurement(f"{part}, D1, {method} half", "kitti2015", frames, "D1", method, 0.5)
            name = f"{part}, D1, {method} half stereokit"
            yield Measurement(name, "kitti2015", frames, "D1", method, 0.5, "stereokit")
    for method in METHODS:
        for refiner in _TUNED:
            name = f"kitti2015 validation, D1, {method} half {refiner}"
            yield Measurement(name, "kitti2015", VALIDATION, "D1", method, 0.5, refiner)
    opencv = [name for name in BASELINES if name in ("OpenCV SGBM", "OpenCV 3WAY", "OpenCV HH")]
    for method in opencv:
        yield Measurement(f"kitti2015, D1, {method}", "kitti2015", None, "D1", method)
    for scene in _MIDDLEBURY:
        for method in ("S2", "S4", "OpenCV HH"):
            yield Measurement(f"middlebury {scene}, bad-2, {method}", "middlebury", scene, "bad-2", method)


def measure(figure: Measurement, data: Path) -> float:
    """Return a figure, percent.

    Parameters
    ----------
    figure : Measurement
    data : Path
        The folder that has a folder for each data set.

    Raises
    ------
    FileError, OptionError
        If the data set or a frame of it is not there.
    """
    frames = select_frames(load_frames(figure.dataset, data / figure.dataset), figure.frames)
    frames = [frame for frame in frames if frame.noc is not None]
    result = run(frames, _matcher(figure, frames))
    return _percent(result, figure.measure)


def region_names(dataset: str) -> dict[str, tuple[str, str]]:
    """Return the figures by kind of pixel of ``"scenes"`` or ``"kitti2015"``: region and row of the study, by key."""
    settings = [name for name in _SETTINGS if dataset == "scenes" or name not in _TUNED]
    rows = {f"{m} {title(name)}": f"{m}{_SETTINGS[name]}" for m in METHODS for name in settings}
    rows |= {name: name for name in (THREE_WAY, HH)}
    parts = _SCENE_REGIONS if dataset == "scenes" else _KITTI_REGIONS
    return {f"{dataset} {region}, D1, {key}": (region, row) for region in parts for row, key in rows.items()}


def measure_by_region(dataset: str, data: Path) -> dict[str, float]:
    """Return the figures of `region_names`, percent."""
    names = region_names(dataset)
    frames = load_frames(dataset, None if dataset == "scenes" else data / dataset, count=_SCENES)
    settings = [name for name in _SETTINGS if dataset == "scenes" or name not in _TUNED]
    configurations = build(list(METHODS), settings, {"max_disparity": _LEVELS, "weights": "kitti"})
    configurations += [baseline(key, _LEVELS) for key in (THREE_WAY, HH)]
    with progress(len(frames) * len(configurations)) as (_, step):
        rows = measure_regions(frames, configurations, scene_masks if dataset == "scenes" else None, step=step)
    by_name = {row.configuration.name: row for row in rows}
    values = {key: by_name[row].d1(region) for key, (region, row) in names.items()}
    return {key: value for key, value in values.items() if value is not None}


def main(argv: Sequence[str] | None = None) -> None:
    """Measure all figures, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of kitti2015 and middlebury")
    parser.add_argument("--output", "-o", type=Path, required=True, help="JSON to write")
    arguments = parser.parse_args(argv)
    check_output(arguments.output, (".json",), "output")
    figures: dict[str, float] = {}
    everything = list(measurements())
    with progress(len(everything)) as (console, step):
        for figure in everything:
            figures[figure.name] = round(measure(figure, arguments.data), 4)
            console.print(f"{figure.name}: {figures[figure.name]:.2f}", highlight=False)
            step(figure.name)
    for dataset in ("scenes", "kitti2015"):
        figures |= {name: round(value, 4) for name, value in measure_by_region(dataset, arguments.data).items()}
    document: dict[str, Any] = {
        "command": "python -m stereokit_evaluation.commands.doc_figures --data DATA -o docs/figures.json",
        "version": __version__,
        "opencv": cv2.__version__,
        "figures": figures,
    }
    write_bytes(arguments.output, (json.dumps(document, indent=2) + "\n").encode())


def _matcher(figure: Measurement, frames: Sequence[Frame]) -> Matching:
    levels = max((frame.max_disparity for frame in frames if frame.max_disparity is not None), default=_LEVELS)
    if figure.method in BASELINES:
        return padded(figure.method, levels)
    options: dict[str, Any] = {"max_disparity": levels, "scale": figure.scale}
    options |= {} if figure.refiner is None else {"refiner": figure.refiner}
    options |= {"weights": "kitti"} if figure.refiner in _TUNED else {}
    return Matcher(figure.method, **options)


def _percent(result: Result, measure_name: str) -> float:
    tally = result.score.noc.all.filled
    value = tally.d1() if measure_name == "D1" else tally.bad_x(2.0)
    assert value is not None
    return value


if __name__ == "__main__":
    sys.exit(exit_status(main))
