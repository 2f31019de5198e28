"""Buffers that are kept from one call to the next.

A matcher owns a `Pool`. Each call takes a `Workspace` out, and puts it back when it ends, so that calls from
several threads never share a buffer and a steady stream of equal frames allocates nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from stereokit.kernels.simd import aligned

__all__ = ["Pool", "Workspace"]

T = TypeVar("T")


class Workspace:
    """Named arrays, allocated when first asked for and reused while shape and type stay the same."""

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray[Any, Any]] = {}
        self._made: dict[str, tuple[Hashable, Any]] = {}

    def array(self, name: str, shape: int | tuple[int, ...], dtype: DTypeLike) -> np.ndarray[Any, Any]:
        """Return the array called `name`, C-contiguous and 64-byte aligned; its content is whatever it was."""
        shape = (shape,) if isinstance(shape, int) else shape
        held = self._arrays.get(name)
        if held is None or held.shape != shape or held.dtype != np.dtype(dtype):
            self._arrays.pop(name, None)  # free the old one before the new one is made
            held = self._arrays[name] = aligned(shape, dtype)
        return held

    def once(self, name: str, key: Hashable, make: Callable[[], T]) -> T:
        """Return what `make` returned when `name` was last asked for, if that was with the same `key`."""
        held = self._made.get(name)
        if held is None or held[0] != key:
            held = self._made[name] = key, make()
        made: T = held[1]
        return made

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return sum(a.nbytes for a in self._arrays.values())


class Pool:
    """Workspaces of one matcher: as many as there were calls at the same time."""

    def __init__(self) -> None:
        self._free: deque[Workspace] = deque()  # its pop and append need no lock, which a fork could leave held

    @contextmanager
    def take(self) -> Iterator[Workspace]:
        """Lend a workspace for the length of a ``with`` block."""
        try:
            workspace = self._free.pop()
        except IndexError:
            workspace = Workspace()
        try:
            yield workspace
        finally:
            self._free.append(workspace)
