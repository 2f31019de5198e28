"""Check of the size in an image file's header against the number of its bytes.

Some decoders reserve and fill all pixels of the header before they miss the data: a file of 400 bytes took gigabytes.

Sources: PNG 1.2, 11.2.2, whose deflate expands a byte to at most 1032 (zlib's technical notes); JPEG (ITU T.81), B.2.2
and F.1.2, where Huffman codes spend at least one bit on each block of 8 x 8; GIF89a, 18.
"""

from __future__ import annotations

import os
import struct

from stereokit.errors import FileError
from stereokit.io.orientation import jpeg_segments, png_chunks

__all__ = ["check_claim"]

_PNG = b"\x89PNG\r\n\x1a\n"
_DEFLATE_PIXELS = 8 * 1032
"""Most pixels per byte, at one bit each: the best that deflate does. Runs and palettes of GIF and BMP are below it."""
_HUFFMAN_PIXELS = 1024
"""Most pixels per byte: a bit per block is 512; twice that where no component has all rows and all columns."""
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # segments of a JPEG with its size
_ARITHMETIC = 0xC9  # from here on, frames with less than one bit per block


def check_claim(path: str | os.PathLike[str], data: bytes) -> None:
    """Refuse an image that claims more pixels than its bytes can hold.

    Parameters
    ----------
    path : path
        For the message.
    data : bytes
        The content of the file. Other formats are not checked: their decoders read before they fill, or a blank image
        of any size has only a few bytes.

    Raises
    ------
    FileError
        If it is a PNG, JPEG, GIF or BMP of such a size, or a PNG of which a chunk is.
    """
    try:
        width, height, pixels_per_byte = _claimed_size(data)
    except struct.error:  # cut off; the decoder reports that
        return
    if data.startswith(_PNG) and any(offset + length > len(data) for _, offset, length in png_chunks(data)):
        raise FileError(f"{str(path)!r} is a broken PNG: a part of it claims more than its {len(data)} bytes")
    if width * height > pixels_per_byte * len(data):
        raise FileError(f"{str(path)!r} claims {width}x{height} pixels, more than {len(data)} bytes can hold")


def _claimed_size(data: bytes) -> tuple[int, int, int]:
    """Return the width, the height and the most pixels per byte; zeros for formats that are not checked."""
    if data.startswith(_PNG):
        return (*struct.unpack_from(">II", data, 16), _DEFLATE_PIXELS)
    if data.startswith(b"\xff\xd8"):
        for marker, offset in jpeg_segments(data):
            if marker in _FRAMES:
                height, width = struct.unpack_from(">HH", data, offset + 1)
                return width, height, _DEFLATE_PIXELS if marker >= _ARITHMETIC else _HUFFMAN_PIXELS
    elif data.startswith((b"GIF87a", b"GIF89a")):
        return (*struct.unpack_from("<HH", data, 6), _DEFLATE_PIXELS)
    elif data.startswith(b"BM"):
        is_os2 = int.from_bytes(data[14:18], "little") == 12  # the header of OS/2
        width, height = struct.unpack_from("<HH" if is_os2 else "<ii", data, 18)
        return abs(width), abs(height), _DEFLATE_PIXELS
    return 0, 0, 0
