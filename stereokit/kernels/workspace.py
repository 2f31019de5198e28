"""Buffers that live from one call to the next.

A matcher owns a `Pool`. Each call takes a `Workspace` out, and puts it back when it ends well, so that calls from
several threads never share a buffer and a steady stream of equal frames allocates nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from stereokit.kernels.simd import aligned

__all__ = ["Pool", "Workspace"]

T = TypeVar("T")

_MOST_FREE = 4
"""Free objects of a pool at the same time; more are dropped."""
_LOANS_UNUSED = 8
"""Loans after which a pool drops an object that none of them needed."""


class Workspace:
    """Named arrays, allocated when first asked for and reused while shape and type stay the same."""

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray[Any, Any]] = {}
        self._cached: dict[str, tuple[Hashable, Any]] = {}
        self._parts: dict[str, Workspace] = {}

    def array(self, name: str, shape: int | tuple[int, ...], dtype: DTypeLike) -> np.ndarray[Any, Any]:
        """Return the array called `name`, C-contiguous and 64-byte aligned; its content is whatever it was."""
        shape = (shape,) if isinstance(shape, int) else shape
        array = self._arrays.get(name)
        if array is None or array.shape != shape or array.dtype != np.dtype(dtype):
            del array  # free the old one before the new one is made
            self._arrays.pop(name, None)
            array = self._arrays[name] = aligned(shape, dtype)
        return array

    def cached(self, name: str, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value called `name`; `make` makes it when it is new, or its `key` has changed."""
        entry = self._cached.get(name)
        if entry is None or entry[0] != key:
            entry = self._cached[name] = key, make()
        value: T = entry[1]
        return value

    def part(self, name: str) -> Workspace:
        """Return the workspace called `name` within this one, with names of its own."""
        return self._parts.setdefault(name, Workspace())

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(a.nbytes for a in self._arrays.values()) + sum(part.nbytes for part in self._parts.values())


class Pool(Generic[T]):
    """Objects that calls borrow, new ones when none is free: workspaces, queues of a GPU, requests of a network.

    Parameters
    ----------
    make : callable
        Makes one.
    """

    def __init__(self, make: Callable[[], T]) -> None:
        self._make = make
        # Pairs of one and the number of loans when it came back, the latest last. The operations of a deque need no
        # lock, which a fork could leave locked.
        self._free: deque[tuple[T, int]] = deque()
        self._loans = 0

    @contextmanager
    def take(self) -> Iterator[T]:
        """Lend one for the length of a ``with`` block.

        An object is never lent again after a block that raises: a thread that was not waited for may still write to
        it.
        """
        try:
            one, _ = self._free.pop()
        except IndexError:
            one = self._make()
        self._loans += 1
        yield one
        self._free.append((one, self._loans))
        self._trim()

    def _trim(self) -> None:
        """Drop the leftovers of a burst of calls: all but a few objects, and those that no call has needed lately."""
        with suppress(IndexError):  # others may take meanwhile
            while len(self._free) > _MOST_FREE or self._loans - self._free[0][1] > _LOANS_UNUSED:
                self._free.popleft()

    @property
    def free(self) -> list[T]:
        """Objects that nobody has borrowed."""
        return [one for one, _ in self._free]
