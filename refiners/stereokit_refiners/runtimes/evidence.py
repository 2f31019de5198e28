"""The values that `stereokit_refiners.networks.evidence.Evidence` weighs, and their evidence: compiled loops over rows.

All maps are held relative to a whole number of pixels below all of them, in steps of 1/256 of a coarse pixel. Then
upscaling and differences are exact (for ranges up to some thousand pixels), and a constant that is added to all
disparities changes no bit of the input. Rows do not depend on one another, so that the result does not depend on how
they are shared out between threads; all operations are on integers or single IEEE ones in a fixed order.

Evidence stands on a grid of half the size: each 2x2 pixels are judged by two of them, the first and the last. Loops
that fetch from places that the data names are kept apart from those that compute, which become vector code everywhere.
A thread goes down its rows once; what it needs of the rows around stays in the caches.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.threads import run, spans
from stereokit.kernels.workspace import Workspace
from stereokit_refiners.networks.evidence import VALUES
from stereokit_refiners.runtimes.evidence_rows import (
    REACH,
    add_costs,
    census_phase,
    census_row,
    eighths,
    extreme_row,
    fixed_row,
    into_columns,
    smooth_row,
    spread_row,
    upscaled_row,
)

__all__ = ["MOST_GAIN", "MULTIPLE", "Hypotheses", "hypotheses"]

MULTIPLE = 32
"""Rows and columns of full size are extended to a multiple of this."""
MOST_GAIN = 127
"""Eighths of a bit."""

_STEPS = np.float32(256)  # of a coarse pixel
_MAP_ROWS, _IMAGE_ROWS = 16, 8  # that are kept: powers of two, of which ten and five are needed at a time


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
    sums : (3, H/4, W/4) float32
        Means over 4x4 of the grey levels, of their squares, and of the coarse map.
    """

    base: int
    step: int
    coarse: NDArray[np.float32]
    half: NDArray[np.float32]
    others: NDArray[np.float32]
    cost: NDArray[np.uint8]
    gains: NDArray[np.int8]
    sums: NDArray[np.float32]

    @property
    def apart(self) -> int:
        """How far "less" and "more" are from the coarse map, full-size pixels."""
        return 2 if self.step == 4 else 1


class _Lines(NamedTuple):
    """Buffers of one thread; `near`, `even`, `odd` and `right` keep the last rows."""

    near: NDArray[np.float32]
    reach: NDArray[np.float32]
    map: NDArray[np.float32]
    image: NDArray[np.uint16]
    smooth: NDArray[np.uint16]
    even: NDArray[np.uint16]
    odd: NDArray[np.uint16]
    right: NDArray[np.uint16]
    census: NDArray[np.uint16]
    mine: NDArray[np.uint32]
    pairs: NDArray[np.uint32]
    differing: NDArray[np.uint32]
    at: NDArray[np.int32]
    part: NDArray[np.int32]
    totals: NDArray[np.int32]
    sums: NDArray[np.int32]


def _lines(height: int, width: int, step: int, workspace: Workspace) -> _Lines:
    half, coarse = width // 2, width // step
    array = workspace.array
    return _Lines(
        array("near", (_MAP_ROWS, coarse), np.float32),
        array("reach", coarse + 2 * REACH, np.float32),
        array("map", coarse, np.float32),
        array("image", width + 6, np.uint16),
        array("smooth", width + 4, np.uint16),
        array("even", (_IMAGE_ROWS, half + 2), np.uint16),
        array("odd", (_IMAGE_ROWS, half + 2), np.uint16),
        array("right", (_IMAGE_ROWS, width + 4), np.uint16),
        array("census", width, np.uint16),
        array("mine", (2, half), np.uint32),
        array("pairs", (2, width + 1), np.uint32),
        array("differing", half, np.uint32),
        array("at", half, np.int32),
        array("part", half, np.int32),
        array("totals", (len(VALUES), half), np.int32),
        array("sums", (2, width), np.int32),
    )


class _Pair(NamedTuple):
    """What comes in."""

    disparity: NDArray[np.float32]
    candidates: NDArray[np.float32]
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]


class _Found(NamedTuple):
    """The arrays of `Hypotheses`."""

    coarse: NDArray[np.float32]
    half: NDArray[np.float32]
    others: NDArray[np.float32]
    cost: NDArray[np.uint8]
    gains: NDArray[np.int8]
    sums: NDArray[np.float32]


