"""Run a matcher, or read finished maps, over frames and score each: the loop of `evaluate`.

A frame that cannot be read or scored becomes a `Skipped` and the loop goes on. Only the call of the matcher
is timed, after one untimed call on the first pair that loads.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, InputError, StereokitError, one_line
from stereokit.io import read_disparity
from stereokit.notices import PairWarning, collecting, warn
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.assessment import Official, assess
from stereokit_evaluation.scoring.kitti import Score
from stereokit_evaluation.scoring.measures import Measures
from stereokit_evaluation.scoring.outside import FunctionMethod, OutsideMethod, Program, map_of

__all__ = [
    "Estimate",
    "Estimator",
    "Matching",
    "Result",
    "Scored",
    "Skipped",
    "from_files",
    "run",
    "score_frames",
    "seen_in_training",
    "with_matcher",
    "with_outside",
]


class _Disparity(Protocol):
    @property
    def disparity(self) -> Any: ...
    @property
    def valid(self) -> Any: ...


Matching = Callable[[NDArray[Any], NDArray[Any]], _Disparity]
"""A function of a left and a right image: `stereokit.Matcher`, or any other with its result."""


@dataclass(frozen=True)
class Estimate:
    """A disparity map to score, (H, W) float32; the mask of its measured pixels; and the seconds of its matching."""

    disparity: NDArray[np.float32]
    measured: NDArray[np.bool_] | None = None
    seconds: float | None = None


Estimator = Callable[[Frame], Estimate]
Observer = Callable[[Frame, Estimate, NDArray[np.float32] | None, NDArray[np.float32] | None], None]


@dataclass(frozen=True)
class Scored:
    """One frame's scores, the seconds of its matching, if any was run, and warnings about it.

    Attributes
    ----------
    name : str
    score : Score
        As the KITTI 2015 development kit counts.
    seconds : float or None
    warnings : tuple of str
    measures : Measures
        Further figures, by set of pixels.
    official : mapping or None
        By the rules of the frame's benchmark.
    scene : str or None
        The scene that the frame is of; None is one of its own.
    """

    name: str
    score: Score
    seconds: float | None = None
    warnings: tuple[str, ...] = ()
    measures: Measures = field(default_factory=Measures)
    official: Official | None = None
    scene: str | None = None


@dataclass(frozen=True)
class Skipped:
    """A frame that could not be scored, and the reason, in one line."""

    name: str
    reason: str


@dataclass(frozen=True)
class Result:
    """All frames of one run.

    Parameters
    ----------
    frames : tuple of Scored
        In the order of the run.
    skipped : tuple of Skipped
        Those that could not be scored; they are left out of all counts.
    """

    frames: tuple[Scored, ...] = ()
    skipped: tuple[Skipped, ...] = ()
    score: Score = field(init=False)
    measures: Measures = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "score", sum((frame.score for frame in self.frames), Score()))
        object.__setattr__(self, "measures", sum((frame.measures for frame in self.frames), Measures()))

    @property
    def seconds_per_image(self) -> float | None:
        """Mean seconds of the matcher's calls, None where none was timed."""
        timed = [frame.seconds for frame in self.frames if frame.seconds is not None]
        return sum(timed) / len(timed) if timed else None


def run(
    frames: Iterable[Frame],
    matcher: Matching,
    progress: Callable[[int, int, str], None] | None = None,
    *,
    gray: bool = True,
) -> Result:
    """Match and score frames, and pool the counts.

    Parameters
    ----------
    frames : iterable of Frame
    matcher : callable
        A `stereokit.Matcher`, or any function of two images that returns an object with ``disparity`` and
        ``valid``.
    progress : callable, optional
        Called after each frame with the number done, the number of all, and the frame's name.
    gray : bool
        Give the matcher grey images (the default, as for all published figures) rather than colour ones.

    Returns
    -------
    Result
        ``result.score.noc.all.filled.d1()`` is the pooled D1 error over non-occluded pixels.
    """
    all_frames = list(frames)
    scored: list[Scored] = []
    skipped: list[Skipped] = []
    for count, outcome in enumerate(score_frames(all_frames, with_matcher(matcher, gray=gray)), start=1):
        if isinstance(outcome, Scored):
            scored.append(outcome)
            for line in outcome.warnings:
                warn(f"{outcome.name}: {line}", PairWarning)
        else:
            skipped.append(outcome)
        if progress is not None:
            progress(count, len(all_frames), outcome.name)
    return Result(tuple(scored), tuple(skipped))


