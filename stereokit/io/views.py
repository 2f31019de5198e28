"""Both views of a pair from one file: side by side, one above the other, or as two pictures of the file.

The pictures of a Multi-Picture Format file (MPO, of 3D cameras) are found by its index: CIPA DC-007, 5.2.3.3.
"""

from __future__ import annotations

import io
import os
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, OptionError, shown
from stereokit.io.images import TIFF_STARTS, decode_bytes, open_tiff, plain_image
from stereokit.io.orientation import find_orientation, jpeg_segments, oriented, without_orientation
from stereokit.io.quiet import quiet_decoders
from stereokit.io.reading import parsing, read_bytes

__all__ = ["LAYOUTS", "read_views", "split_views"]

LAYOUTS = ("side-by-side", "top-bottom", "right-left", "bottom-top", "pages")
"""Where the views are in a file: left and right, right and left ("right-left"), in one picture or in two."""

_APP2 = 0xE2
_MP_ENTRY = 0xB002
_MOST_PICTURES = 64


def read_views(
    path: str | os.PathLike[str], layout: str | None = None, gray: bool = False
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read a pair from one file.

    Parameters
    ----------
    path : path
        An image as `stereokit.read_image` takes it, an MPO, or a TIFF of two pages.
    layout : str or None
        One of `LAYOUTS`. None takes the two pictures of a file that has two, and the halves of one that is at least
        twice as wide as it is high.
    gray : bool
        Turn colour into grey.

    Returns
    -------
    left, right : (H, W) or (H, W, 3) uint8, uint16, float32 or float64

    Raises
    ------
    FileError
        If the file is missing, is no image, or has no such two views.
    OptionError
        If there is no such layout.
    """
    if layout is not None and layout not in LAYOUTS:
        raise OptionError(f"layout must be one of {', '.join(LAYOUTS)}, got {shown(layout)}")
    name, data = repr(str(path)), read_bytes(path)
    pages = _pages(path, data) if layout in (None, "pages") else []
    if len(pages) == 2:
        left, right = (plain_image(path, page, gray) for page in pages)
        if left.shape != right.shape:
            sizes = " and ".join(f"{view.shape[1]}x{view.shape[0]}" for view in (left, right))
            raise FileError(f"{name}: its two pictures must have one size, got {sizes}")
        return left, right
    if layout == "pages" or len(pages) > 2:
        raise FileError(f"{name} must hold two pictures, got {len(pages) or 1}")
    image = plain_image(path, decode_bytes(path, data)[0], gray)
    if layout is None:
        height, width = image.shape[:2]
        if width < 2 * height:
            raise FileError(
                f"{name}: one picture of {width}x{height} pixels does not tell where its two views are; "
                f"layout can be {', '.join(LAYOUTS[:-1])}"
            )
        layout = "side-by-side"
    try:
        return split_views(image, layout)
    except OptionError as error:
        raise FileError(f"{name}: {error}") from None


def split_views(image: NDArray[Any], layout: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the left and the right view of a picture that holds both.

    Parameters
    ----------
    image : (H, W) or (H, W, C)
    layout : str
        One of `LAYOUTS` but "pages".

    Raises
    ------
    OptionError
        If the picture cannot be halved.
    """
    axis = 1 if layout in ("side-by-side", "right-left") else 0
    length = image.shape[axis]
    if length % 2 or length == 0:
        side = "width" if axis else "height"
        raise OptionError(f"a picture with its views {layout} must have an even {side}, got {length}")
    first, second = (np.ascontiguousarray(half) for half in np.split(image, 2, axis))
    return (first, second) if layout in ("side-by-side", "top-bottom") else (second, first)


def _pages(path: str | os.PathLike[str], data: bytes) -> list[NDArray[Any]]:
    """Return the pictures of a file that can hold several; none for other formats."""
    with parsing(path, "image"):
        if data.startswith(TIFF_STARTS):
            return _tiff_pages(path, data)
        if data.startswith(b"\xff\xd8"):
            return [decode_bytes(path, part)[0] for part in _jpeg_pictures(data)]
    return []


def _tiff_pages(path: str | os.PathLike[str], data: bytes) -> list[NDArray[Any]]:
    tag, upright = find_orientation(data), without_orientation(data)
    try:
        with quiet_decoders():
            good, pages = cv2.imdecodemulti(np.frombuffer(upright, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        good, pages = False, ()
    if good:
        images = [
            page[:, :, 2::-1] if page.ndim == 3 and page.shape[2] > 2 else page for page in map(np.asarray, pages)
        ]
        return [oriented(image, tag) for image in images]
    try:
        import tifffile
    except ModuleNotFoundError:
        return []
    with tifffile.TiffFile(io.BytesIO(upright)) as file:
        if open_tiff(path, file) is None or not 1 < len(file.pages) <= _MOST_PICTURES:
            return []
        return [oriented(np.asarray(page.asarray()), tag) for page in file.pages]


def _jpeg_pictures(data: bytes) -> list[bytes]:
    """Return the pictures of an MPO, each a JPEG; none where there is no index of at least two."""
    for marker, offset in jpeg_segments(data):
        if marker == _APP2 and data[offset : offset + 4] == b"MPF\0":
            return _indexed(data, offset + 4)
    return []


def _indexed(data: bytes, start: int) -> list[bytes]:
    """Return what the index at `start` names; offsets in it are relative to its own first byte."""
    order = {b"II": "<", b"MM": ">"}.get(data[start : start + 2])
    if order is None:
        return []
    try:
        directory = start + struct.unpack_from(order + "I", data, start + 4)[0]
        for k in range(struct.unpack_from(order + "H", data, directory)[0]):
            tag, _, size, place = struct.unpack_from(order + "HHII", data, directory + 2 + 12 * k)
            if tag == _MP_ENTRY and 2 <= size // 16 <= _MOST_PICTURES:
                entries = (struct.unpack_from(order + "III", data, start + place + 16 * n) for n in range(size // 16))
                ranges = [(start + offset if offset else 0, length) for _, length, offset in entries]
                return [data[first : first + length] for first, length in ranges]
    except struct.error:
        pass
    return []
