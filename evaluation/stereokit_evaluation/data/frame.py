"""One stereo pair with its ground truth, loaded on demand, and the selection of pairs by name or number."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.calibration import Calibration
from stereokit.errors import OptionError
from stereokit.io import read_image, read_pair

__all__ = ["Benchmark", "Frame", "Loader", "select_frames"]

Loader = Callable[[], NDArray[Any]]
"""A function without arguments that returns an image or a map."""


@dataclass(frozen=True)
class Benchmark:
    """The benchmark whose own rules score a pair too.

    Parameters
    ----------
    name : {"middlebury", "eth3d"}
    integer : bool
        The true disparities are whole pixels.
    """

    name: str
    integer: bool = False


@dataclass(frozen=True)
class Frame:
    """One stereo pair with its ground truth and calibration.

    Parameters
    ----------
    name : str
        Unique in its data set.
    left, right : Path or callable
        The images: a file, or a function that returns the array.
    noc, occ, objects : callable, optional
        Functions that return the true disparity of the pixels that both cameras see, of all pixels, and the
        object map; None where there is none.
    max_disparity : int, optional
        Disparities to search for this pair, None if the data set has no number.
    calibration : callable, optional
        Function that returns the cameras' geometry; None where it is not known.
    scene : str, optional
        The scene or drive that the pair is of: pairs of one scene are not independent. The name by default.
    benchmark : Benchmark, optional
        The benchmark that it belongs to, if that has rules of its own.
    """

    name: str
    left: Path | Loader
    right: Path | Loader
    noc: Loader | None = None
    occ: Loader | None = None
    objects: Loader | None = None
    max_disparity: int | None = None
    calibration: Callable[[], Calibration] | None = None
    scene: str | None = None
    benchmark: Benchmark | None = None

    def load_left(self, *, gray: bool = False) -> NDArray[Any]:
        """Return the left image, (H, W) or (H, W, 3) RGB, in its stored type."""
        return _image(self.left, gray)

    def load_right(self, *, gray: bool = False) -> NDArray[Any]:
        """Return the right image, as `load_left`."""
        return _image(self.right, gray)

    def load_pair(self, *, gray: bool = False) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return both images, as `load_left`; warn where the orientation tags of two files differ."""
        if isinstance(self.left, Path) and isinstance(self.right, Path):
            return read_pair(self.left, self.right, gray)
        return self.load_left(gray=gray), self.load_right(gray=gray)

    def load_noc(self) -> NDArray[np.float32] | None:
        """Return the disparity of pixels that both cameras see, float32 (H, W), NaN unknown, or None."""
        return None if self.noc is None else self.noc()

    def load_occ(self) -> NDArray[np.float32] | None:
        """Return the disparity of all pixels, float32 (H, W), NaN unknown, or None."""
        return None if self.occ is None else self.occ()

    def load_objects(self) -> NDArray[Any] | None:
        """Return the object map, (H, W) integers, 0 background, or None."""
        return None if self.objects is None else self.objects()

    def load_calibration(self) -> Calibration | None:
        """Return the geometry that turns disparity into depth, or None."""
        return None if self.calibration is None else self.calibration()


def select_frames(frames: Iterable[Frame], selection: str | None) -> list[Frame]:
    """Return the frames of a list such as ``"0-3,34-40"`` or ``"cones,teddy"``, in their own order.

    A part is the name of a frame (or the last part of it), or a number or range of numbers, both ends
    included, compared with the number at the end of the name; the ``_10`` of KITTI does not count.

    Raises
    ------
    OptionError
        If a part is empty, a range runs backwards, or a part matches no frame.
    """
    all_frames = list(frames)
    if selection is None:
        return all_frames
    names: set[str] = set()
    for part in (text.strip() for text in selection.split(",")):
        matches = {f.name for f in all_frames if part and part in (f.name, f.name.rpartition("/")[2])}
        if not matches and (match := re.fullmatch(r"([0-9]{1,18})(?:-([0-9]{1,18}))?", part)):
            first, last = int(match[1]), int(match[2] or match[1])
            if last < first:
                raise OptionError(f"frames must be ranges with the smaller number first, got {part!r}")
            matches = {
                f.name for f in all_frames if (number := _number(f.name)) is not None and first <= number <= last
            }
        if not matches:
            known = ", ".join(f.name for f in all_frames[:3])
            raise OptionError(f"frames must be in the data set ({known} ...), got {part!r}")
        names |= matches
    return [frame for frame in all_frames if frame.name in names]


def _number(name: str) -> int | None:
    match = re.search(r"([0-9]{1,18})_1[01]$", name) or re.search(r"([0-9]{1,18})$", name)
    return int(match[1]) if match else None


def _image(source: Path | Loader, gray: bool) -> NDArray[Any]:
    if isinstance(source, Path):
        return read_image(source, gray=gray)
    image = source()
    if gray and image.ndim == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    return image
