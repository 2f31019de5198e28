"""What the network `stereokit_refiners.networks.evidence.Evidence` sees: compiled loops over rows.

All maps are held relative to a whole number of pixels below all of them, in steps of 1/256 of a coarse pixel. Then
upscaling and differences are exact, and a constant that is added to all disparities changes no bit of the input.
Rows do not depend on one another, so that the result does not depend on how they are shared out between threads; all
operations are on integers or single IEEE ones in a fixed order.

Evidence stands on a grid of half the size: each 2x2 pixels are judged by two of them, the first and the last. Loops
that fetch from places that the data names are kept apart from those that compute, which become vector code everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.threads import run, spans
from stereokit_refiners.networks.evidence import CHANNELS, STEPS, VALUES

__all__ = ["MULTIPLE", "Hypotheses", "hypotheses", "network_input"]

MULTIPLE = 32
"""Rows and columns of full size are extended to a multiple of this."""

_STEPS = np.float32(256)  # of a coarse pixel
_REACH = 7  # coarse pixels, side of the window of the smallest and largest value
_BLIND = 8  # bits that differ outside the right image: half of those of a census
_MOST = 127  # of a gain


@dataclass(frozen=True)
class Hypotheses:
    """The values to choose from, and what speaks for each.

    Attributes
    ----------
    base : int
        What the maps are relative to, full-size pixels.
    step : int
        Full-size pixels of a coarse pixel: 1, 2 or 4.
    coarse : (H, W) float32
        The coarse map upscaled, full-size pixels.
    half : (H/2, W/2) float32
        Its means over 2x2.
    others : (4, H/2, W/2) float32
        Lowest and highest nearby, candidate and rival, for each 2x2 pixels.
    cost : (H/2, W/2) uint8
        Of the coarse map, eighths of a bit.
    gains : (6, H/2, W/2) int8
        How much less each of the other `VALUES` costs, eighths of a bit, from -127 to 127.
    """

    base: int
    step: int
    coarse: NDArray[np.float32]
    half: NDArray[np.float32]
    others: NDArray[np.float32]
    cost: NDArray[np.uint8]
    gains: NDArray[np.int8]

    @property
    def apart(self) -> int:
        """How far "less" and "more" are from the coarse map, full-size pixels."""
        return 2 if self.step == 4 else 1


def hypotheses(
    disparity: NDArray[np.float32], candidates: NDArray[np.float32], left: NDArray[np.uint8],
    right: NDArray[np.uint8], step: int, threads: int = 1,
) -> Hypotheses:  # fmt: skip
    """Return the values and their evidence for a pair.

    Parameters
    ----------
    disparity : (h, w) float32
        Coarse map, coarse pixels, without NaN.
    candidates : (2, h, w) float32
        The matcher's candidates, coarse pixels.
    left, right : (rows, columns) uint8
        Full-size images; h and w are theirs divided by `step`, rounded up.
    step : {1, 2, 4}
    threads : int
        Threads to use.

    Returns
    -------
    Hypotheses
        At the size of the images, extended to multiples of `MULTIPLE`.
    """
    rows, columns = left.shape
    height, width = -(-rows // MULTIPLE) * MULTIPLE, -(-columns // MULTIPLE) * MULTIPLE
    grid = (height // 2, width // 2)
    lowest = int(np.floor(np.floor(disparity.min() * _STEPS + np.float32(0.5)) / _STEPS))
    near = np.empty((height // step, width // step), np.float32)
    others = np.empty((4, *grid), np.float32)
    _fix(np.ascontiguousarray(disparity), lowest, step, 1, near)
    for k in range(2):
        _fix(np.ascontiguousarray(candidates[k]), lowest, step, 2 / step, others[2 + k])
    window = np.ones((_REACH, _REACH), np.uint8)
    for k, pick in enumerate((cv2.erode, cv2.dilate)):
        if step == 2:
            pick(near, window, dst=others[k])
        else:
            _spread(np.asarray(pick(near, window), np.float32), 2 / step, others[k])
    coarse = near
    if step > 1:
        coarse = np.empty((height, width), np.float32)
        cv2.resize(near, (width, height), dst=coarse, interpolation=cv2.INTER_LINEAR)
    half = np.empty(grid, np.float32)
    mine = _census_of(left, height, width, False, threads)
    theirs = _census_of(right, height, width, True, threads)
    cost, gains = np.empty(grid, np.uint8), np.empty((len(VALUES) - 1, *grid), np.int8)
    found = Hypotheses(lowest * step, step, coarse, half, others, cost, gains)
    parts = spans(grid[0], threads)
    lines = [np.empty((5 + len(VALUES), grid[1]), np.int32) for _ in parts]
    run(
        [
            partial(
                _weigh, mine, theirs, columns, found.base, coarse, others, found.apart, y0, y1, lines[k],
                lines[k][:3].view(np.uint32), half, cost, gains,
            )
            for k, (y0, y1) in enumerate(parts)
        ],
        threads,
    )  # fmt: skip
    return found


@inline
def _spread_row(row: Any, stride: Any, out: Any) -> None:
    last = row.size - 1
    if stride == 1:
        count = min(row.size, out.size)
        for x in range(count):
            out[x] = row[x]
        for x in range(count, out.size):
            out[x] = row[last]
    else:
        for x in range(out.size):
            out[x] = row[min(np.int64(np.float32(x) * stride), last)]


@kernel
def _spread(map: NDArray[np.float32], stride: float, out: NDArray[np.float32]) -> None:
    """Take every `stride`-th value of a map; its last row and column go on."""
    stride = np.float32(stride)
    for y in range(out.shape[0]):
        _spread_row(map[min(np.int64(np.float32(y) * stride), map.shape[0] - 1)], stride, out[y])


@kernel
def _fix(map: NDArray[np.float32], lowest: int, step: int, stride: float, out: NDArray[np.float32]) -> None:
    """Do that with coarse pixels, made fixed-point full-size pixels above `lowest` coarse ones."""
    steps = np.float32(256)
    low = np.float32(lowest)
    unit = np.float32(step)
    half = np.float32(0.5)
    stride = np.float32(stride)
    for y in range(out.shape[0]):
        row = out[y]
        _spread_row(map[min(np.int64(np.float32(y) * stride), map.shape[0] - 1)], stride, row)
        for x in range(row.size):
            row[x] = (np.floor(row[x] * steps + half) * np.float32(1 / 256) - low) * unit


def _census_of(image: NDArray[np.uint8], height: int, width: int, right: bool, threads: int) -> NDArray[Any]:
    """Return 16 bits a pixel: which of 16 neighbours in 5x5 are darker, after a light smoothing.

    Of the right image (height, width + 1) uint32: each pixel's bits, above those of the pixel left of it.
    """
    below, beside = height - image.shape[0], width - image.shape[1]
    wide = np.asarray(cv2.copyMakeBorder(image, 3, 3 + below, 3, 3 + beside, cv2.BORDER_REPLICATE), np.uint8)
    smooth = np.empty((height + 4, width + 4), np.uint16)
    parts = spans(height + 4, threads)
    lines = [np.empty((width + 6), np.uint16) for _ in parts]
    run([partial(_smooth, wide, y0, y1, lines[k], smooth) for k, (y0, y1) in enumerate(parts)], threads)
    if not right:
        bits = np.empty((height, width), np.uint16)
        run([partial(_census, smooth, y0, y1, bits) for y0, y1 in spans(height, threads)], threads)
        return bits
    pairs = np.empty((height, width + 1), np.uint32)
    parts = spans(height, threads)
    lines = [np.empty((1, width), np.uint16) for _ in parts]
    run([partial(_census_pairs, smooth, y0, y1, lines[k], pairs) for k, (y0, y1) in enumerate(parts)], threads)
    return pairs


@kernel
def _smooth(image: NDArray[np.uint8], y0: int, y1: int, line: NDArray[np.uint16], out: NDArray[np.uint16]) -> None:
    """Sum 3x3 pixels with weights 1, 4, 1 along either axis: sums of 36 weights, nothing rounded."""
    four = np.uint16(4)
    for y in range(y0, y1):
        above = image[y]
        here = image[y + 1]
        below = image[y + 2]
        row = out[y]
        for x in range(line.size):
            line[x] = np.uint16(np.uint16(above[x]) + four * np.uint16(here[x]) + np.uint16(below[x]))
        for x in range(row.size):
            row[x] = np.uint16(line[x] + four * line[x + 1] + line[x + 2])


@inline
def _bit(other: Any, centre: Any, k: Any) -> Any:
    return np.uint16(np.uint16(1 << k) if other < centre else np.uint16(0))


@inline
def _census_row(image: Any, y: Any, row: Any) -> None:
    """Compare with the eight neighbours, and the eight that a knight of chess would reach: all directions alike."""
    a = image[y]
    b = image[y + 1]
    c = image[y + 2]
    d = image[y + 3]
    e = image[y + 4]
    for x in range(row.size):
        m = c[x + 2]
        bits = _bit(a[x + 1], m, 0) | _bit(a[x + 3], m, 1) | _bit(b[x], m, 2) | _bit(b[x + 1], m, 3)
        bits |= _bit(b[x + 2], m, 4) | _bit(b[x + 3], m, 5) | _bit(b[x + 4], m, 6) | _bit(c[x + 1], m, 7)
        bits |= _bit(c[x + 3], m, 8) | _bit(d[x], m, 9) | _bit(d[x + 1], m, 10) | _bit(d[x + 2], m, 11)
        bits |= _bit(d[x + 3], m, 12) | _bit(d[x + 4], m, 13) | _bit(e[x + 1], m, 14) | _bit(e[x + 3], m, 15)
        row[x] = np.uint16(bits)


@kernel
def _census(image: NDArray[np.uint16], y0: int, y1: int, out: NDArray[np.uint16]) -> None:
    for y in range(y0, y1):
        _census_row(image, y, out[y])


@kernel
def _census_pairs(
    image: NDArray[np.uint16], y0: int, y1: int, lines: NDArray[np.uint16], out: NDArray[np.uint32]
) -> None:
    for y in range(y0, y1):
        line = lines[0]
        _census_row(image, y, line)
        row = out[y]
        for x in range(1, line.size):
            row[x] = (np.uint32(line[x]) << np.uint32(16)) | np.uint32(line[x - 1])
        row[0] = np.uint32(line[0]) << np.uint32(16)
        row[line.size] = np.uint32(line[line.size - 1])


@inline
def _add_costs(
    mine: Any, pairs: Any, at: Any, by: Any, part: Any, columns: Any, differing: Any, total: Any
) -> None:  # fmt: skip
    """Add the costs of values whose whole part leads to column ``at + by``, eighths of a bit."""
    shift = np.int32(by)
    most = np.int32(columns)
    for x in range(total.size):
        place = min(max(np.int32(at[x] + shift), np.int32(0)), most)
        differing[x] = pairs[np.uint32(place)] ^ mine[x]
    for x in range(total.size):
        place = np.int32(at[x] + shift)
        v = differing[x]  # two times 16 bits, whose ones are counted side by side
        v = np.uint32(v - ((v >> np.uint32(1)) & np.uint32(0x55555555)))
        v = np.uint32((v & np.uint32(0x33333333)) + ((v >> np.uint32(2)) & np.uint32(0x33333333)))
        v = np.uint32((v + (v >> np.uint32(4))) & np.uint32(0x0F0F0F0F))
        v = np.uint32(v + (v >> np.uint32(8)))
        first = np.int32(v >> np.uint32(16)) & np.int32(31)
        second = np.int32(v & np.uint32(31))
        if place < np.int32(0) or place >= most:
            first = np.int32(_BLIND)
        if place < np.int32(1) or place > most:
            second = np.int32(_BLIND)
        total[x] += np.int32(8) * first + part[x] * np.int32(second - first)


@inline
def _place(stride: Any, shift: Any, part: Any, at: Any) -> None:
    """Split eighths of pixels in `part`: column ``stride * x + shift`` less the whole pixels, and what is left."""
    for x in range(at.size):
        at[x] = np.int32(np.int32(stride * x) + shift) - (part[x] >> np.int32(3))
    for x in range(at.size):
        part[x] &= np.int32(7)


@kernel
def _weigh(
    left: NDArray[np.uint16], right: NDArray[np.uint32], columns: int, base: int, coarse: NDArray[np.float32],
    others: NDArray[np.float32], apart: int, y0: int, y1: int, lines: NDArray[np.int32], bits: NDArray[np.uint32],
    half: NDArray[np.float32], cost: NDArray[np.uint8], gains: NDArray[np.int8],
) -> None:  # fmt: skip
    """Compare the two images where each value says; `bits` are the first three of `lines`."""
    eight = np.float32(8)
    middle = np.float32(0.5)
    width = half.shape[1]
    differing = bits[2]
    at = lines[3]
    part = lines[4]
    totals = lines[5:]
    for y in range(y0, y1):
        for k in range(totals.shape[0]):
            for x in range(width):
                totals[k, x] = np.int32(0)
        upper = coarse[2 * y]
        lower = coarse[2 * y + 1]
        row = half[y]
        for x in range(width):
            row[x] = (upper[2 * x] + lower[2 * x] + upper[2 * x + 1] + lower[2 * x + 1]) * np.float32(0.25)
        for s in range(2):
            own = left[2 * y + s]
            mine = bits[s]
            for x in range(width):
                mine[x] = np.uint32(own[2 * x + s]) * np.uint32(0x10001)
            values = coarse[2 * y + s]
            for x in range(width):
                part[x] = np.int32(np.floor(values[2 * x + s] * eight + middle))
            _place(2, np.int32(s - base), part, at)
            pairs = right[2 * y + s]
            _add_costs(mine, pairs, at, 0, part, columns, differing, totals[0])
            _add_costs(mine, pairs, at, apart, part, columns, differing, totals[1])
            _add_costs(mine, pairs, at, -apart, part, columns, differing, totals[2])
        for k in range(others.shape[0]):
            other = others[k, y]
            for x in range(width):
                part[x] = np.int32(np.floor(other[x] * eight + middle))
            _place(2, np.int32(-base), part, at)
            _add_costs(bits[0], right[2 * y], at, 0, part, columns, differing, totals[3 + k])
            _add_costs(bits[1], right[2 * y + 1], at, 1, part, columns, differing, totals[3 + k])
        for x in range(width):
            cost[y, x] = np.uint8(totals[0, x] >> np.int32(1))
        for k in range(gains.shape[0]):
            for x in range(width):
                less = (totals[0, x] - totals[k + 1, x]) >> np.int32(1)
                gains[k, y, x] = np.int8(min(max(less, np.int32(-_MOST)), np.int32(_MOST)))


def network_input(
    found: Hypotheses, confidence: NDArray[np.float32], left: NDArray[np.uint8], columns: int, threads: int = 1
) -> NDArray[np.int8]:
    """Return the network's input.

    Parameters
    ----------
    found : Hypotheses
    confidence : (h, w) float32
        The matcher's, 0 to 1.
    left : (rows, columns) uint8
        Full-size image.
    columns : int
        Of the right image.
    threads : int

    Returns
    -------
    (C, H/4, W/4) int8, channels innermost in memory
        In steps of 1 / `stereokit_refiners.networks.evidence.STEPS`.
    """
    height, width = found.coarse.shape
    quarter = (height // 4, width // 4)
    channels = sum(CHANNELS.values())
    out = np.empty((*quarter, channels), np.int8)
    sure = np.empty((height // 2, width // 2), np.float32)
    _spread(np.ascontiguousarray(confidence), 2 / found.step, sure)
    below, beside = height - left.shape[0], width - left.shape[1]
    image = left
    if below or beside:
        image = np.asarray(cv2.copyMakeBorder(left, 0, below, 0, beside, cv2.BORDER_REPLICATE))
    image = np.ascontiguousarray(image)
    sums = np.empty((3, *quarter), np.float32)
    means = np.empty((3, *quarter), np.float32)
    parts = spans(quarter[0], threads)
    sides = [np.empty((2, width), np.int32) for _ in parts]
    run([partial(_pool, image, found.half, y0, y1, sides[k], sums) for k, (y0, y1) in enumerate(parts)], threads)
    wide = [np.empty(quarter[1] + 16, np.float32) for _ in parts]
    run([partial(_averages, sums, y0, y1, wide[k], means) for k, (y0, y1) in enumerate(parts)], threads)
    reach = (columns + 1) // 2
    scale = {1: -STEPS, 2: 0, 4: STEPS}[found.step]
    planes = [np.empty((24, 2, width), np.int8) for _ in parts]
    floats = [np.empty((4, width + 2), np.float32) for _ in parts]
    places = [np.empty(width // 2, np.int32) for _ in parts]
    run(
        [
            partial(
                _features, image, sure, found.half, found.others, means, found.cost, found.gains, found.base, reach,
                scale, y0, y1, floats[k], places[k], planes[k], planes[k].view(np.uint16), out.view(np.uint16),
            )
            for k, (y0, y1) in enumerate(parts)
        ],
        threads,
    )  # fmt: skip
    return np.moveaxis(out, 2, 0)


@kernel
def _pool(
    image: NDArray[np.uint8], half: NDArray[np.float32], y0: int, y1: int, lines: NDArray[np.int32],
    sums: NDArray[np.float32],
) -> None:  # fmt: skip
    """Means of 4x4 of the grey levels, of their squares and of the coarse map."""
    total = lines[0]
    squares = lines[1]
    for y in range(y0, y1):
        a = image[4 * y]
        b = image[4 * y + 1]
        c = image[4 * y + 2]
        d = image[4 * y + 3]
        for x in range(total.size):
            i, j, k, l = np.int32(a[x]), np.int32(b[x]), np.int32(c[x]), np.int32(d[x])  # noqa: E741
            total[x] = i + j + k + l
            squares[x] = i * i + j * j + k * k + l * l
        upper = half[2 * y]
        lower = half[2 * y + 1]
        for x in range(sums.shape[2]):
            t = total[4 * x] + total[4 * x + 1] + total[4 * x + 2] + total[4 * x + 3]
            s = squares[4 * x] + squares[4 * x + 1] + squares[4 * x + 2] + squares[4 * x + 3]
            sums[0, y, x] = np.float32(np.int32(t)) * np.float32(1 / 16)
            sums[1, y, x] = np.float32(np.int32(s)) * np.float32(1 / 16)
            sums[2, y, x] = (upper[2 * x] + lower[2 * x] + upper[2 * x + 1] + lower[2 * x + 1]) * np.float32(0.25)


@kernel
def _averages(sums: NDArray[np.float32], y0: int, y1: int, line: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Average over windows of 9x9, and the coarse map over 17x17; the second is one over the spread of grey levels."""
    height, width = sums.shape[1:]
    for y in range(y0, y1):
        for k in range(3):
            reach = 8 if k == 2 else 4
            share = np.float32(1 / 289) if k == 2 else np.float32(1 / 81)
            inner = line[reach : reach + width]
            for x in range(width):
                inner[x] = np.float32(0)
            for dy in range(-reach, reach + 1):
                other = sums[k, min(max(y + dy, 0), height - 1)]
                for x in range(width):
                    inner[x] += other[x]
            for x in range(reach):
                line[x] = inner[0]
                line[reach + width + x] = inner[width - 1]
            row = out[k, y]
            for x in range(width):
                row[x] = np.float32(0)
            for dx in range(2 * reach + 1):
                other = line[dx:]
                for x in range(width):
                    row[x] += other[x]
            for x in range(width):
                row[x] *= share
        for x in range(width):
            mean = out[0, y, x]
            spread = np.sqrt(max(out[1, y, x] - mean * mean, np.float32(0)))
            out[1, y, x] = np.float32(STEPS) / (spread + np.float32(3))


