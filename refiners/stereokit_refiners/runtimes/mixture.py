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
from stereokit_refiners.runtimes.evidence import Hypotheses

__all__ = ["mixture"]

_SMALL, _LARGE = (side // 2 for side in WINDOWS)


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
    sums = [np.empty((3, width + 8), np.int32) for _ in parts]
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
def _exponential(x: Any) -> Any:
    """Return e**x to about 1e-6, for x from -40 to 40: a polynomial times a power of two, which is made of its bits."""
    x = min(max(x, np.float32(-40)), np.float32(40)) * np.float32(1.4426950408889634)
    whole = np.floor(x + np.float32(0.5))
    z = (x - whole) * np.float32(0.6931471805599453)
    p = np.float32(1 / 720)
    p = p * z + np.float32(1 / 120)
    p = p * z + np.float32(1 / 24)
    p = p * z + np.float32(1 / 6)
    p = p * z + np.float32(0.5)
    p = p * z + np.float32(1)
    p = p * z + np.float32(1)
    return p * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)


@inline
def _sum_rows(plane: Any, y: Any, reach: Any, line: Any) -> None:
    """Sum a plane's rows up to `reach` from row y; the line has four places more at either end."""
    width = plane.shape[1]
    last = np.int64(plane.shape[0] - 1)
    inner = line[4 : 4 + width]
    row = plane[y]
    for x in range(width):
        inner[x] = np.int32(row[x])
    for dy in range(1, reach + 1):
        above = plane[max(y - dy, 0)]
        below = plane[min(y + dy, last)]
        for x in range(width):
            inner[x] += np.int32(above[x]) + np.int32(below[x])
    for x in range(4):
        line[x] = inner[0]
        line[4 + width + x] = inner[width - 1]


@kernel
def _mix(
    head: NDArray[np.float32], coarse: NDArray[np.float32], others: NDArray[np.float32], gains: NDArray[np.int8],
    base: int, apart: float, y0: int, y1: int, lines: NDArray[np.float32], sums: NDArray[np.int32],
    wide: NDArray[np.float32], disparity: NDArray[np.float32], sure: NDArray[np.float32],
) -> None:  # fmt: skip
    rows, columns = disparity.shape
    width = gains.shape[2]
    step = np.float32(apart)
    origin = np.float32(base)
    small = np.float32(1 / 16 / (2 * _SMALL + 1) ** 2)
    large = np.float32(1 / 16 / (2 * _LARGE + 1) ** 2)
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
            for x in range(width):
                certain[x] = np.float32(1) / (np.float32(1) + _exponential(-certain[x]))
                share[x] = np.float32(1)
                rest[x] = np.float32(0)
                total[x] = np.float32(1)
            for k in range(6):
                _sum_rows(gains[k], h, _SMALL, near)
                _sum_rows(gains[k], h, _LARGE, around)
                for x in range(width + 6):
                    three[x + 1] = around[x] + around[x + 1] + around[x + 2]
                prior = logits[k]
                first = factors[0 if k < 2 else 1]
                second = factors[2 if k < 2 else 3]
                for x in range(width):
                    less = np.float32(np.int32(near[x + 3] + near[x + 4] + near[x + 5]))
                    wider = np.float32(np.int32(three[x + 2] + around[x + 4] + three[x + 6]))
                    prior[x] = _exponential(prior[x] + less * first[x] + wider * second[x])
                if k < 2:
                    value = step if k == 1 else -step
                    for x in range(width):
                        share[x] += prior[x]
                        rest[x] += prior[x] * value
                        total[x] += prior[x]
                else:
                    other = others[k - 2, h]
                    for x in range(width):
                        rest[x] += prior[x] * other[x]
                        total[x] += prior[x]
            for x in range(width):
                inverse = np.float32(1) / total[x]
                factor = share[x] * inverse
                term = rest[x] * inverse
                for j in range(2):
                    wide[0, 2 * x + j] = factor
                    wide[1, 2 * x + j] = term
                    wide[2, 2 * x + j] = certain[x]
            for r in range(2 * h, min(2 * h + 2, rows)):
                line = coarse[r]
                out = disparity[r]
                for x in range(columns):
                    out[x] = line[x] * wide[0, x] + wide[1, x] + origin
                out = sure[r]
                for x in range(columns):
                    out[x] = wide[2, x]
