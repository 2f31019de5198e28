"""Spans of time, named where the work is done: ``with span("match", "sweep"): ...``.

Nobody listens by default, and a span costs next to nothing. `observed` hands the spans of the code in its ``with``
block to an observer; what other threads do at the same time is not seen, since a context variable carries it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol

__all__ = ["GROUPS", "Observer", "observed", "span"]

GROUPS = ("prepare", "match", "clean", "refine")
"""Groups of stages in their order: checks, resizing and what a cost prepares; the sweep, which makes costs, adds them
up and selects in one pass; the post-processing; and the refiner."""


class Observer(Protocol):
    """Told of every span."""

    def enter(self, group: str, name: str) -> None:
        """Begin a span; spans nest."""

    def leave(self) -> None:
        """End the span that began last."""


_observer: ContextVar[Observer | None] = ContextVar("stereokit.trace", default=None)


class span:
    """A stretch of work that an observer may time.

    Parameters
    ----------
    group : str
        One of `GROUPS`.
    name : str
        Name of the work.
    """

    __slots__ = ("_group", "_name", "_observer")

    def __init__(self, group: str, name: str) -> None:
        self._group, self._name = group, name

    def __enter__(self) -> None:
        self._observer = _observer.get()
        if self._observer is not None:
            self._observer.enter(self._group, self._name)

    def __exit__(self, *_: object) -> None:
        if self._observer is not None:
            self._observer.leave()


@contextmanager
def observed(observer: Observer) -> Iterator[None]:
    """Hand the spans of a ``with`` block, of this thread, to an observer."""
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)
