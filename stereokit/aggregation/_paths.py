"""The compiled half of semi-global matching: paths of one row at a time.

Where what lives (``P`` levels to a pixel, one byte each, all rows of one worker fit its caches)::

    cost    (2, W, P)   costs of two rows, from the cost's row producer
    across  (2, W, P)   sums of the brackets of the two paths along each of those rows
    chains  (4, P)      the path costs that those four paths have got to
    state   (3, W, P)   path costs of the three paths that come from the row before
    least   (3, W)      the smallest path cost of each
    total   (32, P)     16 bit, sum over all paths of a few pixels: what selection reads
    sums    (H, W, P)   sum of the three brackets of the sweep that came first; the only volume
    kept    (H, W)      smallest path cost of each pixel, where `sums` holds path costs instead (see below)

The diagonal paths stay in place: the path that arrives at column ``x`` in sweep row ``k`` lives in slot ``x - k``
(modulo W), or ``x + k`` for the other diagonal, so nothing is ever shifted.

A path cost is ``L = C + B`` with the *bracket* ``B(d) = min(L'(d), L'(d-1) + P1, L'(d+1) + P1, min L' + P2) - min L'``
of the pixel before (Hirschmueller 2008, equation 13), so ``0 <= B <= P2``, and the sum over n paths is
``n * C + sum B``. Costs up to ``C_max`` therefore stay exact in bytes while ``C_max + P2 <= 255``; the three
brackets of a sweep fit bytes while ``3 * P2 <= 255``, else `sums` is 16 bit. The 255 that pads the levels saturates
and never wins: seen from a level that exists it offers at least ``255 - C_max >= P2``.

With 4 paths a sweep has one bracket, and costs that are dear to compute are not computed twice: the first visit
leaves the path costs ``L`` of its vertical path in `sums`. The bracket of row y follows from the path costs of the row
that the path came from, and what is left of ``L`` is the cost (`recover_row`): the volume holds both. The sum over the
paths is then ``3 * C + L`` and the other three brackets.

Bound and measurement, 4 paths with recovered costs, 1242x375 with 128 levels (931 500 vectors of 64 cells), one thread
of a Zen 4 that begins two 512-bit operations per cycle of 3.65 GHz (0.13 ms per operation and volume) and moves
about 10 GB/s beyond its caches (6 ms per volume); operations are those on vectors, loads and stores apart::

                                     operations   bytes        bound     measured
    vertical path, first visit       12           writes 59.6M  5.6 ms    5.6 ms
    costs recovered                  11           reads 59.6M   5.6 ms    5.7 ms
    both paths along the row         26 + 10      caches        4.6 ms    5.4 ms
    vertical path and sum            33           caches        4.2 ms    8.5 ms
    selection                        10 + 15      caches        3.2 ms    3.5 ms

The volume lives outside the caches: its two passes are bound by memory, the rest by the arithmetic. So it is written
past the caches, which spares reading it first, and asked for `CHUNK` pixels ahead of its use, as the processor's own
prefetching ends with every page. The sum stays furthest from its bound: widening bytes to words takes half of its
operations, on ports that few of them share.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import cost_row
from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.simd import (
    LANES,
    add,
    add_saturated,
    convert,
    either,
    first_lane,
    load,
    lowest,
    lowest_of_4,
    minimum,
    multiply,
    prefetch,
    shift_down,
    shift_up,
    splat,
    splat_at,
    store,
    stream,
    stream_end,
    subtract,
)

__all__ = ["CHUNK", "PathBuffers", "Penalties", "finish_part", "first_visit", "prepare_rows", "start"]


CHUNK = 32
"""Pixels whose sums are selected while they are still in the first-level cache."""


class Penalties(NamedTuple):
    """P1 and P2 of a step, in steps of cost."""

    edge: np.int16  # grey difference from which the lower ones hold
    p1: np.uint8
    p2: np.uint8
    p1_edge: np.uint8
    p2_edge: np.uint8


class PathBuffers(NamedTuple):
    """Buffers of one worker (flat arrays; see the module's picture)."""

    blocks: tuple[int, ...]  # one element per 64 levels: its length is known to the compiler
    diagonals: bool
    paths: int
    width: int
    small: bool  # 4 paths, no level pads, and 4 costs and a bracket fit a byte
    few: bool  # no level pads, and what is stored of the other sweep and the brackets along the row fit a byte
    cost: NDArray[np.uint8]
    across: NDArray[Any]
    chains: NDArray[np.uint8]
    state: NDArray[np.uint8]
    least: NDArray[np.uint8]
    penalties: NDArray[np.uint8]  # (2, 4, 2, W): by row, p1 and p2 of each pixel for three paths, then along it
    total: NDArray[np.uint16]
    kept: NDArray[np.uint8]  # or empty, when costs are computed twice
    padding: NDArray[np.uint8]  # (P): 0 for levels that exist, 255 for those that pad


@inline
def _bracket(below: Any, here: Any, above: Any, p1: Any, p2: Any) -> Any:
    """min(L'(d), L'(d-1) + P1, L'(d+1) + P1, P2) of path costs whose minimum was taken off."""
    step = add_saturated(minimum(shift_up(below, here), shift_down(here, above)), p1)
    return minimum(minimum(step, here), p2)


@kernel
def start(buffers: PathBuffers) -> None:
    """Begin a sweep: no path has come from anywhere yet."""
    zero = splat(np.uint8(0))
    size = buffers.width * LANES * len(buffers.blocks)
    for at in range(0 if buffers.diagonals else size, 3 * size if buffers.diagonals else 2 * size, LANES):
        store(buffers.state, at, zero)
    buffers.least[:] = 0


@inline
def _penalise(here: NDArray[np.uint8], other: NDArray[np.uint8], penalties: Penalties, p1: Any, p2: Any) -> None:
    """Write the penalties of steps between pixels of two grey rows into `p1` and `p2`."""
    for x in range(here.size):
        jump = abs(np.int16(np.int16(here[x]) - np.int16(other[x])))
        p1[x] = penalties.p1_edge if jump >= penalties.edge else penalties.p1
        p2[x] = penalties.p2_edge if jump >= penalties.edge else penalties.p2


@inline
def _penalise_from(
    guide: NDArray[np.uint8], y: int, y2: int, shift: int, penalties: Penalties, low: int, out: NDArray[np.uint8]
) -> None:
    """Write the penalties between pixels x of row `y` and x + shift of row `y2`, x + shift clamped; shift is +-1 or 0.

    P1 goes to ``out[low:]``, P2 behind it.
    """
    width = guide.shape[1]
    first = max(0, -shift)
    end = width - max(0, shift)
    here = guide[y, first:end]
    other = guide[y2, first + shift : end + shift]
    _penalise(here, other, penalties, out[low + first : low + end], out[low + width + first : low + width + end])
    if shift != 0:
        x = 0 if shift < 0 else width - 1
        here = guide[y, x : x + 1]
        other = guide[y2, x : x + 1]
        _penalise(here, other, penalties, out[low + x : low + x + 1], out[low + width + x : low + width + x + 1])


@inline
def _look_up(
    guide: NDArray[np.uint8], y: int, step: int, diagonals: bool, along: bool, penalties: Penalties, base: int,
    out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Penalties of row `y`, by grey difference, for the steps of the paths from the row before and `along` the row."""
    height, width = guide.shape
    before = min(max(y - step, 0), height - 1)
    for direction in range(3):
        if direction == 1 or diagonals:
            shift = direction - 1  # the path in slot x - k comes from the left, the one in x + k from the right
            _penalise_from(guide, y, before, shift, penalties, base + 2 * direction * width, out)
    if along:
        _penalise_from(guide, y, y, -1, penalties, base + 6 * width, out)


@inline
def _step_along(buffers: PathBuffers, chain: int, at: int, pixel: int, low: Any, first: bool) -> Any:
    """Take one path along a row to the pixel whose costs are at `at`; return path costs that have its smallest.

    `chain` is where the path's last costs are kept, `pixel` whose penalties hold for the step, `low` the smallest of
    the last costs. The bracket is put into `across`, or added to what the `first` path left there.
    """
    padded = LANES * len(buffers.blocks)
    chains = buffers.chains
    full = splat(np.uint8(255))
    like = buffers.across[0]
    p1 = splat_at(buffers.penalties, 6 * buffers.width + pixel)
    p2 = splat_at(buffers.penalties, 7 * buffers.width + pixel)
    smallest = full
    below = full
    here = subtract(load(chains, chain), low)
    for block in range(0, padded, LANES):
        above = full
        if block + LANES < padded:
            above = subtract(load(chains, chain + block + LANES), low)
        bracket = _bracket(below, here, above, p1, p2)
        path = add_saturated(load(buffers.cost, at + block), bracket)
        store(chains, chain + block, path)
        smallest = minimum(smallest, path)
        wide = convert(bracket, like)
        if not first:
            wide = add(wide, load(buffers.across, at + block))
        store(buffers.across, at + block, wide)
        below = here
        here = above
    return smallest


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
    right_0 = zero
    left_0 = zero
    right_1 = zero
    left_1 = zero
    for x in range(width):
        xb = width - 1 - x
        behind = min(xb + 1, width - 1)  # the step into xb from the right has the jump between xb and xb + 1
        least_right_0 = _step_along(buffers, 0, x * padded, x, right_0, x <= xb)
        least_left_0 = _step_along(buffers, padded, xb * padded, behind, left_0, x < xb)
        least_right_1 = zero
        least_left_1 = zero
        if rows > 1:
            least_right_1 = _step_along(buffers, 2 * padded, size + x * padded, 8 * width + x, right_1, x <= xb)
            least_left_1 = _step_along(buffers, 3 * padded, size + xb * padded, 8 * width + behind, left_1, x < xb)
        right_0, left_0, right_1, left_1 = lowest_of_4(least_right_0, least_left_0, least_right_1, least_left_1)


@inline
def _verticals(
    buffers: PathBuffers, slot: int, k: int, x0: int, x1: int, sums: NDArray[Any], base: int, last: bool, stored: bool,
    past: bool,
) -> None:  # fmt: skip
    """Advance the paths from the row before to sweep row `k`, columns x0..x1.

    `slot` says which of the two rows in the buffers it is. Before the last visit the sum of their brackets (or the
    path costs, if those are kept) goes to ``sums[base:]``, `past` the caches or through them; at the last one
    everything is summed into `total`, with what the other sweep left in `sums` if `stored`.
    """
    width = buffers.width
    padded = LANES * len(buffers.blocks)
    state = buffers.state
    least = buffers.least
    full = splat(np.uint8(255))
    zero = splat(np.uint8(0))
    narrow = np.uint8(0)
    wide = np.uint16(0)
    # Kept path costs hold one cost themselves.
    times = splat(np.uint16(buffers.paths - 1 if buffers.kept.size > 0 else buffers.paths))
    like = sums[0]
    turn = k % width
    here = slot * width * padded
    penalties = 8 * slot * width
    kept = buffers.kept.size > 0
    row = base // padded
    for x in range(x0, x1):
        slot_a = x - turn
        if slot_a < 0:
            slot_a += width
        slot_c = x + turn
        if slot_c >= width:
            slot_c -= width
        a = slot_a * padded
        b = (width + x) * padded
        c = (2 * width + slot_c) * padded
        if buffers.diagonals and x == 0:
            least[slot_a] = 0
            for block in range(0, padded, LANES):
                store(state, a + block, zero)
        if buffers.diagonals and x == width - 1:
            least[2 * width + slot_c] = 0
            for block in range(0, padded, LANES):
                store(state, c + block, zero)
        p1_a = splat_at(buffers.penalties, penalties + x)
        p2_a = splat_at(buffers.penalties, penalties + width + x)
        p1_b = splat_at(buffers.penalties, penalties + 2 * width + x)
        p2_b = splat_at(buffers.penalties, penalties + 3 * width + x)
        p1_c = splat_at(buffers.penalties, penalties + 4 * width + x)
        p2_c = splat_at(buffers.penalties, penalties + 5 * width + x)
        low_a = splat_at(least, slot_a)
        low_b = splat_at(least, width + x)
        low_c = splat_at(least, 2 * width + slot_c)
        smallest_a = full
        smallest_b = full
        smallest_c = full
        below_a = full
        below_b = full
        below_c = full
        here_a = full
        here_c = full
        above_a = full
        above_c = full
        here_b = subtract(load(state, b), low_b)
        if buffers.diagonals:
            here_a = subtract(load(state, a), low_a)
            here_c = subtract(load(state, c), low_c)
        for n in range(len(buffers.blocks)):
            block = n * LANES
            at = x * padded + block
            cost = load(buffers.cost, here + at)
            above_b = full
            if n + 1 < len(buffers.blocks):
                above_b = subtract(load(state, b + block + LANES), low_b)
            bracket_b = _bracket(below_b, here_b, above_b, p1_b, p2_b)
            path_b = add_saturated(cost, bracket_b)
            store(state, b + block, path_b)
            smallest_b = minimum(smallest_b, path_b)
            below_b = here_b
            here_b = above_b
            part = convert(bracket_b, like)
            if buffers.diagonals:
                above_a = full
                above_c = full
                if n + 1 < len(buffers.blocks):
                    above_a = subtract(load(state, a + block + LANES), low_a)
                    above_c = subtract(load(state, c + block + LANES), low_c)
                bracket_a = _bracket(below_a, here_a, above_a, p1_a, p2_a)
                bracket_c = _bracket(below_c, here_c, above_c, p1_c, p2_c)
                path_a = add_saturated(cost, bracket_a)
                path_c = add_saturated(cost, bracket_c)
                store(state, a + block, path_a)
                store(state, c + block, path_c)
                smallest_a = minimum(smallest_a, path_a)
                smallest_c = minimum(smallest_c, path_c)
                below_a = here_a
                here_a = above_a
                below_c = here_c
                here_c = above_c
                part = add(part, add(convert(bracket_a, like), convert(bracket_c, like)))
            if last:
                if buffers.small:
                    twice = add(cost, cost)
                    total = convert(add(add(twice, cost if kept else twice), bracket_b), wide)
                else:
                    total = add(convert(part, wide), multiply(convert(cost, wide), times))
                if stored and not kept:
                    prefetch(sums, base + at + CHUNK * padded)
                across = load(buffers.across, here + at)
                if stored and buffers.few:
                    others = add(convert(across, narrow), convert(load(sums, base + at), narrow))
                    total = add(total, convert(others, wide))
                else:
                    total = add(total, convert(across, wide))
                    if stored:
                        total = add(total, convert(load(sums, base + at), wide))
                store(buffers.total, at - x0 * padded, total)
            else:
                remains = convert(path_b, like) if kept else part
                if past:
                    stream(sums, base + at, remains)
                else:
                    store(sums, base + at, remains)
        if buffers.diagonals:
            one, two, three, _ = lowest_of_4(smallest_a, smallest_b, smallest_c, smallest_c)
            least[slot_a] = first_lane(one)
            least[width + x] = first_lane(two)
            least[2 * width + slot_c] = first_lane(three)
        else:
            lowest_b = lowest(smallest_b)
            least[width + x] = lowest_b
            if kept and not last:
                buffers.kept[row + x] = lowest_b


@kernel
def first_visit(
    rows: Any, buffers: PathBuffers, guide: NDArray[np.uint8], penalties: Penalties, y0: int, y1: int,
    sums: NDArray[Any], near: int,
) -> None:  # fmt: skip
    """Sweep from row `y0` to before row `y1` (upwards when y1 < y0); leave the brackets in `sums`.

    The last `near` elements are written through the caches, all before them past the caches.
    """
    step = 1 if y1 > y0 else -1
    size = buffers.width * LANES * len(buffers.blocks)
    for k in range(abs(y1 - y0)):
        y = y0 + k * step
        cost_row(rows, y, buffers.cost)
        _look_up(guide, y, step, buffers.diagonals, False, penalties, 0, buffers.penalties)
        if (abs(y1 - y0) - k) * size > near:
            _verticals(buffers, 0, k, 0, buffers.width, sums, y * size, False, False, True)
        else:
            _verticals(buffers, 0, k, 0, buffers.width, sums, y * size, False, False, False)
    stream_end()


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
    _look_up(guide, y, -step, False, False, penalties, 0, buffers.penalties)
    for x in range(width):
        p1_b = splat_at(buffers.penalties, 2 * width + x)
        p2_b = splat_at(buffers.penalties, 3 * width + x)
        at = (y * width + x) * padded
        source = (before * width + x) * padded
        low = zero
        below = full
        here = zero
        if not first:
            low = splat_at(buffers.kept, before * width + x)
            here = subtract(convert(load(sums, source), narrow), low)
        for n in range(len(buffers.blocks)):
            block = n * LANES
            above = full
            if n + 1 < len(buffers.blocks) and not first:
                above = subtract(convert(load(sums, source + block + LANES), narrow), low)
            bracket = _bracket(below, here, above, p1_b, p2_b)
            if first:
                bracket = zero
            prefetch(sums, source + block + CHUNK * padded)
            cost = subtract(convert(load(sums, at + block), narrow), bracket)
            if n + 1 == len(buffers.blocks):
                cost = either(cost, load(buffers.padding, block))
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
        if buffers.kept.size > 0:
            recover_row(buffers, guide, penalties, y + n * step, step, n * size, sums)
        else:
            cost_row(rows, y + n * step, buffers.cost[n * size : (n + 1) * size])
    for n in range(count):
        base = 8 * n * buffers.width
        _look_up(guide, y + n * step, step, buffers.diagonals, True, penalties, base, buffers.penalties)
    _horizontals(buffers, count)


@inline
def finish_part(
    buffers: PathBuffers, slot: int, y: int, k: int, x0: int, x1: int, sums: NDArray[Any], stored: bool
) -> None:
    """Sum all paths of columns x0..x1 of row `y`, the `k`-th of its sweep; `prepare_rows` has been there.

    The sums go to the beginning of ``buffers.total``.
    """
    if stored:
        _verticals(buffers, slot, k, x0, x1, sums, y * buffers.width * LANES * len(buffers.blocks), True, True, False)
    else:
        _verticals(buffers, slot, k, x0, x1, sums, 0, True, False, False)
