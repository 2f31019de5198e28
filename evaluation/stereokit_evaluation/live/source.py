"""Sources of live frames: cameras, videos and folders of pairs. Each hands out the newest frame, never a late one.

A camera or a video has both views side by side, or there are two of them. What is not recorded live plays at its own
speed: frames whose time has passed are counted as dropped and are not decoded.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, Protocol

import cv2
from numpy.typing import NDArray

from stereokit.errors import FileError, InputError, OptionError
from stereokit.io import read_pair, split_views
from stereokit.io.quiet import quiet_decoders
from stereokit_evaluation.batch.pairs import folder_pairs, folders_pairs
from stereokit_evaluation.batch.video import Video, retrieve_images

__all__ = ["Cameras", "Folder", "Frame", "Recording", "Source", "open_source"]

_DEFAULT_RATE = 30.0
_RATES = (1.0, 240.0)


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame: its number in the source, and two images, (H, W) or (H, W, 3) uint8 RGB."""

    number: int
    left: NDArray[Any]
    right: NDArray[Any]


class Source(Protocol):
    """A source of frames; one thread reads it."""

    dropped: int
    """Frames that were passed over so far."""

    def newest(self) -> Frame | None:
        """Return the newest frame, after waiting for it; None at the end.

        Raises
        ------
        InputError, FileError
            If a frame cannot be read.
        """
        ...

    def close(self) -> None:
        """Let files and cameras go, and end a wait."""
        ...


class _Clock:
    """The number of the frame that is due."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.closed = Event()
        self._begin: float | None = None

    def due(self, first: int) -> int:
        """Wait until frame `first` is due; return the number of the newest one that is."""
        now = time.monotonic()
        if self._begin is None:
            self._begin = now
        self.closed.wait(max(0.0, self._begin + first / self.rate - now))
        return max(first, int((time.monotonic() - self._begin) * self.rate))


class Recording:
    """A video of both views side by side, or two videos, at their own speed.

    Parameters
    ----------
    left : Path
    right : Path or None
    rate : float or None
        Frames per second; None takes the file's.
    repeat : bool
        Begin again at the end.
    """

    def __init__(self, left: Path, right: Path | None = None, rate: float | None = None, repeat: bool = False) -> None:
        Video(left, right)  # checks both
        self.dropped = 0
        self._paths = [left] if right is None else [left, right]
        self._captures = self._open()
        self._repeat = repeat
        self._next = 0
        self._first = 0  # frames of the rounds before this one
        self._clock = _Clock(rate or _rate(self._captures[0]))

    def _open(self) -> list[Any]:
        with quiet_decoders():
            return [cv2.VideoCapture(str(path)) for path in self._paths]

    def newest(self) -> Frame | None:
        """Return the newest frame, after waiting for it; None at the end."""
        wanted = self._clock.due(self._next)
        while not self._clock.closed.is_set():
            with quiet_decoders():
                advanced = all([capture.grab() for capture in self._captures])
            if not advanced:
                if not self._repeat or self._next == self._first:
                    return None
                self.close_captures()
                self._captures = self._open()
                self._first = self._next
                continue
            number = self._next
            self._next += 1
            if number >= wanted:
                return _decoded(number, self._captures)
            self.dropped += 1
        return None

    def close_captures(self) -> None:
        """Let the files go."""
        for capture in self._captures:
            capture.release()

    def close(self) -> None:
        """End a wait; `newest` returns None then."""
        self._clock.closed.set()


class Cameras:
    """One camera with both views side by side, or two cameras, by their numbers.

    Parameters
    ----------
    numbers : one or two int

    Raises
    ------
    InputError
        If a camera cannot be opened.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        self.dropped = 0
        self._next = 0
        self._closed = Event()
        self._captures: list[Any] = []
        for number in numbers:
            with quiet_decoders():
                capture = cv2.VideoCapture(number)
            self._captures.append(capture)
            if not capture.isOpened():
                self.close_captures()
                raise InputError(f"camera {number} cannot be opened")
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # a queue of old frames would be lag

    def newest(self) -> Frame | None:
        """Return the newest frame; None once closed."""
        if self._closed.is_set():
            return None
        if not all([capture.grab() for capture in self._captures]):  # both first: the views belong together
            raise InputError("a camera gives no more frames")
        self._next += 1
        return _decoded(self._next - 1, self._captures)

    def close_captures(self) -> None:
        """Let the cameras go."""
        for capture in self._captures:
            capture.release()

    def close(self) -> None:
        """End the source."""
        self._closed.set()


