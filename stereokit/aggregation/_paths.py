"""The compiled half of semi-global matching: paths of one row at a time.

Where what lives (``P`` levels to a pixel, one byte each, all rows of one worker fit its caches)::

    cost    (W, P)      costs of the row at hand, from the cost's row producer
    across  (W, P)      sum of the brackets of the two horizontal paths of that row
    state   (3, W, P)   path costs of the three paths that come from the row before
    least   (3, W)      the smallest path cost of each
    total   (W, P)      16 bit, sum over all paths: what selection reads
    sums    (H, W, P)   sum of the three brackets of the sweep that came first; the only volume

The diagonal paths stay in place: the path that arrives at column ``x`` in sweep row ``k`` lives in slot ``x - k``
(modulo W), or ``x + k`` for the other diagonal, so nothing is ever shifted.

A path cost is ``L = C + B`` with the *bracket* ``B(d) = min(L'(d), L'(d-1) + P1, L'(d+1) + P1, min L' + P2) - min L'``
of the pixel before (Hirschmueller 2008, equation 13), so ``0 <= B <= P2``, and the sum over n paths is
``n * C + sum B``. Costs up to ``C_max`` therefore stay exact in bytes while ``C_max + P2 <= 255``; the three
brackets of a sweep fit bytes while ``3 * P2 <= 255``, else `sums` is 16 bit. The 255 that pads the levels saturates
and never wins: seen from a level that exists it offers at least ``255 - C_max >= P2``.
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
    load,
    lowest,
    lowest_of_3,
    minimum,
    multiply,
    shift_down,
    shift_up,
    splat,
    store,
    subtract,
)

__all__ = ["PathBuffers", "first_visit", "last_visit_row", "start"]


class PathBuffers(NamedTuple):
    """Buffers of one worker (flat arrays; see the module's picture)."""

    blocks: tuple[int, ...]  # one element per 64 levels: its length is known to the compiler
    diagonals: bool
    paths: int
    width: int
    cost: NDArray[np.uint8]
    across: NDArray[Any]
    chains: NDArray[np.uint8]
    state: NDArray[np.uint8]
    least: NDArray[np.uint8]
    penalties: NDArray[np.uint8]  # (4, 2, W): p1 and p2 of each pixel for the three paths, then along the row
    total: NDArray[np.uint16]


@inline
def _bracket(below: Any, here: Any, above: Any, p1: Any, p2: Any) -> Any:
    """min(L'(d), L'(d-1) + P1, L'(d+1) + P1, P2) of path costs whose minimum was taken off."""
    step = add_saturated(minimum(shift_up(below, here), shift_down(here, above)), p1)
    return minimum(minimum(step, here), p2)


@kernel
def start(buffers: PathBuffers) -> None:
    """Begin a sweep: no path has come from anywhere yet."""
    buffers.state[:] = 0
    buffers.least[:] = 0


@inline
def _look_up(
    guide: NDArray[np.uint8], y: int, step: int, p1: NDArray[np.uint8], p2: NDArray[np.uint8],
    out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Penalties of row `y` for steps along the three paths of the sweep and along the row, by grey difference."""
    height, width = guide.shape
    before = min(max(y - step, 0), height - 1)
    for direction in range(3):
        shift = direction - 1  # the path in slot x - k comes from the left, the one in x + k from the right
        for x in range(width):
            other = min(max(x + shift, 0), width - 1)
            jump = abs(np.int32(guide[y, x]) - np.int32(guide[before, other]))
            out[2 * direction * width + x] = p1[jump]
            out[(2 * direction + 1) * width + x] = p2[jump]
    for x in range(width):
        jump = abs(np.int32(guide[y, x]) - np.int32(guide[y, max(x - 1, 0)]))
        out[6 * width + x] = p1[jump]
        out[7 * width + x] = p2[jump]


@inline
def _horizontals(buffers: PathBuffers) -> None:
    """Both paths along the row; they run as one loop because each alone would wait for its own minimum."""
    width = buffers.width
    padded = LANES * len(buffers.blocks)
    chains = buffers.chains
    full = splat(np.uint8(255))
    zero = splat(np.uint8(0))
    for block in range(0, 2 * padded, LANES):
        store(chains, block, zero)
    like = buffers.across[0]
    low_a = zero
    low_b = zero
    for x in range(width):
        xb = width - 1 - x
        behind = min(xb + 1, width - 1)  # the step into xb from the right has the jump between xb and xb + 1
        p1_a = splat(buffers.penalties[6 * width + x])
        p2_a = splat(buffers.penalties[7 * width + x])
        p1_b = splat(buffers.penalties[6 * width + behind])
        p2_b = splat(buffers.penalties[7 * width + behind])
        smallest_a = full
        smallest_b = full
        below_a = full
        below_b = full
        here_a = subtract(load(chains, 0), low_a)
        here_b = subtract(load(chains, padded), low_b)
        for k in range(len(buffers.blocks)):
            block = k * LANES
            if k + 1 < len(buffers.blocks):
                above_a = subtract(load(chains, block + LANES), low_a)
                above_b = subtract(load(chains, padded + block + LANES), low_b)
            else:
                above_a = full
                above_b = full
            bracket_a = _bracket(below_a, here_a, above_a, p1_a, p2_a)
            bracket_b = _bracket(below_b, here_b, above_b, p1_b, p2_b)
            at_a = x * padded + block
            at_b = xb * padded + block
            cost_a = add_saturated(load(buffers.cost, at_a), bracket_a)
            cost_b = add_saturated(load(buffers.cost, at_b), bracket_b)
            store(chains, block, cost_a)
            store(chains, padded + block, cost_b)
            smallest_a = minimum(smallest_a, cost_a)
            smallest_b = minimum(smallest_b, cost_b)
            wide_a = convert(bracket_a, like)
            wide_b = convert(bracket_b, like)
            if x < xb:
                store(buffers.across, at_a, wide_a)
                store(buffers.across, at_b, wide_b)
            elif x == xb:
                store(buffers.across, at_a, add(wide_a, wide_b))
            else:
                store(buffers.across, at_a, add(load(buffers.across, at_a), wide_a))
                store(buffers.across, at_b, add(load(buffers.across, at_b), wide_b))
            below_a = here_a
            below_b = here_b
            here_a = above_a
            here_b = above_b
        low_a = splat(lowest(smallest_a))
        low_b = splat(lowest(smallest_b))


@inline
def _verticals(buffers: PathBuffers, k: int, sums: NDArray[Any], base: int, last: bool, stored: bool) -> None:
    """Advance the paths from the row before to sweep row `k`.

    Before the last visit their brackets are added into ``sums[base:]``; at the last one everything is summed
    into `total`, with what the other sweep left in `sums` if `stored`.
    """
    width = buffers.width
    padded = LANES * len(buffers.blocks)
    state = buffers.state
    least = buffers.least
    full = splat(np.uint8(255))
    zero = splat(np.uint8(0))
    wide = np.uint16(0)
    times = splat(np.uint16(buffers.paths))
    like = sums[0]
    turn = k % width
    for x in range(width):
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
        p1_a = splat(buffers.penalties[x])
        p2_a = splat(buffers.penalties[width + x])
        p1_b = splat(buffers.penalties[2 * width + x])
        p2_b = splat(buffers.penalties[3 * width + x])
        p1_c = splat(buffers.penalties[4 * width + x])
        p2_c = splat(buffers.penalties[5 * width + x])
        low_a = splat(least[slot_a])
        low_b = splat(least[width + x])
        low_c = splat(least[2 * width + slot_c])
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
            cost = load(buffers.cost, at)
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
                total = add(convert(part, wide), multiply(convert(cost, wide), times))
                total = add(total, convert(load(buffers.across, at), wide))
                if stored:
                    total = add(total, convert(load(sums, base + at), wide))
                store(buffers.total, at, total)
            else:
                store(sums, base + at, part)
        if buffers.diagonals:
            three = lowest_of_3(smallest_a, smallest_b, smallest_c)
            least[slot_a] = np.uint8(three & np.uint32(255))
            least[width + x] = np.uint8((three >> np.uint32(8)) & np.uint32(255))
            least[2 * width + slot_c] = np.uint8((three >> np.uint32(16)) & np.uint32(255))
        else:
            least[width + x] = lowest(smallest_b)


@kernel
def first_visit(
    rows: Any, buffers: PathBuffers, guide: NDArray[np.uint8], p1: NDArray[np.uint8], p2: NDArray[np.uint8],
    y0: int, y1: int, sums: NDArray[Any],
) -> None:  # fmt: skip
    """Sweep from row `y0` to before row `y1` (upwards when y1 < y0); leave the brackets in `sums`."""
    step = 1 if y1 > y0 else -1
    size = buffers.width * LANES * len(buffers.blocks)
    for k in range(abs(y1 - y0)):
        y = y0 + k * step
        cost_row(rows, y, buffers.cost)
        _look_up(guide, y, step, p1, p2, buffers.penalties)
        _verticals(buffers, k, sums, y * size, False, False)


@inline
def last_visit_row(
    rows: Any, buffers: PathBuffers, guide: NDArray[np.uint8], p1: NDArray[np.uint8], p2: NDArray[np.uint8],
    y: int, step: int, k: int, sums: NDArray[Any], stored: bool,
) -> None:  # fmt: skip
    """Sweep row `y`, the `k`-th of its sweep; leave the sum over all paths in ``buffers.total``."""
    size = buffers.width * LANES * len(buffers.blocks)
    cost_row(rows, y, buffers.cost)
    _look_up(guide, y, step, p1, p2, buffers.penalties)
    _horizontals(buffers)
    if stored:
        _verticals(buffers, k, sums, y * size, True, True)
    else:
        _verticals(buffers, k, sums, 0, True, False)
