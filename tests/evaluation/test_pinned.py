"""D1 of the four matchers on two real frames, pinned: a change of a default or a kernel shows here in percent.

So do some of the figures that the pages print (``docs/figures.json``).
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stereokit import METHODS, Matcher
from stereokit.errors import StereokitError
from stereokit_evaluation.commands.doc_figures import measure, measurements
from stereokit_evaluation.data.datasets import kitti2015, select_frames
from stereokit_evaluation.scoring.runner import run

FRAMES = ("000001_10", "000003_10")
D1 = {"S1": 6.81, "S2": 5.89, "S3": 6.66, "S4": 6.31}
"""Percent of the not occluded pixels of both frames, pooled and filled, with 128 disparities
(``stereokit evaluate --dataset kitti2015 --root KITTI --frames 1,3 --method S1 ...``)."""
PRINTED = json.loads((Path(__file__).parents[2] / "docs" / "figures.json").read_text(encoding="utf-8"))["figures"]
SAMPLE = [
    "kitti2015 validation, D1, S2",
    "kitti2015 validation, D1, S4 half",
    "middlebury cones, bad-2, S2",
    "middlebury teddy, bad-2, S4",
    "middlebury teddy, bad-2, OpenCV HH",
]
"""Figures that take a second or two each."""


@pytest.mark.data
@pytest.mark.parametrize("name", SAMPLE)
@pytest.mark.filterwarnings("ignore::stereokit.PairWarning")
def test_the_printed_figures_are_those_of_the_code(data_root, name):
    figure = next(figure for figure in measurements() if figure.name == name)
    try:
        value = measure(figure, data_root)
    except StereokitError as error:
        pytest.skip(f"{error}; set STEREOKIT_DATA")
    assert value == pytest.approx(PRINTED[name], abs=0.02)  # another version of OpenCV smooths a little differently


@pytest.mark.data
@pytest.mark.parametrize("method", METHODS)
def test_d1_of_two_frames_of_kitti_is_what_it_was(data_root, method):
    root = data_root / "kitti2015"
    if not root.is_dir():
        pytest.skip(f"no KITTI 2015 in {data_root}; set STEREOKIT_DATA")
    frames = [frame for frame in select_frames(kitti2015(root), "1,3") if frame.name in FRAMES]
    if len(frames) < len(FRAMES):
        pytest.skip(f"no frames {' and '.join(FRAMES)} in {root}")
    counts = run(frames, Matcher(method, max_disparity=128)).score.noc.all.filled
    assert 100 * counts.outliers / counts.pixels == pytest.approx(D1[method], abs=0.05)
