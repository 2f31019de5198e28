"""The loop of the study: every frame through every configuration, timed, scored and stored.

Frames are the outer loop: a pair is loaded once and all configurations take turns on it, so that a busy machine harms
all alike, and an interrupt leaves the same frames for all. Each configuration is called once to warm up; on each
frame it is then called `repeats` times, and the median counts.

A frame that fails in one configuration is left out for all, so that the rows stay comparable. A program of others is
run once for each frame, and finished maps are only read.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, InputError, StereokitError
from stereokit.kernels.trace import observed
from stereokit.notices import collecting
from stereokit_evaluation.bench.stages import GROUPS, OTHER, TOTAL, StageTimer
from stereokit_evaluation.data import datasets
from stereokit_evaluation.data import disturbed as disturbed_frames
from stereokit_evaluation.data import frame as frames
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring import assessment, eth3d, kitti, measures, middlebury
from stereokit_evaluation.scoring.assessment import assess
from stereokit_evaluation.scoring.outside import FunctionMethod, Program
from stereokit_evaluation.scoring.runner import Result, Scored, Skipped
from stereokit_evaluation.study.configurations import BASELINE, Configuration, describe_error, fingerprint, title
from stereokit_evaluation.study.store import Record, Store, digest, frame_digest
from stereokit_evaluation.synthetic import disturbances as faults
from stereokit_evaluation.synthetic import sensors

__all__ = ["Study", "StudyRow", "measure", "run_study"]

Clock = Callable[[], float]

_MAX_FAILURES = 3  # first frames that all fail in a configuration, until it is given up


@dataclass(frozen=True, eq=False)
class StudyRow:
    """One configuration's results.

    Attributes
    ----------
    configuration : Configuration
    result : Result
        Over the frames that all configurations scored; empty if it is missing.
    ms : dict of str to float
        Milliseconds a frame, in all and by group of stages: medians over the frames of `result`.
    missing : str or None
        The reason why there are no results.
    failed : int
        The number of frames that it failed on.
    """

    configuration: Configuration
    result: Result
    ms: dict[str, float]
    missing: str | None = None
    failed: int = 0


@dataclass
class Study:
    """The results of a run.

    Attributes
    ----------
    rows : list of Row
        In the order of the configurations.
    skipped : list of Skipped
        Frames that are left out, each once, with the first reason.
    reused, computed : int
        Numbers of records from the store, and of new ones.
    interrupted : bool
        Whether the user interrupted it.
    """

    rows: list[StudyRow] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)
    reused: int = 0
    computed: int = 0
    interrupted: bool = False


class _LoadedFrame:
    """A frame's images and ground truth, read once, at their first use."""

    def __init__(self, frame: Frame, gray: bool) -> None:
        self.frame = frame
        self.gray = gray

    @cached_property
    def images(self) -> tuple[NDArray[Any], NDArray[Any]]:
        left, right = self.frame.load_pair(gray=self.gray)
        if left.shape != right.shape:
            raise InputError(f"left and right must have one size, got {left.shape} and {right.shape}")
        return left, right

    @cached_property
    def stored_images(self) -> tuple[NDArray[Any], NDArray[Any]]:
        left, right = self.frame.load_pair()
        if left.shape != right.shape:
            raise InputError(f"left and right must have one size, got {left.shape} and {right.shape}")
        return left, right

    @cached_property
    def truth(self) -> dict[str, NDArray[Any] | None]:
        maps = {name: getattr(self.frame, f"load_{name}")() for name in ("noc", "occ", "objects")}
        size = self.images[0].shape[:2]
        for name, values in maps.items():
            if values is not None and values.shape != size:
                raise InputError(f"{name} must have the size of the images, {size}, got {values.shape}")
        return maps

    @cached_property
    def digest(self) -> str:
        if self.frame.noc is None and self.frame.occ is None:
            raise FileError("the frame has no ground truth")
        return frame_digest(self.frame)


