"""The work on one pair of a batch, in a thread of this machine or in a worker of a cluster: read, match, write.

Any error of a pair becomes a line of its outcome. Matchers are cached by job, so that a process compiles and allocates
once.
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
from stereokit.rig import Rectification, read_rig
from stereokit_evaluation.batch.store import COLOR, make_below, publish, target_of

__all__ = ["Job", "Outcome", "describe", "matcher_of", "rectification_of", "work"]

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Job:
    """The common options of all pairs of a batch; hashable, and the same in every process.

    Attributes
    ----------
    folder : str
        The folder of the outputs, absolute.
    suffix : str
        Of the maps, with its dot.
    color : bool
        Also write a coloured picture.
    method : str
    options : tuple of (str, value)
        Of `stereokit.Matcher`.
    rig : tuple of str
        Files of raw cameras, absolute, with which the images are rectified first; empty for rectified pairs.
    alpha : float or None
        Of `stereokit.StereoRig.rectification`.
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
    rig: tuple[str, ...] = ()
    alpha: float | None = None
    mask: str | None = None
    right_mask: str | None = None
    align: bool = False
    strict: bool = False


@dataclass(frozen=True)
class Outcome:
    """The result of one pair.

    Attributes
    ----------
    name : str
    written : bool
        False if the map existed already, or could not be computed.
    reason : str
        The reason why there is no map, in one line; empty if there is one.
    fatal : bool
        No further output can be written.
    seconds : float
        From reading to writing.
    density : float or None
        The share of measured pixels, from 0 to 1; None if nothing was matched.
    warnings : tuple of str
        Warnings about the pair, a line each.
    """

    name: str
    written: bool = False
    reason: str = ""
    fatal: bool = False
    seconds: float = 0.0
    density: float | None = None
    warnings: tuple[str, ...] = ()


def work(job: Job, name: str, left: str | NDArray[Any], right: str | NDArray[Any]) -> Outcome:
    """Compute the map of one pair, unless it exists.

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
        if target.exists():  # from a worker that died after that
            return Outcome(name)
        with collecting() as warnings:
            if isinstance(left, str) and isinstance(right, str):
                left, right = read_pair(left, right, alpha=True)
            images = np.asarray(left), np.asarray(right)
            if images[0].shape[:2] != images[1].shape[:2]:
                sizes = " and ".join(f"{image.shape[1]}x{image.shape[0]}" for image in images)
                raise InputError(f"left and right must have the same size, got {sizes}")
            matcher = matcher_of(job)
            masks: dict[str, NDArray[np.bool_]] = {}
            if job.rig:
                rectification = rectification_of(job, (images[0].shape[1], images[0].shape[0]))
                images, masks = rectification(*images), rectification.masks
            for mask_name, drawn in _masks(job, images[0].shape[:2]).items():
                masks[mask_name] = masks[mask_name] & drawn if mask_name in masks else drawn
            if job.align:
                images = images[0], align_rows(*images, nodata=matcher.settings.nodata)[0]
            result = matcher(*images, **masks)
        if job.strict and warnings:
            raise InputError(f"{warnings[0]} (--strict)")
        if job.color:  # before the map, whose existence means that the pair is complete
            picture = folder / COLOR / f"{name}.png"
            make_below(folder, *picture.parent.relative_to(folder).parts)
            write_image(picture, colorize(result.disparity, matcher.min_disparity, matcher.max_disparity))
        # The range fits the format, as the command checks; a refiner may add a pixel.
        written = publish(folder, target, lambda path: write_disparity(path, result.disparity, clip=True))
        seconds = time.perf_counter() - start
        return Outcome(name, written, seconds=seconds, density=result.density, warnings=tuple(warnings))
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


def _masks(job: Job, shape: tuple[int, ...]) -> dict[str, NDArray[np.bool_]]:
    size = int(shape[0]), int(shape[1])
    masks = {
        name: _mask(name, path, size) for name, path in (("mask", job.mask), ("right_mask", job.right_mask)) if path
    }
    return {name: mask for name, mask in masks.items() if mask is not None}


@lru_cache(maxsize=4)
def _mask(name: str, path: str, size: tuple[int, int]) -> NDArray[np.bool_] | None:
    return read_mask(f"--{name.replace('_', '-')}", Path(path), size)


_matchers: dict[Job, Matcher] = {}
_rectifications: dict[tuple[Job, tuple[int, int]], Rectification] = {}
_lock = threading.Lock()


def matcher_of(job: Job) -> Matcher:
    """Return the job's matcher, one thread per call; the last one is cached."""
    with _lock:
        matcher = _matchers.get(job)
        if matcher is None:
            matcher = Matcher(job.method, threads=1, **dict(job.options))
            _matchers.clear()
            _matchers[job] = matcher
        return matcher


def rectification_of(job: Job, size: tuple[int, int]) -> Rectification:
    """Return what rectifies the job's images of a size, pixels; the last one is kept."""
    with _lock:
        rectification = _rectifications.get((job, size))
        if rectification is None:
            rectification = read_rig(*job.rig, size=size).rectification(alpha=job.alpha)
            _rectifications.clear()
            _rectifications[job, size] = rectification
        return rectification
