"""Matching costs against loops: every cell, borders and bad pixels included."""

from __future__ import annotations

import cv2
import numba
import numpy as np
import oracles
import pytest

import stereokit
from stereokit import OptionError, RowCost, cost_volume

SHAPES = [(7, 9), (1, 13), (13, 1), (1, 1), (4, 6)]
RANGES = [(0, 5), (0, 1), (-4, 7), (3, 6), (0, 70), (-30, 66), (50, 3), (-60, 3)]
"""(minimum, number of levels): more levels than columns, more than one block of 64, and all outside."""


def options(minimum, count):
    return {"min_disparity": minimum, "max_disparity": minimum + count, "threads": 1}


def assert_rounded(volume, cost, steps):
    """`volume` is `cost` times steps, rounded; float32 correlations may fall on either side of a half."""
    assert volume.dtype == np.uint8
    assert np.abs(volume - cost * steps).max() <= 0.5 + 1e-4 * steps


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_census_counts_the_neighbours_that_differ(random_pair, shape, dtype):
    left, right = random_pair(*shape, seed=1, dtype=dtype, high=np.iinfo(dtype).max + 1)
    volume = cost_volume(left, right, "census", **options(-2, 6))
    assert volume.dtype == np.uint8
    assert volume.shape == (*shape, 6)
    np.testing.assert_array_equal(volume, oracles.census(left, right, -2, 6))


@pytest.mark.parametrize(("minimum", "count"), RANGES)
@pytest.mark.parametrize("outside", [1.0, 0.5, None])
def test_census_over_ranges_of_disparity(random_pair, minimum, count, outside):
    left, right = random_pair(3, 9, seed=2, high=4)
    volume = cost_volume(left, right, "census", outside=outside, **options(minimum, count))
    np.testing.assert_array_equal(volume, oracles.census(left, right, minimum, count, outside=outside))


@pytest.mark.parametrize(("window", "width", "height"), [("5x5", 5, 5), ("7x7", 7, 7), ("9x7", 9, 7)])
def test_census_windows_count_every_neighbour(random_pair, window, width, height):
    left, right = random_pair(6, 10, seed=3)
    volume = cost_volume(left, right, "census", window=window, **options(0, 4))
    np.testing.assert_array_equal(volume, oracles.census(left, right, 0, 4, width, height))
    assert stereokit.Census(window).cost_max == width * height - 1


def test_census_reaches_its_largest_cost():
    # The centre is above all neighbours on the left and below them on the right: all 62 bits differ.
    left, right = np.full((7, 9), 10, np.uint8), np.full((7, 9), 10, np.uint8)
    left[3, 4], right[3, 4] = 11, 9
    assert cost_volume(left, right, "census", **options(0, 1))[3, 4, 0] == 62


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_zncc_is_the_rounded_correlation(random_pair, shape, dtype):
    left, right = random_pair(*shape, seed=4, dtype=dtype, high=256 if dtype == np.uint8 else 2600)
    volume = cost_volume(left, right, "zncc", window=5, steps=63, **options(-2, 6))
    assert_rounded(volume, oracles.zncc(left, right, -2, 6), 63)


@pytest.mark.parametrize(("minimum", "count"), RANGES)
@pytest.mark.parametrize("outside", [1.0, 0.5, None])
def test_zncc_over_ranges_of_disparity(random_pair, minimum, count, outside):
    left, right = random_pair(3, 9, seed=5)
    volume = cost_volume(left, right, "zncc", window=5, steps=63, outside=outside, **options(minimum, count))
    expected = oracles.zncc(left, right, minimum, count, outside=outside)
    assert_rounded(volume, expected, 63)


@pytest.mark.parametrize(("window", "steps"), [(3, 1), (3, 254), (7, 100), (11, 63)])
def test_zncc_windows_and_steps(random_pair, window, steps):
    left, right = random_pair(8, 9, seed=6)
    volume = cost_volume(left, right, "zncc", window=window, steps=steps, **options(0, 4))
    assert_rounded(volume, oracles.zncc(left, right, 0, 4, window), steps)
    assert volume.max() <= steps


