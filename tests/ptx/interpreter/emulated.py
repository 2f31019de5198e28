"""A queue of launches that runs on the CPU: `stereokit.cuda.kernel.Queue` for tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ptx.interpreter.harness import Buffer, Report, run

__all__ = ["EmulatedQueue"]


class EmulatedQueue:
    """A stand-in for a GPU; its arrays are `Buffer`, so that reads of unwritten memory are errors.

    Parameters
    ----------
    seed : int, optional
        Of the random schedule of the threads.

    Attributes
    ----------
    launches : list of (name, blocks, Report)
        Launches so far.
    arrays : dict of Buffer
        Resident arrays.
    """

    def __init__(self, seed: int | None = None) -> None:
        self.seed = seed
        self.launches: list[tuple[str, int, Report]] = []
        self.arrays: dict[str, Buffer] = {}
        self._keys: dict[str, Any] = {}

    def array(self, name: str, size: int, dtype: Any) -> Buffer:
        """Return the array called `name`, of garbage."""
        self.arrays[name] = Buffer(size, dtype)
        return self.arrays[name]

    def upload(self, name: str, values: np.ndarray) -> Buffer:
        """Return the array called `name` with a copy of `values`."""
        flat = np.ascontiguousarray(values).reshape(-1)
        array = self.array(name, flat.size, flat.dtype)
        array.values[:] = flat
        array.known[:] = 1
        return array

    def cached(self, name: str, key: Any, make: Callable[[], np.ndarray]) -> Buffer:
        """Return the array called `name`, which is new when the key changes."""
        if self._keys.get(name, self) != key:
            self.upload(name, make())
            self._keys[name] = key
        return self.arrays[name]

    def view(self, array: Buffer, dtype: Any) -> Buffer:
        """Return the same memory as another type."""
        return array.view(dtype)

    def launch(self, what: Any, blocks: int, *arguments: Any) -> None:
        """Run a kernel."""
        report = run(what, blocks, *arguments, seed=self.seed)
        self.launches.append((what.name, blocks, report))

    def copy(self, array: Buffer) -> Buffer:
        """Return a new array with the same content."""
        out = Buffer(array.size, array.dtype)
        out.values[:], out.known[:] = array.values, array.known
        return out

    def fetch(self, array: Buffer) -> np.ndarray:
        """Return a copy of an array."""
        return array.values.copy()