def run_study(
    all_frames: Iterable[Frame],
    configurations: Sequence[Configuration],
    store: Store,
    *,
    repeats: int = 3,
    gray: bool = True,
    about_times: Any = None,
    warm_up: bool = True,
    step: Callable[[str, int], None] = lambda text, advance: None,
    report: Callable[[str], None] = lambda line: None,
) -> Study:
    """Measure and score all configurations on all frames, except for those in the store.

    Parameters
    ----------
    all_frames : iterable of Frame
    configurations : sequence of Configuration
        Those without a matcher are reported as missing.
    store : Store
    repeats : int
        Timed calls for each frame and configuration, 1 or more.
    gray : bool
        Give grey images.
    about_times : any
        Further conditions of the times: threads, processor.
    warm_up : bool
        Call each configuration once before it is timed. Without, the first time is too long, and nothing is repeated.
    step : callable
        Called with a short text and a number of steps, before each configuration of each frame.
    report : callable
        Called with one line for each frame that is left out.

    Returns
    -------
    Study
        An interrupt (KeyboardInterrupt) ends the work; the results so far are returned.

    Raises
    ------
    FileError
        If the store cannot be written to.
    """
    study = Study()
    missing = {index: c.missing or "" for index, c in enumerate(configurations) if not c.can_match}
    records: dict[int, dict[str, Record]] = {index: {} for index in range(len(configurations)) if index not in missing}
    failures: dict[str, list[tuple[int | None, str]]] = {}
    scenes: dict[str, str | None] = {}
    warm: set[int] = set() if warm_up else set(range(len(configurations)))

    def fail(frame: Frame, index: int | None, reason: str) -> None:
        report(f"skipped {frame.name}: {_named(configurations, index, reason)}")
        failures.setdefault(frame.name, []).append((index, reason))
        if index is not None and not records[index] and _times_failed(failures, index) == _MAX_FAILURES:
            missing[index] = reason  # and its frames count again

    common = [_source(), repeats, gray, about_times]
    try:
        for frame in all_frames:
            loaded, warnings = _LoadedFrame(frame, gray), list[str]()
            scenes[frame.name] = frame.scene
            step(frame.name, sum(index in missing for index in range(len(configurations))))
            for index, configuration in enumerate(configurations):
                if index in missing:
                    continue
                step(f"{frame.name}: {configuration.name}", 1)
                path = f"{configuration.label}/{title(configuration.variant)}/{frame.name}"
                try:
                    content = loaded.digest
                    try:
                        identity = configuration.identity_on(frame)
                    except (StereokitError, OSError) as error:
                        fail(frame, index, describe_error(error))
                        continue
                    key = digest([content, identity, *common])
                    record = store.get(path, key)
                    if record is None:
                        _ = loaded.images, loaded.truth  # here, because trouble with these is the frame's
                except (StereokitError, OSError) as error:
                    fail(frame, None, describe_error(error))
                    break
                if record is None:
                    try:
                        with collecting() as lines:
                            record = measure(configuration, loaded, repeats, warm=index in warm)
                        warnings += lines
                    except ImportError as error:  # a refiner's runtime, imported at its first call
                        missing[index] = describe_error(error)
                        continue
                    except Exception as error:  # a plug-in's slip must not end a long run
                        fail(frame, index, describe_error(error))
                        continue
                    warm.add(index)
                    store.put(path, key, record, {"frame": frame.name, "identity": identity})
                    study.computed += 1
                else:
                    study.reused += 1
                records[index][frame.name] = record
            for line in warnings[:1]:
                report(f"warning: {frame.name}: {line}")
    except KeyboardInterrupt:
        study.interrupted = True
    _pool(study, configurations, records, missing, failures, scenes)
    return study


