"""Calibrations by keyword: OpenCV's FileStorage in all spellings that people use, and ROS's camera_info.

Sources: OpenCV, samples/cpp/stereo_calib.cpp (M1 D1 M2 D2 in intrinsics.yml; R T R1 R2 P1 P2 Q in extrinsics.yml) and
the documentation of cv::stereoCalibrate and cv::stereoRectify, whose names for the arguments others use as keys; ROS,
sensor_msgs/CameraInfo and camera_calibration_parsers. Names are compared without case and without ``_`` and ``-``; what
is nested counts as one long name.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

from stereokit.errors import OptionError
from stereokit.io.calibrations.content import (
    UNITS,
    Array,
    Content,
    Size,
    check_pinhole,
    lens,
    matrix,
    numbers,
    projection,
)
from stereokit.io.calibrations.trees import leaves

__all__ = ["from_keys", "joined_files", "known_keys"]

_SIDES = (
    (("1",), ("2",)),
    (("left", "l", "leftcamera", "leftcam", "cameraleft", "camleft"),
     ("right", "r", "rightcamera", "rightcam", "cameraright", "camright")),
    (("0", "cam0", "camera0"), ("1", "cam1", "camera1")),
    (("cam1", "camera1"), ("cam2", "camera2")),
)  # fmt: skip
_MATRIX = ("k", "m", "cameramatrix", "cammatrix", "camera", "cm", "mtx", "intrinsic", "intrinsics", "intrinsicmatrix",
           "cameraintrinsic", "cameraintrinsics", "matrix", "mat")  # fmt: skip
_DISTORTION = ("d", "distcoeffs", "distcoeff", "distcoefs", "distcoef", "distortioncoefficients", "distortioncoeffs",
               "distortion", "dist", "dcoeffs", "coeffs", "cameradistortion", "distortions", "kc")  # fmt: skip
_TURN = ("r", "rect", "rectification", "rectificationmatrix", "rectificationtransform", "rectify", "rectrotation",
         "rectr", "rotation")  # fmt: skip
_PROJECTION = ("p", "projection", "projectionmatrix", "newcameramatrix", "proj", "projmatrix", "rectp")
_ALONE = ("", "stereo", "extrinsic", "extrinsics", "relative", "calibration", "stereocalibration", "lefttoright")
_R = ("r", "rot", "rotation", "rotationmatrix", "rmat", "rvec", "om", "rlr", "rmatrix")
_T = ("t", "trans", "translation", "translationvector", "tvec", "tvector", "tlr", "tmatrix")
_Q = ("q", "disptodepthmatrix", "disparitytodepthmatrix", "disparitytodepthmappingmatrix", "qmatrix", "matq")
_WIDTHS = ("imagewidth", "width", "imgwidth", "imagew", "w", "cols")
_HEIGHTS = ("imageheight", "height", "imgheight", "imageh", "h", "rows")
_SIZES = ("imagesize", "imgsize", "size", "resolution", "imageresolution", "framesize", "calibrationsize", "rawsize")
_SHAPES = ("imageshape", "imgshape", "shape")  # height and width, as arrays have them
_MODELS = ("cameramodel", "distortionmodel", "model", "lensmodel", "cameratype")
_XI = frozenset(("xi", "xi1", "xi2", "xil", "xir", "xileft", "xiright", "leftxi", "rightxi"))
_FLAGS = ("fisheye", "isfisheye", "usefisheye")


class _Fields:
    """The values of a file, or of several, that are taken by any of their names."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.values = values

    def any(self, names: Iterable[str], *counts: int) -> tuple[str, Array] | None:
        """Return the first name that holds as many numbers as one of `counts`, and them."""
        for name in names:
            if name in self.values:
                match = self._numbers(name)
                if match is not None and (not counts or len(match) in counts):
                    return name, match
        return None

    def pair(self, bases: Iterable[str], *counts: int) -> tuple[tuple[str, Array], tuple[str, Array]] | None:
        """Return the values of the left and of the right camera that are called after one of `bases`."""
        bases = tuple(bases)
        for left, right in _SIDES:
            for base in bases:
                both = [
                    self.any((name for side in sides for name in (base + side, side + base)), *counts)
                    for sides in (left, right)
                ]
                if both[0] is not None and both[1] is not None:
                    return both[0], both[1]
        return None

    def text(self, bases: Iterable[str], camera: int) -> str | None:
        """Return a word about one camera, 0 or 1, or about both."""
        for base in bases:
            names = [name for sides in _SIDES[:3] for side in sides[camera] for name in (side + base, base + side)]
            for name in (*names, base):
                value = self.values.get(name)
                if isinstance(value, str | bool | int | float):
                    return str(value)
        return None

    def _numbers(self, name: str) -> Array | None:
        try:
            return numbers(name, self.values[name])
        except OptionError:
            if isinstance(self.values[name], list):
                raise
            return None


