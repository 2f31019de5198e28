"""Consistency, filling and median against loops and hand-made rows."""

from __future__ import annotations

import numpy as np
import oracles
import pytest

from stereokit import InputError, OptionError, UnknownNameError
from stereokit.postprocess import fill, median, remove_speckles, single_matching_phase
from stereokit.postprocess.median import _network, median_rows

NAN = np.nan
SHAPES = [(9, 14), (1, 12), (12, 1), (1, 1), (2, 3)]


def map_of(shape, seed=0, gaps=0.4, low=-3, high=12):
    rng = np.random.default_rng(seed)
    disparity = (rng.integers(8 * low, 8 * high, shape) / 8).astype(np.float32)
    disparity[rng.random(shape) < gaps] = NAN
    return disparity


def row(*values):
    return np.array([values], np.float32)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.uint16, np.int16, np.float32])
@pytest.mark.parametrize("seed", range(4))
def test_no_right_pixel_is_matched_twice(shape, dtype, seed):
    disparity = map_of(shape, seed, gaps=0.2)
    cost = np.random.default_rng(seed).integers(0, 5, shape).astype(dtype)
    before = disparity.copy()
    out = single_matching_phase(disparity, cost)
    np.testing.assert_array_equal(out, oracles.single_matching_phase(disparity, cost))
    np.testing.assert_array_equal(disparity, before)
    assert out.dtype == np.float32


def test_the_cheapest_of_rivals_stays_wherever_it_is():
    disparity = row(0, 0, 1, 2, 3)  # pixels 1 to 4 all match right pixel 1
    for best in range(1, 5):
        cost = np.full((1, 5), 9, np.uint16)
        cost[0, best] = 3
        expected = np.full(5, NAN, np.float32)
        expected[[0, best]] = disparity[0, [0, best]]
        np.testing.assert_array_equal(single_matching_phase(disparity, cost)[0], expected)
    equal = single_matching_phase(disparity, np.full((1, 5), 9, np.uint16))
    np.testing.assert_array_equal(equal, row(0, NAN, NAN, NAN, 3))  # of equals the larger disparity


def test_matches_outside_the_right_image_are_invalid():
    cost = np.zeros((1, 4), np.uint16)
    np.testing.assert_array_equal(single_matching_phase(row(1, NAN, 2, -1), cost), row(NAN, NAN, 2, NAN))
    # The match of column 0 at 0.5 rounds to column 0 and that of column 3 at -0.5 to column 4.
    np.testing.assert_array_equal(single_matching_phase(row(0.5, NAN, NAN, -0.5), cost), row(0.5, NAN, NAN, NAN))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("mode", ["background", "nearest"])
@pytest.mark.parametrize("gaps", [0.0, 0.5, 0.9, 1.0])
def test_fill(shape, mode, gaps):
    disparity = map_of(shape, 5, gaps)
    before = disparity.copy()
    out = fill(disparity, mode)
    np.testing.assert_array_equal(out, oracles.fill(disparity, mode))
    np.testing.assert_array_equal(disparity, before)
    assert not np.isnan(out).any() or np.isnan(disparity).all()


def test_fill_by_hand():
    gaps = row(NAN, 5, NAN, NAN, NAN, 2, NAN)
    np.testing.assert_array_equal(fill(gaps, "background"), row(5, 5, 2, 2, 2, 2, 2))
    np.testing.assert_array_equal(fill(gaps, "nearest"), row(5, 5, 5, 2, 2, 2, 2))
    lines = np.array([[NAN, NAN], [1, NAN], [NAN, NAN], [7, 8], [NAN, NAN]], np.float32)
    np.testing.assert_array_equal(fill(lines), [[1, 1], [1, 1], [1, 1], [7, 8], [7, 8]])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [3, 5])
@pytest.mark.parametrize("gaps", [0.0, 0.3, 0.9, 1.0])
def test_median(shape, size, gaps):
    disparity = map_of(shape, 6, gaps)
    before = disparity.copy()
    out = median(disparity, size)
    np.testing.assert_array_equal(out, oracles.median(disparity, size))
    np.testing.assert_array_equal(disparity, before)
    assert out.dtype == np.float32
    assert out.shape == shape


def test_median_leaves_gaps_out():
    disparity = np.array([[1, NAN, 9], [NAN, 5, NAN], [2, NAN, NAN]], np.float32)
    out = median(disparity, 3)
    assert out[1, 1] == 2  # of 1, 2, 5, 9 the lower of the two middle ones
    np.testing.assert_array_equal(np.isnan(out), np.isnan(disparity))


