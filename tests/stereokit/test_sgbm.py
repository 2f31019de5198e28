"""OpenCV's StereoSGBM and ours behind one interface: what callers rely on holds for both."""

from __future__ import annotations

import inspect
import warnings

import cv2
import numpy as np
import pytest

import stereokit
from stereokit import opencv

BOTH = pytest.mark.parametrize("create", [cv2.StereoSGBM_create, opencv.StereoSGBM_create], ids=["cv2", "stereokit"])
SHIFT = 7


@pytest.fixture(scope="module")
def pair():
    """Return views of a textured plane at a disparity of 7 pixels."""
    image = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (60, 160 + SHIFT), dtype=np.uint8), (0, 0), 0.8)
    return np.ascontiguousarray(image[:, :-SHIFT]), np.ascontiguousarray(image[:, SHIFT:])


@BOTH
@pytest.mark.parametrize("minimum", [-16, 0, 4])
def test_maps_are_sixteenths_in_16_bits_with_one_invalid_value(create, minimum, pair):
    disparity = create(minDisparity=minimum, numDisparities=32).compute(*pair)
    invalid = 16 * (minimum - 1)
    assert disparity.dtype == np.int16
    assert disparity.shape == pair[0].shape
    assert set(np.unique(disparity[disparity < 16 * minimum])) <= {invalid}
    assert disparity.max() < 16 * (minimum + 32)
    inside = disparity[:, 60:140]  # with a negative minimum OpenCV leaves columns at the right border invalid too
    assert np.abs(np.median(inside[inside != invalid]) / 16 - SHIFT) < 0.2
    assert (inside != invalid).mean() > 0.9


@BOTH
def test_what_is_set_can_be_read(create):
    matcher = create()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stereokit.StereokitWarning)
        for number, name in enumerate(inspect.signature(opencv.StereoSGBM_create).parameters):
            method = name[0].upper() + name[1:]
            getattr(matcher, f"set{method}")(16 + number)
            assert getattr(matcher, f"get{method}")() == 16 + number


@BOTH
def test_arguments_come_in_one_order_with_the_same_defaults(create):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stereokit.StereokitWarning)
        matcher = create(1, 32, 5, 10, 40, -1, 20, 3, 50, 2, 1)
    getters = [f"get{n[0].upper()}{n[1:]}" for n in inspect.signature(opencv.StereoSGBM_create).parameters]
    assert [getattr(matcher, name)() for name in getters] == [1, 32, 5, 10, 40, -1, 20, 3, 50, 2, 1]
    theirs, plain = cv2.StereoSGBM_create(), create()
    assert [getattr(plain, name)() for name in getters] == [getattr(theirs, name)() for name in getters]


@BOTH
def test_a_map_that_fits_is_written_in_place(create, pair):
    place = np.zeros(pair[0].shape, np.int16)
    result = create(numDisparities=16).compute(*pair, place)
    assert result is place
    assert create(numDisparities=16).compute(*pair, np.zeros((3, 3), np.float32)).shape == pair[0].shape


@BOTH
def test_colour_is_bgr(create, pair):
    """Ours weighs the channels as OpenCV's own conversion from BGR does."""
    rng = np.random.default_rng(2)
    left, right = (np.dstack([image, np.full_like(image, 90), np.full_like(image, 20)]) for image in pair)
    disparity = create(numDisparities=16).compute(left, right)
    assert abs(np.median(disparity[:, 40:]) / 16 - SHIFT) < 0.2
    mixed = [rng.integers(0, 256, (20, 50, 3), dtype=np.uint8) for _ in range(2)]
    grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in mixed]
    if create is opencv.StereoSGBM_create:
        assert np.array_equal(create().compute(*mixed), create().compute(*grey))


@BOTH
def test_what_both_refuse(create, pair):
    matcher = create(numDisparities=16)
    for left, right in ((pair[0], pair[1][:, :-1]), (pair[0].astype(np.float32),) * 2, (None, None)):
        with pytest.raises((cv2.error, stereokit.InputError)):
            matcher.compute(left, right)


def test_maps_are_those_of_the_matcher(pair):
    """Rounded to sixteenths; speckles are counted in pixels."""
    left, right = pair
    sgbm = opencv.StereoSGBM_create(numDisparities=32, uniquenessRatio=10, speckleWindowSize=40, disp12MaxDiff=-1)
    options = {"max_disparity": 32, "uniqueness": 10, "speckle": 40.5 / left.size, "smp": False, "fill": None}
    result = stereokit.Matcher("census+sgm", **options)(left, right)
    expected = np.where(result.valid, np.rint(result.disparity * 16), -16)
    assert np.array_equal(sgbm.compute(left, right), expected)
    sgbm.setSpeckleWindowSize(0)
    assert sgbm.matcher(left.size).settings.speckle == 0
    assert sgbm.matcher(left.size).settings.uniqueness == 10


def test_what_has_no_counterpart_is_named_once():
    with pytest.warns(stereokit.StereokitWarning, match="blockSize, P1, P2 have no counterpart") as caught:
        opencv.StereoSGBM_create(0, 64, 5, 200, 800)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    with pytest.warns(stereokit.StereokitWarning, match="mode has no counterpart"):
        opencv.StereoSGBM_create().setMode(opencv.STEREO_SGBM_MODE_HH)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opencv.StereoSGBM_create(-3, 64, uniquenessRatio=5, speckleWindowSize=100)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"numDisparities": 0}, "numDisparities must be .* got 0"),
        ({"numDisparities": 2100}, "numDisparities must stay within .* got 0 and 2100"),
        ({"minDisparity": -5000}, "minDisparity .* got -5000"),
        ({"uniquenessRatio": 101}, "uniquenessRatio must be .* got 101"),
        ({"numDisparities": 16.5}, "numDisparities must be"),
    ],
)
def test_values_out_of_range_are_refused(arguments, line):
    with pytest.raises(stereokit.OptionError, match=line):
        opencv.StereoSGBM_create(**arguments)


def test_a_refused_value_changes_nothing():
    sgbm = opencv.StereoSGBM_create(numDisparities=64)
    with pytest.raises(stereokit.OptionError):
        sgbm.setNumDisparities(5000)
    assert sgbm.getNumDisparities() == 64


def test_names_are_opencvs():
    for name in opencv.__all__:
        assert hasattr(cv2, name)
    for name in ("SGBM", "HH", "SGBM_3WAY", "HH4"):
        value = getattr(cv2, f"STEREO_SGBM_MODE_{name}")
        assert getattr(opencv, f"STEREO_SGBM_MODE_{name}") == getattr(opencv.StereoSGBM, f"MODE_{name}") == value
    assert {n for n in dir(cv2.StereoSGBM) if n[:3] in ("get", "set")} - set(dir(opencv.StereoSGBM)) == {
        "getDefaultName"
    }
