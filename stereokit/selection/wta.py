"""Winner takes all with sub-pixel interpolation (StereoVAE paper, equation 6) and a confidence.

The level with the lowest aggregated cost wins, the lowest of equals. A parabola through it and its two neighbours
gives the fraction of a pixel. Confidence is the margin to the best competitor that is not a neighbour,
``(c2 - c1) / c2``: 0 where another disparity is as good, towards 1 where there is none.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError
from stereokit.images.check import MAX_DISPARITY, check_flag, check_integer
from stereokit.images.maps import numbers
from stereokit.kernels import simd
from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.simd import LANES, first_bit, load, lowest, mask_equal, minimum, splat, without_three

__all__ = ["SelectionOutput", "margin_of", "parabola", "select", "select_row", "selection_output"]


class SelectionOutput(NamedTuple):
    """Maps that selection writes, ``(H, W)`` and flat for kernels, and its rules."""

    disparity: NDArray[np.float32]  # pixels
    cost: NDArray[Any]  # aggregated cost of the winner
    confidence: NDArray[np.float32]  # or empty, when nobody asked for it
    candidates: NDArray[np.float32]  # the winners again, then the best that are not next to them; or empty
    starts: NDArray[np.int16]  # first level of each pixel's search; empty where it is 0 everywhere
    levels: int  # that each pixel searches
    minimum: int
    subpixel: bool
    uniqueness: np.float32  # margin to the best rival below which a pixel is invalid, 0 to 1


@inline
def _best_level(keys: NDArray[Any], at: int, blocks: tuple[int, ...]) -> tuple[Any, int]:
    """Return the smallest key of the levels from `at` on, and the first level that has it."""
    smallest = load(keys, at)
    for n in range(1, len(blocks)):
        smallest = minimum(smallest, load(keys, at + n * LANES))
    value = lowest(smallest)
    lowest_key = splat(value)
    level = np.int64(0)
    for back in range(len(blocks)):
        block = (len(blocks) - 1 - back) * LANES
        first = first_bit(mask_equal(load(keys, at + block), lowest_key))
        level = simd.select(first < 64, block + first, level)
    return value, level


@inline
def parabola(before: np.float32, best: np.float32, behind: np.float32) -> np.float32:
    """Return the offset in levels of the lowest point of a parabola through three costs."""
    bend = before + behind - np.float32(2) * best
    offset: np.float32 = (before - behind) / (np.float32(2) * bend) if bend > np.float32(0) else np.float32(0)
    return offset


@inline
def margin_of(best: np.float32, rival: np.float32) -> np.float32:
    """Return the margin between the best cost and its rival's, as a share of the latter."""
    share: np.float32 = (rival - best) / rival if rival > np.float32(0) else np.float32(0)
    return share