def known_keys(tree: Any) -> bool:
    """Return whether a tree holds any of the keys by which a calibration is known."""
    if not isinstance(tree, dict):
        return False
    fields = _Fields(leaves(tree))
    alone = (*_MATRIX[2:4], *_MATRIX[-6:-2], *_MATRIX[:2], *_DISTORTION[:7], "projectionmatrix", "p")
    return bool(
        fields.pair(_MATRIX, 9)
        or fields.pair(_PROJECTION, 12)
        or fields.any(_Q, 16)
        or fields.any(alone, 9, 12)
        or (fields.any(_R, 9, 3) and fields.any(_T, 3))
        or _is_ros(tree)
    )


def _is_ros(tree: Any) -> bool:
    if not isinstance(tree, dict):
        return False
    return "projection_matrix" in tree or {"distortion_model", "p"} <= {str(name).lower() for name in tree}


def joined_files(trees: list[Any]) -> tuple[str, dict[str, Any]]:
    """Return what files of one calibration are called, and all that they hold.

    Two files that use the same names are of the left and the right camera, in this order; others add up, such as
    intrinsics.yml and extrinsics.yml.
    """
    kind = "a ROS camera_info file" if any(map(_is_ros, trees)) else "an OpenCV calibration"
    parts = [leaves(tree) for tree in trees]
    if len(parts) == 1:
        if kind.startswith("a ROS"):  # of which camera, its projection tells
            p = _Fields(parts[0]).any(("projectionmatrix", "p"), 12)
            side = "right" if p is not None and p[1][3] != 0 else "left"
            return kind, {side + name: value for name, value in parts[0].items()}
        return kind, parts[0]
    telling = {*_MATRIX, *_DISTORTION, *_PROJECTION}
    if parts[0].keys() & parts[1].keys() & telling:
        both = zip(("left", "right"), parts, strict=True)
        return kind, {side + name: value for side, part in both for name, value in part.items()}
    return kind, {**parts[1], **parts[0]}


def from_keys(kind: str, values: dict[str, Any]) -> Content:
    """Return what a calibration by keyword says.

    Raises
    ------
    OptionError
        If something in it is wrong.
    """
    fields = _Fields(values)
    if _XI & values.keys():
        raise OptionError(
            "the camera model must be pinhole or equidistant fisheye, got an omnidirectional one (it has xi, as of "
            "cv2.omnidir); calibrate as a fisheye, or undistort the images with cv2.omnidir first"
        )
    unit = values.get("unit", values.get("units"))
    if unit is not None and unit not in UNITS:
        raise OptionError(f"unit must be one of {', '.join(UNITS)}, got {unit!r}")
    cameras, coefficients = fields.pair(_MATRIX, 9), fields.pair(_DISTORTION)
    lenses = None
    if cameras is not None:
        sizes = [_size(fields, side) for side in (0, 1)]
        if sizes[0] and sizes[1] and sizes[0] != sizes[1]:
            texts = " and ".join("{}x{}".format(*size) for size in sizes if size)
            raise OptionError(f"left and right must have images of the same size, got {texts}")
        words = [_model(fields, side) for side in (0, 1)]
        both = coefficients or (("", None), ("", None))
        left, right = (
            lens((camera[0], d[0]), camera[1], d[1], word, size or sizes[0] or sizes[1])
            for camera, d, word, size in zip(cameras, both, words, sizes, strict=True)
        )
        lenses = left, right
    rotation, translation = _alone(fields, _R, 9, 3), _alone(fields, _T, 3)
    projections, turns = fields.pair(_PROJECTION, 12), fields.pair(_TURN, 9)
    names = ("left", "right") if projections is None else (projections[0][0], projections[1][0])
    both_p = None if projections is None else _square(projections, 3, 4)
    both_r = None if turns is None else _square(turns, 3, 3)
    q = fields.any((*_Q, *(prefix + name for prefix in _ALONE for name in _Q)), 16)
    if both_p is None and q is not None:
        both_p, names = _from_q(*q), ("Q", "Q")
    pose = None
    if rotation is not None and translation is not None:
        pose = _rotation(rotation), translation
    elif both_p is not None and both_r is not None and lenses is not None:
        pose = _pose(both_r, both_p, names)
    if names == ("Q", "Q"):
        both_r = None
    return Content(kind, lenses, pose, both_p, both_r, None, unit, names)


