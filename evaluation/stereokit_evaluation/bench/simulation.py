"""How long a match would take on more cores than there are: a simulation of its tasks, whose times are measured.

One thread runs the tasks that so many threads would share, one after the other, and notes how long each takes, and
what happens between them. Then threads are simulated that claim tasks in their order as soon as they are free. Of
rows that follow one another a row is taken to lean on the one before from its first column on, which is more than it
does. What cores take from one another, caches, memory and clock rate, is left out: a simulated time is a lower bound
on what memory allows, and the traffic that is printed beside it tells how near that is.
"""

from __future__ import annotations

import heapq
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from stereokit import matching
from stereokit.kernels.threads import run
from stereokit.kernels.trace import tasks_by
from stereokit_evaluation.bench.table import new_table

__all__ = ["Lines", "Simulated", "Tasks", "TimedTasks", "makespan", "print_simulated", "simulate"]

_HAND_OVERS = 200
"""Empty stages, of whose times the first quartile is that of a hand-over."""


@dataclass(frozen=True)
class Tasks:
    """Tasks of which none needs another.

    Attributes
    ----------
    seconds : tuple of float
        Time of each, in the order in which they are claimed.
    """

    seconds: tuple[float, ...]

    def span(self, cores: int) -> float:
        """Return the seconds until all have ended."""
        free = [0.0] * min(cores, len(self.seconds))
        for seconds in self.seconds:
            heapq.heapreplace(free, free[0] + seconds)
        return max(free)


@dataclass(frozen=True)
class Lines:
    """Lines of tasks, each of which needs the one before in its line, block by block.

    Attributes
    ----------
    seconds : tuple of tuples of float
        Time of each task of each line.
    blocks : int
        Into how many a task is cut.
    shared : bool
        Whether cores may share a line.
    """

    seconds: tuple[tuple[float, ...], ...]
    blocks: int
    shared: bool

    def span(self, cores: int) -> float:
        """Return the seconds until all have ended: cores begin with the lines in turn, and then help in others."""
        if not self.shared:
            return Tasks(tuple(sum(line) for line in self.seconds)).span(cores)
        claimed = [0] * len(self.seconds)
        done = [np.zeros(self.blocks) for _ in self.seconds]  # when each block of the task claimed last will be done
        free = [(0.0, k) for k in range(cores)]
        heapq.heapify(free)
        end = 0.0
        while free:
            now, core = heapq.heappop(free)
            order = [(core + n) % len(self.seconds) for n in range(len(self.seconds))]
            line = next((n for n in order if claimed[n] < len(self.seconds[n])), None)
            if line is None:
                continue
            block = self.seconds[line][claimed[line]] / self.blocks
            claimed[line] += 1
            for k in range(self.blocks):
                now = max(now, done[line][k]) + block
                done[line][k] = now
            end = max(end, now)
            heapq.heappush(free, (now, core))
        return end


class TimedTasks:
    """A runner (`stereokit.kernels.trace.Runner`) that runs tasks one after the other and takes their times.

    Attributes
    ----------
    stages : list of Tasks or Lines
    seconds : float
        Of all tasks together.
    own_seconds : float
        That the simulation took.
    """

    def __init__(self, clock: Callable[[], float] = time.thread_time) -> None:
        self.clock = clock
        self.stages: list[Tasks | Lines] = []
        self.seconds = 0.0
        self.own_seconds = 0.0

    def _timed(self, task: Callable[[], object]) -> float:
        before = self.clock()
        task()
        took = self.clock() - before
        self.seconds += took
        return took

    def side_by_side(self, tasks: Sequence[Callable[[], object]]) -> None:
        """Run tasks of which none needs another."""
        self.stages.append(Tasks(tuple(map(self._timed, tasks))))

    def in_line(self, lines: Sequence[Iterable[Callable[[], object]]], blocks: int, shared: bool) -> None:
        """Run lines of tasks; to hand them out one by one is the simulation's own work, which does not count."""
        before, tasks_before = self.clock(), self.seconds
        self.stages.append(Lines(tuple(tuple(map(self._timed, line)) for line in lines), blocks, shared))
        self.own_seconds += self.clock() - before - (self.seconds - tasks_before)