@inline
def select_pixel(
    keys: NDArray[Any], values: NDArray[Any], at: int, blocks: tuple[int, ...], to: int, out: SelectionOutput
) -> None:
    """Write the winner among the levels from element `at` on to element `to` of the maps.

    `keys` are integers in the order of `values`: `values` itself, or the bits of non-negative floats.
    """
    _, level = _best_level(keys, at, blocks)
    best = np.float32(values[at + level])
    minimum = out.minimum
    if out.starts.size > 0:
        minimum += np.int64(out.starts[to])
    disparity = np.float32(level + minimum)
    if out.subpixel and level > 0 and level < out.levels - 1:
        before = np.float32(values[at + level - 1])
        behind = np.float32(values[at + level + 1])
        disparity += parabola(before, best, behind)
    out.disparity[to] = disparity
    out.cost[to] = values[at + level]
    if out.confidence.size > 0 or out.uniqueness > np.float32(0):
        other = _rival(keys, at, blocks, level, out.levels)
        margin = margin_of(best, np.float32(values[at + other])) if other != level else np.float32(1)
        if out.confidence.size > 0:
            out.confidence[to] = margin
        if out.candidates.size > 0:
            out.candidates[to] = disparity
            out.candidates[out.candidates.size // 2 + to] = np.float32(other + minimum)
        if margin < out.uniqueness:
            out.disparity[to] = np.nan


@inline
def _rival(keys: NDArray[Any], at: int, blocks: tuple[int, ...], level: int, levels: int) -> Any:
    """Return the level of the lowest cost that is not next to the winner, the lowest of equals; `level` if none is."""
    smallest = without_three(load(keys, at), level - 1)
    for n in range(1, len(blocks)):
        smallest = minimum(smallest, without_three(load(keys, at + n * LANES), level - 1 - n * LANES))
    lowest_key = splat(lowest(smallest))
    other = np.int64(level)
    for back in range(len(blocks)):
        block = (len(blocks) - 1 - back) * LANES
        first = first_bit(mask_equal(without_three(load(keys, at + block), level - 1 - block), lowest_key))
        other = simd.select(first < 64, block + first, other)
    if other >= levels or abs(other - level) < 2:
        return level
    return other


@kernel
def select_row(
    keys: NDArray[Any], values: NDArray[Any], width: int, blocks: tuple[int, ...], to: int, out: SelectionOutput
) -> None:
    """Select all pixels of one row of aggregated costs, ``(W, P)`` flat, into the maps from element `to` on."""
    for x in range(width):
        select_pixel(keys, values, x * LANES * len(blocks), blocks, to + x, out)


def selection_output(
    disparity: NDArray[np.float32], cost: NDArray[Any], confidence: NDArray[np.float32] | None,
    levels: int, minimum_disparity: int, subpixel: bool, uniqueness: float = 0.0,
    candidates: NDArray[np.float32] | None = None, starts: NDArray[np.int16] | None = None,
) -> SelectionOutput:  # fmt: skip
    """Return the flat view of the maps that kernels write; `candidates` come with a `confidence` only."""
    empty = np.empty(0, np.float32)
    return SelectionOutput(
        disparity=disparity.ravel(),
        cost=cost.ravel(),
        confidence=empty if confidence is None else confidence.ravel(),
        candidates=empty if candidates is None else candidates.ravel(),
        starts=np.empty(0, np.int16) if starts is None else starts.ravel(),
        levels=levels,
        minimum=minimum_disparity,
        subpixel=subpixel,
        uniqueness=np.float32(uniqueness / 100),
    )


def select(
    volume: NDArray[Any], *, min_disparity: int = 0, subpixel: bool = True
) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[np.float32]]:
    """Select the disparity of every pixel of a volume of aggregated costs.

    Parameters
    ----------
    volume : (H, W, D) uint16, int16 or float32, not negative
        Aggregated costs, as `stereokit.aggregate` returns them. NaN and infinity say nothing of a level: it does not
        win, and what wins next to it is not interpolated.
    min_disparity : int
        Disparity of level 0, pixels.
    subpixel : bool
        Whether to interpolate between levels.

    Returns
    -------
    disparity : (H, W) float32, pixels
        Within the levels; NaN where all costs are NaN or infinite.
    cost : (H, W), dtype of the volume
        Aggregated cost of the winner; NaN where there is none.
    confidence : (H, W) float32 in [0, 1]

    Raises
    ------
    InputError, OptionError
        If the volume has another shape or type, or an option breaks its rule.
    """
    volume = numbers("volume", volume)
    low = check_integer("min_disparity", min_disparity, -MAX_DISPARITY, MAX_DISPARITY)
    check_flag("subpixel", subpixel)
    if volume.ndim != 3 or volume.dtype not in (np.uint16, np.int16, np.float32) or 0 in volume.shape:
        raise InputError(
            f"volume must be a non-empty (H, W, D) array of uint16, int16 or float32, got {volume.dtype} {volume.shape}"
        )
    height, width, count = volume.shape
    padded = -(-count // LANES) * LANES
    disparity = np.empty((height, width), np.float32)
    cost = np.empty((height, width), volume.dtype)
    confidence = np.empty((height, width), np.float32)
    out = selection_output(disparity, cost, confidence, count, low, subpixel)
    worst = np.iinfo(volume.dtype).max if volume.dtype.kind in "iu" else np.finfo(volume.dtype).max
    blocks = tuple(range(padded // LANES))
    row = np.full((width, padded), worst, volume.dtype)
    for y in range(height):
        finite = np.isfinite(volume[y])
        row[:, :count] = np.where(finite, volume[y], worst) + volume.dtype.type(0)  # no -0, whose bits are the lowest
        if row.min() < 0:
            raise InputError(f"volume must not be negative, got {row.min()}")
        values = row.ravel()
        select_row(keys_of(values), values, width, blocks, y * width, out)
        if not finite.all():
            _amend(finite, row.argmin(axis=1), low, disparity[y], cost[y], confidence[y])
    return disparity, cost, confidence


def _amend(
    finite: NDArray[np.bool_], best: NDArray[np.intp], low: int, disparity: NDArray[np.float32], cost: NDArray[Any],
    confidence: NDArray[np.float32],
) -> None:  # fmt: skip
    """Undo in the pixels of a row the interpolation with levels that have no cost, and the choice among such levels."""
    beside = np.stack([np.clip(best - 1, 0, None), np.clip(best + 1, None, finite.shape[1] - 1)], axis=1)
    alone = ~np.take_along_axis(finite, beside, axis=1).all(axis=1)
    disparity[alone] = best[alone] + low
    empty = ~finite.any(axis=1)
    disparity[empty], cost[empty], confidence[empty] = np.nan, np.nan, 0


def keys_of(values: NDArray[Any]) -> NDArray[Any]:
    """Return integers that sort as non-negative `values` do, sharing their memory."""
    return values.view(np.int32) if values.dtype == np.float32 else values