@pytest.mark.parametrize("count", [9, 25])
def test_the_network_of_the_median_sorts(count):
    values = np.random.default_rng(0).integers(0, 2, (count, 20_000))  # what sorts zeros and ones sorts everything
    values[:, : count + 1] = np.tri(count, count + 1, -1)
    expected = np.sort(values, axis=0)
    for a, b in _network(count):
        values[a], values[b] = np.minimum(values[a], values[b]), np.maximum(values[a], values[b])
    np.testing.assert_array_equal(values, expected)


def test_the_median_of_a_map_with_gaps_is_the_same_in_bands():
    disparity = map_of((40, 150), 6, 0.3)
    out = np.empty_like(disparity)
    for y0, y1 in ((0, 1), (1, 17), (17, 40)):
        median_rows(disparity, 5, y0, y1, out)
    np.testing.assert_array_equal(out, median(disparity, 5))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [0, 1, 4, 1000])
@pytest.mark.parametrize("gaps", [0.0, 0.3, 1.0])
def test_speckles(shape, size, gaps):
    disparity = map_of(shape, 10, gaps, low=0, high=4)
    before = disparity.copy()
    out = remove_speckles(disparity, size)
    np.testing.assert_array_equal(out, oracles.remove_speckles(disparity, size))
    np.testing.assert_array_equal(disparity, before)
    assert out.dtype == np.float32


@pytest.mark.parametrize("difference", [0, 0.5, 2])
@pytest.mark.parametrize("offset", [-1990, 1990])
def test_speckles_by_difference_far_from_zero(difference, offset):
    disparity = map_of((12, 20), 11, 0.1, low=0, high=4) + np.float32(offset)
    out = remove_speckles(disparity, 3, difference)
    np.testing.assert_array_equal(out, oracles.remove_speckles(disparity, 3, difference))


def test_a_speckle_is_an_island_of_its_size():
    disparity = np.full((5, 6), 9, np.float32)
    disparity[1:3, 1:3] = 20
    disparity[4, 5] = 9.5
    np.testing.assert_array_equal(remove_speckles(disparity, 3), disparity)
    expected = disparity.copy()
    expected[1:3, 1:3] = NAN
    np.testing.assert_array_equal(remove_speckles(disparity, 4), expected)


@pytest.mark.parametrize("view", [np.s_[::-1], np.s_[:, ::-2], np.s_[1:, 1:]])
def test_strided_maps(view):
    disparity, cost = map_of((9, 14), 7), np.random.default_rng(8).integers(0, 9, (9, 14), dtype=np.uint16)
    for stage in (fill, median, lambda d: remove_speckles(d, 2)):
        np.testing.assert_array_equal(stage(disparity[view]), stage(disparity[view].copy()))
    np.testing.assert_array_equal(
        single_matching_phase(disparity[view], cost[view]),
        single_matching_phase(disparity[view].copy(), cost[view].copy()),
    )


@pytest.mark.parametrize("threads", [2, 3, 30])
def test_maps_do_not_depend_on_threads(threads):
    disparity, cost = map_of((13, 20), 9), np.random.default_rng(9).integers(0, 9, (13, 20), dtype=np.uint16)
    np.testing.assert_array_equal(
        single_matching_phase(disparity, cost), single_matching_phase(disparity, cost, threads=threads)
    )
    np.testing.assert_array_equal(fill(disparity), fill(disparity, threads=threads))


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: fill(row(1), "foreground"), UnknownNameError, ["fill", "foreground", "background"]),
        (lambda: fill(np.zeros(3, np.float32)), InputError, ["disparity", "(3,)"]),
        (lambda: median(row(1), 4), OptionError, ["median", "3 or 5", "4"]),
        (lambda: median(np.zeros(3, np.float32)), InputError, ["disparity", "(3,)"]),
        (lambda: remove_speckles(np.zeros(3, np.float32), 2), InputError, ["disparity", "(3,)"]),
        (lambda: remove_speckles(row(1), -2), OptionError, ["size", "-2"]),
        (lambda: remove_speckles(row(1), 2, -1), OptionError, ["difference", "-1"]),
        (lambda: single_matching_phase(row(1), np.zeros((1, 2), np.uint16)), InputError, ["cost", "(1, 2)"]),
    ],
)
def test_what_cannot_be_used_is_named(call, error, words):
    with pytest.raises(error) as caught:
        call()
    assert all(word in str(caught.value) for word in words)
