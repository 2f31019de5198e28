"""Where the time of a call goes, stage by stage, without a line of it in the core.

While it runs, the functions that `stereokit.matching` calls (input checks, smoothing, post-processing), the cost's
``prepare``, the aggregation's ``sweep`` and the kernels that the sweep calls are replaced by timed stand-ins. They
are found by what they are, not by name: a function that the core renames shows under its new name, and what is not
found stays in "other". Times are exclusive: a stage does not count the stages inside it.

With the kernels that the sweep calls, the calls must run on one thread; `watched` by groups leaves those out, and
is right for any number of threads. Nothing else in the process may match at the same time.
"""

from __future__ import annotations

import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from types import FunctionType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit import matching

__all__ = ["GROUPS", "OTHER", "TOTAL", "Watch", "allocated_bytes", "stage_times", "watched"]

OTHER, TOTAL = "other", "total"
GROUPS = ("prepare", "match", "clean", "refine")
"""Groups of stages in their order: checks, resizing and what a cost prepares; the sweep, which makes costs, adds them
up and selects in one pass; the post-processing; and the refiner."""

_STAGES = {"stereokit.images.gray": "prepare", "stereokit.postprocess": "clean", "stereokit.selection": "clean"}


class Watch:
    """Seconds by stage of one call; stages nest."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.seconds: dict[str, float] = {}
        self._inner: list[float] = []  # time of the stages inside each one that is under way

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return `function` with its calls timed under `name`."""

        @wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self.seconds.setdefault(name, 0.0)  # here, so that stages stand in the order in which they begin
            self._inner.append(0.0)
            begun = self.clock()
            try:
                return function(*args, **kwargs)
            finally:
                took = self.clock() - begun
                self.seconds[name] += took - self._inner.pop()
                if self._inner:
                    self._inner[-1] += took

        return timed


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
    matcher(left, right)  # compiled before names are replaced: a kernel that is not must not see the stand-ins
    rows: list[dict[str, float]] = []
    for _ in range(rounds):
        watch = Watch(clock)
        with watched(matcher, watch):
            begun = clock()
            matcher(left, right)
            total = clock() - begun
        rows.append({**watch.seconds, OTHER: total - sum(watch.seconds.values()), TOTAL: total})
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


@contextmanager
def watched(matcher: Any, watch: Watch, *, groups: bool = False) -> Iterator[None]:
    """Replace the stages of `matcher` by timed ones, and put them back.

    Parameters
    ----------
    matcher : Matcher
        Its calls are watched inside the context; what they allocate and return is the same.
    watch : Watch
        Collects the seconds.
    groups : bool
        Add the stages up in `GROUPS`, and leave the kernels that other threads may run alone.
    """
    replaced: list[tuple[Any, str, Any]] = []
    try:
        for owner, attribute, name, group in _targets(matcher):
            if groups and group is None:
                continue
            original = vars(owner)[attribute]
            setattr(owner, attribute, watch.wrap(group if groups and group else name, original))
            replaced.append((owner, attribute, original))
        yield
    finally:
        for owner, attribute, original in reversed(replaced):
            setattr(owner, attribute, original)


def _targets(matcher: Any) -> list[tuple[Any, str, str, str | None]]:
    """Return where each stage's name is looked up: owner, attribute, the name to report and the stage's group."""
    found: list[tuple[Any, str, str, str | None]] = []
    homes: dict[str, Any] = {}
    for attribute, value in vars(matching).items():
        if isinstance(value, FunctionType) and value.__module__.startswith(tuple(_STAGES)):
            group = next(group for module, group in _STAGES.items() if value.__module__.startswith(module))
            found.append((matching, attribute, _words(attribute), group))
            homes[value.__module__] = sys.modules[value.__module__]
    found += [(home, part, _words(part), None) for home in homes.values() for part in _kernels(home)]
    for stage, attribute, name, group in (
        (getattr(matcher, "cost", None), "prepare", "prepare cost", "prepare"),
        (getattr(matcher, "aggregation", None), "sweep", "sweep, around its kernels", "match"),
    ):
        if isinstance(vars(type(stage)).get(attribute), FunctionType):
            found.append((type(stage), attribute, name, group))
    if callable(vars(matcher).get("_refine")):
        found.append((matcher, "_refine", "refine", "refine"))
    home = sys.modules[type(getattr(matcher, "aggregation", None)).__module__]
    found += [(home, part, f"sweep: {_words(part)}", None) for part in _kernels(home)]
    return found


def _kernels(home: Any) -> list[str]:
    """Return the names of a module's kernels that Python has called, its own and those that it imports."""
    return [
        attribute
        for attribute, value in vars(home).items()
        if getattr(value, "signatures", None) and hasattr(value, "py_func")
    ]


def _words(name: str) -> str:
    return name.strip("_").replace("_", " ")
