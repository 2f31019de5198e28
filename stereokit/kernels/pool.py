"""Run kernels side by side on plain threads.

Kernels release the interpreter lock, so threads are enough; and unlike the thread layers of numba, these may be
used by any number of calling threads at once. What the tasks compute never depends on how many run together.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait

from stereokit.kernels.gate import meet, new_gate, open_for_good

__all__ = ["available_threads", "run", "run_stages", "spans"]

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

    With two threads the work is handed over once, and the two meet at a gate between stages.
    """
    count = min(threads, max(map(len, stages), default=0))
    if count > 2:
        # Members of a gate must all be running. More than two might be waiting in the pool's queue, behind members of
        # other gates that wait for members in the queue. One is never alone: the other is the caller.
        for stage in stages:
            _run_together([stage], min(count, len(stage)))
    else:
        _run_together(stages, count)


def _run_together(stages: Sequence[Sequence[Task]], count: int) -> None:
    if count <= 1:
        for stage in stages:
            for task in stage:
                task()
        return
    gate = new_gate()

    def work(k: int) -> None:
        try:
            for number, stage in enumerate(stages):
                if number > 0 and not meet(gate, count):
                    return
                for task in stage[k::count]:
                    task()
        except BaseException:
            open_for_good(gate)
            raise

    pool = _shared_executor()
    others: list[Future[None]] = []
    try:
        others += [pool.submit(work, k) for k in range(1, count)]
        work(0)
    except BaseException:
        open_for_good(gate)
        raise
    finally:
        _wait_for(others)
    for other in others:
        other.result()


def spans(length: int, parts: int) -> list[tuple[int, int]]:
    """Cut ``range(length)`` into at most `parts` runs of nearly equal size, none empty."""
    parts = max(1, min(parts, length))
    return [(length * k // parts, length * (k + 1) // parts) for k in range(parts)]