@pytest.mark.parametrize(("dtype", "window"), [(np.uint16, 5), (np.uint8, 31)])
def test_zncc_of_ranges_that_need_scaling_is_near_the_correlation(random_pair, dtype, window):
    # 16-bit ranges, and 8-bit ones under large windows, are scaled to fit; that moves a grey level by half of
    # 1/2620 or 1/68 of the range, and the correlation of noise by about as much.
    left, right = random_pair(9, 12, seed=7, dtype=dtype, high=np.iinfo(dtype).max + 1)
    volume = cost_volume(left, right, "zncc", window=window, steps=254, **options(0, 4))
    error = np.abs(volume - oracles.zncc(left, right, 0, 4, window) * 254)
    assert error.max() <= 0.5 + 254 * 0.02


def test_zncc_of_a_window_without_variance_is_the_worst(random_pair):
    left, right = random_pair(9, 16, seed=8)
    left[:, :8] = 7
    volume = cost_volume(left, right, "zncc", window=5, steps=63, **options(0, 3))
    assert (volume[:, :6] == 63).all()
    assert_rounded(volume, oracles.zncc(left, right, 0, 3), 63)
    right[:] = 200
    assert (cost_volume(left, right, "zncc", steps=63, **options(0, 3)) == 63).all()


def test_zncc_of_equal_and_of_inverted_images():
    left = np.random.default_rng(9).integers(0, 256, (9, 16), dtype=np.uint8)
    assert (cost_volume(left, left, "zncc", **options(0, 1)) == 0).all()
    assert (cost_volume(left, 255 - left, "zncc", steps=63, **options(0, 1)) == 63).all()  # 1 - rho = 2, clipped


@pytest.mark.parametrize("power", [0, 1, 3])
def test_zncc_does_not_change_under_brightness_and_powers_of_two_of_contrast(random_pair, power):
    left, right = random_pair(9, 12, seed=10, dtype=np.uint16)
    plain = cost_volume(left, right, "zncc", window=5, **options(-2, 6))
    moved = left * 2**power + 777, right * 2**power + 90
    np.testing.assert_array_equal(plain, cost_volume(moved[0], right, "zncc", window=5, **options(-2, 6)))
    np.testing.assert_array_equal(plain, cost_volume(left, moved[1], "zncc", window=5, **options(-2, 6)))


