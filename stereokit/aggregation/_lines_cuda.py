"""Common parts of both forms of the CUDA domain transform: feedback pixel by pixel, marks and bands."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.aggregation.dt import Dt
from stereokit.cuda.kernel import Kernel, Queue, array, blocks_for, cuda, f32, i16, i32, kernel, u8, u32

__all__ = ["SEGMENT", "bands", "marks_of", "weights"]

SEGMENT = 8
"""Pixels from mark to mark: what a thread holds in registers."""

BAND_BYTES = 2**26
"""Most memory of one band of totals, unless a band of `SEGMENT` columns is larger."""


def _make_edges(name: str, weight: Any) -> Kernel:
    @kernel(array(u8), array(weight), array(weight), array(weight), array(weight), u32, u32, name=name)
    def edges(guide, row_table, column_table, row, column, width, pixels):  # type: ignore[no-untyped-def]
        """Feedback from the pixel to the left and from the pixel above; none into the first column and row."""
        at = u32(cuda.grid(1))
        if at < pixels:
            here = i32(guide[at])
            left = above = weight(0)
            if u32(at % width) > u32(0):
                left = row_table[u32(abs(i32(here - i32(guide[u32(at - u32(1))]))))]
            if at >= width:
                above = column_table[u32(abs(i32(here - i32(guide[u32(at - width)]))))]
            row[at] = left
            column[at] = above

    result: Kernel = edges
    return result


_edges_rf = _make_edges("dt_edges_rf", i16)
_edges_sum = _make_edges("dt_edges_sum", f32)


def weights(
    queue: Queue, dt: Dt, cost_max: int, number: int, guide: Any, shape: tuple[int, int]
) -> tuple[Any, Any, int]:
    """Return the feedback of pass `number` along rows and along columns, ``(H * W)``, and its `Weights.shift`."""
    height, width = shape
    floats = dt.mode == "sum"
    edges, dtype = (_edges_sum, np.float32) if floats else (_edges_rf, np.int16)
    tables = dt.weights(dtype, cost_max)[number]
    row = queue.cached(f"dt.{dt.mode}.row{number}", (dt, cost_max), lambda: tables.row)
    column = queue.cached(f"dt.{dt.mode}.column{number}", (dt, cost_max), lambda: tables.column)
    rows = queue.array(f"dt.{dt.mode}.rows", height * width, dtype)
    columns = queue.array(f"dt.{dt.mode}.columns", height * width, dtype)
    blocks = blocks_for(height * width, edges.block)
    queue.launch(edges, blocks, guide, row, column, rows, columns, width, height * width)
    return rows, columns, tables.shift


def bands(width: int, column_bytes: int) -> list[tuple[int, int]]:
    """Return first column and width of each band of totals, left to right; every band starts at a mark of its rows."""
    count = -(-width * column_bytes // BAND_BYTES)
    band = -(-width // (count * SEGMENT)) * SEGMENT
    return [(x0, min(band, width - x0)) for x0 in range(0, width, band)]


def marks_of(pixels: int) -> int:
    """Return the number of marks of a line of so many pixels: none before its first segment."""
    return -(-pixels // SEGMENT) - 1
