"""Single matching phase (Di Stefano, Marchionni, Mattoccia 2004; StereoVAE paper, section III).

No right pixel may be matched by two left pixels. The condition as the paper prints it ("<= 1") is inverted: it
would hold only where pixels collide. Of all left pixels whose match rounds to the same right pixel, the one with
the lowest aggregated cost stays, of equals the one with the larger disparity; the others become invalid, and so do
pixels whose match lies outside the right image.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError
from stereokit.images.maps import check_threads, checked_map, numbers
from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.threads import run, spans

__all__ = ["resolve_rows", "right_column", "single_matching_phase"]


_COSTS = (np.uint16, np.int16, np.float32)


def single_matching_phase(
    disparity: NDArray[np.float32], cost: NDArray[Any], *, threads: int = 1
) -> NDArray[np.float32]:
    """Return a copy of the left view's map in which no two pixels match the same right pixel.

    Parameters
    ----------
    disparity : (H, W) float32, pixels, NaN where invalid
    cost : (H, W) uint16, int16 or float32
        Aggregated cost of each pixel's match.
    threads : int
        Threads to use; the result does not depend on it.

    Returns
    -------
    (H, W) float32, pixels, NaN where invalid

    Raises
    ------
    InputError, OptionError
        If the two are not numbers of one shape, or `threads` is none.
    """
    threads = check_threads(threads)
    out = checked_map(disparity)
    cost = numbers("cost", cost)
    if out.shape != cost.shape:
        raise InputError(f"cost must have the shape of disparity {out.shape}, got {cost.shape}")
    cost = np.ascontiguousarray(cost, None if cost.dtype in _COSTS else np.float64)
    parts = spans(out.shape[0], threads)
    scratch = np.empty((len(parts), 2 * out.shape[1] + 2), np.int32)
    lowest = np.zeros((len(parts), out.shape[1] + 1), cost.dtype)
    is_loser = np.empty((len(parts), out.shape[1] + 1), np.uint8)
    buffers = zip(scratch, lowest, is_loser, strict=True)
    run([partial(resolve_rows, out, cost, *part, *own) for part, own in zip(parts, buffers, strict=True)], threads)
    return out


@inline
def right_column(x: int, d: np.float32, width: int) -> int:
    """Return the right column that left column `x` matches, or -1 if none: outside the image, or `d` is NaN."""
    at = np.float32(x) - d + np.float32(0.5)
    column: int = np.int64(-1)
    if at >= np.float32(0) and at < np.float32(width):  # NaN is neither
        column = np.int64(np.int32(at))
    return column


@kernel
def resolve_rows(
    disparity: NDArray[np.float32], cost: NDArray[Any], y0: int, y1: int, scratch: NDArray[np.int32],
    lowest: NDArray[Any], is_loser: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Invalidate the losers of rows y0..y1, in place.

    Buffers have a place for each column and one more, `scratch` twice as many; `lowest` is of the type of `cost`. No
    branch depends on the image: whoever loses a right column is marked, where nobody does the place behind the row.
    Of equal costs the later pixel wins: as both match one column, its disparity is the larger one.
    """
    width = disparity.shape[1]
    owner = scratch[: width + 1]
    columns = scratch[width + 1 :]
    for y in range(y0, y1):
        row = disparity[y]
        costs = cost[y]
        owner[:] = width
        is_loser[:] = 0
        for x in range(width):
            column = right_column(x, row[x], width)
            columns[x] = column if column >= 0 else width  # matches outside meet in a place of their own
        for x in range(width):
            to = np.int64(columns[x])
            before = np.int64(owner[to])
            wins = before == width or costs[x] <= lowest[to]
            is_loser[before if wins else x] = 1
            owner[to] = np.int32(x) if wins else np.int32(before)
            lowest[to] = costs[x] if wins else lowest[to]
        for x in range(width):
            row[x] = np.float32(np.nan) if is_loser[x] != 0 or columns[x] == width else row[x]
