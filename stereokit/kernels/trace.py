"""Spans of time, named where the work is done: ``with span("match", "sweep"): ...``.

Nobody listens by default, and a span costs next to nothing. `observed` hands the spans of the code in its ``with``
block to an observer; what other threads do at the same time is not seen, since a context variable carries it.

`tasks_by` hands the tasks themselves, which threads would share, to one who runs them in turn and takes their times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol

__all__ = ["GROUPS", "Observer", "Runner", "observed", "runner", "span", "tasks_by"]

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


class Runner(Protocol):
    """Runs tasks that threads would share, on the calling thread."""

    def side_by_side(self, tasks: Sequence[Callable[[], object]]) -> None:
        """Run tasks of which none needs another."""

    def in_line(self, lines: Sequence[Iterable[Callable[[], object]]], blocks: int, shared: bool) -> None:
        """Run lines of tasks: each task needs the one before in its line, block by block, and no other line.

        Threads may share a line where that is `shared`; else each line is one thread's.
        """


_runner: ContextVar[Runner | None] = ContextVar("stereokit.tasks", default=None)


def runner() -> Runner | None:
    """Return who runs the tasks of this thread instead of its team."""
    return _runner.get()


@contextmanager
def tasks_by(runner: Runner) -> Iterator[None]:
    """Hand the tasks of a ``with`` block, of this thread, to a runner."""
    token = _runner.set(runner)
    try:
        yield
    finally:
        _runner.reset(token)
