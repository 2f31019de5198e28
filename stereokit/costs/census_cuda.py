"""CUDA twin of `stereokit.costs.census`: the same bits, the same costs.

One kernel makes the bits, one or two words to a pixel, another one the Hamming distances (see
`stereokit.costs.rows_cuda`). The order of the bits differs from the CPU's, which no distance can see.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from stereokit.costs.census import WINDOWS, Census
from stereokit.costs.rows_cuda import EVIDENCE, DevicePair, apply_border, masked_cost, padding
from stereokit.cuda.kernel import Kernel, Queue, array, blocks_for, cuda, i32, kernel, u32
from stereokit.images.prepare_cuda import KINDS, clamped

__all__ = ["bits_kernel", "costs_kernel", "volume"]

STRIP = 32
"""Pixels of a row that a thread takes one after the other."""


def _words(window: str) -> int:
    across, down = WINDOWS[window]
    return -(-(across * down - 1) // 32)


@cache
def bits_kernel(window: str, dtype: np.dtype[Any]) -> Kernel:
    """Return the kernel that transforms image `place` of a pair, `columns` columns from `first` on."""
    kind = KINDS[dtype]
    across, down = (side // 2 for side in WINDOWS[window])
    words = _words(window)
    count = (2 * across + 1) * (2 * down + 1) - 1
    share = count // words

    @kernel(array(kind), i32, i32, i32, i32, i32, array(u32), block=128, name=f"census_bits_{window}_{dtype}")
    def census_bits(images, place, first, columns, height, width, out):  # type: ignore[no-untyped-def]
        at = u32(cuda.grid(1))
        size = u32(u32(height) * u32(columns))
        if at < size:
            y = i32(at // u32(columns))
            x = i32(i32(at % u32(columns)) + first)
            base = u32(u32(place) * u32(height))
            centre_row = u32(u32(base + u32(y)) * u32(width))
            centre = i32(images[u32(centre_row + u32(clamped(x, width - 1)))])
            bits = u32(0)
            number = 0
            for dy in range(-down, down + 1):
                row = u32(u32(base + u32(clamped(y + dy, height - 1))) * u32(width))
                for dx in range(-across, across + 1):
                    if dy != 0 or dx != 0:
                        other = i32(images[u32(row + u32(clamped(x + dx, width - 1)))])
                        bits = u32(u32(bits << u32(1)) | u32(other < centre))
                        number += 1
                        if words == 2 and number == share:
                            out[u32(size + at)] = bits
                            bits = u32(0)
            out[at] = bits

    result: Kernel = census_bits
    return result


@cache
def costs_kernel(words: int, masked: bool) -> Kernel:
    """Return the kernel that writes the volume of costs from bits of so many words."""
    name = f"census_costs_{words}" + "_masked" * masked

    @kernel(array(u32), array(u32), array(u32), *EVIDENCE, block=128, name=name)
    def census_costs(  # type: ignore[no-untyped-def]
        left, right, volume, bad, height, width, span, count, minimum, border_cost, clamp_border
    ):
        at = u32(cuda.grid(1))
        strips = u32(u32(width + STRIP - 1) // u32(STRIP))
        word = u32(at % u32(span))
        line = u32(at // u32(span))
        y = i32(line // strips)
        if y < height:
            x0 = i32(u32(line % strips) * u32(STRIP))
            reach = u32(u32(width) + u32(4) * u32(span) - u32(1))
            level = i32(u32(4) * word)
            u = u32(u32(u32(y) * reach + u32(x0)) + u32(4 * span - 1 - level))
            pixel = u32(u32(u32(y) * u32(width)) + u32(x0))
            pads = padding(level, count)
            near = cuda.local.array(4, u32)
            far = cuda.local.array(4, u32)
            for k in range(1, 4):  # of the pixel before, which level k - 1 of that one was
                near[k - 1] = right[u32(u - u32(k))]
                if words == 2:
                    far[k - 1] = right[u32(u32(u32(height) * reach) + u - u32(k))]
            for x in range(x0, min(i32(x0 + i32(STRIP)), width)):
                for k in range(3):
                    near[3 - k] = near[2 - k]
                near[0] = right[u]
                left_bits = left[pixel]
                also = u32(0)
                if words == 2:
                    for k in range(3):
                        far[3 - k] = far[2 - k]
                    far[0] = right[u32(u32(u32(height) * reach) + u)]
                    also = left[u32(u32(u32(height) * u32(width)) + pixel)]
                packed = pads
                for k in range(4):
                    cost = i32(cuda.popc(u32(left_bits ^ near[k])))
                    if words == 2:
                        cost = i32(cost + i32(cuda.popc(u32(also ^ far[k]))))
                    column = i32(i32(x) - level - i32(k) - minimum)
                    cost = apply_border(cost, column, width, border_cost, clamp_border)
                    if masked:
                        cost = masked_cost(cost, column, y, x, bad, height, width, border_cost)
                    packed = u32(packed | u32(u32(cost) << u32(8 * k)))
                volume[u32(u32(pixel * u32(span)) + word)] = packed
                pixel = u32(pixel + u32(1))
                u = u32(u + u32(1))

    result: Kernel = census_costs
    return result


for _window in WINDOWS:
    for _dtype in KINDS:
        bits_kernel(_window, _dtype)
    costs_kernel(_words(_window), False)
    costs_kernel(_words(_window), True)


def volume(queue: Queue, cost: Census, pair: DevicePair) -> Any:
    """Return the volume of costs of a pair, flat words on the device (`stereokit.costs.rows_cuda`)."""
    height, width, words = pair.height, pair.width, _words(cost.window)
    left = queue.array("census.left", words * height * width, np.uint32)
    right = queue.array("census.right", words * height * pair.reach, np.uint32)
    bits = bits_kernel(cost.window, pair.dtype)
    first = -pair.levels.minimum - (pair.padded - 1)
    for place, start, columns, out in ((0, 0, width, left), (1, first, pair.reach, right)):
        blocks = blocks_for(height * columns, bits.block)
        queue.launch(bits, blocks, pair.images, place, start, columns, height, width, out)
    out = queue.array("costs", height * width * pair.padded // 4, np.uint32)
    costs = costs_kernel(words, pair.masked)
    threads = height * -(-width // STRIP) * pair.padded // 4
    queue.launch(costs, blocks_for(threads, costs.block), left, right, out, *pair.evidence(cost.cost_max))
    return out
