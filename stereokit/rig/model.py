"""Two raw cameras: lenses, and how the right one stands to the left.

A point ``x`` in the left camera's frame (x right, y down, z forward) is ``rotation @ x + translation_m`` in the right
one's, as with the R and T of ``cv2.stereoCalibrate``; so a right camera that is to the right of the left one has a
negative ``translation_m[0]``. Lenses are those of OpenCV: pinhole with 4, 5, 8, 12 or 14 coefficients (radial,
tangential, rational, thin prism, tilt; OpenCV, "Camera calibration and 3D reconstruction"), and the equidistant fisheye
with four (Kannala and Brandt 2006; OpenCV, "Fisheye camera model").
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.calibration import Calibration
from stereokit.errors import InputError, OptionError, shown
from stereokit.images.check import check_integer
from stereokit.io.calibrations import Lens
from stereokit.io.calibrations.content import Size, lens
from stereokit.notices import warn
from stereokit.rig.rectification import Rectification, RectifiedCameras, rectification

__all__ = ["Camera", "StereoRig"]

Array = NDArray[np.float64]
_CACHE_SIZE = 4
"""Rectifications that a rig keeps, of different options."""
_ORTHOGONAL = 1e-3
_WIDE_DEGREES = 45.0


@dataclass(frozen=True, eq=False)
class Camera:
    """One raw camera.

    Parameters
    ----------
    matrix : (3, 3) float
        ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``, pixels; the centre of the first pixel is (0, 0).
    distortion : (n,) float
        OpenCV's coefficients: none, 4, 5, 8, 12 or 14 of a pinhole camera, 4 of a fisheye.
    model : {"pinhole", "fisheye"}
    width, height : int, optional
        Size of the images, pixels.

    Raises
    ------
    OptionError
        If the matrix has a skew or a focal length that is not positive, or the model has not so many coefficients.
    """

    matrix: Array
    distortion: Array = ()  # type: ignore[assignment]
    model: str = "pinhole"
    width: int | None = None
    height: int | None = None

    def __post_init__(self) -> None:
        if self.model not in ("pinhole", "fisheye"):
            raise OptionError(f"model must be 'pinhole' or 'fisheye', got {shown(self.model)}")
        checked = lens(("matrix", "distortion"), self.matrix, self.distortion, self.model)
        for name, value in (("matrix", checked.matrix), ("distortion", checked.distortion)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        if (self.width is None) != (self.height is None):
            raise OptionError("width and height go together, got only one of them")
        for name in ("width", "height"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, check_integer(name, getattr(self, name), 1, 2**20))

    @property
    def size(self) -> Size | None:
        """Width and height, pixels, if known."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    def scaled(self, factor: float) -> Camera:
        """Return the camera of images resized by `factor`; pixel areas map to pixel areas, as with ``cv2.resize``."""
        if not (np.isfinite(factor) and factor > 0):
            raise OptionError(f"factor must be positive, got {factor}")
        scale = np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1]])
        size = (None, None) if self.size is None else tuple(max(1, round(side * factor)) for side in self.size)
        return Camera(scale @ self.matrix, self.distortion, self.model, *size)


