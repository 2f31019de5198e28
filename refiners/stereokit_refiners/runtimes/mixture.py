"""From the head of `stereokit_refiners.networks.evidence.Evidence` to the map: a weighted mean of values.

The head comes with its channels innermost, (H/4, W/4, C), as convolutions leave it in memory. Rows do not depend on
one another, so the result does not depend on how they are shared out between threads.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.threads import run, spans
from stereokit_refiners.networks.evidence import GAINS, LOGITS, WINDOWS
from stereokit_refiners.outputs.exponential import exponential
from stereokit_refiners.runtimes.evidence import Hypotheses

__all__ = ["mixture"]

assert WINDOWS == (3, 7)  # what the kernel is written for


def mixture(
    head: NDArray[np.float32], found: Hypotheses, rows: int, columns: int, threads: int = 1
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the map, and how sure it is.

    Parameters
    ----------
    head : (H/4, W/4, C) float32, C-contiguous
    found : Hypotheses
    rows, columns : int
        Size of the map, at most H x W.
    threads : int

    Returns
    -------
    disparity : (rows, columns) float32, pixels
    sure : (rows, columns) float32
        The share of like places that are right within 1.5 pixels, 0 to 1, as far as the network knows.
    """
    disparity = np.empty((rows, columns), np.float32)
    sure = np.empty((rows, columns), np.float32)
    parts = spans(-(-rows // 4), threads)
    width = found.half.shape[1]
    lines = [np.empty((14, width), np.float32) for _ in parts]
    sums = [np.empty((3, width + 8), np.int16) for _ in parts]
    wide = [np.empty((3, 2 * width), np.float32) for _ in parts]
    run(
        [
            partial(
                _mix, head, found.coarse, found.others, found.gains, found.base, found.apart, y0, y1,
                lines[k], sums[k], wide[k], disparity, sure,
            )
            for k, (y0, y1) in enumerate(parts)
        ],
        threads,
    )  # fmt: skip
    return disparity, sure


@inline
def _inside(y: Any, rows: Any) -> Any:
    return min(max(y, 0), rows - 1)


@inline
def _go_on(line: Any) -> None:
    """Fill four places at either end of a line with its first and its last value."""
    last = line.size - 5
    for x in range(4):
        line[x] = line[4]
        line[last + 1 + x] = line[last]


@inline
def _sum_rows(plane: Any, y: Any, near: Any, around: Any) -> None:
    """Sum three and seven rows of a plane around row y; lines have four places more at either end."""
    rows, width = plane.shape
    inner = near[4 : 4 + width]
    outer = around[4 : 4 + width]
    a = plane[_inside(y - 1, rows)]
    b = plane[_inside(y, rows)]
    c = plane[_inside(y + 1, rows)]
    for x in range(width):
        inner[x] = np.int16(np.int16(a[x]) + np.int16(b[x]) + np.int16(c[x]))
    a = plane[_inside(y - 3, rows)]
    b = plane[_inside(y - 2, rows)]
    c = plane[_inside(y + 2, rows)]
    d = plane[_inside(y + 3, rows)]
    for x in range(width):
        outer[x] = np.int16(inner[x] + np.int16(a[x]) + np.int16(b[x]) + np.int16(c[x]) + np.int16(d[x]))
    _go_on(near)
    _go_on(around)


@inline
def _by_two(line: Any, out: Any) -> None:
    for x in range(line.size):
        out[2 * x] = line[x]
        out[2 * x + 1] = line[x]


@kernel
def _mix(
    head: NDArray[np.float32], coarse: NDArray[np.float32], others: NDArray[np.float32], gains: NDArray[np.int8],
    base: int, apart: float, y0: int, y1: int, lines: NDArray[np.float32], sums: NDArray[np.int16],
    wide: NDArray[np.float32], disparity: NDArray[np.float32], sure: NDArray[np.float32],
) -> None:  # fmt: skip
    rows, columns = disparity.shape
    width = gains.shape[2]
    step = np.float32(apart)
    origin = np.float32(base)
    small = np.float32(1 / 16 / 9)
    large = np.float32(1 / 16 / 49)
    factors = lines[:4]
    share = lines[4]  # of the coarse map
    rest = lines[5]
    total = lines[6]
    certain = lines[7]
    logits = lines[8:14]
    near = sums[0]
    around = sums[1]
    three = sums[2]
    for y in range(y0, y1):
        pixels = head[y]
        for x in range(width // 2):
            for g in range(GAINS):
                factor = pixels[x, LOGITS + g] * (small if g < 2 else large)
                factors[g, 2 * x] = factor
                factors[g, 2 * x + 1] = factor
        for i in range(2):
            h = 2 * y + i
            for x in range(width // 2):
                for k in range(6):
                    logits[k, 2 * x] = pixels[x, 4 * k + 2 * i]
                    logits[k, 2 * x + 1] = pixels[x, 4 * k + 2 * i + 1]
                certain[2 * x] = pixels[x, LOGITS + GAINS + 2 * i]
                certain[2 * x + 1] = pixels[x, LOGITS + GAINS + 2 * i + 1]
            for k in range(6):
                _sum_rows(gains[k], h, near, around)
                for x in range(width + 6):
                    three[x + 1] = np.int16(around[x] + around[x + 1] + around[x + 2])
                prior = logits[k]
                first = factors[0 if k < 2 else 1]
                second = factors[2 if k < 2 else 3]
                for x in range(width):
                    less = np.float32(np.int32(near[x + 3]) + np.int32(near[x + 4]) + np.int32(near[x + 5]))
                    prior[x] += less * first[x]
                for x in range(width):
                    wider = np.float32(np.int32(three[x + 2]) + np.int32(around[x + 4]) + np.int32(three[x + 6]))
                    prior[x] = exponential(prior[x] + wider * second[x])
            less = logits[0]
            more = logits[1]
            for x in range(width):
                share[x] = np.float32(1) + less[x] + more[x]
            for x in range(width):
                rest[x] = (more[x] - less[x]) * step
            a = logits[2]
            b = logits[3]
            c = logits[4]
            d = logits[5]
            for x in range(width):
                total[x] = np.float32(1) / (share[x] + ((a[x] + b[x]) + (c[x] + d[x])))
            for k in range(4):
                weight = logits[2 + k]
                other = others[k, h]
                for x in range(width):
                    rest[x] += weight[x] * other[x]
            for x in range(width):
                share[x] *= total[x]
            for x in range(width):
                rest[x] *= total[x]
            for x in range(width):
                certain[x] = np.float32(1) / (np.float32(1) + exponential(-certain[x]))
            _by_two(share, wide[0])
            _by_two(rest, wide[1])
            _by_two(certain, wide[2])
            factor = wide[0]
            term = wide[1]
            like = wide[2]
            for r in range(2 * h, min(2 * h + 2, rows)):
                line = coarse[r]
                out = disparity[r]
                for x in range(columns):
                    out[x] = line[x] * factor[x] + term[x] + origin
                out = sure[r]
                for x in range(columns):
                    out[x] = like[x]