@inline
def _whole(x: Any) -> Any:
    return np.int8(np.int32(np.floor(x + np.float32(0.5))))


@inline
def _squashed(x: Any, unit: Any) -> Any:
    """Return x between -2 and 2, in steps; differences of about a unit are what it resolves best."""
    return _whole(np.float32(2 * STEPS) * (x / (abs(x) + unit)))


@inline
def _surface(nearest: Any, row: Any, base: Any, reach: Any, place: Any, there: Any, out: Any) -> None:
    """Write the nearest surface of the right view where each value points to, less the value; 0 where there is none."""
    half = np.float32(0.5)
    most = np.int32(reach)
    for x in range(row.size):
        at = np.int32(np.floor((np.float32(2 * x - base) - row[x]) * half + half))
        place[x] = min(max(at + np.int32(1), np.int32(0)), most + np.int32(1))
    for x in range(row.size):
        there[x] = nearest[np.uint32(place[x])]
    for x in range(row.size):
        value = row[x]
        beyond = there[x] - value
        out[x] = _squashed(np.float32(0) if there[x] < np.float32(-5e8) else beyond, np.float32(2))


@kernel
def _features(
    image: NDArray[np.uint8], sure: NDArray[np.float32], half: NDArray[np.float32], others: NDArray[np.float32],
    means: NDArray[np.float32], cost: NDArray[np.uint8], gains: NDArray[np.int8], base: int, reach: int, scale: int,
    y0: int, y1: int, lines: NDArray[np.float32], place: NDArray[np.int32], planes: NDArray[np.int8],
    twos: NDArray[np.uint16], out: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Write rows of 4x4 pixels; `twos` are the bytes of `planes` by two."""
    quarter = out.shape[1]
    width = half.shape[1]
    two = np.float32(2)
    steps = np.float32(STEPS)
    none = np.float32(-1e9)
    bound = np.float32(3 * STEPS)
    mean = lines[0]
    inverse = lines[1]
    there = lines[2]
    nearest = lines[3]
    for y in range(y0, y1):
        for x in range(quarter):
            for j in range(4):
                mean[4 * x + j] = means[0, y, x]
                inverse[4 * x + j] = means[1, y, x]
        for i in range(4):
            grey = image[4 * y + i]
            row = planes[20 + i, 0]
            for x in range(2 * width):
                level = (np.float32(grey[x]) - mean[x]) * inverse[x]
                row[x] = _whole(min(max(level, -bound), bound))
        for x in range(quarter):
            for j in range(2):
                mean[2 * x + j] = means[2, y, x]
        outside = planes[18, 0]
        for x in range(2 * width):
            outside[x] = np.int8(0)
        for i in range(2):
            h = 2 * y + i
            here = half[h]
            certain = sure[h]
            row = planes[0, i]
            for x in range(width):
                row[x] = _whole(certain[x] * (np.float32(4) * steps) - two * steps)
            row = planes[1, i]
            for x in range(width):
                row[x] = _squashed(here[x] - mean[x], np.float32(8))
            for k in range(4):
                other = others[k, h]
                row = planes[2 + k, i]
                for x in range(width):
                    row[x] = _squashed(other[x] - here[x], two)
            row = planes[6, i]
            costs = cost[h]
            for x in range(width):
                row[x] = np.int8(((np.int32(costs[x]) * np.int32(5)) >> np.int32(2)) - np.int32(STEPS))
            for k in range(6):
                row = planes[7 + k, i]
                gain = gains[k, h]
                for x in range(width):
                    row[x] = gain[x]
            # The right view's map is the left one's, each pixel moved to where it is seen.
            for x in range(reach + 2):
                nearest[x] = none
            for x in range(width):
                at = np.int32(np.floor((np.float32(2 * x - base) - here[x]) * np.float32(0.5)))
                place[x] = min(max(at + np.int32(1), np.int32(-1)), np.int32(reach + 1))
            for x in range(reach):
                at = place[x]
                value = here[x]
                if at >= 1 and at <= reach:
                    nearest[at] = max(nearest[at], value)
                if at >= 0 and at < reach:
                    nearest[at + 1] = max(nearest[at + 1], value)
            for x in range(width):
                away = np.int8(place[x] < np.int32(1)) + np.int8(place[x] > np.int32(reach))
                outside[x] = np.int8(outside[x] + np.int8(away))
            _surface(nearest, here, base, reach, place, there[:width], planes[13, i])
            for k in range(4):
                _surface(nearest, others[k, h], base, reach, place, there[:width], planes[14 + k, i])
        for x in range(quarter):
            share = np.int32(outside[2 * x]) + np.int32(outside[2 * x + 1])
            planes[19, 0, 2 * x] = np.int8(share * np.int32(STEPS // 4))
            planes[19, 0, 2 * x + 1] = np.int8(scale)
        for x in range(quarter):
            pixel = out[y, x]
            for i in range(4):
                pixel[2 * i] = twos[20 + i, 0, 2 * x]
                pixel[2 * i + 1] = twos[20 + i, 0, 2 * x + 1]
            for k in range(18):
                pixel[8 + 2 * k] = twos[k, 0, x]
                pixel[9 + 2 * k] = twos[k, 1, x]
            pixel[44] = twos[19, 0, x]
