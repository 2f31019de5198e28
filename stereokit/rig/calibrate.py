"""Two cameras calibrated from images of a board: which pairs are fit for it, the rig, and how good it is.

First each camera alone (Zhang, A flexible new technique for camera calibration, 2000), then both together
(``cv2.stereoCalibrate``, ``cv2.fisheye.stereoCalibrate``). After each step pairs whose error stands out are left out
and the step is done again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError, OptionError, shown
from stereokit.images.intensity import display_8bit, to_gray
from stereokit.rig.boards import Board, Corners
from stereokit.rig.model import Camera, StereoRig
from stereokit.rig.rectification import Rectification

__all__ = ["BoardCalibration", "PairQuality", "calibrate", "rows_picture"]

Array = NDArray[np.float64]
COEFFICIENTS = (4, 5, 8, 12, 14)
_LEAST_PAIRS, _GOOD_PAIRS = 4, 10
_EDGE_PX, _EDGE_WIDTH = 6.0, 1280
"""An edge wider than this is blurred, in images up to that width, and in larger ones in proportion."""
_OUTLIER, _OUTLIER_PX = 3.0, 0.5
"""A pair is left out where its error is that many times the median, and at least that many pixels."""
_GRID = 8, 6
_TILT_DEGREES = 15.0
_COVERAGE = 0.5
_ROUNDS = 4


@dataclass
class PairQuality:
    """What a pair was good for.

    Attributes
    ----------
    name : str
    reason : str
        Why it was left out; empty if it was used.
    reprojection_px : float or None
        Root mean square over both views.
    epipolar_px : float or None
        Root mean square of the differences of rows after rectification.
    """

    name: str
    reason: str = ""
    reprojection_px: float | None = None
    epipolar_px: float | None = None


@dataclass
class BoardCalibration:
    """A rig, and how good it is.

    Attributes
    ----------
    rig : StereoRig
    reprojection_px, epipolar_px : float
        Root mean squares over all corners of the pairs that were used.
    epipolar_max_px : float
        The largest difference of rows of a corner.
    coverage : (left, right)
        The share of each image, in cells of 8 x 6, in which there were corners.
    pairs : list of PairQuality
    doubts : list of str
        What could be better about the images, a line each.
    """

    rig: StereoRig
    reprojection_px: float
    epipolar_px: float
    epipolar_max_px: float
    coverage: tuple[float, float]
    pairs: list[PairQuality] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


@dataclass
class _View:
    """The corners that both cameras see of one pair, in one order."""

    quality: PairQuality
    points: Array
    pixels: tuple[Array, Array]


def calibrate(
    pairs: Iterable[tuple[str, NDArray[Any], NDArray[Any]]],
    board: Board,
    *,
    model: str = "pinhole",
    coefficients: int = 5,
) -> BoardCalibration:
    """Calibrate two cameras from images of a board.

    Parameters
    ----------
    pairs : iterable of (name, left, right)
        Images of one size, (H, W) or (H, W, 3); they are looked at one pair at a time.
    board : Board
    model : {"pinhole", "fisheye"}
    coefficients : {4, 5, 8, 12, 14}
        Of a pinhole camera's distortion; a fisheye has 4.

    Returns
    -------
    BoardCalibration

    Raises
    ------
    OptionError
        If an option is wrong, or left and right are exchanged.
    InputError
        If the images have several sizes, or fewer than four pairs are fit for it.
    """
    if model not in ("pinhole", "fisheye"):
        raise OptionError(f"model must be 'pinhole' or 'fisheye', got {shown(model)}")
    if coefficients not in COEFFICIENTS:
        raise OptionError(f"coefficients must be one of {', '.join(map(str, COEFFICIENTS))}, got {shown(coefficients)}")
    views, qualities, size = _views(pairs, board)
    _demand(views, qualities, board)
    solver = _Fisheye(size) if model == "fisheye" else _Pinhole(size, coefficients)
    lenses: list[tuple[Array, Array]] = []
    for side in (0, 1):
        views, lens = _without_outliers(views, lambda some, side=side: solver.alone(some, side))
        _demand(views, qualities, board)
        lenses.append(lens)
    # With the lenses as they are first: free ones bend to what a single wrong pair says.
    views, _ = _without_outliers(views, lambda some: solver.together(some, lenses, True))
    _demand(views, qualities, board)
    views, (lenses, rotation, translation) = _without_outliers(views, lambda some: solver.together(some, lenses, False))
    _demand(views, qualities, board)
    left, right = (Camera(k, d, model, *size) for k, d in lenses)
    rig = StereoRig(left, right, rotation, translation)
    return _graded(rig, views, qualities)


def _views(
    pairs: Iterable[tuple[str, NDArray[Any], NDArray[Any]]], board: Board
) -> tuple[list[_View], list[PairQuality], tuple[int, int]]:
    """Return what all pairs show, and why some show nothing."""
    views: list[_View] = []
    qualities: list[PairQuality] = []
    size: tuple[int, int] | None = None
    for name, left, right in pairs:
        quality = PairQuality(name)
        qualities.append(quality)
        images = [_gray(left), _gray(right)]
        for image in images:
            shape = image.shape[1], image.shape[0]
            size = size or shape
            if shape != size:
                raise InputError(
                    f"all images must have one size, got {size[0]}x{size[1]} and, in pair {name!r}, "
                    f"{shape[0]}x{shape[1]}"
                )
        corners = [board.corners(image) for image in images]
        missing = [side for side, one in zip(("left", "right"), corners, strict=True) if one is None]
        if corners[0] is None or corners[1] is None:
            quality.reason = f"board not found in {' and '.join(missing)}"
            continue
        for side, image, one in zip(("left", "right"), images, corners, strict=True):
            width = _edge_width(image, one.pixels) if one is not None else 0.0
            if width > _EDGE_PX * max(1.0, image.shape[1] / _EDGE_WIDTH):
                quality.reason = f"blurred in {side}: edges are {width:.0f} px wide"
        if quality.reason:
            continue
        view = _shared(quality, board, corners[0], corners[1])
        if view is not None:
            views.append(view)
    if size is None:
        raise InputError("pairs must hold at least one pair of images, got none")
    return views, qualities, size


def _gray(image: NDArray[Any]) -> NDArray[np.uint8]:
    shades = np.asarray(display_8bit(np.asarray(image)), np.uint8)
    return np.ascontiguousarray(shades if shades.ndim == 2 else to_gray(shades), np.uint8)


def _edge_width(gray: NDArray[np.uint8], pixels: Array) -> float:
    """Return how many pixels it takes from black to white around the corners, the median."""
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    apart[apart == 0] = np.inf
    radius = int(np.clip(0.6 * np.median(apart.min(axis=1)), 3, 40))
    widths = []
    for x, y in np.rint(pixels[:: max(1, len(pixels) // 24)]).astype(int):
        patch = gray[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1].astype(np.float32)
        if min(patch.shape) < 5:
            continue
        contrast = np.quantile(patch, 0.95) - np.quantile(patch, 0.05)
        slope = np.hypot(cv2.Sobel(patch, cv2.CV_32F, 1, 0), cv2.Sobel(patch, cv2.CV_32F, 0, 1)) / 8
        widths.append(float(contrast / max(np.quantile(slope, 0.98), 1e-3)))
    return float(np.median(widths)) if widths else 0.0


def _shared(quality: PairQuality, board: Board, left: Corners, right: Corners) -> _View | None:
    """Return the corners that both views show, in one order; a chessboard may be numbered from its other end."""
    ids, in_left, in_right = np.intersect1d(left.ids, right.ids, return_indices=True)
    if len(ids) < min(8, len(board.points)):
        quality.reason = f"only {len(ids)} corners are in both views"
        return None
    a, b = left.pixels[in_left], right.pixels[in_right]
    if len(ids) == len(board.points):
        shapes = [b[order] for order in board.orders()]
        b = min(shapes, key=lambda shape: float(np.abs(_normal(a) - _normal(shape)).sum()))
    return _View(quality, board.points[ids], (a, b))


def _normal(pixels: Array) -> Array:
    centered = pixels - pixels.mean(axis=0)
    return np.asarray(centered / max(float(np.abs(centered).max()), 1e-9), np.float64)


def _demand(views: Sequence[_View], qualities: Sequence[PairQuality], board: Board) -> None:
    if len(views) >= _LEAST_PAIRS:
        return
    lost = [quality for quality in qualities if quality.reason]
    counts: dict[str, int] = {}
    for quality in lost:
        key = quality.reason.split(":")[0]
        counts[key] = counts.get(key, 0) + 1
    reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items(), key=lambda item: -item[1]))
    hint = ""
    if not views and board.marker_m is None:
        hint = (
            f"; {board.columns}x{board.rows} counts the inner corners: "
            f"is it a board of {board.columns + 1}x{board.rows + 1} squares?"
        )
    raise InputError(
        f"at least {_LEAST_PAIRS} pairs must show the board well in both views, got {len(views)} of {len(qualities)}"
        f"{': ' + reasons if reasons else ''}{hint}"
    )


def _without_outliers(views: list[_View], solve: Any) -> tuple[list[_View], Any]:
    """Return the views that agree, and what was solved with them: `solve` returns errors by view, and the rest."""
    for number in range(_ROUNDS):
        errors, solution = solve(views)
        limit = max(_OUTLIER * float(np.median(errors)), _OUTLIER_PX)
        bad = [view for view, error in zip(views, errors, strict=True) if error > limit]
        if not bad or number == _ROUNDS - 1 or len(views) - len(bad) < _LEAST_PAIRS:
            break
        middle = f"{np.median(errors):.2f}"
        for view, error in zip(views, errors, strict=True):
            if error > limit:
                view.quality.reprojection_px = float(error)
                view.quality.reason = f"disagrees with the others: reprojection error {error:.1f} px, median {middle}"
        views = [view for view in views if not view.quality.reason]
    for view, error in zip(views, errors, strict=True):
        view.quality.reprojection_px = float(error)
    return views, solution


class _Pinhole:
    """Calibration of pinhole cameras."""

    def __init__(self, size: tuple[int, int], coefficients: int) -> None:
        self.size, self.count = size, coefficients
        self.flags = {
            4: cv2.CALIB_FIX_K3,
            5: 0,
            8: cv2.CALIB_RATIONAL_MODEL,
            12: cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL,
            14: cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL,
        }[coefficients]

    def alone(self, views: Sequence[_View], side: int) -> tuple[Array, tuple[Array, Array]]:
        """Return the error of each view of a camera, and the camera."""
        points, pixels = _lists(views, side)
        _, k, d, _, _, _, _, errors = cv2.calibrateCameraExtended(
            points, pixels, self.size, np.eye(3), np.zeros(5), flags=self.flags
        )
        return np.ravel(np.asarray(errors, np.float64)), (np.asarray(k, np.float64), self._trimmed(d))

    def together(
        self, views: Sequence[_View], lenses: Sequence[tuple[Array, Array]], fixed: bool
    ) -> tuple[Array, tuple[list[tuple[Array, Array]], Array, Array]]:
        """Return the error of each pair, and the two cameras with their pose; with `fixed` the lenses stay."""
        points, left = _lists(views, 0)
        _, right = _lists(views, 1)
        (k1, d1), (k2, d2) = lenses
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-7)
        done = cv2.stereoCalibrateExtended(
            points, left, right, k1.copy(), d1.copy(), k2.copy(), d2.copy(), self.size, np.eye(3), np.zeros((3, 1)),
            flags=self.flags | (cv2.CALIB_FIX_INTRINSIC if fixed else cv2.CALIB_USE_INTRINSIC_GUESS), criteria=criteria,
        )  # fmt: skip
        k1, d1, k2, d2, rotation, translation = (np.asarray(one, np.float64) for one in done[1:7])
        each = np.asarray(done[-1], np.float64).reshape(len(views), 2)
        both = [(k1, self._trimmed(d1)), (k2, self._trimmed(d2))]
        return np.sqrt((each**2).mean(axis=1)), (both, rotation, translation.ravel())

    def _trimmed(self, d: Any) -> Array:
        return np.ravel(np.asarray(d, np.float64))[: self.count]


class _Fisheye:
    """Calibration of equidistant fisheyes."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.flags = _fisheye_flag("RECOMPUTE_EXTRINSIC", 2) | _fisheye_flag("FIX_SKEW", 8)
        self.criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)

    def alone(self, views: Sequence[_View], side: int) -> tuple[Array, tuple[Array, Array]]:
        """Return the error of each view of a camera, and the camera."""
        points, pixels = self._lists(views, side)
        try:
            _, camera, distortion, turns, steps = cv2.fisheye.calibrate(
                points, pixels, self.size, np.eye(3), np.zeros((4, 1)), flags=self.flags, criteria=self.criteria
            )
        except cv2.error as error:
            raise InputError(
                "the images do not suffice for a fisheye lens; take more, with the board tilted and in the corners "
                f"(OpenCV: {error.err})"
            ) from error
        k, d = np.asarray(camera, np.float64), np.ravel(np.asarray(distortion, np.float64))
        errors = [
            _rms(self._projected(points[n], turns[n], steps[n], k, d) - pixels[n].reshape(-1, 2))
            for n in range(len(views))
        ]
        return np.array(errors), (k, d)

    def together(
        self, views: Sequence[_View], lenses: Sequence[tuple[Array, Array]], fixed: bool
    ) -> tuple[Array, tuple[list[tuple[Array, Array]], Array, Array]]:
        """Return the error of each pair, and the two cameras with their pose; the lenses always stay."""
        points, left = self._lists(views, 0)
        _, right = self._lists(views, 1)
        (k1, d1), (k2, d2) = lenses
        rotation, translation, turns, steps = self._pose(views, lenses)
        errors = []
        for n, (turn, step) in enumerate(zip(turns, steps, strict=True)):
            first = cv2.Rodrigues(np.asarray(turn, np.float64))[0]
            second = cv2.Rodrigues(rotation @ first)[0]
            after = rotation @ np.asarray(step, np.float64).reshape(3, 1) + translation.reshape(3, 1)
            rest = [
                self._projected(points[n], turn, step, k1, d1) - left[n].reshape(-1, 2),
                self._projected(points[n], second, after, k2, d2) - right[n].reshape(-1, 2),
            ]
            errors.append(_rms(np.concatenate(rest)))
        return np.array(errors), ([(k1, d1), (k2, d2)], rotation, translation.ravel())

    def _pose(self, views: Sequence[_View], lenses: Sequence[tuple[Array, Array]]) -> tuple[Array, Array, Any, Any]:
        """Return R and T, and the poses of the boards before the left camera.

        ``cv2.fisheye.stereoCalibrate`` wants as many corners in all views; where parts of a board are hidden, the
        corners are freed of distortion first.
        """
        (k1, d1), (k2, d2) = lenses
        if len({len(view.points) for view in views}) == 1:
            points, left = self._lists(views, 0)
            _, right = self._lists(views, 1)
            flags = self.flags | _fisheye_flag("FIX_INTRINSIC", 256)
            solution: Any = cv2.fisheye.stereoCalibrate(
                points, left, right, k1.copy(), d1.copy(), k2.copy(), d2.copy(), self.size, flags=flags,
                criteria=self.criteria,
            )  # fmt: skip
            rotation, translation, turns, steps = solution[5:9]
        else:
            flat = [directions(Camera(k, d, "fisheye"), view.pixels[n]).astype(np.float32)
                    for n, (k, d) in enumerate(lenses) for view in views]  # fmt: skip
            none, same = np.zeros(5), np.eye(3)
            solution = cv2.stereoCalibrateExtended(
                [view.points.astype(np.float32) for view in views], flat[: len(views)], flat[len(views) :],
                same.copy(), none.copy(), same.copy(), none.copy(), self.size, np.eye(3), np.zeros((3, 1)),
                flags=cv2.CALIB_FIX_INTRINSIC,
            )  # fmt: skip
            rotation, translation, turns, steps = solution[5], solution[6], solution[-3], solution[-2]
        return np.asarray(rotation, np.float64), np.asarray(translation, np.float64), turns, steps

    @staticmethod
    def _projected(points: Array, turn: Any, step: Any, k: Array, d: Array) -> Array:
        turn, step = np.asarray(turn, np.float64).reshape(3, 1), np.asarray(step, np.float64).reshape(3, 1)
        return np.asarray(cv2.fisheye.projectPoints(points, turn, step, k, d)[0], np.float64).reshape(-1, 2)

    @staticmethod
    def _lists(views: Sequence[_View], side: int) -> tuple[list[Array], list[Array]]:
        return [view.points.reshape(1, -1, 3) for view in views], [v.pixels[side].reshape(1, -1, 2) for v in views]


