"""Grey values of floats and 16 bits: no outlier and no mark of missing pixels decides what all others become."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import stereokit
from stereokit import Matcher
from stereokit.errors import StereokitWarning
from stereokit.images.gray import gray_pair
from stereokit.images.intensity import display_8bit, fill_bad

METHODS = tuple(stereokit.METHODS)
SHIFT = 9
EVIDENCE = {"fill": None, "smp": False, "speckle": 0, "uniqueness": 0, "median": 0}
"""A pixel is invalid for want of evidence only."""


@pytest.fixture(scope="module")
def scene():
    """Return a textured pair, (H, W) uint8 each, all at one disparity; a value or two of each are rare."""
    rng = np.random.default_rng(0)
    fine, coarse = rng.normal(size=(48, 160)), np.kron(rng.normal(size=(12, 40)), np.ones((4, 4)))
    texture = np.clip(127 + 25 * fine + 45 * coarse, 0, 255).astype(np.uint8)
    return texture[:, :-SHIFT].copy(), texture[:, SHIFT:].copy()


def wrong(disparity):
    """Return the share of pixels, seen by both views, whose disparity is off by more than a pixel or missing."""
    return np.mean(~(np.abs(disparity - SHIFT) <= 1)[:, 16:])


def put(pair, where, value):
    """Return copies of a pair with `value` in some places, which differ between the views."""
    left, right = pair[0].copy(), pair[1].copy()
    if where == "pixel":
        left[20, 70] = value
    elif where == "corner":
        left[:4, :4], right[-4:, -4:] = value, value
    else:  # borders, a quarter of each view
        left[:10], right[:, -30:] = value, value
    return left, right


def as_dn(pair):
    """Return a pair as a sensor's 16 bits: 300 to 810."""
    return tuple(image.astype(np.uint16) * 2 + 300 for image in pair)


def as_floats(pair, dtype=np.float32):
    return tuple(image.astype(dtype) / 255 for image in pair)


FLOAT_MARKS = (-3.4028235e38, -9999, -32768, -1, 1e5, 3e38, np.inf, -np.inf)


@pytest.mark.parametrize("where", ["pixel", "corner", "border"])
@pytest.mark.parametrize("value", FLOAT_MARKS)
def test_marks_in_floats_are_what_nan_is(scene, value, where):
    for dtype in (np.float32, np.float64):
        pair = gray_pair(*put(as_floats(scene, dtype), where, value))
        expected = gray_pair(*put(as_floats(scene, dtype), where, np.nan))
        for name in ("left", "right", "left_bad", "right_bad", "guide"):
            np.testing.assert_array_equal(getattr(pair, name), getattr(expected, name))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["floats", "whole floats", "dn", "colour"])
def test_a_few_values_do_not_cost_the_pair_its_levels(scene, kind, method):
    pair = {
        "floats": as_floats(scene),
        "whole floats": tuple(image.astype(np.float32) for image in as_dn(scene)),
        "dn": as_dn(scene),
        "colour": tuple(np.dstack([image * np.float32(k) for k in (0.9, 1, 1.1)]) for image in as_floats(scene)),
    }[kind]
    marks = (65535,) if kind == "dn" else (-3.4028235e38, -9999, 1e5)
    clean = wrong(stereokit.match(*pair, method, max_disparity=16))
    for value in marks:
        for where in ("pixel", "corner"):
            result = Matcher(method, max_disparity=16)(*put(pair, where, value))
            assert wrong(result.disparity) <= clean + 0.005, (value, where)
            assert result.density > 0.8


@pytest.mark.parametrize("method", METHODS)
def test_many_outliers_of_all_sizes(scene, method):
    rng = np.random.default_rng(1)
    left, right = as_dn(scene)
    clean = Matcher(method, max_disparity=16)(left, right)
    hot = rng.random(left.shape) < 0.004
    left[hot] = rng.integers(3000, 65536, np.count_nonzero(hot))
    result = Matcher(method, max_disparity=16)(left, right)
    assert wrong(result.disparity) <= wrong(clean.disparity) + 0.03
    guide = gray_pair(left, right).guide
    assert len(np.unique(guide)) > 100


