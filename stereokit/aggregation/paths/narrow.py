"""Paths where each pixel has a search range of its own: the `LANES` levels from its start on.

A path that comes from a pixel with another start finds its levels at other lanes; `_before` brings them into line with
one load that need not be aligned. A level that the pixel before did not search is reached at P2, as any other that
lies far away, and so is one whose neighbour the pixel itself does not search.

A path cost is stored without the smallest of its pixel: then 255, which stands for levels that were not searched,
exceeds P2, whatever the smallest was. Arrays as in `stereokit.aggregation.paths`, with ``P = LANES``; `state` and
`chains` have `LANES` elements more at both ends, which loads may touch and `edges` masks out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.aggregation.paths.penalties import Penalties, write_penalties
from stereokit.aggregation.paths.steps import PathBuffers, bracket_of, slots_of
from stereokit.aggregation.paths.visits import CHUNK, add_others, sum_of_sweep
from stereokit.costs.rows import Search, cost_row
from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.simd import (
    LANES,
    add,
    bitwise_or,
    convert,
    load,
    lowest_of_4,
    prefetch,
    splat,
    splat_at,
    store,
    stream,
    stream_fence,
    subtract,
)

__all__ = ["NarrowBuffers", "finish_narrow_part", "first_narrow_visit", "prepare_narrow_rows", "start_narrow"]


class NarrowBuffers(NamedTuple):
    """Buffers of one worker."""

    paths: PathBuffers
    search: Search
    edges: NDArray[np.uint8]  # 64 times 255, 64 times 0, 64 times 255
    below: NDArray[np.uint8]  # 64 times `UNEXPECTED`, 64 times 0
    above: NDArray[np.uint8]  # 65 times 0, 63 times `UNEXPECTED`


@kernel
def start_narrow(buffers: NarrowBuffers, x0: int, x1: int) -> None:
    """Begin a sweep in columns x0..x1: no path has come from anywhere yet."""
    zero = splat(np.uint8(0))
    for direction in range(3):
        if direction == 1 or len(buffers.paths.diagonals) > 0:
            first = direction * buffers.paths.width
            for x in range(first + x0, first + x1):
                store(buffers.paths.state, LANES + x * LANES, zero)


@inline
def _before(costs: NDArray[np.uint8], place: int, shift: int, edges: NDArray[np.uint8]) -> Any:
    """Return the path costs at `place` of a pixel whose search begins `shift` levels lower, 255 for those without."""
    shift = min(max(shift, -LANES), LANES)
    return bitwise_or(load(costs, place + shift), load(edges, LANES + shift))


@inline
def _step(buffers: NarrowBuffers, costs: NDArray[np.uint8], place: int, shift: int, p1: Any, p2: Any, cost: Any) -> Any:
    """Return the bracket and the new path costs of a path; its old ones lie at `place`."""
    full = splat(np.uint8(255))
    bracket = bracket_of(full, _before(costs, place, shift, buffers.edges), full, p1, p2)
    return bracket, add(cost, bracket)


@inline
def _shift(buffers: NarrowBuffers, here: int, before: int) -> int:
    """Return by how many levels the search at pixel `here` begins above that at pixel `before`."""
    shift: int = np.int64(buffers.search.starts[here]) - np.int64(buffers.search.starts[before])
    return shift


@inline
def _step_down(buffers: NarrowBuffers, slot: int, shift: int, penalties: int, cost: Any) -> Any:
    """Take one of the paths that come from the row before to the next pixel."""
    paths = buffers.paths
    p1 = splat_at(paths.penalties, penalties)
    p2 = splat_at(paths.penalties, penalties + paths.width)
    return _step(buffers, paths.state, LANES + slot * LANES, shift, p1, p2, cost)


@inline
def _leave(buffers: NarrowBuffers, slot: int, path_cost: Any, smallest: Any) -> None:
    store(buffers.paths.state, LANES + slot * LANES, subtract(path_cost, smallest))


@inline
def _restart(buffers: NarrowBuffers, slot: int) -> None:
    store(buffers.paths.state, LANES + slot * LANES, splat(np.uint8(0)))


@inline
def _from_row_before(
    buffers: NarrowBuffers, x: int, turn: int, here: int, before: int, penalties: int, cost: Any, like: Any
) -> Any:
    """Take the paths from the row before to column `x`; return the sum of their brackets in the type of `like`.

    Column `x` is pixel `here`; pixel `before` of the row before is its neighbour, or `here` itself where that row lies
    outside.
    """
    paths = buffers.paths
    width = paths.width
    slots = slots_of(width, turn, x)
    bracket, straight = _step_down(buffers, slots.straight, _shift(buffers, here, before), penalties + 2 * width, cost)
    brackets = convert(bracket, like)
    from_left = straight
    from_right = straight
    if len(paths.diagonals) > 0:
        shift_left = 0
        shift_right = 0
        if x == 0:
            _restart(buffers, slots.from_left)
        elif here != before:
            shift_left = _shift(buffers, here, before - 1)
        if x == width - 1:
            _restart(buffers, slots.from_right)
        elif here != before:
            shift_right = _shift(buffers, here, before + 1)
        bracket, from_left = _step_down(buffers, slots.from_left, shift_left, penalties, cost)
        brackets = add(brackets, convert(bracket, like))
        bracket, from_right = _step_down(buffers, slots.from_right, shift_right, penalties + 4 * width, cost)
        brackets = add(brackets, convert(bracket, like))
    low_left, low, low_right, _ = lowest_of_4(from_left, straight, from_right, straight)
    _leave(buffers, slots.straight, straight, low)
    if len(paths.diagonals) > 0:
        _leave(buffers, slots.from_left, from_left, low_left)
        _leave(buffers, slots.from_right, from_right, low_right)
    return brackets


@inline
def _row_before(buffers: NarrowBuffers, guide: NDArray[np.uint8], y: int, step: int) -> int:
    """Return the place of the first pixel of the row from which the paths come to row `y`, which may be the same."""
    before = y - step
    if before < 0 or before >= guide.shape[0]:
        before = y
    return before * buffers.paths.width


@inline
def _narrow_costs(rows: Any, buffers: NarrowBuffers, y: int, x0: int, x1: int, to: int) -> None:
    """Write the costs of a part of row `y`, those of unexpected levels raised; the row's are at element `to`."""
    width = buffers.paths.width
    costs = buffers.paths.cost
    cost_row(rows, y, x0, x1, costs[to : to + width * LANES])
    for x in range(x0, x1):
        low = np.int64(buffers.search.low[y * width + x])
        high = np.int64(buffers.search.high[y * width + x])
        unexpected = add(load(buffers.below, LANES - low), load(buffers.above, LANES - high))
        store(costs, to + x * LANES, add(load(costs, to + x * LANES), unexpected))


