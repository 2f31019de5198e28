"""Run kernels side by side on plain threads.

Kernels release the interpreter lock, so threads are enough; and unlike the thread layers of numba, these may be
used by any number of calling threads at once. What the tasks compute never depends on how many run together.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait

__all__ = ["available_threads", "run", "spans"]

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


def _run_all(tasks: Sequence[Callable[[], object]]) -> None:
    for task in tasks:
        task()


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


def run(tasks: Sequence[Callable[[], object]], threads: int) -> None:
    """Run all `tasks`, at most `threads` at a time, and return when all have ended.

    The calling thread does its share. The first exception of any task is raised again. A task must not call
    `run` itself.
    """
    count = min(threads, len(tasks))
    if count <= 1:
        _run_all(tasks)
        return
    pool = _shared_executor()
    others = [pool.submit(_run_all, tasks[k::count]) for k in range(1, count)]
    try:
        _run_all(tasks[0::count])
    finally:
        _wait_for(others)
    for other in others:
        other.result()


def spans(length: int, parts: int) -> list[tuple[int, int]]:
    """Cut ``range(length)`` into at most `parts` runs of nearly equal size, none empty."""
    parts = max(1, min(parts, length))
    return [(length * k // parts, length * (k + 1) // parts) for k in range(parts)]