def measure(
    configuration: Configuration, loaded: Any, repeats: int, *, warm: bool = True, clock: Clock = time.perf_counter
) -> Record:
    """Return the score and the median times of one configuration on one frame.

    Parameters
    ----------
    configuration : Configuration
        With a matcher.
    loaded : object
        With ``images`` and ``truth``.
    repeats : int
        Timed calls.
    warm : bool
        Whether the matcher was called before; if not, it is called once untimed.
    clock : callable
        Returns seconds.
    """
    outside, frame = configuration.outside, loaded.frame
    left, right = loaded.images if outside is None else loaded.stored_images
    truth = loaded.truth
    runs: list[dict[str, float]] = []
    if isinstance(outside, Program):
        result, seconds = outside.timed(frame, left, right)
        runs.append({TOTAL: seconds})
    elif configuration.kind == "maps":
        result = configuration.match(frame, left, right)
    else:
        if not warm:
            configuration.match(frame, left, right)
        for _ in range(repeats):
            timer = StageTimer(clock, groups=True)
            if isinstance(outside, FunctionMethod):
                result, seconds = outside.timed(left, right, clock)
                runs.append({TOTAL: seconds})
                continue
            if configuration.variant == BASELINE:
                start = clock()
                result = configuration.match(frame, left, right)
                runs.append({TOTAL: clock() - start})
                continue
            with observed(timer):
                start = clock()
                result = configuration.match(frame, left, right)
                total = clock() - start
            group_seconds = {group: timer.seconds.get(group, 0.0) for group in GROUPS}
            runs.append({TOTAL: total, **group_seconds, OTHER: total - sum(group_seconds.values())})
    scores = assess(frame, truth, np.asarray(result.disparity), np.asarray(result.valid))
    ms = {name: 1e3 * median(run[name] for run in runs) for name in runs[0]} if runs else {}
    return Record(scores.score, ms, scores.measures, scores.official)


def _named(configurations: Sequence[Configuration], index: int | None, reason: str) -> str:
    return reason if index is None else f"{configurations[index].name}: {reason}"


def _times_failed(failures: dict[str, list[tuple[int | None, str]]], index: int) -> int:
    return sum(cause == index for causes in failures.values() for cause, _ in causes)


def _source() -> list[str]:
    """Return the digests of the modules that scores and times depend on."""
    modules = (datasets, frames, disturbed_frames, faults, sensors, kitti, measures, assessment, eth3d, middlebury)
    return [fingerprint(Path(str(file))) for file in (*(module.__file__ for module in modules), __file__)]


def _pool(
    study: Study,
    configurations: Sequence[Configuration],
    all_records: dict[int, dict[str, Record]],
    missing: dict[int, str],
    failures: dict[str, list[tuple[int | None, str]]],
    scenes: dict[str, str | None],
) -> None:
    """Build the rows over the frames that all configurations scored; one that scored none is missing."""
    scored_names = {name for records in all_records.values() for name in records}
    for index, records in all_records.items():
        if index not in missing and not records and scored_names:
            reasons = [reason for causes in failures.values() for cause, reason in causes if cause == index]
            missing[index] = reasons[0] if reasons else "interrupted before its first frame"
    complete = [records for index, records in all_records.items() if index not in missing]
    shared_names = [name for name in (complete[0] if complete else ()) if all(name in records for records in complete)]
    for name, causes in failures.items():
        reasons = [_named(configurations, cause, reason) for cause, reason in causes if cause not in missing]
        if reasons:
            study.skipped.append(Skipped(name, reasons[0]))
    for index, configuration in enumerate(configurations):
        failed = _times_failed(failures, index)
        if index in missing:
            study.rows.append(StudyRow(configuration, Result(), {}, missing[index], failed))
            continue
        records = {name: all_records[index][name] for name in shared_names}
        scored = tuple(_scored(name, record, scenes.get(name)) for name, record in records.items())
        names = list(next(iter(records.values())).ms) if records else []
        ms = {name: median(record.ms[name] for record in records.values()) for name in names}
        study.rows.append(StudyRow(configuration, Result(scored), ms, failed=failed))


def _scored(name: str, record: Record, scene: str | None) -> Scored:
    total = record.ms.get(TOTAL)
    return Scored(
        name, record.score, None if total is None else total / 1e3, (), record.measures, record.official, scene
    )
