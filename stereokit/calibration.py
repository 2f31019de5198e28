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
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import FileError, InputError, OptionError

__all__ = ["Calibration", "read_calibration"]


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
        Principal point of the right camera, pixels; `cx0` when not given, and then stored as such.
    width, height : int, optional
        Size of the images, pixels. When given, maps of another size are refused.

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
                if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 1):
                    raise OptionError(f"{name} must be a positive whole number of pixels, got {value}")
            elif not math.isfinite(value):
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
            Metres along the optical axis, NaN where the disparity is invalid or says "beyond infinity"
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

    def points(self, disparity: ArrayLike) -> NDArray[np.float32]:
        """Return the point of every pixel in the left camera's frame: x right, y down, z forward.

        Parameters
        ----------
        disparity : (H, W) float
            Pixels, not finite where invalid.

        Returns
        -------
        (H, W, 3) float32
            Metres, NaN where there is no depth.

        Raises
        ------
        InputError
            If `disparity` is not a 2-d array of floats or has another size than the calibration.
        """
        depth = self.disparity_to_depth(disparity)
        height, width = depth.shape
        points = np.empty((height, width, 3), np.float32)
        points[..., 0] = depth * ((np.arange(width) - self.cx0) / self.fx).astype(np.float32)
        points[..., 1] = depth * ((np.arange(height) - self.cy) / self.fy).astype(np.float32)[:, None]
        points[..., 2] = depth
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
        """Refuse a map of `width` x `height` pixels if the calibration says that it is for another size.

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


def read_calibration(path: str | os.PathLike[str], cameras: tuple[int, int] = (2, 3)) -> Calibration:
    """Read a calibration file; its content tells which of the known forms it has.

    Parameters
    ----------
    path : path
        Middlebury or ETH3D ``calib.txt``, KITTI ``calib_cam_to_cam.txt`` or per-frame file, or a JSON object
        with ``fx``, ``fy``, ``cx0``, ``cy``, ``baseline_m`` and optionally ``cx1``, ``width``, ``height``.
    cameras : pair of int
        Left and right camera of a KITTI file: (2, 3) is the colour pair, (0, 1) the grey one.

    Raises
    ------
    FileError
        If the file is missing, has none of the known forms, or lacks a field.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise FileError(f"no such file: {str(path)!r}") from error
    except UnicodeDecodeError as error:
        raise FileError(f"{str(path)!r} is not a text file") from error
    except OSError as error:
        raise FileError(f"cannot read {str(path)!r}: {error.strerror or error}") from error
    try:
        if text.lstrip().startswith("{"):
            return _from_json(text)
        if re.search(r"^\s*\w+\s*=", text, re.MULTILINE):
            return _from_middlebury(dict(re.findall(r"^\s*(\w+)\s*=(.*)$", text, re.MULTILINE)))
        if re.search(r"^\s*\w+:", text, re.MULTILINE):
            return _from_kitti(dict(re.findall(r"^\s*(\w+):(.*)$", text, re.MULTILINE)), cameras)
    except KeyError as error:
        raise FileError(f"{str(path)!r} has no field {error.args[0]!r}") from error
    except (ValueError, OverflowError) as error:
        raise FileError(f"{str(path)!r}: {error}") from error
    raise FileError(f"{str(path)!r} is no calibration known here: Middlebury calib.txt, KITTI, or JSON")


def _from_json(text: str) -> Calibration:
    fields = {field.name: field.default is dataclasses.MISSING for field in dataclasses.fields(Calibration)}
    try:
        content: Any = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"not valid JSON, line {error.lineno}: {error.msg}") from error
    for name, value in content.items():
        if name not in fields:
            raise ValueError(f"unknown field {name!r}. Known: {', '.join(fields)}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{name} must be a number, got {value!r}")
    for name, needed in fields.items():
        if needed and name not in content:
            raise KeyError(name)
    return Calibration(**content)


def _numbers(lines: dict[str, str], name: str, count: int) -> list[float]:
    words = lines[name].translate(str.maketrans("[];,", "    ")).split()
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"{name} must hold {count} numbers, got {lines[name].strip()!r}") from error
    if len(values) != count:
        raise ValueError(f"{name} must hold {count} numbers, got {len(values)}")
    return values


def _size(lines: dict[str, str], name: str) -> int | None:
    return int(_numbers(lines, name, 1)[0]) if name in lines else None


def _from_middlebury(lines: dict[str, str]) -> Calibration:
    left = _numbers(lines, "cam0", 9)
    if "doffs" in lines or "cam1" not in lines:
        doffs = _numbers(lines, "doffs", 1)[0]
    else:
        doffs = _numbers(lines, "cam1", 9)[2] - left[2]
    return Calibration(
        fx=left[0],
        fy=left[4],
        cx0=left[2],
        cy=left[5],
        baseline_m=_numbers(lines, "baseline", 1)[0] / 1000,
        cx1=left[2] + doffs,
        width=_size(lines, "width"),
        height=_size(lines, "height"),
    )


def _from_kitti(lines: dict[str, str], cameras: tuple[int, int]) -> Calibration:
    raw = any(name.startswith("P_rect_") for name in lines)
    names = [f"P_rect_{camera:02d}" if raw else f"P{camera}" for camera in cameras]
    left, right = (_numbers(lines, name, 12) for name in names)
    baseline_m = right[3] / -right[0] - left[3] / -left[0] if left[0] and right[0] else math.nan
    if not baseline_m > 0:
        raise ValueError(f"{names[1]} must lie to the right of {names[0]}, got a baseline of {baseline_m} m")
    size = f"S_rect_{cameras[0]:02d}"
    width, height = _numbers(lines, size, 2) if raw and size in lines else (None, None)
    return Calibration(
        fx=left[0],
        fy=left[5],
        cx0=left[2],
        cy=left[6],
        baseline_m=baseline_m,
        cx1=right[2],
        width=None if width is None else int(width),
        height=None if height is None else int(height),
    )
