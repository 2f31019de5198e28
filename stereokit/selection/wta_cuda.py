"""CUDA twin of `stereokit.selection.wta`: the same winner, the same fraction, the same confidence.

The levels of a pixel lie in the registers of a group of 8, 16 or 32 lanes of a warp, a multiple of four to each lane.
The lowest cost goes round by shuffles, a vote finds the lowest lane that has it, and that lane writes the result: it
has the costs of the neighbouring levels at hand. The scalar rules are those of the CPU, compiled for the GPU.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from stereokit.cuda.kernel import (
    FULL,
    Kernel,
    Queue,
    array,
    blocks_for,
    cuda,
    device,
    f32,
    i32,
    kernel,
    load4,
    shuffle_down,
    shuffle_from,
    shuffle_up,
    shuffle_xor,
    u8,
    u16,
    u32,
)
from stereokit.selection.wta import margin_of, parabola

__all__ = [
    "RULES",
    "Maps",
    "group_of",
    "lowest_of_group",
    "select",
    "select_kernel",
    "selector",
    "zero_invalid_confidence",
]

RULES = (i32, i32, i32, f32, i32)
"""Types of the number of levels, the lowest disparity, whether to interpolate, the least margin, and the detail
(`stereokit.settings.Detail`): 0 neither confidence nor candidates, 1 the confidence, 2 both."""


class Maps(NamedTuple):
    """Maps of the selection and its rules; the last arguments of kernels that select.

    The maps are flat, ``(H * W)`` on the device; `confidence` has one element where nobody asked for it, and thrice as
    many with candidates: behind it lie the winners again, and the best that are not next to them.
    """

    disparity: Any  # float32, pixels, NaN where the margin is too small
    cost: Any  # uint16 or float32, aggregated cost of the winner
    confidence: Any  # float32
    levels: int
    minimum: int
    subpixel: int
    uniqueness: np.float32  # 0 to 1
    detail: int


def group_of(padded: int) -> tuple[int, int]:
    """Return the number of lanes that share the levels of a pixel, and the levels of each."""
    lanes = min(32, padded // 4)
    return lanes, padded // lanes


@cache
def lowest_of_group(lanes: int) -> Any:
    """Return the helper that returns the lowest value of a group of lanes."""

    @device
    def lowest(value):  # type: ignore[no-untyped-def]
        if lanes > 16:
            value = min(value, shuffle_xor(value, 16))
        if lanes > 8:
            value = min(value, shuffle_xor(value, 8))
        value = min(value, shuffle_xor(value, 4))
        value = min(value, shuffle_xor(value, 2))
        return min(value, shuffle_xor(value, 1))

    return lowest


@cache
def selector(padded: int, floats: bool) -> Any:
    """Return the helper that selects among values in registers; all lanes of the warp must call it."""
    lanes, per_lane = group_of(padded)
    lowest_of = lowest_of_group(lanes)
    kind = f32 if floats else i32
    most = np.float32(np.finfo(np.float32).max) if floats else np.int32(2**31 - 1)
    group_bits = np.uint32(2**lanes - 1)

    @device
    def choose(  # type: ignore[no-untyped-def]
        values, lane, at, alive, disparity, cost, confidence, levels, minimum, subpixel, uniqueness, detail
    ):
        place = i32(lane & i32(lanes - 1))
        first = i32(place * i32(per_lane))
        below = shuffle_up(values[per_lane - 1], 1)
        above = shuffle_down(values[0], 1)
        best, before, behind = kind(most), kind(0), kind(0)
        level = i32(0)
        for k in range(per_lane):
            value = values[k] if i32(first + i32(k)) < levels else kind(most)
            if value < best:
                best = value
                level = i32(first + i32(k))
                before = values[k - 1] if k > 0 else below
                behind = values[k + 1] if k < per_lane - 1 else above
        lowest = lowest_of(best)
        votes = u32(cuda.ballot_sync(FULL, best == lowest))
        base = u32(u32(lane) & u32(32 - lanes))
        winner = i32(cuda.ffs(u32(u32(votes >> base) & u32(group_bits)))) - 1
        margin = f32(1)
        other = i32(0)
        if detail != 0 or uniqueness > f32(0):
            winner_level = shuffle_from(level, i32(base) + winner)
            rival = kind(most)
            for k in range(per_lane):
                away = i32(abs(i32(first + i32(k) - winner_level)))
                if i32(first + i32(k)) < levels and away > 1 and values[k] < rival:
                    rival = values[k]
                    other = i32(first + i32(k))
            own_rival = rival
            rival = lowest_of(rival)
            if rival < kind(most):
                margin = margin_of(f32(lowest), f32(rival))
            if detail > 1:
                votes = u32(cuda.ballot_sync(FULL, own_rival == rival))
                other = shuffle_from(other, i32(base) + i32(cuda.ffs(u32(u32(votes >> base) & u32(group_bits)))) - 1)
                other = other if rival < kind(most) else winner_level
        if alive and place == winner:
            result = f32(i32(level + minimum))
            if subpixel != 0 and level > 0 and level < levels - 1:
                result = f32(result + parabola(f32(before), f32(best), f32(behind)))
            if detail > 1:
                pixels = u32(u32(confidence.size) // u32(3))
                confidence[at + pixels] = result
                confidence[at + pixels + pixels] = f32(i32(other + minimum))
            if margin < uniqueness:
                result = f32(np.nan)
            disparity[at] = result
            cost[at] = best
            if detail != 0:
                confidence[at] = margin

    return choose


@cache
def select_kernel(padded: int, floats: bool) -> Kernel:
    """Return the kernel that selects from a volume, ``(H, band, padded)``, of columns `first` to `first` + `band`."""
    lanes, per_lane = group_of(padded)
    choose = selector(padded, floats)
    value, out = (f32, f32) if floats else (u16, u16)
    register = f32 if floats else i32
    maps = array(f32), array(out), array(f32), *RULES
    name = f"select_{'float' if floats else 'short'}_{padded}"

    @kernel(array(value), i32, i32, i32, i32, *maps, block=128, name=name)
    def select(  # type: ignore[no-untyped-def]
        volume, first, band, height, width, disparity, cost, confidence,
        levels, minimum, subpixel, uniqueness, detail,
    ):  # fmt: skip
        thread = u32(cuda.grid(1))
        lane = i32(thread & u32(31))
        pixel = u32(thread // u32(lanes))
        alive = pixel < u32(u32(height) * u32(band))
        pixel = min(pixel, u32(u32(u32(height) * u32(band)) - u32(1)))
        values = cuda.local.array(per_lane, register)
        source = u32(u32(pixel * u32(padded)) + u32(u32(lane & i32(lanes - 1)) * u32(per_lane)))
        for j in range(0, per_lane, 4):
            a, b, c, d = load4(volume, u32(source + u32(j)))
            values[j], values[j + 1], values[j + 2], values[j + 3] = register(a), register(b), register(c), register(d)
        y = u32(pixel // u32(band))
        at = u32(u32(y * u32(width)) + u32(first) + u32(pixel - u32(y * u32(band))))
        choose(values, lane, at, alive, disparity, cost, confidence, levels, minimum, subpixel, uniqueness, detail)

    result: Kernel = select
    return result


@kernel(array(f32), array(u8), i32, block=128)
def zero_invalid_confidence(confidence, valid, pixels):  # type: ignore[no-untyped-def]
    """Set the confidence of pixels that are not valid to 0."""
    at = u32(cuda.grid(1))
    if at < u32(pixels) and valid[at] == 0:
        confidence[at] = f32(0)


for _padded in (32, 128, 512):
    select_kernel(_padded, False)
    select_kernel(_padded, True)


def select(
    queue: Queue, totals: Any, floats: bool, first: int, band: int, shape: tuple[int, int], padded: int, maps: Maps
) -> None:
    """Select the pixels of a band of columns from their aggregated costs, ``(H, band, padded)`` uint16 or float32."""
    kernel_of_size = select_kernel(padded, floats)
    lanes, _ = group_of(padded)
    blocks = blocks_for(shape[0] * band * lanes, kernel_of_size.block)
    queue.launch(kernel_of_size, blocks, totals, first, band, *shape, *maps)
