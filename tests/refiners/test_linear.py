"""Linear upscaling against loops, and inside a half-size match."""

from __future__ import annotations

import itertools

import numpy as np
import oracles
import pytest

import stereokit
from stereokit import Disparity
from stereokit_refiners import Linear

NAN = np.nan
SIZES = [(8, 12), (7, 11), (1, 1), (1, 9), (9, 1), (2, 3)]
"""Full sizes; the half-size map has half of each, rounded up."""


def coarse_of(size, seed=0, gaps=0.0):
    rng = np.random.default_rng(seed)
    shape = tuple(-(-side // 2) for side in size)
    disparity = (rng.random(shape) * 40).astype(np.float32)
    disparity[rng.random(shape) < gaps] = NAN
    valid = ~np.isnan(disparity) & (rng.random(shape) < 0.8)
    confidence = np.where(valid, rng.random(shape), 0).astype(np.float32)
    return Disparity(disparity, valid, confidence)


@pytest.mark.parametrize("size", SIZES)
def test_the_map_doubles_in_size_and_in_value(size):
    coarse = coarse_of(size)
    original = coarse.disparity.copy()
    fine = Linear()(coarse, np.zeros(size, np.uint8))
    np.testing.assert_allclose(fine.disparity, 2 * oracles.double(coarse.disparity, *size), rtol=1e-5)
    np.testing.assert_array_equal(coarse.disparity, original)
    assert fine.disparity.dtype == np.float32
    assert fine.disparity.shape == fine.valid.shape == fine.confidence.shape == size


@pytest.mark.parametrize("size", SIZES)
def test_a_pixel_is_valid_where_its_half_size_pixel_is(size):
    coarse = coarse_of(size, 1)
    fine = Linear()(coarse, np.zeros(size, np.uint8))
    y, x = np.indices(size)
    np.testing.assert_array_equal(fine.valid, coarse.valid[y // 2, x // 2])
    assert fine.confidence.min() >= 0
    assert fine.confidence.max() <= 1
    assert (fine.confidence[~fine.valid] == 0).all()
    expected = oracles.double(coarse.confidence, *size)[fine.valid]
    np.testing.assert_allclose(fine.confidence[fine.valid], expected, rtol=1e-5)


def upscaled_by_loops(image, height, width):
    """Return twice the bilinear upscaling in float32: down the columns first, three quarters plus a quarter."""
    near, far = np.float32(0.75), np.float32(0.25)
    rows, columns = image.shape
    out = np.empty((height, width), np.float32)
    for y in range(height):
        other = min(max(y // 2 + (1 if y % 2 else -1), 0), rows - 1)
        line = [np.float32(2) * (near * image[y // 2, x] + far * image[other, x]) for x in range(columns)]
        for x in range(width):
            beside = min(max(x // 2 + (1 if x % 2 else -1), 0), columns - 1)
            out[y, x] = near * line[x // 2] + far * line[beside]
    return out


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("size", [*SIZES, (23, 150)])
def test_bits_are_those_of_loops_whatever_the_threads(size, threads):
    coarse = coarse_of(size, 4, gaps=0.05)
    fine = Linear()(coarse, np.zeros(size, np.uint8), threads=threads)
    expected = upscaled_by_loops(coarse.disparity, *size)
    np.testing.assert_array_equal(fine.disparity, expected)


@pytest.mark.parametrize("size", [*SIZES, (23, 150)])
def test_bits_at_a_quarter_of_the_size_are_those_of_loops(size):
    """Down the columns first; each sum of two products is rounded as single precision rounds it."""
    height, width = size
    shape = -(-height // 4), -(-width // 4)
    image = (np.random.default_rng(6).random(shape) * 40).astype(np.float32)
    image[np.random.default_rng(7).random(shape) < 0.05] = NAN
    fine = Linear()(Disparity(image, ~np.isnan(image)), np.zeros(size, np.uint8), scale=0.25)

    def mixed(line, x):
        share = np.float32((7 if x % 4 in (1, 2) else 5) / 8)
        beside = min(max(x // 4 + (1 if x % 4 > 1 else -1), 0), len(line) - 1)
        return line[x // 4] * share + line[beside] * (np.float32(1) - share)

    for y, x in itertools.islice(np.ndindex(size), 0, None, 1 if height * width < 200 else 7):
        column = [mixed(np.float32(4) * image[:, k], y) for k in range(shape[1])]
        np.testing.assert_array_equal(fine.disparity[y, x], mixed(column, x))


@pytest.mark.parametrize("size", [*SIZES, (23, 150)])
def test_tensors_are_upscaled_to_the_same_bits(size):
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes.tensors import upscaled

    image = coarse_of(size, 5, gaps=0.05).disparity
    actual = upscaled(torch.from_numpy(image), 2, *size).numpy()
    np.testing.assert_array_equal(actual, upscaled_by_loops(image, *size))


def test_gaps_stay_gaps_and_reach_no_further_than_their_neighbours():
    coarse = coarse_of((20, 24), 2, gaps=0.1)
    fine = Linear()(coarse, np.zeros((20, 24), np.uint8))
    y, x = np.indices((20, 24))
    own = np.isnan(coarse.disparity)[y // 2, x // 2]
    assert np.isnan(fine.disparity[own]).all()
    expected = 2 * oracles.double(coarse.disparity, 20, 24)
    np.testing.assert_allclose(fine.disparity, expected, rtol=1e-5)
    assert not fine.valid[np.isnan(fine.disparity)].any()


def test_a_ramp_stays_a_ramp():
    ramp = np.tile(np.arange(6, dtype=np.float32), (4, 1))
    fine = Linear()(Disparity(ramp, np.ones((4, 6), bool)), np.zeros((8, 12), np.uint8))
    np.testing.assert_allclose(fine.disparity[:, 1:-1], np.tile(np.arange(10) + 0.5, (8, 1)))
    assert fine.confidence is None


@pytest.mark.parametrize("size", [(22, 40), (21, 39)])
def test_half_size_matching_is_matching_halved_images_and_upscaling(size):
    rng = np.random.default_rng(3)
    # Multiples of four: the mean of four pixels is whole, whichever way halves are rounded.
    left, right = (rng.integers(0, 64, size).astype(np.uint8) * 4 for _ in range(2))
    options = {"confidence": True, "smp": True, "median": 3, "smooth": 0.5}
    result = stereokit.Matcher("census+sgm", max_disparity=31, min_disparity=-3, scale=0.5, **options)(left, right)
    halves = (oracles.halve(image).astype(np.uint8) for image in (left, right))
    coarse = stereokit.Matcher("census+sgm", max_disparity=16, min_disparity=-2, **options)(*halves)
    fine = Linear()(coarse, left)
    np.testing.assert_array_equal(result.disparity, fine.disparity)
    np.testing.assert_array_equal(result.valid, fine.valid)
    np.testing.assert_array_equal(result.confidence, fine.confidence)


def test_linear_is_the_default_refiner_of_half_size():
    matcher = stereokit.Matcher("census+sgm", max_disparity=16, scale=0.5)
    assert matcher.refiner == "linear"
    assert stereokit.REFINERS.get("Linear") is Linear
