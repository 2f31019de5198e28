"""Depth images: float metres in TIFF and npy, and 16-bit millimetres in PNG, as depth cameras and Open3D have them."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import FileError, InputError
from stereokit.io.atomic import check_output, write_bytes
from stereokit.io.disparity import write_disparity
from stereokit.io.images import decode, describe, encode
from stereokit.io.reading import parsing, read_bytes, read_npy

__all__ = ["DEPTH_SUFFIXES", "FARTHEST_PNG_M", "read_depth", "write_depth"]

DEPTH_SUFFIXES = (".png", ".tiff", ".tif", ".npy")
"""What `write_depth` knows."""

FARTHEST_PNG_M = 65.535
"""The largest depth that 16 bits of millimetres hold, metres."""


def write_depth(path: str | os.PathLike[str], depth: ArrayLike) -> None:
    """Write a depth image; the format follows from the suffix.

    Parameters
    ----------
    path : path
        ``.png``: 16-bit millimetres, 0 where there is no depth or it is beyond 65.535 m (a depth of less than half a
        millimetre is 1). ``.tiff`` and ``.npy``: float32 metres, NaN where there is no depth.
    depth : (H, W) float
        Metres, not finite where there is none.

    Raises
    ------
    InputError
        If `depth` is not (H, W) float, or a depth is negative.
    FileError
        If the suffix is unknown or the file cannot be written.
    """
    target = check_output(path, DEPTH_SUFFIXES)
    metres = np.asarray(depth)
    if metres.ndim != 2 or metres.size == 0 or metres.dtype.kind != "f":
        raise InputError(f"depth must be (H, W) float and not empty, got {describe(metres)}")
    known = np.isfinite(metres)
    if (metres[known] < 0).any():
        raise InputError(f"depth must not be negative, got {metres[known].min():g}")
    if target.suffix.lower() != ".png":
        write_disparity(target, np.where(known, metres, np.nan).astype(np.float32))
        return
    known &= metres <= FARTHEST_PNG_M
    millimetres = np.rint(np.where(known, metres, 0).astype(np.float64) * 1000)
    stored = np.where(known, np.clip(millimetres, 1, 65535), 0).astype(np.uint16)
    write_bytes(target, encode(".png", stored))


def read_depth(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a depth image, as `write_depth` writes it.

    Parameters
    ----------
    path : path
        16-bit millimetres in ``.png``, float metres in ``.tiff`` or ``.npy``.

    Returns
    -------
    (H, W) float32
        Metres, NaN where there is no depth.

    Raises
    ------
    FileError
        If the file is missing or is none of these.
    """
    suffix = os.path.splitext(path)[1].lower()
    with parsing(path, "depth image"):
        stored = read_npy(path, read_bytes(path)) if suffix == ".npy" else decode(path)[0]
        if suffix == ".png":
            if stored.dtype != np.uint16 or stored.ndim != 2:
                raise FileError(f"{str(path)!r} must be a 16-bit grey PNG, got {describe(stored)}")
            return np.where(stored == 0, np.nan, stored / 1000).astype(np.float32)
        if stored.ndim != 2 or stored.dtype.kind != "f":
            raise FileError(f"{str(path)!r} must hold (H, W) float metres, got {describe(stored)}")
        return np.where(np.isfinite(stored), stored, np.nan).astype(np.float32)
