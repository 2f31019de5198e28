"""Synthetic stereo cameras with exact truth: a scene of which every ray's depth is known, seen through any lens.

A raw image is drawn pixel by pixel: the lens model is inverted (`cv2.undistortPoints`, to 1e-12), the ray meets the
scene, and the scene's texture is an exact function of the point that it meets. Nothing of stereokit is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

SIZE = (320, 240)
R = cv2.Rodrigues(np.array([0.02, -0.03, 0.015]))[0]
T = np.array([-0.12, 0.004, 0.006])
K1 = np.array([[260.0, 0, 163], [0, 262.0, 117], [0, 0, 1]])
K2 = np.array([[255.0, 0, 158], [0, 256.0, 122], [0, 0, 1]])
LENSES = {
    "pinhole 0": ((), ()),
    "pinhole 4": ((-0.25, 0.08, 0.001, -0.0008), (-0.24, 0.07, -0.0006, 0.0011)),
    "pinhole 5": ((-0.28, 0.1, 0.001, -0.0008, -0.02), (-0.26, 0.09, -0.0006, 0.0011, -0.015)),
    "pinhole 8": ((0.5, 0.1, 0.0005, -0.0004, 0.01, 0.75, 0.15, 0.02),
                  (0.45, 0.1, 0.0003, 0.0004, 0.01, 0.7, 0.15, 0.02)),
    "pinhole 12": (
        (-0.2, 0.05, 0.001, -0.001, 0.0, 0.02, 0.0, 0.0, 0.004, -0.002, 0.003, 0.001),
        (-0.2, 0.05, 0.0, 0.001, 0.0, 0.02, 0.0, 0.0, -0.003, 0.002, 0.002, -0.001),
    ),
    "pinhole 14": (
        (-0.2, 0.05, 0.001, -0.001, 0.0, 0.02, 0.0, 0.0, 0.004, -0.002, 0.003, 0.001, 0.02, -0.015),
        (-0.2, 0.05, 0.0, 0.001, 0.0, 0.02, 0.0, 0.0, -0.003, 0.002, 0.002, -0.001, -0.01, 0.02),
    ),
    "fisheye": ((0.05, -0.01, 0.004, -0.001), (0.04, -0.008, 0.003, -0.0006)),
}  # fmt: skip
FISHEYE_K = (
    np.array([[150.0, 0, 161], [0, 151.0, 118], [0, 0, 1]]),
    np.array([[148.0, 0, 158], [0, 148.5, 121], [0, 0, 1]]),
)


@dataclass
class Rig:
    """Two raw cameras: matrices, coefficients, whether they are fisheyes, and the pose of the right one."""

    k: tuple
    d: tuple
    fisheye: bool
    r: np.ndarray
    t: np.ndarray


def rig_of(name: str) -> Rig:
    fisheye = name == "fisheye"
    d = tuple(np.array(one, float) for one in LENSES[name])
    return Rig(FISHEYE_K if fisheye else (K1, K2), d, fisheye, R, T)


def project(rig: Rig, side: int, points: np.ndarray) -> np.ndarray:
    """Return the raw pixels, (n, 2), of points, (n, 3), in the left camera's frame."""
    turn, step = (np.eye(3), np.zeros(3)) if side == 0 else (rig.r, rig.t)
    vector = cv2.Rodrigues(turn)[0]
    if rig.fisheye:
        return cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), vector, step, rig.k[side], rig.d[side])[0].reshape(
            -1, 2
        )
    d = rig.d[side] if len(rig.d[side]) else None
    return cv2.projectPoints(points.reshape(-1, 1, 3), vector, step, rig.k[side], d)[0].reshape(-1, 2)


_rays: dict[tuple, np.ndarray] = {}


def rays(rig: Rig, side: int, size=SIZE) -> np.ndarray:
    """Return the direction (x, y, 1) of every raw pixel in its camera's frame, (H, W, 3), exact to 1e-9."""
    key = rig.fisheye, rig.k[side].tobytes(), rig.d[side].tobytes(), size
    if key not in _rays:
        _rays[key] = _all_rays(rig, side, size)
    return _rays[key]


def _all_rays(rig: Rig, side: int, size: tuple[int, int]) -> np.ndarray:
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    k, d = rig.k[side], rig.d[side]
    if rig.fisheye:
        flat = cv2.fisheye.undistortPoints(pixels, k, d).reshape(-1, 2)
    else:
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
        coefficients, same = d if len(d) else np.zeros(5), np.eye(3)
        if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
            flat = cv2.undistortPointsIter(pixels, k, coefficients, same, same, criteria)
        else:
            flat = cv2.undistortPoints(pixels, k, coefficients, criteria=criteria)
        flat = flat.reshape(-1, 2)
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1).reshape(size[1], size[0], 3)


def texture(points: np.ndarray) -> np.ndarray:
    """Return the grey level, 0 to 255, of points in space: waves of many directions and lengths."""
    rng = np.random.default_rng(5)
    level = np.zeros(points.shape[:-1])
    for _ in range(60):
        direction = rng.normal(size=3)
        direction *= rng.uniform(60, 500) / np.linalg.norm(direction)  # radians a metre
        level += np.sin(points @ direction + rng.uniform(0, 6.28))
    return np.clip(127 + 20 * level, 0, 255)


