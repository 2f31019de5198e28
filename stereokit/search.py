"""Coarse to fine: a map of half the size tells each pixel where to search (after Rothermel et al. 2012, tSGM).

A pixel searches `LANES` levels, however large the range is. They hold what the half-size map has around the pixel,
and a margin; where it has more than fits, the pixel's own value decides.

Where the half-size map was measured and has no jump, it is an opinion: levels that differ from it cost `UNEXPECTED`
more. That is next to nothing where the images tell levels apart, and decides where they do not: a half-size census
sees twice as far, so that it is right on weak texture where the full-size one follows the noise.

D1, bad-1 (percent) and EPE (pixels) of S2 over all pairs, full search and coarse to fine: KITTI 2015 4.65, 24.7, 1.165
and 4.55, 24.5, 1.141; KITTI 2012 4.46, 14.9, 1.026 and 4.11, 14.5, 0.961; Middlebury 4.25, 8.2, 0.943 and 4.18, 8.3,
0.901; ETH3D 1.81, 12.4, 0.556 and 1.22, 10.9, 0.493; satellite 14.3, 42.2, 1.996 and 14.3, 42.2, 1.973; rendered 8.80,
12.2, 3.026 and 8.82, 12.2, 2.927. An opinion at jumps too, or of pixels that were filled, costs Middlebury 3 % of bad-1
and more; two steps of cost instead of one change little.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import Levels, Search
from stereokit.kernels.jit import kernel
from stereokit.kernels.simd import LANES
from stereokit.kernels.threads import run, spans

__all__ = ["EXPECTED_CONFIDENCE", "SEARCHED_IN_FULL", "SEARCHES", "halved_levels", "plan_search", "restore_thin"]

SEARCHES = ("auto", "full", "coarse-to-fine")
"""Values of the option `search`."""
SEARCHED_IN_FULL = LANES
"""Levels up to which "auto" searches in full: fewer leave nothing to save."""

EXPECTED_CONFIDENCE = 0.5
"""Of a refined half-size map, the confidence from which its value counts as measured. Over the pairs of the model
card full size with the general refiner has 0.748 times the error of S2 without one (geometric mean of 24 figures),
0.769 with 0.75, and 0.789 where the half-size map is not refined."""

_RADIUS = 4  # of the neighbourhood, half-size pixels
_MARGIN = 6.0  # above and below what it holds, levels
_SLACK = 0.5  # around the expected levels
_FLAT = 0.5  # range of the coarse map in 3x3 pixels up to which something is expected, half-size pixels
_CONFIRMING = 3  # neighbours that agree with a thin thing
_STEP = 8  # starts are multiples of this: neighbours then mostly share theirs


def halved_levels(levels: Levels) -> Levels:
    """Return the levels at half size that cover `levels`."""
    low = levels.minimum // 2
    high = max(-(-(levels.minimum + levels.count) // 2), low + 1)
    return Levels(low, high - low)


def restore_thin(selected: NDArray[np.float32], cleaned: NDArray[np.float32], threads: int = 1) -> None:
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
    threads : int
        Threads to use.
    """
    run([partial(_restore_rows, selected, y0, y1, cleaned) for y0, y1 in spans(len(selected), threads)], threads)


@kernel
def _restore_rows(selected: NDArray[np.float32], y0: int, y1: int, cleaned: NDArray[np.float32]) -> None:
    height, width = selected.shape
    for y in range(y0, y1):
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


def plan_search(
    coarse: NDArray[np.float32], measured: NDArray[np.bool_], levels: Levels, search: Search, threads: int = 1
) -> None:
    """Write where each pixel searches, and what is expected there.

    Parameters
    ----------
    coarse : (ceil(H / 2), ceil(W / 2)) float32, half-size pixels, no NaN
        Filled map of half the size.
    measured : (ceil(H / 2), ceil(W / 2)) bool
        Its pixels that were measured.
    levels : Levels
        Of the full size, at least `LANES`.
    search : Search, (H, W)
        Is overwritten.
    threads : int
        Threads to use.
    """
    height = coarse.shape[0]

    def plan(y0: int, y1: int) -> None:
        first, behind = max(y0 - _RADIUS, 0), min(y1 + _RADIUS, height)
        part = coarse[first:behind]

        def around(radius: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
            low, high = (np.asarray(extreme(part, window), np.float32) for extreme in (cv2.erode, cv2.dilate))
            return low[y0 - first : y1 - first], high[y0 - first : y1 - first]

        _plan(coarse, measured, y0, y1, *around(_RADIUS), *around(1), levels.minimum, levels.count, search)

    run([partial(plan, y0, y1) for y0, y1 in spans(height, threads)], threads)


@kernel
def _plan(
    own: NDArray[np.float32], measured: NDArray[np.bool_], y0: int, y1: int, lows: NDArray[np.float32],
    highs: NDArray[np.float32], lows_3: NDArray[np.float32], highs_3: NDArray[np.float32], minimum: int, count: int,
    search: Search,
) -> None:  # fmt: skip
    """Write the search for rows y0..y1 of a half-size map and their lowest and highest values around each pixel.

    They are those of all pixels that the search shall hold, and of 3x3.
    """
    starts, first, last = search
    height, width = starts.shape
    searched = np.float32(LANES)
    zero = np.float32(0)
    top = np.float32(LANES - 1)
    margin = np.float32(_MARGIN)
    slack = np.float32(_SLACK)
    step = np.float32(_STEP)
    for y in range(y0, y1):
        low = lows[y - y0]
        high = highs[y - y0]
        low_3 = lows_3[y - y0]
        high_3 = highs_3[y - y0]
        for x in range(own.shape[1]):
            begin = np.float32(2) * low[x] - np.float32(minimum) - margin
            end = np.float32(2) * high[x] - np.float32(minimum) + margin + np.float32(2)  # a pixel is two levels
            middle = np.float32(2) * own[y, x] - np.float32(minimum) - searched * np.float32(0.5)
            middle = min(max(middle, begin), max(end - searched, begin))
            spare = searched - (end - begin)
            start = begin - spare * np.float32(0.5) if spare >= zero else middle
            start = np.floor(start / step + np.float32(0.5)) * step
            start = min(max(start, zero), np.float32(count - LANES))
            is_expected = measured[y, x] and high_3[x] - low_3[x] <= np.float32(_FLAT)
            lowest = np.floor(np.float32(2) * low_3[x] - slack - np.float32(minimum) - start)
            highest = np.ceil(np.float32(2) * high_3[x] + np.float32(1) + slack - np.float32(minimum) - start)
            right = min(2 * x + 1, width - 1)
            starts[2 * y, 2 * x] = np.int16(start)
            starts[2 * y, right] = np.int16(start)
            first[2 * y, 2 * x] = np.uint8(min(max(lowest, zero), top) if is_expected else zero)
            first[2 * y, right] = first[2 * y, 2 * x]
            last[2 * y, 2 * x] = np.uint8(min(max(highest, zero), top) if is_expected else top)
            last[2 * y, right] = last[2 * y, 2 * x]
        if 2 * y + 1 < height:
            for x in range(width):
                starts[2 * y + 1, x] = starts[2 * y, x]
                first[2 * y + 1, x] = first[2 * y, x]
                last[2 * y + 1, x] = last[2 * y, x]
