"""A stereo video as pairs: left and right side by side in one file, or one file for each camera; OpenCV decodes.

Frames are named by their number. They come one at a time and in order; unwanted frames are skipped without decoding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, InputError, OptionError
from stereokit.io import parsing, split_views
from stereokit.io.quiet import quiet_decoders

__all__ = ["FramePair", "Frames", "Video", "retrieve_images"]

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class FramePair:
    """One frame: its name and two images, (H, W, 3) uint8 RGB, or the reason why there is none."""

    name: str
    left: Image | None
    right: Image | None
    reason: str = ""


class Frames:
    """A source of pairs that come as images, one after the other.

    Attributes
    ----------
    expected : int or None
        How many there are, as far as the source tells; it may be wrong.
    """

    expected: int | None = None

    def frames(self, wanted: Callable[[str], bool] = lambda name: True) -> Iterator[FramePair]:
        """Yield the frames whose names are wanted."""
        raise NotImplementedError

    def owns(self, name: str) -> bool:
        """Return whether a frame of the source may have this name: here, a number."""
        return name.isdigit()


class Video(Frames):
    """A stereo video.

    Parameters
    ----------
    left : Path
        The left camera's video, or both side by side.
    right : Path or None
        The right camera's video.
    layout : str
        Where the views are in the one video; see `stereokit.io.LAYOUTS`.

    Raises
    ------
    FileError
        If a file cannot be opened.
    InputError
        If the two differ in size, or the one cannot be halved.
    """

    def __init__(self, left: Path, right: Path | None = None, layout: str = "side-by-side") -> None:
        self.paths = [left] if right is None else [left, right]
        captures = [_open(path) for path in self.paths]
        try:
            sizes = [tuple(int(c.get(p)) for p in (_WIDTH, _HEIGHT)) for c in captures]
            counts = [int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) for capture in captures]
        finally:
            for capture in captures:
                capture.release()
        for path, size in zip(self.paths, sizes, strict=True):
            if min(size) <= 0:
                raise FileError(f"{str(path)!r} is not a video that can be read")
        if len(set(sizes)) > 1:
            texts = " and ".join(f"{width}x{height}" for width, height in sizes)
            raise InputError(f"the two videos must have the same size, got {texts}")
        self.layout = layout
        if right is None:
            try:
                split_views(np.empty(sizes[0][::-1], np.bool_), layout)
            except OptionError as error:
                raise InputError(f"the video: {error}") from None
        self.expected: int | None = (
            min(counts) if min(counts) > 0 else None
        )  # by the files' headers, which may be wrong

    def frames(self, wanted: Callable[[str], bool] = lambda name: True) -> Iterator[FramePair]:
        """Yield the frames whose names are wanted; where one of two videos ends early, a last one has the reason."""
        captures = [_open(path) for path in self.paths]
        try:
            number = 0
            while True:
                name = f"{number:06d}"
                with quiet_decoders():
                    grabbed = [capture.grab() for capture in captures]
                if not all(grabbed):
                    if any(grabbed):
                        side = "left" if not grabbed[0] else "right"
                        yield FramePair(name, None, None, f"the {side} video ends before the other")
                    return
                if wanted(name):
                    yield _frame(name, captures, self.layout)
                number += 1
        finally:
            for capture in captures:
                capture.release()


_WIDTH, _HEIGHT = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT


def _open(path: Path) -> Any:
    if not path.exists():
        raise FileError(f"no such file: {str(path)!r}")
    with parsing(path, "video"), quiet_decoders():
        capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise FileError(f"{str(path)!r} is neither a folder, a list (.csv, .tsv, .txt) nor a video that can be read")
    return capture


def retrieve_images(captures: list[Any]) -> list[Image] | None:
    """Return the frames that the captures have grabbed, RGB or grey; None if one cannot be decoded."""
    images = []
    for capture in captures:
        with quiet_decoders():
            good, image = capture.retrieve()
        if not good or image is None:
            return None
        images.append(np.ascontiguousarray(image[:, :, ::-1] if image.ndim == 3 else image))
    return images


def _frame(name: str, captures: list[Any], layout: str) -> FramePair:
    images = retrieve_images(captures)
    if images is None:
        return FramePair(name, None, None, "the frame cannot be decoded")
    if len(images) == 1:
        images = list(split_views(images[0], layout))
    return FramePair(name, images[0], images[1])
