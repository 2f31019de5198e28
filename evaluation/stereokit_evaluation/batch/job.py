"""What is done for one pair of a batch, in a thread of this machine or in a worker of a cluster: read, match, write.

Whatever goes wrong with a pair becomes a line of its outcome. Matchers are kept by job, so that a process compiles
and allocates once.
"""

from __future__ import annotations

import errno
import threading
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.cli.pair import read_mask
from stereokit.errors import InputError, StereokitError, one_line
from stereokit.io import read_pair, write_disparity, write_image
from stereokit.matching import Matcher
from stereokit.notices import collecting
from stereokit.pairs import align_rows
from stereokit.result import colorize
from stereokit_evaluation.batch.store import COLOR, make_below, publish, target_of

__all__ = ["Job", "Outcome", "describe", "matcher_of", "work"]

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Job:
    """What all pairs of a batch have in common; hashable, and the same in every process.

    Attributes
    ----------
    folder : str
        Where outputs go, absolute.
    suffix : str
        Of the maps, with its dot.
    color : bool
        Also write a coloured picture.
    method : str
    options : tuple of (str, value)
        Of `stereokit.Matcher`.
    mask, right_mask : str or None
        Files with the usable pixels of all left, and of all right images.
    align : bool
        Align the rows of each pair first.
    strict : bool
        Pairs that would be warned of fail.
    """

    folder: str
    suffix: str
    color: bool
    method: str
    options: tuple[tuple[str, Any], ...]
    mask: str | None = None
    right_mask: str | None = None
    align: bool = False
    strict: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of one pair.

    Attributes
    ----------
    name : str
    written : bool
        False if there was such a map already, or none could be made.
    reason : str
        Why there is none, in one line; empty if there is one.
    fatal : bool
        Nothing more can be written.
    seconds : float
        From reading to writing.
    density : float or None
        The share of pixels that were measured, from 0 to 1; None if nothing was matched.
    doubts : tuple of str
        What looks wrong about the pair, a line each.
    """

    name: str
    written: bool = False
    reason: str = ""
    fatal: bool = False
    seconds: float = 0.0
    density: float | None = None
    doubts: tuple[str, ...] = ()


def work(job: Job, name: str, left: str | NDArray[Any], right: str | NDArray[Any]) -> Outcome:
    """Make the map of one pair, unless it is there.

    Parameters
    ----------
    job : Job
    name : str
    left, right : str or array
        Files, or the images themselves.
    """
    start = time.perf_counter()
    try:
        folder = Path(job.folder)
        target = target_of(folder, name, job.suffix)
        if target.exists():  # a worker that died had got that far
            return Outcome(name)
        with collecting() as doubts:
            if isinstance(left, str) and isinstance(right, str):
                left, right = read_pair(left, right, alpha=True)
            images = np.asarray(left), np.asarray(right)
            if images[0].shape[:2] != images[1].shape[:2]:
                sizes = " and ".join(f"{image.shape[1]}x{image.shape[0]}" for image in images)
                raise InputError(f"left and right must have the same size, got {sizes}")
            matcher = matcher_of(job)
            if job.align:
                images = images[0], align_rows(*images, nodata=matcher.settings.nodata)[0]
            result = matcher(*images, **_masks(job, images[0].shape[:2]))
        if job.strict and doubts:
            raise InputError(f"{doubts[0]} (--strict)")
        if job.color:  # first: the map says that all is done
            picture = folder / COLOR / f"{name}.png"
            make_below(folder, *picture.parent.relative_to(folder).parts)
            write_image(picture, colorize(result.disparity, matcher.min_disparity, matcher.max_disparity))
        # The range fits the format, as the command checks; a refiner may add a pixel.
        written = publish(folder, target, lambda path: write_disparity(path, result.disparity, clip=True))
        seconds = time.perf_counter() - start
        return Outcome(name, written, seconds=seconds, density=result.density, doubts=tuple(doubts))
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, OSError):
            cause = cause.__cause__
        fatal = cause is not None and cause.errno in _FULL
        return Outcome(name, False, describe(error), fatal, time.perf_counter() - start)


def describe(error: BaseException) -> str:
    """Return an error in one line, with its type unless it is one of ours."""
    text = one_line(str(error))
    return text if isinstance(error, StereokitError) and text else f"{type(error).__name__}: {text}".rstrip(": ")


def _masks(job: Job, shape: tuple[int, ...]) -> dict[str, NDArray[np.bool_] | None]:
    size = int(shape[0]), int(shape[1])
    names = (("mask", job.mask), ("right_mask", job.right_mask))
    return {name: None if path is None else _mask(name, path, size) for name, path in names}


@lru_cache(maxsize=4)
def _mask(name: str, path: str, size: tuple[int, int]) -> NDArray[np.bool_] | None:
    return read_mask(f"--{name.replace('_', '-')}", Path(path), size)


_matchers: dict[Job, Matcher] = {}
_lock = threading.Lock()


def matcher_of(job: Job) -> Matcher:
    """Return the job's matcher, one thread a call; the last one is kept."""
    with _lock:
        found = _matchers.get(job)
        if found is None:
            found = Matcher(job.method, threads=1, **dict(job.options))
            _matchers.clear()
            _matchers[job] = found
        return found
