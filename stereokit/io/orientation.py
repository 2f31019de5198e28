"""The orientation tag of an image file: EXIF's tag 0x0112, in JPEG, PNG, WebP and TIFF.

Source: EXIF 2.32 (CIPA DC-008), 4.6.4. The EXIF block is JPEG's segment APP1, PNG's chunk ``eXIf``, WebP's chunk
``EXIF``; a TIFF file is such a block itself. The tag is read here because OpenCV's treatment of it depends on the
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
    tag_offset = _tag_offset(data)
    return UPRIGHT if tag_offset is None else int.from_bytes(data[tag_offset[0] : tag_offset[0] + 2], tag_offset[1])


def without_orientation(data: bytes) -> bytes:
    """Return the content of an image file with its orientation set to upright."""
    tag_offset = _tag_offset(data)
    if tag_offset is None:
        return data
    return data[: tag_offset[0]] + UPRIGHT.to_bytes(2, tag_offset[1]) + data[tag_offset[0] + 2 :]


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
    """Return the stored rows and columns of a window, y0 to y1 and x0 to x1, of the upright image."""
    sideways, upside_down, mirrored = _STEPS[orientation]
    rows = (height - y1, height - y0) if upside_down else (y0, y1)
    columns = (width - x1, width - x0) if mirrored else (x0, x1)
    return (*columns, *rows) if sideways else (*rows, *columns)


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the marker of each segment of a JPEG before its first scan, and the offset of the segment's content.

    Bytes between segments are skipped, as decoders do.
    """
    offset = data.find(b"\xff", 2)
    while 0 <= offset < len(data) - 3:
        marker = data[offset + 1]
        if marker in (0xD9, 0xDA):  # the end, or a scan
            return
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD8:  # nothing follows
            step = 1
        else:
            yield marker, offset + 4
            step = 2 + int.from_bytes(data[offset + 2 : offset + 4], "big")
        offset = data.find(b"\xff", offset + step)


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind of each chunk of a PNG before its end, the offset of its content, and its length by the header."""
    offset = 8
    while data[offset + 4 : offset + 8] not in (b"IEND", b""):
        length = int.from_bytes(data[offset : offset + 4], "big")
        yield data[offset + 4 : offset + 8], offset + 8, length
        offset += 12 + length


def _tag_offset(data: bytes) -> tuple[int, Any] | None:
    """Return the offset of the tag's value in a file, two bytes, and their order; None if there is no sound one."""
    try:
        start = _exif_offset(data)
        return None if start is None else _value_offset(data, start)
    except (struct.error, IndexError):  # cut off
        return None


def _exif_offset(data: bytes) -> int | None:
    """Return the offset of the EXIF block of a file."""
    if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return 0
    if data[:2] == b"\xff\xd8":
        for marker, offset in jpeg_segments(data):
            if marker == 0xE1 and data[offset : offset + 6] == b"Exif\0\0":
                return offset + 6
    elif data[:8] == b"\x89PNG\r\n\x1a\n":
        for kind, offset, _ in png_chunks(data):
            if kind == b"eXIf":
                return offset
    elif data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        offset = 12
        while data[offset : offset + 4]:
            if data[offset : offset + 4] == b"EXIF":
                return offset + (14 if data[offset + 8 : offset + 14] == b"Exif\0\0" else 8)
            size = int(struct.unpack_from("<I", data, offset + 4)[0])
            offset += 8 + size + size % 2
    return None


def _value_offset(data: bytes, start: int) -> tuple[int, Any] | None:
    """Return the offset of the tag's value in the first directory of a block, and the order of its bytes."""
    order, byte_order = {b"II": ("<", "little"), b"MM": (">", "big")}.get(data[start : start + 2], ("", ""))
    if not order:
        return None
    is_bigtiff = struct.unpack_from(order + "H", data, start + 2)[0] == 43  # BigTIFF
    directory, count, entry, step = ("Q", "Q", "HHQ", 20) if is_bigtiff else ("I", "H", "HHI", 12)
    offset = start + int(struct.unpack_from(order + directory, data, start + (8 if is_bigtiff else 4))[0])
    entries = int(struct.unpack_from(order + count, data, offset)[0])
    offset += struct.calcsize(order + count)
    for entry_offset in range(offset, min(offset + step * entries, len(data)), step):
        tag, kind, value_count = struct.unpack_from(order + entry, data, entry_offset)
        if (tag, kind, value_count) == (_TAG, _SHORT, 1):
            value = entry_offset + struct.calcsize(order + entry)
            orientation = int(struct.unpack_from(order + "H", data, value)[0])
            return (value, byte_order) if orientation in _STEPS else None
    return None
