"""Cost volumes on a queue, against the CPU's cost rows: equal in every cell."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.costs import Census, Zncc, census_cuda, zncc_cuda
from stereokit.costs.rows import CostInput, Levels, produce_volume
from stereokit.costs.rows_cuda import DevicePair
from stereokit.kernels.workspace import Workspace

SIZES: list[tuple[tuple[int, int], Levels, float | None]] = [
    ((1, 1), Levels(0, 1), 0.5),
    ((3, 2), Levels(-70, 40), 1.0),
    ((4, 65), Levels(3, 33), None),
    ((2, 31), Levels(60, 129), 0.0),
]
"""Shapes, levels and costs of matches outside the right image."""


def check_volume(
    queue: Any, cost: Any, shape: tuple[int, int], levels: Levels, outside: float | None = 0.5, masked: bool = False,
    dtype: type = np.uint8, ranges: tuple[tuple[int, int], tuple[int, int]] | None = None, seed: int = 0,
) -> None:  # fmt: skip
    """Compare all cells of a random pair with a flat patch in it, and the levels that pad."""
    rng = np.random.default_rng(seed)
    left, right = rng.integers(0, np.iinfo(dtype).max, (2, *shape), dtype, endpoint=True)
    left[1:5, 2 : shape[1] // 2] = 77
    bad = rng.random((2, *shape)) < 0.1
    masks = tuple(bad) if masked else (None, None)
    rows = cost.prepare(CostInput(left, right, *masks, levels, outside, 1, ranges), Workspace(), 1)
    want = produce_volume(rows, shape, levels, 1)
    images = queue.upload("images", np.stack([left, right]))
    known = queue.upload("bad", bad.view(np.uint8)) if masked else queue.array("bad", 1, np.uint8)
    pair = DevicePair(images, np.dtype(dtype), known, masked, *shape, levels, outside, ranges)
    module = census_cuda if isinstance(cost, Census) else zncc_cuda
    costs = queue.fetch(queue.view(module.volume(queue, cost, pair), np.uint8)).reshape(*shape, pair.padded)
    np.testing.assert_array_equal(costs[:, :, : levels.count], want)
    assert (costs[:, :, levels.count :] == 255).all()


def check_census(queue):
    check_volume(queue, Census("5x5"), (6, 35), Levels(0, 10))


def check_census_of_two_words(queue):
    check_volume(queue, Census("9x7"), (5, 19), Levels(-4, 12), outside=None, masked=True)


def check_zncc(queue):
    check_volume(queue, Zncc(5), (9, 70), Levels(0, 9))


def check_zncc_of_16_bits(queue):
    """Compare where products of pixels need more than 16 bits."""
    check_volume(queue, Zncc(5), (6, 33), Levels(0, 8), dtype=np.uint16)


def check_zncc_rounding(queue):
    """Compare costs of which one changes when its factors are multiplied in another order."""
    check_volume(queue, Zncc(5, 254), (9, 70), Levels(0, 32), seed=4)


def check_zncc_with_masks(queue):
    check_volume(queue, Zncc(3, 200), (5, 23), Levels(-4, 9), outside=None, masked=True)


def check_zncc_within_larger_ranges(queue):
    """Compare a window of a larger image, whose ranges are narrower on one side and wider on the other."""
    check_volume(queue, Zncc(5), (5, 23), Levels(0, 8), ranges=((5, 240), (20, 300)))