def _fisheye_flag(name: str, value: int) -> int:
    """Return a flag of cv2.fisheye, which OpenCV 5 has elsewhere."""
    for place in (cv2.fisheye, cv2):
        if hasattr(place, f"CALIB_{name}"):
            return int(getattr(place, f"CALIB_{name}"))
    return value


def _lists(views: Sequence[_View], side: int) -> tuple[list[Any], list[Any]]:
    return [view.points.astype(np.float32) for view in views], [v.pixels[side].astype(np.float32) for v in views]


def _rms(rest: Array) -> float:
    return float(np.sqrt((rest**2).sum(axis=1).mean()))


def _graded(rig: StereoRig, views: Sequence[_View], qualities: list[PairQuality]) -> BoardCalibration:
    """Return the rig with all that tells how good it is."""
    rectified = rectification_of(rig)
    rows = []
    for view in views:
        left, right = (rectified_pixels(rig, rectified, side, view.pixels[side]) for side in (0, 1))
        apart = left[:, 1] - right[:, 1]
        view.quality.epipolar_px = float(np.sqrt((apart**2).mean()))
        rows.append(apart)
    apart = np.concatenate(rows)
    weights = [len(view.points) for view in views]
    errors = np.array([view.quality.reprojection_px for view in views], np.float64)
    size = rig.size
    assert size is not None
    covered = _coverage([view.pixels[0] for view in views], size), _coverage([view.pixels[1] for view in views], size)
    doubts = []
    if len(views) < _GOOD_PAIRS:
        doubts.append(f"only {len(views)} pairs were used; {_GOOD_PAIRS} to 20 are better")
    for side, share in zip(("left", "right"), covered, strict=True):
        if share < _COVERAGE:
            doubts.append(
                f"the board covers {100 * share:.0f} % of the {side} image; hold it into the corners too, "
                "where distortion is largest"
            )
    tilt = _tilt(rig, views)
    if tilt < _TILT_DEGREES:
        doubts.append(f"the board is tilted by {tilt:.0f} degrees at most; tilt it by 30 and more, in all directions")
    return BoardCalibration(
        rig,
        float(np.sqrt(np.average(errors**2, weights=weights))),
        float(np.sqrt((apart**2).mean())),
        float(np.abs(apart).max()),
        covered,
        qualities,
        doubts,
    )