@pytest.mark.parametrize("cost", ["census", "zncc"])
@pytest.mark.parametrize("side", ["left", "right", "both"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_bad_pixels_never_spread_beyond_their_window(random_pair, cost, side, value):
    left, right = (image.astype(np.float32) for image in random_pair(15, 31, seed=11))
    minimum, count, worst = -3, 20, {"census": 62, "zncc": 63}[cost]
    choice = {"census": {"window": "9x7"}, "zncc": {"window": 5, "steps": 63}}[cost]
    clean = cost_volume(left, right, cost, **choice, **options(minimum, count))
    touched, own = np.zeros(clean.shape, bool), np.zeros(clean.shape, bool)
    columns = np.arange(31)[:, None] - np.arange(count)[None, :] - minimum
    points = {"left": [(2, 20), (7, 0)], "right": [(8, 11), (14, 30)]}
    for name, image in (("left", left), ("right", right)):
        if side not in (name, "both"):
            continue
        for y, x in points[name]:
            image[y, x] = value
            where = np.broadcast_to(np.arange(31)[:, None], columns.shape) if name == "left" else columns
            own[y] |= where == x
            touched[max(y - 3, 0) : y + 4] |= abs(where - x) <= 4
    volume = cost_volume(left, right, cost, outside=1.0, **choice, **options(minimum, count))
    assert (volume[own] == worst).all()
    np.testing.assert_array_equal(volume[~touched], clean[~touched])
    assert touched.mean() < 0.5


def test_bad_pixels_have_the_cost_of_no_evidence(random_pair):
    left, right = (image.astype(np.float32) for image in random_pair(9, 20, seed=12))
    left[4, 15], right[2, 3] = np.nan, np.nan
    volume = cost_volume(left, right, "census", outside=0.5, **options(0, 8))
    assert (volume[4, 15] == 31).all()
    assert all(volume[2, 3 + d, d] == 31 for d in range(8))


@pytest.mark.parametrize("cost", ["census", "zncc"])
def test_images_without_any_finite_pixel_are_all_without_evidence(cost):
    nothing = np.full((5, 8), np.nan, np.float32)
    volume = cost_volume(nothing, nothing, cost, **options(0, 4))
    assert (volume == volume.max()).all()


@pytest.mark.parametrize("cost", ["census", "zncc"])
@pytest.mark.parametrize("threads", [2, 3, 50])
def test_volumes_do_not_depend_on_threads(random_pair, cost, threads):
    left, right = random_pair(17, 20, seed=13)
    one = cost_volume(left, right, cost, max_disparity=20, threads=1)
    np.testing.assert_array_equal(one, cost_volume(left, right, cost, max_disparity=20, threads=threads))


def absolute_difference(left, right, y, min_disparity, out):
    """Write a cost row as plain python: a row cost need not be compiled."""
    for x in range(out.shape[0]):
        for d in range(out.shape[1]):
            xr = x - d - min_disparity
            if 0 <= xr < right.shape[1]:
                out[x, d] = min(abs(int(left[y, x]) - int(right[y, xr])), 60)


@pytest.fixture
def added_cost(monkeypatch):
    monkeypatch.setattr(stereokit.COSTS, "_items", dict(stereokit.COSTS._items))
    stereokit.COSTS.register("Difference")(RowCost(absolute_difference, 60, "difference"))


def test_a_row_cost_fills_volumes(random_pair, added_cost):
    left, right = random_pair(5, 12, seed=14)
    volume = cost_volume(left, right, "difference", outside=0.5, **options(-2, 9))
    x_right = np.arange(12)[:, None] - np.arange(9)[None, :] + 2
    inside = (x_right >= 0) & (x_right < 12)
    difference = np.abs(left[:, :, None].astype(int) - right[:, np.clip(x_right, 0, 11)])
    np.testing.assert_array_equal(volume, np.where(inside, np.minimum(difference, 60), 30))


def test_a_row_cost_without_a_cost_for_outside_takes_the_border_pixel(random_pair, added_cost):
    # What `Matcher` and `cost_volume` promise for outside=None, whatever the cost.
    left, right = random_pair(4, 8, seed=15)
    volume = cost_volume(left, right, "difference", outside=None, **options(0, 8))
    nearest = np.clip(np.arange(8)[:, None] - np.arange(8)[None, :], 0, 7)
    difference = np.abs(left[:, :, None].astype(int) - right[:, nearest])
    np.testing.assert_array_equal(volume, np.minimum(difference, 60))


@pytest.mark.parametrize(
    ("method", "options"),
    [("difference+sgm", {"p1": 7, "p2": 190, "paths": 8}), ("difference+dt", {"sigma_s": 9.0})],
)
def test_a_row_cost_runs_in_every_aggregation(method, options, added_cost):
    left = np.random.default_rng(16).integers(0, 256, (12, 40), dtype=np.uint8)
    options = {"max_disparity": 16, "subpixel": False, "smooth": 0, **options}
    disparity = stereokit.match(left, np.roll(left, -5, axis=1), method, **options)
    assert (disparity[:, 10:] == 5).all()


def test_a_row_cost_sees_bad_pixels_as_no_evidence(random_pair, added_cost):
    left, right = (image.astype(np.float64) for image in random_pair(5, 9, seed=17))
    left[1, 6], right[3, 2] = np.nan, np.inf
    volume = cost_volume(left, right, "difference", outside=1.0, **options(0, 4))
    assert (volume[1, 6] == 60).all()
    assert all(volume[3, 2 + d, d] == 60 for d in range(4))


@pytest.fixture(scope="module")
def street():
    """Return a pair as a camera gives it, (H, W) uint8 each, and its disparity: noise, gain, two slanted surfaces."""
    rng = np.random.default_rng(20)
    height, width = 80, 240
    texture = np.kron(rng.normal(size=(height // 4, width // 4)), np.ones((4, 4))) * 40
    texture = cv2.GaussianBlur(texture + rng.normal(size=(height, width)) * 30, (0, 0), 0.8) + 120
    y, x = np.mgrid[:height, :width].astype(np.float32)
    disparity = np.where(y < 40, 6 + x / 60, 10 + y / 12).astype(np.float32)
    left = cv2.remap(texture.astype(np.float32), x - disparity, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    noisy = [image + rng.normal(size=image.shape) * 2 for image in (left, 0.97 * texture + 2)]
    return [np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in noisy], disparity


@numba.njit(nogil=True)
def compiled_difference(left, right, y, min_disparity, out):
    for x in range(out.shape[0]):
        for d in range(out.shape[1]):
            xr = x - d - min_disparity
            if 0 <= xr < right.shape[1]:
                out[x, d] = min(abs(np.int32(left[y, x]) - np.int32(right[y, xr])), 60)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_a_row_cost_works_with_the_defaults_on_what_cameras_give(street, dtype, monkeypatch):
    monkeypatch.setattr(stereokit.COSTS, "_items", dict(stereokit.COSTS._items))
    stereokit.COSTS.register("difference")(RowCost(compiled_difference, 60, "difference"))
    pair, truth = street
    if dtype != np.uint8:
        pair = [image.astype(dtype) * dtype(13) + dtype(0.5 if dtype == np.float32 else 700) for image in pair]
    for scale in (1, 0.5):
        result = stereokit.Matcher("difference+sgm", max_disparity=32, scale=scale)(*pair)
        seen = np.s_[:, 20:]
        error = np.abs(result.disparity - truth)[seen]
        assert np.mean(error > 3) < 0.05
        assert result.density > 0.7


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("smooth", [0, 0.6, 2.0])
def test_a_row_cost_sees_8_bits_whatever_comes_in(random_pair, dtype, smooth):
    seen = []

    def spy(left, right, y, min_disparity, out):
        seen.append((left, right))
        out[:] = 0

    left, right = (np.sort(image, axis=1) for image in random_pair(6, 40, seed=21))
    images = [image.astype(dtype) for image in (left, right)]
    if dtype == np.uint16:
        images = [image * dtype(100) + dtype(5000) for image in images]
    if dtype == np.float32:
        images = [image / dtype(255) for image in images]
    cost_volume(*images, RowCost(spy, 60), smooth=smooth, max_disparity=4)
    low, high = (
        (0, 255) if dtype == np.uint8 else (float(min(left.min(), right.min())), float(max(left.max(), right.max())))
    )
    for image, source in zip(seen[0], (left, right), strict=True):
        assert image.dtype == np.uint8
        expected = (source - low) / (high - low) * 255
        if smooth:
            expected = oracles.gaussian(expected, smooth)
        np.testing.assert_allclose(image, expected, atol=1.2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RowCost(None, 60), "function of a row cost must be callable, got None"),
        (lambda: RowCost(absolute_difference, 0), "cost_max must be from 1 to 254, got 0"),
        (lambda: RowCost(absolute_difference, 255), "cost_max must be from 1 to 254, got 255"),
        (lambda: RowCost(absolute_difference, 1.5), "cost_max must be an integer, got 1.5"),
    ],
)
def test_row_costs_are_checked(make, message):
    with pytest.raises(OptionError, match=message):
        make()
