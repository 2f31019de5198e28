"""From raw images to a rectified pair: maps, the pixels that hold something, and the calibration that is left.

``cv2.stereoRectify`` (Bouguet's algorithm: each camera turns by half, then both turn to the baseline; Bradski and
Kaehler, Learning OpenCV, ch. 12) and ``cv2.fisheye.stereoRectify`` place the rectified cameras, ``cv2.remap``
resamples. The maps are in fixed point, 1/32 pixel, so that every processor gives the same images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.calibration import Calibration
from stereokit.errors import InputError, OptionError, shown
from stereokit.images.check import check_integer, check_number
from stereokit.io.calibrations.content import Array, Lens, Size, projection

__all__ = ["Rectification", "RectifiedCameras", "rectification"]

_TYPES = (np.uint8, np.uint16, np.float32, np.float64)
_LEAST_SHARE = 0.02
"""Of pixels that hold something: with fewer there is no pair."""


@dataclass(frozen=True)
class RectifiedCameras:
    """Rectified cameras that a file tells.

    Attributes
    ----------
    turns : (left, right) of (3, 3) float64
        OpenCV's R1 and R2.
    projections : (left, right) of (3, 4) float64
        OpenCV's P1 and P2, the last column in metres times pixels.
    size : (width, height) or None
        Of the rectified images, pixels; that of the raw ones where it is None.
    """

    turns: tuple[Array, Array]
    projections: tuple[Array, Array]
    size: Size | None = None


@dataclass(frozen=True, eq=False)
class Rectification:
    """What turns raw images of a rig into a rectified pair.

    Attributes
    ----------
    calibration : Calibration
        Of the rectified pair, with its size.
    mask, right_mask : (H, W) bool
        Where the rectified left and right image hold something.
    turns : (left, right) of (3, 3) float64
        From the raw cameras' frames to the rectified ones' (OpenCV's R1 and R2).
    raw_size : (width, height)
        Of the images that it takes, pixels.
    """

    calibration: Calibration
    mask: NDArray[np.bool_]
    right_mask: NDArray[np.bool_]
    turns: tuple[Array, Array]
    projections: tuple[Array, Array]
    raw_size: Size
    _maps: tuple[tuple[NDArray[Any], NDArray[Any]], tuple[NDArray[Any], NDArray[Any]]]

    @property
    def size(self) -> Size:
        """Width and height of the rectified images, pixels."""
        return self.mask.shape[1], self.mask.shape[0]

    @property
    def masks(self) -> dict[str, NDArray[np.bool_]]:
        """Arguments of `stereokit.Matcher` that leave out what no sensor saw: ``matcher(left, right, **masks)``."""
        masks = {"mask": self.mask, "right_mask": self.right_mask}
        return {name: mask for name, mask in masks.items() if not mask.all()}

    def __call__(self, left: ArrayLike, right: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the rectified images of a raw pair, of the same types; 0 where the sensors saw nothing.

        Raises
        ------
        InputError
            If an image has another size, or a type that cannot be resampled.
        """
        a, b = (self._image(name, image) for name, image in (("left", left), ("right", right)))
        return _remapped(a, self._maps[0]), _remapped(b, self._maps[1])

    def _image(self, name: str, image: ArrayLike) -> NDArray[Any]:
        array = np.asarray(image)
        if array.ndim not in (2, 3) or array.dtype not in _TYPES:
            kinds = ", ".join(np.dtype(kind).name for kind in _TYPES)
            raise InputError(
                f"{name} must be an image of {kinds}, (H, W) or (H, W, C), got {array.dtype} {array.shape}"
            )
        if array.shape[1::-1] != self.raw_size:
            raise InputError(
                f"the rig is for raw images of {self.raw_size[0]}x{self.raw_size[1]} pixels, "
                f"got {name} of {array.shape[1]}x{array.shape[0]}; use StereoRig.scaled for resized images"
            )
        return np.ascontiguousarray(array)


def _remapped(image: NDArray[Any], maps: tuple[NDArray[Any], NDArray[Any]]) -> NDArray[Any]:
    return np.asarray(cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))


