"""Images that are read a window at a time: arrays, memory-mapped ``.npy``, and TIFF tile by tile.

Of a TIFF only the tiles (or strips) that a window touches are decoded. Any other image file is read whole and held.
A mapped file is mapped anew for each window: pages of a mapping that lives on count as memory of the process.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, StereokitError
from stereokit.images.check import checked_image
from stereokit.io import read_image

__all__ = ["Source", "open_source"]

_TIFF = (".tif", ".tiff")


class Source(Protocol):
    """An image of which windows can be read.

    Attributes
    ----------
    shape : tuple of int
        (H, W) or (H, W, 3).
    dtype : numpy.dtype
        uint8, uint16, float32 or float64.
    row_step : int
        Rows that are read together at no further cost: the height of a tile.
    piece_nbytes : int
        Bytes that reading one piece takes beside the window.
    held_nbytes : int
        Bytes that the source itself holds in memory.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    row_step: int
    piece_nbytes: int
    held_nbytes: int

    def read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        """Return rows y0 to y1 of columns x0 to x1."""
        ...


def open_source(name: str, image: Any) -> Source:
    """Return the source of an array or of a file.

    Parameters
    ----------
    name : str
        What messages call the argument.
    image : (H, W) or (H, W, 3) array, or path
        ``.npy`` is mapped, of ``.tif`` and ``.tiff`` tiles are decoded as needed, other files are read whole.

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
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return _Mapped(name, path)
    if suffix in _TIFF:
        return _Tiff(name, path)
    whole = checked_image(name, read_image(path))
    return _Array(whole, whole.nbytes)


def _checked(name: str, shape: tuple[int, ...], dtype: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and the type, in this machine's byte order, of an image that can be matched."""
    image = checked_image(name, np.broadcast_to(np.zeros((), np.dtype(dtype).newbyteorder("=")), shape))
    return image.shape, image.dtype


class _Array:
    row_step, piece_nbytes = 1, 0

    def __init__(self, array: NDArray[Any], held_nbytes: int) -> None:
        self.shape, self.dtype, self.held_nbytes = array.shape, array.dtype, held_nbytes
        self._array = array

    def read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        return self._array[y0:y1, x0:x1]


class _Mapped:
    row_step, piece_nbytes, held_nbytes = 1, 0, 0

    def __init__(self, name: str, path: Path) -> None:
        self._path = path
        array = self._open()
        self.shape, self.dtype = _checked(name, array.shape, array.dtype)

    def _open(self) -> NDArray[Any]:
        try:
            return np.asarray(np.load(self._path, mmap_mode="r", allow_pickle=False))
        except FileNotFoundError as error:
            raise FileError(f"no such file: {str(self._path)!r}") from error
        except OSError as error:
            raise FileError(f"cannot read {str(self._path)!r}: {error.strerror or error}") from error
        except (ValueError, EOFError) as error:
            raise FileError(f"{str(self._path)!r} is not a readable npy file") from error

    def read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        window = self._open()[y0:y1, x0:x1]
        return np.array(window.reshape(*window.shape[:2], *self.shape[2:]), self.dtype, order="C")


class _Tiff:
    held_nbytes = 0

    def __init__(self, name: str, path: Path) -> None:
        try:
            import tifffile
        except ModuleNotFoundError as error:
            raise StereokitError(
                f"{name}: windows of TIFF need tifffile, which is not installed: pip install 'stereokit[large]'"
            ) from error
        self._path = path
        try:
            with tifffile.TiffFile(path) as file:
                self._page: Any = file.pages.first
                page = self._page
                layout = str(getattr(page.photometric, "name", page.photometric))
                plain = page.planarconfig == 1 or page.samplesperpixel == 1
                if not plain or layout == "PALETTE" or page.samplesperpixel not in (1, 3, 4) or page.imagedepth != 1:
                    raise FileError(
                        f"{str(path)!r} must be a grey or RGB TIFF with its channels side by side, got "
                        f"{page.samplesperpixel} channels, {layout}"
                    )
                if page.dtype is None:
                    raise FileError(f"{str(path)!r} holds pixels of no type that can be matched")
                tile = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
        except FileNotFoundError as error:
            raise FileError(f"no such file: {str(path)!r}") from error
        except OSError as error:
            raise FileError(f"cannot read {str(path)!r}: {error.strerror or error}") from error
        except tifffile.TiffFileError as error:
            raise FileError(f"{str(path)!r} is not a readable TIFF: {error}") from error
        color = (3,) if page.samplesperpixel > 1 else ()
        height, width = page.imagelength, page.imagewidth
        self.shape, self.dtype = _checked(name, (height, width, *color), page.dtype)
        self._tile = min(tile[0], height) if not page.is_tiled else tile[0], tile[1]
        self.row_step = self._tile[0]
        pixels = self._tile[0] * self._tile[1] * page.samplesperpixel
        self.piece_nbytes = 3 * pixels * self.dtype.itemsize  # as stored, decoded, and on its way to the window

    def read(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[Any]:
        out = np.zeros((y1 - y0, x1 - x0, *self.shape[2:]), self.dtype)
        page, (high, wide) = self._page, self._tile
        across = -(-self.shape[1] // wide)
        try:
            with self._path.open("rb") as file:
                for down in range(y0 // high, -(-y1 // high)):
                    for along in range(x0 // wide, -(-x1 // wide)):
                        index = down * across + along
                        file.seek(page.dataoffsets[index])
                        stored = file.read(page.databytecounts[index])
                        decoded = page.decode(stored, index, jpegtables=page.jpegtables)[0] if stored else None
                        if decoded is not None:  # None is a tile that was never written: zeros
                            self._place(decoded[0], down * high, along * wide, out, y0, x0)
        except (OSError, IndexError) as error:
            raise FileError(f"cannot read {str(self._path)!r}: {error}") from error
        except Exception as error:  # whatever a decoder raises for broken data, or for want of its package
            reason = " ".join(str(error).split()) or type(error).__name__
            raise FileError(f"{str(self._path)!r} cannot be decoded: {reason}") from error
        return out

    def _place(self, tile: NDArray[Any], top: int, start: int, out: NDArray[Any], y0: int, x0: int) -> None:
        """Copy what a tile, (h, w, samples) from row `top` and column `start`, has of the window `out`."""
        first_y, last_y = max(top, y0), min(top + tile.shape[0], y0 + out.shape[0])
        first_x, last_x = max(start, x0), min(start + tile.shape[1], x0 + out.shape[1])
        part = tile[first_y - top : last_y - top, first_x - start : last_x - start]
        part = part[:, :, 0] if out.ndim == 2 else part[:, :, :3]
        out[first_y - y0 : last_y - y0, first_x - x0 : last_x - x0] = part
