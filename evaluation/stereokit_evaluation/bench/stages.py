"""Where the time of a call goes, stage by stage: an observer of the spans that the library names.

Times are exclusive: a stage does not count the stages inside it. What other threads do within a stage counts as that
stage's, since the thread that called waits for it; single kernels show when a call has one thread.
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
        self._open: list[list[Any]] = []  # of each stage that is under way: name, start, seconds of stages inside it

    def enter(self, group: str, name: str) -> None:
        """Begin a stage."""
        key = group if self.groups else name
        self.seconds.setdefault(key, 0.0)
        self._open.append([key, self.clock(), 0.0])

    def leave(self) -> None:
        """End the stage that began last."""
        key, start, inner = self._open.pop()
        took = self.clock() - start
        self.seconds[key] += took - inner
        if self._open:
            self._open[-1][2] += took


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
        Stages in the order in which they first begin, then `OTHER`, what no stage accounts for, and `TOTAL`.
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
    """Return the most bytes that a call holds above what it held before and the maps that it returns.

    Of the third call: by then all buffers are there. Python and numpy count, what OpenCV takes inside does not.
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
