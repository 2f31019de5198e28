"""What a calibration file says, whatever its format, and the rules that all of them obey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError, shown

__all__ = [
    "CENTRE_PX",
    "UNITS",
    "Array",
    "Content",
    "Lens",
    "PartialSize",
    "Size",
    "check_pinhole",
    "check_projections",
    "check_rectified",
    "lens",
    "matrix",
    "numbers",
    "projection",
    "vector",
]

Array = NDArray[np.float64]
Size = tuple[int, int]
PartialSize = tuple["int | None", "int | None"]

CENTRE_PX, FOCAL_SHARE = 0.5, 0.001
"""How far what rectified cameras share may differ: principal points in pixels, focal lengths as a share of them."""
_BASELINE_SHARE = 0.02
"""How far two statements of the baseline in one file may differ."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Metres of the units of length that files may have."""
_NOT_FINITE = {".Nan": "nan", ".Inf": "inf", "-.Inf": "-inf"}  # as OpenCV writes them
_PINHOLE = (0, 4, 5, 8, 12, 14)
_PINHOLE_NAMES = frozenset(
    "pinhole perspective radtan radialtangential plumbbob brown brownconrady rationalpolynomial rational thinprism "
    "tilted none opencv polynomial".split()
)
_FISHEYE_NAMES = frozenset("equidistant equi fisheye kannalabrandt kannalabrandt4 opencvfisheye kb4".split())


@dataclass(frozen=True)
class Lens:
    """A raw camera.

    Attributes
    ----------
    matrix : (3, 3) float64
        Focal lengths and principal point, pixels.
    distortion : (n,) float64
        OpenCV's coefficients: k1 k2 p1 p2 k3 ... of a pinhole camera, k1 to k4 of a fisheye.
    model : {"pinhole", "fisheye"}
    size : (width, height) or None
        Of the images, pixels.
    """

    matrix: Array
    distortion: Array
    model: str = "pinhole"
    size: Size | None = None


@dataclass(frozen=True)
class Content:
    """What a file says of a pair; None where it says nothing.

    Attributes
    ----------
    kind : str
        What the file is, with its article.
    lenses : (left, right) of Lens or None
        The raw cameras.
    pose : (rotation, translation) or None
        Takes a point from the left raw camera's frame to the right one's, as OpenCV's R and T.
    projections : (left, right) of (3, 4) or None
        Of the rectified cameras, as OpenCV's P1 and P2.
    turns : (left, right) of (3, 3) or None
        Of the raw cameras into the rectified ones, as OpenCV's R1 and R2.
    size : (width, height) or None
        Of the rectified images, pixels, where it is told on its own; either may be None.
    unit : str or None
        Of `pose` and `projections`, one of `UNITS`; None if neither format nor file says.
    names : (left, right)
        What the file calls the two cameras.
    """

    kind: str
    lenses: tuple[Lens, Lens] | None = None
    pose: tuple[Array, Array] | None = None
    projections: tuple[Array, Array] | None = None
    turns: tuple[Array, Array] | None = None
    size: PartialSize | None = None
    unit: str | None = None
    names: tuple[str, str] = field(default=("left", "right"))

    @property
    def baseline(self) -> float | None:
        """Of the pose or else the projections, in the file's unit."""
        if self.pose is not None:
            return float(np.linalg.norm(self.pose[1]))
        if self.projections is None or not all(camera[0, 0] > 0 for camera in self.projections):
            return None
        return abs(_baseline(*self.projections))

    def scaled(self, factor: float) -> Content:
        """Return it with all lengths times `factor`."""
        pose, projections = self.pose, self.projections
        if pose is not None:
            pose = pose[0], pose[1] * factor
        if projections is not None:
            scale = np.array([1, 1, 1, factor])
            projections = projections[0] * scale, projections[1] * scale
        return replace(self, pose=pose, projections=projections)


def _baseline(left: Array, right: Array) -> float:
    return float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0])


def numbers(name: str, value: Any) -> Array:
    """Return what a file holds, nested lists of numbers or of their words, as one row.

    Raises
    ------
    OptionError
        If something else is in it, a number is not finite, or there are more than any calibration has.
    """
    values: list[float] = []
    waiting: list[Any] = [value]
    steps = 0
    while waiting:
        steps += 1
        item = waiting.pop()
        if isinstance(item, np.ndarray):
            item = item.tolist()
        if isinstance(item, list | tuple):
            waiting.extend(reversed(item))
        elif isinstance(item, bool):
            raise OptionError(f"{name} must hold numbers, got {item}")
        else:
            try:
                values.append(float(_NOT_FINITE.get(item, item) if isinstance(item, str) else item))
            except (TypeError, ValueError, OverflowError) as error:
                raise OptionError(f"{name} must hold numbers, got {shown(item)}") from error
        if steps > 4096:
            raise OptionError(f"{name} holds more numbers than a calibration has")
    array = np.array(values, np.float64)
    if not np.isfinite(array).all():
        raise OptionError(f"{name} must hold finite numbers, got {shown(value)}")
    return array


def vector(name: str, value: Any, *counts: int) -> Array:
    """Return the numbers that a file holds under a name, of which there must be one of `counts`.

    Raises
    ------
    OptionError
        If there are not.
    """
    values = numbers(name, value)
    if counts and len(values) not in counts:
        rule = " or ".join(map(str, counts))
        raise OptionError(f"{name} must hold {rule} numbers, got {len(values)}")
    return values


