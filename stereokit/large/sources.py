"""Image sources that are read a window at a time: arrays, memory-mapped ``.npy``, and TIFF tile by tile.

Of a TIFF only the tiles (or strips) that a window touches are decoded. Any other image file is read whole and stays in
memory, and so does a TIFF whose tiles are not its pixels: a palette, planes, inverted greys. A mapped file is mapped
anew for each window, since the pages of an open mapping count as memory of the process.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, StereokitError
from stereokit.images.check import checked_image
from stereokit.io import parsing, read_npy
from stereokit.io.images import NPY_START, TIFF_STARTS, open_tiff, read_oriented
from stereokit.io.orientation import UPRIGHT, oriented, stored_window

__all__ = ["Source", "open_source"]

_ORIENTATION = 0x0112


class Source(Protocol):
    """An image of which windows can be read.

    Attributes
    ----------
    shape : tuple of int
        (H, W) or (H, W, 3).
    dtype : numpy.dtype
        uint8, uint16, float32 or float64.
    row_step : int
        Rows that one read decodes together: the height of a tile.
    piece_nbytes : int
        Further bytes while one tile is read, without the window itself.
    resident_nbytes : int
        Bytes of the source's own memory.
    orientation : int
        The tag that was applied, 1 to 8.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    row_step: int
    piece_nbytes: int
    resident_nbytes: int
    orientation: int

    def read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        """Return rows y0 to y1 of columns x0 to x1."""
        ...


def open_source(name: str, image: Any) -> Source:
    """Return the source of an array or of a file.

    Parameters
    ----------
    name : str
        The argument's name in messages.
    image : (H, W) or (H, W, 3) array, or path
        An npy file is mapped, of a TIFF tiles are decoded as needed, other files are read whole.

    Raises
    ------
    FileError
        If the file cannot be read.
    InputError
        If it holds no image of a type and shape that can be matched.
    StereokitError
        If it needs a package that is not installed.
    """
    if not isinstance(image, (str, os.PathLike)):
        return _Array(checked_image(name, image), 0)
    path = Path(image)
    with parsing(path, "image"), path.open("rb") as file:
        start = file.read(8)
    if start.startswith(NPY_START):
        return _Mapped(name, path)
    page = _tiled(name, path) if start.startswith(TIFF_STARTS) else None
    if page is not None:
        return _Tiff(name, path, page)
    array, orientation = read_oriented(path, alpha=True)
    array = checked_image(name, array)
    return _Array(array, array.nbytes, orientation)


def _checked(name: str, shape: tuple[int, ...], dtype: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and the type, in this machine's byte order, of an image that can be matched."""
    image = checked_image(name, np.broadcast_to(np.zeros((), np.dtype(dtype).newbyteorder("=")), shape))
    return image.shape, image.dtype


class _Array:
    row_step, piece_nbytes = 1, 0

    def __init__(self, array: NDArray[Any], resident_nbytes: int, orientation: int = UPRIGHT) -> None:
        self.shape, self.dtype, self.resident_nbytes = array.shape, array.dtype, resident_nbytes
        self.orientation = orientation
        self._array = array

    def read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        return self._array[y0:y1, x0:x1]


class _Mapped:
    row_step, piece_nbytes, resident_nbytes, orientation = 1, 0, 0, UPRIGHT

    def __init__(self, name: str, path: Path) -> None:
        self._path = path
        array = read_npy(path)
        self.shape, self.dtype = _checked(name, array.shape, array.dtype)

    def read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        with parsing(self._path, "npy file"):  # it may have changed
            window = read_npy(self._path)[y0:y1, x0:x1]
            return np.array(window.reshape(y1 - y0, x1 - x0, *self.shape[2:]), self.dtype, order="C")


def _tiled(name: str, path: Path) -> Any:
    """Return the page of a TIFF that can be read tile by tile, None if it must be read whole."""
    try:
        import tifffile
    except ModuleNotFoundError as error:
        raise StereokitError(
            f"{name}: windows of TIFF need tifffile, which is not installed: pip install 'stereokit[tiff]'"
        ) from error
    with parsing(path, "TIFF"), tifffile.TiffFile(path) as file:
        page = open_tiff(path, file)
        return page


class _Tiff:
    resident_nbytes = 0

    def __init__(self, name: str, path: Path, page: Any) -> None:
        self._path, self._page = path, page
        with parsing(path, "TIFF"):
            tile = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
            height, width = page.imagelength, page.imagewidth
            self._stored = height, width
            self._tile = min(int(tile[0]), height), int(tile[1])
            if min(*self._tile, height, width) < 1:
                raise FileError(f"{str(path)!r} is a broken TIFF: {width}x{height} in pieces of {tile[1]}x{tile[0]}")
            tag = page.tags.valueof(_ORIENTATION, default=UPRIGHT)
            self.orientation = tag if tag in range(1, 9) else UPRIGHT
            if self.orientation > 4:  # on its side
                height, width = width, height
            color = (3,) if page.samplesperpixel > 1 else ()
        self.shape, self.dtype = _checked(name, (height, width, *color), page.dtype)
        self.row_step = self._tile[0] if self.orientation <= 4 else self._tile[1]
        pixels = self._tile[0] * self._tile[1] * page.samplesperpixel
        self.piece_nbytes = 3 * pixels * self.dtype.itemsize  # as stored, decoded, and on its way to the window

    def read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        height, width = self.shape[:2]
        place = stored_window(self.orientation, height, width, y0, y1, x0, x1)
        with parsing(self._path, "TIFF"):
            return oriented(self._read(*place), self.orientation)

    def _read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        out = np.zeros((y1 - y0, x1 - x0, *self.shape[2:]), self.dtype)
        page, (tile_height, tile_width) = self._page, self._tile
        tiles_per_row = -(-self._stored[1] // tile_width)
        with self._path.open("rb") as file:
            for tile_row in range(y0 // tile_height, -(-y1 // tile_height)):
                for tile_column in range(x0 // tile_width, -(-x1 // tile_width)):
                    index = tile_row * tiles_per_row + tile_column
                    file.seek(page.dataoffsets[index])
                    stored = file.read(page.databytecounts[index])
                    decoded = page.decode(stored, index, jpegtables=page.jpegtables)[0] if stored else None
                    if decoded is not None:  # None is a tile that was never written: zeros
                        self._place(decoded[0], tile_row * tile_height, tile_column * tile_width, out, y0, x0)
        return out

    def _place(self, tile: NDArray[Any], top: int, start: int, out: NDArray[Any], y0: int, x0: int) -> None:
        """Copy the pixels that a tile, (h, w, samples) from row `top` and column `start`, shares with window `out`."""
        first_y, last_y = max(top, y0), min(top + tile.shape[0], y0 + out.shape[0])
        first_x, last_x = max(start, x0), min(start + tile.shape[1], x0 + out.shape[1])
        part = tile[first_y - top : last_y - top, first_x - start : last_x - start]
        part = part[:, :, 0] if out.ndim == 2 else part[:, :, :3]
        out[first_y - y0 : last_y - y0, first_x - x0 : last_x - x0] = part
