"""Blank pixels: those around which the left view has no texture as far as a cost looks."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel
from stereokit.kernels.threads import run_stages, spans

__all__ = ["blank_pixels"]


def blank_pixels(gray: NDArray[Any], across: int, down: int, threads: int = 1) -> NDArray[np.bool_] | None:
    """Return the pixels around which all are equal, None if there are none.

    Parameters
    ----------
    gray : (H, W) uint8 or uint16
    across, down : int
        How far it is looked to either side, and up and down, pixels. Beyond the image there is nothing to differ.
    threads : int
        Threads to use.
    """
    height, width = gray.shape
    bands = spans(height, threads)
    same = np.empty(gray.shape, np.uint8)
    rows_with, rows_blank = np.zeros((2, height), np.uint8)
    blank = np.empty(gray.shape, np.bool_)
    lines = np.empty((len(bands), width + 2 * across), np.uint8)
    run_stages(
        [
            [partial(_same_along, gray, across, *band, lines[k], same, rows_with) for k, band in enumerate(bands)],
            [partial(_same_around, gray, down, *band, same, rows_with, blank, rows_blank) for band in bands],
        ],
        threads,
    )
    return blank if rows_blank.any() else None


@kernel
def _same_along(
    gray: NDArray[Any], across: int, y0: int, y1: int, line: NDArray[np.uint8], same: NDArray[np.uint8],
    found: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Mark the pixels of rows y0..y1 that are equal to all `across` to their left and right, and rows with such."""
    width = gray.shape[1]
    line[:] = 1
    inner = line[across : across + width]
    for y in range(y0, y1):
        row = gray[y]
        for x in range(width - 1):
            inner[x] = row[x] == row[x + 1]
        marks = same[y]
        marks[:] = 1
        for k in range(2 * across):
            other = line[k : k + width]
            for x in range(width):
                marks[x] &= other[x]
        any_mark = np.uint8(0)
        for x in range(width):
            any_mark |= marks[x]
        found[y] = any_mark


@kernel
def _same_around(
    gray: NDArray[Any], down: int, y0: int, y1: int, same: NDArray[np.uint8], found: NDArray[np.uint8],
    blank: NDArray[np.bool_], blank_rows: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Mark the pixels of rows y0..y1 around which all marks of `same` are set and all columns equal, and their rows."""
    height, width = gray.shape
    for y in range(y0, y1):
        first = max(y - down, 0)
        last = min(y + down, height - 1)
        is_blank = blank[y]
        is_blank[:] = found[first : last + 1].all()
        if not is_blank[0]:
            continue
        for other in range(first, last + 1):
            marks = same[other]
            for x in range(width):
                is_blank[x] &= marks[x] != 0
        for other in range(first, last):
            upper = gray[other]
            lower = gray[other + 1]
            for x in range(width):
                is_blank[x] &= upper[x] == lower[x]
        blank_rows[y] = is_blank.any()
