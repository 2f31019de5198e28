"""Signs in a map that its pair is not what it should be: they need no features, and 0.3 milliseconds.

At up to two hundred measured pixels, those with the steepest slopes down the image, the right view is taken where the
map says, and the shift is looked for that makes it most like the left view: one step of Lucas and Kanade (1981) in both
directions. The median of the shifts down the rows is within a tenth of a pixel for offsets of up to a third of a pixel
(of up to one on streets and rooms), and short of larger ones where the texture is fine. Where the right view is turned,
shifts of the halves of the image differ. A range that ends too early shows in values that crowd at its end, one view
given twice in values of 0.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.images.gray import GrayPair
from stereokit.kernels.jit import kernel

__all__ = ["MapSigns", "map_signs"]

_CANDIDATES, _POINTS, _FEWEST = 2500, 200, 30
_HALF = 2  # of the windows, pixels
_MARGIN = _HALF + 1
_SIDE = 2 * _MARGIN + 1
_SLOPE = 2.0  # grey levels of 256 a pixel that a point must have
_BINS = 512  # of slopes: half a grey level each
_NEAR_END = 1.5  # pixels from the first and the last level
_STILL = 0.25  # pixels of disparity
_REGULAR = 0.02  # of the determinant, to the square of the slopes down, where both directions can be told


class MapSigns(NamedTuple):
    """What a map tells of its pair.

    Attributes
    ----------
    offset : float or None
        How much lower the right view shows what the map says is the same, pixels; None if too little tells.
    spread : float
        Median of such offsets without their signs, pixels; 0 if too little tells.
    tilt : float
        Difference of the offset between the left and the right half, or the upper and the lower, the larger; pixels.
    low, high : float
        Shares of the measured pixels that lie within two pixels of the ends of the range.
    still : float
        Share of the measured pixels that have no disparity.
    """

    offset: float | None
    spread: float
    tilt: float
    low: float
    high: float
    still: float


def map_signs(
    pair: GrayPair, disparity: NDArray[np.float32], valid: NDArray[np.bool_], min_disparity: int, max_disparity: int
) -> MapSigns:  # fmt: skip
    """Return what a map tells of its pair.

    Parameters
    ----------
    pair : GrayPair
    disparity : (H, W) float32
        The left view's map, pixels.
    valid : (H, W) bool
        Where it was measured.
    min_disparity, max_disparity : int
        The range, pixels.
    """
    height, width = disparity.shape
    if min(height, width) <= 4 * _MARGIN:
        return MapSigns(None, 0.0, 0.0, 0.0, 0.0, 0.0)
    step = max(1, int(math.sqrt(height * width / _CANDIDATES)))
    scale = 1.0 if pair.left.dtype == np.uint8 else 255 / max(pair.span[1] - pair.span[0], 1)
    points = np.empty((4, _POINTS), np.float32)
    counts = np.zeros(_BINS, np.int32)
    windows = np.empty((2, _SIDE * _SIDE), np.float32)
    slopes = np.empty(-(-(height - 2 * _MARGIN) // step) * -(-(width - 2 * _MARGIN) // step), np.int16)
    ends = min_disparity + _NEAR_END, max_disparity - 1 - _NEAR_END
    count, measured, low, high, still = _row_shifts(
        pair.left, pair.right, disparity, valid, step, scale, ends, slopes, counts, windows, points
    )
    shares = [number / max(measured, 1) for number in (low, high, still)]
    y, x, both, down = points[:, :count]
    known = ~np.isnan(both)
    if np.count_nonzero(known) >= _FEWEST:
        y, x, shifts = y[known], x[known], both[known]
    elif count >= _FEWEST:
        shifts = down
    else:
        return MapSigns(None, 0.0, 0.0, *shares)
    tilt = max(_apart(shifts, x > width / 2), _apart(shifts, y > height / 2))
    return MapSigns(_median(shifts), _median(np.abs(shifts)), tilt, *shares)


def _median(values: NDArray[np.float32]) -> float:
    values = np.sort(values)
    return float(values[(values.size - 1) // 2] + values[values.size // 2]) / 2


def _apart(values: NDArray[np.float32], second: NDArray[np.bool_]) -> float:
    """Return the difference of the medians of two parts, 0 if one has few values."""
    if not _FEWEST // 2 <= np.count_nonzero(second) <= second.size - _FEWEST // 2:
        return 0.0
    return abs(_median(values[second]) - _median(values[~second]))


@kernel
def _row_shifts(
    left: NDArray[Any], right: NDArray[Any], disparity: NDArray[np.float32], valid: NDArray[np.bool_], step: int,
    scale: float, ends: tuple[float, float], slopes: NDArray[np.int16], counts: NDArray[np.int32],
    windows: NDArray[np.float32], points: NDArray[np.float32],
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Measure shifts at the points of a grid of `step` that have the steepest slopes.

    `slopes` has one element per point of the grid; `counts`, zeros, one per bin of slopes; `windows` room for two. The
    rows of `points` take, of each point, its y and x, the shift by both directions (NaN where only one can be told),
    and the shift by the slope down alone. Returned are the number of points, and, of the grid, how many were measured,
    lie below and above `ends` of disparity, and are still.
    """
    height, width = disparity.shape
    k, measured, below, above, still = 0, 0, 0, 0, 0
    for y in range(_MARGIN, height - _MARGIN, step):
        for x in range(_MARGIN, width - _MARGIN, step):
            slopes[k] = -1
            k += 1
            if not valid[y, x]:
                continue
            d = disparity[y, x]
            measured += 1
            below += d < ends[0]
            above += d > ends[1]
            still += abs(d) < _STILL
            place = np.float32(x) - d
            if place >= _MARGIN and place < width - _MARGIN - 1:
                slope = abs(np.float64(left[y + 1, x]) - np.float64(left[y - 1, x])) * scale
                if slope > 2 * _SLOPE:
                    slopes[k - 1] = np.int16(min(slope, _BINS - 1.0))
                    counts[slopes[k - 1]] += 1
    least, steeper = _BINS - 1, 0  # points of at least this slope, and of more than it
    while least > 0 and steeper + counts[least] < points.shape[1]:
        steeper += counts[least]
        least -= 1
    rest = points.shape[1] - steeper  # of the points of just this slope
    k, count = 0, 0
    for y in range(_MARGIN, height - _MARGIN, step):
        for x in range(_MARGIN, width - _MARGIN, step):
            slope_bin = slopes[k]
            k += 1
            if slope_bin < least or slope_bin < 0:
                continue
            if slope_bin == least:
                rest -= 1
                if rest < 0:
                    continue
            place = np.float32(x) - disparity[y, x]
            column = int(place)
            part = place - np.float32(column)
            for j in range(_SIDE):
                row = y - _MARGIN + j
                for i in range(_SIDE):
                    n = j * _SIDE + i
                    windows[0, n] = np.float32(left[row, x - _MARGIN + i])
                    at = column - _MARGIN + i
                    a, b = np.float32(right[row, at]), np.float32(right[row, at + 1])
                    windows[1, n] = a + part * (b - a)
            yy, xx, xy, yt, xt, downs, acrosses, lesses = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(1, _SIDE - 1):
                for i in range(1, _SIDE - 1):
                    n = j * _SIDE + i
                    both = windows[0, n + _SIDE] - windows[0, n - _SIDE] + windows[1, n + _SIDE] - windows[1, n - _SIDE]
                    down = np.float64(both) / 4
                    both = windows[0, n + 1] - windows[0, n - 1] + windows[1, n + 1] - windows[1, n - 1]
                    across = np.float64(both) / 4
                    less = np.float64(windows[0, n] - windows[1, n])
                    yy += down * down
                    xx += across * across
                    xy += down * across
                    yt += down * less
                    xt += across * less
                    downs += down
                    acrosses += across
                    lesses += less
            mean = lesses / (_SIDE - 2) ** 2  # brightness may differ
            yt -= mean * downs
            xt -= mean * acrosses
            determinant = yy * xx - xy * xy
            if yy <= 0:
                continue
            points[0, count] = y
            points[1, count] = x
            points[2, count] = np.nan
            if determinant > _REGULAR * yy * yy:
                points[2, count] = (xx * yt - xy * xt) / determinant
            points[3, count] = yt / yy
            count += 1
    return count, measured, below, above, still