@kernel
def first_narrow_visit(
    rows: Any, buffers: NarrowBuffers, guide: NDArray[np.uint8], penalties: Penalties, y0: int, y1: int, x0: int,
    x1: int, sums: NDArray[Any], near: int,
) -> None:  # fmt: skip
    """Sweep a part of the rows; see `stereokit.aggregation.paths.visits.first_visit`."""
    start_narrow(buffers, x0, x1)
    step = 1 if y1 > y0 else -1
    width = buffers.paths.width
    for k in range(abs(y1 - y0)):
        y = y0 + k * step
        here = y * width
        before = _row_before(buffers, guide, y, step)
        _narrow_costs(rows, buffers, y, x0, x1, 0)
        diagonals = len(buffers.paths.diagonals) > 0
        write_penalties(guide, y, x0, x1, step, diagonals, False, penalties, 0, buffers.paths.penalties)
        bypass = (abs(y1 - y0) - k) * width * LANES > near
        for x in range(x0, x1):
            cost = load(buffers.paths.cost, x * LANES)
            brackets = _from_row_before(buffers, x, k % width, here + x, before + x, x, cost, sums[0])
            if bypass:
                stream(sums, (here + x) * LANES, brackets)
            else:
                store(sums, (here + x) * LANES, brackets)
    stream_fence()


@inline
def _along(buffers: NarrowBuffers, chain: int, row: int, x: int, shift: int, pixel: int) -> Any:
    """Take one path along row `row` of the buffers to column `x`; return its bracket and path costs."""
    paths = buffers.paths
    p1 = splat_at(paths.penalties, pixel)
    p2 = splat_at(paths.penalties, pixel + paths.width)
    cost = load(paths.cost, (row * paths.width + x) * LANES)
    return _step(buffers, paths.chains, LANES + chain * LANES, shift, p1, p2, cost)