def test_a_mark_is_seen_behind_hot_pixels(scene):
    rng = np.random.default_rng(10)
    left, right = put(as_floats(scene), "border", 300)
    hot = rng.random(left.shape) < 0.001
    left[hot] = rng.uniform(1000, 1e6, np.count_nonzero(hot))
    pair = gray_pair(left, right)
    np.testing.assert_array_equal(pair.left_bad, left >= 300)
    assert len(np.unique(pair.guide)) > 200


@pytest.mark.parametrize("method", METHODS)
def test_evident_marks_and_nodata_are_never_valid(scene, method):
    marked = put(as_floats(scene), "border", -9999)
    where = marked[0] == -9999
    result = Matcher(method, max_disparity=16, **EVIDENCE)(*marked)
    np.testing.assert_array_equal(result.valid, ~where)
    eight = put(scene, "border", 77)
    result = Matcher(method, max_disparity=16, nodata=77, **EVIDENCE)(*eight)
    np.testing.assert_array_equal(result.valid, eight[0] != 77)
    assert np.isnan(result.disparity[eight[0] == 77]).all()
    filled = Matcher(method, max_disparity=16, nodata=77)(*eight)
    np.testing.assert_array_equal(np.isnan(filled.disparity), eight[0] == 77)


@pytest.mark.parametrize("scale", [1, 0.5])
def test_nodata_is_what_nan_is(scene, scale):
    for value, pair in ((0, scene), (500, as_dn(scene)), (0.25, as_floats(scene)), (-3.4028235e38, as_floats(scene))):
        marked = put(pair, "border", value)
        holes = tuple(np.where(image == image.dtype.type(value), np.nan, image.astype(np.float64)) for image in marked)
        options = {"max_disparity": 16, "scale": scale}
        result = Matcher("S4", nodata=value, **options)(*marked)
        expected = Matcher("S4", **options)(*holes)
        np.testing.assert_array_equal(result.disparity, expected.disparity)
        np.testing.assert_array_equal(result.valid, expected.valid)
    volume = stereokit.cost_volume(*put(scene, "border", 0), "census", max_disparity=16, nodata=0)
    assert (volume[0] == volume[0, 0, 0]).all()


def test_colours_are_nodata_where_all_three_are():
    rng = np.random.default_rng(2)
    left, right = rng.integers(1, 256, (2, 12, 40, 3), np.uint8)
    left[3, 4], left[5, 6, 1:] = 0, 0
    pair = gray_pair(left, right, 0)
    assert list(zip(*np.nonzero(pair.left_bad), strict=True)) == [(3, 4)]
    assert pair.right_bad is None


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_transparent_pixels_are_no_evidence(scene, dtype):
    alpha = np.full(scene[0].shape, 255)
    alpha[10:20, 30:50] = 0
    rgba = [np.dstack([image] * 3 + [alpha]).astype(dtype) for image in scene]
    result = Matcher("S2", max_disparity=16, **EVIDENCE)(*rgba)
    np.testing.assert_array_equal(result.valid, alpha > 0)
    opaque = [np.dstack([image] * 3 + [np.full_like(alpha, 200)]).astype(dtype) for image in scene]
    expected = stereokit.match(*(image[:, :, :3] for image in opaque), "S2", max_disparity=16)
    np.testing.assert_array_equal(stereokit.match(*opaque, "S2", max_disparity=16), expected)


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.int64, np.uint32, np.float16])
def test_other_numbers_are_taken_by_their_values(scene, dtype):
    expected = stereokit.match(*scene, "S4", max_disparity=16)
    np.testing.assert_array_equal(
        stereokit.match(*(image.astype(dtype) for image in scene), "S4", max_disparity=16), expected
    )
    if dtype in (np.int16, np.int32):
        marked = [image.astype(dtype) for image in put([image.astype(np.int32) for image in scene], "border", -32768)]
        pair = gray_pair(*marked)
        assert pair.left.dtype == np.uint8
        np.testing.assert_array_equal(pair.left_bad, marked[0] < 0)