class StereoRig:
    """Two raw cameras, which `rectify` turns into a rectified pair.

    Parameters
    ----------
    left, right : Camera
    rotation : (3, 3) float
    translation_m : (3,) float
        Metres. Both take a point from the left camera's frame to the right one's, as OpenCV's R and T.
    rectified_cameras : RectifiedCameras or None
        Rectified cameras that came with the file; they are what `rectify` uses where no other options are asked for.

    Raises
    ------
    OptionError
        If `rotation` is none, or the right camera is not to the right of the left one.
    """

    def __init__(
        self,
        left: Camera,
        right: Camera,
        rotation: ArrayLike,
        translation_m: ArrayLike,
        rectified_cameras: RectifiedCameras | None = None,
    ) -> None:
        self.left, self.right = left, right
        self.rotation, self.translation_m = _checked(rotation, translation_m)
        self.rectified_cameras = rectified_cameras
        if left.size != right.size:
            texts = " and ".join("no size" if c.size is None else "{}x{}".format(*c.size) for c in (left, right))
            raise OptionError(f"left and right must have images of one size, got {texts}")
        self._cache: OrderedDict[Any, Rectification] = OrderedDict()
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        size = "size unknown" if self.size is None else "{}x{}".format(*self.size)
        return f"StereoRig({self.left.model}, {size}, baseline {self.baseline_m:.4g} m)"

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_cache", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._cache, self._lock = OrderedDict(), threading.Lock()

    @property
    def size(self) -> Size | None:
        """Width and height of the raw images, pixels, if known."""
        return self.left.size

    @property
    def baseline_m(self) -> float:
        """Distance between the cameras, metres."""
        return float(np.linalg.norm(self.translation_m))

    def sized(self, width: int, height: int) -> StereoRig:
        """Return the rig for raw images of `width` x `height` pixels: itself, or with the size that it does not know.

        Raises
        ------
        InputError
            If it is for images of another size.
        """
        if self.size == (width, height):
            return self
        if self.size is not None:
            size = "{}x{}".format(*self.size)
            hint = "; use StereoRig.scaled for resized images"
            if self.rectified_cameras is not None and self.rectified_cameras.size == (width, height):
                hint = ", and those are rectified ones: nothing is left to rectify"
            raise InputError(f"the rig is for raw images of {size} pixels, got {width}x{height}{hint}")
        for name, camera in (("left", self.left), ("right", self.right)):
            cx, cy = camera.matrix[0, 2], camera.matrix[1, 2]
            if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
                raise InputError(
                    f"the {name} camera has its principal point at {cx:g}, {cy:g}, outside of the images of "
                    f"{width}x{height} pixels: the rig is for images of another size"
                )
        left, right = (Camera(c.matrix, c.distortion, c.model, width, height) for c in (self.left, self.right))
        return StereoRig(left, right, self.rotation, self.translation_m, self.rectified_cameras)

    def scaled(self, factor: float) -> StereoRig:
        """Return the rig of images resized by `factor`, such as 0.5.

        Raises
        ------
        OptionError
            If `factor` is not positive.
        """
        return StereoRig(self.left.scaled(factor), self.right.scaled(factor), self.rotation, self.translation_m)

    def exchanged(self) -> StereoRig:
        """Return the rig with left and right exchanged, for cameras that hang upside down or files that name them so.

        Raises
        ------
        OptionError
            If the right camera is then not to the right.
        """
        return StereoRig(self.right, self.left, self.rotation.T, -self.rotation.T @ self.translation_m)

    def rectification(
        self,
        alpha: float | None = None,
        size: Size | None = None,
        crop: bool = False,
        focal: float | None = None,
    ) -> Rectification:
        """Return maps, masks and calibration of the rectified pair; they are made once and kept.

        Parameters
        ----------
        alpha : float or None
            From 0, only pixels that both sensors saw, to 1, all that they saw, with blank areas around (OpenCV's
            ``alpha``; ``balance`` of a fisheye). None is what the file says, else 0.
        size : (width, height) or None
            Of the rectified images, pixels; that of the raw ones by default.
        crop : bool
            Cut away rows and columns until no blank pixel is left at the sides.
        focal : float or None
            Focal length of the rectified cameras, pixels, instead of what `alpha` gives. For lenses so wide that it
            gives none.

        Returns
        -------
        Rectification

        Raises
        ------
        OptionError
            If the size of the raw images is not known, or no rectified pair comes of the options.
        """
        if self.size is None:
            raise OptionError("the rig does not know the size of its images: StereoRig.sized(width, height) tells it")
        key = repr((alpha, size, bool(crop), focal))
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
            cameras = self.rectified_cameras if (alpha, size, focal) == (None, None, None) else None
            result = rectification(
                (self._lens(self.left), self._lens(self.right)), (self.rotation, self.translation_m), self.size,
                cameras, 0.0 if alpha is None else alpha, size, crop, focal,
            )  # fmt: skip
            self._cache[key] = result
            if len(self._cache) > _CACHE_SIZE:
                self._cache.popitem(last=False)
            return result

    @staticmethod
    def _lens(camera: Camera) -> Lens:
        return Lens(camera.matrix, camera.distortion, camera.model, camera.size)

    def rectify(self, left: ArrayLike, right: ArrayLike, **options: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the rectified images of a raw pair.

        Parameters
        ----------
        left, right : (H, W) or (H, W, 3) uint8, uint16, float32 or float64
            Of the size of the rig.
        **options
            Of `rectification`.

        Returns
        -------
        left, right : arrays of the same type
            0 where the sensors saw nothing.

        Raises
        ------
        InputError
            If the images have another size, or a type that cannot be resampled.
        """
        shape = np.shape(left)
        if self.size is None:
            if len(shape) < 2:
                raise InputError(f"left must be an image, got an array of shape {shape}")
            self._take_size(shape[1], shape[0])
        return self.rectification(**options)(left, right)

    def _take_size(self, width: int, height: int) -> None:
        """Take the size of the first images for that of all."""
        sized = self.sized(width, height)
        self.left, self.right = sized.left, sized.right

    def rectified(self, **options: Any) -> Calibration:
        """Return the calibration of the rectified pair; options as of `rectification`."""
        return self.rectification(**options).calibration

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the rig as OpenCV's FileStorage does, from which `read_rig` and ``cv2.FileStorage`` read it.

        Parameters
        ----------
        path : path
            Ends in .yml, .yaml, .xml or .json. Keys: ``K1 D1 K2 D2 R T``, ``R1 R2 P1 P2 Q`` of the rectified pair,
            ``image_width``, ``image_height``, ``camera_model`` and ``unit``, which is ``m``.

        Raises
        ------
        FileError
            If the suffix is another or the file cannot be written.
        """
        from stereokit.rig.files import save_rig

        save_rig(self, path)


def _checked(rotation: ArrayLike, translation_m: ArrayLike) -> tuple[Array, Array]:
    """Return copies of rotation and translation that are what they should be."""
    turn, step = np.array(rotation, np.float64), np.array(translation_m, np.float64).reshape(-1)
    if turn.shape != (3, 3) or step.shape != (3,) or not (np.isfinite(turn).all() and np.isfinite(step).all()):
        raise OptionError(
            f"rotation must be (3, 3) and translation_m (3,), all finite, got shapes {turn.shape} and {step.shape}"
        )
    if np.abs(turn @ turn.T - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(turn) < 0:
        raise OptionError("rotation (R) must be a rotation matrix, got one whose rows are not at right angles")
    place = -turn.T @ step  # of the right camera, in the left one's frame
    across, down, ahead = np.abs(place)
    if not np.linalg.norm(place) > 0:
        raise OptionError("translation_m (T) must not be 0: the two cameras would be in one place")
    if down > across and down >= ahead:
        raise OptionError(
            f"the right camera must be beside the left one, but is {abs(place[1]):g} m above or below it (T); "
            "turn the images by 90 degrees and calibrate those"
        )
    if ahead > across:
        raise OptionError(f"the right camera must be beside the left one, but is {place[2]:g} m before it (T)")
    if place[0] < 0:
        raise OptionError(
            f"the right camera lies {-place[0]:g} m to the left of the left one (the sign of T): "
            "left and right are exchanged, or T goes the other way; StereoRig.exchanged, or --exchange, turns them"
        )
    between = float(np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1))))
    if between > _WIDE_DEGREES:
        warn(f"the two cameras look {between:.0f} degrees apart (R): is it the rotation from left to right?")
    for array in (turn, step):
        array.flags.writeable = False
    return turn, step
