"""Path costs with selection, and selection alone, on a queue, against the CPU: equal to the last bit."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from stereokit.aggregation import sgm_cuda
from stereokit.aggregation.sgm import Sgm
from stereokit.costs import Census
from stereokit.costs.rows import Levels, VolumeRows
from stereokit.costs.rows_cuda import pad_levels
from stereokit.kernels.workspace import Workspace
from stereokit.selection import wta_cuda
from stereokit.selection.wta import keys_of, select_row, selection_output

LOWEST = -3


def _maps(queue: Any, pixels: int, floats: bool, count: int, subpixel: bool, uniqueness: float, detail: int) -> Any:
    return wta_cuda.Maps(
        queue.array("disparity", pixels, np.float32),
        queue.array("cost", pixels, np.float32 if floats else np.uint16),
        queue.array("confidence", (0, 1, 3)[detail] * pixels or 1, np.float32),
        count,
        LOWEST,
        int(subpixel),
        np.float32(uniqueness / 100),
        detail,
    )


def _compare(queue: Any, maps: Any, disparity: np.ndarray, cost: np.ndarray, sure: np.ndarray) -> None:
    np.testing.assert_array_equal(queue.fetch(maps.disparity), disparity.ravel())
    np.testing.assert_array_equal(queue.fetch(maps.cost), cost.ravel())
    if maps.detail:
        np.testing.assert_array_equal(queue.fetch(maps.confidence), sure[: (0, 1, 3)[maps.detail]].ravel())


def _winners(
    sure: np.ndarray, disparity: np.ndarray, cost: np.ndarray, count: int, subpixel: bool, least: float
) -> Any:
    """Return the maps for the CPU: `sure` is its confidence and the two candidates."""
    return selection_output(disparity, cost, sure[0], count, LOWEST, subpixel, least, sure[1:])


def check_paths(
    queue: Any, sgm: Sgm, shape: tuple[int, int], count: int, subpixel: bool = True, uniqueness: float = 0.0,
    detail: int = 1, steep: bool = False,
) -> None:  # fmt: skip
    """Compare the maps of random costs with a patch of equal ones, on a guide with edges around the threshold.

    Where `steep`, all levels but one have the largest cost, and path costs grow along the paths to their largest.
    """
    rng = np.random.default_rng(0)
    cost = Census("5x5")
    costs = rng.integers(0, cost.cost_max + 1, (*shape, count)).astype(np.uint8)
    costs[1:4, 2:7] = 4
    if steep:
        costs[:], costs[:, :, 6] = cost.cost_max, 1
    edge = int(sgm.edge)
    guide = np.repeat(rng.choice([0, edge - 1, edge, 3 * edge], shape), 3, axis=1)[:, : shape[1]].astype(np.uint8)
    levels = Levels(0, count)
    disparity, sure = np.empty(shape, np.float32), np.empty((3, *shape), np.float32)
    total = np.empty(shape, np.uint16)
    out = _winners(sure, disparity, total, count, subpixel, uniqueness)
    sgm.sweep([VolumeRows(costs, levels.padded)] * 2, levels, cost, guide, Workspace(), 1, out)
    padded = pad_levels(count)
    volume = np.full((*shape, padded), 255, np.uint8)
    volume[:, :, :count] = costs
    maps = _maps(queue, disparity.size, False, count, subpixel, uniqueness, detail)
    words = queue.upload("costs", volume.view(np.uint32))
    sgm_cuda.aggregate(queue, sgm, cost, words, queue.upload("guide", guide), shape, padded, maps)
    _compare(queue, maps, disparity, total, sure)


def check_four_paths(queue):
    check_paths(queue, Sgm(15, 85, paths=4), (5, 9), 8)


def check_five_paths(queue):
    check_paths(queue, Sgm(15, 85, paths=5), (5, 9), 12)


def check_eight_paths(queue):
    check_paths(queue, Sgm(15, 85, paths=8), (6, 5), 40, uniqueness=4.0, detail=0)


def check_full_groups(queue):
    """Compare where no level pads, so that the last level of one line and the first of the next are neighbors."""
    check_paths(queue, Sgm(15, 85, paths=8), (3, 5), 64)


def check_edges(queue, factor=0.5):
    """Compare with penalties so small that both are paid."""
    check_paths(queue, Sgm(4, 14, edge=5, edge_factor=factor), (4, 12), 12, subpixel=False)


def check_largest_path_costs(queue):
    """Compare where path costs reach 255 and their total, in the middle, 8 times as much."""
    check_paths(queue, Sgm(231, 231, paths=8, edge_factor=1), (23, 23), 20, steep=True)


def check_selection(
    queue: Any, floats: bool = False, shape: tuple[int, int] = (3, 7), count: int = 10, subpixel: bool = True,
    uniqueness: float = 3.0, detail: int = 2, bands: tuple[int, ...] = (0, 4, 7),
) -> None:  # fmt: skip
    """Compare selection from a random volume, in bands of columns, with ties and a pixel of zeros."""
    rng = np.random.default_rng(0)
    dtype = np.float32 if floats else np.uint16
    height, width = shape
    padded = pad_levels(count)
    volume = np.full((height, width, padded), 60000, dtype)
    volume[:, :, :count] = rng.integers(0, 50, (height, width, count)) * (0.37 if floats else 1)
    volume[0, 0, :count] = 0
    whole = -(-padded // 64) * 64
    values = np.full((height, width, whole), 60000, dtype)
    values[:, :, :padded] = volume
    disparity, sure = np.empty(shape, np.float32), np.empty((3, *shape), np.float32)
    cost = np.empty(shape, dtype)
    out = _winners(sure, disparity, cost, count, subpixel, uniqueness)
    for y in range(height):
        row = values[y].ravel()
        select_row(keys_of(row), row, width, tuple(range(whole // 64)), y * width, out)
    maps = _maps(queue, cost.size, floats, count, subpixel, uniqueness, detail)
    for first, end in itertools.pairwise(bands):
        part = queue.upload("totals", np.ascontiguousarray(volume[:, first:end]))
        wta_cuda.select(queue, part, floats, first, end - first, shape, padded, maps)
    _compare(queue, maps, disparity, cost, sure)


def check_selection_of_many_levels(queue):
    check_selection(queue, shape=(3, 5), count=250, bands=(0, 5))


def check_selection_of_floats(queue):
    check_selection(queue, floats=True)


def check_zeroed_confidence(queue):
    confidence = np.linspace(0, 1, 200, dtype=np.float32)
    valid = (np.arange(200) % 3 != 0).astype(np.uint8)
    on_device = queue.upload("confidence", confidence)
    queue.launch(wta_cuda.zero_invalid_confidence, 2, on_device, queue.upload("valid", valid), confidence.size)
    np.testing.assert_array_equal(queue.fetch(on_device), confidence * valid)
