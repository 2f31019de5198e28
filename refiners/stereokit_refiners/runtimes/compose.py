"""From a network's head to the full-size map: compiled loops, a range of rows at a time.

The heads come with their channels innermost, (h, w, C), as convolutions leave them in memory. Rows do not depend on
one another, so the result does not depend on how they are shared out between threads.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.threads import run, spans
from stereokit_refiners.networks.pyramid import CANDIDATES, OFFSETS

__all__ = ["compose"]

_GAIN = np.float32(4)  # the unit of a head, pixels
_DY = np.array([dy for dy, _ in OFFSETS], np.int64)
_DX = np.array([dx for _, dx in OFFSETS], np.int64)


def compose(
    name: str, form: str, head: NDArray[np.float32], coarse: NDArray[np.float32], rows: int, columns: int,
    threads: int = 1, candidates: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:  # fmt: skip
    """Return the map of a head.

    Parameters
    ----------
    name : str
        Architecture: "stereokit" is a mixture, all others a residual.
    form : {"residual", "literal"}
    head : (h, w, C) float32, C-contiguous
    coarse : (h, w) float32
        Coarse map, full-size pixels.
    rows, columns : int
        Size of the map, at most ``2h`` x ``2w``.
    threads : int
    candidates : (2, h, w) float32 or None
        The matcher's candidates, full-size pixels, for the mixture.

    Returns
    -------
    (rows, columns) float32, full-size pixels
    """
    out = np.empty((rows, columns), np.float32)
    parts = spans(-(-rows // 2), threads)
    tasks: list[Any]
    if form == "literal":
        tasks = [partial(_literal, head, y0, y1, out) for y0, y1 in parts]
    elif name == "stereokit":
        assert candidates is not None
        corrected = np.empty(coarse.shape, np.float32)
        run([partial(_correct, head, coarse, y0, y1, corrected) for y0, y1 in spans(len(coarse), threads)], threads)
        held = [np.empty(4 * CANDIDATES + 4, np.float32) for _ in parts]
        given = np.ascontiguousarray(candidates)
        tasks = [
            partial(_mix, head, corrected, given, _DY, _DX, y0, y1, held[k], out) for k, (y0, y1) in enumerate(parts)
        ]
    else:
        tasks = [partial(_correct_upscaled, head, coarse, y0, y1, out) for y0, y1 in parts]
    run(tasks, threads)
    return out


@kernel
def _literal(head: NDArray[np.float32], y0: int, y1: int, out: NDArray[np.float32]) -> None:
    for y in range(2 * y0, min(2 * y1, out.shape[0])):
        for x in range(out.shape[1]):
            out[y, x] = np.float32(256) * head[y // 2, x // 2, 2 * (y % 2) + x % 2]


@kernel
def _correct_upscaled(
    head: NDArray[np.float32], coarse: NDArray[np.float32], y0: int, y1: int, out: NDArray[np.float32]
) -> None:
    """Add the residual to the bilinearly upscaled map; pixel centres are kept, so the weights are 3/4 and 1/4."""
    height, width = coarse.shape
    near = np.float32(0.75)
    far = np.float32(0.25)
    for y in range(y0, y1):
        for i in range(2):
            row = 2 * y + i
            if row >= out.shape[0]:
                continue
            other = coarse[min(max(y - 1 + 2 * i, 0), height - 1)]
            mine = coarse[y]
            before = near * mine[0] + far * other[0]
            here = before
            for x in range((out.shape[1] + 1) // 2):
                after = here
                if x + 1 < width:
                    after = near * mine[x + 1] + far * other[x + 1]
                out[row, 2 * x] = near * here + far * before + _GAIN * head[y, x, 2 * i]
                if 2 * x + 1 < out.shape[1]:
                    out[row, 2 * x + 1] = near * here + far * after + _GAIN * head[y, x, 2 * i + 1]
                before = here
                here = after


@kernel
def _correct(
    head: NDArray[np.float32], coarse: NDArray[np.float32], y0: int, y1: int, out: NDArray[np.float32]
) -> None:
    for y in range(y0, y1):
        for x in range(coarse.shape[1]):
            out[y, x] = coarse[y, x] + _GAIN * head[y, x, 0]


@inline
def _exponential(x: Any) -> Any:
    """Return p and n with ``p * 2**n = e**x`` to about 1e-7, for x from -80 to 0: p is a polynomial.

    Single IEEE operations, so that it becomes vector code and is the same everywhere.
    """
    x = max(x, np.float32(-80)) * np.float32(1.4426950408889634)
    whole = np.floor(x + np.float32(0.5))
    z = (x - whole) * np.float32(0.6931471805599453)
    p = np.float32(1 / 720)
    p = p * z + np.float32(1 / 120)
    p = p * z + np.float32(1 / 24)
    p = p * z + np.float32(1 / 6)
    p = p * z + np.float32(0.5)
    p = p * z + np.float32(1)
    p = p * z + np.float32(1)
    return p, np.int32(whole)


@kernel
def _mix(
    head: NDArray[np.float32], corrected: NDArray[np.float32], candidates: NDArray[np.float32],
    dy: NDArray[np.int64], dx: NDArray[np.int64],
    y0: int, y1: int, share: NDArray[np.float32], out: NDArray[np.float32],
) -> None:  # fmt: skip
    """Softmax-weighted mean of the values to choose from, for each of the four phases, plus its residual."""
    height, width = corrected.shape
    around = dy.size
    count = around + len(candidates)
    bits = share.view(np.int32)
    for y in range(y0, y1):
        for x in range((out.shape[1] + 1) // 2):
            pixel = head[y, x]
            peak = share[4 * count :]  # the largest logit of each phase
            for phase in range(4):
                peak[phase] = pixel[5 + phase]
            for k in range(1, count):
                for phase in range(4):
                    peak[phase] = max(peak[phase], pixel[5 + 4 * k + phase])
            for k in range(count):
                for phase in range(4):
                    share[4 * k + phase] = pixel[5 + 4 * k + phase] - peak[phase]
            for k in range(4 * count):  # one long loop: vector code
                fraction, power = _exponential(share[k])
                share[k] = fraction
                bits[k] += power << np.int32(23)
            total_0 = np.float32(0)
            total_1 = np.float32(0)
            total_2 = np.float32(0)
            total_3 = np.float32(0)
            sum_0 = np.float32(0)
            sum_1 = np.float32(0)
            sum_2 = np.float32(0)
            sum_3 = np.float32(0)
            for k in range(count):
                if k < around:
                    value = corrected[min(max(y + dy[k], 0), height - 1), min(max(x + dx[k], 0), width - 1)]
                else:
                    value = candidates[k - around, y, x]
                total_0 += share[4 * k]
                total_1 += share[4 * k + 1]
                total_2 += share[4 * k + 2]
                total_3 += share[4 * k + 3]
                sum_0 += share[4 * k] * value
                sum_1 += share[4 * k + 1] * value
                sum_2 += share[4 * k + 2] * value
                sum_3 += share[4 * k + 3] * value
            row = 2 * y
            column = 2 * x
            out[row, column] = sum_0 / total_0 + _GAIN * pixel[1]
            if column + 1 < out.shape[1]:
                out[row, column + 1] = sum_1 / total_1 + _GAIN * pixel[2]
            if row + 1 < out.shape[0]:
                out[row + 1, column] = sum_2 / total_2 + _GAIN * pixel[3]
                if column + 1 < out.shape[1]:
                    out[row + 1, column + 1] = sum_3 / total_3 + _GAIN * pixel[4]
