"""The size that an image file claims, against what so many bytes can hold.

Some decoders reserve and fill all that a header claims before they miss the data: a file of 400 bytes took gigabytes.

Sources: PNG 1.2, 11.2.2, whose deflate makes at most 1032 bytes of one (zlib's technical notes); JPEG (ITU T.81), B.2.2
and F.1.2, where Huffman codes spend at least one bit on each block of 8 x 8; GIF89a, 18.
"""

from __future__ import annotations

import os
import struct

from stereokit.errors import FileError
from stereokit.io.orientation import jpeg_segments, png_chunks

__all__ = ["check_claim"]

_PNG = b"\x89PNG\r\n\x1a\n"
_MOST_PER_BYTE = 8 * 1032
"""Pixels: of one bit each, as deflate packs them at best. Runs and palettes of GIF and BMP stay below that."""
_MOST_PER_BYTE_OF_HUFFMAN = 1024
"""Pixels: a bit a block is 512; twice that where no component has all rows and all columns."""
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # segments of a JPEG that tell its size
_ARITHMETIC = 0xC9  # from here on, frames whose bits are less than one a block


def check_claim(path: str | os.PathLike[str], data: bytes) -> None:
    """Refuse an image that claims more pixels than its bytes can hold.

    Parameters
    ----------
    path : path
        For the message.
    data : bytes
        The content of the file. Other formats are not looked at: their decoders read before they fill, or a blank image
        of any size takes but a few bytes.

    Raises
    ------
    FileError
        If it is a PNG, JPEG, GIF or BMP of such a size, or a PNG of which a chunk is.
    """
    try:
        width, height, most = _claim(data)
    except struct.error:  # cut off, which the decoder tells
        return
    if data.startswith(_PNG) and any(at + length > len(data) for _, at, length in png_chunks(data)):
        raise FileError(f"{str(path)!r} is a broken PNG: a part of it claims more than its {len(data)} bytes")
    if width * height > most * len(data):
        raise FileError(f"{str(path)!r} claims {width}x{height} pixels, more than {len(data)} bytes can hold")


def _claim(data: bytes) -> tuple[int, int, int]:
    """Return the width, the height and the most pixels a byte; zeros for what is not looked at."""
    if data.startswith(_PNG):
        return (*struct.unpack_from(">II", data, 16), _MOST_PER_BYTE)
    if data.startswith(b"\xff\xd8"):
        for marker, at in jpeg_segments(data):
            if marker in _FRAMES:
                height, width = struct.unpack_from(">HH", data, at + 1)
                return width, height, _MOST_PER_BYTE if marker >= _ARITHMETIC else _MOST_PER_BYTE_OF_HUFFMAN
    elif data.startswith((b"GIF87a", b"GIF89a")):
        return (*struct.unpack_from("<HH", data, 6), _MOST_PER_BYTE)
    elif data.startswith(b"BM"):
        old = int.from_bytes(data[14:18], "little") == 12  # the header of OS/2
        width, height = struct.unpack_from("<HH" if old else "<ii", data, 18)
        return abs(width), abs(height), _MOST_PER_BYTE
    return 0, 0, 0
