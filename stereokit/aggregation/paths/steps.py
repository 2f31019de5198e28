"""Steps of paths: one path through the levels of one pixel, and the three paths of a sweep together.

A step of a path takes the path costs of the pixel before, adds the bracket to the costs of the new pixel, and leaves
the new path costs in the place of the old ones, 64 levels at a time and upwards. What it needs of the block below,
which is overwritten by then, travels in `Path`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline
from stereokit.kernels.simd import (
    LANES,
    add,
    add_saturated,
    convert,
    first_lane,
    load,
    lowest,
    lowest_of_4,
    minimum,
    shift_down,
    shift_up,
    splat,
    splat_at,
    store,
    subtract,
)

__all__ = [
    "PathBuffers",
    "advance",
    "advance_paths",
    "bracket_of",
    "enter",
    "enter_paths",
    "leave_paths",
    "recovers_costs",
    "restart_diagonals",
    "slots_of",
]


class PathBuffers(NamedTuple):
    """Buffers of one worker (flat arrays; see the package's picture)."""

    blocks: tuple[int, ...]  # one element per 64 levels: its length is known to the compiler
    diagonals: tuple[int, ...]  # not empty where paths come from the left and the right of the row before, too
    paths: int
    width: int
    byte_costs: bool  # 4 paths, no level pads, and 4 costs and a bracket fit a byte
    byte_brackets: bool  # no level pads, and the other sweep's sums and the brackets along the row fit a byte together
    cost: NDArray[np.uint8]
    across: NDArray[Any]
    chains: NDArray[np.uint8]
    state: NDArray[np.uint8]
    lowest: NDArray[np.uint8]
    penalties: NDArray[np.uint8]  # (2, 4, 2, W): by row, P1 and P2 of each pixel for three paths, then along it
    total: NDArray[np.uint16]
    path_minimum: NDArray[np.uint8]  # or empty, when both sweeps compute the costs
    padding: NDArray[np.uint8]  # (P): 0 for levels that exist, 255 for those that pad


class Path(NamedTuple):
    """A path on its way up through the levels of a pixel; vectors of 64 levels.

    Path costs of the pixel before come without their smallest.
    """

    place: int  # of its path costs, for level 0
    low: Any  # the smallest path cost of the pixel before, in every lane
    p1: Any
    p2: Any
    below: Any  # path costs of the pixel before, block below
    here: Any  # and block to come
    smallest: Any  # of the new path costs so far, lane by lane


class Slots(NamedTuple):
    """Pixels of `state` and `lowest` that hold the three paths which arrive at one pixel."""

    from_left: int
    straight: int
    from_right: int


class Paths(NamedTuple):
    """The three paths that come from the row before."""

    from_left: Path
    straight: Path
    from_right: Path


@inline
def recovers_costs(buffers: PathBuffers) -> bool:
    """Whether the other sweep left path costs, from which the costs are recovered."""
    return buffers.path_minimum.size > 0


@inline
def bracket_of(below: Any, here: Any, above: Any, p1: Any, p2: Any) -> Any:
    """min(L'(d), L'(d-1) + P1, L'(d+1) + P1, P2) of path costs without their smallest."""
    step = add_saturated(minimum(shift_up(below, here), shift_down(here, above)), p1)
    return minimum(minimum(step, here), p2)


@inline
def enter(costs: NDArray[np.uint8], place: int, low: Any, p1: Any, p2: Any) -> Path:
    """Begin a step of the path whose costs lie at `place`, `low` the smallest of them."""
    full = splat(np.uint8(255))
    return Path(place, low, p1, p2, full, subtract(load(costs, place), low), full)


@inline
def advance(costs: NDArray[np.uint8], path: Path, block: int, top: bool, cost: Any) -> tuple[Any, Any, Path]:
    """Take a path through 64 levels from `block` on, the last ones if `top`; return bracket, path costs and path."""
    above = splat(np.uint8(255))
    if not top:
        above = subtract(load(costs, path.place + block + LANES), path.low)
    bracket = bracket_of(path.below, path.here, above, path.p1, path.p2)
    path_cost = add_saturated(cost, bracket)
    store(costs, path.place + block, path_cost)
    smallest = minimum(path.smallest, path_cost)
    return bracket, path_cost, Path(path.place, path.low, path.p1, path.p2, path.here, above, smallest)


@inline
def slots_of(width: int, turn: int, x: int) -> Slots:
    """Slots of the paths that arrive at column `x` in a sweep row whose number is `turn` modulo the width."""
    left = x - turn
    if left < 0:
        left += width
    right = x + turn
    if right >= width:
        right -= width
    return Slots(left, width + x, 2 * width + right)


@inline
def _restart(buffers: PathBuffers, slot: int) -> None:
    """Let a path begin anew: its costs become 0."""
    padded = LANES * len(buffers.blocks)
    buffers.lowest[slot] = 0
    for block in range(0, padded, LANES):
        store(buffers.state, slot * padded + block, splat(np.uint8(0)))


@inline
def restart_diagonals(buffers: PathBuffers, slots: Slots, x: int) -> None:
    """Let the diagonal paths that enter the image at column `x` begin anew."""
    if len(buffers.diagonals) > 0 and x == 0:
        _restart(buffers, slots.from_left)
    if len(buffers.diagonals) > 0 and x == buffers.width - 1:
        _restart(buffers, slots.from_right)


@inline
def _enter_slot(buffers: PathBuffers, slot: int, penalties: int) -> Path:
    """Begin a step of the path in a slot, with the penalties of its pixel."""
    p1 = splat_at(buffers.penalties, penalties)
    p2 = splat_at(buffers.penalties, penalties + buffers.width)
    return enter(buffers.state, slot * LANES * len(buffers.blocks), splat_at(buffers.lowest, slot), p1, p2)


@inline
def enter_paths(buffers: PathBuffers, slots: Slots, penalties: int) -> Paths:
    """Begin the step of the three paths; `penalties` is the place of the pixel's P1 for the path from the left."""
    straight = _enter_slot(buffers, slots.straight, penalties + 2 * buffers.width)
    from_left = straight
    from_right = straight
    if len(buffers.diagonals) > 0:
        from_left = _enter_slot(buffers, slots.from_left, penalties)
        from_right = _enter_slot(buffers, slots.from_right, penalties + 4 * buffers.width)
    return Paths(from_left, straight, from_right)


@inline
def advance_paths(buffers: PathBuffers, paths: Paths, n: int, cost: Any, like: Any) -> tuple[Any, Any, Paths]:
    """Take the paths through block `n` of the levels.

    Return the sum of their brackets in the type of `like`, the costs of the vertical path, and the paths.
    """
    block = n * LANES
    top = n + 1 == len(buffers.blocks)
    from_left = paths.from_left
    from_right = paths.from_right
    bracket, path_cost, straight = advance(buffers.state, paths.straight, block, top, cost)
    brackets = convert(bracket, like)
    if len(buffers.diagonals) > 0:
        bracket_left, _, from_left = advance(buffers.state, from_left, block, top, cost)
        bracket_right, _, from_right = advance(buffers.state, from_right, block, top, cost)
        brackets = add(brackets, add(convert(bracket_left, like), convert(bracket_right, like)))
    return brackets, path_cost, Paths(from_left, straight, from_right)


@inline
def leave_paths(buffers: PathBuffers, slots: Slots, paths: Paths) -> Any:
    """End the step: write the smallest path costs; return that of the vertical path."""
    straight = paths.straight.smallest
    if len(buffers.diagonals) > 0:
        left, middle, right, _ = lowest_of_4(paths.from_left.smallest, straight, paths.from_right.smallest, straight)
        low = first_lane(middle)
        buffers.lowest[slots.from_left] = first_lane(left)
        buffers.lowest[slots.from_right] = first_lane(right)
    else:
        low = lowest(straight)
    buffers.lowest[slots.straight] = low
    return low
