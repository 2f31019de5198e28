"""The one place where options and images of users are checked: each rule once, each error one line."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError, OptionError, did_you_mean, shown

__all__ = [
    "MAX_DISPARITY",
    "accepted_type",
    "check_flag",
    "check_integer",
    "check_names",
    "check_nodata",
    "check_number",
    "checked_image",
    "writable",
]

MAX_DISPARITY = 2**20
"""Bound of `min_disparity`, far beyond any image."""

_TYPES = (np.uint8, np.uint16, np.float32, np.float64)


def check_integer(name: str, value: Any, low: int | None = None, high: int | None = None) -> int:
    """Return `value` as an int if it is a whole number from `low` to `high`, else raise OptionError."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise OptionError(f"{name} must be an integer, got {shown(value)}")
    if (low is not None and value < low) or (high is not None and value > high):
        rule = f"at least {low}" if high is None else f"from {low} to {high}"
        raise OptionError(f"{name} must be {rule}, got {shown(value)}")
    return int(value)


def check_number(name: str, value: Any, low: float, high: float) -> float:
    """Return `value` as a float if it lies from `low` to `high`, else raise OptionError."""
    is_no_number = isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating))
    if is_no_number or not low <= value <= high:
        raise OptionError(f"{name} must be a number from {low:g} to {high:g}, got {shown(value)}")
    return float(value)


def check_flag(name: str, value: Any) -> bool:
    """Return `value` if it is True or False, else raise OptionError."""
    if not isinstance(value, (bool, np.bool_)):
        raise OptionError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def check_nodata(value: Any) -> float | None:
    """Return `value` as a float if it is a number, None if it is None or NaN, else raise OptionError."""
    if value is None:
        return None
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise OptionError(f"nodata must be a number or None, got {shown(value)}")
    if isinstance(value, int) and abs(value) > 2**64:  # beyond any pixel, and beyond any float
        raise OptionError(f"nodata must be a value that pixels can have, got {shown(value)}")
    return None if np.isnan(value) else float(value)


def check_names(kind: str, names: Any, known: Any) -> None:
    """Raise OptionError with the nearest known name for the first of `names` that is not in `known`."""
    for name in names:
        if name not in known:
            raise OptionError(did_you_mean(kind, name, known))


def writable(array: Any) -> NDArray[Any]:
    """Return `array`, or a copy, C-contiguous and writable, as the compiled kernels need it; nothing writes to it."""
    contiguous = np.ascontiguousarray(array)
    return contiguous if contiguous.flags.writeable else contiguous.copy()


def checked_image(name: str, image: Any) -> NDArray[Any]:
    """Return an image as uint8, uint16, float32 or float64, (H, W), (H, W, 3) or, with alpha, (H, W, 4)."""
    if image is None:
        raise InputError(f"{name} must be an image, got None: was the file read?")
    if isinstance(image, str | bytes | os.PathLike):
        raise InputError(f"{name} must be an image, got the path {shown(image)}; read_image reads it")
    if isinstance(image, np.ma.MaskedArray):
        raise InputError(f"{name} must be a plain array, got a masked one; put NaN where there is no evidence")
    if hasattr(image, "__cuda_array_interface__"):
        raise InputError(f"{name} must lie in host memory here, got an array on a GPU; see Matcher.on_device")
    try:
        array = np.asarray(image)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be an array of numbers, got {shown(image)}") from None
    kind = accepted_type(array.dtype)
    if kind is None:
        raise InputError(f"{name} must be of whole or floating-point numbers of at most 64 bits, got {array.dtype}")
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise InputError(f"{name} must be grey (H, W), RGB (H, W, 3) or RGBA (H, W, 4), got shape {array.shape}")
    if 0 in array.shape:
        raise InputError(f"{name} must not be empty, got shape {array.shape}")
    return array.astype(kind, copy=False)


def accepted_type(dtype: np.dtype[Any]) -> np.dtype[Any] | None:
    """Return the type among `_TYPES`, in this machine's byte order, that takes the values of another; None if none.

    Whole numbers become floats that represent them: their values decide about the mapping to grey, not their type.
    """
    native: np.dtype[Any] = dtype.newbyteorder("=")
    if native in _TYPES:
        return native
    if dtype.kind == "b":
        return np.dtype(np.uint8)
    if dtype.kind in "iuf" and dtype.itemsize <= 8:
        return np.dtype(np.float32 if dtype.itemsize <= 2 else np.float64)
    return None
