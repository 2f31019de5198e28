"""From images of any kind to a grey pair.

Whatever comes in (grey or RGB, 8 or 16 bit or floating point, strided, read-only, with NaN) leaves as two grey
C-contiguous ``uint8`` or ``uint16`` images and the masks of the pixels that carry no evidence. Nothing that comes in
is modified. Floating-point images are brought to 16 bits over the finite range that both share; those that hold
whole numbers from 0 to 255 become what they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError
from stereokit.images.check import checked_image, writable

__all__ = [
    "GrayPair",
    "fill_bad",
    "gray_pair",
    "guide_of",
    "scale_guide",
    "scale_to_16_bits",
    "to_gray",
]


@dataclass(frozen=True)
class GrayPair:
    """Two grey images of one shape and type.

    Attributes
    ----------
    left, right : (H, W) uint8 or uint16, C-contiguous
        Grey values; pixels without evidence hold a neighbour's value.
    left_bad, right_bad : (H, W) bool or None
        Pixels that were NaN or infinite; None when there are none.
    guide : (H, W) uint8
        The left image in 256 grey levels.
    ranges : ((int, int), (int, int)) or None
        Smallest and largest value of either image as a cost sees it, halved and smoothed, where this pair is a
        window of larger images; None where it is the whole.
    """

    left: NDArray[Any]
    right: NDArray[Any]
    left_bad: NDArray[np.bool_] | None
    right_bad: NDArray[np.bool_] | None
    guide: NDArray[np.uint8]
    ranges: tuple[tuple[int, int], tuple[int, int]] | None = None


def to_gray(array: NDArray[Any]) -> NDArray[Any]:
    """Return a checked image in grey: 0.299 R + 0.587 G + 0.114 B."""
    if array.ndim == 2:
        return array
    if array.dtype == np.float64:
        with np.errstate(invalid="ignore"):  # inf - inf, inf * 0: such pixels are bad ones
            return np.asarray(array @ np.array([0.299, 0.587, 0.114]))
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(array), cv2.COLOR_RGB2GRAY))


def _whole_numbers(left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return float images that both hold whole numbers of 8 or 16 bits as such, others as they are."""
    with np.errstate(invalid="ignore"):
        for limit, kind in ((255, np.uint8), (65535, np.uint16)):
            as_is = left.astype(kind), right.astype(kind)
            if all(
                np.array_equal(whole, image) and image.max() <= limit
                for whole, image in zip(as_is, (left, right), strict=True)
            ):
                return as_is
    return left, right


def fill_bad(image: NDArray[Any], bad: NDArray[np.bool_]) -> NDArray[Any]:
    """Return `image` with bad pixels replaced by the nearest good one before them on the row, else behind."""
    width = image.shape[1]
    columns = np.where(bad, -1, np.arange(width))
    before = np.maximum.accumulate(columns, axis=1)
    columns = np.where(bad, width, np.arange(width))
    behind = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    source = np.where(before >= 0, before, behind)
    empty = source >= width
    filled = np.take_along_axis(image, np.where(empty, 0, source), axis=1)
    filled[empty] = 0
    return np.asarray(filled)


def _integers(left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Bring finite floats to 16 bits over their common range."""
    low = min(float(left.min()), float(right.min()))
    high = max(float(left.max()), float(right.max()))
    if high <= low:
        return np.zeros(left.shape, np.uint8), np.zeros(right.shape, np.uint8)

    return scale_to_16_bits(left, low, high), scale_to_16_bits(right, low, high)


def scale_to_16_bits(image: NDArray[Any], low: float, high: float) -> NDArray[np.uint16]:
    """Return finite floats from `low` to `high` as whole numbers from 0 to 65535."""
    share = (image.astype(np.float64) / 2 - low / 2) / (high / 2 - low / 2)  # halves: no overflow
    return np.rint(share * 65535).astype(np.uint16)


def gray_pair(left: Any, right: Any) -> GrayPair:
    """Check two images and return them as a grey pair.

    Parameters
    ----------
    left, right : (H, W) or (H, W, 3), uint8, uint16, float32 or float64
        Of one shape (up to colour) and type. Any strides; read-only arrays are fine.

    Raises
    ------
    InputError
        If an image has another shape or type, is empty, or the two differ.
    """
    a, b = checked_image("left", left), checked_image("right", right)
    if a.dtype != b.dtype:
        raise InputError(f"left and right must have the same type, got {a.dtype} and {b.dtype}")
    if a.shape[:2] != b.shape[:2]:
        raise InputError(f"left and right must have the same size, got {a.shape[:2]} and {b.shape[:2]}")
    if a.dtype.kind == "f":
        a, b = _whole_numbers(a, b)
    a, b = to_gray(a), to_gray(b)
    bad: list[NDArray[np.bool_] | None] = [None, None]
    if a.dtype.kind == "f":
        images = [a, b]
        for k, image in enumerate(images):
            finite = np.isfinite(image)
            if not finite.all():
                bad[k] = ~finite
                images[k] = fill_bad(image, ~finite)
        a, b = _whole_numbers(*images)
        if a.dtype.kind == "f":
            a, b = _integers(a, b)
    if a.dtype == np.uint16 and max(int(a.max()), int(b.max())) <= 255:
        a, b = a.astype(np.uint8), b.astype(np.uint8)
    a, b = writable(a), writable(b)
    return GrayPair(a, b, bad[0], bad[1], guide_of(a, b))


def guide_of(left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.uint8]:
    """Return `left`, (H, W) uint8 or uint16, in 256 grey levels of the range that it shares with `right`."""
    if left.dtype == np.uint8:
        return left
    low = min(int(left.min()), int(right.min()))
    high = max(int(left.max()), int(right.max()))
    return scale_guide(left, low, high)


def scale_guide(image: NDArray[Any], low: int, high: int) -> NDArray[np.uint8]:
    """Return grey values from `low` to `high` in 256 levels."""
    scaled = (image.astype(np.float32) - np.float32(low)) * np.float32(255 / max(high - low, 1))
    return np.asarray(np.rint(scaled), np.uint8)
