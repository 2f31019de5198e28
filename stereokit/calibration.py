"""From disparity to depth and points, for a rectified pair.

Both cameras share ``fx``, ``fy`` and ``cy``. With ``d = x_left - x_right`` and principal points ``cx0`` and
``cx1``, a point at depth ``Z`` obeys ``d + (cx1 - cx0) = fx * baseline_m / Z``; Middlebury calls the term in
brackets ``doffs``. ``Q`` is the same statement as the matrix of ``cv2.reprojectImageTo3D`` (Bradski and
Kaehler, Learning OpenCV, ch. 12).

Files: Middlebury ``calib.txt`` (2014 and later, ETH3D too; baseline in millimetres), KITTI
``calib_cam_to_cam.txt`` and per-frame files (``P = K [I | t]``; the devkit's ``b = -P[0, 3] / fx``), and a
plain JSON object.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import FileError, InputError, OptionError, UnknownNameError, did_you_mean
from stereokit.io import parsing, read_text
from stereokit.notices import warn

__all__ = ["FRAMES", "Calibration", "read_calibration"]

_CENTRE_PX, _SHARE = 0.5, 0.001
"""Tolerances of the shared values of rectified cameras: of principal points, pixels; of focal lengths, relative."""
_BASELINES_M = 0.001, 100.0
"""Range of baselines without a warning: others are mostly in another unit."""
_KINDS = "known are Middlebury's calib.txt, KITTI's files, and JSON with fx, fy, cx0, cy, baseline_m"
_OTHER_KINDS = {
    "an OpenCV calibration (YAML)": r"\A%YAML|!!opencv-matrix",
    "an OpenCV calibration (XML)": r"<opencv_storage>",
    "an OpenCV calibration (JSON)": r'"opencv-matrix"',
    "a ROS camera_info file": r"^[ \t]*(projection_matrix|distortion_model|camera_name)\s*:",
    "a Kalibr camchain": r"^[ \t]*(T_cn_cnm1|distortion_coeffs|rostopic)\s*:",
    "a BoofCV calibration": r"^[ \t]*leftToRight\s*:|boofcv",
    "a ZED settings file": r"^[ \t]*\[(LEFT|RIGHT|STEREO)(_CAM_\w+)?\]",
    "a calibration in XML": r"\A<",
    "a calibration of Cityscapes (JSON)": r'"(intrinsic|extrinsic)"\s*:',
    "a file of bare numbers, such as K.txt": r"\A[-+.\deE\s,;\[\]()]+\Z",
}
"""Kinds of files of other programs, each with the pattern that identifies it."""

FRAMES = {
    "optical": "x right, y down, z forward",
    "y-up": "x right, y up, z backward",
    "ros": "x forward, y left, z up",
}
"""Frames of points, and their axes: that of images and OpenCV; that of OpenGL, in which viewers show the scene upright;
and that of the body of a ROS robot (REP 103)."""


@dataclass(frozen=True)
class Calibration:
    """The geometry of a rectified pair.

    Parameters
    ----------
    fx, fy : float
        Focal lengths, pixels.
    cx0, cy : float
        Principal point of the left camera, pixels; the centre of the first pixel is (0, 0).
    baseline_m : float
        Distance between the cameras, metres.
    cx1 : float, optional
        Principal point of the right camera, pixels; `cx0` by default.
    width, height : int, optional
        Size of the images, pixels. If present, maps of another size are refused.

    Raises
    ------
    OptionError
        If a length is not positive or a number is not finite.
    """

    fx: float
    fy: float
    cx0: float
    cy: float
    baseline_m: float
    cx1: float | None = None
    width: int | None = None
    height: int | None = None

    def __post_init__(self) -> None:
        if self.cx1 is None:
            object.__setattr__(self, "cx1", self.cx0)
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            if name in ("width", "height"):
                if value is not None:
                    object.__setattr__(self, name, _pixels(name, value))
            elif not _is_finite(value):
                raise OptionError(f"{name} must be finite, got {value}")
            elif name in ("fx", "fy", "baseline_m") and value <= 0:
                raise OptionError(f"{name} must be positive, got {value}")

    @property
    def doffs(self) -> float:
        """Middlebury's disparity offset ``cx1 - cx0``, pixels."""
        return (self.cx0 if self.cx1 is None else self.cx1) - self.cx0

    @property
    def Q(self) -> NDArray[np.float64]:
        """The (4, 4) float64 matrix with which ``cv2.reprojectImageTo3D`` turns disparity into metres."""
        ratio = self.fx / self.fy
        return np.array(
            [
                [1, 0, 0, -self.cx0],
                [0, ratio, 0, -ratio * self.cy],
                [0, 0, 0, self.fx],
                [0, 0, 1 / self.baseline_m, self.doffs / self.baseline_m],
            ]
        )

    def disparity_to_depth(self, disparity: ArrayLike) -> NDArray[np.float32]:
        """Return the depth of every pixel of a disparity map.

        Parameters
        ----------
        disparity : (H, W) float
            Pixels, not finite where invalid.

        Returns
        -------
        (H, W) float32
            Metres along the optical axis, NaN where the disparity is invalid or of a point beyond infinity
            (``disparity + doffs <= 0``).

        Raises
        ------
        InputError
            If `disparity` is not a 2-d array of floats or has another size than the calibration.
        """
        values = np.asarray(disparity)
        if values.ndim != 2 or values.dtype.kind != "f":
            raise InputError(f"disparity must be (H, W) float, got {values.dtype} of shape {values.shape}")
        self.check_size(values.shape[1], values.shape[0])
        depth = np.full(values.shape, np.nan, np.float32)
        with np.errstate(over="ignore"):
            parallax = values.astype(np.float32) + np.float32(self.doffs)
            known = np.isfinite(parallax) & (parallax > 0)
            np.divide(np.float32(self.fx * self.baseline_m), parallax, out=depth, where=known)
        depth[np.isinf(depth)] = np.nan
        return depth

    def points(self, disparity: ArrayLike, frame: str = "optical") -> NDArray[np.float32]:
        """Return the point of every pixel in a frame of the left camera.

        Parameters
        ----------
        disparity : (H, W) float
            Pixels, not finite where invalid.
        frame : {"optical", "y-up", "ros"}
            The axes, see `FRAMES`: x right, y down, z forward; x right, y up, z backward; x forward, y left, z up.

        Returns
        -------
        (H, W, 3) float32
            Metres, NaN where there is no depth.

        Raises
        ------
        InputError
            If `disparity` is not a 2-d array of floats or has another size than the calibration.
        UnknownNameError
            If there is no such frame.
        """
        if not isinstance(frame, str) or frame not in FRAMES:
            raise UnknownNameError(did_you_mean("frame", frame, FRAMES))
        depth = self.disparity_to_depth(disparity)
        height, width = depth.shape
        points = np.empty((height, width, 3), np.float32)
        points[..., 0] = depth * ((np.arange(width) - self.cx0) / self.fx).astype(np.float32)
        points[..., 1] = depth * ((np.arange(height) - self.cy) / self.fy).astype(np.float32)[:, None]
        points[..., 2] = depth
        if frame == "y-up":
            points[..., 1:] *= -1
        elif frame == "ros":
            points = np.stack([points[..., 2], -points[..., 0], -points[..., 1]], axis=-1)
        return points

    def scaled(self, factor: float) -> Calibration:
        """Return the calibration of images resized by `factor`.

        Pixel areas map to pixel areas, as with ``cv2.resize``: ``x' + 0.5 = factor * (x + 0.5)``. Disparities
        scale by `factor` too; depths and points stay as they are.

        Raises
        ------
        OptionError
            If `factor` is not positive.
        """
        if not (math.isfinite(factor) and factor > 0):
            raise OptionError(f"factor must be positive, got {factor}")

        def position(center: float) -> float:
            return (center + 0.5) * factor - 0.5

        return Calibration(
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx0=position(self.cx0),
            cy=position(self.cy),
            baseline_m=self.baseline_m,
            cx1=position(self.cx0 + self.doffs),
            width=None if self.width is None else max(1, round(self.width * factor)),
            height=None if self.height is None else max(1, round(self.height * factor)),
        )

    def check_size(self, width: int, height: int) -> None:
        """Refuse a map of `width` x `height` pixels if the calibration is for another size.

        Raises
        ------
        InputError
            If the size is known and differs.
        """
        if (self.width or width, self.height or height) != (width, height):
            raise InputError(
                f"calibration is for {self.width}x{self.height} pixels, got a map of {width}x{height}; "
                "use Calibration.scaled for resized images"
            )


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond floating point
        return False


