"""Run kernels side by side on plain threads.

Kernels release the interpreter lock, so threads are enough; and unlike the thread layers of numba, these may be
used by any number of calling threads at once. What the tasks compute never depends on how many run together.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager

from stereokit.kernels.barrier import meet, new_gate, open_for_good

__all__ = ["available_threads", "crew", "run", "run_stages", "spans"]

_lock = threading.Lock()
_executor: ThreadPoolExecutor | None = None


def available_threads() -> int:
    """Return the number of processors that this process may use."""
    try:
        return max(1, len(os.sched_getaffinity(0)))
    except AttributeError:  # not on Linux
        return max(1, os.cpu_count() or 1)


def _shared_executor() -> ThreadPoolExecutor:
    global _executor
    with _lock:
        if _executor is None:
            _executor = ThreadPoolExecutor(available_threads(), thread_name_prefix="stereokit")
        return _executor


def _forget_executor() -> None:
    global _executor, _lock
    _executor = None
    _lock = threading.Lock()  # the old one may be held by a thread that the child does not have


if hasattr(os, "register_at_fork"):  # a forked child has no worker threads: it must start its own
    os.register_at_fork(after_in_child=_forget_executor)


def _wait_for(others: list[Future[None]]) -> None:
    """Wait until all have ended, however often the user interrupts: until then they write to borrowed buffers."""
    interrupted: KeyboardInterrupt | None = None
    while True:
        try:
            wait(others)
            break
        except KeyboardInterrupt as error:
            interrupted = error
    if interrupted is not None:
        raise interrupted


Task = Callable[[], object]


def run(tasks: Sequence[Task], threads: int) -> None:
    """Run all `tasks`, at most `threads` at a time, and return when all have ended.

    The calling thread does its share. The first exception of any task is raised again. A task must not call
    `run` itself.
    """
    run_stages([tasks], threads)


def run_stages(stages: Sequence[Sequence[Task]], threads: int) -> None:
    """Run the tasks of each stage, at most `threads` at a time, when all of the stage before have ended.

    With two threads the work is handed over once, or not at all within `crew`, and the two meet at a gate between
    stages.
    """
    stages = [stage for stage in stages if len(stage) > 0]
    count = min(threads, max(map(len, stages), default=0))
    if count == 2:
        held: _Crew | None = getattr(_local, "crew", None)
        if held is not None:
            held.run(stages)
        else:
            with crew(2):
                _local.crew.run(stages)
        return
    # Those who meet at a gate must all be running. More than two might wait in the pool's queue, behind members of
    # other gates that wait for members in the queue; a helper that is alone waits for nobody but its caller.
    for stage in stages:
        _run_together(stage, min(count, len(stage)))


def _run_together(tasks: Sequence[Task], count: int) -> None:
    def work(k: int) -> None:
        for task in tasks[k::count]:
            task()

    pool = _shared_executor() if count > 1 else None
    others = [] if pool is None else [pool.submit(work, k) for k in range(1, count)]
    try:
        work(0)
    finally:
        _wait_for(others)
    for other in others:
        other.result()


_local = threading.local()  # .crew: the helper that the thread has borrowed


class _Crew:
    """The calling thread and one helper, which waits at a gate for the next stages."""

    def __init__(self) -> None:
        self.gate = new_gate()
        self.stages: Sequence[Sequence[Task]] = ()
        self.helper = _shared_executor().submit(self._help)

    def _help(self) -> None:
        try:
            while meet(self.gate, 2) and self.stages and self._work(1):
                pass
        except BaseException:
            open_for_good(self.gate)
            raise

    def _work(self, k: int) -> bool:
        """Do the `k`-th member's share; return False if the other one failed."""
        for stage in self.stages:
            for task in stage[k::2]:
                task()
            if not meet(self.gate, 2):
                return False
        return True

    def run(self, stages: Sequence[Sequence[Task]]) -> None:
        self.stages = stages
        if not (meet(self.gate, 2) and self._work(0)):
            self.helper.result()


@contextmanager
def crew(threads: int) -> Iterator[None]:
    """Keep one helper at hand for all `run` and `run_stages` with two threads in a ``with`` block.

    It uses its processor even while it waits: the block must not do anything else that takes long.
    """
    if threads != 2 or getattr(_local, "crew", None) is not None:
        yield
        return
    held = _Crew()
    _local.crew = held
    try:
        yield
    except BaseException:
        open_for_good(held.gate)
        _wait_for([held.helper])  # it may be in the midst of a task
        raise
    finally:
        _local.crew = None
        open_for_good(held.gate)


def spans(length: int, parts: int) -> list[tuple[int, int]]:
    """Cut ``range(length)`` into at most `parts` runs of nearly equal size, none empty."""
    parts = max(1, min(parts, length))
    return [(length * k // parts, length * (k + 1) // parts) for k in range(parts)]
