"""CUDA twin of `stereokit.aggregation.sgm`: the same paths in the same integers.

A path is walked by 8, 16 or 32 lanes of a warp, four levels or more to a lane; path costs stay in registers, the
levels on either side of a lane's come by shuffles, and so does the smallest cost. One launch walks all directions but
the last, lines along the rows first, as they are the longest; each writes its path costs, a byte to a level. A second
launch walks the last direction, up the columns, adds what the others left and selects at once, so that neither the
last path nor the sum is ever stored. Both ask for the words of the next pixel before they work on the present one.

A line along the image's height begins at every column, whatever its slant: where it leaves the image on one side it
goes on as a new path on the other one. So all lines of a direction are equally long and every pixel lies on one.
The levels that pad cost 255, and from an existing level seem to cost P2 or more, as on the CPU.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.aggregation.paths.penalties import Penalties
from stereokit.aggregation.sgm import Sgm
from stereokit.costs.rows import Cost
from stereokit.cuda.kernel import (
    Kernel,
    Queue,
    array,
    blocks_for,
    cuda,
    device,
    f32,
    i32,
    kernel,
    load2,
    load4,
    shuffle_down,
    shuffle_up,
    store2,
    store4,
    u8,
    u16,
    u32,
    u64,
)
from stereokit.selection.wta_cuda import RULES, Maps, group_of, lowest_of_group, selector

__all__ = ["aggregate", "directions", "final_kernel", "paths_kernel"]

_FAR = 4096
"""Path cost of a level that does not exist: more than any that does."""

_PENALTIES = (i32, i32, i32, i32, i32)
"""Types of the edge, P1 and P2, and P1 and P2 across an edge."""


def directions(paths: int) -> list[tuple[int, int]]:
    """Return the steps (dx, dy) of each direction, the last one along a column."""
    rows = [(1, 0), (-1, 0)]
    down = [(1, 1), (-1, 1)]
    if paths == 5:
        return [*rows, *down, (0, 1)]
    return [*rows, (0, 1), *([*down, (1, -1), (-1, -1)] if paths == 8 else []), (0, -1)]


@cache
def _words_loader(words: int) -> Any:
    """Return the helper that fills a register array with the words of a lane."""

    @device
    def load(volume, at, out):  # type: ignore[no-untyped-def]
        if words % 4 == 0:
            for j in range(0, words, 4):
                out[j], out[j + 1], out[j + 2], out[j + 3] = load4(volume, at + u64(j))
        elif words % 2 == 0:
            for j in range(0, words, 2):
                out[j], out[j + 1] = load2(volume, at + u64(j))
        else:
            for j in range(words):
                out[j] = volume[at + u64(j)]

    return load


@cache
def _finder(padded: int) -> Any:
    """Return the helper that returns the first word of a lane of a group at a pixel."""
    _, per_lane = group_of(padded)

    @device
    def words_at(pixel, place):  # type: ignore[no-untyped-def]
        return u64(u32(u32(pixel * u32(padded // 4)) + u32(place * i32(per_lane // 4))))

    return words_at


@cache
def _stepper(padded: int) -> Any:
    """Return the helper that takes a path one pixel further, in place; it returns the smallest path cost."""
    lanes, per_lane = group_of(padded)
    lowest_of = lowest_of_group(lanes)

    @device
    def step(path, costs, low, p1, p2, place):  # type: ignore[no-untyped-def]
        below = shuffle_up(path[per_lane - 1], 1)
        above_last = shuffle_down(path[0], 1)
        if place == 0:
            below = i32(_FAR)
        if place == i32(lanes - 1):
            above_last = i32(_FAR)
        up = i32(p1 - low)
        smallest = i32(_FAR)
        for k in range(per_lane):
            here = path[k]
            above = path[k + 1] if k < per_lane - 1 else above_last
            bracket = min(min(i32(min(below, above) + up), i32(here - low)), p2)
            cost = i32(u32(costs[k // 4] >> u32(8 * (k % 4))) & u32(255))
            path[k] = i32(cost + bracket)
            smallest = min(smallest, path[k])
            below = here
        return lowest_of(smallest)

    return step


@cache
def paths_kernel(padded: int) -> Kernel:
    """Return the kernel that walks many directions and writes the path costs of each.

    `table` has dx, dy and the first block of each direction.
    """
    lanes, per_lane = group_of(padded)
    words = per_lane // 4
    span = padded // 4
    lines_of_block = 128 // lanes
    words_at = _finder(padded)
    load = _words_loader(words)
    step = _stepper(padded)
    types = array(u32), array(u8), array(i32), i32, array(u32), i32, i32

    @kernel(*types, *_PENALTIES, block=128, name=f"sgm_paths_{padded}")
    def sgm_paths(  # type: ignore[no-untyped-def]
        costs, guide, table, count, out, height, width, edge, p1, p2, p1_edge, p2_edge
    ):
        thread = i32(cuda.threadIdx.x)
        block = i32(cuda.blockIdx.x)
        place = i32(thread & i32(lanes - 1))
        direction = u32(0)
        while i32(direction) + 1 < count and block >= table[u32(u32(3) * direction + u32(5))]:
            direction = u32(direction + u32(1))
        dx = table[u32(u32(3) * direction)]
        dy = table[u32(u32(3) * direction + u32(1))]
        first = table[u32(u32(3) * direction + u32(2))]
        line = i32(i32(block - first) * i32(lines_of_block) + i32(thread // i32(lanes)))
        lines = height if dy == 0 else width
        steps = width if dy == 0 else height
        alive = line < lines
        line = i32(min(line, i32(lines - 1)))
        x = line
        y = i32(0) if dy > 0 else i32(height - 1)
        if dy == 0:
            x = i32(0) if dx > 0 else i32(width - 1)
            y = line
        base = u64(u64(direction) * u64(u32(u32(height) * u32(width) * u32(span))))
        path = cuda.local.array(per_lane, i32)
        coming = cuda.local.array(words, u32)
        present = cuda.local.array(words, u32)
        for k in range(per_lane):
            path[k] = i32(0)
        low = i32(0)
        at = u32(u32(u32(y) * u32(width)) + u32(x))
        load(costs, words_at(at, place), coming)
        grey = i32(guide[at])
        before = grey
        for _ in range(steps):
            to = words_at(at, place)
            for j in range(words):
                present[j] = coming[j]
            jump = i32(abs(i32(grey - before)))
            before = grey
            x = i32(x + dx)
            y = i32(min(max(i32(y + dy), i32(0)), i32(height - 1)))
            wrapped = u32(x) >= u32(width)
            if wrapped:
                x = i32(x - width) if dx > 0 else i32(x + width)
            at = u32(u32(u32(y) * u32(width)) + u32(x))
            load(costs, words_at(at, place), coming)
            grey = i32(guide[at])
            small = p1_edge if jump >= edge else p1
            large = p2_edge if jump >= edge else p2
            low = step(path, present, low, small, large, place)
            for j in range(words):
                packed = u32(u32(path[4 * j]) | u32(u32(path[4 * j + 1]) << u32(8)))
                packed = u32(packed | u32(u32(path[4 * j + 2]) << u32(16)))
                present[j] = u32(packed | u32(u32(path[4 * j + 3]) << u32(24)))
            if alive:
                if words % 4 == 0:
                    for j in range(0, words, 4):
                        four = present[j], present[j + 1], present[j + 2], present[j + 3]
                        store4(out, base + to + u64(j), four)
                elif words % 2 == 0:
                    for j in range(0, words, 2):
                        store2(out, base + to + u64(j), (present[j], present[j + 1]))
                else:
                    for j in range(words):
                        out[base + to + u64(j)] = present[j]
            if wrapped:
                low = i32(0)
                for k in range(per_lane):
                    path[k] = i32(0)

    result: Kernel = sgm_paths
    return result


@cache
def final_kernel(padded: int, others: int) -> Kernel:
    """Return the kernel that walks the columns, `dy` at a time, adds `others` paths and selects."""
    lanes, per_lane = group_of(padded)
    words = per_lane // 4
    span = padded // 4
    lines_of_block = 128 // lanes
    words_at = _finder(padded)
    load = _words_loader(words)
    step = _stepper(padded)
    choose = selector(padded, False)
    path_words = words * others
    even = np.uint32(0x00FF00FF)
    maps = array(f32), array(u16), array(f32), *RULES
    types = array(u32), array(u8), array(u32), i32, i32, i32

    @kernel(*types, *_PENALTIES, *maps, block=128, name=f"sgm_final_{padded}_{others + 1}")
    def sgm_final(  # type: ignore[no-untyped-def]
        costs, guide, path_costs, dy, height, width, edge, p1, p2, p1_edge, p2_edge,
        disparity, cost, confidence, levels, minimum, subpixel, uniqueness, detail,
    ):  # fmt: skip
        thread = i32(cuda.threadIdx.x)
        lane = i32(thread & i32(31))
        place = i32(thread & i32(lanes - 1))
        x = i32(i32(cuda.blockIdx.x) * i32(lines_of_block) + i32(thread // i32(lanes)))
        alive = x < width
        x = i32(min(x, i32(width - 1)))
        y = i32(0) if dy > 0 else i32(height - 1)
        volume = u64(u32(u32(height) * u32(width) * u32(span)))
        path = cuda.local.array(per_lane, i32)
        total = cuda.local.array(per_lane, i32)
        coming = cuda.local.array(words, u32)
        present = cuda.local.array(words, u32)
        ahead = cuda.local.array(path_words, u32)
        part = cuda.local.array(words, u32)
        for k in range(per_lane):
            path[k] = i32(0)
        low = i32(0)
        at = u32(u32(u32(y) * u32(width)) + u32(x))
        load(costs, words_at(at, place), coming)
        before = i32(guide[at])
        for n in range(others):
            load(path_costs, words_at(at, place) + u64(n) * volume, part)
            for j in range(words):
                ahead[n * words + j] = part[j]
        for _ in range(height):
            pixel = at
            grey = i32(guide[at])
            for j in range(words):
                present[j] = coming[j]
                low_sum, high_sum = u32(0), u32(0)
                for n in range(others):
                    low_sum = u32(low_sum + u32(ahead[n * words + j] & even))
                    high_sum = u32(high_sum + u32(u32(ahead[n * words + j] >> u32(8)) & even))
                total[4 * j] = i32(low_sum & u32(0xFFFF))
                total[4 * j + 1] = i32(high_sum & u32(0xFFFF))
                total[4 * j + 2] = i32(low_sum >> u32(16))
                total[4 * j + 3] = i32(high_sum >> u32(16))
            y = i32(min(max(i32(y + dy), i32(0)), i32(height - 1)))
            at = u32(u32(u32(y) * u32(width)) + u32(x))
            source = words_at(at, place)
            load(costs, source, coming)
            for n in range(others):
                load(path_costs, source + u64(n) * volume, part)
                for j in range(words):
                    ahead[n * words + j] = part[j]
            jump = i32(abs(i32(grey - before)))
            before = grey
            small = p1_edge if jump >= edge else p1
            large = p2_edge if jump >= edge else p2
            low = step(path, present, low, small, large, place)
            for k in range(per_lane):
                total[k] = i32(total[k] + path[k])
            choose(
                total, lane, pixel, alive, disparity, cost, confidence, levels, minimum, subpixel, uniqueness, detail
            )

    result: Kernel = sgm_final
    return result


for _padded, _others in ((32, 3), (64, 3), (128, 3), (128, 4), (128, 7), (512, 7)):
    final_kernel(_padded, _others)
    paths_kernel(_padded)


def _table(paths: int, shape: tuple[int, int], lines_of_block: int) -> tuple[NDArray[np.int32], int]:
    """Return dx, dy and the first block of all directions but the last, and how many blocks they take."""
    rows, blocks = [], 0
    for dx, dy in directions(paths)[:-1]:
        rows.append((dx, dy, blocks))
        blocks += blocks_for(shape[0] if dy == 0 else shape[1], lines_of_block)
    return np.array(rows, np.int32), blocks


def aggregate(
    queue: Queue, sgm: Sgm, cost: Cost, costs: Any, guide: Any, shape: tuple[int, int], padded: int, maps: Maps
) -> None:
    """Aggregate a volume of costs and select.

    Parameters
    ----------
    queue : Queue
        Queue of launches.
    sgm : Sgm
        Options.
    cost : Cost
        Cost of the volume.
    costs : (H * W * padded / 4,) uint32
        The volume (`stereokit.costs.rows_cuda`); not modified.
    guide : (H * W,) uint8
        The left image, which the penalties may follow.
    shape : (int, int)
        Height and width, pixels.
    padded : int
        Levels of the volume.
    maps : Maps
        Maps of the selection.
    """
    penalties: Penalties = sgm.penalties(cost.cost_max, cost.unit)
    steps = penalties.edge, penalties.p1, penalties.p2, penalties.p1_edge, penalties.p2_edge
    lanes, _ = group_of(padded)
    per_block = 128 // lanes
    others = sgm.paths - 1
    rows, blocks = _table(sgm.paths, shape, per_block)
    table = queue.cached("sgm.table", (sgm.paths, shape, padded), lambda: rows)
    path_costs = queue.array("sgm.paths", others * shape[0] * shape[1] * padded // 4, np.uint32)
    numbers = [int(step) for step in steps]
    queue.launch(paths_kernel(padded), blocks, costs, guide, table, others, path_costs, *shape, *numbers)
    final = final_kernel(padded, others)
    dy = directions(sgm.paths)[-1][1]
    queue.launch(final, blocks_for(shape[1], per_block), costs, guide, path_costs, dy, *shape, *numbers, *maps)
