"""Planar patches seen by a rectified stereo pair: exact disparity, visibility and occlusion in both views.

A patch is a rectangle in space, optionally cut out by a bit mask. Seen from the left camera its disparity
is ``d(x, y) = a*x + b*y + c``, and its rectangle is four inequalities that are linear in ``x`` and ``y``. A
right pixel ``x_r`` of the same patch satisfies ``x_r = x - d(x, y)``, so ``x = (x_r + b*y + c) / (1 - a)``,
which is again linear. Both views are therefore drawn from the same functions, without warping one into the
other, and the ground truth has no holes and no rounding but that of the number type.

Axes: X right, Y down, Z forward, metres, the left camera at the origin. Pixel centres are whole numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.textures import Look

__all__ = ["Camera", "Patch", "Plane", "covers", "occlusion", "plane_of", "rasterise", "texture_coordinates"]

_NEAR_M = 0.2  # what is nearer than this to the camera plane is cut off
_EPSILON_PX = 1e-6  # a surface must be nearer by more than this to occlude

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A rectified pair: focal length and principal point in pixels, baseline in metres."""

    focal: float
    cx: float
    cy: float
    baseline_m: float


@dataclass(frozen=True)
class Patch:
    """A rectangle in space.

    Attributes
    ----------
    origin : tuple of 3 float
        The corner with ``u = v = 0``, metres.
    u_axis, v_axis : tuple of 3 float
        Orthonormal directions along the width and the height.
    width_m, height_m : float
        Extent in metres.
    look : Look
        The appearance.
    object_id : int
        0 for background, else the number of the object it belongs to.
    mask : (h, w) bool or None
        Cut-out: the patch exists where ``mask[int(v / height_m * h), int(u / width_m * w)]`` is True.
    """

    origin: tuple[float, float, float]
    u_axis: tuple[float, float, float]
    v_axis: tuple[float, float, float]
    width_m: float
    height_m: float
    look: Look
    object_id: int = 0
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Plane:
    """A patch as one view sees it; every form ``(p, q, r)`` stands for ``p*x + q*y + r``.

    Attributes
    ----------
    disparity, inverse_depth, u, v : (3,) float64
        Forms of the disparity, of 1/Z, and of u/Z and v/Z.
    left_x : (3,) float64
        Form of the left column that this view's pixel corresponds to.
    box : tuple of 4 float
        Smallest and largest x, smallest and largest y of the rectangle in this view.
    patch : Patch
        The patch in space.
    """

    disparity: Float
    inverse_depth: Float
    u: Float
    v: Float
    left_x: Float
    box: tuple[float, float, float, float]
    patch: Patch


def _corners(patch: Patch) -> Float:
    """Return the rectangle's corners in space, cut at the near plane: (n, 3), n = 0 if all is behind it."""
    origin, u, v = (np.asarray(p, np.float64) for p in (patch.origin, patch.u_axis, patch.v_axis))
    u, v = u * patch.width_m, v * patch.height_m
    ring = [origin, origin + u, origin + u + v, origin + v]
    corners: list[Float] = []
    for p, q in zip(ring, ring[1:] + ring[:1], strict=True):
        if p[2] >= _NEAR_M:
            corners.append(p)
        if (p[2] >= _NEAR_M) != (q[2] >= _NEAR_M):
            corners.append(p + (q - p) * (_NEAR_M - p[2]) / (q[2] - p[2]))
    return np.array(corners, np.float64).reshape(-1, 3)


def plane_of(patch: Patch, camera: Camera, *, right: bool = False) -> Plane | None:
    """Return `patch` as the left or the right view sees it, None if it is invisible.

    That is a patch behind the camera, or one whose plane holds the left camera or separates the two.
    """
    corners = _corners(patch)
    if not len(corners):
        return None
    origin, u, v = (np.asarray(p, np.float64) for p in (patch.origin, patch.u_axis, patch.v_axis))
    normal = np.cross(u, v)
    distance = float(normal @ origin)
    if abs(distance) < 1e-9:
        return None

    def form(w: Float) -> Float:
        slope = w[:2] / camera.focal
        return np.array([slope[0], slope[1], w[2] - slope[0] * camera.cx - slope[1] * camera.cy])

    inverse_depth = form(normal) / distance
    disparity = camera.focal * camera.baseline_m * inverse_depth
    forms = [
        disparity,
        inverse_depth,
        form(u) - (u @ origin) * inverse_depth,
        form(v) - (v @ origin) * inverse_depth,
    ]
    left_x = np.array([1.0, 0.0, 0.0])
    a, b, c = disparity
    if a >= 0.999:
        return None
    shift = 0.0
    if right:
        left_x = np.array([1.0, b, c]) / (1.0 - a)
        forms = [p[0] * left_x + np.array([0.0, p[1], p[2]]) for p in forms]
        shift = camera.baseline_m
    x = camera.cx + camera.focal * (corners[:, 0] - shift) / corners[:, 2]
    y = camera.cy + camera.focal * corners[:, 1] / corners[:, 2]
    box = (float(x.min()), float(x.max()), float(y.min()), float(y.max()))
    return Plane(forms[0], forms[1], forms[2], forms[3], left_x, box, patch)


