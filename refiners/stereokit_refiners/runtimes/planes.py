"""Inputs of networks for runtimes that want each channel to lie together, in floating point."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel
from stereokit.kernels.threads import run, spans

__all__ = ["planar"]


def planar(array: NDArray[Any], threads: int = 1) -> NDArray[np.float32]:
    """Return (C, h, w) as (1, C, h, w) float32, C-contiguous; bytes may come with their channels innermost."""
    rows = np.moveaxis(array, 0, 2)
    if array.dtype != np.int8 or not rows.flags.c_contiguous:
        return np.ascontiguousarray(array[None], np.float32)
    out = np.empty(array.shape, np.float32)
    run([partial(_part, rows, y0, y1, out) for y0, y1 in spans(len(rows), threads)], threads)
    return out[None]


@kernel
def _part(rows: NDArray[np.int8], y0: int, y1: int, out: NDArray[np.float32]) -> None:
    for y in range(y0, y1):
        for c in range(rows.shape[2]):
            row = out[c, y]
            for x in range(rows.shape[1]):
                row[x] = np.float32(rows[y, x, c])
