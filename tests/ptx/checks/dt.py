"""Parity of the domain transform on the GPU: every check filters and selects on a queue and compares with the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit import RowCost, aggregate, select
from stereokit.aggregation import _lines_cuda
from stereokit.aggregation.dt import Dt
from stereokit.aggregation.dt_cuda import aggregate as aggregate_cuda
from stereokit.selection.wta_cuda import Maps

LOWEST = -3
SHAPES = [(9, 33, 8), (1, 20, 3), (17, 1, 1), (1, 1, 1), (8, 16, 33), (5, 9, 65)]
"""Height, width and levels; lines of whole segments and of a pixel more or less, levels of one and of many words."""


def _compare(queue: Any, shape: tuple[int, int, int], largest: int, **options: Any) -> None:
    height, width, levels = shape
    rng = np.random.default_rng(height * width + levels)
    guide = rng.integers(0, 256, (height, width), dtype=np.uint8)
    guide[: height // 2 + 1, : width // 2 + 1] //= 64  # nearly flat: weights of every size occur
    volume = rng.integers(0, largest + 1, shape, dtype=np.uint8)
    cost = RowCost(lambda *_: None, largest)
    dt = Dt(**options)
    want = select(aggregate(volume, guide, "dt", cost=cost, **options), min_disparity=LOWEST)

    padded = 32 if levels <= 32 else 64 if levels <= 64 else -(-levels // 128) * 128
    padded_costs = np.full((height, width, padded), 255, np.uint8)
    padded_costs[:, :, :levels] = volume
    kind = np.uint16 if dt.mode == "rf" else np.float32
    arrays = [queue.array(f"test.{n}", height * width, dtype) for n, dtype in enumerate((np.float32, kind, np.float32))]
    maps = Maps(*arrays, levels, LOWEST, 1, np.float32(0), 1)
    costs, image = (
        queue.upload("test.costs", padded_costs.reshape(-1).view(np.uint32)),
        queue.upload("test.guide", guide),
    )
    aggregate_cuda(queue, dt, cost, costs, image, (height, width), padded, maps)
    for out, expected in zip(arrays, want, strict=True):
        np.testing.assert_array_equal(queue.fetch(out).reshape(height, width), expected)


def check_rf(queue: Any, shapes: Any = SHAPES) -> None:
    """Compare the fixed point, one pass and several, for costs that fill their byte and costs that do not."""
    for shape in shapes:
        _compare(queue, shape, 62, passes=1)
        _compare(queue, shape, 254, passes=2, sigma_v=None)


def check_sum(queue: Any, shapes: Any = SHAPES) -> None:
    """Compare the unbounded sums, whose every rounding must be the CPU's."""
    for shape in shapes:
        _compare(queue, shape, 62, mode="sum")


def check_rf_of_many_levels(queue: Any, shapes: Any = ((3, 27, 130), (9, 5, 257))) -> None:
    """Compare more levels than a warp selects from as it walks: totals of 16 bits, whole and in bands."""
    for shape in shapes:
        for bytes_ in (_lines_cuda.BAND_BYTES, 1):
            _in_bands(bytes_, queue, shape, 62, passes=1)


def check_sum_in_bands(queue: Any, shapes: Any = ((3, 27, 40), (2, 16, 130))) -> None:
    """Compare bands of a segment each: what one band hands to the next on its left."""
    for shape in shapes:
        _in_bands(1, queue, shape, 62, mode="sum")


def _in_bands(bytes_: int, *arguments: Any, **options: Any) -> None:
    whole = _lines_cuda.BAND_BYTES
    _lines_cuda.BAND_BYTES = bytes_
    try:
        _compare(*arguments, **options)
    finally:
        _lines_cuda.BAND_BYTES = whole
