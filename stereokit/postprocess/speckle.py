"""Removal of speckles: small islands of disparity that agree with nothing around them (Hirschmueller 2008, III-B).

A region is a set of neighbours (4-connected) whose disparities differ by at most one pixel from one to the next;
regions of few pixels become invalid. This is OpenCV's ``filterSpeckles`` on disparities in sixteenths of a pixel.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError
from stereokit.inputs import check_integer, check_number

__all__ = ["remove_speckles"]

_SCALE = 16


def remove_speckles(
    disparity: NDArray[np.float32], size: int, difference: float = 1.0
) -> NDArray[np.float32]:
    """Return a copy of the map without regions of `size` pixels or fewer.

    Parameters
    ----------
    disparity : (H, W) float32, pixels, NaN where invalid
        Between -2000 and 2000.
    size : int
        Largest region that is removed, pixels.
    difference : float
        How much neighbours of one region differ at most, pixels, in sixteenths.

    Returns
    -------
    (H, W) float32, pixels, NaN where invalid

    Raises
    ------
    InputError, OptionError
        If the map is not two-dimensional, or an option breaks its rule.
    """
    if disparity.ndim != 2:
        raise InputError(f"disparity must be (H, W), got shape {disparity.shape}")
    size = check_integer("size", size, 0)
    difference = check_number("difference", difference, 0, 1000)
    invalid = np.isnan(disparity)
    fixed = np.where(invalid, 0, np.rint(disparity * np.float32(_SCALE))).astype(np.int16)
    mark = -32768
    fixed[invalid] = mark
    cv2.filterSpeckles(fixed, mark, size, difference * _SCALE)
    out = np.array(disparity, np.float32)
    out[fixed == mark] = np.nan
    return out
