"""What the network `stereokit_refiners.networks.evidence.Evidence` sees: compiled loops over rows.

All maps are held relative to a whole number of pixels below all of them, in steps of 1/256 of a coarse pixel. Then
upscaling and differences are exact, and a constant that is added to all disparities changes no bit of the input.
Rows do not depend on one another, so that the result does not depend on how they are shared out between threads; all
operations are on integers or single IEEE ones in a fixed order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.simd import count_ones
from stereokit.kernels.threads import run, spans
from stereokit_refiners.networks.evidence import CHANNELS, VALUES

__all__ = ["MULTIPLE", "Hypotheses", "hypotheses", "network_input"]

MULTIPLE = 32
"""Rows and columns of full size are extended to a multiple of this."""

_STEPS = np.float32(256)  # of a coarse pixel
_REACH = 7  # coarse pixels, side of the window of the smallest and largest value
_BLIND = 12  # cost outside the right image: half of the bits of a census
_SMALL, _LARGE = 3, 7  # sides of the windows over which costs are averaged


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
    others : (4, H/2, W/2) float32
        Lowest and highest nearby, candidate and rival, for each 2x2 pixels.
    costs : (7, H, W) uint8
        Of each of `VALUES`, eighths of a bit.
    near : (H, W) uint8
        The mean of the coarse map's costs over 3x3.
    around : (7, H, W) uint8
        The means of all costs over 7x7.
    outside : (H, W) uint8
        1 where the coarse map points outside the right image.
    """

    base: int
    step: int
    coarse: NDArray[np.float32]
    others: NDArray[np.float32]
    costs: NDArray[np.uint8]
    near: NDArray[np.uint8]
    around: NDArray[np.uint8]
    outside: NDArray[np.uint8]

    @property
    def apart(self) -> int:
        """How far "less" and "more" are from the coarse map, full-size pixels."""
        return 2 if self.step == 4 else 1


def extended(image: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """Return `image`, extended to a size by its last row and column."""
    below, beside = rows - image.shape[0], columns - image.shape[1]
    if below == 0 and beside == 0:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.copyMakeBorder(image, 0, below, 0, beside, cv2.BORDER_REPLICATE))


