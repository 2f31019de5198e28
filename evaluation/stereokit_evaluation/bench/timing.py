"""Interleaved timing: every contender once per round, so that a busy machine harms all alike.

Medians and quartiles are reported, not means: a few slow runs (another process, a page fault) then change nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from stereokit.errors import OptionError

__all__ = ["Spread", "ratio", "round_robin", "spread"]


@dataclass(frozen=True)
class Spread:
    """Summary statistics of repeated times.

    Attributes
    ----------
    median, q25, q75, least : float
        Median, quartiles (linear interpolation) and minimum, in the unit of the times.
    runs : int
        Their number.
    """

    median: float
    q25: float
    q75: float
    least: float
    runs: int


def spread(times: list[float]) -> Spread:
    """Return median, quartiles and minimum of `times`.

    Raises
    ------
    OptionError
        If there are none.
    """
    if not times:
        raise OptionError("times must hold at least one value, got none")
    q25, median, q75 = (float(q) for q in np.percentile(times, (25, 50, 75)))
    return Spread(median, q25, q75, float(min(times)), len(times))


def ratio(baseline: Spread | None, ours: Spread | None) -> float | None:
    """Return how many times faster `ours` is than `baseline`, by medians; None where one is missing or took no time."""
    if baseline is None or ours is None or ours.median <= 0:
        return None
    return baseline.median / ours.median


def round_robin(
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    times: dict[str, list[float]],
    *,
    max_rounds: Mapping[str, int] | None = None,
    clock: Callable[[], float] = time.perf_counter,
    step: Callable[[str], None] | None = None,
) -> None:
    """Time each of `calls` once per round, in order.

    Parameters
    ----------
    calls : mapping of str to callable
        The calls to time. Results are freed outside the timed part.
    rounds : int
        Number of rounds.
    times : dict of str to list of float
        Seconds are appended here, run by run, so that an interrupt leaves all measurements so far.
    max_rounds : mapping of str to int or None
        Names that take part in the first so many rounds only.
    clock : callable
        Returns seconds.
    step : callable or None
        Called with the name after each run, outside the timed part.
    """
    for number in range(rounds):
        for name, call in calls.items():
            if max_rounds is not None and number >= max_rounds.get(name, rounds):
                continue
            start = clock()
            result = call()
            end = clock()
            del result
            times.setdefault(name, []).append(end - start)
            if step is not None:
                step(name)
