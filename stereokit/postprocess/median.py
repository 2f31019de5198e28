"""Median filter of a disparity map, border replicated, NaN left out.

Dense maps go to OpenCV; where pixels are invalid, the median is over the valid ones of the window (the lower of
the two middle ones if they are even in number) and an invalid pixel stays invalid. There the windows of 64 neighbours
are sorted side by side by Batcher's network (Knuth, The Art of Computer Programming 3, 5.2.2, algorithm M), invalid
values last, which needs no branch; the number of valid ones tells where the median then is.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError, shown
from stereokit.images.check import check_integer
from stereokit.images.maps import checked_map
from stereokit.kernels.jit import kernel
from stereokit.kernels.simd import LANES, load, maximum, minimum, store
from stereokit.kernels.workspace import Workspace

__all__ = ["median", "median_rows"]


def median(disparity: NDArray[np.float32], size: int = 3) -> NDArray[np.float32]:
    """Return the median-filtered map.

    Parameters
    ----------
    disparity : (H, W) float32, pixels, NaN where invalid
    size : {3, 5}
        Side of the window in pixels.

    Returns
    -------
    (H, W) float32, pixels, NaN where invalid

    Raises
    ------
    OptionError
        If the size is another.
    InputError
        If the map is not (H, W) numbers.
    """
    if check_integer("size of the median", size) not in (3, 5):
        raise OptionError(f"size of the median must be 3 or 5, got {shown(size)}")
    source = checked_map(disparity)
    out = np.empty_like(source)
    median_rows(source, size, 0, source.shape[0], out)
    return out


def median_rows(
    source: NDArray[np.float32], size: int, y0: int, y1: int, out: NDArray[np.float32],
    workspace: Workspace | None = None, dense: bool = False, band: int = 0,
) -> None:  # fmt: skip
    """Write rows y0..y1 of the filtered map to `out`; the same values however the rows are cut into ranges.

    `dense` promises that no pixel is NaN; `band` is another number for each range that is filtered at the same time.
    """
    half = size // 2
    top, bottom = max(y0 - half, 0), min(y1 + half, source.shape[0])
    part = source[top:bottom]
    if not dense and (gaps := np.isnan(part)).any():
        window, border = (size, size), cv2.BORDER_REPLICATE
        valid_count = np.asarray(
            cv2.boxFilter((~gaps).view(np.uint8), -1, window, normalize=False, borderType=border), np.uint8
        )
        wide = np.asarray(cv2.copyMakeBorder(part, half, half, half, half + LANES, border), np.float32)
        wide[np.isnan(wide)] = np.inf
        windows = np.empty(size * size * LANES, np.float32)
        network = _network(size * size)
        _median_of_valid(
            wide.ravel(), size, part.shape[1], y0 - top, valid_count[y0 - top :], network, windows, out[y0:y1]
        )
        out[y0:y1][gaps[y0 - top : y1 - top]] = np.nan
    elif top == y0 and bottom == y1:
        cv2.medianBlur(part, size, dst=out[y0:y1])
    else:
        wide = np.empty_like(part) if workspace is None else workspace.array(f"median.{band}", part.shape, np.float32)
        cv2.medianBlur(part, size, dst=wide)
        out[y0:y1] = wide[y0 - top : y1 - top]


@lru_cache(maxsize=2)
def _network(count: int) -> NDArray[np.int64]:
    """Return the comparisons that sort `count` values, (N, 2): each puts the smaller one first."""
    pairs = []
    top = 1 << ((count - 1).bit_length() - 1)
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while d > 0:
            pairs += [(i, i + d) for i in range(count - d) if i & p == r]
            d, q, r = q - p, q >> 1, p
        p >>= 1
    return np.array(pairs, np.int64)


@kernel
def _median_of_valid(
    wide: NDArray[np.float32], size: int, width: int, y0: int, valid_count: NDArray[np.uint8], pairs: NDArray[np.int64],
    windows: NDArray[np.float32], out: NDArray[np.float32],
) -> None:  # fmt: skip
    stride = width + size - 1 + LANES
    for y in range(out.shape[0]):
        for x0 in range(0, width, LANES):
            for k in range(size * size):
                store(windows, k * LANES, load(wide, (y0 + y + k // size) * stride + x0 + k % size))
            for n in range(len(pairs)):
                first, second = pairs[n, 0] * LANES, pairs[n, 1] * LANES
                a, b = load(windows, first), load(windows, second)
                store(windows, first, minimum(a, b))
                store(windows, second, maximum(a, b))
            for x in range(x0, min(x0 + LANES, width)):
                middle = (np.int64(valid_count[y, x]) - 1) // 2
                out[y, x] = windows[max(middle, 0) * LANES + x - x0]
