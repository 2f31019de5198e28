"""A queue of launches that runs on the CPU: `stereokit.cuda.kernel.Queue` for tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ptx.interpreter.harness import Buffer, Report, run

__all__ = ["EmulatedQueue"]


class EmulatedQueue:
    """A stand-in for a GPU; its arrays are `Buffer`, so that reads of what nobody wrote are found.

    Parameters
    ----------
    seed : int, optional
        Of the random schedule of the threads.

    Attributes
    ----------
    launches : list of (name, blocks, Report)
        What ran.
    arrays : dict of Buffer
        What is resident.
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
        held = self.array(name, flat.size, flat.dtype)
        held.values[:] = flat
        held.known[:] = 1
        return held

    def cached(self, name: str, key: Any, make: Callable[[], np.ndarray]) -> Buffer:
        """Return the array called `name`, made anew when the key changes."""
        if self._keys.get(name, self) != key:
            self.upload(name, make())
            self._keys[name] = key
        return self.arrays[name]

    def view(self, held: Buffer, dtype: Any) -> Buffer:
        """Return the same memory as another type."""
        return held.view(dtype)

    def launch(self, what: Any, blocks: int, *arguments: Any) -> None:
        """Run a kernel."""
        report = run(what, blocks, *arguments, seed=self.seed)
        self.launches.append((what.name, blocks, report))

    def copy(self, held: Buffer) -> Buffer:
        """Return a new array with the same content."""
        made = Buffer(held.size, held.dtype)
        made.values[:], made.known[:] = held.values, held.known
        return made

    def fetch(self, held: Buffer) -> np.ndarray:
        """Return a copy of an array."""
        return held.values.copy()
