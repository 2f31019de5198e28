"""The search behind the defaults: one option at a time around them, on the frames that are named for tuning.

``python -m stereokit_evaluation.commands.search --data DIR --method S2 --output S2.csv`` scores each set of options on
the tuning frames of KITTI 2015 (000013-000033, 000046, 000072, 000104, 000115: whole drives, so that no neighbour in
time is among the validation frames 000000-000003 and 000034-000040) and on Middlebury's cones, teddy and Motorcycle.
Options are chosen by the tuning column and the three scenes; validation is printed too and not searched on.

`DIR` has ``kitti2015`` and ``middlebury/{2003/cones, 2003/teddy, 2014/Motorcycle}``. Rows are appended to the CSV one
by one; options that are in it are not run again. ``--scale 0.5`` searches the defaults of half size.
Disparities are searched in full.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stereokit import Matcher
from stereokit.defaults import METHODS
from stereokit.methods import parse_method
from stereokit_evaluation.data.datasets import Frame, kitti2015, middlebury, select_frames
from stereokit_evaluation.scoring.runner import run

__all__ = ["main", "settings"]

TUNING = "13-33,46,72,104,115"
VALIDATION = "0-3,34-40"
SCENES = ("cones", "teddy", "Motorcycle")
COLUMNS = ["method", "options", "tuning", "validation", "all", *SCENES]

_COMMON: dict[str, list[Any]] = {
    "smooth": [0, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0],
    "border_cost": [0.3, 0.5, 0.7, 1.0, None],
    "smp": [False],
    "speckle": [0, 0.0001, 0.0002, 0.0003, 0.0005, 0.001],
    "uniqueness": [2, 5],
    "fill": ["background", "nearest"],
    "median": [0, 3, 5],
    "subpixel": [False],
}
_STAGES: dict[str, dict[str, list[Any]]] = {
    "census": {"window": ["5x5", "7x7", "9x7"]},
    "zncc": {"window": [3, 5, 7, 9], "steps": [15, 31, 45]},
    "sgm": {"paths": [4, 5, 8], "edge": [4, 8, 16], "edge_factor": [0.25, 0.35, 0.5, 0.7, 1.0]},
    "dt": {
        "sigma_s": [6, 10, 14, 20, 26],
        "sigma_v": [3, 4, 6, 8, 10],
        "sigma_r": [20, 30, 40, 60, 90],
        "passes": [2, 3],
        "mode": ["sum"],
    },
    "census+sgm": {"p1": [6, 9, 12, 15, 18, 21], "p2": [50, 68, 85, 100, 120]},
    "zncc+sgm": {"p1": [0.3, 0.5, 0.65, 0.8, 1.0], "p2": [2.0, 3.0, 3.9, 5.0, 6.5]},
}


def settings(method: str, scale: float = 1) -> Iterator[dict[str, Any]]:
    """Yield the defaults (no option), then every single change of one option of `method`."""
    base: dict[str, Any] = {} if scale == 1 else {"scale": scale}
    yield base
    name = parse_method(method)
    cost, aggregation = name.split("+")
    for group in (_COMMON, *(_STAGES.get(part, {}) for part in (cost, aggregation, name))):
        for option, values in group.items():
            for value in values:
                yield {**base, option: value}


def _d1(frames: list[Frame], matcher: Matcher) -> tuple[int, int]:
    """Errors and pixels of the pooled D1 over not occluded pixels."""
    counts = run(frames, matcher).score.noc.all.filled
    return counts.outliers, counts.pixels


def _bad_2(frame: Frame, method: str, options: dict[str, Any]) -> float:
    """Percent of the not occluded pixels of one scene that are off by more than 2 pixels."""
    left, right, truth = frame.load_left(), frame.load_right(), frame.load_noc()
    assert truth is not None
    levels = 64 if frame.max_disparity is None else frame.max_disparity
    disparity = Matcher(method, max_disparity=levels, search="full", **options)(left, right).disparity
    known = np.isfinite(truth)
    return float(100 * np.mean(np.abs(disparity - truth)[known] > 2))


def _row(method: str, options: dict[str, Any], kitti: list[Frame], scenes: dict[str, Frame]) -> dict[str, Any]:
    matcher = Matcher(method, search="full", **options)
    tuning, validation = (_d1(select_frames(kitti, part), matcher) for part in (TUNING, VALIDATION))
    parts = (tuning, validation, (tuning[0] + validation[0], tuning[1] + validation[1]))
    shares = [f"{100 * errors / pixels:.2f}" for errors, pixels in parts]
    bad = [f"{_bad_2(scenes[name], method, options):.2f}" for name in SCENES]
    return dict(zip(COLUMNS, [method, json.dumps(options), *shares, *bad], strict=True))


def main(argv: list[str] | None = None) -> None:
    """Run the search from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of kitti2015 and middlebury")
    parser.add_argument("--method", choices=sorted(METHODS), action="append", help="default: all four")
    parser.add_argument("--scale", type=float, choices=(1, 0.5), default=1, help="0.5: at half size, upscaled")
    parser.add_argument("--output", type=Path, required=True, help="CSV that rows are appended to")
    arguments = parser.parse_args(argv)
    kitti = kitti2015(arguments.data / "kitti2015")
    scenes = {frame.name.split("/")[-1]: frame for frame in middlebury(arguments.data / "middlebury")}
    done = set()
    if arguments.output.exists():
        with arguments.output.open(newline="") as file:
            done = {(row["method"], row["options"]) for row in csv.DictReader(file)}
    with arguments.output.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if not done:
            writer.writeheader()
        for method in arguments.method or sorted(METHODS):
            for options in settings(method, arguments.scale):
                if (method, json.dumps(options)) in done:
                    continue
                row = _row(method, options, kitti, scenes)
                writer.writerow(row)
                file.flush()
                print("  ".join(str(row[name]) for name in COLUMNS), flush=True)


if __name__ == "__main__":
    main()
