"""CUDA twin of `stereokit.costs.zncc`: the same integers and the same two rounded factors, so the same costs.

Images are centred and brought into range with borders clamped, window sums and variances are taken from them, and
a third kernel slides: a thread has four levels of a strip of a row, keeps their sums over the columns of the window
in registers, and takes one column in and one out at each pixel. Of a column it multiplies `window` pixels with each of
the four right ones, which move on by one level from column to column. So the work of a cell grows with the window's
side, not with its area; see `stereokit.costs.rows_cuda` for the layout.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from stereokit.costs.rows_cuda import EVIDENCE, DevicePair, apply_border, masked_cost, padding
from stereokit.costs.zncc import Zncc
from stereokit.cuda.kernel import Kernel, Queue, array, blocks_for, cuda, f32, i16, i32, kernel, u32
from stereokit.errors import DeviceError
from stereokit.images.prepare_cuda import KINDS, clamped, ranges

__all__ = ["LARGEST_WINDOW", "centre_kernel", "check", "costs_kernel", "statistics", "volume"]

LARGEST_WINDOW = 11
"""Side of the largest window whose sums fit the registers."""

STRIP = 64
"""Pixels of a row that a thread takes one after the other."""

_PART = 16
"""The same for the statistics, whose rows are many fewer."""


@cache
def centre_kernel(dtype: np.dtype[Any]) -> Kernel:
    """Return the kernel that writes ``(image - middle) * factor``, rounded, with `half` border pixels around.

    Element k of a row is column ``first - half + k``; there are `columns` of them and the borders.
    """
    kind = KINDS[dtype]
    types = array(kind), i32, array(i32), i32, i32, i32, i32, i32, i32, array(i16)

    @kernel(*types, block=128, name=f"zncc_centre_{dtype}")
    def zncc_centre(  # type: ignore[no-untyped-def]
        images, place, extremes, range_max, half, first, columns, height, width, out
    ):
        at = u32(cuda.grid(1))
        stride = u32(columns + i32(2) * half)
        row = i32(at // stride)
        if row < height + i32(2) * half:
            x = clamped(i32(at % stride) + first - half, width - 1)
            y = u32(u32(place) * u32(height) + u32(clamped(row - half, height - 1)))
            low = extremes[u32(u32(2) * u32(place))]
            high = extremes[u32(u32(2) * u32(place) + u32(1))]
            middle = i32(i32(low + high) >> i32(1))
            span = i32(max(i32(high - low), i32(1)))
            factor = min(f32(1), f32(f32(range_max) / f32(span)))
            pixel = min(max(i32(images[u32(y * u32(width) + u32(x))]), low), high)  # of a window it may leave the range
            value = f32(f32(i32(pixel - middle)) * factor)
            out[at] = i16(cuda.libdevice.float2int_rn(value))

    result: Kernel = zncc_centre
    return result


@kernel(array(i16), i32, i32, i32, i32, array(i32), array(f32), block=128)
def zncc_statistics(image, window, scale, columns, height, sums, scales):  # type: ignore[no-untyped-def]
    """Window sums and ``scale / sqrt(variance)`` of the pixels of a centred image, strips of a row to a thread."""
    at = u32(cuda.grid(1))
    parts = u32(u32(columns + i32(_PART - 1)) // u32(_PART))
    y = i32(at // parts)
    if y < height:
        x0 = i32(u32(at % parts) * u32(_PART))
        stride = u32(columns + window - i32(1))
        total, square = i32(0), i32(0)
        for c in range(x0, min(i32(x0 + i32(_PART)), columns) + window - i32(1)):
            x = i32(i32(c) - window + i32(1))  # the pixel whose window ends with this column
            for j in range(window):
                row = u32(u32(u32(y) + u32(j)) * stride)
                new = i32(image[u32(row + u32(c))])
                total = i32(total + new)
                square = i32(square + i32(new * new))
                if x > x0:
                    old = i32(image[u32(row + u32(x) - u32(1))])
                    total = i32(total - old)
                    square = i32(square - i32(old * old))
            if x >= x0:
                variance = i32(i32(i32(window * window) * square) - i32(total * total))
                root = cuda.libdevice.fsqrt_rn(f32(max(variance, i32(1))))
                to = u32(u32(u32(y) * u32(columns)) + u32(x))
                sums[to] = total
                scales[to] = f32(f32(scale) / root) if variance > 0 else f32(0)


@cache
def costs_kernel(window: int, masked: bool) -> Kernel:
    """Return the kernel that writes the volume of costs of a window of `window` pixels square."""
    held_columns = 4 * window
    newest = held_columns - 4
    images = array(i16), array(i32), array(f32)
    name = f"zncc_costs_{window}" + "_masked" * masked

    @kernel(*images, *images, i32, array(u32), *EVIDENCE, block=128, name=name)
    def zncc_costs(  # type: ignore[no-untyped-def]
        left, left_sum, left_scale, right, right_sum, right_scale, steps, volume,
        bad, height, width, span, count, minimum, border_cost, clamp_border,
    ):  # fmt: skip
        at = u32(cuda.grid(1))
        strips = u32(u32(width + i32(STRIP - 1)) // u32(STRIP))
        word = u32(at % u32(span))
        line = u32(at // u32(span))
        y = i32(line // strips)
        if y < height:
            x0 = i32(u32(line % strips) * u32(STRIP))
            level = i32(u32(4) * word)
            pads = padding(level, count)
            reach = u32(u32(width) + u32(4) * u32(span) - u32(1))
            ahead = u32(i32(4) * span - i32(1) - level)  # element of the right image less column of the left one
            left_row = u32(u32(u32(y) * u32(width + i32(window - 1))) + u32(x0))
            right_row = u32(u32(u32(y) * u32(reach + u32(window - 1))) + u32(x0) + ahead)
            columns = cuda.local.array(held_columns, i32)
            pixels = cuda.local.array(held_columns, i32)
            totals = cuda.local.array(4, i32)
            sums = cuda.local.array(4, i32)
            scales = cuda.local.array(4, f32)
            for k in range(held_columns):
                columns[k] = i32(0)
            for j in range(window):
                for k in range(1, 4):
                    there = u32(right_row + u32(u32(j) * u32(reach + u32(window - 1))) - u32(k))
                    pixels[4 * j + k - 1] = i32(right[there])
            for k in range(4):
                totals[k] = i32(0)
                sums[k] = i32(0)
                scales[k] = f32(0)
            for k in range(1, 4):
                there = u32(u32(u32(y) * reach) + u32(x0) + ahead - u32(k))
                sums[k - 1] = right_sum[there]
                scales[k - 1] = right_scale[there]
            for step in range(min(i32(STRIP), i32(width - x0)) + i32(window - 1)):
                for k in range(4):
                    totals[k] = i32(totals[k] - columns[k])
                for k in range(newest):
                    columns[k] = columns[k + 4]
                for k in range(4):
                    columns[newest + k] = i32(0)
                for j in range(window):
                    for k in range(3):
                        pixels[4 * j + 3 - k] = pixels[4 * j + 2 - k]
                    there = u32(right_row + u32(u32(j) * u32(reach + u32(window - 1))) + u32(step))
                    pixels[4 * j] = i32(right[there])
                    left_pixel = i32(left[u32(left_row + u32(u32(j) * u32(width + i32(window - 1))) + u32(step))])
                    for k in range(4):
                        gain = i32(left_pixel * pixels[4 * j + k])
                        columns[newest + k] = i32(columns[newest + k] + gain)
                for k in range(4):
                    totals[k] = i32(totals[k] + columns[newest + k])
                x = i32(x0 + i32(step) - i32(window - 1))
                if x >= x0:
                    pixel = u32(u32(u32(y) * u32(width)) + u32(x))
                    there = u32(u32(u32(y) * reach) + u32(x) + ahead)
                    for k in range(3):
                        sums[3 - k] = sums[2 - k]
                        scales[3 - k] = scales[2 - k]
                    sums[0] = right_sum[there]
                    scales[0] = right_scale[there]
                    window_sum = left_sum[pixel]
                    scale = left_scale[pixel]
                    packed = pads
                    for k in range(4):
                        numerator = i32(i32(i32(window * window) * totals[k]) - i32(window_sum * sums[k]))
                        rho = f32(f32(f32(numerator) * scales[k]) * scale)
                        cost = i32(steps - max(i32(cuda.libdevice.float2int_rn(rho)), i32(0)))
                        column = i32(x - level - i32(k) - minimum)
                        cost = apply_border(cost, column, width, border_cost, clamp_border)
                        if masked:
                            cost = masked_cost(cost, column, y, x, bad, height, width, border_cost)
                        packed = u32(packed | u32(u32(cost) << u32(8 * k)))
                    volume[u32(u32(pixel * u32(span)) + word)] = packed

    result: Kernel = zncc_costs
    return result


for _dtype in KINDS:
    centre_kernel(_dtype)
for _window in range(3, LARGEST_WINDOW + 1, 2):
    costs_kernel(_window, False)
    costs_kernel(_window, True)


def statistics(
    queue: Queue, cost: Zncc, pair: DevicePair, extremes: Any, place: int, first: int, columns: int, scale: int
) -> tuple[Any, Any, Any]:
    """Return a centred image with its borders, the window sums of its pixels, and ``scale / sqrt(variance)``."""
    height, width, half = pair.height, pair.width, cost.window // 2
    side = ("left", "right")[place]
    size = (height + 2 * half) * (columns + 2 * half)
    image = queue.array(f"zncc.{side}", size, np.int16)
    sums = queue.array(f"zncc.{side}_sum", height * columns, np.int32)
    scales = queue.array(f"zncc.{side}_scale", height * columns, np.float32)
    centre = centre_kernel(pair.dtype)
    shape = half, first, columns, height, width
    queue.launch(centre, blocks_for(size, centre.block), pair.images, place, extremes, cost.range_max, *shape, image)
    blocks = blocks_for(height * math.ceil(columns / _PART), zncc_statistics.block)
    queue.launch(zncc_statistics, blocks, image, cost.window, scale, columns, height, sums, scales)
    return image, sums, scales


def check(cost: Zncc) -> None:
    """Raise DeviceError if the window is larger than `LARGEST_WINDOW`."""
    if cost.window > LARGEST_WINDOW:
        raise DeviceError(f"window of zncc must be at most {LARGEST_WINDOW} on device 'cuda', got {cost.window}")


def volume(queue: Queue, cost: Zncc, pair: DevicePair) -> Any:
    """Return the volume of costs of a pair, flat words on the device (`stereokit.costs.rows_cuda`).

    Raises
    ------
    DeviceError
        If the window is larger than `LARGEST_WINDOW`.
    """
    check(cost)
    height, width = pair.height, pair.width
    if pair.ranges is None:
        extremes = ranges(queue, pair.images, pair.dtype, height * width)
    else:
        extremes = queue.upload("zncc.ranges", np.array(pair.ranges, np.int32))
    first = -pair.levels.minimum - (pair.padded - 1)
    left = statistics(queue, cost, pair, extremes, 0, 0, width, cost.steps)
    right = statistics(queue, cost, pair, extremes, 1, first, pair.reach, 1)
    out = queue.array("costs", height * width * pair.padded // 4, np.uint32)
    costs = costs_kernel(cost.window, pair.masked)
    threads = height * -(-width // STRIP) * pair.padded // 4
    evidence = pair.evidence(cost.cost_max)
    queue.launch(costs, blocks_for(threads, costs.block), *left, *right, cost.steps, out, *evidence)
    return out
