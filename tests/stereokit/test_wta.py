"""Selection against loops: the winner, its fraction, its cost and its confidence."""

from __future__ import annotations

import numpy as np
import oracles
import pytest

from stereokit import InputError, select
from stereokit.selection.wta import keys_of, select_row, selection_output

TYPES = [np.uint16, np.int16, np.float32]


def volume_of(shape, count, dtype, high=2000, seed=0):
    values = np.random.default_rng(seed).integers(0, high, (*shape, count))
    return (values / 8 if dtype == np.float32 else values).astype(dtype)


def assert_selected(volume, minimum=0, subpixel=True):
    disparity, cost, confidence = select(volume, min_disparity=minimum, subpixel=subpixel)
    expected = oracles.select(volume, minimum, subpixel)
    assert disparity.dtype == np.float32
    assert cost.dtype == volume.dtype
    assert confidence.dtype == np.float32
    np.testing.assert_allclose(disparity, expected[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(cost, expected[1])
    np.testing.assert_allclose(confidence, expected[2], rtol=1e-6, atol=1e-7)
    assert confidence.min() >= 0
    assert confidence.max() <= 1


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("count", [1, 2, 3, 4, 63, 64, 65, 130])
def test_every_number_of_levels(dtype, count):
    assert_selected(volume_of((4, 5), count, dtype), -7)


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("high", [1, 2, 4])
def test_of_equal_costs_the_lowest_level_wins(dtype, high):
    assert_selected(volume_of((6, 7), 70, dtype, high))


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("level", [0, 1, 5, 8, 9])
def test_the_parabola_needs_a_neighbour_on_either_side(dtype, level):
    costs = np.full((1, 1, 10), 40, dtype)
    costs[0, 0, level] = 10
    if level > 0:
        costs[0, 0, level - 1] = 20
    # c(-1) = 20, c(0) = 10, c(1) = 40: vertex at (20 - 40) / (2 * (20 + 40 - 20)) = -0.25
    expected = level - 0.25 if 0 < level < 9 else level
    assert select(costs)[0][0, 0] == expected
    assert select(costs, min_disparity=-3)[0][0, 0] == expected - 3
    assert select(costs, subpixel=False)[0][0, 0] == level


def test_confidence_is_the_margin_to_a_level_that_is_no_neighbour():
    costs = np.array([[[50, 12, 10, 11, 40, 60]]], np.uint16)
    assert select(costs)[2][0, 0] == np.float32(0.75)  # (40 - 10) / 40: levels 1 and 3 are no rivals
    assert select(costs[:, :, 1:4])[2][0, 0] == 1  # no rival at all
    assert select(np.zeros((1, 1, 9), np.uint16))[2][0, 0] == 0


@pytest.mark.parametrize("dtype", TYPES)
def test_confidence_over_the_whole_range_of_the_type(dtype):
    high = 65536 if dtype == np.uint16 else 32768
    assert_selected(volume_of((5, 6), 9, dtype, high))
    assert_selected(volume_of((5, 6), 64, dtype, high))
    costs = np.full((1, 1, 6), high - 1, dtype)
    costs[0, 0, 2] = high // 4
    assert_selected(costs)


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize(("count", "high"), [(1, 9), (3, 9), (4, 3), (63, 50), (64, 2), (130, 2000)])
@pytest.mark.parametrize("uniqueness", [0, 40])
def test_candidates_are_the_winner_and_its_best_rival(dtype, count, high, uniqueness):
    volume = volume_of((4, 5), count, dtype, high)
    padded = -(-count // 64) * 64
    values = np.full((4, 5, padded), 30000, dtype)
    values[:, :, :count] = volume
    disparity, confidence = np.empty((2, 4, 5), np.float32)
    cost, candidates = np.empty((4, 5), dtype), np.full((2, 4, 5), -99, np.float32)
    out = selection_output(disparity, cost, confidence, count, -7, True, uniqueness, candidates)
    for y in range(4):
        row = values[y].ravel()
        select_row(keys_of(row), row, 5, tuple(range(padded // 64)), 5 * y, out)
    expected = oracles.select(volume, -7)
    np.testing.assert_allclose(candidates[0], expected[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(candidates[1], oracles.rivals(volume, -7))
    sure = expected[2] >= uniqueness / 100
    np.testing.assert_array_equal(disparity[sure], candidates[0][sure])
    assert np.isnan(disparity[~sure]).all()


def test_without_subpixel_disparities_are_whole():
    assert_selected(volume_of((5, 6), 20, np.uint16), 3, subpixel=False)


@pytest.mark.parametrize("view", [np.s_[::-1], np.s_[:, ::2], np.s_[:, :, ::-1]])
def test_strided_volumes(view):
    volume = volume_of((5, 6), 20, np.uint16)
    for a, b in zip(select(volume[view]), select(volume[view].copy()), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    "volume",
    [
        np.zeros((2, 3), np.uint16),
        np.zeros((2, 3, 0), np.uint16),
        np.zeros((2, 3, 4), np.uint8),
        np.zeros((2, 3, 4)),
    ],
)
def test_volumes_that_cannot_be_used(volume):
    with pytest.raises(InputError, match="volume must be"):
        select(volume)