NORMAL, DISTANCE = np.array([0.12, -0.2, 1.0]), 0.9
"""The scene: the plane of all points with ``NORMAL @ point == DISTANCE``, metres, in the left camera's frame."""
BALL, RADIUS = np.array([0.06, 0.03, 0.72]), 0.12
"""And a ball before it."""


def meet(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return where rays meet the scene, (..., 3); NaN where they do not."""
    along = (DISTANCE - origin @ NORMAL) / (directions @ NORMAL)
    along = np.where(along > 0, along, np.nan)
    b = directions @ (origin - BALL)
    a = np.sum(directions * directions, axis=-1)
    inner = b * b - a * (np.sum((origin - BALL) ** 2) - RADIUS**2)
    with np.errstate(invalid="ignore"):
        near = (-b - np.sqrt(inner)) / a
    along = np.where((inner > 0) & (near > 0), np.fmin(near, along), along)
    return origin + along[..., None] * directions


def raw_pair(rig: Rig, size=SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Return the raw images of the scene, uint8."""
    images = []
    for side in (0, 1):
        turn, step = (np.eye(3), np.zeros(3)) if side == 0 else (rig.r, rig.t)
        directions = rays(rig, side, size) @ turn  # into the left camera's frame: turn.T @ ray
        points = meet(-turn.T @ step, directions)
        images.append(np.rint(np.nan_to_num(texture(points))).astype(np.uint8))
    return images[0], images[1]


def true_depth(r1: np.ndarray, camera: tuple[float, float, float, float], size: tuple[int, int]) -> np.ndarray:
    """Return the depth of each pixel of the rectified left camera, whose frame is turned by `r1` (``fx fy cx cy``)."""
    fx, fy, cx, cy = camera
    x, y = np.meshgrid((np.arange(size[0]) - cx) / fx, (np.arange(size[1]) - cy) / fy)
    directions = np.stack([x, y, np.ones_like(x)], axis=-1) @ r1
    return (meet(np.zeros(3), directions) @ r1.T)[..., 2]


def board_pose(number: int, count: int, center: np.ndarray, distance=0.45) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation and translation that put a board before the left camera: tilted, turned, over the whole view."""
    rng = np.random.default_rng([9, number])
    turn = cv2.Rodrigues(np.array([*rng.uniform(-0.55, 0.55, 2), rng.uniform(-0.3, 0.3)]))[0]
    side = 2.0 * np.pi * number / count
    reach = 0.0 if number % 4 == 0 else 0.4
    place = distance * rng.uniform(0.9, 1.4) * np.array([0.06 + reach * np.cos(side), 0.75 * reach * np.sin(side), 1.0])
    return turn, place - turn @ center


def board_image(rig: Rig, side: int, pose, draw, size=SIZE) -> np.ndarray:
    """Return the raw image of a board, uint8; `draw` gives levels, 0 to 1, of places on it, a pixel being so wide."""
    turn, step = (np.eye(3), np.zeros(3)) if side == 0 else (rig.r, rig.t)
    turn, step = turn @ pose[0], turn @ pose[1] + step
    directions = rays(rig, side, size) @ turn  # in the board's frame
    origin = -turn.T @ step
    along = -origin[2] / directions[..., 2]
    place = origin[:2] + along[..., None] * directions[..., :2]
    place[along <= 0] = 1e6
    across = np.linalg.norm(np.diff(place, axis=1, append=place[:, -1:]), axis=-1)
    across[:, -1] = across[:, -2]
    down = np.linalg.norm(np.diff(place, axis=0, append=place[-1:]), axis=-1)
    down[-1] = down[-2]
    return np.rint(255 * draw(place, np.maximum(across, down))).astype(np.uint8)


def chessboard(columns: int, rows: int, square: float):
    """Return what `board_image` draws: a chessboard of so many inner corners with a white border, grey around."""

    def draw(place, width):
        u, v = place[..., 0] / square, place[..., 1] / square  # the first inner corner is at (0, 0)
        waves = [np.clip(np.sin(np.pi * w) / (np.pi * np.maximum(width / square, 1e-6)), -1, 1) for w in (u, v)]
        level = 0.5 + 0.42 * waves[0] * waves[1]
        white = (u < -1) | (u > columns) | (v < -1) | (v > rows)
        outside = (u < -2) | (u > columns + 1) | (v < -2) | (v > rows + 1)
        return np.where(outside, 0.45, np.where(white, 0.92, level))

    return draw, np.array([(columns - 1) / 2 * square, (rows - 1) / 2 * square, 0])


def charuco(columns: int, rows: int, square: float, marker: float, dictionary=cv2.aruco.DICT_4X4_50, legacy=False):
    """Return what `board_image` draws: a ChArUco board of so many squares."""
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, cv2.aruco.getPredefinedDictionary(dictionary))
    board.setLegacyPattern(legacy)
    fine = 40  # pixels a square
    picture = board.generateImage((columns * fine, rows * fine), marginSize=0).astype(np.float32) / 255
    picture = cv2.GaussianBlur(
        cv2.copyMakeBorder(picture, fine, fine, fine, fine, cv2.BORDER_CONSTANT, value=1), (0, 0), 1.2
    )

    def draw(place, width):
        x, y = (place / square * fine + fine - 0.5).astype(np.float32).transpose(2, 0, 1)
        level = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.45)
        return 0.08 + 0.84 * level

    return draw, np.array([columns / 2 * square, rows / 2 * square, 0])
