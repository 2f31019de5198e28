"""From disparity to depth and points, for a rectified pair.

Both cameras share ``fx``, ``fy`` and ``cy``. With ``d = x_left - x_right`` and principal points ``cx0`` and
``cx1``, a point at depth ``Z`` obeys ``d + (cx1 - cx0) = fx * baseline_m / Z``; Middlebury calls the term in
brackets ``doffs``. ``Q`` is the same statement as the matrix of ``cv2.reprojectImageTo3D`` (Bradski and
Kaehler, Learning OpenCV, ch. 12).

Files of other programs are read by `stereokit.io.calibrations`; here they must be of a rectified pair.
"""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import FileError, InputError, OptionError, UnknownNameError, did_you_mean
from stereokit.io import parsing
from stereokit.io.calibrations import Content, check_projections, read_content
from stereokit.io.calibrations.dispatch import name_of
from stereokit.io.calibrations.units import in_metres
from stereokit.notices import warn

__all__ = ["FRAMES", "Calibration", "read_calibration"]

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
    path: str | os.PathLike[str],
    cameras: tuple[int, int] | None = None,
    size: tuple[int, int] | None = None,
    *,
    right: str | os.PathLike[str] | None = None,
    unit: str | None = None,
) -> Calibration:
    """Read the calibration file of a rectified pair; its content identifies the format.

    Parameters
    ----------
    path : path
        Middlebury or ETH3D ``calib.txt``; KITTI ``calib_cam_to_cam.txt`` or per-frame file; OpenCV's YAML, XML or JSON
        with P1 and P2, or Q; the left of two ROS camera_info files; K.txt with a baseline; a JSON object with ``fx``,
        ``fy``, ``cx0``, ``cy``, ``baseline_m`` and optionally ``cx1``, ``width``, ``height``; a folder with such files.
    cameras : pair of int or None
        Left and right camera of a KITTI file: (2, 3), the default, is the colour pair, (0, 1) the grey one.
    size : pair of int or None
        Expected width and height of the images, pixels.
    right : path or None
        The second of two files, such as ROS's right.yaml.
    unit : {"m", "cm", "mm", "in"} or None
        Unit of the lengths in the file. None is that of the file or format, or else metres; without either, a baseline
        of 10 or more is taken for millimetres, with a warning.

    Warns
    -----
    StereokitWarning
        If the baseline is under 1 mm or over 100 m or in a doubtful unit, or the principal point lies outside of the
        image.

    Raises
    ------
    InputError
        If it is for images of another `size`.
    FileError
        If the file is missing, of an unknown format, of raw cameras (`stereokit.read_rig` reads those), incomplete or
        contradictory: the two cameras of a rectified pair share fx, fy and cy, have no skew, and ``doffs`` is the
        difference of their cx.
    """
    paths = [path] if right is None else [path, right]
    name = name_of(paths)
    content = in_metres(read_content(paths, cameras, size), unit, name)
    with parsing(name, "calibration"):
        camera = _rectified(content, name)
    if size is not None:
        camera.check_size(*size)
    width, height = size or (camera.width, camera.height)
    for field, center, pixels in (("cx0", camera.cx0, width), ("cy", camera.cy, height)):
        if pixels is not None and not -0.5 <= center <= pixels - 0.5:
            warn(f"{name!r} has its principal point outside of the image: {field} is {center:g} of {pixels} pixels")
    return camera


def _rectified(content: Content, name: str) -> Calibration:
    """Return the calibration of the rectified cameras of a file."""
    if content.projections is None:
        if content.lenses is not None and content.pose is not None:
            raise FileError(
                f"{name!r} is {content.kind} of raw cameras: its images must be rectified first, "
                "which stereokit.read_rig and --rig do"
            )
        raise OptionError(
            f"it is {content.kind} without the rectified cameras (P1 and P2, or Q, or both of left.yaml and right.yaml)"
        )
    baseline = check_projections(content)
    left, right = content.projections
    lens_size = None if content.lenses is None else content.lenses[0].size
    width, height = content.size or lens_size or (None, None)
    return Calibration(
        fx=float(left[0, 0]),
        fy=float(left[1, 1]),
        cx0=float(left[0, 2]),
        cy=float(left[1, 2]),
        baseline_m=baseline,
        cx1=float(right[0, 2]),
        width=width,
        height=height,
    )