def on_half_grid(coarse: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """Return one value for each 2x2 full-size pixels of a map whose pixels are `step` wide."""
    if step == 1:
        return np.ascontiguousarray(coarse[::2, ::2])
    return coarse if step == 2 else np.ascontiguousarray(coarse.repeat(2, 0).repeat(2, 1))


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
    lowest = int(np.floor(np.rint(disparity.min() * _STEPS) / _STEPS))

    def relative(map: NDArray[np.float32]) -> NDArray[np.float32]:
        fixed = np.rint(map * _STEPS) * np.float32(1 / 256) - np.float32(lowest)
        return extended(fixed * np.float32(step), height // step, width // step)

    near = relative(disparity)
    window = np.ones((_REACH, _REACH), np.uint8)
    coarse = near
    if step > 1:
        coarse = np.asarray(cv2.resize(near, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    extremes = [np.asarray(pick(near, window), np.float32) for pick in (cv2.erode, cv2.dilate)]
    others = np.stack([on_half_grid(one, step) for one in (*extremes, *map(relative, candidates))])
    base = lowest * step
    costs, around = (np.empty((len(VALUES), height, width), np.uint8) for _ in range(2))
    near_costs, outside = (np.empty((height, width), np.uint8) for _ in range(2))
    found = Hypotheses(base, step, coarse, others, costs, near_costs, around, outside)
    mine, theirs = (_census_of(extended(image, height, width), threads) for image in (left, right))
    parts = spans(height, threads)
    lines = [np.empty((6, width), np.int32) for _ in parts]
    run(
        [
            partial(
                _costs, mine, theirs, columns, base, coarse, others, found.apart, y0, y1, lines[k], costs, outside
            )
            for k, (y0, y1) in enumerate(parts)
        ],
        threads,
    )  # fmt: skip
    means = [partial(_mean, costs[k], _LARGE, around[k]) for k in range(len(VALUES))]
    run([*means, partial(_mean, costs[0], _SMALL, near_costs)], threads)
    return found


def _mean(costs: NDArray[np.uint8], side: int, out: NDArray[np.uint8]) -> None:
    cv2.blur(costs, (side, side), dst=out, borderType=cv2.BORDER_REPLICATE)  # odd windows: no half is ever rounded


def _census_of(image: NDArray[np.uint8], threads: int) -> NDArray[np.uint32]:
    """Return 24 bits a pixel: which neighbours of 5x5 are darker, after a light smoothing."""
    height, width = image.shape
    wide = np.asarray(cv2.copyMakeBorder(image, 3, 3, 3, 3, cv2.BORDER_REPLICATE), np.uint8)
    smooth = np.empty((height + 4, width + 4), np.uint16)
    run([partial(_smooth, wide, y0, y1, smooth) for y0, y1 in spans(height + 4, threads)], threads)
    bits = np.empty((height, width), np.uint32)
    run([partial(_census, smooth, y0, y1, bits) for y0, y1 in spans(height, threads)], threads)
    return bits


@kernel
def _smooth(image: NDArray[np.uint8], y0: int, y1: int, out: NDArray[np.uint16]) -> None:
    """Sum 3x3 pixels with weights 1, 4, 1 along either axis: sums of 36 weights, nothing rounded."""
    for y in range(y0, y1):
        above = image[y]
        here = image[y + 1]
        below = image[y + 2]
        row = out[y]
        for x in range(row.size):
            before = np.int32(above[x]) + np.int32(4) * np.int32(here[x]) + np.int32(below[x])
            middle = np.int32(above[x + 1]) + np.int32(4) * np.int32(here[x + 1]) + np.int32(below[x + 1])
            after = np.int32(above[x + 2]) + np.int32(4) * np.int32(here[x + 2]) + np.int32(below[x + 2])
            row[x] = np.uint16(before + np.int32(4) * middle + after)


@kernel
def _census(image: NDArray[np.uint16], y0: int, y1: int, out: NDArray[np.uint32]) -> None:
    for y in range(y0, y1):
        centre = image[y + 2, 2:]
        row = out[y]
        for x in range(row.size):
            row[x] = np.uint32(0)
        for dy in range(5):
            for dx in range(5):
                if dy == 2 and dx == 2:
                    continue
                other = image[y + dy, dx:]
                for x in range(row.size):
                    row[x] = (row[x] << np.uint32(1)) | np.uint32(other[x] < centre[x])


@inline
def _distances(mine: Any, row: Any, at: Any, shift: Any, columns: Any, out: Any) -> None:
    """Compare each pixel of a row with the right image's pixel `shift` columns right of where `at` says."""
    last = np.int32(columns - 1)
    for x in range(out.size):
        place = np.int32(at[x] + np.int32(shift))
        inside = np.uint32(min(max(place, np.int32(0)), last))
        bits = count_ones(np.uint32(mine[x] ^ row[inside]))
        out[x] = np.int32(_BLIND) if inside != np.uint32(place) else bits


@inline
def _between(part: Any, first: Any, second: Any, out: Any) -> None:
    """Return costs `part` eighths of the way from the first distance to the second, eighths of a bit."""
    for x in range(out.size):
        out[x] = np.uint8((np.int32(8) - part[x]) * first[x] + part[x] * second[x])


@kernel
def _costs(
    left: NDArray[np.uint32], right: NDArray[np.uint32], columns: int, base: int, coarse: NDArray[np.float32],
    others: NDArray[np.float32], apart: int, y0: int, y1: int, lines: NDArray[np.int32], out: NDArray[np.uint8],
    outside: NDArray[np.uint8],
) -> None:  # fmt: skip
    eight = np.float32(8)
    half = np.float32(0.5)
    width = coarse.shape[1]
    at = lines[0]
    part = lines[1]
    here = lines[2]
    beside = lines[3]
    first = lines[4]
    second = lines[5]
    last = np.int32(columns - 1)
    for y in range(y0, y1):
        mine = left[y]
        theirs = right[y]
        row = coarse[y]
        blind = outside[y]
        for x in range(width):
            place = np.int32(np.floor(row[x] * eight + half))
            part[x] = place & np.int32(7)
            at[x] = np.int32(x - base) - (place >> np.int32(3))
            blind[x] = (at[x] < np.int32(0)) | (at[x] > last)
        _distances(mine, theirs, at, 0, columns, here)
        _distances(mine, theirs, at, -1, columns, beside)
        _between(part, here, beside, out[0, y])
        _distances(mine, theirs, at, apart, columns, first)
        if apart == 1:
            _between(part, first, here, out[1, y])
            _distances(mine, theirs, at, -2, columns, second)
            _between(part, beside, second, out[2, y])
        else:
            _distances(mine, theirs, at, apart - 1, columns, second)
            _between(part, first, second, out[1, y])
            _distances(mine, theirs, at, -apart, columns, first)
            _distances(mine, theirs, at, -apart - 1, columns, second)
            _between(part, first, second, out[2, y])
        for k in range(others.shape[0]):
            row = others[k, y >> 1]
            for x in range(width // 2):
                place = np.int32(np.floor(row[x] * eight + half))
                part[2 * x] = place & np.int32(7)
                part[2 * x + 1] = place & np.int32(7)
                at[2 * x] = np.int32(2 * x - base) - (place >> np.int32(3))
                at[2 * x + 1] = at[2 * x] + np.int32(1)
            _distances(mine, theirs, at, 0, columns, here)
            _distances(mine, theirs, at, -1, columns, beside)
            _between(part, here, beside, out[3 + k, y])


def network_input(
    found: Hypotheses, confidence: NDArray[np.float32], left: NDArray[np.uint8], columns: int, threads: int = 1
) -> NDArray[np.float32]:
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
    (C, H/4, W/4) float32, channels innermost in memory
    """
    height, width = found.coarse.shape
    quarter = (height // 4, width // 4)
    channels = sum(CHANNELS.values())
    out = np.empty((*quarter, channels), np.float32)
    sure = on_half_grid(extended(confidence, height // found.step, width // found.step), found.step)
    image = extended(left, height, width)
    half = np.empty((height // 2, width // 2), np.float32)
    sums = np.empty((3, *quarter), np.float32)
    means = np.empty((3, *quarter), np.float32)
    surface = np.empty((len(VALUES) - 2, *half.shape), np.float32)
    parts = spans(quarter[0], threads)
    run([partial(_pool, found.coarse, image, y0, y1, half, sums) for y0, y1 in parts], threads)
    lines = [np.empty(half.shape[1], np.float32) for _ in parts]
    wide = [np.empty(quarter[1] + 16, np.float32) for _ in parts]
    reach = (columns + 1) // 2
    run(
        [partial(_averages, sums, y0, y1, wide[k], means) for k, (y0, y1) in enumerate(parts)]
        + [
            partial(_surface, half, found.others, found.base, reach, 2 * y0, 2 * y1, lines[k], surface)
            for k, (y0, y1) in enumerate(parts)
        ],
        threads,
    )
    scale = np.float32({1: -1, 2: 0, 4: 1}[found.step])
    planes = np.empty((len(parts), channels, quarter[1]), np.float32)
    run(
        [
            partial(
                _features, image, sure, half, found.others, means, found.costs, found.near, found.outside, surface,
                scale, y0, y1, planes[k], out,
            )
            for k, (y0, y1) in enumerate(parts)
        ],
        threads,
    )  # fmt: skip
    return np.moveaxis(out, 2, 0)


@kernel
def _pool(
    coarse: NDArray[np.float32], image: NDArray[np.uint8], y0: int, y1: int, half: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:  # fmt: skip
    """Means of 2x2 of the coarse map; of 4x4 of the grey levels, of their squares and of the coarse map."""
    quarter = np.float32(0.25)
    for y in range(y0, y1):
        for i in range(2):
            a = coarse[4 * y + 2 * i]
            b = coarse[4 * y + 2 * i + 1]
            row = half[2 * y + i]
            for x in range(row.size):
                row[x] = (a[2 * x] + b[2 * x] + a[2 * x + 1] + b[2 * x + 1]) * quarter
        upper = half[2 * y]
        lower = half[2 * y + 1]
        for x in range(sums.shape[2]):
            total = np.int32(0)
            squares = np.int32(0)
            for i in range(4):
                for j in range(4):
                    grey = np.int32(image[4 * y + i, 4 * x + j])
                    total += grey
                    squares += grey * grey
            sums[0, y, x] = np.float32(total) * np.float32(1 / 16)
            sums[1, y, x] = np.float32(squares) * np.float32(1 / 16)
            sums[2, y, x] = (upper[2 * x] + lower[2 * x] + upper[2 * x + 1] + lower[2 * x + 1]) * quarter


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
            out[1, y, x] = np.float32(1) / (spread + np.float32(3))


@kernel
def _surface(
    half: NDArray[np.float32], others: NDArray[np.float32], base: int, reach: int, y0: int, y1: int,
    line: NDArray[np.float32], out: NDArray[np.float32],
) -> None:  # fmt: skip
    """Return the nearest surface of the right view where each value points to, less the value; 0 where there is none.

    The right view's map is the left one's, each pixel moved to where it is seen.
    """
    none = np.float32(-1e9)
    half_pixel = np.float32(0.5)
    for y in range(y0, y1):
        line[:] = none
        for x in range(reach):
            value = half[y, x]
            at = np.int64(np.floor((np.float32(2 * x - base) - value) * half_pixel))
            for place in range(max(at, 0), min(at + 2, reach)):
                line[place] = max(line[place], value)
        for k in range(out.shape[0]):
            row = half[y] if k == 0 else others[k - 1, y]
            for x in range(half.shape[1]):
                at = np.int64(np.floor((np.float32(2 * x - base) - row[x]) * half_pixel + half_pixel))
                there = np.float32(0)
                if 0 <= at < reach:
                    if line[at] > none:
                        there = line[at] - row[x]
                out[k, y, x] = there


@inline
def _squashed(x: Any, unit: Any) -> Any:
    """Return x between -2 and 2; differences of about a unit are what it resolves best."""
    return np.float32(2) * (x / (abs(x) + unit))


@kernel
def _features(
    image: NDArray[np.uint8], sure: NDArray[np.float32], half: NDArray[np.float32], others: NDArray[np.float32],
    means: NDArray[np.float32], costs: NDArray[np.uint8], near: NDArray[np.uint8], outside: NDArray[np.uint8],
    surface: NDArray[np.float32], scale: float, y0: int, y1: int, plane: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:  # fmt: skip
    width = out.shape[1]
    two = np.float32(2)
    for y in range(y0, y1):
        mean = means[0, y]
        inverse = means[1, y]
        around = means[2, y]
        for i in range(4):
            line = image[4 * y + i]
            for j in range(4):
                row = plane[4 * i + j]
                for x in range(width):
                    level = (np.float32(line[4 * x + j]) - mean[x]) * inverse[x]
                    row[x] = min(max(level, np.float32(-3)), np.float32(3))
        for i in range(2):
            for j in range(2):
                p = 2 * i + j
                h = 2 * y + i
                row = plane[16 + p]
                line_f = sure[h]
                for x in range(width):
                    row[x] = line_f[2 * x + j] * np.float32(4) - two
                row = plane[20 + p]
                here = half[h]
                for x in range(width):
                    row[x] = _squashed(here[2 * x + j] - around[x], np.float32(8))
                for k in range(4):
                    row = plane[24 + 4 * k + p]
                    line_f = others[k, h]
                    for x in range(width):
                        row[x] = _squashed(line_f[2 * x + j] - here[2 * x + j], two)
                for k in range(5):
                    row = plane[70 + 4 * k + p]
                    line_f = surface[k, h]
                    for x in range(width):
                        row[x] = _squashed(line_f[2 * x + j], two)
                upper = 2 * h
                row = plane[40 + p]
                for x in range(width):
                    c = 2 * x + j
                    total = np.int32(near[upper, 2 * c]) + np.int32(near[upper, 2 * c + 1])
                    total += np.int32(near[upper + 1, 2 * c]) + np.int32(near[upper + 1, 2 * c + 1])
                    row[x] = np.float32(total) * np.float32(1 / 128) - np.float32(1)
                for k in range(1, 7):
                    row = plane[40 + 4 * k + p]
                    for x in range(width):
                        c = 2 * (2 * x + j)
                        total = np.int32(costs[0, upper, c]) + np.int32(costs[0, upper, c + 1])
                        total += np.int32(costs[0, upper + 1, c]) + np.int32(costs[0, upper + 1, c + 1])
                        total -= np.int32(costs[k, upper, c]) + np.int32(costs[k, upper, c + 1])
                        total -= np.int32(costs[k, upper + 1, c]) + np.int32(costs[k, upper + 1, c + 1])
                        row[x] = np.float32(total) * np.float32(1 / 128)
        row = plane[68]
        for x in range(width):
            total = np.int32(0)
            for i in range(4):
                for j in range(4):
                    total += np.int32(outside[4 * y + i, 4 * x + j])
            row[x] = np.float32(total) * np.float32(1 / 16)
        row = plane[69]
        for x in range(width):
            row[x] = np.float32(scale)
        for first in range(0, width, 16):  # pixels that fit into the nearest cache, channel by channel
            for c in range(plane.shape[0]):
                for x in range(first, min(first + 16, width)):
                    out[y, x, c] = plane[c, x]
