"""Run kernels side by side on plain threads.

Kernels release the interpreter lock, so threads are enough; and unlike the thread layers of numba, these may be
used by any number of calling threads at once. What the tasks compute never depends on how many run together.

Ctrl-C raises KeyboardInterrupt between any two steps of the calling thread: also while it hands work over, and within
a ``finally``. So nothing here depends on a later step of the caller:

- Work belongs to who claims it, in one atomic operation (``pop``). The caller does what nobody has claimed, and waits
  only for work that another thread has begun, which ends by itself.
- A helper that hears nothing for a few milliseconds leaves. One whose caller is gone is never lost.
- What the caller touches are lists, queues and locks of the interpreter itself, whose operations are never cut in two.
  Those of `threading` and `concurrent.futures` that are written in Python an interrupt can leave locked for good; so
  workers are no `threading.Thread` either. They do not keep the process from ending.
"""

from __future__ import annotations

import os
import threading
import time
from _thread import start_new_thread
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

import numpy as np

from stereokit.kernels.spin import LOOKS_AWAKE, spin_while
from stereokit.kernels.trace import runner

__all__ = ["Job", "Team", "Workers", "available_threads", "run", "run_stages", "spans", "team"]

T = TypeVar("T")
Task = Callable[[], object]

_IDLE_SECONDS = 60.0
"""Time after which a worker without work ends."""
_LOOKS_OF_TWO = 10_000
"""Looks without sleep, some milliseconds, of one who waits for the only other member of a team. More members together
look no longer, for the processor's time."""
_NAP_SECONDS = 50e-6
"""Sleep between two looks at a helper that is long at its task; signals get in meanwhile."""


def available_threads() -> int:
    """Return the number of processors that this process may use."""
    try:
        return max(1, len(os.sched_getaffinity(0)))
    except AttributeError:  # not on Linux
        return max(1, os.cpu_count() or 1)


class Workers:
    """Threads that call what they are handed; each is started when it is needed, and ends when it is not.

    Parameters
    ----------
    limit : int
        Threads at the same time; a few more if several threads hand work over at the same time.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._jobs: SimpleQueue[Task | None] = SimpleQueue()
        self._present: set[int] = set()  # of each worker
        self._idle: deque[None] = deque()  # an element for each worker that waits

    def submit(self, job: Task) -> None:
        """Have a worker call `job`, which must not raise.

        Nothing is promised: where no thread can be had, nobody calls it.
        """
        try:
            self._idle.pop()
        except IndexError:
            if len(self._present) < self.limit:
                try:
                    self._present.add(start_new_thread(self._work, (job,)))
                    return
                except RuntimeError:  # the system has no more threads for us
                    pass
            if not self._present:
                return
        self._jobs.put(job)

    def _work(self, job: Task | None) -> None:
        self._present.add(threading.get_ident())  # again: its caller may have been interrupted before that
        try:
            while job is not None:
                job()
                job = self._next()
        finally:
            self._present.discard(threading.get_ident())

    def _next(self) -> Task | None:
        """Return the next job, or None if the worker is to end."""
        with suppress(Empty):
            return self._jobs.get_nowait()
        self._idle.append(None)
        with suppress(Empty):
            return self._jobs.get(timeout=_IDLE_SECONDS)
        with suppress(IndexError):
            self._idle.pop()
        return None

    def close(self) -> None:
        """Let workers end as soon as they have nothing to do."""
        for _ in range(len(self._present)):
            self._jobs.put(None)


class Job(Generic[T]):
    """A call that a worker makes, unless its owner makes it first.

    Parameters
    ----------
    function, *arguments
        Function and its arguments.
    """

    def __init__(self, function: Callable[..., T], *arguments: object) -> None:
        self._unclaimed: list[Callable[[], T]] = [partial(function, *arguments)]
        self._running = threading.Lock()  # a worker's, from before it claims until it has ended
        self._values: list[T] = []
        self._error: BaseException | None = None

    def __call__(self) -> None:
        """Make the call if nobody has claimed it: a worker's part."""
        with self._running:
            try:
                call = self._unclaimed.pop()
            except IndexError:
                return
            try:
                self._values.append(call())
            except BaseException as error:
                self._error = error

    def result(self) -> T:
        """Return the call's value, or raise its error; make the call here if no worker has begun."""
        try:
            call = self._unclaimed.pop()
        except IndexError:
            pass
        else:
            return call()
        with self._running:
            pass
        if self._error is not None:
            raise self._error
        return self._values[0]

    def withdraw(self) -> None:
        """See that no worker makes the call any more; wait for one that has begun."""
        self._unclaimed.clear()
        with self._running:
            pass


_workers = Workers(available_threads())


def _replace_workers() -> None:
    global _workers
    _workers = Workers(available_threads())


