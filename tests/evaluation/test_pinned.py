"""D1 of the four matchers on two real frames, pinned: a change of a default or a kernel shows here in percent."""

from __future__ import annotations

import pytest

from stereokit import METHODS, Matcher
from stereokit_evaluation.data.datasets import kitti2015, select_frames
from stereokit_evaluation.scoring.runner import run

FRAMES = ("000001_10", "000003_10")
D1 = {"S1": 6.81, "S2": 6.38, "S3": 6.66, "S4": 6.31}
"""Percent of the not occluded pixels of both frames, pooled and filled, with 128 disparities
(``stereokit evaluate --dataset kitti2015 --root KITTI --frames 1,3 --method S1 ...``)."""


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
