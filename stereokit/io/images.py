"""Images as OpenCV reads and writes them."""

from __future__ import annotations

import os
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import FileError, InputError
from stereokit.io.atomic import check_output, read_bytes, write_bytes

__all__ = [
    "IMAGE_SUFFIXES",
    "decode",
    "describe",
    "encode",
    "read_image",
    "write_image",
]

IMAGE_SUFFIXES = (".png", ".tiff", ".tif", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm")
"""What `write_image` knows."""

_DEEP = {
    "uint16": (".png", ".tiff", ".tif", ".pgm", ".ppm"),
    "float32": (".tiff", ".tif"),
    "float64": (".tiff", ".tif"),
}


def read_image(path: str | os.PathLike[str], gray: bool = False) -> NDArray[Any]:
    """Read an image as it is stored.

    Parameters
    ----------
    path : path
        Anything that OpenCV decodes: PNG, JPEG, TIFF, BMP, PGM, PPM ...
    gray : bool
        Turn colour into grey (0.299 R + 0.587 G + 0.114 B).

    Returns
    -------
    (H, W) or (H, W, 3) uint8, uint16, float32 or float64
        Grey or RGB. Alpha is dropped, palettes are resolved, rotation tags are not applied.

    Raises
    ------
    FileError
        If the file is missing or is not an image of these types.
    """
    image = decode(path)
    if str(image.dtype) not in ("uint8", *_DEEP):
        raise FileError(f"{str(path)!r} holds {image.dtype} pixels, expected uint8, uint16 or float")
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    if image.shape[2] not in (3, 4):
        raise FileError(f"{str(path)!r} has {image.shape[2]} channels, expected grey or colour")
    colors = np.ascontiguousarray(image[:, :, 2::-1])
    if not gray:
        return colors
    if colors.dtype == np.float64:  # OpenCV's conversion stops at float32
        return np.asarray(colors @ np.array([0.299, 0.587, 0.114]))
    return np.asarray(cv2.cvtColor(colors, cv2.COLOR_RGB2GRAY))


def write_image(path: str | os.PathLike[str], array: ArrayLike) -> None:
    """Write an image; the format follows from the suffix.

    Parameters
    ----------
    path : path
        Ends in one of `IMAGE_SUFFIXES`.
    array : (H, W) or (H, W, 3) uint8, uint16, float32 or float64
        Grey or RGB. uint16 goes to PNG, TIFF, PGM and PPM, floats to TIFF only; PGM is grey, PPM is colour.

    Raises
    ------
    InputError
        If `array` has another shape or type, or a type that the format cannot hold.
    FileError
        If the suffix is unknown or the file cannot be written.
    """
    target = check_output(path, IMAGE_SUFFIXES)
    image = np.asarray(array)
    if image.size == 0 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise InputError(f"array must be (H, W) or (H, W, 3) and not empty, got shape {image.shape}")
    kind, suffix = str(image.dtype), target.suffix.lower()
    if kind not in ("uint8", *_DEEP):
        raise InputError(f"array must be uint8, uint16, float32 or float64, got {kind}")
    if suffix not in _DEEP.get(kind, IMAGE_SUFFIXES):
        raise InputError(f"array of {kind} cannot be kept in {suffix}; use one of {', '.join(_DEEP[kind])}")
    if (suffix, image.ndim) in ((".pgm", 3), (".ppm", 2)):
        raise InputError(
            f"array for {suffix} must be {'(H, W)' if image.ndim == 3 else '(H, W, 3)'}, got {image.shape}"
        )
    write_bytes(target, encode(suffix, image))


def decode(path: str | os.PathLike[str]) -> NDArray[Any]:
    """Return an image as it is stored, with the channels in OpenCV's order.

    Raises
    ------
    FileError
        If the file is missing or is not an image.
    """
    data = read_bytes(path)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise FileError(f"{str(path)!r} is not an image that can be read")
    return np.asarray(image)


def encode(suffix: str, image: NDArray[Any]) -> bytes:
    """Return an image, grey or RGB, as the content of a file.

    Raises
    ------
    FileError
        If the format cannot hold it.
    """
    stored = image if image.ndim == 2 else image[:, :, ::-1]  # OpenCV wants BGR
    # Left to itself, OpenCV 4 keeps float colour in TIFF as LogLuv, which loses digits; 5 is LZW.
    settings = [cv2.IMWRITE_TIFF_COMPRESSION, 5] if suffix.startswith(".tif") else []
    try:
        ok, data = cv2.imencode(suffix, np.ascontiguousarray(stored), settings)
    except cv2.error as error:
        raise FileError(f"cannot encode {describe(image)} as {suffix}") from error
    if not ok:
        raise FileError(f"cannot encode {describe(image)} as {suffix}")
    return data.tobytes()


def describe(array: Any) -> str:
    """Return what messages say of an array that was not wanted."""
    return f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