@inline
def _put_across(buffers: NarrowBuffers, row: int, x: int, bracket: Any, alone: bool) -> None:
    """Write the bracket of a path along a row, `alone` or added to that of the other path."""
    paths = buffers.paths
    at = (row * paths.width + x) * LANES
    across = convert(bracket, paths.across[0])
    if not alone:
        across = add(across, load(paths.across, at))
    store(paths.across, at, across)


@inline
def _horizontals(buffers: NarrowBuffers, here: int, next_row: int, count: int) -> None:
    """Both paths along the row of pixel `here` and, if `count` is 2, along that of pixel `next_row`, side by side."""
    paths = buffers.paths
    width = paths.width
    zero = splat(np.uint8(0))
    for chain in range(4):
        store(paths.chains, LANES + chain * LANES, zero)
    right_1 = zero
    left_1 = zero
    for x in range(width):
        xb = width - 1 - x
        before = max(x - 1, 0)
        behind = min(xb + 1, width - 1)  # the step into xb from the right has the jump between xb and xb + 1
        bracket, right_0 = _along(buffers, 0, 0, x, _shift(buffers, here + x, here + before), 6 * width + x)
        _put_across(buffers, 0, x, bracket, x <= xb)
        bracket, left_0 = _along(buffers, 1, 0, xb, _shift(buffers, here + xb, here + behind), 6 * width + behind)
        _put_across(buffers, 0, xb, bracket, x < xb)
        if count > 1:
            shift = _shift(buffers, next_row + x, next_row + before)
            bracket, right_1 = _along(buffers, 2, 1, x, shift, 14 * width + x)
            _put_across(buffers, 1, x, bracket, x <= xb)
            shift = _shift(buffers, next_row + xb, next_row + behind)
            bracket, left_1 = _along(buffers, 3, 1, xb, shift, 14 * width + behind)
            _put_across(buffers, 1, xb, bracket, x < xb)
        low_right_0, low_left_0, low_right_1, low_left_1 = lowest_of_4(right_0, left_0, right_1, left_1)
        store(paths.chains, LANES, subtract(right_0, low_right_0))
        store(paths.chains, 2 * LANES, subtract(left_0, low_left_0))
        if count > 1:
            store(paths.chains, 3 * LANES, subtract(right_1, low_right_1))
            store(paths.chains, 4 * LANES, subtract(left_1, low_left_1))


@inline
def prepare_narrow_rows(
    rows: Any, buffers: NarrowBuffers, guide: NDArray[np.uint8], penalties: Penalties, y: int, step: int, count: int
) -> None:
    """Costs, penalties and paths along the row of row `y` and, if `count` is 2, of the next one of the sweep."""
    paths = buffers.paths
    size = paths.width * LANES
    for n in range(count):
        _narrow_costs(rows, buffers, y + n * step, 0, paths.width, n * size)
        place = 8 * n * paths.width
        diagonals = len(paths.diagonals) > 0
        write_penalties(guide, y + n * step, 0, paths.width, step, diagonals, True, penalties, place, paths.penalties)
    _horizontals(buffers, y * paths.width, (y + step) * paths.width, count)


@inline
def finish_narrow_part(
    buffers: NarrowBuffers, guide: NDArray[np.uint8], half: int, y: int, step: int, k: int, x0: int, x1: int,
    sums: NDArray[Any], both: bool,
) -> None:  # fmt: skip
    """Sum all paths of columns x0..x1 of row `y`, the `k`-th of its sweep; `prepare_narrow_rows` has been there.

    `half` tells which of the two rows in the buffers it is. If there are `both` sweeps, the other one left its part in
    `sums`. The sums go to the beginning of the buffers' `total`.
    """
    paths = buffers.paths
    width = paths.width
    here = y * width
    before = _row_before(buffers, guide, y, step)
    for x in range(x0, x1):
        cost = load(paths.cost, (half * width + x) * LANES)
        brackets = _from_row_before(buffers, x, k % width, here + x, before + x, 8 * half * width + x, cost, sums[0])
        at = (here + x) * LANES
        if both:
            prefetch(sums, at + CHUNK * LANES)
        total = sum_of_sweep(paths, cost, brackets)
        across = load(paths.across, (half * width + x) * LANES)
        if both:
            total = add_others(paths, total, across, sums, at, True)
        else:
            total = add_others(paths, total, across, sums, 0, False)
        store(paths.total, (x - x0) * LANES, total)