def rectification(
    lenses: tuple[Lens, Lens],
    pose: tuple[Array, Array],
    raw_size: Size,
    rectified_cameras: RectifiedCameras | None,
    alpha: float,
    size: Size | None,
    crop: bool,
    focal: float | None,
) -> Rectification:
    """Return the rectification of two lenses.

    Parameters
    ----------
    lenses : (left, right) of Lens
    pose : (rotation, translation)
        From left to right, metres.
    raw_size : (width, height)
    rectified_cameras : RectifiedCameras or None
        Rectified cameras, instead of those that `alpha`, `size` and `focal` give.
    alpha, size, crop, focal
        As of `StereoRig.rectification`.

    Raises
    ------
    OptionError
        If no rectified pair comes of them.
    """
    alpha = check_number("alpha", alpha, 0, 1)
    if size is not None:
        if not isinstance(size, tuple | list) or len(size) != 2:
            raise OptionError(f"size must be (width, height), got {shown(size)}")
        size = check_integer("width", size[0], 8, 2**15), check_integer("height", size[1], 8, 2**15)
    if focal is not None:
        focal = check_number("focal", focal, 1e-3, 1e7)
    if rectified_cameras is None:
        turns, projections = _placed(lenses, pose, raw_size, alpha, size or raw_size, focal)
        target = size or raw_size
    else:
        turns, projections, target = (
            rectified_cameras.turns,
            rectified_cameras.projections,
            rectified_cameras.size or raw_size,
        )
    fields, masks = [], []
    for one, turn, camera in zip(lenses, turns, projections, strict=True):
        x, y = _maps_of(one, turn, camera, target)
        fields.append((x, y))
        masks.append(_visible(x, y, raw_size, camera))
    if min(mask.mean() for mask in masks) < _LEAST_SHARE:
        raise OptionError(
            "no rectified pair comes of this rig: hardly a pixel of it lies within the raw images; "
            "are the lens model and the size right? For a very wide lens choose focal"
        )
    x0, y0, x1, y1 = _cropped(masks[0] & masks[1]) if crop else (0, 0, *target)
    maps = [
        cv2.convertMaps(np.ascontiguousarray(x[y0:y1, x0:x1]), np.ascontiguousarray(y[y0:y1, x0:x1]), cv2.CV_16SC2)
        for x, y in fields
    ]
    left, right = projections
    shift = np.array([[0, 0, x0, 0], [0, 0, y0, 0], [0, 0, 0, 0]])
    calibration = Calibration(
        fx=float(left[0, 0]),
        fy=float(left[1, 1]),
        cx0=float(left[0, 2] - x0),
        cy=float(left[1, 2] - y0),
        baseline_m=float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0]),
        cx1=float(right[0, 2] - x0),
        width=x1 - x0,
        height=y1 - y0,
    )
    crops = [np.ascontiguousarray(mask[y0:y1, x0:x1]) for mask in masks]
    for mask in crops:
        mask.flags.writeable = False
    return Rectification(
        calibration, crops[0], crops[1], turns, (left - shift, right - shift), raw_size, (maps[0], maps[1])
    )


