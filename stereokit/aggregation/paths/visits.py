"""Visits of rows: the first leaves the brackets of one sweep, the last sums all paths of a pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.aggregation.paths.penalties import Penalties, write_penalties
from stereokit.aggregation.paths.steps import (
    PathBuffers,
    advance,
    advance_paths,
    bracket_of,
    enter,
    enter_paths,
    leave_paths,
    recovers_costs,
    restart_diagonals,
    slots_of,
)
from stereokit.costs.rows import cost_row
from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.simd import (
    LANES,
    add,
    bitwise_or,
    convert,
    load,
    lowest_of_4,
    multiply,
    prefetch,
    splat,
    splat_at,
    store,
    stream,
    stream_fence,
    subtract,
)

__all__ = ["CHUNK", "add_others", "finish_part", "first_visit", "prepare_rows", "start", "sum_of_sweep"]


CHUNK = 32
"""Pixels whose sums are selected while they are still in the first-level cache."""


@kernel
def start(buffers: PathBuffers, x0: int, x1: int) -> None:
    """Begin a sweep in columns x0..x1: no path has come from anywhere yet."""
    zero = splat(np.uint8(0))
    padded = LANES * len(buffers.blocks)
    for direction in range(3):
        if direction == 1 or len(buffers.diagonals) > 0:
            first = direction * buffers.width
            for at in range((first + x0) * padded, (first + x1) * padded, LANES):
                store(buffers.state, at, zero)
            buffers.lowest[first + x0 : first + x1] = 0


@inline
def _step_along(buffers: PathBuffers, chain: int, at: int, pixel: int, low: Any, alone: bool) -> Any:
    """Take one path along a row to the pixel whose costs are at `at`; return a vector that has its smallest cost.

    `chain` is the place of the path's costs, `pixel` that of the step's penalties, `low` the smallest of the path's
    costs. The bracket goes to `across`: `alone`, or added to that of the other path.
    """
    padded = LANES * len(buffers.blocks)
    p1 = splat_at(buffers.penalties, 6 * buffers.width + pixel)
    p2 = splat_at(buffers.penalties, 7 * buffers.width + pixel)
    path = enter(buffers.chains, chain, low, p1, p2)
    for block in range(0, padded, LANES):
        cost = load(buffers.cost, at + block)
        bracket, _, path = advance(buffers.chains, path, block, block + LANES == padded, cost)
        across = convert(bracket, buffers.across[0])
        if not alone:
            across = add(across, load(buffers.across, at + block))
        store(buffers.across, at + block, across)
    return path.smallest


@inline
def _horizontals(buffers: PathBuffers, rows: int) -> None:
    """Both paths along each of `rows` rows, 1 or 2.

    They run side by side, because each alone would wait at every pixel for its own smallest cost: the processor
    works on one chain while another waits.
    """
    width = buffers.width
    padded = LANES * len(buffers.blocks)
    size = width * padded
    zero = splat(np.uint8(0))
    for at in range(0, 4 * padded, LANES):
        store(buffers.chains, at, zero)
    low_right_0 = zero
    low_left_0 = zero
    low_right_1 = zero
    low_left_1 = zero
    for x in range(width):
        xb = width - 1 - x
        behind = min(xb + 1, width - 1)  # the step into xb from the right has the jump between xb and xb + 1
        right_0 = _step_along(buffers, 0, x * padded, x, low_right_0, x <= xb)
        left_0 = _step_along(buffers, padded, xb * padded, behind, low_left_0, x < xb)
        right_1 = zero
        left_1 = zero
        if rows > 1:
            right_1 = _step_along(buffers, 2 * padded, size + x * padded, 8 * width + x, low_right_1, x <= xb)
            left_1 = _step_along(buffers, 3 * padded, size + xb * padded, 8 * width + behind, low_left_1, x < xb)
        low_right_0, low_left_0, low_right_1, low_left_1 = lowest_of_4(right_0, left_0, right_1, left_1)


@inline
def _leave_row(buffers: PathBuffers, k: int, x0: int, x1: int, sums: NDArray[Any], base: int, bypass: bool) -> None:
    """Take the paths from the row before to columns x0..x1 of the `k`-th row of the first visit.

    The sum of their brackets, or the vertical path's costs where costs are recovered from them, goes to
    ``sums[base:]``: past the caches, if `bypass`, or through them.
    """
    width = buffers.width
    padded = LANES * len(buffers.blocks)
    like = sums[0]
    turn = k % width
    for x in range(x0, x1):
        slots = slots_of(width, turn, x)
        restart_diagonals(buffers, slots, x)
        paths = enter_paths(buffers, slots, x)
        for n in range(len(buffers.blocks)):
            at = x * padded + n * LANES
            brackets, path_cost, paths = advance_paths(buffers, paths, n, load(buffers.cost, at), like)
            left = convert(path_cost, like) if recovers_costs(buffers) else brackets
            if bypass:
                stream(sums, base + at, left)
            else:
                store(sums, base + at, left)
        low = leave_paths(buffers, slots, paths)
        if recovers_costs(buffers):
            buffers.path_minimum[base // padded + x] = low


@kernel
def first_visit(
    rows: Any, buffers: PathBuffers, guide: NDArray[np.uint8], penalties: Penalties, y0: int, y1: int, x0: int, x1: int,
    sums: NDArray[Any], near: int,
) -> None:  # fmt: skip
    """Sweep columns x0..x1 from row `y0` to before row `y1` (upwards when y1 < y0); leave the brackets in `sums`.

    Columns do not depend on one another unless there are diagonal paths, which take all of them at a time. The last
    `near` elements of whole rows are written through the caches, all before them past the caches.
    """
    start(buffers, x0, x1)
    step = 1 if y1 > y0 else -1
    size = buffers.width * LANES * len(buffers.blocks)
    for k in range(abs(y1 - y0)):
        y = y0 + k * step
        cost_row(rows, y, x0, x1, buffers.cost)
        write_penalties(guide, y, x0, x1, step, len(buffers.diagonals) > 0, False, penalties, 0, buffers.penalties)
        if (abs(y1 - y0) - k) * size > near:
            _leave_row(buffers, k, x0, x1, sums, y * size, True)
        else:
            _leave_row(buffers, k, x0, x1, sums, y * size, False)
    stream_fence()


@inline
def recover_row(
    buffers: PathBuffers, guide: NDArray[np.uint8], penalties: Penalties, y: int, step: int, to: int,
    sums: NDArray[Any],
) -> None:  # fmt: skip
    """Take the brackets off the path costs that the other sweep left for row `y`; costs go to ``buffers.cost[to:]``.

    The other sweep came from row ``y + step``.
    """
    width = buffers.width
    padded = LANES * len(buffers.blocks)
    narrow = np.uint8(0)
    full = splat(np.uint8(255))
    zero = splat(np.uint8(0))
    before = y + step
    first = before < 0 or before >= guide.shape[0]  # there the other sweep began, with brackets of 0
    write_penalties(guide, y, 0, width, -step, False, False, penalties, 0, buffers.penalties)
    for x in range(width):
        p1 = splat_at(buffers.penalties, 2 * width + x)
        p2 = splat_at(buffers.penalties, 3 * width + x)
        at = (y * width + x) * padded
        source = (before * width + x) * padded
        low = zero
        below = full
        here = zero
        if not first:
            low = splat_at(buffers.path_minimum, before * width + x)
            here = subtract(convert(load(sums, source), narrow), low)
        for n in range(len(buffers.blocks)):
            block = n * LANES
            above = full
            if n + 1 < len(buffers.blocks) and not first:
                above = subtract(convert(load(sums, source + block + LANES), narrow), low)
            bracket = bracket_of(below, here, above, p1, p2)
            if first:
                bracket = zero
            prefetch(sums, source + block + CHUNK * padded)
            cost = subtract(convert(load(sums, at + block), narrow), bracket)
            if n + 1 == len(buffers.blocks):
                cost = bitwise_or(cost, load(buffers.padding, block))
            store(buffers.cost, to + x * padded + block, cost)
            below = here
            here = above


@inline
def prepare_rows(
    rows: Any, buffers: PathBuffers, guide: NDArray[np.uint8], penalties: Penalties, y: int, step: int,
    count: int, sums: NDArray[Any],
) -> None:  # fmt: skip
    """Costs, penalties and paths along the row of row `y` and, if `count` is 2, of the next one of the sweep."""
    size = buffers.width * LANES * len(buffers.blocks)
    for n in range(count):
        if recovers_costs(buffers):
            recover_row(buffers, guide, penalties, y + n * step, step, n * size, sums)
        else:
            cost_row(rows, y + n * step, 0, buffers.width, buffers.cost[n * size : (n + 1) * size])
    for n in range(count):
        place = 8 * n * buffers.width
        write_penalties(
            guide, y + n * step, 0, buffers.width, step, len(buffers.diagonals) > 0, True, penalties, place,
            buffers.penalties,
        )  # fmt: skip
    _horizontals(buffers, count)


@inline
def sum_of_sweep(buffers: PathBuffers, cost: Any, brackets: Any) -> Any:
    """Costs of all paths and brackets of this sweep, as words; path costs that the other sweep left hold one cost."""
    wide = np.uint16(0)
    if buffers.byte_costs:
        double = add(cost, cost)
        costs = add(double, cost if recovers_costs(buffers) else double)
        return convert(add(costs, convert(brackets, np.uint8(0))), wide)
    times = splat(np.uint16(buffers.paths - 1 if recovers_costs(buffers) else buffers.paths))
    return add(convert(brackets, wide), multiply(convert(cost, wide), times))


@inline
def add_others(buffers: PathBuffers, total: Any, across: Any, sums: NDArray[Any], at: int, both: bool) -> Any:
    """Add the brackets along the row and, if there are `both` sweeps, what the other one left at element `at`."""
    narrow = np.uint8(0)
    wide = np.uint16(0)
    if both and buffers.byte_brackets:
        return add(total, convert(add(convert(across, narrow), convert(load(sums, at), narrow)), wide))
    total = add(total, convert(across, wide))
    if both:
        total = add(total, convert(load(sums, at), wide))
    return total


@inline
def _sum_part(
    buffers: PathBuffers, half: int, k: int, x0: int, x1: int, sums: NDArray[Any], base: int, both: bool
) -> None:
    """Take the paths from the row before to columns x0..x1 of sweep row `k`, and sum all paths there into `total`.

    `half` tells which of the two rows in the buffers it is. If there are `both` sweeps, the other one left its part in
    ``sums[base:]``.
    """
    width = buffers.width
    padded = LANES * len(buffers.blocks)
    turn = k % width
    row = half * width * padded
    for x in range(x0, x1):
        slots = slots_of(width, turn, x)
        restart_diagonals(buffers, slots, x)
        paths = enter_paths(buffers, slots, 8 * half * width + x)
        for n in range(len(buffers.blocks)):
            at = x * padded + n * LANES
            cost = load(buffers.cost, row + at)
            brackets, _, paths = advance_paths(buffers, paths, n, cost, sums[0])
            if both and not recovers_costs(buffers):
                prefetch(sums, base + at + CHUNK * padded)
            total = sum_of_sweep(buffers, cost, brackets)
            total = add_others(buffers, total, load(buffers.across, row + at), sums, base + at, both)
            store(buffers.total, at - x0 * padded, total)
        leave_paths(buffers, slots, paths)


@inline
def finish_part(
    buffers: PathBuffers, half: int, y: int, k: int, x0: int, x1: int, sums: NDArray[Any], both: bool
) -> None:
    """Sum all paths of columns x0..x1 of row `y`, the `k`-th of its sweep; `prepare_rows` has been there.

    The sums go to the beginning of ``buffers.total``.
    """
    if both:
        _sum_part(buffers, half, k, x0, x1, sums, y * buffers.width * LANES * len(buffers.blocks), True)
    else:
        _sum_part(buffers, half, k, x0, x1, sums, 0, False)
