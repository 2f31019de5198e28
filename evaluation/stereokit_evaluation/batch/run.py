"""Run a batch: hold its folder, hand the pairs that are not there yet to an engine, count what comes back.

The local engine is threads, one pair each: measured on two cores they are as fast as processes, which would compile
and allocate once each. An engine is asked for one outcome at a time and holds a bounded number of pairs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import stereokit
from stereokit.errors import StereokitError
from stereokit.kernels.threads import available_threads
from stereokit.notices import collecting
from stereokit_evaluation.batch.job import Job, Outcome, matcher_of, work
from stereokit_evaluation.batch.pairs import Pair
from stereokit_evaluation.batch.store import finished, held, mark_of
from stereokit_evaluation.batch.video import FramePair, Video
from stereokit_evaluation.common.environment import versions

__all__ = ["Engine", "Summary", "identity", "on_threads", "run_batch"]

_LOWEST = 10

Engine = Callable[[Job, Iterable[Pair | FramePair]], Generator[Outcome, None, None]]
"""Works on pairs and yields their outcomes, in any order."""


@dataclass
class Summary:
    """What a batch came to.

    Attributes
    ----------
    pairs : int
        Those that were looked at; all of them unless interrupted.
    written, found, failed : int
        Maps made by this run, there before, and not made.
    errors : list of (name, reason)
    seconds : float
        From the first pair to the last.
    interrupted : bool
    stopped : str
        Why the run could not go on; empty if it could.
    vanished : bool
        It could not because its folder is gone.
    notes : list of str
        Lines about the input.
    doubts : list of (name, line)
        What looks wrong about pairs.
    lowest : list of (density, name)
        The maps of this run of which least was measured, a few.
    """

    written: int = 0
    found: int = 0
    failed: int = 0
    errors: list[tuple[str, str]] = field(default_factory=list)
    seconds: float = 0.0
    interrupted: bool = False
    stopped: str = ""
    vanished: bool = False
    notes: list[str] = field(default_factory=list)
    doubts: list[tuple[str, str]] = field(default_factory=list)
    lowest: list[tuple[float, str]] = field(default_factory=list)
    densities: float = 0.0
    """Sum over the maps that this run made."""

    @property
    def pairs(self) -> int:
        """All that were looked at."""
        return self.written + self.found + self.failed

    @property
    def pairs_per_second(self) -> float | None:
        """Maps that this run made, a second."""
        return self.written / self.seconds if self.written and self.seconds > 0 else None

    def as_json(self) -> dict[str, Any]:
        """Return all of it, and versions."""
        return {
            "pairs": self.pairs,
            "written": self.written,
            "found": self.found,
            "failed": self.failed,
            "errors": [{"name": name, "reason": reason} for name, reason in self.errors],
            "seconds": self.seconds,
            "pairs_per_second": self.pairs_per_second,
            "interrupted": self.interrupted,
            "stopped": self.stopped or None,
            "notes": self.notes,
            "density": {
                "mean": self.densities / self.written if self.lowest else None,
                "lowest": [{"name": name, "density": density} for density, name in self.lowest],
            },
            "warnings": [{"name": name, "reason": line} for name, line in self.doubts],
            "versions": versions(),
        }


def identity(job: Job, inputs: Any) -> dict[str, Any]:
    """Return what all maps of a job depend on: resolved options, weights, version and inputs."""
    matcher = matcher_of(job)
    evidence = {"mask": job.mask, "right_mask": job.right_mask, "align": job.align or None}
    return {
        "inputs": inputs,
        **matcher.identity(),
        **{name: value for name, value in evidence.items() if value is not None},
        "format": job.suffix,
        "color": job.color,
        "version": stereokit.__version__,
    }


def run_batch(
    job: Job,
    source: list[Pair] | Video,
    engine: Engine,
    *,
    inputs: Any,
    overwrite: bool = False,
    progress: Callable[[Summary], object] | None = None,
) -> Summary:
    """Make the maps of all pairs that have none.

    Parameters
    ----------
    job : Job
    source : list of Pair or Video
    engine : callable
        `on_threads` or `stereokit_evaluation.batch.dask.on_cluster` with their options.
    inputs : str, or a list of them
        What the pairs came from: maps of other inputs are not taken for theirs.
    overwrite : bool
        Make all maps anew, whatever is there.
    progress : callable or None
        Called with the state so far after each pair.

    Returns
    -------
    Summary
        After an interrupt (Ctrl-C) and where it could not go on (a full disk, a lost cluster) too: what is written is
        whole, and the next call goes on from there.

    Raises
    ------
    FileError
        If the folder cannot be used.
    OptionError
        If the folder was made with other options.
    """
    summary = Summary()
    owned: Callable[[str], bool] = str.isdigit
    if not isinstance(source, Video):
        owned = {pair.name for pair in source}.__contains__
    folder = Path(job.folder)
    with held(folder, identity(job, inputs), job.suffix, owned, overwrite) as there:
        mark = mark_of(folder)
        summary.found = len(there)
        start = time.perf_counter()
        outcomes = engine(job, _pending(source, there))
        try:
            for outcome in outcomes:
                if mark_of(folder) != mark:
                    summary.vanished = True
                    break
                _count(summary, outcome)
                summary.seconds = time.perf_counter() - start
                if progress is not None:
                    progress(summary)
                if outcome.fatal:
                    summary.stopped = outcome.reason
                    break
        except KeyboardInterrupt:
            summary.interrupted = True
        except StereokitError as error:  # of the engine or of the source, not of a pair
            summary.stopped = str(error)
        finally:
            outcomes.close()
        summary.vanished = mark_of(folder) != mark
        if summary.vanished:
            summary.stopped = f"output {job.folder!r} was removed or replaced while the batch ran"
        elif summary.interrupted or summary.stopped:  # some were finished that nobody asked for any more
            now = sum(map(owned, finished(folder, job.suffix)))
            summary.written = max(summary.written, now - summary.found)
    summary.seconds = time.perf_counter() - start
    return summary


def on_threads(
    job: Job, pairs: Iterable[Pair | FramePair], workers: int | None = None
) -> Generator[Outcome, None, None]:
    """Work on pairs with threads of this process, one pair each; all processors by default."""
    count = available_threads() if workers is None else workers
    waiting: set[Future[Outcome]] = set()
    source = iter(pairs)
    with ThreadPoolExecutor(count, thread_name_prefix="stereokit-batch") as executor:
        try:
            more, compiled = True, False
            while more or waiting:
                while more and len(waiting) < 2 * count:
                    pair = next(source, None)
                    more = pair is not None
                    if pair is not None:
                        compiled = compiled or _compile(job)
                        waiting.add(executor.submit(_outcome, job, pair))
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
        finally:
            for future in waiting:
                future.cancel()


def _compile(job: Job) -> bool:
    """Match a small pair, so that threads do not compile side by side."""
    small = np.zeros((32, 32), np.uint8)
    with collecting():
        matcher_of(job)(small, small)
    return True


def _outcome(job: Job, pair: Pair | FramePair) -> Outcome:
    if pair.left is None or pair.right is None:
        return Outcome(pair.name, reason=pair.reason)
    return work(job, pair.name, pair.left, pair.right)


def _pending(source: list[Pair] | Video, there: set[str]) -> Iterator[Pair | FramePair]:
    if isinstance(source, Video):
        yield from source.frames(lambda name: name not in there)
    else:
        yield from (pair for pair in source if pair.name not in there)


def _count(summary: Summary, outcome: Outcome) -> None:
    summary.doubts += [(outcome.name, line) for line in outcome.doubts]
    if outcome.written and outcome.density is not None:
        summary.densities += outcome.density
        summary.lowest = sorted([*summary.lowest, (outcome.density, outcome.name)])[:_LOWEST]
    if outcome.reason:
        summary.failed += 1
        summary.errors.append((outcome.name, outcome.reason))
    elif outcome.written:
        summary.written += 1
    else:
        summary.found += 1
