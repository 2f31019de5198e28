"""PFM of Middlebury 2014: rows bottom-up, the sign of the scale gives the byte order, its magnitude is unused.

PFM is read and written here because OpenCV's treatment of row order and scale depends on the version.
"""

from __future__ import annotations

import os
import re

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError
from stereokit.io.reading import parsing, read_bytes

__all__ = [
    "pfm_bytes",
    "read_pfm",
]

_HEADER = re.compile(rb"(P[fF])\s+(\d{1,10})\s+(\d{1,10})\s+([-+]?[0-9.]+(?:[eE][-+]?\d+)?)(?:\r\n|[ \t]*\n|\s)")


def read_pfm(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Return the values of a grey PFM, (H, W), the upper row first.

    Raises
    ------
    FileError
        If the file is missing or is no such PFM.
    """
    data = read_bytes(path)
    with parsing(path, "PFM"):
        return _parsed(path, data)


def _parsed(path: str | os.PathLike[str], data: bytes) -> NDArray[np.float32]:
    header = _HEADER.match(data)
    if header is None:
        raise FileError(f"{str(path)!r} has no PFM header")
    if header[1] == b"PF":
        raise FileError(f"{str(path)!r} is a colour PFM, expected a grey one (Pf)")
    width, height = int(header[2]), int(header[3])
    try:
        scale = float(header[4])
    except ValueError:
        scale = 0.0
    expected, received = 4 * width * height, len(data) - header.end()
    if scale == 0 or expected == 0 or received < expected:
        raise FileError(
            f"{str(path)!r} is a broken PFM: size {width}x{height}, scale {header[4].decode()}, "
            f"{received} bytes of data where {expected} are needed"
        )
    values = np.frombuffer(data, "<f4" if scale < 0 else ">f4", width * height, header.end())
    return values.reshape(height, width)[::-1].astype(np.float32)


def pfm_bytes(values: NDArray[np.float32]) -> bytes:
    """Return a map, (H, W) float32, as a grey PFM; values that are not finite become infinite."""
    rows = np.where(np.isfinite(values), values, np.float32(np.inf))[::-1].astype("<f4")
    return b"Pf\n%d %d\n-1.0\n" % (values.shape[1], values.shape[0]) + rows.tobytes()