def hypotheses(
    disparity: NDArray[np.float32], candidates: NDArray[np.float32], left: NDArray[np.uint8],
    right: NDArray[np.uint8], step: int, threads: int = 1, workspace: Workspace | None = None,
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
    workspace : Workspace, optional
        Has the arrays of the result, which its next use writes over; None takes new ones.

    Returns
    -------
    Hypotheses
        At the size of the images, extended to multiples of `MULTIPLE`.
    """
    workspace = Workspace() if workspace is None else workspace
    rows, columns = left.shape
    height, width = -(-rows // MULTIPLE) * MULTIPLE, -(-columns // MULTIPLE) * MULTIPLE
    grid, quarter = (height // 2, width // 2), (height // 4, width // 4)
    lowest = int(np.floor(np.floor(disparity.min() * _STEPS + np.float32(0.5)) / _STEPS))
    arrays: Any = map(np.ascontiguousarray, (disparity, candidates, left, right))
    pair = _Pair(*arrays)
    found = _Found(
        workspace.array("coarse", (height, width), np.float32),
        workspace.array("half", grid, np.float32),
        workspace.array("others", (4, *grid), np.float32),
        workspace.array("cost", grid, np.uint8),
        workspace.array("gains", (len(VALUES) - 1, *grid), np.int8),
        workspace.array("sums", (3, *quarter), np.float32),
    )
    values = Hypotheses(lowest * step, step, *found)
    tasks = []
    for k, (y0, y1) in enumerate(spans(quarter[0], threads)):
        lines = _lines(height, width, step, workspace.part(f"lines {k}"))
        tasks.append(partial(_weigh, pair, found, lines, lowest, step, values.apart, y0, y1))
    run(tasks, threads)
    return values


@inline
def _add_maps(pair: Any, lowest: Any, step: Any, first: Any, after: Any, lines: Any) -> None:
    """Keep rows `first` to `after` of the coarse map, made fixed-point; its last row and column go on."""
    for y in range(first, after):
        row = pair.disparity[min(y, pair.disparity.shape[0] - 1)]
        fixed_row(row, np.float32(1), np.float32(lowest), np.float32(step), lines.near[y & (_MAP_ROWS - 1)])


@inline
def _upscale(rows: Any, step: Any, y: Any, lines: Any, out: Any) -> None:
    """Write full-size row y of the coarse map, of so many rows; those around it are kept."""
    near = lines.near
    if step == 1:
        row = near[y & (_MAP_ROWS - 1)]
        for x in range(out.size):
            out[x] = row[x]
        return
    here = y // step
    phase = y - here * step
    beside = here - 1 if 2 * phase < step else here + 1
    share = np.float32(0.75)
    if step == 4:
        share = np.float32(0.875) if phase == 1 or phase == 2 else np.float32(0.625)
    rest = np.float32(1) - share
    a = near[here & (_MAP_ROWS - 1)]
    b = near[min(max(beside, 0), rows - 1) & (_MAP_ROWS - 1)]
    row = lines.map
    for x in range(row.size):
        row[x] = share * a[x] + rest * b[x]
    upscaled_row(row, step, out)


@inline
def _add_others(pair: Any, lowest: Any, step: Any, rows: Any, h: Any, lines: Any, others: Any) -> None:
    """Write row h of the other values."""
    stride = np.float32(2) / np.float32(step)
    at = np.int64(np.float32(h) * stride)
    first = max(at - REACH, 0)
    after = min(at + REACH + 1, rows)
    for k in range(2):
        extreme_row(lines.near, first, after, np.float32(2 * k - 1), lines.reach, lines.map)
        spread_row(lines.map, stride, others[k, h])
        row = pair.candidates[k, min(at, pair.candidates.shape[1] - 1)]
        fixed_row(row, stride, np.float32(lowest), np.float32(step), others[2 + k, h])


@inline
def _smooth_next(image: Any, y: Any, line: Any, out: Any) -> None:
    """Write smoothed row ``y - 2`` of an image, whose borders go on."""
    last = image.shape[0] - 1
    above = image[min(max(y - 3, 0), last)]
    here = image[min(max(y - 2, 0), last)]
    below = image[min(max(y - 1, 0), last)]
    smooth_row(above, here, below, line, out)


@inline
def _add_smooth(pair: Any, y: Any, lines: Any) -> None:
    """Keep smoothed row ``y - 2`` of both images; columns of the left one, from -2 on, by two."""
    slot = y & (_IMAGE_ROWS - 1)
    _smooth_next(pair.right, y, lines.image, lines.right[slot])
    _smooth_next(pair.left, y, lines.image, lines.smooth)
    even = lines.even[slot]
    odd = lines.odd[slot]
    for x in range(even.size):
        even[x] = lines.smooth[2 * x]
    for x in range(odd.size):
        odd[x] = lines.smooth[2 * x + 1]


@inline
def _transform(y: Any, s: Any, lines: Any) -> None:
    """Write the bits of row y: of every second pixel of the left image, from s on, two times; and of the right one.

    There each pixel's bits stand above those of the pixel left of it.
    """
    m = _IMAGE_ROWS - 1
    i, j, k, l, n = y & m, (y + 1) & m, (y + 2) & m, (y + 3) & m, (y + 4) & m  # noqa: E741
    even, odd, right = lines.even, lines.odd, lines.right
    bits = lines.census[: lines.at.size]
    if s == 0:
        a, b, c = (even[i], odd[i]), (even[j], odd[j]), (even[k], odd[k])
        census_phase(a, b, c, (even[l], odd[l]), (even[n], odd[n]), bits)
    else:
        a, b, c = (odd[i], even[i][1:]), (odd[j], even[j][1:]), (odd[k], even[k][1:])
        census_phase(a, b, c, (odd[l], even[l][1:]), (odd[n], even[n][1:]), bits)
    mine = lines.mine[s]
    for x in range(mine.size):
        mine[x] = np.uint32(bits[x]) * np.uint32(0x10001)
    line = lines.census
    census_row(right[i], right[j], right[k], right[l], right[n], line)
    row = lines.pairs[s]
    for x in range(1, line.size):
        row[x] = (np.uint32(line[x]) << np.uint32(16)) | np.uint32(line[x - 1])
    row[0] = np.uint32(line[0]) << np.uint32(16)
    row[line.size] = np.uint32(line[line.size - 1])


@inline
def _compare(found: Any, h: Any, base: Any, apart: Any, columns: Any, lines: Any) -> None:
    """Compare the two images where each value of row h says, and write its cost and gains."""
    at, part, differing, totals = lines.at, lines.part, lines.differing, lines.totals
    width = at.size
    for k in range(totals.shape[0]):
        for x in range(width):
            totals[k, x] = np.int32(0)
    for s in range(2):
        eighths(found.coarse[2 * h + s], s, 2, part)
        into_columns(2, np.int32(s - base), part, at)
        mine, pairs = lines.mine[s], lines.pairs[s]
        add_costs(mine, pairs, at, 0, part, columns, differing, totals[0])
        add_costs(mine, pairs, at, apart, part, columns, differing, totals[1])
        add_costs(mine, pairs, at, -apart, part, columns, differing, totals[2])
    for k in range(4):
        eighths(found.others[k, h], 0, 1, part)
        into_columns(2, np.int32(-base), part, at)
        add_costs(lines.mine[0], lines.pairs[0], at, 0, part, columns, differing, totals[3 + k])
        add_costs(lines.mine[1], lines.pairs[1], at, 1, part, columns, differing, totals[3 + k])
    cost = found.cost[h]
    for x in range(width):
        cost[x] = np.uint8(totals[0, x] >> np.int32(1))
    for k in range(6):
        gain = found.gains[k, h]
        for x in range(width):
            less = (totals[0, x] - totals[k + 1, x]) >> np.int32(1)
            gain[x] = np.int8(min(max(less, np.int32(-MOST_GAIN)), np.int32(MOST_GAIN)))


@inline
def _pool(image: Any, half: Any, y: Any, lines: Any, sums: Any) -> None:
    """Write row y of the means over 4x4; pixels beyond the image's ends repeat its last."""
    rows, columns = image.shape
    last = rows - 1
    a = image[min(4 * y, last)]
    b = image[min(4 * y + 1, last)]
    c = image[min(4 * y + 2, last)]
    d = image[min(4 * y + 3, last)]
    total = lines.sums[0]
    squares = lines.sums[1]
    for x in range(columns):
        i, j, k, l = np.int32(a[x]), np.int32(b[x]), np.int32(c[x]), np.int32(d[x])  # noqa: E741
        total[x] = i + j + k + l
        squares[x] = i * i + j * j + k * k + l * l
    for x in range(columns, total.size):
        total[x] = total[columns - 1]
        squares[x] = squares[columns - 1]
    upper = half[2 * y]
    lower = half[2 * y + 1]
    for x in range(sums.shape[2]):
        t = total[4 * x] + total[4 * x + 1] + total[4 * x + 2] + total[4 * x + 3]
        s = squares[4 * x] + squares[4 * x + 1] + squares[4 * x + 2] + squares[4 * x + 3]
        sums[0, y, x] = np.float32(np.int32(t)) * np.float32(1 / 16)
        sums[1, y, x] = np.float32(np.int32(s)) * np.float32(1 / 16)
        sums[2, y, x] = (upper[2 * x] + lower[2 * x] + upper[2 * x + 1] + lower[2 * x + 1]) * np.float32(0.25)


@kernel
def _weigh(pair: _Pair, found: _Found, lines: _Lines, lowest: int, step: int, apart: int, y0: int, y1: int) -> None:
    """Fill rows y0 to y1 of 4x4 pixels."""
    coarse, half = found.coarse, found.half
    rows = coarse.shape[0] // step  # of the coarse map, extended
    columns = pair.right.shape[1]
    base = lowest * step
    known = max(4 * y0 // step - REACH, 0)  # rows of the coarse map that are kept go up to here
    smoothed = 4 * y0
    for y in range(y0, y1):
        needed = min((4 * y + 3) // step + REACH + 1, rows)
        _add_maps(pair, lowest, step, known, needed, lines)
        known = needed
        for h in range(2 * y, 2 * y + 2):
            for s in range(2):
                while smoothed < 2 * h + s + 5:
                    _add_smooth(pair, smoothed, lines)
                    smoothed += 1
                _transform(2 * h + s, s, lines)
                _upscale(rows, step, 2 * h + s, lines, coarse[2 * h + s])
            upper = coarse[2 * h]
            lower = coarse[2 * h + 1]
            row = half[h]
            for x in range(row.size):
                row[x] = (upper[2 * x] + lower[2 * x] + upper[2 * x + 1] + lower[2 * x + 1]) * np.float32(0.25)
            _add_others(pair, lowest, step, rows, h, lines, found.others)
            _compare(found, h, base, apart, columns, lines)
        _pool(pair.left, half, y, lines, found.sums)