def _pixels(name: str, value: float) -> int:
    """Return a size as a whole number; files and arrays may have it as 640.0."""
    if isinstance(value, bool) or not _is_finite(value) or value != int(value) or value < 1:
        raise OptionError(f"{name} must be a positive whole number of pixels, got {value}")
    return int(value)


def read_calibration(
    path: str | os.PathLike[str], cameras: tuple[int, int] = (2, 3), size: tuple[int, int] | None = None
) -> Calibration:
    """Read a calibration file; the format is recognised by the content.

    Parameters
    ----------
    path : path
        Middlebury or ETH3D ``calib.txt``, KITTI ``calib_cam_to_cam.txt`` or per-frame file, or a JSON object
        with ``fx``, ``fy``, ``cx0``, ``cy``, ``baseline_m`` and optionally ``cx1``, ``width``, ``height``.
    cameras : pair of int
        Left and right camera of a KITTI file: (2, 3) is the colour pair, (0, 1) the grey one.
    size : pair of int or None
        Width and height of the images, pixels.

    Warns
    -----
    StereokitWarning
        If the baseline is under 1 mm or over 100 m, or the principal point lies outside of the image.

    Raises
    ------
    InputError
        If it is for images of another `size`.
    FileError
        If the file is missing, is of no known format, lacks a field, or contradicts itself: the two cameras of a
        rectified pair share fx, fy and cy, have no skew, and ``doffs`` is the difference of their cx.
    """
    camera = _read(path, cameras)
    if size is not None:
        camera.check_size(*size)
    if not _BASELINES_M[0] <= camera.baseline_m <= _BASELINES_M[1]:
        warn(f"{str(path)!r} has a baseline of {camera.baseline_m:g} m: is it in the unit that it should be in?")
    width, height = size or (camera.width, camera.height)
    for name, center, pixels in (("cx0", camera.cx0, width), ("cy", camera.cy, height)):
        if pixels is not None and not -0.5 <= center <= pixels - 0.5:
            warn(f"{str(path)!r} has its principal point outside of the image: {name} is {center:g} of {pixels} pixels")
    return camera