def _placed(
    lenses: tuple[Lens, Lens], pose: tuple[Array, Array], raw: Size, alpha: float, size: Size, focal: float | None
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return R1, R2 and P1, P2 of the rectified cameras."""
    if lenses[0].model != lenses[1].model:
        raise OptionError(f"left and right must have one lens model, got {lenses[0].model} and {lenses[1].model}")
    left, right = lenses
    turn, step = pose
    try:
        if left.model == "fisheye":
            parts = cv2.fisheye.stereoRectify(
                left.matrix, left.distortion, right.matrix, right.distortion, raw, turn, step.reshape(3, 1),
                flags=cv2.CALIB_ZERO_DISPARITY, newImageSize=size, balance=alpha, fov_scale=1.0,
            )[:4]  # fmt: skip
        else:
            parts = cv2.stereoRectify(
                left.matrix, _distortion(left), right.matrix, _distortion(right), raw, turn, step.reshape(3, 1),
                flags=cv2.CALIB_ZERO_DISPARITY, alpha=alpha, newImageSize=size,
            )[:4]  # fmt: skip
    except cv2.error as error:
        raise OptionError(f"OpenCV cannot rectify this rig: {error.err or error}") from error
    r1, r2, p1, p2 = (np.array(one, np.float64) for one in parts)
    if focal is not None:
        middle = (size[0] - 1) / 2, (size[1] - 1) / 2
        p1, p2 = (projection(focal, focal, *middle, b) for b in (0.0, float(np.linalg.norm(step))))
    _check_placed(p1, p2, raw, step, focal)
    return (r1, r2), (p1, p2)


def _check_placed(p1: Array, p2: Array, raw: Size, step: Array, focal: float | None) -> None:
    finite = np.isfinite(p1).all() and np.isfinite(p2).all()
    if not finite or not 0.01 * max(raw) < p1[0, 0] < 100 * max(raw):
        if focal is None:
            length = f"{p1[0, 0]:g}" if finite else "none"
            raise OptionError(
                f"the lenses are too wide, or their distortion is wrong: the rectified focal length is {length} "
                "pixels; choose focal (--focal), or alpha nearer to 0"
            )
    if not p2[0, 3] < 0 or abs(-p2[0, 3] / p2[0, 0] - np.linalg.norm(step)) > 1e-3 * float(np.linalg.norm(step)):
        raise OptionError("the cameras cannot be rectified side by side: R and T do not go together")


def _distortion(one: Lens) -> Array:
    return one.distortion if len(one.distortion) else np.zeros(5)


def _maps_of(one: Lens, turn: Array, rectified: Array, size: Size) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return where in the raw image each rectified pixel lies, (H, W) float32 each."""
    camera = np.ascontiguousarray(rectified[:, :3])
    if one.model == "fisheye":
        x, y = cv2.fisheye.initUndistortRectifyMap(one.matrix, one.distortion, turn, camera, size, cv2.CV_32FC1)
    else:
        x, y = cv2.initUndistortRectifyMap(one.matrix, _distortion(one), turn, camera, size, cv2.CV_32FC1)
    return x, y


def _visible(x: NDArray[Any], y: NDArray[Any], raw: Size, rectified: Array) -> NDArray[np.bool_]:
    """Return which rectified pixels lie within the raw image, where the lens model does not fold.

    Beyond the angles that a distortion was fitted to, its polynomial turns back into the image: what is there is a
    mirrored ghost. It is told by the sign of the map's Jacobian, and by not hanging together with the middle.
    """
    with np.errstate(invalid="ignore"):
        inside = np.asarray((x >= 0) & (y >= 0) & (x <= raw[0] - 1) & (y <= raw[1] - 1), np.bool_)
    if min(x.shape) < 2:
        return inside
    xy, xx = np.gradient(x)
    yy, yx = np.gradient(y)
    upright: NDArray[np.bool_] = inside & (xx * yy - xy * yx > 0)
    count, labels = cv2.connectedComponents(upright.astype(np.uint8), connectivity=4)
    if count <= 2:
        return np.asarray(upright, np.bool_)
    column, row = np.clip(np.rint(rectified[:2, 2]), 0, (x.shape[1] - 1, x.shape[0] - 1)).astype(int)
    middle = labels[row, column]
    if middle == 0:
        middle = 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    return np.asarray(labels == middle, np.bool_)


def _cropped(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Return a rectangle without blank pixels at its sides: from the bounding box, the worst side goes first."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        raise OptionError("crop leaves nothing: no pixel is seen by both cameras")
    y0, y1, x0, x1 = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    while x1 - x0 > 1 and y1 - y0 > 1:
        sides = (mask[y0, x0:x1], mask[y1 - 1, x0:x1], mask[y0:y1, x0], mask[y0:y1, x1 - 1])
        blank = [1 - float(side.mean()) for side in sides]
        worst = int(np.argmax(blank))
        if blank[worst] == 0:
            break
        y0, y1, x0, x1 = y0 + (worst == 0), y1 - (worst == 1), x0 + (worst == 2), x1 - (worst == 3)
    return x0, y0, x1, y1
