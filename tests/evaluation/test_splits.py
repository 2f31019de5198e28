"""The 160/40 split, what is missing of it, and what is said about comparing."""

from __future__ import annotations

import numpy as np
import pytest

from stereokit.errors import OptionError
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.data.splits import comparison, split, split_of


def kitti(*numbers, truth=True):
    image = lambda: np.zeros((1, 1), np.uint8)  # noqa: E731
    return [Frame(f"{n:06d}_10", image, image, noc=image if truth else None) for n in numbers]


def test_the_split_is_by_number():
    assert [split_of(frame) for frame in kitti(0, 159, 160, 199, 200)] == [
        "train",
        "train",
        "validation",
        "validation",
        None,
    ]
    assert split_of(Frame("2003/cones", lambda: None, lambda: None)) is None


def test_a_whole_data_set_is_validated_on_the_papers_40():
    which, chosen, warning = split(kitti(*range(200)), None)
    assert (which, warning) == ("validation", None)
    assert [frame.name for frame in (chosen[0], chosen[-1])] == ["000160_10", "000199_10"]
    assert split(kitti(*range(200)), "train")[2] is None
    assert comparison("kitti2015", chosen).startswith("Ours are of the same 40 frames")


def test_missing_frames_are_counted():
    which, chosen, warning = split(kitti(*range(34), 160, 161), None)
    assert which == "all" and len(chosen) == 36
    assert warning == (
        "164 of 200 frames of KITTI 2015 are missing (126 of the 160 for train, 38 of the 40 for validation)"
    )
    assert split(kitti(0, 160), "validation")[2] == "39 of 40 frames of KITTI 2015 are missing"
    assert "2 of them among those 40" in comparison("kitti2015", chosen)


def test_frames_without_truth_do_not_count():
    with pytest.raises(OptionError, match=r"split 'all' must have frames with ground truth, got none \(there are 0"):
        split(kitti(1, truth=False), "all")


def test_bad_splits_are_refused():
    with pytest.raises(OptionError, match="split must be one of all, train, validation, got 'test'"):
        split(kitti(0), "test")
    with pytest.raises(OptionError, match=r"got none \(there are 1 for train, 0 for validation\)"):
        split(kitti(0), "validation")


def test_other_data_sets_say_so():
    assert comparison("scenes", kitti(0)).startswith("No published figures: they are of KITTI 2015")
