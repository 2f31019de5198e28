"""Run a batch: lock its folder, pass the pairs without a map to an engine, count the outcomes.

The local engine is threads, one pair each: measured on two cores they are as fast as processes, which would compile
and allocate once each. An engine yields one outcome at a time and has a bounded number of pairs in memory.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import stereokit
from stereokit.errors import StereokitError
from stereokit.io.calibrations.dispatch import digest
from stereokit.kernels.threads import available_threads
from stereokit.matching import compile_kernels
from stereokit_evaluation.batch.job import Job, Outcome, matcher_of, work
from stereokit_evaluation.batch.pairs import PairFiles
from stereokit_evaluation.batch.store import finished, folder_identity, open_output
from stereokit_evaluation.batch.video import FramePair, Frames
from stereokit_evaluation.common.environment import versions

__all__ = ["Engine", "Summary", "identity", "on_threads", "run_batch"]

_LOWEST = 10

Engine = Callable[[Job, Iterable[PairFiles | FramePair]], Generator[Outcome, None, None]]
"""Works on pairs and yields their outcomes, in any order."""


@dataclass
class Summary:
    """The summary of a batch.

    Attributes
    ----------
    pairs : int
        The processed pairs; all pairs unless interrupted.
    written, existing, failed : int
        New maps of this run, maps from before, and pairs without a map.
    errors : list of (name, reason)
    seconds : float
        From the first pair to the last.
    interrupted : bool
    stopped : str
        The reason why the run ended early; empty if it did not.
    vanished : bool
        Whether it ended because its folder is gone.
    notes : list of str
        Lines about the input.
    warnings : list of (name, line)
        Warnings about pairs.
    lowest : list of (density, name)
        The maps of this run with the lowest densities, a few.
    """

    written: int = 0
    existing: int = 0
    failed: int = 0
    errors: list[tuple[str, str]] = field(default_factory=list)
    seconds: float = 0.0
    interrupted: bool = False
    stopped: str = ""
    vanished: bool = False
    notes: list[str] = field(default_factory=list)
    warnings: list[tuple[str, str]] = field(default_factory=list)
    lowest: list[tuple[float, str]] = field(default_factory=list)
    densities: float = 0.0
    """Sum over the new maps of this run."""

    @property
    def pairs(self) -> int:
        """The number of processed pairs."""
        return self.written + self.existing + self.failed

    @property
    def pairs_per_second(self) -> float | None:
        """New maps of this run per second."""
        return self.written / self.seconds if self.written and self.seconds > 0 else None

    def as_json(self) -> dict[str, Any]:
        """Return the summary as JSON, with versions."""
        return {
            "pairs": self.pairs,
            "written": self.written,
            "found": self.existing,
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
            "warnings": [{"name": name, "reason": line} for name, line in self.warnings],
            "versions": versions(),
        }


def identity(job: Job, inputs: Any) -> dict[str, Any]:
    """Return everything that all maps of a job depend on: resolved options, weights, version and inputs."""
    matcher = matcher_of(job)
    evidence = {"mask": job.mask, "right_mask": job.right_mask, "align": job.align or None}
    return {
        "inputs": inputs,
        **matcher.identity(),
        **{name: value for name, value in evidence.items() if value is not None},
        "format": job.suffix,
        "color": job.color,
        **({"rig": digest(job.rig), "alpha": job.alpha} if job.rig else {}),
        "version": stereokit.__version__,
    }


def run_batch(
    job: Job,
    source: list[PairFiles] | Frames,
    engine: Engine,
    *,
    inputs: Any,
    overwrite: bool = False,
    progress: Callable[[Summary], object] | None = None,
) -> Summary:
    """Compute the maps of all pairs that have none.

    Parameters
    ----------
    job : Job
    source : list of PairFiles, or Frames
    engine : callable
        `on_threads` or `stereokit_evaluation.batch.dask.on_cluster` with their options.
    inputs : str, or a list of them
        The origin of the pairs: maps of other inputs are not taken for theirs.
    overwrite : bool
        Replace existing maps.
    progress : callable or None
        Called with the summary so far after each pair.

    Returns
    -------
    Summary
        After an interrupt (Ctrl-C) and an early end (a full disk, a lost cluster) too: written maps are whole, and the
        next call resumes from there.

    Raises
    ------
    FileError
        If the folder cannot be used.
    OptionError
        If the folder has maps of other options.
    """
    summary = Summary()
    is_own = source.owns if isinstance(source, Frames) else {pair.name for pair in source}.__contains__
    folder = Path(job.folder)
    with open_output(folder, identity(job, inputs), job.suffix, is_own, overwrite) as existing:
        folder_id = folder_identity(folder)
        summary.existing = len(existing)
        start = time.perf_counter()
        outcomes = engine(job, _pending(source, existing))
        try:
            for outcome in outcomes:
                if folder_identity(folder) != folder_id:
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
        summary.vanished = folder_identity(folder) != folder_id
        if summary.vanished:
            summary.stopped = f"output {job.folder!r} was removed or replaced while the batch ran"
        elif summary.interrupted or summary.stopped:  # workers may have finished pairs after the last outcome
            finished_count = sum(map(is_own, finished(folder, job.suffix)))
            summary.written = max(summary.written, finished_count - summary.existing)
    summary.seconds = time.perf_counter() - start
    return summary


def on_threads(
    job: Job, pairs: Iterable[PairFiles | FramePair], workers: int | None = None
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
    compile_kernels(matcher_of(job))
    return True


def _outcome(job: Job, pair: PairFiles | FramePair) -> Outcome:
    if pair.left is None or pair.right is None:
        return Outcome(pair.name, reason=pair.reason)
    return work(job, pair.name, pair.left, pair.right)


def _pending(source: list[PairFiles] | Frames, existing: set[str]) -> Iterator[PairFiles | FramePair]:
    if isinstance(source, Frames):
        yield from source.frames(lambda name: name not in existing)
    else:
        yield from (pair for pair in source if pair.name not in existing)


def _count(summary: Summary, outcome: Outcome) -> None:
    summary.warnings += [(outcome.name, line) for line in outcome.warnings]
    if outcome.written and outcome.density is not None:
        summary.densities += outcome.density
        summary.lowest = sorted([*summary.lowest, (outcome.density, outcome.name)])[:_LOWEST]
    if outcome.reason:
        summary.failed += 1
        summary.errors.append((outcome.name, outcome.reason))
    elif outcome.written:
        summary.written += 1
    else:
        summary.existing += 1