def _evaluate(form: Float, x: Float, y: Float) -> Float:
    return np.asarray(form[0] * x + (form[1] * y + form[2]))


def covers(plane: Plane, x: Float, y: Float) -> NDArray[np.bool_]:
    """Return where `plane` exists, for positions `x` and `y` of its view that broadcast together."""
    patch = plane.patch
    inverse = _evaluate(plane.inverse_depth, x, y)
    u, v = _evaluate(plane.u, x, y), _evaluate(plane.v, x, y)
    inside = (u >= 0) & (v >= 0) & (u < patch.width_m * inverse) & (v < patch.height_m * inverse)
    if patch.mask is not None and inside.any():
        rows, columns = patch.mask.shape
        safe = np.where(inside, inverse, 1.0)
        j = np.where(inside, u / safe * (columns / patch.width_m), 0.0).astype(np.intp)
        i = np.where(inside, v / safe * (rows / patch.height_m), 0.0).astype(np.intp)
        inside &= patch.mask[np.minimum(i, rows - 1), np.minimum(j, columns - 1)]
    return np.asarray(inside)


def _window(low: float, high: float, first: float, size: int) -> slice:
    """Return the slice of ``first + arange(size)`` that holds every position within [low, high]."""
    start = max(0, int(np.floor(np.clip(low - first, -1, size))))
    stop = min(size, int(np.ceil(np.clip(high - first, -1, size))) + 1)
    return slice(start, max(start, stop))


def rasterise(planes: Sequence[Plane | None], x: Float, y: Float) -> tuple[NDArray[np.int16], Float]:
    """Return which patch is nearest at each position of one view, and its disparity there.

    Parameters
    ----------
    planes : sequence of Plane or None
        All patches in that view.
    x : (W,) float64
        Columns, one apart.
    y : (H,) float64
        Rows, one apart.

    Returns
    -------
    surface : (H, W) int16
        1 + index of the nearest patch, 0 where there is none (sky).
    disparity : (H, W) float64, pixels
        Its disparity, 0 for the sky.
    """
    surface = np.zeros((y.size, x.size), np.int16)
    disparity = np.zeros((y.size, x.size), np.float64)
    for index, plane in enumerate(planes):
        if plane is None:
            continue
        columns = _window(plane.box[0], plane.box[1], float(x[0]), x.size)
        rows = _window(plane.box[2], plane.box[3], float(y[0]), y.size)
        xs, ys = x[None, columns], y[rows, None]
        if not xs.size or not ys.size:
            continue
        d = _evaluate(plane.disparity, xs, ys)
        nearer = (d > disparity[rows, columns]) & covers(plane, xs, ys)
        np.copyto(disparity[rows, columns], d, where=nearer)
        np.copyto(surface[rows, columns], np.int16(index + 1), where=nearer)
    return surface, disparity


def occlusion(planes: Sequence[Plane | None], disparity: Float) -> NDArray[np.bool_]:
    """Return which left pixels the right view does not see.

    Parameters
    ----------
    planes : sequence of Plane or None
        All patches as the right view sees them.
    disparity : (H, W) float64, pixels
        Truth of the left view at the pixel centres.

    Returns
    -------
    (H, W) bool
        True where the corresponding position lies left of the right image, or a nearer patch covers it.
        The test is made at the exact position, not at the nearest right pixel.
    """
    height, width = disparity.shape
    x = np.arange(width, dtype=np.float64) - disparity
    y = np.arange(height, dtype=np.float64)
    hidden = x < 0
    reach = float(disparity.max(initial=0.0))
    for plane in planes:
        if plane is None:
            continue
        columns = _window(plane.box[0], plane.box[1] + reach, 0.0, width)
        rows = _window(plane.box[2], plane.box[3], 0.0, height)
        xs, ys = x[rows, columns], y[rows, None]
        if not xs.size:
            continue
        nearer = _evaluate(plane.disparity, xs, ys) > disparity[rows, columns] + _EPSILON_PX
        if nearer.any():
            hidden[rows, columns] |= nearer & covers(plane, xs, ys)
    return np.asarray(hidden)


def texture_coordinates(plane: Plane, x: Float, y: Float) -> tuple[Float, Float, Float, Float]:
    """Return where on the patch the view positions `x`, `y`, each (n,), lie.

    Returns
    -------
    u, v, depth, step : (n,) float64
        Place on the patch, distance Z, and how far one pixel of the left view reaches on the patch, metres.
        The reach is that along a row, or half of that along a column: what is too fine along a column looks
        the same in both views, so some of it may stay.
    """
    inverse = _evaluate(plane.inverse_depth, x, y)
    depth = 1.0 / inverse
    u, v = _evaluate(plane.u, x, y) * depth, _evaluate(plane.v, x, y) * depth
    per_left = 1.0 / plane.left_x[0]  # dx_view / dx_left
    reach = []
    for k, scale in ((0, per_left), (1, 0.5)):
        du = (plane.u[k] - u * plane.inverse_depth[k]) * depth * scale
        dv = (plane.v[k] - v * plane.inverse_depth[k]) * depth * scale
        reach.append(np.sqrt(du * du + dv * dv))
    return u, v, depth, np.maximum(reach[0], reach[1])
