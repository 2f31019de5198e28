"""Map files, written band by band: ``.npy``, and tiled TIFF, which needs tifffile.

The file has a temporary name in the target's folder; it is renamed when it is complete, and removed after an error.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import StereokitError
from stereokit.io import check_output, replacing

__all__ = ["SUFFIXES", "check_large_output", "write_bands"]

SUFFIXES = (".npy", ".tiff", ".tif")
TILE = 256
"""Side of the tiles of a TIFF, pixels."""


def check_large_output(path: str | os.PathLike[str]) -> Path:
    """Return `path`, checked before any work is done for it.

    Raises
    ------
    FileError
        If its suffix is unknown, its folder is missing, or it is a folder.
    StereokitError
        If it needs a package that is not installed.
    """
    target = check_output(path, SUFFIXES, "output")
    if target.suffix.lower() != ".npy":
        try:
            import tifffile  # noqa: F401
        except ModuleNotFoundError as error:
            raise StereokitError("output: tiled TIFF needs tifffile: pip install 'stereokit[tiff]'") from error
    return target


def write_bands(path: Path, height: int, width: int, bands: Iterable[NDArray[np.float32]]) -> None:
    """Write a map that comes in bands of full width from top to bottom, one band in memory at a time.

    Parameters
    ----------
    path : Path
        Ends in one of `SUFFIXES`.
    height, width : int
        Of the map.
    bands : iterable of (rows, `width`) float32

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    write = _write_npy if path.suffix.lower() == ".npy" else _write_tiff
    with replacing(path) as temporary:
        write(temporary, height, width, bands)


def _write_npy(path: Path, height: int, width: int, bands: Iterable[NDArray[np.float32]]) -> None:
    header = {"descr": "<f4", "fortran_order": False, "shape": (height, width)}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for band in bands:
            file.write(np.ascontiguousarray(band, "<f4").data)


def _write_tiff(path: Path, height: int, width: int, bands: Iterable[NDArray[np.float32]]) -> None:
    import tifffile

    options: dict[str, Any] = {"shape": (height, width), "dtype": np.float32, "tile": (TILE, TILE)}
    with tifffile.TiffWriter(path, bigtiff=4 * height * width > 2**31) as writer:
        writer.write(_tiles(bands, width), photometric="minisblack", compression="deflate", metadata=None, **options)


def _tiles(bands: Iterable[NDArray[np.float32]], width: int) -> Iterator[NDArray[np.float32]]:
    """Yield the tiles of a map, row by row of tiles; those at the lower and right side are filled up with zeros."""
    pending: list[NDArray[np.float32]] = []
    for band in bands:
        pending.append(band)
        rows = np.concatenate(pending)
        row_count = len(rows) // TILE * TILE
        for top in range(0, row_count, TILE):
            yield from _row_of_tiles(rows[top : top + TILE], width)
        pending = [rows[row_count:].copy()]
    if pending and len(pending[0]):
        yield from _row_of_tiles(pending[0], width)


def _row_of_tiles(rows: NDArray[np.float32], width: int) -> Iterator[NDArray[np.float32]]:
    for start in range(0, width, TILE):
        part = rows[:, start : start + TILE]
        tile = np.zeros((TILE, TILE), np.float32)
        tile[: part.shape[0], : part.shape[1]] = part
        yield tile
