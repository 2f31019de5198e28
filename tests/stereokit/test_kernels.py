"""Vector values and helpers below the stages, against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from stereokit.kernels import simd
from stereokit.kernels.jit import kernel
from stereokit.kernels.workspace import Workspace


@kernel
def _pairs(a, b, out):
    simd.store(out, 0, simd.multiply_pairs(simd.load(a, 0), simd.load(b, 0)))


@kernel
def _bytes(values, out):
    simd.store(out, 0, simd.convert(simd.load(values, 0), np.uint8(0)))


@kernel
def _lowest(a, out):
    one, two, three, four = simd.lowest_of_4(simd.load(a, 0), simd.load(a, 64), simd.load(a, 128), simd.load(a, 192))
    simd.store(out, 0, one)
    simd.store(out, 64, two)
    simd.store(out, 128, three)
    simd.store(out, 192, four)


def halves(low, high):
    return ((np.int32(low) & 0xFFFF) | (np.int32(high) << 16)).astype(np.int32)


def test_pairs_of_words_are_multiplied_and_added():
    rng = np.random.default_rng(0)
    words = rng.integers(-(2**15), 2**15, (4, 64)).astype(np.int32)
    words[:, :4] = [[-(2**15)] * 4, [2**15 - 1] * 4, [2**15 - 1, -1, 0, 1], [0, -(2**15), 1, -1]]
    out = np.empty(64, np.int32)
    _pairs(halves(words[0], words[1]), halves(words[2], words[3]), out)
    exact = words[0].astype(np.int64) * words[2] + words[1].astype(np.int64) * words[3]
    np.testing.assert_array_equal(out, exact.astype(np.int32))


def test_words_are_cut_to_their_low_bytes_in_order():
    values = np.random.default_rng(1).integers(-(2**31), 2**31, 64).astype(np.int32)
    out = np.empty(64, np.uint8)
    _bytes(values, out)
    np.testing.assert_array_equal(out, values.astype(np.uint8))


@pytest.mark.parametrize("seed", range(4))
def test_the_smallest_lane_of_each_of_four_vectors(seed):
    values = np.random.default_rng(seed).integers(3, 256, (4, 64)).astype(np.uint8)
    values[np.arange(4), np.random.default_rng(seed).integers(0, 64, 4)] = [2, 0, 3, 1]
    out = np.empty(256, np.uint8)
    _lowest(values.ravel(), out)
    np.testing.assert_array_equal(out.reshape(4, 64), np.repeat([[2], [0], [3], [1]], 64, axis=1))


def test_a_workspace_makes_again_what_was_made_for_another_key():
    workspace, made = Workspace(), []

    def make():
        made.append(len(made))
        return made[-1]

    assert [workspace.cached("a", key, make) for key in (1, 1, 2, 2, 1)] == [0, 0, 1, 1, 2]