def _alone(fields: _Fields, names: Iterable[str], *counts: int) -> Array | None:
    match = fields.any((prefix + name for prefix in _ALONE for name in names), *counts)
    return None if match is None else match[1]


def _square(pair: tuple[tuple[str, Array], tuple[str, Array]], rows: int, columns: int) -> tuple[Array, Array]:
    left, right = (matrix(name, values, rows, columns) for name, values in pair)
    return left, right


def _rotation(values: Array) -> Array:
    """Return a rotation matrix from itself, or from a vector as of cv::Rodrigues."""
    if len(values) == 3:
        return np.asarray(cv2.Rodrigues(values)[0], np.float64)
    return values.reshape(3, 3)


def _pose(turns: tuple[Array, Array], projections: tuple[Array, Array], names: tuple[str, str]) -> tuple[Array, Array]:
    """Return rotation and translation between raw cameras from those into the rectified ones, which lie side by side.

    ``R2 x2 = R1 x1 + t``, where ``t = (P2[0, 3] - P1[0, 3]) / fx`` along x.
    """
    left, right = projections
    for name, camera in zip(names, projections, strict=True):
        check_pinhole(name, camera)
    along = np.array([right[0, 3] / right[0, 0] - left[0, 3] / left[0, 0], 0, 0])
    return turns[1].T @ turns[0], turns[1].T @ along


def _from_q(name: str, values: Array) -> tuple[Array, Array]:
    """Return projections that have the matrix Q of cv::stereoRectify."""
    q = values.reshape(4, 4)
    focal, inverse = q[2, 3], q[3, 2]
    if not focal > 0 or inverse == 0:
        raise OptionError(f"{name} must be the Q of cv2.stereoRectify, with fx in row 3 and 1 / baseline in row 4")
    baseline = 1 / inverse
    fy = focal * (1.0 if q[1, 1] == 0 else 1 / q[1, 1])
    cy = -q[1, 3] * (1.0 if q[1, 1] == 0 else 1 / q[1, 1])
    left = projection(focal, fy, -q[0, 3], cy)
    right = projection(focal, fy, -q[0, 3] + q[3, 3] * baseline, cy, baseline)
    return left, right


def _size(fields: _Fields, camera: int) -> Size | None:
    """Return the size of the images of a camera, or of both."""
    sides = [side for pair in _SIDES[1:3] for side in pair[camera]]
    for side in (*sides, *_ALONE):
        some = 6 if side else 2  # of a file as a whole, w and cols may be of anything
        width, height = (fields.any([side + name for name in names[:some]], 1) for names in (_WIDTHS, _HEIGHTS))
        if width is not None and height is not None:
            return _pixels(width[1][0], height[1][0])
        match = fields.any((side + name for name in _SIZES), 2)
        if match is not None:
            return _pixels(*match[1])
        match = fields.any((side + name for name in _SHAPES), 2, 3)
        if match is not None:
            return _pixels(match[1][1], match[1][0])
    return None


def _pixels(width: float, height: float) -> Size:
    if not all(side == int(side) and 0 < side <= 2**20 for side in (width, height)):
        raise OptionError(f"the size of the images must be whole numbers of pixels, got {width:g} and {height:g}")
    return int(width), int(height)


def _model(fields: _Fields, camera: int) -> str | None:
    flag = fields.text(_FLAGS, camera)
    if flag is not None and flag.lower() in ("1", "1.0", "true", "yes"):
        return "fisheye"
    words = fields.text(_MODELS[1:2], camera), fields.text(_MODELS, camera)
    return words[0] if words[0] is not None and words[0].lower() not in ("none", "") else words[1]
