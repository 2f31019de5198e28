"""Images in every form, and the errors of those and of options that cannot be used."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import oracles
import pytest

import stereokit
from stereokit import InputError, Matcher, OptionError, StereokitError, UnknownNameError, match
from stereokit.images.blur import smooth
from stereokit.images.gray import gray_pair
from stereokit.images.intensity import to_gray
from stereokit.images.resize import half_size

METHOD = "census+sgm"
KEEP_ALL = {"fill": None, "smp": False, "speckle": 0, "uniqueness": 0, "median": 0}
"""Nothing becomes invalid for a reason other than its own pixel, and nothing is filled."""


def matched(left, right, **options):
    return match(left, right, METHOD, max_disparity=16, **options)


def pair_of(shape=(13, 30), seed=0, dtype=np.uint8, high=256):
    rng = np.random.default_rng(seed)
    return tuple(rng.integers(0, high, shape).astype(dtype) for _ in range(2))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("method", stereokit.METHODS.values())
def test_types_that_hold_the_same_values_give_the_same_map(method, dtype):
    left, right = pair_of()
    expected = match(left, right, method, max_disparity=16)
    np.testing.assert_array_equal(match(left.astype(dtype), right.astype(dtype), method, max_disparity=16), expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_colours_that_hold_the_same_values_give_the_same_map(dtype):
    left, right = pair_of((13, 30, 3), 1)
    np.testing.assert_array_equal(matched(left.astype(dtype), right.astype(dtype)), matched(left, right))


@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
def test_floats_that_hold_16_bits_give_the_map_of_16_bits(dtype):
    left, right = pair_of(dtype=np.uint16, high=65536)
    np.testing.assert_array_equal(matched(left.astype(dtype), right.astype(dtype)), matched(left, right))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("gain", "offset"), [(1 / 256, 0), (1024, -5), (2.0**100, 0), (-1, 0), (2.0**-60, 0)])
def test_floats_of_any_range_are_used_in_full(dtype, gain, offset):
    # Census compares grey values: a map that keeps their order (or turns it in both images) keeps costs.
    left, right = (np.clip(image, 1, 255) for image in pair_of(seed=2))
    volume = stereokit.cost_volume(left, right, "census", max_disparity=9)
    moved = [image.astype(dtype) * dtype(gain) + dtype(offset) for image in (left, right)]
    if gain < 0:
        volume = stereokit.cost_volume(255 - left, 255 - right, "census", max_disparity=9)
    np.testing.assert_array_equal(stereokit.cost_volume(*moved, "census", max_disparity=9), volume)


def test_the_whole_range_of_float64_is_no_overflow():
    left, right = (image.astype(np.float64) for image in pair_of(seed=3))
    low, high = np.finfo(np.float64).min, np.finfo(np.float64).max
    left[0, 0], right[0, 0] = low, high
    disparity = matched(left, right)
    assert np.isnan(disparity[0, 0]) and np.isfinite(disparity.ravel()[1:]).all()  # an outlier marks no data


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_rgb_is_grey_by_the_usual_weights(dtype):
    left, right = pair_of((9, 20, 3), 4, dtype)
    grey = gray_pair(left, right).left.astype(float)
    assert abs(grey - left @ [0.299, 0.587, 0.114]).max() < 1 or dtype in (np.float32, np.float64)
    pure = np.zeros((1, 3, 3), np.uint8)
    pure[0, range(3), range(3)] = 255
    np.testing.assert_array_equal(gray_pair(pure, pure).left, [[76, 150, 29]])  # red, green, blue


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_floats_become_grey_by_one_operation_after_the_other(dtype):
    """No fused operations and no sums in another order, or the bits would depend on the processor."""
    image = np.random.default_rng(0).normal(0, 100, (9, 67, 3)).astype(dtype)
    weights = [dtype(weight) for weight in (0.299, 0.587, 0.114)]
    expected = [[(r * weights[0] + g * weights[1]) + b * weights[2] for r, g, b in row] for row in image]
    np.testing.assert_array_equal(to_gray(image), np.array(expected, dtype))
    assert to_gray(image).dtype == dtype


def test_grey_may_have_a_channel_axis():
    left, right = pair_of(seed=5)
    np.testing.assert_array_equal(matched(left[:, :, None], right[:, :, None]), matched(left, right))
    np.testing.assert_array_equal(matched(left[:, :, None], right), matched(left, right))


VIEWS = {
    "reversed rows": lambda a: a[::-1],
    "reversed columns": lambda a: a[:, ::-1],
    "every second": lambda a: a[::2, ::2],
    "part": lambda a: a[1:-2, 3:-1],
    "transposed": lambda a: a.swapaxes(0, 1),
    "fortran": np.asfortranarray,
    "read only": lambda a: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape),
    "broadcast": lambda a: np.broadcast_to(a[:1], a.shape),
    "unaligned": lambda a: np.frombuffer(b"x" + a.tobytes(), np.uint8)[1:].view(a.dtype).reshape(a.shape),
}


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
@pytest.mark.parametrize("shape", [(14, 30), (14, 30, 3)], ids=["grey", "colour"])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_views_give_what_their_copies_give_and_stay_as_they_are(view, shape, dtype):
    left, right = (view(image) for image in pair_of(shape, 6, dtype))
    copies = np.array(left, order="C"), np.array(right, order="C")
    np.testing.assert_array_equal(matched(left, right), matched(*copies))
    np.testing.assert_array_equal(left, copies[0])
    np.testing.assert_array_equal(right, copies[1])


def test_unaligned_16_bits():
    left, right = (VIEWS["unaligned"](image) for image in pair_of(seed=7, dtype=np.uint16, high=4000))
    assert not left.flags.aligned
    np.testing.assert_array_equal(matched(left, right), matched(left.copy(), right.copy()))


@pytest.mark.parametrize("method", stereokit.METHODS.values())
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float64])
def test_inputs_are_never_modified(method, dtype):
    pair = pair_of(seed=8, dtype=dtype, high=250)
    if dtype == np.float64:
        pair[0][2, 3], pair[1][4, 5] = np.nan, np.inf
    copies = [image.copy() for image in pair]
    for scale in (1, 0.5):
        match(*pair, method, max_disparity=16, scale=scale)
        Matcher(method, max_disparity=16, scale=scale, right=True, confidence=True)(*pair)
    for image, copy in zip(pair, copies, strict=True):
        np.testing.assert_array_equal(image, copy)


def test_results_are_not_shared_with_later_calls():
    left, right = pair_of(seed=9)
    matcher = Matcher(METHOD, max_disparity=16, confidence=True, smp=False, median=0)
    first = matcher(left, right)
    copies = first.disparity.copy(), first.valid.copy(), first.confidence.copy()
    matcher(right, left)
    for array, copy in zip((first.disparity, first.valid, first.confidence), copies, strict=True):
        np.testing.assert_array_equal(array, copy)
    assert first.disparity.flags.writeable
    assert not np.shares_memory(first.disparity, left)


@pytest.mark.parametrize("method", stereokit.METHODS.values())
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_invalid(method, value):
    left, right = (image.astype(np.float32) for image in pair_of((15, 40), 10))
    left[3, 20], left[7, 30] = value, value
    result = Matcher(method, max_disparity=16, **KEEP_ALL)(left, right)
    expected = np.ones((15, 40), bool)
    expected[3, 20] = expected[7, 30] = False
    np.testing.assert_array_equal(result.valid, expected)
    np.testing.assert_array_equal(np.isnan(result.disparity), ~expected)
    filled = Matcher(method, max_disparity=16)(left, right)
    assert not filled.valid[~expected].any()
    np.testing.assert_array_equal(np.isnan(filled.disparity), ~expected)  # they are not filled either


@pytest.mark.parametrize("method", stereokit.METHODS.values())
def test_bad_pixels_of_the_right_image_do_no_harm_elsewhere(method):
    left = np.random.default_rng(11).integers(0, 256, (30, 80)).astype(np.float32)
    right = np.roll(left, -6, axis=1)
    right[15, 40] = np.nan
    disparity = match(left, right, method, max_disparity=16)
    assert abs(disparity[:, 20:] - 6).max() < 1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_colours_that_are_not_finite_are_bad_pixels_without_a_warning(dtype):
    left, right = pair_of((9, 30, 3), 12, dtype)
    left[2, 3] = [np.inf, -np.inf, 0]
    left[4, 5, 1] = np.nan
    result = Matcher(METHOD, max_disparity=16, **KEEP_ALL)(left, right)
    assert list(zip(*np.nonzero(~result.valid), strict=True)) == [(2, 3), (4, 5)]


@pytest.mark.parametrize("scale", [1, 0.5])
def test_an_image_without_any_finite_pixel_has_no_valid_pixel(scale):
    nothing, right = np.full((6, 20), np.nan), np.random.default_rng(13).random((6, 20))
    result = Matcher(METHOD, max_disparity=16, scale=scale, confidence=True)(nothing, right)
    assert not result.valid.any()
    assert (result.confidence == 0).all()


@pytest.mark.parametrize("shape", [(6, 8), (7, 9), (1, 1), (1, 5), (5, 1), (33, 71)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_half_size_is_the_rounded_mean_of_four(shape, dtype):
    left, right = pair_of(shape, 14, dtype, np.iinfo(dtype).max + 1)
    half = half_size(gray_pair(left, right))
    for image, source in ((half.left, left), (half.right, right)):
        expected = oracles.halve(source)
        assert image.shape == expected.shape
        assert abs(image - expected).max() <= 0.5
    assert half.guide.shape == half.left.shape


def test_half_size_is_bad_where_one_of_four_is():
    left, right = (image.astype(np.float32) for image in pair_of((7, 9), 15))
    left[6, 8], right[2, 3] = np.nan, np.inf
    half = half_size(gray_pair(left, right))
    assert list(zip(*np.nonzero(half.left_bad), strict=True)) == [(3, 4)]
    assert list(zip(*np.nonzero(half.right_bad), strict=True)) == [(1, 1)]


@pytest.mark.parametrize("shape", [(9, 14), (1, 8), (8, 1), (1, 1)])
@pytest.mark.parametrize("sigma", [0.3, 0.6, 1.5])
def test_smoothing_is_gaussian_and_keeps_fractions(shape, sigma):
    left, right = pair_of(shape, 17)
    pair = gray_pair(left, right)
    out = smooth(pair, sigma)
    for image, source in ((out.left, left), (out.right, right)):
        assert image.dtype == np.uint16
        assert image.shape == shape
        # 8-bit values times 256; OpenCV cuts the filter at four sigma and rounds its taps to 16 bits.
        assert abs(image - 256 * oracles.gaussian(source, sigma)).max() < 64
    np.testing.assert_array_equal(out.guide, left)
    assert smooth(pair, 0) is pair
    constant = np.full(shape, 200, np.uint8)
    assert (smooth(gray_pair(constant, constant), sigma).left == 200 * 256).all()


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (5, 1), (2, 3), (37, 83)])
def test_smoothing_is_that_of_opencv_to_the_last_bit(shape, dtype, threads):
    largest = np.iinfo(dtype).max
    left = np.random.default_rng(3).integers(0, largest, shape, dtype, endpoint=True)
    pair = gray_pair(left, np.full(shape, largest, dtype))
    for sigma in (0.2, 0.6, 0.7, 2.3, 10.0):
        out = smooth(pair, sigma, threads=threads)
        for image, source in ((out.left, pair.left), (out.right, pair.right)):
            deep = source.astype(np.uint16) * np.uint16(256 if dtype == np.uint8 else 1)
            expected = cv2.GaussianBlur(deep, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
            np.testing.assert_array_equal(image, expected.reshape(shape))


@pytest.mark.parametrize("method", ["census+sgm", "zncc+sgm"])
def test_matching_smoothed_images_is_smoothing_before_matching(method):
    left, right = pair_of((14, 40), 18)
    pair = smooth(gray_pair(left, right), 0.8)
    options = {"max_disparity": 16, "edge_factor": 1}  # nothing follows the guide, which stays sharp
    inside = Matcher(method, smooth=0.8, **options)(left, right)
    before = Matcher(method, smooth=0, **options)(pair.left, pair.right)
    np.testing.assert_array_equal(inside.disparity, before.disparity)
    cost = method.split("+")[0]
    np.testing.assert_array_equal(
        stereokit.cost_volume(left, right, cost, max_disparity=16, smooth=0.8),
        stereokit.cost_volume(pair.left, pair.right, cost, max_disparity=16),
    )


A = np.zeros((4, 5), np.uint8)


@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        (A[0], A, ["left", "(5,)"]),
        (A, A[None, None], ["right", "(1, 1, 4, 5)"]),
        (np.zeros((4, 5, 5), np.uint8), A, ["left", "(4, 5, 5)"]),
        (np.zeros((4, 5, 2), np.uint8), A, ["left", "(4, 5, 2)"]),
        (A[:0], A[:0], ["left", "empty", "(0, 5)"]),
        (A, A[:, :0], ["right", "empty", "(4, 0)"]),
        (np.zeros((0, 5, 3), np.uint8), A, ["left", "empty"]),
        (A, A[:3], ["same size", "(4, 5)", "(3, 5)"]),
        (A, A.astype(np.float32), ["same type", "uint8", "float32"]),
        (A.astype(np.int32), A, ["same type", "int32", "uint8"]),
        (A, A.astype(np.float16), ["same type", "uint8", "float16"]),
        (A.astype(complex), A, ["left", "complex"]),
        (A, A.astype("M8[s]"), ["right", "datetime64"]),
        (A.astype(object), A, ["left", "object"]),
        (None, A, ["left", "None", "was the file read?"]),
        (A, None, ["right", "None", "was the file read?"]),
        ("left.png", A, ["left", "path", "read_image"]),
        (A, Path("right.png"), ["right", "path", "read_image"]),
        ([[1, 2], [3]], A, ["left"]),
    ],
)
def test_images_that_cannot_be_used_are_named(left, right, words):
    for call in (matched, lambda a, b: stereokit.cost_volume(a, b, "census")):
        with pytest.raises(InputError) as caught:
            call(left, right)
        assert all(word in str(caught.value) for word in words), str(caught.value)
        assert "\n" not in str(caught.value)


BAD_OPTIONS = [
    ({"max_disparity": 0}, ["max_disparity", "at least 1", "0"]),
    ({"max_disparity": 3, "min_disparity": 3}, ["max_disparity", "at least 4", "3"]),
    ({"max_disparity": 16.0}, ["max_disparity", "integer", "16.0"]),
    ({"max_disparity": True}, ["max_disparity", "integer", "True"]),
    ({"max_disparity": "many"}, ["max_disparity", "many"]),
    ({"max_disparity": None}, ["max_disparity", "None"]),
    ({"max_disparity": 2049}, ["max_disparity", "2048", "2049"]),
    ({"min_disparity": 0.5}, ["min_disparity", "0.5"]),
    ({"scale": 2}, ["scale", "1, 0.5 or 0.25", "2"]),
    ({"scale": None}, ["scale", "None"]),
    ({"scale": "half"}, ["scale", "half"]),
    ({"device": "tpu"}, ["device", "cpu", "tpu"]),
    ({"threads": 0}, ["threads", "from 1", "0"]),
    ({"threads": -1}, ["threads", "-1"]),
    ({"threads": 1.5}, ["threads", "1.5"]),
    ({"refiner": "liner", "scale": 0.5}, ["refiner", "liner", "did you mean 'linear'"]),
    ({"refiner": 3, "scale": 0.5}, ["refiner", "3"]),
    ({"fill": "foreground"}, ["fill", "foreground", "background"]),
    ({"fill": 3}, ["fill", "3"]),
    ({"median": 4}, ["median", "4"]),
    ({"median": [3]}, ["median", "[3]"]),
    ({"median": "wide"}, ["median", "wide"]),
    ({"border_cost": 1.5}, ["border_cost", "1.5"]),
    ({"border_cost": float("nan")}, ["border_cost", "nan"]),
    ({"nodata": "none"}, ["nodata", "number", "none"]),
    ({"nodata": True}, ["nodata", "True"]),
    ({"smooth": -1}, ["smooth", "0 to 10", "-1"]),
    ({"smooth": None}, ["smooth", "None"]),
    ({"uniqueness": 101}, ["uniqueness", "0 to 100", "101"]),
    ({"speckle": 2}, ["speckle", "0 to 1", "2"]),
    ({"smp": 1}, ["smp", "True or False", "1"]),
    ({"subpixel": "parabola"}, ["subpixel", "parabola"]),
    ({"confidence": None}, ["confidence", "None"]),
    ({"right": 0}, ["right", "0"]),
    ({"windw": "9x7"}, ["windw", "did you mean 'window'"]),
    ({"sigma_s": 20}, ["sigma_s"]),
    ({"steps": 63}, ["steps"]),
    ({"window": 9}, ["window", "9x7", "9"]),
    ({"window": (9, 7)}, ["window", "9x7"]),
    ({"window": [9, 7]}, ["window", "9x7"]),
    ({"paths": 16}, ["paths", "16"]),
    ({"p1": 100, "p2": 50}, ["p1", "p2", "100", "50"]),
    ({"p2": 1000}, ["p2", "1000"]),
    ({"p1": "small"}, ["p1", "small"]),
]


@pytest.mark.parametrize(("options", "words"), BAD_OPTIONS, ids=lambda value: repr(value)[:40])
def test_options_outside_their_rule_are_named(options, words):
    calls = [lambda: Matcher(METHOD, **options), lambda: match(A, A, METHOD, **options)]
    for call in calls[: 1 if "right" in options else 2]:  # `match` has no such option: it returns one map
        with pytest.raises(OptionError) as caught:
            call()
        assert all(word in str(caught.value) for word in words), str(caught.value)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"window": 4}, ["window", "odd", "4"]),
        ({"window": 1}, ["window", "from 3", "1"]),
        ({"window": 5.0}, ["window", "5.0"]),
        ({"window": "5x5"}, ["window", "5x5"]),
        ({"window": 129}, ["window", "127", "129"]),
        ({"steps": 0}, ["steps", "1 to 254", "0"]),
        ({"steps": 255}, ["steps", "255"]),
        ({"steps": 254, "p2": 1}, ["p2", "1"]),
    ],
)
def test_options_of_zncc(options, words):
    with pytest.raises(OptionError) as caught:
        Matcher("zncc+sgm", **options)
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ("zncc", ["zncc", "S4"]),
        ("", ["method", "''"]),
        ("S5", ["S5", "S4"]),
        ("zncc+sgn", ["sgn", "did you mean 'sgm'"]),
        ("senses+sgm", ["senses", "did you mean 'census'"]),
        ("zncc+sgm+dt", ["zncc+sgm+dt"]),
        (4, ["method", "4"]),
        (None, ["method", "None"]),
        (["zncc", "sgm"], ["method"]),
    ],
)
def test_methods_that_do_not_exist(method, words):
    for call in (lambda m: Matcher(m), lambda m: match(A, A, m)):
        with pytest.raises(OptionError) as caught:
            call(method)
        assert all(word in str(caught.value) for word in words), str(caught.value)
        assert "\n" not in str(caught.value)


def test_numbers_of_numpy_are_numbers():
    numbers = {"max_disparity": np.int64(16), "window": np.int32(5), "steps": np.uint8(63)}
    assert Matcher("zncc+sgm", **numbers, p1=np.float32(0.5), border_cost=np.float64(0.5)).max_disparity == 16
    assert Matcher("zncc+dt", **numbers, sigma_s=np.float32(9), passes=np.int64(1)).max_disparity == 16


@pytest.mark.parametrize("options", [{"max_disparity": 16.0}, {"smp": 1}, {"threads": 2.0}])
def test_a_wrong_type_is_refused_even_if_an_equal_value_was_used_before(options):
    right_types = {"max_disparity": 16, "smp": True, "threads": 2}
    common = {} if "max_disparity" in options else {"max_disparity": 16}
    match(A, A, METHOD, **common, **{name: right_types[name] for name in options})
    with pytest.raises(OptionError):
        match(A, A, METHOD, **common, **options)


@pytest.mark.parametrize(
    "call",
    [
        lambda: stereokit.cost_volume(A, A, "sad"),
        lambda: stereokit.cost_volume(A, A, None),
        lambda: stereokit.cost_volume(A, A, "census", steps=3),
        lambda: stereokit.cost_volume(A, A, "census", max_disparity=0),
        lambda: stereokit.cost_volume(A, A, "census", border_cost=2),
        lambda: stereokit.cost_volume(A, A, "census", threads=0),
        lambda: stereokit.aggregate(np.zeros((4, 5, 3), np.uint8), A, "bilateral"),
        lambda: stereokit.aggregate(np.zeros((4, 5, 3), np.uint8), A, None),
        lambda: stereokit.aggregate(np.zeros((4, 5, 3), np.uint8), A, "sgm", cost="sad"),
        lambda: stereokit.aggregate(np.zeros((4, 5, 3), np.uint8), None, "sgm"),
        lambda: stereokit.select([[[1, 2, 3]]]),
        lambda: stereokit.select(np.zeros((4, 5, 3), np.uint16), min_disparity=0.5),
        lambda: stereokit.select(np.zeros((4, 5, 3), np.uint16), subpixel="no"),
        lambda: stereokit.warmup("S9"),
    ],
)
def test_stages_refuse_what_they_cannot_use(call):
    with pytest.raises(StereokitError) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_errors_are_one_family_of_value_errors():
    assert issubclass(UnknownNameError, OptionError)
    for error in (InputError, OptionError, UnknownNameError):
        assert issubclass(error, StereokitError)
        assert issubclass(error, ValueError)