if hasattr(os, "register_at_fork"):  # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=_replace_workers)


class _Stage:
    """Tasks that may run at the same time; each is done by who claims it first."""

    def __init__(self, tasks: Sequence[Task] = ()) -> None:
        self.size = len(tasks)
        self.unclaimed = dict(enumerate(tasks))
        self.error: BaseException | None = None

    def work(self, member: int, members: int) -> None:
        """Do tasks until all are claimed, those first that no other member begins with."""
        first = member * self.size // max(members, 1)
        for k in range(first, first + self.size):
            task = self.unclaimed.pop(k % self.size, None)
            if task is not None:
                task()


_ABSENT, _CALLED, _IDLE, _BUSY = range(4)  # what the word of a helper says
_CLOSED = -1  # instead of the number of stages so far


class Team:
    """The calling thread and its helpers, which come when they are called and wait a moment for the next stage.

    Parameters
    ----------
    threads : int
        The caller and its helpers.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        # The first word is the number of stages so far, the others say what each helper does. Each has one writer at
        # a time: the caller that of an absent helper, the helper its own.
        self._words = np.zeros(min(threads, 1 + _workers.limit), np.int64)
        self._awake = max(LOOKS_AWAKE, _LOOKS_OF_TWO // max(1, len(self._words) - 1) ** 2)
        self._stage = _Stage()

    def run(self, stages: Sequence[Sequence[Task]]) -> None:
        """Run the tasks of each stage when all of the stage before have ended."""
        for tasks in stages:
            self._run(_Stage(tasks))

    def summon(self, members: int | None = None) -> None:
        """Call so many members that are not here, or all: to wake a thread takes longer than many a stage does."""
        if runner() is not None:
            return
        words = self._words
        for k in range(1, len(words) if members is None else members):
            if words[k] == _ABSENT:
                words[k] = _CALLED
                _workers.submit(partial(self._help, k))

    def _run(self, stage: _Stage) -> None:
        words = self._words
        members = min(stage.size, len(words))
        try:
            self._stage = stage
            words[0] += 1
            self.summon(members)
            stage.work(0, members)
        finally:
            stage.unclaimed.clear()  # after an error nobody needs the rest
            self._wait()
        if stage.error is not None:
            raise stage.error

    def _wait(self) -> None:
        """Wait for helpers that are at a task; one that comes later finds none."""
        for k in range(1, len(self._words)):
            while not spin_while(self._words, k, _BUSY, self._awake):
                time.sleep(_NAP_SECONDS)

    def _help(self, k: int) -> None:
        """Take part as member `k` until the team is closed, or nothing has come for a moment."""
        words = self._words
        seen = 0
        try:
            while spin_while(words, 0, seen, self._awake):
                seen = int(words[0])
                if seen == _CLOSED:
                    break
                words[k] = _BUSY
                stage = self._stage
                try:
                    stage.work(k, min(stage.size, len(words)))
                except BaseException as error:
                    stage.error = error
                    stage.unclaimed.clear()
                words[k] = _IDLE
        finally:
            words[k] = _ABSENT

    def close(self) -> None:
        """Let the helpers go now."""
        self._words[0] = _CLOSED
        self._stage = _Stage()


_local = threading.local()  # .team: the calling thread's


@contextmanager
def team(threads: int) -> Iterator[Team]:
    """Keep helpers at hand for all `run` and `run_stages` with so many threads in a ``with`` block."""
    present: Team | None = getattr(_local, "team", None)
    if present is not None and present.threads == threads:
        yield present
        return
    own = Team(threads)
    try:
        _local.team = own
        yield own
    finally:
        _local.team = present
        own.close()


def run(tasks: Sequence[Task], threads: int) -> None:
    """Run all `tasks`, at most `threads` at a time, and return when all have ended.

    The calling thread does its share. The first exception of any task is raised again. A task must not call
    `run` itself.
    """
    run_stages([tasks], threads)


def run_stages(stages: Sequence[Sequence[Task]], threads: int) -> None:
    """Run the tasks of each stage, at most `threads` at a time, when all of the stage before have ended."""
    stages = [stage for stage in stages if len(stage) > 0]
    own = runner()
    if own is not None:
        for stage in stages:
            own.side_by_side(stage)
        return
    if min(threads, max(map(len, stages), default=0)) < 2:
        for stage in stages:
            for task in stage:
                task()
        return
    with team(threads) as members:
        members.run(stages)


def spans(length: int, parts: int) -> list[tuple[int, int]]:
    """Cut ``range(length)`` into at most `parts` runs of nearly equal size, none empty."""
    parts = max(1, min(parts, length))
    return [(length * k // parts, length * (k + 1) // parts) for k in range(parts)]
