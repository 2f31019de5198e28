"""The CUDA twin of `stereokit.aggregation.dt`: the same fixed point and the same floats, so equal bit for bit.

A recursion along a line has no parallelism within the line, but every line and every level is on its own: a thread
owns four levels (a word of the cost volume) of one row or column and walks it there and back. Neighbouring threads
own neighbouring words, so that each step of a warp reads whole lines of memory, and no thread waits for another.

The way back needs what the way there computed, in 16 bits. That is not stored: the first walk leaves marks, its state
after every `SEGMENT` pixels, and on the way back each segment is walked again from its mark into registers. A line is
read twice and written once, a byte per cell, and the marks are a quarter of a byte per cell.

The columns of the last pass end in 16 bits, which bytes do not hold. Up to 128 levels lie in the registers of one
warp, which selects as it walks up; more are written for a band of columns, which selection takes before the next. So
there is no volume but the costs' own. ``mode="sum"`` is in `stereokit.aggregation.dt_sum_cuda`.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from stereokit.aggregation._lines_cuda import SEGMENT, bands, marks_of, weights
from stereokit.aggregation.dt import Dt
from stereokit.aggregation.dt_sum_cuda import aggregate_sum
from stereokit.costs.rows import Cost
from stereokit.cuda.kernel import (
    Kernel,
    Queue,
    array,
    blocks_for,
    cuda,
    device,
    f32,
    i16,
    i32,
    kernel,
    store2,
    u16,
    u32,
)
from stereokit.selection.wta_cuda import RULES, Maps, select, selector

__all__ = ["aggregate"]

_FRACTION_BITS = 6
_SEGMENT_WORDS = 2 * SEGMENT  # words of a thread: each has two costs of 16 bits


@device
def _there(value, before, weight):  # type: ignore[no-untyped-def]
    """Return the next state on the way there: fixed point, rounded down, as the high product of the CPU is."""
    return i32(value + i32(i32(i32(before - value) * weight) >> i32(15)))


@device
def _back(value, before, weight):  # type: ignore[no-untyped-def]
    """Return the next state on the way back, rounded up."""
    return i32(value - i32(i32(i32(value - before) * weight) >> i32(15)))


@device
def _pack(value, shift, place):  # type: ignore[no-untyped-def]
    """Round to what a byte holds: half a step is added; the largest cost, 255, must not pass the byte."""
    half = i32(i32(i32(1) << shift) >> i32(1))
    return u32(u32(min(i32(i32(value + half) >> shift), i32(255))) << u32(8 * place))


@device
def _pair(low, high):  # type: ignore[no-untyped-def]
    return u32(u32(low) | u32(u32(high) << u32(16)))


@device
def _apart(ab, cd):  # type: ignore[no-untyped-def]
    return i32(ab & u32(0xFFFF)), i32(ab >> u32(16)), i32(cd & u32(0xFFFF)), i32(cd >> u32(16))


@device
def _step(state, word, weight, fraction):  # type: ignore[no-untyped-def]
    """Return the state of four levels one pixel on; costs of a word get `fraction` fractional bits."""
    a = i32(i32(word & u32(255)) << fraction)
    b = i32(i32(u32(word >> u32(8)) & u32(255)) << fraction)
    c = i32(i32(u32(word >> u32(16)) & u32(255)) << fraction)
    d = i32(i32(word >> u32(24)) << fraction)
    return (
        _there(a, state[0], weight),
        _there(b, state[1], weight),
        _there(c, state[2], weight),
        _there(d, state[3], weight),
    )


@device
def _leave_marks(volume, weights, marks, thread, threads, start, step, count, quad, quads, fraction):  # type: ignore[no-untyped-def]
    """Walk a line there but for its last segment, and return where that begins."""
    state = i32(0), i32(0), i32(0), i32(0)
    segment = u32(0)
    mark = thread
    while u32(segment + u32(SEGMENT)) < count:
        for k in range(SEGMENT):
            pixel = u32(start + u32(u32(segment + u32(k)) * step))
            state = _step(state, volume[u32(u32(pixel * quads) + quad)], i32(weights[pixel]), fraction)
        store2(marks, u32(mark * u32(2)), (_pair(state[0], state[1]), _pair(state[2], state[3])))
        mark = u32(mark + threads)
        segment = u32(segment + u32(SEGMENT))
    return segment


@device
def _walk_again(volume, weights, marks, steps, thread, threads, start, step, count, quad, quads, fraction, segment):  # type: ignore[no-untyped-def]
    """Walk one segment there, from its mark, and hold what it computes; pixels past the line's end repeat the last."""
    state = i32(0), i32(0), i32(0), i32(0)
    if segment > u32(0):
        mark = u32(u32(u32(u32(segment // u32(SEGMENT)) - u32(1)) * threads) + thread)
        state = _apart(marks[u32(mark * u32(2))], marks[u32(u32(mark * u32(2)) + u32(1))])
    last = u32(count - u32(1))
    for k in range(SEGMENT):
        pixel = u32(start + u32(min(u32(segment + u32(k)), last) * step))
        state = _step(state, volume[u32(u32(pixel * quads) + quad)], i32(weights[pixel]), fraction)
        steps[2 * k] = _pair(state[0], state[1])
        steps[2 * k + 1] = _pair(state[2], state[3])


@device
def _step_back(state, steps, k, weight):  # type: ignore[no-untyped-def]
    a, b, c, d = _apart(steps[2 * k], steps[2 * k + 1])
    return (
        _back(a, state[0], weight),
        _back(b, state[1], weight),
        _back(c, state[2], weight),
        _back(d, state[3], weight),
    )


@device
def _weight_back(weights, start, step, n, count):  # type: ignore[no-untyped-def]
    """Return the feedback from pixel n + 1; none into the line's last pixel and what stands for pixels past it."""
    weight = i32(0)
    if u32(n + u32(1)) < count:
        weight = i32(weights[u32(start + u32(u32(n + u32(1)) * step))])
    return weight


def _walker(finish: Any) -> Any:
    """Return the helper that walks a line there and back.

    On the way back it hands every pixel to ``finish(state, n, target)``, from the last to the first; `n` may lie past
    the line's end, and `target` is whatever the kernel gave for it.
    """

    @device
    def walk(volume, weights, marks, thread, threads, start, step, count, quad, quads, fraction, target):  # type: ignore[no-untyped-def]
        segment = _leave_marks(volume, weights, marks, thread, threads, start, step, count, quad, quads, fraction)
        steps = cuda.local.array(_SEGMENT_WORDS, u32)
        state = i32(0), i32(0), i32(0), i32(0)
        more = True
        while more:
            _walk_again(
                volume, weights, marks, steps, thread, threads, start, step, count, quad, quads, fraction, segment
            )
            for j in range(SEGMENT):
                k = SEGMENT - 1 - j
                n = u32(segment + u32(k))
                state = _step_back(state, steps, k, _weight_back(weights, start, step, n, count))
                finish(state, n, target)
            more = segment > u32(0)
            segment = u32(segment - u32(SEGMENT))

    return walk


@device
def _write_bytes(state, n, target):  # type: ignore[no-untyped-def]
    volume, start, step, count, quad, quads, shift = target
    if n < count:
        low = u32(_pack(state[0], shift, 0) | _pack(state[1], shift, 1))
        high = u32(_pack(state[2], shift, 2) | _pack(state[3], shift, 3))
        volume[u32(u32(u32(start + u32(n * step)) * quads) + quad)] = u32(low | high)


@device
def _write_totals(state, n, target):  # type: ignore[no-untyped-def]
    totals, thread, threads, count = target
    if n < count:
        to = u32(u32(n * threads) + thread)
        store2(totals, u32(to * u32(2)), (_pair(state[0], state[1]), _pair(state[2], state[3])))


_walk_bytes = _walker(_write_bytes)
_walk_totals = _walker(_write_totals)


@kernel(array(u32), array(i16), array(u32), *[u32] * 5, i32, i32)
def dt_walk_bytes(volume, weights, marks, lines, count, pitch, step, quads, fraction, shift):  # type: ignore[no-untyped-def]
    """Filter lines in place; pixel n of line k is ``k * pitch + n * step``."""
    thread = u32(cuda.grid(1))
    threads = u32(lines * quads)
    if thread < threads:
        line = u32(thread // quads)
        quad = u32(thread - u32(line * quads))
        start = u32(line * pitch)
        target = volume, start, step, count, quad, quads, shift
        _walk_bytes(volume, weights, marks, thread, threads, start, step, count, quad, quads, fraction, target)


@kernel(array(u32), array(i16), array(u32), array(u32), *[u32] * 5, i32)
def dt_walk_totals(volume, weights, marks, totals, height, width, x0, band, quads, fraction):  # type: ignore[no-untyped-def]
    """Filter the columns x0 to x0 + band into ``(height, band, 4 * quads)`` totals of 16 bits."""
    thread = u32(cuda.grid(1))
    threads = u32(band * quads)
    if thread < threads:
        line = u32(thread // quads)
        quad = u32(thread - u32(line * quads))
        start = u32(x0 + line)
        target = totals, thread, threads, height
        _walk_totals(volume, weights, marks, thread, threads, start, width, height, quad, quads, fraction, target)


@cache
def select_kernel(padded: int) -> Kernel:
    """Return the kernel that filters all columns and selects, for 32, 64 or 128 levels."""
    quads = padded // 4
    choose = selector(padded, False)
    maps = array(f32), array(u16), array(f32), *RULES

    @device
    def write_winner(state, n, target):  # type: ignore[no-untyped-def]
        values, lane, start, alive, height, width, disparity, cost, confidence, rules = target
        levels, minimum, subpixel, uniqueness, detail = rules
        values[0], values[1], values[2], values[3] = state
        choose(
            values, lane, u32(start + u32(n * width)), alive and n < height, disparity, cost, confidence,
            levels, minimum, subpixel, uniqueness, detail,
        )  # fmt: skip

    walk = _walker(write_winner)

    @kernel(array(u32), array(i16), array(u32), u32, u32, i32, *maps, name=f"dt_walk_select_{padded}")
    def walk_select(  # type: ignore[no-untyped-def]
        volume, weights, marks, height, width, fraction, disparity, cost, confidence,
        levels, minimum, subpixel, uniqueness, detail,
    ):  # fmt: skip
        """Lanes past the last column walk it too, so that warps stay whole, but leave their marks elsewhere."""
        thread = u32(cuda.grid(1))
        threads = u32(cuda.gridsize(1))
        line = u32(thread // u32(quads))
        quad = u32(thread - u32(line * u32(quads)))
        start = min(line, u32(width - u32(1)))
        values = cuda.local.array(4, i32)
        rules = levels, minimum, subpixel, uniqueness, detail
        lane = i32(thread & u32(31))
        target = values, lane, start, line < width, height, width, disparity, cost, confidence, rules
        walk(volume, weights, marks, thread, threads, start, width, height, quad, u32(quads), fraction, target)

    result: Kernel = walk_select
    return result


for _padded in (32, 64, 128):
    select_kernel(_padded)


def aggregate(
    queue: Queue, dt: Dt, cost: Cost, costs: Any, guide: Any, shape: tuple[int, int], padded: int, maps: Maps
) -> None:
    """Aggregate a volume of costs and select.

    Parameters
    ----------
    queue : Queue
        Queue of launches.
    dt : Dt
        Options.
    cost : Cost
        Cost of the volume.
    costs : (H * W * padded / 4,) uint32
        The volume (`stereokit.costs.rows_cuda`); overwritten.
    guide : (H * W,) uint8
        The left image, whose edges costs do not cross.
    shape : (int, int)
        Height and width, pixels.
    padded : int
        Levels of the volume.
    maps : Maps
        Maps of the selection.
    """
    if dt.mode == "sum":
        aggregate_sum(queue, dt, cost.cost_max, costs, guide, shape, padded, maps)
        return
    height, width = shape
    words = padded // 4
    line_marks = max(
        blocks_for(height * words, 128) * marks_of(width), blocks_for(width * words, 128) * marks_of(height)
    )
    marks = queue.array("dt.marks", max(2, 2 * 128 * line_marks), np.uint32)
    row_blocks, column_blocks = (blocks_for(lines * words, 128) for lines in shape)
    fraction = _FRACTION_BITS
    for number in range(dt.passes):
        rows, columns, shift = weights(queue, dt, cost.cost_max, number, guide, shape)
        queue.launch(dt_walk_bytes, row_blocks, costs, rows, marks, height, width, width, 1, words, fraction, shift)
        fraction = shift
        if number < dt.passes - 1:
            queue.launch(
                dt_walk_bytes, column_blocks, costs, columns, marks, width, height, 1, width, words, fraction, shift
            )
        elif padded <= 128:
            queue.launch(select_kernel(padded), column_blocks, costs, columns, marks, height, width, fraction, *maps)
        else:
            _select_bands(queue, costs, columns, marks, shape, padded, fraction, maps)


def _select_bands(
    queue: Queue, costs: Any, columns: Any, marks: Any, shape: tuple[int, int], padded: int, fraction: int, maps: Maps
) -> None:
    height, width = shape
    words = padded // 4
    parts = bands(width, 2 * height * padded)
    totals = queue.array("dt.totals", height * max(band for _, band in parts) * words * 2, np.uint32)
    for x0, band in parts:
        blocks = blocks_for(band * words, dt_walk_totals.block)
        queue.launch(dt_walk_totals, blocks, costs, columns, marks, totals, height, width, x0, band, words, fraction)
        select(queue, queue.view(totals, np.uint16), False, x0, band, shape, padded, maps)
