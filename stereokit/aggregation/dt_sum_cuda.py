"""The ``sum`` form of the CUDA domain transform: floats, for one band of columns at a time.

The sums are not bounded, so that neither bytes nor 16 bits hold them. Rows are walked to the right once, which leaves
marks only; then, from the right, the rows of a band are walked back into a volume of the band, the band's columns are
walked down and up in it, and selection takes it. A thread owns one level of a line. Products and sums are rounded
one by one, as on the CPU.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.aggregation._lines_cuda import SEGMENT, bands, marks_of, weights
from stereokit.aggregation.dt import Dt
from stereokit.cuda.kernel import Queue, array, blocks_for, cuda, device, f32, kernel, u8, u32
from stereokit.selection.wta_cuda import Maps, select

__all__ = ["aggregate_sum"]


@device
def _feed(value, before, weight):  # type: ignore[no-untyped-def]
    """Return ``value + weight * before``."""
    return cuda.libdevice.fadd_rn(value, cuda.libdevice.fmul_rn(weight, before))


@device
def _leave_marks(values, weights, marks, thread, threads, first, stride, start, step, count):  # type: ignore[no-untyped-def]
    """Walk a line there but for its last segment, and return where that begins.

    Its values lie at ``first + n * stride`` and their feedback at ``start + n * step``.
    """
    a = f32(0)
    segment = u32(0)
    while u32(segment + u32(SEGMENT)) < count:
        for k in range(SEGMENT):
            n = u32(segment + u32(k))
            a = _feed(f32(values[u32(first + u32(n * stride))]), a, weights[u32(start + u32(n * step))])
        marks[u32(u32(u32(segment // u32(SEGMENT)) * threads) + thread)] = a
        segment = u32(segment + u32(SEGMENT))
    return segment


@device
def _walk_again(values, weights, marks, steps, thread, threads, first, stride, start, step, last, segment):  # type: ignore[no-untyped-def]
    """Walk one segment there, from its mark, and hold what it computes; past `last` that one is repeated."""
    a = f32(0)
    if segment > u32(0):
        a = marks[u32(u32(u32(u32(segment // u32(SEGMENT)) - u32(1)) * threads) + thread)]
    for k in range(SEGMENT):
        n = min(u32(segment + u32(k)), last)
        a = _feed(f32(values[u32(first + u32(n * stride))]), a, weights[u32(start + u32(n * step))])
        steps[k] = a


@device
def _weight_back(weights, start, step, n, count):  # type: ignore[no-untyped-def]
    """Return the feedback from pixel n + 1; none into the line's last pixel."""
    weight = f32(0)
    if u32(n + u32(1)) < count:
        weight = weights[u32(start + u32(u32(n + u32(1)) * step))]
    return weight


@kernel(array(u8), array(f32), array(f32), u32, u32, u32, name="dt_sum_marks")
def _sum_marks(costs, weights, marks, height, width, levels):  # type: ignore[no-untyped-def]
    """Walk all rows to the right and leave the marks; a thread owns one level of a row."""
    thread = u32(cuda.grid(1))
    threads = u32(height * levels)
    if thread < threads:
        line = u32(thread // levels)
        start = u32(line * width)
        first = u32(u32(start * levels) + u32(thread - u32(line * levels)))
        _leave_marks(costs, weights, marks, thread, threads, first, levels, start, u32(1), width)


@kernel(array(u8), array(f32), array(f32), array(f32), array(f32), *[u32] * 5, name="dt_sum_rows")
def _sum_rows(costs, weights, marks, state, out, height, width, x0, band, levels):  # type: ignore[no-untyped-def]
    """Walk back the columns x0 to x0 + band of all rows; `state` is what the band to the right ended with."""
    thread = u32(cuda.grid(1))
    threads = u32(height * levels)
    if thread >= threads:
        return
    line = u32(thread // levels)
    level = u32(thread - u32(line * levels))
    start = u32(line * width)
    first = u32(u32(start * levels) + level)
    end = u32(x0 + band)
    last = u32(end - u32(1))
    b = f32(0)
    if end < width:
        b = state[thread]
    steps = cuda.local.array(SEGMENT, f32)
    segment = u32(x0 + u32(u32(u32(band - u32(1)) // u32(SEGMENT)) * u32(SEGMENT)))
    more = True
    while more:
        _walk_again(costs, weights, marks, steps, thread, threads, first, levels, start, u32(1), last, segment)
        for j in range(SEGMENT):
            k = SEGMENT - 1 - j
            x = u32(segment + u32(k))
            if x <= last:
                b = _feed(steps[k], b, _weight_back(weights, start, u32(1), x, width))
                out[u32(u32(u32(u32(line * band) + u32(x - x0)) * levels) + level)] = b
        more = segment > x0
        segment = u32(segment - u32(SEGMENT))
    state[thread] = b


@kernel(array(f32), array(f32), array(f32), *[u32] * 5, name="dt_sum_columns")
def _sum_columns(totals, weights, marks, height, width, x0, band, levels):  # type: ignore[no-untyped-def]
    """Walk the columns of a band down and up, in place; a thread owns one level of a column."""
    thread = u32(cuda.grid(1))
    threads = u32(band * levels)
    if thread >= threads:
        return
    start = u32(x0 + u32(thread // levels))
    last = u32(height - u32(1))
    segment = _leave_marks(totals, weights, marks, thread, threads, thread, threads, start, width, height)
    steps = cuda.local.array(SEGMENT, f32)
    b = f32(0)
    more = True
    while more:
        _walk_again(totals, weights, marks, steps, thread, threads, thread, threads, start, width, last, segment)
        for j in range(SEGMENT):
            k = SEGMENT - 1 - j
            y = u32(segment + u32(k))
            if y <= last:
                b = _feed(steps[k], b, _weight_back(weights, start, width, y, height))
                totals[u32(u32(y * threads) + thread)] = b
        more = segment > u32(0)
        segment = u32(segment - u32(SEGMENT))


def aggregate_sum(
    queue: Queue, dt: Dt, cost_max: int, costs: Any, guide: Any, shape: tuple[int, int], padded: int, maps: Maps
) -> None:
    """Aggregate a volume of costs and select; parameters as of `stereokit.aggregation.dt_cuda.aggregate`."""
    height, width = shape
    costs = queue.view(costs, np.uint8)
    rows, columns, _ = weights(queue, dt, cost_max, 0, guide, shape)
    line_threads = height * padded
    parts = bands(width, 4 * line_threads)
    widest = max(band for _, band in parts)
    marks = queue.array("dt.sum.marks", max(1, line_threads * marks_of(width)), np.float32)
    column_marks = queue.array("dt.sum.column_marks", max(1, widest * padded * marks_of(height)), np.float32)
    state = queue.array("dt.sum.state", line_threads, np.float32)
    totals = queue.array("dt.sum.totals", widest * line_threads, np.float32)
    blocks = blocks_for(line_threads, _sum_marks.block)
    queue.launch(_sum_marks, blocks, costs, rows, marks, height, width, padded)
    for x0, band in reversed(parts):
        queue.launch(_sum_rows, blocks, costs, rows, marks, state, totals, height, width, x0, band, padded)
        column_blocks = blocks_for(band * padded, _sum_columns.block)
        queue.launch(_sum_columns, column_blocks, totals, columns, column_marks, height, width, x0, band, padded)
        select(queue, totals, True, x0, band, shape, padded, maps)