def score_frames(
    frames: Iterable[Frame],
    estimate: Estimator,
    observe: Observer | None = None,
) -> Iterator[Scored | Skipped]:
    """Yield the outcome of each frame, one at a time, so that an interrupted run has its results so far.

    Parameters
    ----------
    frames : iterable of Frame
    estimate : callable
        Turns a frame into an `Estimate`: `with_matcher` or `from_files`.
    observe : callable, optional
        Called for each scored frame with the frame, its estimate, and its *noc* and *occ* ground truth.
    """
    for frame in frames:
        try:
            with collecting() as warnings:
                noc, occ, objects = frame.load_noc(), frame.load_occ(), frame.load_objects()
                if noc is None and occ is None:
                    raise FileError("the frame has no ground truth")
                result = estimate(frame)
                truth = {"noc": noc, "occ": occ, "objects": objects}
                scores = assess(frame, truth, result.disparity, result.measured)
        except (StereokitError, OSError) as error:
            yield Skipped(frame.name, one_line(str(error)))
            continue
        if observe is not None:
            observe(frame, result, noc, occ)
        yield Scored(
            frame.name, scores.score, result.seconds, tuple(warnings), scores.measures, scores.official, frame.scene
        )


def seen_in_training(matcher: object, dataset: str, frames: Iterable[Frame]) -> str | None:
    """Return a line with the number of frames that a matcher's refiner was trained on, None for none.

    Parameters
    ----------
    matcher : object
        A `stereokit.Matcher`, whose refiner may have the attribute ``trained_on``.
    dataset : str
        Name of the data set that the frames are of.
    frames : iterable of Frame
    """
    refiner = getattr(matcher, "refine", None)
    training_frames: frozenset[str] = getattr(refiner, "trained_on", frozenset())
    all_frames = list(frames)
    count = sum(f"{dataset}/{frame.name}" in training_frames for frame in all_frames)
    if not count:
        return None
    name = getattr(matcher, "refiner", None)
    return f"refiner {name!r} was trained on {count} of these {len(all_frames)} frames: on those its errors say little"


def with_matcher(matcher: Matching, *, gray: bool = True) -> Estimator:
    """Return an estimator that loads a pair and times `matcher` on it, after one call to warm up."""
    warm = False

    def estimate(frame: Frame) -> Estimate:
        nonlocal warm
        left, right = frame.load_pair(gray=gray)
        if left.shape != right.shape:
            raise InputError(f"left and right must have one size, got {left.shape} and {right.shape}")
        if not warm:
            with collecting():
                matcher(left, right)
            warm = True
        start = time.perf_counter()
        result = matcher(left, right)
        seconds = time.perf_counter() - start
        return Estimate(np.asarray(result.disparity), np.asarray(result.valid), seconds)

    return estimate


def from_files(directory: str | Path) -> Estimator:
    """Return an estimator that reads finished maps (`stereokit_evaluation.scoring.outside.map_of`).

    All unknown pixels count as not measured, and are filled before scoring.

    Raises
    ------
    FileError
        If `directory` is no folder; and for each frame that has no map in it.
    """
    base = Path(directory)
    if not base.is_dir():
        raise FileError(f"predictions must be a folder, got {str(base)!r}, which is not")
    return lambda frame: Estimate(read_disparity(map_of(base, frame.name)))


def with_outside(method: OutsideMethod) -> Estimator:
    """Return an estimator that gives a method of others the images as they are stored, and times it.

    A function is called once more on the first pair, to warm up; a program is not.
    """
    warm = False

    def estimate(frame: Frame) -> Estimate:
        nonlocal warm
        left, right = frame.load_pair()
        if left.shape != right.shape:
            raise InputError(f"left and right must have one size, got {left.shape} and {right.shape}")
        try:
            if isinstance(method, Program):
                result, seconds = method.timed(frame, left, right)
            else:
                if not warm:
                    method(frame, left, right)
                    warm = True
                if isinstance(method, FunctionMethod):
                    result, seconds = method.timed(left, right)
                else:
                    start = time.perf_counter()
                    result = method(frame, left, right)
                    seconds = time.perf_counter() - start
        except (StereokitError, OSError):
            raise
        except Exception as error:  # a slip in another's method costs the frame
            raise InputError(one_line(f"{method.name}: {type(error).__name__}: {error}")) from error
        return Estimate(result.disparity, result.valid, seconds)

    return estimate
