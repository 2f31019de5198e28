"""Gaussian filter of grey images in 16 bits: columns, then rows, in fixed point, so that every processor agrees.

Rows are filtered one at a time while they are in the cache, with each tap a loop that becomes vector code. Rounding, of
the weights first of all, moves a result by one or two of 65536 levels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel

__all__ = ["blur_rows", "taps"]

_BITS = 15  # of the weights: 17-bit values times weights that sum to 2**15 fit 32 bits, with what rounding adds


def taps(sigma: float) -> NDArray[np.uint32]:
    """Return the weights from the centre outwards, until they round to 0."""
    radius = max(1, math.ceil(4 * sigma))
    shares = np.exp(-(np.arange(radius + 1) ** 2) / (2 * sigma**2))
    weights = np.rint(2**_BITS * shares / (shares[0] + 2 * shares[1:].sum())).astype(np.int64)
    weights[0] = 2**_BITS - 2 * weights[1:].sum()
    return np.asarray(np.trim_zeros(weights, "b"), np.uint32)


@kernel
def blur_rows(
    image: NDArray[Any], weights: NDArray[np.uint32], shift: int, y0: int, y1: int, line: NDArray[np.uint32],
    total: NDArray[np.uint32], out: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Write rows y0..y1 of ``image << shift``, filtered; borders are replicated. `line` holds W + 2 * radius."""
    height, width = image.shape
    radius = weights.size - 1
    once = np.uint32(_BITS - 1)  # between the passes values have one bit more
    twice = np.uint32(_BITS + 1)
    half_once = np.uint32(1 << (_BITS - 2))
    half_twice = np.uint32(1 << _BITS)
    left = np.uint32(shift)
    for y in range(y0, y1):
        middle = line[radius : radius + width]
        centre = image[y]
        for x in range(width):
            total[x] = np.uint32(np.uint32(np.uint32(centre[x]) << left) * weights[0]) + half_once
        for k in range(1, weights.size):
            weight = weights[k]
            above = image[max(y - k, 0)]
            below = image[min(y + k, height - 1)]
            for x in range(width):
                pair = np.uint32(np.uint32(np.uint32(above[x]) + np.uint32(below[x])) << left)
                total[x] = np.uint32(total[x] + np.uint32(pair * weight))
        for x in range(width):
            middle[x] = np.uint32(total[x] >> once)
        line[:radius] = middle[0]
        line[radius + width :] = middle[width - 1]
        for x in range(width):
            total[x] = np.uint32(np.uint32(middle[x] * weights[0]) + half_twice)
        for k in range(1, weights.size):
            weight = weights[k]
            before = line[radius - k : radius - k + width]
            behind = line[radius + k : radius + k + width]
            for x in range(width):
                pair = np.uint32(before[x] + behind[x])
                total[x] = np.uint32(total[x] + np.uint32(pair * weight))
        target = out[y]
        for x in range(width):
            target[x] = np.uint16(total[x] >> twice)