@dataclass(frozen=True)
class Simulated:
    """A match on several cores.

    Attributes
    ----------
    cores : int
    one_ms : float
        Measured on one thread, with the tasks of one; CPU time.
    cores_ms : float
        Simulated.
    path_ms : float
        The critical path of the same tasks: with as many cores as could be used.
    serial_ms : float
        Of that what happens between the tasks, and the hand-overs.
    hand_overs : int
    traffic_mb : float
        That the match moves between caches and memory, about: each buffer is written once and read once.
    """

    cores: int
    one_ms: float
    cores_ms: float
    path_ms: float
    serial_ms: float
    hand_overs: int
    traffic_mb: float

    @property
    def speed_up(self) -> float:
        """How many times as fast as one core."""
        return self.one_ms / self.cores_ms

    @property
    def serial_share(self) -> float:
        """What cannot be shared, as a part of the time of one core."""
        return self.serial_ms / self.one_ms


def makespan(stages: Sequence[Tasks | Lines], cores: int) -> float:
    """Return the seconds of stages that follow one another."""
    return sum(stage.span(cores) for stage in stages)


def simulate(
    method: str, levels: int, left: NDArray[np.uint8], right: NDArray[np.uint8], cores: Sequence[int], rounds: int,
    clock: Callable[[], float] = time.thread_time, **options: Any,
) -> list[Simulated]:  # fmt: skip
    """Simulate one match of a pair on more cores.

    Parameters
    ----------
    method : str
    levels : int
        Disparities 0 to `levels` - 1.
    left, right : (H, W) uint8
    cores : sequence of int
    rounds : int
        Calls for each number of cores, whose medians are returned.
    clock : callable
        Returns seconds of this thread.
    **options
        Of the matcher.
    """
    one = _matcher(method, levels, 1, options, left, right)
    many = {count: _matcher(method, levels, count, options, left, right) for count in cores}
    hand_over = _hand_over()
    singles: list[float] = []
    rows: dict[int, list[tuple[float, float, float, int]]] = {count: [] for count in cores}
    for _ in range(rounds):
        before = clock()
        one(left, right)
        singles.append(clock() - before)
        for count, matcher in many.items():
            timed = TimedTasks(clock)
            before = clock()
            with tasks_by(timed):
                matcher(left, right)
            serial = clock() - before - timed.seconds - timed.own_seconds + hand_over * len(timed.stages)
            widest = max(count, *(len(s.seconds) for s in timed.stages if isinstance(s, Tasks)))
            spans = makespan(timed.stages, count), makespan(timed.stages, max(widest, left.shape[0]))
            rows[count].append((serial + spans[0], serial + spans[1], serial, len(timed.stages)))
    traffic = 2 * one.nbytes(*left.shape) / 1e6
    result = []
    for count in cores:
        on_cores, path, serial = (1e3 * median(row[k] for row in rows[count]) for k in range(3))
        result.append(Simulated(count, 1e3 * median(singles), on_cores, path, serial, rows[count][0][3], traffic))
    return result


def print_simulated(simulated: Mapping[tuple[str, str], Sequence[Simulated]]) -> None:
    """Print simulations by size and method."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    table = new_table("simulated from task times that one thread took, not measured", "size")
    for head in (
        "method",
        "cores",
        "1 thread ms",
        "simulated ms",
        "speed-up",
        "critical path ms",
        "serial ms",
        "share",
    ):
        table.add_column(head, justify="right")
    table.add_column("MB moved", justify="right")
    for (size, method), rows in simulated.items():
        for row in rows:
            figures = (row.one_ms, row.cores_ms, row.speed_up, row.path_ms, row.serial_ms)
            texts = [f"{figure:.2f}" for figure in figures]
            share = f"{100 * row.serial_share:.1f} %"
            table.add_row(size, method, str(row.cores), *texts, share, f"{row.traffic_mb:.0f}")
    console.print(table)


def _matcher(method: str, levels: int, threads: int, options: Any, left: Any, right: Any) -> matching.Matcher:
    matcher = matching.Matcher(method, max_disparity=levels, threads=threads, device="cpu", **options)
    for _ in range(2):  # compiles, and makes the buffers
        matcher(left, right)
    return matcher


def _hand_over() -> float:
    """Return the seconds that two threads need to share out two tasks and to meet again, when nobody disturbs them."""
    took = []
    for _ in range(_HAND_OVERS):
        before = time.perf_counter()
        run([_nothing, _nothing], 2)
        took.append(time.perf_counter() - before)
    return float(np.percentile(took, 25))


def _nothing() -> None:
    pass