def _read(path: str | os.PathLike[str], cameras: tuple[int, int]) -> Calibration:
    text = read_text(path, "calibration")
    with parsing(path, "calibration"):
        if other := _other_kind(text):
            raise FileError(f"{str(path)!r} looks like {other}, which is not read; {_KINDS}")
        if text.lstrip().startswith("{"):
            return _from_json(text)
        if re.search(r"^[ \t]*\w+[ \t]*=", text, re.MULTILINE):
            return _from_middlebury(dict(re.findall(r"^[ \t]*(\w+)[ \t]*=(.*)$", text, re.MULTILINE)))
        if re.search(r"^[ \t]*\w+:", text, re.MULTILINE):
            return _from_kitti(dict(re.findall(r"^[ \t]*(\w+):(.*)$", text, re.MULTILINE)), cameras)
    raise FileError(f"{str(path)!r} is no calibration known here; {_KINDS}")


def _other_kind(text: str) -> str | None:
    """Return the kind of another program's file, with its article, or None if it is of no known kind."""
    start = text.lstrip()
    for kind, pattern in _OTHER_KINDS.items():
        if re.search(pattern, start, re.MULTILINE):
            return kind
    return None


def _from_json(text: str) -> Calibration:
    fields = {field.name: field.default is dataclasses.MISSING for field in dataclasses.fields(Calibration)}
    try:
        content: Any = json.loads(text)
    except json.JSONDecodeError as error:
        raise OptionError(f"not valid JSON, line {error.lineno}: {error.msg}") from error
    for name, value in content.items():
        if name not in fields:
            raise OptionError(f"unknown field {name!r}. Known: {', '.join(fields)}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise OptionError(f"{name} must be a number, got {value!r}")
    missing = [name for name, needed in fields.items() if needed and name not in content]
    if missing:
        raise OptionError(f"it has no field {missing[0]!r}, which a calibration in JSON has")
    return Calibration(**content)


def _numbers(lines: dict[str, str], name: str, count: int, kind: str) -> list[float]:
    if name not in lines:
        raise OptionError(f"it has no field {name!r}, which {kind} has; {_KINDS}")
    words = lines[name].translate(str.maketrans("[];,", "    ")).split()
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise OptionError(f"{name} must hold {count} numbers, got {lines[name].strip()!r}") from error
    if len(values) != count:
        raise OptionError(f"{name} must hold {count} numbers, got {len(values)}")
    if not all(map(math.isfinite, values)):
        raise OptionError(f"{name} must hold finite numbers, got {lines[name].strip()!r}")
    return values


def _from_middlebury(lines: dict[str, str]) -> Calibration:
    kind = "a Middlebury calib.txt"
    left = _numbers(lines, "cam0", 9, kind)
    _check_pinhole("cam0", left[0], left[1], left[3], left[6:])
    right = None
    if "cam1" in lines:
        right = _numbers(lines, "cam1", 9, kind)
        _check_pinhole("cam1", right[0], right[1], right[3], right[6:])
        _check_rectified("cam0", (left[0], left[4], left[5]), "cam1", (right[0], right[4], right[5]))
    if right is None or "doffs" in lines:
        doffs = _numbers(lines, "doffs", 1, kind)[0]
    else:
        doffs = right[2] - left[2]
    if right is not None and abs(doffs - (right[2] - left[2])) > _CENTRE_PX:
        raise OptionError(f"doffs is {doffs:g}, but cam0 and cam1 say {right[2] - left[2]:g} (cx1 - cx0)")
    return Calibration(
        fx=left[0],
        fy=left[4],
        cx0=left[2],
        cy=left[5],
        baseline_m=_numbers(lines, "baseline", 1, kind)[0] / 1000,
        cx1=left[2] + doffs,
        **{name: _numbers(lines, name, 1, kind)[0] for name in ("width", "height") if name in lines},  # type: ignore[arg-type]
    )


def _from_kitti(lines: dict[str, str], cameras: tuple[int, int]) -> Calibration:
    raw = any(name.startswith("P_rect_") for name in lines)
    names = [f"P_rect_{camera:02d}" if raw else f"P{camera}" for camera in cameras]
    left, right = (_numbers(lines, name, 12, "a KITTI calibration") for name in names)
    for name, matrix in zip(names, (left, right), strict=True):
        _check_pinhole(name, matrix[0], matrix[1], matrix[4], matrix[8:11])
    _check_rectified(names[0], (left[0], left[5], left[6]), names[1], (right[0], right[5], right[6]))
    baseline_m = right[3] / -right[0] - left[3] / -left[0]
    if not baseline_m > 0:
        raise OptionError(f"{names[1]} must lie to the right of {names[0]}, got a baseline of {baseline_m} m")
    size = f"S_rect_{cameras[0]:02d}"
    width, height = _numbers(lines, size, 2, "a KITTI calibration") if raw and size in lines else (None, None)
    return Calibration(
        fx=left[0],
        fy=left[5],
        cx0=left[2],
        cy=left[6],
        baseline_m=baseline_m,
        cx1=right[2],
        width=width,  # type: ignore[arg-type]
        height=height,  # type: ignore[arg-type]
    )


def _check_pinhole(name: str, focal: float, skew: float, below: float, last: list[float]) -> None:
    """Refuse a camera matrix with more than a focal length and a principal point."""
    if not focal > 0:
        raise OptionError(f"{name} must begin with a positive focal length, got {focal:g}")
    if abs(skew) > _CENTRE_PX:
        raise OptionError(f"{name} must be of a rectified camera, without skew, got a skew of {skew:g}")
    if abs(below) > _CENTRE_PX or max(abs(a - b) for a, b in zip(last, (0, 0, 1), strict=True)) > _SHARE:
        raise OptionError(f"{name} must be a camera matrix, with 0 below its focal length and a last row of 0 0 1")


def _check_rectified(
    left: str, left_values: tuple[float, float, float], right: str, right_values: tuple[float, float, float]
) -> None:
    """Refuse two cameras that differ in the values that rectified ones share: fx, fy and cy."""
    for name, a, b in zip(("fx", "fy", "cy"), left_values, right_values, strict=True):
        if abs(a - b) > (_CENTRE_PX if name == "cy" else _SHARE * abs(a)):
            raise OptionError(f"{left} and {right} must share {name}, as rectified cameras do, got {a:g} and {b:g}")