def matrix(name: str, value: Any, rows: int, columns: int) -> Array:
    """Return the matrix that a file holds under a name.

    Raises
    ------
    OptionError
        If it has another size.
    """
    return vector(name, value, rows * columns).reshape(rows, columns)


def lens(
    names: tuple[str, str], camera: Any, distortion: Any, model: str | None = None, size: Size | None = None
) -> Lens:
    """Return a raw camera, checked.

    Parameters
    ----------
    names : (camera, distortion)
        What the file calls its matrix and its coefficients.
    camera : (3, 3), or fx fy cx cy
    distortion : numbers or None
    model : str or None
        The file's word for it; None is a pinhole camera.
    size : (width, height) or None

    Raises
    ------
    OptionError
        If a number is wrong, or the model is none of pinhole and equidistant fisheye.
    """
    values = vector(names[0], camera, 9, 4)
    if len(values) == 4:
        fx, fy, cx, cy = values
        values = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    square = values.reshape(3, 3)
    check_pinhole(names[0], square)
    kind = model_of(model)
    coefficients = np.zeros(0) if distortion is None else vector(names[1], distortion)
    known = (4,) if kind == "fisheye" else _PINHOLE
    if len(coefficients) not in (0, *known):
        extra = coefficients[max(known) :] if len(coefficients) > max(known) else np.ones(1)
        if extra.any() or kind == "fisheye":
            rule = ", ".join(map(str, known))
            raise OptionError(f"{names[1]} of a {kind} camera must hold {rule} numbers, got {len(coefficients)}")
        coefficients = coefficients[: max(known)]
    if kind == "fisheye" and not len(coefficients):
        coefficients = np.zeros(4)
    return Lens(square, coefficients, kind, size)


def model_of(word: str | None) -> str:
    """Return ``"pinhole"`` or ``"fisheye"`` for a format's word for a model.

    Raises
    ------
    OptionError
        If it is another.
    """
    plain = "".join(c for c in str(word or "pinhole").lower() if c.isalnum())
    if plain in _FISHEYE_NAMES:
        return "fisheye"
    if plain in _PINHOLE_NAMES:
        return "pinhole"
    raise OptionError(f"the camera model must be pinhole (radtan, plumb_bob) or equidistant fisheye, got {shown(word)}")


def check_pinhole(name: str, camera: Array) -> None:
    """Refuse a camera matrix that says more than focal lengths and a principal point.

    Raises
    ------
    OptionError
        If it does.
    """
    focal = camera[0, 0] if not camera[0, 0] > 0 else camera[1, 1]
    if not focal > 0:
        raise OptionError(f"{name} must begin with a positive focal length, got {focal:g}")
    if abs(camera[0, 1]) > CENTRE_PX:
        raise OptionError(f"{name} must be of a camera without skew, got a skew of {camera[0, 1]:g}")
    if abs(camera[1, 0]) > CENTRE_PX or np.abs(camera[2, :3] - (0, 0, 1)).max() > FOCAL_SHARE:
        raise OptionError(f"{name} must be a camera matrix, with 0 below its focal length and a last row of 0 0 1")


def check_rectified(names: Sequence[str], left: Array, right: Array) -> None:
    """Refuse two cameras that differ in what rectified ones share: fx, fy and cy.

    Raises
    ------
    OptionError
        If they do.
    """
    for name, row, column in (("fx", 0, 0), ("fy", 1, 1), ("cy", 1, 2)):
        a, b = left[row, column], right[row, column]
        if abs(a - b) > (CENTRE_PX if name == "cy" else FOCAL_SHARE * abs(a)):
            raise OptionError(
                f"{names[0]} and {names[1]} must share {name}, as rectified cameras do, got {a:g} and {b:g}"
            )


def check_projections(content: Content) -> float:
    """Return the baseline of the two rectified cameras that a file holds, in its unit.

    Raises
    ------
    OptionError
        If they do not share fx, fy and cy, are exchanged or above each other, or contradict the translation.
    """
    assert content.projections is not None
    left, right = content.projections
    names = content.names
    for name, one in zip(names, (left, right), strict=True):
        check_pinhole(name, one)
    down = abs(right[1, 3] / right[1, 1] - left[1, 3] / left[1, 1])
    baseline = _baseline(left, right)
    if down > 0.2 * abs(baseline):
        raise OptionError(
            f"{names[0]} and {names[1]} must be side by side, but one is above the other; "
            "turn the images by 90 degrees and calibrate those"
        )
    check_rectified(names, left, right)
    if not baseline > 0:
        hint = ": left and right are exchanged" if baseline < 0 else ""
        raise OptionError(f"{names[1]} must lie to the right of {names[0]}, got a baseline of {baseline:g}{hint}")
    if content.pose is not None:
        length = float(np.linalg.norm(content.pose[1]))
        if abs(length - baseline) > _BASELINE_SHARE * baseline:
            raise OptionError(
                f"T is {length:g} long, but {names[0]} and {names[1]} have a baseline of {baseline:g}: "
                "one of them is of another calibration or in another unit"
            )
    return baseline


def projection(fx: float, fy: float, cx: float, cy: float, baseline: float = 0.0) -> Array:
    """Return the (3, 4) projection of a rectified camera `baseline` to the right of the left one."""
    return np.array([[fx, 0, cx, -fx * baseline], [0, fy, cy, 0], [0, 0, 1, 0]], np.float64)