def test_truth_values_are_two_levels(scene):
    left, right = (image > 127 for image in scene)
    expected = stereokit.match(left.astype(np.uint8), right.astype(np.uint8), "S2", max_disparity=16)
    np.testing.assert_array_equal(stereokit.match(left, right, "S2", max_disparity=16), expected)


def test_grey_with_colour_is_matched_in_grey(scene):
    color = np.dstack([scene[1]] * 3)
    expected = stereokit.match(*scene, "S2", max_disparity=16)
    np.testing.assert_array_equal(stereokit.match(scene[0], color, "S2", max_disparity=16), expected)


# What stays


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_8_bits_stay_bit_for_bit_whatever_they_hold(dtype):
    rng = np.random.default_rng(3)
    left, right = rng.integers(100, 118, (2, 30, 50))
    left[0, 0], right[5, :20] = 255, 0  # would be marks, were there more than 8 bits
    pair = gray_pair(left.astype(dtype), right.astype(dtype))
    assert pair.left.dtype == np.uint8
    np.testing.assert_array_equal(pair.left, left)
    np.testing.assert_array_equal(pair.right, right)
    np.testing.assert_array_equal(pair.guide, left)
    assert pair.left_bad is None and pair.right_bad is None


def test_a_pair_that_needs_no_clipping_keeps_every_level():
    rng = np.random.default_rng(4)
    left, right = rng.normal(20000, 3000, (2, 60, 80)).astype(np.uint16)
    ordered = np.sort(np.concatenate([left.ravel(), right.ravel()]))
    core = ordered[48], ordered[-49]  # half a percent of 9600 lies beyond at either end
    assert ordered[-1] - core[1] < (core[1] - core[0]) / 2 > core[0] - ordered[0]
    pair = gray_pair(left, right)
    np.testing.assert_array_equal(pair.left, left)
    np.testing.assert_array_equal(pair.right, right)
    real = gray_pair(left / 7, right / 7)
    span = float(ordered[-1]) - float(ordered[0])
    np.testing.assert_array_equal(real.left, np.rint((left - float(ordered[0])) / span * 65535))


def test_what_lies_far_out_is_clipped_and_order_is_kept():
    rng = np.random.default_rng(5)
    left, right = rng.normal(20000, 500, (2, 60, 80))
    left[7, :20] = np.linspace(5000, 40000, 20)
    ordered = np.sort(np.concatenate([left.ravel(), right.ravel()]))
    first, last = ordered[48], ordered[-49]
    reach = (last - first) / 2
    for pair, unit in (((left, right), 1.0), ((left.astype(np.uint16), right.astype(np.uint16)), 1.0)):
        gray = gray_pair(*pair)
        assert gray.left_bad is None
        order = np.argsort(pair[0], axis=None, kind="stable")
        assert (np.diff(gray.left.ravel()[order].astype(int)) >= 0).all()
        inside = (pair[0] >= first - reach + unit) & (pair[0] <= last + reach - unit)
        values = pair[0][inside]
        assert len(np.unique(gray.left[inside])) >= 0.98 * len(np.unique(values)) if values.dtype == np.uint16 else True
        assert (gray.left[pair[0] > last + reach + unit] == gray.left.max()).all()
        assert (gray.left[pair[0] < first - reach - unit] == gray.left.min()).all()


def test_rows_without_any_evidence_do_not_enter_the_range():
    rng = np.random.default_rng(6)
    left, right = 1000 + rng.random((2, 40, 60))
    left[5] = np.nan
    assert len(np.unique(gray_pair(left, right).guide)) > 200


