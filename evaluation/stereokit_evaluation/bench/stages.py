"""The time of a call, stage by stage: an observer of the library's named spans.

Times are exclusive: a stage does not count the stages inside it. The work of other threads counts for the stage that
waits for them; with one thread, single kernels are visible.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit import matching
from stereokit.kernels.trace import GROUPS, observed

__all__ = ["GROUPS", "OTHER", "TOTAL", "StageTimer", "allocated_bytes", "stage_times"]

OTHER, TOTAL = "other", "total"


class StageTimer:
    """An observer (`stereokit.kernels.trace.Observer`) that adds up the seconds of each stage; stages nest.

    Parameters
    ----------
    clock : callable
        Returns seconds.
    groups : bool
        Add stages up by group instead of by name.

    Attributes
    ----------
    seconds : dict of str to float
        In the order in which the stages first began.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter, *, groups: bool = False) -> None:
        self.clock = clock
        self.groups = groups
        self.seconds: dict[str, float] = {}
        self._stack: list[list[Any]] = []  # of each open stage: name, start, seconds of the stages inside it

    def enter(self, group: str, name: str) -> None:
        """Begin a stage."""
        key = group if self.groups else name
        self.seconds.setdefault(key, 0.0)
        self._stack.append([key, self.clock(), 0.0])

    def leave(self) -> None:
        """End the stage that began last."""
        key, start, inner = self._stack.pop()
        took = self.clock() - start
        self.seconds[key] += took - inner
        if self._stack:
            self._stack[-1][2] += took


def stage_times(
    method: str,
    levels: int,
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    rounds: int,
    *,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Return the median milliseconds of each stage of a method with default options on one thread.

    Parameters
    ----------
    method : str
        A method's name.
    levels : int
        Disparities 0 to `levels` - 1.
    left, right : (H, W) uint8
        Images.
    rounds : int
        Calls, 1 or more, after one that compiles.
    clock : callable
        Returns seconds.

    Returns
    -------
    dict of str to float
        Stages in the order in which they first begin, then `OTHER`, the time outside of all stages, and `TOTAL`.
    """
    matcher = matching.Matcher(method, max_disparity=levels, threads=1, device="cpu")
    matcher(left, right)  # compiles
    rows: list[dict[str, float]] = []
    for _ in range(rounds):
        timer = StageTimer(clock)
        with observed(timer):
            start = clock()
            matcher(left, right)
            total = clock() - start
        rows.append({**timer.seconds, OTHER: total - sum(timer.seconds.values()), TOTAL: total})
    names = [name for name in rows[0] if name not in (OTHER, TOTAL)]
    return {name: 1e3 * float(np.median([row.get(name, 0.0) for row in rows])) for name in (*names, OTHER, TOTAL)}


def allocated_bytes(method: str, levels: int, left: NDArray[np.uint8], right: NDArray[np.uint8], threads: int) -> int:
    """Return the peak of the bytes that a call allocates, without the maps that it returns.

    It is measured on the third call, when all buffers exist. Memory of Python and numpy counts, OpenCV's own does not.
    """
    matcher = matching.Matcher(method, max_disparity=levels, threads=threads, device="cpu")
    for _ in range(2):
        matcher(left, right)
    tracing = tracemalloc.is_tracing()
    if not tracing:
        tracemalloc.start()
    try:
        tracemalloc.reset_peak()
        before, _ = tracemalloc.get_traced_memory()
        result = matcher(left, right)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        if not tracing:
            tracemalloc.stop()
    return peak - before - result.disparity.nbytes - result.valid.nbytes
