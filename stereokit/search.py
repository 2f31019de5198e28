"""Coarse to fine: a map of half the size tells each pixel where to search (after Rothermel et al. 2012, tSGM).

A pixel searches `LANES` levels, however large the range is. They hold what the half-size map has around the pixel,
and a margin; where it has more than fits, the pixel's own value decides. Ranges of no more levels are searched in full.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import Levels
from stereokit.kernels.jit import kernel
from stereokit.kernels.simd import LANES

__all__ = ["SEARCHED_IN_FULL", "SEARCHES", "halved_levels", "restore_thin", "search_starts"]

SEARCHES = ("auto", "full", "coarse-to-fine")
"""Values of the option `search`."""
SEARCHED_IN_FULL = 128
"""Levels up to which a full search takes less time."""

_RADIUS = 4  # of the neighbourhood, half-size pixels
_MARGIN = 6.0  # above and below what it holds, levels
_CONFIRMING = 3  # neighbours that agree with a thin thing
_STEP = 8  # starts are multiples of this: neighbours then mostly share theirs


def halved_levels(levels: Levels) -> Levels:
    """Return the levels at half size that cover `levels`."""
    low = levels.minimum // 2
    high = max(-(-(levels.minimum + levels.count) // 2), low + 1)
    return Levels(low, high - low)


@kernel
def restore_thin(selected: NDArray[np.float32], cleaned: NDArray[np.float32]) -> None:
    """Put back into a cleaned map, in place, what cleaning took away of things that stand far in front.

    Poles and wires are a few pixels wide in a half-size map, where the filters take them for noise: then nobody would
    look for them at full size. A pixel gets its selected value back if that is larger by more than half a search and
    `_CONFIRMING` of its eight neighbours agree with it.

    Parameters
    ----------
    selected : (H, W) float32, pixels, NaN where there is none
        The map before its post-processing.
    cleaned : (H, W) float32, pixels, no NaN
        The map after it.
    """
    height, width = selected.shape
    for y in range(height):
        for x in range(width):
            value = selected[y, x]
            if not value - cleaned[y, x] > np.float32(LANES // 4):
                continue
            confirming = -1  # the pixel itself agrees
            for y2 in range(max(y - 1, 0), min(y + 2, height)):
                for x2 in range(max(x - 1, 0), min(x + 2, width)):
                    if abs(selected[y2, x2] - value) <= np.float32(1):
                        confirming += 1
            if confirming >= _CONFIRMING:
                cleaned[y, x] = value


def search_starts(coarse: NDArray[np.float32], levels: Levels, out: NDArray[np.int16]) -> None:
    """Write the first level of each pixel's search.

    Parameters
    ----------
    coarse : (ceil(H / 2), ceil(W / 2)) float32, half-size pixels, no NaN
        Filled map of half the size.
    levels : Levels
        Of the full size, more than `LANES`.
    out : (H, W) int16
        Levels above `levels.minimum`, 0 to ``levels.count - LANES``.
    """
    kernel = np.ones((2 * _RADIUS + 1, 2 * _RADIUS + 1), np.uint8)
    low, high = (np.asarray(extreme(coarse, kernel), np.float32) for extreme in (cv2.erode, cv2.dilate))
    _place_searches(coarse, low, high, levels.minimum, levels.count, out)


@kernel
def _place_searches(
    own: NDArray[np.float32], low: NDArray[np.float32], high: NDArray[np.float32], minimum: int, count: int,
    out: NDArray[np.int16],
) -> None:  # fmt: skip
    """Write the starts for the half-size map and its lowest and highest values around each pixel."""
    height, width = out.shape
    searched = np.float32(LANES)
    margin = np.float32(_MARGIN)
    step = np.float32(_STEP)
    last = np.float32(count - LANES)
    for y in range(own.shape[0]):
        for x in range(own.shape[1]):
            first = np.float32(2) * low[y, x] - np.float32(minimum) - margin
            end = np.float32(2) * high[y, x] - np.float32(minimum) + margin + np.float32(2)  # a pixel is two levels
            middle = np.float32(2) * own[y, x] - np.float32(minimum) - searched * np.float32(0.5)
            middle = min(max(middle, first), max(end - searched, first))
            spare = searched - (end - first)
            start = first - spare * np.float32(0.5) if spare >= np.float32(0) else middle
            start = np.floor(start / step + np.float32(0.5)) * step
            value = np.int16(min(max(start, np.float32(0)), last))
            out[2 * y, 2 * x] = value
            out[2 * y, min(2 * x + 1, width - 1)] = value
        if 2 * y + 1 < height:
            for x in range(width):
                out[2 * y + 1, x] = out[2 * y, x]
