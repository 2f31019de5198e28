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
    owners = np.empty((len(parts), out.shape[1]), np.int32)
    run([partial(resolve_rows, out, cost, y0, y1, owners[k]) for k, (y0, y1) in enumerate(parts)], threads)
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
    disparity: NDArray[np.float32], cost: NDArray[Any], y0: int, y1: int, owner: NDArray[np.int32]
) -> None:
    """Invalidate the losers of rows y0..y1, in place; `owner` has a place for each column."""
    width = disparity.shape[1]
    for y in range(y0, y1):
        row = disparity[y]
        owner[:] = -1
        for x in range(width):
            d = row[x]
            xr = right_column(x, d, width)
            if xr < 0:
                row[x] = np.nan
                continue
            rival = owner[xr]
            if rival < 0:
                owner[xr] = np.int32(x)
            elif cost[y, x] < cost[y, rival] or (cost[y, x] == cost[y, rival] and d > row[rival]):
                row[rival] = np.nan
                owner[xr] = np.int32(x)
            else:
                row[x] = np.nan
