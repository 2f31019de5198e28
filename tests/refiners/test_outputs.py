"""From heads to maps: the compiled loops against plain ones and against their torch twin."""

from __future__ import annotations

import numpy as np
import oracles
import pytest

from stereokit_refiners.networks.pyramid import OFFSETS
from stereokit_refiners.outputs import Direct, Mixture, Residual

RULES = {"residual": Residual(), "direct": Direct(), "mixture": Mixture(OFFSETS)}
MIXTURE = RULES["mixture"]
SIZES = [(8, 12), (7, 11), (1, 1), (2, 2), (1, 9), (9, 1), (2, 7), (13, 6)]
"""Full sizes; heads and coarse maps have half of each, rounded up."""


def arguments(name, size, seed=0, extra=(0, 0)):
    """Return a head, (h, w, C), a coarse map and candidates, all larger than half of `size` by `extra`."""
    rng = np.random.default_rng(seed)
    shape = tuple(-(-side // 2) + more for side, more in zip(size, extra, strict=True))
    head = rng.normal(0, 1.5, (*shape, RULES[name].channels)).astype(np.float32)
    coarse, *candidates = (rng.random((3, *shape)) * 60 - 5).astype(np.float32)
    return head, coarse, np.stack(candidates)


def by_loops(name, head, coarse, candidates, rows, columns):
    planes = head.transpose(2, 0, 1).astype(np.float64)
    if name == "direct":
        full = 256 * oracles.phases_to_pixels(planes)
    elif name == "mixture":
        logits = planes[5:].reshape(MIXTURE.values, 4, *coarse.shape)
        full = oracles.mixture(coarse + 4 * planes[0], logits, 4 * planes[1:5], OFFSETS, candidates)
    else:
        height, width = coarse.shape
        full = oracles.double(coarse, 2 * height, 2 * width) + 4 * oracles.phases_to_pixels(planes)
    return full[:rows, :columns]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", RULES)
def test_the_map_is_what_loops_compute(name, size):
    head, coarse, two = arguments(name, size)
    original = head.copy(), coarse.copy(), two.copy()
    actual = RULES[name].map(head, coarse, *size, candidates=two)
    assert actual.shape == size
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, by_loops(name, head, coarse, two, *size), rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(head, original[0])
    np.testing.assert_array_equal(coarse, original[1])
    np.testing.assert_array_equal(two, original[2])


@pytest.mark.parametrize("name", RULES)
def test_heads_larger_than_the_map_are_cut(name):
    head, coarse, two = arguments(name, (9, 13), 1, extra=(3, 2))
    whole = RULES[name].map(head, coarse, 2 * coarse.shape[0], 2 * coarse.shape[1], 1, two)
    np.testing.assert_array_equal(RULES[name].map(head, coarse, 9, 13, 1, two), whole[:9, :13])


@pytest.mark.parametrize("size", [(21, 17), (1, 17), (17, 1), (40, 40)])
@pytest.mark.parametrize("name", RULES)
def test_threads_do_not_change_a_bit(name, size):
    head, coarse, two = arguments(name, size, 2)
    one = RULES[name].map(head, coarse, *size, 1, two)
    for threads in (2, 3, 64):
        np.testing.assert_array_equal(RULES[name].map(head, coarse, *size, threads, two), one)


@pytest.mark.parametrize("size", [(8, 12), (2, 2), (2, 14), (14, 2)])
@pytest.mark.parametrize("name", RULES)
def test_the_torch_twin_agrees(name, size):
    torch = pytest.importorskip("torch")
    head, coarse, two = arguments(name, size, 3)
    tensor = torch.from_numpy(head.transpose(2, 0, 1).copy())[None]
    twin = RULES[name].tensor_map(tensor, torch.from_numpy(coarse)[None, None], torch.from_numpy(two)[None])
    assert twin.shape == (1, 1, *size)
    expected = RULES[name].map(head, coarse, *size, candidates=two)
    np.testing.assert_allclose(twin[0, 0].numpy(), expected, rtol=1e-5, atol=1e-4)


def test_a_zero_residual_is_bilinear_upscaling():
    _, coarse, _ = arguments("residual", (10, 14), 4)
    actual = Residual().map(np.zeros((5, 7, 4), np.float32), coarse, 10, 14)
    np.testing.assert_allclose(actual, oracles.double(coarse, 10, 14), rtol=1e-6, atol=1e-5)


def test_a_mixture_of_equal_values_is_that_value():
    head = np.random.default_rng(5).normal(0, 8, (6, 5, MIXTURE.channels)).astype(np.float32)
    head[..., :5] = 0
    level = np.full((3, 6, 5), 37.25, np.float32)
    actual = MIXTURE.map(head, level[0], 12, 10, candidates=level[1:])
    np.testing.assert_allclose(actual, 37.25, rtol=1e-6)


@pytest.mark.parametrize("k", range(MIXTURE.values))
def test_one_large_weight_copies_that_neighbour_or_candidate(k):
    coarse, *two = np.random.default_rng(6).random((3, 7, 8)).astype(np.float32) * 50
    head = np.zeros((7, 8, MIXTURE.channels), np.float32)
    head[..., 5 + 4 * k : 9 + 4 * k] = 35
    head[..., 0] = 0 if k < len(OFFSETS) else 9  # corrects the coarse values, not the candidates
    actual = MIXTURE.map(head, coarse, 14, 16, candidates=np.stack(two))
    for y in range(14):
        for x in range(16):
            if k < len(OFFSETS):
                dy, dx = OFFSETS[k]
                expected = coarse[min(max(y // 2 + dy, 0), 6), min(max(x // 2 + dx, 0), 7)]
            else:
                expected = two[k - len(OFFSETS)][y // 2, x // 2]
            assert actual[y, x] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("offset", [-100.0, 45.0, 100.0])
def test_a_constant_on_all_logits_changes_nothing(offset):
    head, coarse, two = arguments("mixture", (8, 10), 7)
    shifted = head.copy()
    shifted[..., 5:] += np.float32(offset)
    plain, other = (MIXTURE.map(h, coarse, 8, 10, candidates=two) for h in (head, shifted))
    np.testing.assert_allclose(other, plain, rtol=1e-4, atol=1e-3)


def test_logits_far_apart_still_choose_the_larger():
    coarse = np.arange(12, dtype=np.float32).reshape(3, 4) * 10
    head = np.zeros((3, 4, MIXTURE.channels), np.float32)
    head[..., 5 + 4 * 4 : 9 + 4 * 4] = 90  # the pixel itself
    head[..., 5 + 4 * 5 : 9 + 4 * 5] = 60  # the one to its right
    actual = MIXTURE.map(head, coarse, 6, 8, candidates=np.full((2, 3, 4), -50, np.float32))
    np.testing.assert_allclose(actual, np.repeat(np.repeat(coarse, 2, 0), 2, 1), atol=1e-3)


def test_far_values_keep_their_precision():
    head, _, _ = arguments("residual", (6, 6), 8)
    coarse = np.full((3, 3), 2000.0, np.float32)
    actual = Residual().map(head, coarse, 6, 6)
    np.testing.assert_allclose(actual - 2000, 4 * oracles.phases_to_pixels(head.transpose(2, 0, 1)), atol=5e-4)
