"""A queue without a GPU: arrays of which only the size is known, and launches that are noted and not run.

It tells what a match would take on a device (`stereokit.cuda.pipeline.CudaPipeline.nbytes`) and what it would launch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = ["DryQueue", "SizedArray"]


class SizedArray:
    """An array of the device of which only the size is known.

    Attributes
    ----------
    size : int
        Elements.
    dtype : numpy dtype
    """

    def __init__(self, size: int, dtype: Any) -> None:
        self.size = size
        self.dtype = np.dtype(dtype)

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return self.size * int(self.dtype.itemsize)

    def __getitem__(self, part: slice) -> SizedArray:
        return SizedArray(len(range(*part.indices(self.size))), self.dtype)


class DryQueue:
    """A queue (`stereokit.cuda.kernel.Queue`) that computes nothing."""

    def __init__(self) -> None:
        self._arrays: dict[str, SizedArray] = {}

    @property
    def nbytes(self) -> int:
        """Bytes of all resident arrays."""
        return sum(array.nbytes for array in self._arrays.values())

    def array(self, name: str, size: int, dtype: Any) -> SizedArray:
        """Note a resident array."""
        self._arrays[name] = SizedArray(size, dtype)
        return self._arrays[name]

    def upload(self, name: str, values: np.ndarray[Any, Any]) -> SizedArray:
        """Note a resident array with the size of `values`."""
        return self.array(name, values.size, values.dtype)

    def cached(self, name: str, key: Any, make: Callable[[], np.ndarray[Any, Any]]) -> SizedArray:
        """Note a resident table."""
        return self.upload(name, make())

    def view(self, array: SizedArray, dtype: Any) -> SizedArray:
        """Return the same memory as another type."""
        return SizedArray(array.nbytes // np.dtype(dtype).itemsize, dtype)

    def launch(self, what: Any, blocks: int, *arguments: Any) -> None:
        """Run nothing."""

    def copy(self, array: SizedArray) -> SizedArray:
        """Note an array that is the caller's."""
        return SizedArray(array.size, array.dtype)

    def fetch(self, array: SizedArray) -> np.ndarray[Any, Any]:
        """Return zeros."""
        return np.zeros(array.size, array.dtype)
