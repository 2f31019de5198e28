"""Disparity maps: KITTI 16-bit PNG, PFM, npy, float TIFF, and OpenCV's fixed point.

Sources: KITTI stereo devkit (``readme.txt``, ``io_disp.h``: ``uint16 = disparity * 256``, 0 is invalid); OpenCV's
``StereoMatcher::DISP_SHIFT`` (16 steps a pixel, invalid is one pixel below the minimum).
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import FileError, InputError, OptionError
from stereokit.io.atomic import write_bytes
from stereokit.io.images import decode, describe, encode
from stereokit.io.pfm import pfm_bytes, read_pfm
from stereokit.io.reading import parsing, read_bytes, read_npy

__all__ = [
    "DISPARITY_SUFFIXES",
    "from_opencv",
    "read_disparity",
    "to_opencv",
    "write_disparity",
]

DISPARITY_SUFFIXES = (".png", ".pfm", ".npy", ".tiff")
"""The suffixes of `read_disparity` and `write_disparity`; ``.tif`` is ``.tiff``."""

_MAX_STEP = 65535  # of a KITTI PNG
_STEPS = 16  # of OpenCV's fixed point in a pixel


def read_disparity(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a disparity map.

    Parameters
    ----------
    path : path
        ``.png`` (KITTI, 16-bit grey: value / 256, 0 invalid), ``.pfm`` (grey), ``.npy``, ``.tiff`` (pixels).

    Returns
    -------
    (H, W) float32
        Pixels, NaN where invalid (infinite in the file, or 0 in a PNG).

    Raises
    ------
    FileError
        If the file is missing, has another suffix or does not hold such a map.
    """
    with parsing(path, "disparity map"):
        return _read(path, _suffix(path))


def _read(path: str | os.PathLike[str], suffix: str) -> NDArray[np.float32]:
    if suffix == ".png":
        stored, _ = decode(path)
        if stored.dtype != np.uint16 or stored.ndim != 2:
            raise FileError(f"{str(path)!r} must be a 16-bit grey PNG, got {describe(stored)}")
        disparity: NDArray[np.float32] = stored.astype(np.float32) / np.float32(256)
        disparity[stored == 0] = np.nan
        return disparity
    if suffix == ".pfm":
        array: NDArray[Any] = read_pfm(path)
    elif suffix == ".npy":
        array = read_npy(path, read_bytes(path))
    else:
        array, _ = decode(path)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu":
        raise FileError(f"{str(path)!r} must hold a 2-d array of numbers, got {describe(array)}")
    disparity = array.astype(np.float32)
    disparity[~np.isfinite(disparity)] = np.nan
    return disparity


def write_disparity(path: str | os.PathLike[str], disparity: ArrayLike, *, clip: bool = False) -> None:
    """Write a disparity map; the format follows from the suffix.

    Parameters
    ----------
    path : path
        ``.png``: KITTI, 16-bit, 1/256 pixel, 0 where invalid; as in the devkit, a valid 0 becomes 1/256. ``.pfm``:
        infinite where invalid. ``.npy`` and ``.tiff``: float32 with NaN.
    disparity : (H, W) float
        Pixels, not finite where invalid.
    clip : bool
        Clip disparities to the range of a ``.png``, 0 to 65535/256 pixels.

    Raises
    ------
    InputError
        If `disparity` is not a 2-d array of floats, or has values beyond the range of a ``.png`` and `clip` is False.
    FileError
        If the suffix is unknown or the file cannot be written.
    """
    suffix = _suffix(path)
    values = _checked_map(disparity)
    known = np.isfinite(values)
    if suffix == ".png":
        steps = np.rint(np.where(known, values, np.float32(0)) * np.float32(256))
        if not clip and (values.min(initial=0, where=known) < 0 or steps.max() > _MAX_STEP):
            span = f"{values.min(initial=np.inf, where=known):g} .. {values.max(initial=-np.inf, where=known):g}"
            raise InputError(
                f"disparity must not be negative or above {_MAX_STEP / 256:g} px for KITTI's .png, got {span}; "
                "use .pfm, .npy or .tiff, or clip=True"
            )
        data = encode(".png", np.where(known, np.clip(steps, 1, _MAX_STEP), 0).astype(np.uint16))
    elif suffix == ".pfm":
        data = pfm_bytes(values)
    elif suffix == ".npy":
        buffer = io.BytesIO()
        np.save(buffer, values)
        data = buffer.getvalue()
    else:
        data = encode(".tiff", values)
    write_bytes(path, data)


def from_opencv(fixed: ArrayLike, min_disparity: int = 0) -> NDArray[np.float32]:
    """Return OpenCV's fixed-point disparity in pixels.

    Parameters
    ----------
    fixed : (H, W) int16
        The result of ``StereoBM.compute`` or ``StereoSGBM.compute``: 16 steps per pixel.
    min_disparity : int
        The matcher's ``minDisparity``, pixels. ``(min_disparity - 1) * 16`` marks invalid pixels.

    Returns
    -------
    (H, W) float32
        Pixels, NaN where invalid.

    Raises
    ------
    InputError
        If `fixed` is not a 2-d int16 array.
    OptionError
        If the mark of invalid pixels does not fit 16 bits.
    """
    mark = _mark(min_disparity)
    steps = np.asarray(fixed)
    if steps.ndim != 2 or steps.dtype != np.int16:
        raise InputError(f"fixed must be (H, W) int16, got {describe(steps)}")
    disparity: NDArray[np.float32] = steps.astype(np.float32) / np.float32(_STEPS)
    disparity[steps <= mark] = np.nan
    return disparity


def to_opencv(disparity: ArrayLike, min_disparity: int = 0) -> NDArray[np.int16]:
    """Return a disparity map in OpenCV's fixed point, the inverse of `from_opencv`.

    Parameters
    ----------
    disparity : (H, W) float
        Pixels, not finite where invalid.
    min_disparity : int
        ``minDisparity`` of the matcher it stands for, pixels.

    Raises
    ------
    InputError
        If `disparity` is not a 2-d array of floats, or a value would collide with the mark of invalid pixels
        or does not fit 16 bits.
    OptionError
        If the mark of invalid pixels does not fit 16 bits.
    """
    mark = _mark(min_disparity)
    values = _checked_map(disparity)
    known = np.isfinite(values)
    steps = np.rint(np.where(known, values, np.float32(0)) * np.float32(_STEPS))
    if np.any(known & ((steps <= mark) | (steps > 32767))):
        raise InputError(f"disparity must lie above {min_disparity - 1} and below 2048 pixels, got others")
    return np.where(known, steps, mark).astype(np.int16)


def _suffix(path: str | os.PathLike[str]) -> str:
    suffix = Path(path).suffix.lower()
    suffix = ".tiff" if suffix == ".tif" else suffix
    if suffix not in DISPARITY_SUFFIXES:
        known = ", ".join(DISPARITY_SUFFIXES)
        raise FileError(f"disparity file must end in one of {known}, got {str(path)!r}")
    return suffix


def _mark(min_disparity: int) -> int:
    mark = (min_disparity - 1) * _STEPS
    if not -32768 <= mark <= 32767:
        raise OptionError(f"min_disparity must lie in -2047 .. 2048 for 16 bits, got {min_disparity}")
    return mark


def _checked_map(disparity: ArrayLike) -> NDArray[np.float32]:
    values = np.asarray(disparity)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind != "f":
        raise InputError(f"disparity must be (H, W) float and not empty, got {describe(values)}")
    return np.ascontiguousarray(values, dtype=np.float32)
