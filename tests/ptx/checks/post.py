"""Parity of post-processing on the GPU: every check runs kernels on a queue and compares with the CPU, exactly."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.kernels.workspace import Workspace
from stereokit.postprocess import fill, median, remove_speckles, single_matching_phase
from stereokit.postprocess.chain import PostProcessing, post_process
from stereokit.postprocess.chain_cuda import hold
from stereokit.postprocess.chain_cuda import post_process as post_process_cuda
from stereokit.postprocess.fill_cuda import fill as fill_cuda
from stereokit.postprocess.median_cuda import median as median_cuda
from stereokit.postprocess.smp_cuda import resolve
from stereokit.postprocess.speckle_cuda import remove

SHAPES = [(9, 33), (3, 70), (1, 65), (40, 1), (1, 1), (6, 32)]


def map_of(shape: tuple[int, int], seed: int, gaps: float, low: int = -3, high: int = 12) -> np.ndarray:
    """Return a map of eighths of pixels with gaps; the last row is empty if some are."""
    rng = np.random.default_rng(seed)
    disparity = (rng.integers(8 * low, 8 * high, shape) / 8).astype(np.float32)
    disparity[rng.random(shape) < gaps] = np.nan
    if gaps:
        disparity[shape[0] // 2 + 1 :] = np.nan
    return disparity


def maps(shape: tuple[int, int]) -> list[np.ndarray]:
    """Return maps that are dense, gappy, sparse, empty and constant."""
    constant = np.full(shape, 3, np.float32)
    return [*(map_of(shape, 3, gaps) for gaps in (0, 0.3, 0.95, 1)), constant]


def check_smp(queue: Any, shapes: Any = SHAPES) -> None:
    """Compare the single matching phase for costs of either type, with many equal costs."""
    for shape in shapes:
        for dtype in (np.uint16, np.float32):
            cost = np.random.default_rng(1).integers(0, 5, shape).astype(dtype)
            for disparity in maps(shape):
                flat = disparity.flatten()
                resolve(queue, flat, cost.reshape(-1), shape)
                np.testing.assert_array_equal(flat.reshape(shape), single_matching_phase(disparity, cost))


def check_smp_rounding(queue: Any) -> None:
    """Compare where disparities lie within a few units in the last place of where a match changes its column."""
    rng = np.random.default_rng(7)
    shape = 4, 90
    column = np.arange(shape[1])
    disparity = (column - rng.integers(0, 40, shape) + rng.choice([-0.5, 0.5], shape)).astype(np.float32)
    for _ in range(2):
        disparity = np.nextafter(disparity, np.float32(rng.choice([-1000, 1000])))
    cost = rng.integers(0, 2, shape).astype(np.uint16)
    flat = disparity.flatten()
    resolve(queue, flat, cost.reshape(-1), shape)
    np.testing.assert_array_equal(flat.reshape(shape), single_matching_phase(disparity, cost))


def check_speckle(queue: Any, shapes: Any = SHAPES) -> None:
    """Compare which regions are erased."""
    for shape in shapes:
        for gaps, size, difference in ((0, 9, 1), (0.3, 2, 1), (0.1, 4, 0.5), (0.1, 0, 0), (0, 1000, 2), (1, 5, 1)):
            disparity = map_of(shape, 10, gaps, 0, 4)
            flat = disparity.flatten()
            remove(queue, flat, size, shape, difference)
            expected = remove_speckles(disparity, size, difference)
            np.testing.assert_array_equal(flat.reshape(shape), expected)


def check_speckle_shapes(queue: Any) -> None:
    """Compare on regions that wind: a comb, a spiral, a checkerboard, and one that two arms close from below."""
    shape = 13, 70
    comb = np.zeros(shape, np.float32)
    comb[1:, ::2] = 9 + np.arange(35, dtype=np.float32) * 9
    comb[-1] = 50
    spiral = np.zeros(shape, np.float32)
    for k in range(0, 6, 2):
        spiral[k, k : 70 - k] = spiral[k : 13 - k, 69 - k] = spiral[12 - k, k : 70 - k] = 5
        spiral[k + 2 : 13 - k, k] = 5
    checks = (np.indices(shape).sum(0) % 2 * 7).astype(np.float32)
    arms = np.zeros(shape, np.float32)
    arms[:, 3] = arms[:, 60] = arms[-1, 3:61] = 4
    for disparity, size in ((comb, 40), (spiral, 300), (checks, 1), (arms, 83), (arms, 82)):
        flat = disparity.flatten()
        remove(queue, flat, size, shape)
        np.testing.assert_array_equal(flat.reshape(shape), remove_speckles(disparity, size))


def check_fill(queue: Any, shapes: Any = SHAPES) -> None:
    """Compare both rules and none, and the map of what was valid."""
    for shape in shapes:
        for disparity in maps(shape):
            for mode in ("background", "nearest", None):
                flat = disparity.flatten()
                valid = queue.fetch(fill_cuda(queue, flat, mode, np.nan, shape))
                expected = disparity if mode is None else fill(disparity, mode)
                np.testing.assert_array_equal(flat.reshape(shape), expected)
                np.testing.assert_array_equal(valid.reshape(shape), ~np.isnan(disparity))


def check_fill_far(queue: Any) -> None:
    """Compare gaps that are longer than a warp, at either end of a row and within."""
    disparity = np.full((4, 200), np.nan, np.float32)
    disparity[0, [100, 199]] = 4, 2
    disparity[1, [0, 31, 32, 130]] = 1, 2, 3, 4
    disparity[3, 64] = 9
    for mode in ("background", "nearest"):
        flat = disparity.flatten()
        fill_cuda(queue, flat, mode, np.nan, disparity.shape)
        np.testing.assert_array_equal(flat.reshape(disparity.shape), fill(disparity, mode))


def check_median(queue: Any, shapes: Any = SHAPES) -> None:
    """Compare both windows."""
    for shape in shapes:
        for disparity in maps(shape):
            for size in (3, 5):
                out = queue.fetch(median_cuda(queue, disparity.reshape(-1), size, shape))
                np.testing.assert_array_equal(out.reshape(shape), median(disparity, size))


def check_chain(queue: Any, shape: tuple[int, int] = (9, 40)) -> None:
    """Compare all steps together with everything, with nothing, and on a map without a valid pixel."""
    cost = np.random.default_rng(2).integers(0, 9, shape).astype(np.uint16)
    bad = np.random.default_rng(3).random(shape) < 0.1
    for disparity in (map_of(shape, 4, 0.2), map_of(shape, 4, 1)):
        for steps in (
            PostProcessing(True, 3, "background", 3, -2.0),
            PostProcessing(True, 3, "nearest", 5, -2.0),
            PostProcessing(False, 0, "background", 0, -2.0),
            PostProcessing(True, 2, None, 3, -2.0),
            PostProcessing(False, 0, None, 0, -2.0),
        ):
            for flags in (None, bad):
                flat = disparity.flatten()
                device_bad = None if flags is None else flags.reshape(-1).view(np.uint8)
                finished, valid = post_process_cuda(queue, flat, cost.reshape(-1), device_bad, steps, shape)
                expected, measured = post_process(disparity.copy(), cost, flags, steps, Workspace(), 1)
                finished = finished if isinstance(finished, np.ndarray) else queue.fetch(finished)
                np.testing.assert_array_equal(finished.reshape(shape), expected)
                np.testing.assert_array_equal(queue.fetch(valid).reshape(shape), measured)


def check_hold(queue: Any) -> None:
    """Compare what lies outside the range; NaN stays."""
    disparity = map_of((5, 61), 4, 0.3, -12, 3)
    for low, high in ((-7.0, 1.0), (-7.0, np.inf)):
        outside = np.count_nonzero(disparity < low), np.count_nonzero(disparity > high)
        assert outside[0] and bool(outside[1]) == np.isfinite(high)
        within = queue.upload("disparity", disparity.reshape(-1))
        queue.launch(hold, 3, within, low, high, disparity.size)
        want = np.clip(disparity, np.float32(low), np.float32(high))
        np.testing.assert_array_equal(queue.fetch(within).reshape(disparity.shape), want)
