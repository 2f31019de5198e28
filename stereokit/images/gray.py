"""The one place where images and options are checked.

Whatever comes in (grey or RGB, 8 or 16 bit or floating point, strided, read-only, with NaN) leaves as two grey
C-contiguous ``uint8`` or ``uint16`` images and the masks of the pixels that carry no evidence. Nothing that comes in
is modified. Floating-point images are brought to 16 bits over the finite range that both share; those that hold
whole numbers from 0 to 255 become what they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError, OptionError, did_you_mean
from stereokit.kernels.threads import run
from stereokit.kernels.workspace import Workspace

__all__ = [
    "GrayPair",
    "check_flag",
    "check_integer",
    "check_names",
    "check_number",
    "checked_image",
    "fill_bad",
    "gray_pair",
    "guide_of",
    "half_size",
    "reduced",
    "scale_guide",
    "scale_to_16_bits",
    "smooth",
    "to_gray",
]

MAX_DISPARITY = 2**20
"""Bound of `min_disparity`, far beyond any image."""

_TYPES = (np.uint8, np.uint16, np.float32, np.float64)


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


def check_integer(name: str, value: Any, low: int | None = None, high: int | None = None) -> int:
    """Return `value` as an int if it is a whole number from `low` to `high`, else raise OptionError."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise OptionError(f"{name} must be an integer, got {value!r}")
    if (low is not None and value < low) or (high is not None and value > high):
        rule = f"at least {low}" if high is None else f"from {low} to {high}"
        raise OptionError(f"{name} must be {rule}, got {value}")
    return int(value)


def check_number(name: str, value: Any, low: float, high: float) -> float:
    """Return `value` as a float if it lies from `low` to `high`, else raise OptionError."""
    wrong = isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.number))
    if wrong or not low <= value <= high:
        raise OptionError(f"{name} must be a number from {low:g} to {high:g}, got {value!r}")
    return float(value)


def check_flag(name: str, value: Any) -> bool:
    """Return `value` if it is True or False, else raise OptionError."""
    if not isinstance(value, (bool, np.bool_)):
        raise OptionError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_names(kind: str, given: Any, known: Any) -> None:
    """Raise OptionError with the nearest known name for the first of `given` that is not in `known`."""
    for name in given:
        if name not in known:
            raise OptionError(did_you_mean(kind, str(name), known))


def writable(array: Any) -> NDArray[Any]:
    """Return `array`, or a copy, C-contiguous and writable: what kernels were compiled for. It is not written to."""
    contiguous = np.ascontiguousarray(array)
    return contiguous if contiguous.flags.writeable else contiguous.copy()


def checked_image(name: str, image: Any) -> NDArray[Any]:
    """Return an image of an accepted type and shape, (H, W) or (H, W, 3)."""
    if isinstance(image, np.ma.MaskedArray):
        raise InputError(f"{name} must be a plain array, got a masked one; put NaN where there is no evidence")
    if hasattr(image, "__cuda_array_interface__"):
        raise InputError(f"{name} must lie in host memory here, got an array on a GPU; see Matcher.on_device")
    try:
        array = np.asarray(image)
    except ValueError as error:
        raise InputError(f"{name} must be an array of numbers: {error}") from None
    if array.dtype.byteorder not in "=|":
        array = array.astype(array.dtype.newbyteorder("="))
    if array.dtype not in _TYPES:
        raise InputError(f"{name} must be uint8, uint16, float32 or float64, got {array.dtype}")
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise InputError(f"{name} must be grey (H, W) or RGB (H, W, 3), got shape {array.shape}")
    if 0 in array.shape:
        raise InputError(f"{name} must not be empty, got shape {array.shape}")
    return array


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


def smooth(pair: GrayPair, sigma: float, workspace: Workspace | None = None, threads: int = 1) -> GrayPair:
    """Return the pair with both images smoothed by a Gaussian; the guide stays as sharp as it was.

    The result is 16 bit, so that nothing is lost to rounding: 8-bit images are multiplied by 256 first.

    Parameters
    ----------
    pair : GrayPair
    sigma : float
        Standard deviation in pixels; 0 returns the pair itself.
    workspace : Workspace or None
        Where the smoothed images are kept until the next call; None makes new ones.
    threads : int
        Threads to use.
    """
    if sigma == 0:
        return pair
    held = workspace or Workspace()
    images = pair.left, pair.right
    wide, blurred = ([held.array(f"smooth.{name}{k}", images[0].shape, np.uint16) for k in (0, 1)] for name in "wb")

    def blur(k: int) -> None:
        image = images[k]
        if image.dtype == np.uint8:
            image = np.multiply(image, np.uint16(256), out=wide[k])
        cv2.GaussianBlur(image, (0, 0), sigma, dst=blurred[k], borderType=cv2.BORDER_REPLICATE)

    run([partial(blur, 0), partial(blur, 1)], threads)
    return GrayPair(blurred[0], blurred[1], pair.left_bad, pair.right_bad, pair.guide, pair.ranges)


def reduced(pair: GrayPair, step: int) -> GrayPair:
    """Return the pair at 1/`step` of its size, 1, 2 or 4: halved as often as that takes."""
    while step > 1:
        pair, step = half_size(pair), step // 2
    return pair


def half_size(pair: GrayPair) -> GrayPair:
    """Return the pair at half size, ``(ceil(H/2), ceil(W/2))``: the mean of each 2x2 pixels.

    Odd sizes are extended by their last row or column. A pixel is bad if one of its four is.
    """

    def shrink(image: NDArray[Any]) -> NDArray[Any]:
        height, width = image.shape
        even = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        size = (even.shape[1] // 2, even.shape[0] // 2)
        return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA)).reshape(size[1], size[0])

    def shrink_bad(bad: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        if bad is None:
            return None
        height, width = bad.shape
        even = np.pad(bad, ((0, height % 2), (0, width % 2)))
        return np.asarray(even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).any(axis=(1, 3)))

    left, right = shrink(pair.left), shrink(pair.right)
    guide = left if pair.left.dtype == np.uint8 else shrink(pair.guide)
    return GrayPair(left, right, shrink_bad(pair.left_bad), shrink_bad(pair.right_bad), guide, pair.ranges)
