"""Penalties of the steps between neighbouring pixels: lower where the guide has an edge."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline

__all__ = ["Penalties", "write_penalties"]


class Penalties(NamedTuple):
    """P1 and P2 of a step, in steps of cost."""

    edge: np.int16  # grey difference from which the lower ones hold
    p1: np.uint8
    p2: np.uint8
    p1_edge: np.uint8
    p2_edge: np.uint8


@inline
def _penalise(here: NDArray[np.uint8], other: NDArray[np.uint8], penalties: Penalties, p1: Any, p2: Any) -> None:
    """Write the penalties of steps between pixels of two grey rows into `p1` and `p2`."""
    for x in range(here.size):
        jump = abs(np.int16(np.int16(here[x]) - np.int16(other[x])))
        p1[x] = penalties.p1_edge if jump >= penalties.edge else penalties.p1
        p2[x] = penalties.p2_edge if jump >= penalties.edge else penalties.p2


@inline
def _penalise_from(
    guide: NDArray[np.uint8], y: int, y2: int, shift: int, penalties: Penalties, start: int, out: NDArray[np.uint8]
) -> None:
    """Write the penalties between pixels x of row `y` and x + shift of row `y2`, x + shift clamped; shift is +-1 or 0.

    P1 goes to ``out[start:]``, P2 behind it.
    """
    width = guide.shape[1]
    first = max(0, -shift)
    end = width - max(0, shift)
    here = guide[y, first:end]
    other = guide[y2, first + shift : end + shift]
    _penalise(
        here, other, penalties, out[start + first : start + end], out[start + width + first : start + width + end]
    )
    if shift != 0:
        x = 0 if shift < 0 else width - 1
        here = guide[y, x : x + 1]
        other = guide[y2, x : x + 1]
        at = start + x
        _penalise(here, other, penalties, out[at : at + 1], out[at + width : at + width + 1])


@inline
def write_penalties(
    guide: NDArray[np.uint8], y: int, x0: int, x1: int, step: int, diagonals: bool, along: bool, penalties: Penalties,
    start: int, out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Write the penalties of row `y` for the steps of the paths from the row before and `along` the row.

    They go to ``out[start:]``: P1 and P2 of each pixel for the path from the left, the vertical one, the one from the
    right, and those along the row. Of the vertical path only those of columns x0..x1 are written.
    """
    height, width = guide.shape
    before = min(max(y - step, 0), height - 1)
    at = start + 2 * width
    _penalise(
        guide[y, x0:x1], guide[before, x0:x1], penalties, out[at + x0 : at + x1], out[at + width + x0 : at + width + x1]
    )
    if diagonals:
        for direction in (0, 2):
            _penalise_from(guide, y, before, direction - 1, penalties, start + 2 * direction * width, out)
    if along:
        _penalise_from(guide, y, y, -1, penalties, start + 6 * width, out)
