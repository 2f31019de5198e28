"""The orientation that a camera notes in an image file: EXIF's tag 0x0112, in JPEG, PNG, WebP and TIFF.

Source: EXIF 2.32 (CIPA DC-008), 4.6.4; where the EXIF block lies: JPEG's segment APP1, PNG's chunk ``eXIf``, WebP's
chunk ``EXIF``; a TIFF file is such a block itself. Read here because what OpenCV makes of the tag depends on its
version and on the format, and because a pair whose views differ in it is suspicious.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "UPRIGHT",
    "find_orientation",
    "jpeg_segments",
    "oriented",
    "png_chunks",
    "stored_window",
    "without_orientation",
]

UPRIGHT = 1
_TAG = 0x0112
_SHORT = 3
_STEPS = {  # transposed, then upside down, then mirrored
    1: (False, False, False),
    2: (False, False, True),
    3: (False, True, True),
    4: (False, True, False),
    5: (True, False, False),
    6: (True, False, True),
    7: (True, True, True),
    8: (True, True, False),
}


def find_orientation(data: bytes) -> int:
    """Return the orientation, 1 to 8, that the content of an image file names; 1, upright, where it names none."""
    place = _place(data)
    return UPRIGHT if place is None else int.from_bytes(data[place[0] : place[0] + 2], place[1])


def without_orientation(data: bytes) -> bytes:
    """Return the content of an image file with its orientation set to upright."""
    place = _place(data)
    if place is None:
        return data
    return data[: place[0]] + UPRIGHT.to_bytes(2, place[1]) + data[place[0] + 2 :]


def oriented(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Return an image as viewers show it.

    Parameters
    ----------
    image : (H, W, ...)
        As stored.
    orientation : int
        1 to 8.

    Returns
    -------
    (H, W, ...), or (W, H, ...) where the camera was on its side
        C-contiguous.
    """
    sideways, upside_down, mirrored = _STEPS[orientation]
    turned = image.swapaxes(0, 1) if sideways else image
    turned = turned[::-1] if upside_down else turned
    return np.ascontiguousarray(turned[:, ::-1] if mirrored else turned)


def stored_window(
    orientation: int, height: int, width: int, y0: int, y1: int, x0: int, x1: int
) -> tuple[int, int, int, int]:
    """Return where rows y0 to y1 and columns x0 to x1 of the image as shown, `height` x `width`, lie as stored."""
    sideways, upside_down, mirrored = _STEPS[orientation]
    rows = (height - y1, height - y0) if upside_down else (y0, y1)
    columns = (width - x1, width - x0) if mirrored else (x0, x1)
    return (*columns, *rows) if sideways else (*rows, *columns)


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the marker of each segment of a JPEG before its first scan, and where the segment's content begins.

    What stands between segments is passed over, as decoders do.
    """
    at = data.find(b"\xff", 2)
    while 0 <= at < len(data) - 3:
        marker = data[at + 1]
        if marker in (0xD9, 0xDA):  # the end, or a scan
            return
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD8:  # nothing follows
            step = 1
        else:
            yield marker, at + 4
            step = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        at = data.find(b"\xff", at + step)


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind of each chunk of a PNG before its end, where its content begins, and the length that it claims."""
    at = 8
    while data[at + 4 : at + 8] not in (b"IEND", b""):
        length = int.from_bytes(data[at : at + 4], "big")
        yield data[at + 4 : at + 8], at + 8, length
        at += 12 + length


def _place(data: bytes) -> tuple[int, Any] | None:
    """Return where the value of the tag lies in a file, two bytes, and their order; None if there is no sound one."""
    try:
        start = _block(data)
        return None if start is None else _entry(data, start)
    except (struct.error, IndexError):  # cut off
        return None


def _block(data: bytes) -> int | None:
    """Return where the EXIF block of a file begins."""
    if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return 0
    if data[:2] == b"\xff\xd8":
        for marker, at in jpeg_segments(data):
            if marker == 0xE1 and data[at : at + 6] == b"Exif\0\0":
                return at + 6
    elif data[:8] == b"\x89PNG\r\n\x1a\n":
        for kind, at, _ in png_chunks(data):
            if kind == b"eXIf":
                return at
    elif data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        at = 12
        while data[at : at + 4]:
            if data[at : at + 4] == b"EXIF":
                return at + (14 if data[at + 8 : at + 14] == b"Exif\0\0" else 8)
            size = int(struct.unpack_from("<I", data, at + 4)[0])
            at += 8 + size + size % 2
    return None


def _entry(data: bytes, start: int) -> tuple[int, Any] | None:
    """Return where the first directory of a block has the tag's value."""
    order, byte_order = {b"II": ("<", "little"), b"MM": (">", "big")}.get(data[start : start + 2], ("", ""))
    if not order:
        return None
    big = struct.unpack_from(order + "H", data, start + 2)[0] == 43  # BigTIFF
    directory, count, entry, step = ("Q", "Q", "HHQ", 20) if big else ("I", "H", "HHI", 12)
    at = start + int(struct.unpack_from(order + directory, data, start + (8 if big else 4))[0])
    entries = int(struct.unpack_from(order + count, data, at)[0])
    at += struct.calcsize(order + count)
    for place in range(at, min(at + step * entries, len(data)), step):
        tag, kind, number = struct.unpack_from(order + entry, data, place)
        if (tag, kind, number) == (_TAG, _SHORT, 1):
            value = place + struct.calcsize(order + entry)
            found = int(struct.unpack_from(order + "H", data, value)[0])
            return (value, byte_order) if found in _STEPS else None
    return None
