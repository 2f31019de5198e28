"""Median filter of a disparity map, border replicated, NaN left out.

Dense maps go to OpenCV; where pixels are invalid, the median is over the valid ones of the window (the lower of
the two middle ones if they are even in number) and an invalid pixel stays invalid.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError, OptionError
from stereokit.kernels.jit import kernel
from stereokit.kernels.workspace import Workspace

__all__ = ["median", "median_rows"]


def median(disparity: NDArray[np.float32], size: int = 3) -> NDArray[np.float32]:
    """Return the median-filtered map.

    Parameters
    ----------
    disparity : (H, W) float32, pixels, NaN where invalid
    size : {3, 5}
        Side of the window in pixels.

    Returns
    -------
    (H, W) float32, pixels, NaN where invalid

    Raises
    ------
    OptionError
        If the size is another.
    InputError
        If the map is not two-dimensional.
    """
    if size not in (3, 5):
        raise OptionError(f"size of the median must be 3 or 5, got {size!r}")
    if disparity.ndim != 2:
        raise InputError(f"disparity must be (H, W), got shape {disparity.shape}")
    source = np.ascontiguousarray(disparity, np.float32)
    out = np.empty_like(source)
    median_rows(source, size, 0, source.shape[0], out)
    return out


def median_rows(
    source: NDArray[np.float32], size: int, y0: int, y1: int, out: NDArray[np.float32],
    workspace: Workspace | None = None, dense: bool = False,
) -> None:  # fmt: skip
    """Write rows y0..y1 of the filtered map to `out`; the same values however the rows are cut into ranges.

    `dense` promises that no pixel is NaN.
    """
    half = size // 2
    top, bottom = max(y0 - half, 0), min(y1 + half, source.shape[0])
    part = source[top:bottom]
    if not dense and np.isnan(part).any():
        _median_of_valid(source, half, y0, y1, np.empty(size * size, np.float32), out)
    elif top == y0 and bottom == y1:
        cv2.medianBlur(part, size, dst=out[y0:y1])
    else:
        held = np.empty_like(part) if workspace is None else workspace.array(f"median.{y0}", part.shape, np.float32)
        cv2.medianBlur(part, size, dst=held)
        out[y0:y1] = held[y0 - top : y1 - top]


@kernel
def _median_of_valid(
    source: NDArray[np.float32], half: int, y0: int, y1: int, held: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    height, width = source.shape
    for y in range(y0, y1):
        for x in range(width):
            if np.isnan(source[y, x]):
                out[y, x] = np.nan
                continue
            count = 0
            for dy in range(-half, half + 1):
                for dx in range(-half, half + 1):
                    value = source[min(max(y + dy, 0), height - 1), min(max(x + dx, 0), width - 1)]
                    if not np.isnan(value):
                        place = count  # insertion sort: at most 25 values
                        while place > 0 and held[place - 1] > value:
                            held[place] = held[place - 1]
                            place -= 1
                        held[place] = value
                        count += 1
            out[y, x] = held[(count - 1) // 2]