def test_large_images_are_sampled_and_small_marks_are_clipped_at_least():
    rng = np.random.default_rng(7)
    left, right = rng.random((2, 600, 700), np.float32)
    left[1, 1] = 1e30  # on no grid of every second pixel
    pair = gray_pair(left, right)
    assert len(np.unique(pair.guide)) > 150


# The warning


def warned(call):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return [str(one.message) for one in caught if one.category is StereokitWarning]


def test_a_pair_that_has_lost_its_levels_is_warned_of():
    rng = np.random.default_rng(8)
    left, right = (1000 + rng.random((2, 40, 60))).astype(np.float32)
    left[:, :6] = right[:, :6] = np.linspace(0, 900, 6)  # many values, which are no marks, far from all others
    for call in (
        lambda: stereokit.match(left, right, "S2", max_disparity=16),
        lambda: stereokit.match((left * 30).astype(np.uint16), (right * 30).astype(np.uint16), "S2", max_disparity=16),
    ):
        messages = warned(call)
        assert len(messages) == 1
        assert "nodata" in messages[0] and "of 256" in messages[0] and "\n" not in messages[0]


def test_ordinary_pairs_are_not_warned_of(scene, tmp_path):
    few = tuple((image // 32).astype(np.float32) / 7 for image in scene)  # that few from the start
    for pair in (scene, as_dn(scene), as_floats(scene), few, (np.full((9, 9), 0.5),) * 2):
        assert warned(lambda pair=pair: stereokit.match(*pair, "S2", max_disparity=16)) == []
    assert issubclass(StereokitWarning, UserWarning)


def test_windows_warn_once(tmp_path):
    rng = np.random.default_rng(9)
    left, right = (1000 + rng.random((2, 60, 90))).astype(np.float32)
    left[:, :9] = np.linspace(0, 900, 9)
    call = lambda: stereokit.match_large(left, right, tmp_path / "m.npy", "S2", max_disparity=16)  # noqa: E731
    assert len(warned(call)) == 1


# To look at


def test_images_are_shown_over_the_range_that_they_have(scene):
    image = scene[0]
    np.testing.assert_array_equal(display_8bit(image), image)
    color = np.dstack([image, image[::-1], image[:, ::-1]])
    for shown, plain in ((image, image), (color, color)):
        low, high = float(plain.min()), float(plain.max())
        expected = np.rint((plain - low) / (high - low) * 255)
        for deep in (shown.astype(np.uint16) * 16, shown.astype(np.float32) / 255, shown * 1000.0 - 5):
            np.testing.assert_allclose(display_8bit(deep), expected, atol=1)
    hot = color.astype(np.float32) / 255
    hot[3, 4] = 1e6
    hot[5, 6] = np.nan
    shown = display_8bit(hot)
    assert shown.dtype == np.uint8 and shown.shape == color.shape
    assert (shown[5, 6] == 0).all() and np.percentile(shown, 99) > 200
    alpha = np.where(np.arange(image.shape[1]) < 5, 0, 255) + 0 * image
    shown = display_8bit(np.dstack([color, alpha.astype(np.uint8)]))
    assert (shown[:, :5] == 0).all()
    np.testing.assert_array_equal(shown[:, 5:], color[:, 5:])
    assert (display_8bit(image, nodata=int(image[0, 0]))[image == image[0, 0]] == 0).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_bad_pixels_take_the_last_good_one_of_their_row(dtype):
    image = np.arange(1, 22).reshape(3, 7).astype(dtype)
    bad = np.array([[1, 1, 0, 0, 1, 1, 0], [0, 0, 1, 0, 0, 1, 1], [1] * 7], bool)
    wanted = np.array([[3, 3, 3, 4, 4, 4, 7], [8, 9, 9, 11, 12, 12, 12], [0] * 7], dtype)
    for layout in (np.ascontiguousarray, np.asfortranarray):
        filled = fill_bad(layout(image), layout(bad))
        np.testing.assert_array_equal(filled, wanted)
        assert filled.dtype == dtype
    assert image[0, 0] == 1  # what came in stays
