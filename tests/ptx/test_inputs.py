"""The images' kernels, executed from their PTX: lockstep and in random orders."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ptx.checks import inputs as checks
from ptx.interpreter.emulated import EmulatedQueue
from stereokit.images.blur import gaussian_weights

SEEDS = [None, 1, 2, 3]
TYPES = [np.uint8, np.uint16]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("check", [checks.check_grey, checks.check_mirrored, checks.check_halved, checks.check_ranges])
def test_integers(check, dtype, seed):
    check(EmulatedQueue(seed), dtype)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("dtype", TYPES)
def test_gaussian(dtype, seed):
    checks.check_blurred(EmulatedQueue(seed), dtype, (0.3, 0.7, 2.0) if seed is None else (0.3, 0.4, 0.5))


@pytest.mark.parametrize("seed", SEEDS)
def test_flip(seed):
    checks.check_flipped(EmulatedQueue(seed))


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.5, 0.6, 0.7, 1.0, 2.5, 10.0])
def test_the_weights_are_those_of_opencv(sigma):
    weights = gaussian_weights(sigma).astype(np.int64)
    assert weights.sum() == 65536
    np.testing.assert_array_equal(weights, weights[::-1])
    half = weights.size // 2
    row = np.random.default_rng(0).integers(0, 65535, (1, 3 * half + 9), np.uint16, endpoint=True)
    sums = np.convolve(np.pad(row[0].astype(np.int64), half, mode="edge"), weights, mode="valid")
    blurred = cv2.GaussianBlur(np.repeat(row, 3, axis=0), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_array_equal(blurred[1], (sums + 2**15) >> 16)