class Folder:
    """Pairs of image files at a given speed, in the order of their names.

    Parameters
    ----------
    left : Path
        A folder with pairs, or with left images.
    right : Path or None
        The folder with right images.
    rate : float
        Frames per second.
    repeat : bool
        Begin again at the end.
    """

    def __init__(self, left: Path, right: Path | None = None, rate: float = 10.0, repeat: bool = False) -> None:
        self.dropped = 0
        self._pairs = folder_pairs(left) if right is None else folders_pairs(left, right)
        self._repeat = repeat
        self._next = 0
        self._clock = _Clock(rate)

    def newest(self) -> Frame | None:
        """Return the newest pair, after waiting for it; None at the end."""
        wanted = self._clock.due(self._next)
        last = len(self._pairs) - 1
        if not self._repeat:
            if self._next > last:
                return None
            wanted = min(wanted, last)
        if self._clock.closed.is_set():
            return None
        self.dropped += wanted - self._next
        self._next = wanted + 1
        pair = self._pairs[wanted % len(self._pairs)]
        if pair.left is None or pair.right is None:
            raise InputError(f"pair {pair.name!r}: {pair.reason}")
        return Frame(wanted, *read_pair(pair.left, pair.right))

    def close(self) -> None:
        """End a wait; `newest` returns None then."""
        self._clock.closed.set()


def open_source(inputs: Sequence[str], rate: float | None = None, repeat: bool = False) -> Source:
    """Return the source that inputs of the command line name.

    Parameters
    ----------
    inputs : one or two str
        Camera numbers, videos, or folders.
    rate : float or None
        Frames per second of a folder or video; None takes the video's own, and 10 for a folder.
    repeat : bool
        Begin again at the end.

    Raises
    ------
    OptionError, InputError, FileError
        If there are none or too many, they are of two kinds, or one cannot be opened.
    """
    if len(inputs) not in (1, 2):
        raise OptionError(f"live takes one or two sources, got {len(inputs)}")
    if rate is not None and not _RATES[0] / 10 <= rate <= _RATES[1]:
        raise OptionError(f"--fps must be from {_RATES[0] / 10:g} to {_RATES[1]:g}, got {rate:g}")
    if all(text.isdecimal() for text in inputs):
        return Cameras([int(text) for text in inputs])
    paths = [Path(text) for text in inputs]
    for path in paths:
        if not path.exists():
            raise FileError(f"no such camera number, video or folder: {str(path)!r}")
    if len({path.is_dir() for path in paths}) > 1:
        raise OptionError("two sources must be of one kind, got a folder and a file")
    left, right = paths[0], paths[1] if len(paths) == 2 else None
    if left.is_dir():
        return Folder(left, right, rate or 10.0, repeat)
    return Recording(left, right, rate, repeat)


def _rate(capture: Any) -> float:
    rate = float(capture.get(cv2.CAP_PROP_FPS))
    return rate if _RATES[0] <= rate <= _RATES[1] else _DEFAULT_RATE


def _decoded(number: int, captures: list[Any]) -> Frame:
    images = retrieve_images(captures)
    if images is None:
        raise InputError(f"frame {number} cannot be decoded")
    if len(images) == 1:
        half = images[0].shape[1] // 2  # of an odd width, as a camera may have, the last column is left out
        images = list(split_views(images[0][:, : 2 * half], "side-by-side"))
    return Frame(number, images[0], images[1])
