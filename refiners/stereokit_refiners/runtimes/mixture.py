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
from stereokit_refiners.networks.evidence import GAINS, LOGITS
from stereokit_refiners.runtimes.evidence import Hypotheses

__all__ = ["mixture"]


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
    lines = [np.empty((15, found.coarse.shape[1]), np.float32) for _ in parts]
    run(
        [
            partial(
                _mix, head, found.coarse, found.others, found.around, found.base, found.apart, y0, y1,
                lines[k], disparity, sure,
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


@kernel
def _mix(
    head: NDArray[np.float32], coarse: NDArray[np.float32], others: NDArray[np.float32], around: NDArray[np.uint8],
    base: int, apart: float, y0: int, y1: int, lines: NDArray[np.float32], disparity: NDArray[np.float32],
    sure: NDArray[np.float32],
) -> None:  # fmt: skip
    rows, columns = disparity.shape
    width = coarse.shape[1]
    low = np.int32(-127)
    high = np.int32(127)
    step = np.float32(apart)
    gains = lines[:2]
    above = lines[2]
    below = lines[3]
    certain = lines[4]
    logits = lines[5:11]
    values = lines[11:]
    for y in range(y0, y1):
        pixels = head[y]
        for x in range(width // 4):
            for g in range(GAINS):
                gain = pixels[x, LOGITS + g] * np.float32(1 / 16)
                for j in range(4):
                    gains[g, 4 * x + j] = gain
        for i in range(2):
            for x in range(width // 4):  # each logit stands for two columns, and for two rows
                for k in range(6):
                    for j in range(2):
                        logit = pixels[x, 4 * k + 2 * i + j]
                        logits[k, 4 * x + 2 * j] = logit
                        logits[k, 4 * x + 2 * j + 1] = logit
                for j in range(2):
                    logit = -pixels[x, LOGITS + GAINS + 2 * i + j]
                    certain[4 * x + 2 * j] = logit
                    certain[4 * x + 2 * j + 1] = logit
            for x in range(width):
                certain[x] = np.float32(1) / (np.float32(1) + _exponential(certain[x]))
            for k in range(4):
                other = others[k, 2 * y + i]
                for x in range(width // 2):
                    values[k, 2 * x] = other[x]
                    values[k, 2 * x + 1] = other[x]
            for r in range(4 * y + 2 * i, min(4 * y + 2 * i + 2, rows)):
                line = coarse[r]
                mine = around[0, r]
                for x in range(width):
                    above[x] = np.float32(0)
                    below[x] = np.float32(1)
                for k in range(6):
                    cost = around[k + 1, r]
                    prior = logits[k]
                    gain = gains[0 if k < 2 else 1]
                    if k < 2:
                        value = step if k == 1 else -step
                        for x in range(width):
                            less = min(max(np.int32(mine[x]) - np.int32(cost[x]), low), high)
                            weight = _exponential(prior[x] + np.float32(less) * gain[x])
                            above[x] += weight * value
                            below[x] += weight
                    else:
                        other = values[k - 2]
                        for x in range(width):
                            less = min(max(np.int32(mine[x]) - np.int32(cost[x]), low), high)
                            weight = _exponential(prior[x] + np.float32(less) * gain[x])
                            above[x] += weight * (other[x] - line[x])
                            below[x] += weight
                out = disparity[r]
                for x in range(columns):
                    out[x] = line[x] + above[x] / below[x] + np.float32(base)
                out = sure[r]
                for x in range(columns):
                    out[x] = certain[x]
