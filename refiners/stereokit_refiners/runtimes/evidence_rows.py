"""Rows of images and maps for `stereokit_refiners.runtimes.evidence`: loops that become vector code.

All of them are exact, or single IEEE operations in a fixed order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.kernels.jit import inline

__all__ = [
    "BLIND",
    "REACH",
    "add_costs",
    "census_phase",
    "census_row",
    "eighths",
    "extreme_row",
    "fixed_row",
    "into_columns",
    "smooth_row",
    "spread_row",
    "upscaled_row",
]

REACH = 3
"""Coarse pixels to either side of the window of the smallest and largest value."""

BLIND = 8
"""Bits that differ outside the right image: half of those of a census."""


@inline
def spread_row(row: Any, stride: Any, out: Any) -> None:
    """Take every `stride`-th value of a row; its last one goes on."""
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


@inline
def fixed_row(row: Any, stride: Any, lowest: Any, unit: Any, out: Any) -> None:
    """Do that with coarse pixels, made fixed-point full-size pixels above `lowest` coarse ones."""
    spread_row(row, stride, out)
    for x in range(out.size):
        whole = np.floor(out[x] * np.float32(256) + np.float32(0.5)) * np.float32(1 / 256)
        out[x] = (whole - lowest) * unit


@inline
def upscaled_row(row: Any, step: Any, out: Any) -> None:
    """Upscale by 2 or 4 along a row, pixel centres kept: linear, the ends go on."""
    width = row.size
    last = width - 1
    if step == 2:
        near = np.float32(0.75)
        far = np.float32(0.25)
        for x in range(1, last):
            out[2 * x] = near * row[x] + far * row[x - 1]
            out[2 * x + 1] = near * row[x] + far * row[x + 1]
        for x in (0, last):
            out[2 * x] = near * row[x] + far * row[max(x - 1, 0)]
            out[2 * x + 1] = near * row[x] + far * row[min(x + 1, last)]
    else:
        a = np.float32(0.125)
        b = np.float32(0.375)
        c = np.float32(0.625)
        d = np.float32(0.875)
        for x in range(1, last):
            here = row[x]
            before = row[x - 1]
            after = row[x + 1]
            out[4 * x] = c * here + b * before
            out[4 * x + 1] = d * here + a * before
            out[4 * x + 2] = d * here + a * after
            out[4 * x + 3] = c * here + b * after
        for x in (0, last):
            here = row[x]
            before = row[max(x - 1, 0)]
            after = row[min(x + 1, last)]
            out[4 * x] = c * here + b * before
            out[4 * x + 1] = d * here + a * before
            out[4 * x + 2] = d * here + a * after
            out[4 * x + 3] = c * here + b * after


@inline
def extreme_row(rows: Any, first: Any, after: Any, sign: Any, line: Any, out: Any) -> None:
    """Write ``sign`` times the largest of ``sign`` times the values in windows around a row.

    Those of its rows, at most seven, are `first` to `after`; `rows` keeps the last ones of the map, a power of two of
    them. `line` has `REACH` places more than `out` at either end.
    """
    width = out.size
    kept = rows.shape[0] - 1
    inner = line[REACH : REACH + width]
    row = rows[first & kept]
    for x in range(width):
        inner[x] = sign * row[x]
    for y in range(first + 1, after):
        row = rows[y & kept]
        for x in range(width):
            inner[x] = max(inner[x], sign * row[x])
    for x in range(REACH):
        line[x] = inner[0]
        line[REACH + width + x] = inner[width - 1]
    for x in range(line.size - 1):
        line[x] = max(line[x], line[x + 1])
    for x in range(line.size - 3):
        line[x] = max(line[x], line[x + 2])
    for x in range(width):
        out[x] = sign * max(line[x], line[x + 3])


@inline
def smooth_row(above: Any, here: Any, below: Any, line: Any, out: Any) -> None:
    """Sum 3x3 pixels with weights 1, 4, 1 along either axis: sums of 36 weights, nothing rounded.

    `out` begins two pixels before the image, `line` three; pixels beyond its ends repeat the last.
    """
    four = np.uint16(4)
    columns = here.size
    inner = line[3 : 3 + columns]
    for x in range(columns):
        inner[x] = np.uint16(np.uint16(above[x]) + four * np.uint16(here[x]) + np.uint16(below[x]))
    for x in range(3):
        line[x] = inner[0]
    for x in range(3 + columns, line.size):
        line[x] = inner[columns - 1]
    for x in range(out.size):
        out[x] = np.uint16(line[x] + four * line[x + 1] + line[x + 2])


@inline
def _bit(other: Any, centre: Any, k: Any) -> Any:
    return np.uint16(np.uint16(1 << k) if other < centre else np.uint16(0))


@inline
def census_row(a: Any, b: Any, c: Any, d: Any, e: Any, out: Any) -> None:
    """Compare the pixels of row `c`, from the third on, with 16 neighbours in the five rows.

    They are the eight next to it, and the eight that a knight of chess would reach: all directions alike.
    """
    for x in range(out.size):
        m = c[x + 2]
        bits = _bit(a[x + 1], m, 0) | _bit(a[x + 3], m, 1) | _bit(b[x], m, 2) | _bit(b[x + 1], m, 3)
        bits |= _bit(b[x + 2], m, 4) | _bit(b[x + 3], m, 5) | _bit(b[x + 4], m, 6) | _bit(c[x + 1], m, 7)
        bits |= _bit(c[x + 3], m, 8) | _bit(d[x], m, 9) | _bit(d[x + 1], m, 10) | _bit(d[x + 2], m, 11)
        bits |= _bit(d[x + 3], m, 12) | _bit(d[x + 4], m, 13) | _bit(e[x + 1], m, 14) | _bit(e[x + 3], m, 15)
        out[x] = np.uint16(bits)


@inline
def census_phase(a: Any, b: Any, c: Any, d: Any, e: Any, out: Any) -> None:
    """Do that for every second pixel.

    Each of the rows is a pair: its columns 0, 2, 4 and so on from the first such pixel's window on, and those between.
    """
    for x in range(out.size):
        m = c[0][x + 1]
        bits = _bit(a[1][x], m, 0) | _bit(a[1][x + 1], m, 1) | _bit(b[0][x], m, 2) | _bit(b[1][x], m, 3)
        bits |= _bit(b[0][x + 1], m, 4) | _bit(b[1][x + 1], m, 5) | _bit(b[0][x + 2], m, 6) | _bit(c[1][x], m, 7)
        bits |= _bit(c[1][x + 1], m, 8) | _bit(d[0][x], m, 9) | _bit(d[1][x], m, 10) | _bit(d[0][x + 1], m, 11)
        bits |= _bit(d[1][x + 1], m, 12) | _bit(d[0][x + 2], m, 13) | _bit(e[1][x], m, 14) | _bit(e[1][x + 1], m, 15)
        out[x] = np.uint16(bits)


@inline
def add_costs(
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
            first = np.int32(BLIND)
        if place < np.int32(1) or place > most:
            second = np.int32(BLIND)
        total[x] += np.int32(8) * first + part[x] * np.int32(second - first)


@inline
def into_columns(stride: Any, shift: Any, part: Any, at: Any) -> None:
    """Split eighths of pixels in `part`: column ``stride * x + shift`` less the whole pixels, and what is left."""
    for x in range(at.size):
        at[x] = np.int32(np.int32(stride * x) + shift) - (part[x] >> np.int32(3))
    for x in range(at.size):
        part[x] &= np.int32(7)


@inline
def eighths(row: Any, first: Any, stride: Any, part: Any) -> None:
    """Write every `stride`-th value of a row, from `first` on, in eighths of pixels, rounded."""
    for x in range(part.size):
        part[x] = np.int32(np.floor(row[stride * x + first] * np.float32(8) + np.float32(0.5)))
