"""Filling of invalid pixels along rows.

``"background"`` is the rule of the KITTI development kit: a gap takes the smaller of its two valid ends, because
what is hidden lies behind what hides it; ends of rows extend outward. ``"nearest"`` is the StereoVAE paper's: the
closest valid value on the row, the smaller one where both are equally close. Rows without any valid pixel take the
nearest row that has some (the upper of equals).
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import UnknownNameError, did_you_mean
from stereokit.images.maps import check_threads, checked_map
from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.threads import run, spans

__all__ = ["FILLS", "fill", "fill_empty_rows", "fill_rows", "gap_value"]

FILLS = ("background", "nearest")


def fill(disparity: NDArray[np.float32], mode: str = "background", *, threads: int = 1) -> NDArray[np.float32]:
    """Return a copy of the map without gaps.

    Parameters
    ----------
    disparity : (H, W) float32, pixels, NaN where invalid
    mode : {"background", "nearest"}
        Rule of filling.
    threads : int
        Threads to use; the result does not depend on it.

    Returns
    -------
    (H, W) float32, pixels
        Dense; all NaN if nothing was valid.

    Raises
    ------
    UnknownNameError
        If there is no such mode.
    InputError, OptionError
        If the map is not (H, W) numbers, or `threads` is none.
    """
    if not isinstance(mode, str) or mode not in FILLS:
        raise UnknownNameError(did_you_mean("fill", mode, FILLS))
    threads = check_threads(threads)
    out = checked_map(disparity)
    nearest = mode == "nearest"
    parts = spans(out.shape[0], threads)
    run([partial(fill_rows, out, y0, y1, nearest) for y0, y1 in parts], threads)
    fill_empty_rows(out)
    return out


@inline
def gap_value(left: np.float32, right: np.float32, to_left: int, to_right: int, nearest: bool) -> np.float32:
    """Return the value of a gap's pixel from its valid ends and the distances to them, pixels."""
    if nearest and to_left != to_right:
        return left if to_left < to_right else right
    return min(left, right)


@kernel
def fill_rows(disparity: NDArray[np.float32], y0: int, y1: int, nearest: bool) -> int:
    """Fill the gaps of rows y0..y1 that have a valid pixel, in place; return how many rows have none."""
    width = disparity.shape[1]
    empty = 0
    for y in range(y0, y1):
        row = disparity[y]
        last = -1  # the last valid column
        for x in range(width):
            if np.isnan(row[x]):
                continue
            if last < 0:
                row[:x] = row[x]
            elif x - last > 1:
                left, right = row[last], row[x]
                for gap in range(last + 1, x):
                    row[gap] = gap_value(left, right, gap - last, x - gap, nearest)
            last = x
        if last >= 0:
            row[last + 1 :] = row[last]
        else:
            empty += 1
    return empty


def fill_empty_rows(disparity: NDArray[np.float32]) -> bool:
    """Fill rows without any valid pixel from the nearest, in place; return False if all are such rows."""
    empty = np.isnan(disparity[:, 0])
    if not empty.any():
        return True
    if empty.all():
        return False
    full = np.flatnonzero(~empty)
    for y in np.flatnonzero(empty):
        disparity[y] = disparity[full[np.argmin(np.abs(full - y))]]
    return True