def rectification_of(rig: StereoRig) -> Rectification:
    """Return the rectification of a rig; for a very wide lens that at the focal length of the raw one."""
    try:
        return rig.rectification()
    except OptionError:  # a very wide lens
        return rig.rectification(focal=float(rig.left.matrix[0, 0]))


def rectified_pixels(rig: StereoRig, rectified: Rectification, side: int, pixels: Array) -> Array:
    """Return where raw pixels of a camera lie in its rectified image, (n, 2) float64."""
    camera = (rig.left, rig.right)[side]
    turn, projection = rectified.turns[side], rectified.projections[side][:, :3]
    points = pixels.reshape(-1, 1, 2)
    if camera.model == "fisheye":
        flat = cv2.fisheye.undistortPoints(points, camera.matrix, camera.distortion, R=turn, P=projection)
    else:
        distortion = camera.distortion if len(camera.distortion) else np.zeros(5)
        flat = _undistorted(points, camera.matrix, distortion, turn, projection)
    return np.asarray(flat, np.float64).reshape(-1, 2)


def _undistorted(points: Array, camera: Array, distortion: Array, turn: Array, projection: Array) -> Any:
    """Return points without distortion, with as many iterations as it takes: five are too few at the sides."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        return cv2.undistortPointsIter(points, camera, distortion, turn, projection, criteria)
    return cv2.undistortPoints(points, camera, distortion, None, turn, projection, criteria)


def _coverage(pixels: Sequence[Array], size: tuple[int, int]) -> float:
    cells = np.zeros(_GRID, bool)
    for some in pixels:
        x, y = (np.clip(some[:, k] * _GRID[k] / size[k], 0, _GRID[k] - 1).astype(int) for k in (0, 1))
        cells[x, y] = True
    return float(cells.mean())


def _tilt(rig: StereoRig, views: Sequence[_View]) -> float:
    """Return the largest angle between the board and the left image plane, or between two boards, degrees."""
    normals = []
    for view in views:
        flat = directions(rig.left, view.pixels[0])
        done, turn, _ = cv2.solvePnP(view.points, flat, np.eye(3), None)
        if done:
            normals.append(cv2.Rodrigues(turn)[0][:, 2] * np.sign(cv2.Rodrigues(turn)[0][2, 2]))
    if not normals:
        return 0.0
    cosines = np.clip(np.array(normals) @ np.array(normals).T, -1, 1)
    return float(np.degrees(np.arccos(cosines.min())))


def directions(camera: Camera, pixels: Array) -> Array:
    """Return raw pixels as directions, x and y at a depth of 1, (n, 2) float64."""
    points = pixels.reshape(-1, 1, 2)
    if camera.model == "fisheye":
        flat = cv2.fisheye.undistortPoints(points, camera.matrix, camera.distortion)
    else:
        distortion = camera.distortion if len(camera.distortion) else np.zeros(5)
        flat = _undistorted(points, camera.matrix, distortion, np.eye(3), np.eye(3))
    return np.asarray(flat, np.float64).reshape(-1, 2)


def rows_picture(left: NDArray[Any], right: NDArray[Any], lines: int = 20) -> NDArray[np.uint8]:
    """Return a rectified pair side by side with lines along its rows: what lies on a line in one does so in the other.

    Parameters
    ----------
    left, right : (H, W) or (H, W, 3)
    lines : int
        How many.

    Returns
    -------
    (H, 2 W, 3) uint8
        RGB.
    """
    shades = [np.asarray(display_8bit(np.asarray(image)), np.uint8) for image in (left, right)]
    both = np.concatenate(
        [image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2) for image in shades], 1
    )
    picture = np.ascontiguousarray(both)
    colors = ((255, 80, 60), (80, 220, 90), (70, 150, 255))
    thickness = max(1, round(picture.shape[0] / 900))
    for number in range(1, lines + 1):
        y = round(number * picture.shape[0] / (lines + 1))
        cv2.line(picture, (0, y), (picture.shape[1] - 1, y), colors[number % 3], thickness, cv2.LINE_AA)
    return picture
