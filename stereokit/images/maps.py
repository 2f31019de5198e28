"""Checks of the maps and volumes of public functions; kernels and the matcher check nothing again."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError
from stereokit.images.check import check_integer

__all__ = ["check_threads", "checked_map", "numbers"]


def numbers(name: str, values: Any) -> NDArray[Any]:
    """Return real numbers as an array in native byte order; raise InputError if they are something else."""
    if isinstance(values, np.ma.MaskedArray):
        raise InputError(f"{name} must be a plain array, got a masked one")
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be an array of numbers, got {type(values).__name__}") from None
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name} must be an array of numbers, got {array.dtype} of shape {array.shape}")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def checked_map(disparity: Any) -> NDArray[np.float32]:
    """Return a copy of a disparity map, C-contiguous; raise InputError if it is none."""
    array = numbers("disparity", disparity)
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"disparity must be (H, W) and not empty, got shape {array.shape}")
    with np.errstate(over="ignore"):
        return np.array(array, np.float32, order="C")


def check_threads(threads: Any) -> int:
    """Return a number of threads; raise OptionError if it is none."""
    return check_integer("threads", threads, 1, 1024)
