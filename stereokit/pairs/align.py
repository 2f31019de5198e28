"""Alignment of rows that are a little apart: the right view is shifted, turned and stretched by what was seen."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError
from stereokit.images.check import checked_image
from stereokit.pairs.check import PairReport, check_pair

__all__ = ["LARGEST", "align_rows"]

LARGEST = 2.0
"""Rows may be so many pixels apart at most, anywhere in the image: what is more calls for a calibration."""

_LEAST = 0.05  # pixels: less is left as it is


def align_rows(left: Any, right: Any, *, nodata: float | None = None) -> tuple[NDArray[Any], PairReport]:
    """Bring the rows of the right view to those of the left one, where they are less than two pixels apart.

    Parameters
    ----------
    left, right : (H, W), (H, W, 3) or (H, W, 4), numbers
        A pair as `stereokit.Matcher` takes it; not modified.
    nodata : float or None
        Value of pixels that hold nothing.

    Returns
    -------
    right : array as `right`
        Resampled (cubic), or `right` itself where rows are less than a twentieth of a pixel apart.
    report : PairReport
        Of the pair as it was given.

    Raises
    ------
    InputError
        If an image cannot be used, rows are further apart, or too few points are seen by both views to tell.
    """
    report = check_pair(left, right, nodata=nodata)
    apart = report.row_errors()
    if report.row_offset is None or report.roll is None or report.scale is None:
        raise InputError(
            f"rows cannot be aligned: only {report.points} points are seen by both views, and do not agree"
        )
    if apart >= LARGEST:
        raise InputError(
            f"rows are up to {apart:.1f} px apart, and less than {LARGEST:g} px can be aligned: rectify the pair"
        )
    image = checked_image("right", right)
    if apart < _LEAST:
        return image, report
    height, width = image.shape[:2]
    slope, stretch = np.tan(np.radians(report.roll)), report.scale - 1
    start = report.row_offset - slope * (width - 1) / 2 - stretch * (height - 1) / 2
    matrix = np.array([[1, 0, 0], [slope, 1 + stretch, start]])
    method = cv2.INTER_CUBIC if image.dtype.kind == "u" else cv2.INTER_LINEAR  # NaN reaches less far
    flags = method | cv2.WARP_INVERSE_MAP
    aligned = cv2.warpAffine(image, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(aligned), report
