"""The visible triangle at each sample of a view: homogeneous coordinates, exact at any position.

A triangle with the corners ``v0, v1, v2`` (camera coordinates, Z forward) covers the ray ``p = (x, y, 1)`` where the
three products ``(v1 x v2) . p``, ``(v2 x v0) . p``, ``(v0 x v1) . p`` have one sign; their sum over the determinant is
the inverse depth there (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997). Nothing
has to be clipped, and triangles that share an edge leave no crack: the edge's product is the same number in both,
negated. All arithmetic is float64, one IEEE operation at a time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["MASK_SIZE", "edge_functions", "hidden", "visible"]

Float = NDArray[np.float64]

MASK_SIZE = 256
"""Side of a cut-out mask, samples."""

_NEAR = 1e-6


@njit(cache=True, nogil=True, error_model="numpy")
def edge_functions(points: Float, faces: NDArray[np.int32]) -> Float:
    """Return the edge functions of every triangle.

    Parameters
    ----------
    points : (N, 3) float64
        Corners in camera coordinates.
    faces : (M, 3) int32
        Rows of `points`.

    Returns
    -------
    (M, 10) float64
        Three normals, turned so that inside is positive, and 1 over the determinant; 0 there for a triangle seen
        from its edge.
    """
    out = np.zeros((faces.shape[0], 10))
    for m in range(faces.shape[0]):
        a, b, c = points[faces[m, 0]], points[faces[m, 1]], points[faces[m, 2]]
        out[m, 0], out[m, 1], out[m, 2] = (
            b[1] * c[2] - b[2] * c[1],
            b[2] * c[0] - b[0] * c[2],
            b[0] * c[1] - b[1] * c[0],
        )
        out[m, 3], out[m, 4], out[m, 5] = (
            c[1] * a[2] - c[2] * a[1],
            c[2] * a[0] - c[0] * a[2],
            c[0] * a[1] - c[1] * a[0],
        )
        out[m, 6], out[m, 7], out[m, 8] = (
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        )
        det = a[0] * out[m, 0] + a[1] * out[m, 1] + a[2] * out[m, 2]
        if det < 0:
            for k in range(9):
                out[m, k] = -out[m, k]
            det = -det
        out[m, 9] = 1.0 / det if det > 1e-30 else 0.0
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _rows(points: Float, face: Any, focal: float, cy: float, y0: float, dy: float, count: int) -> tuple[int, int]:
    """Return the first and last + 1 of the rows ``y0 + k * dy`` that a triangle may touch."""
    low, high = 1e300, -1e300
    for k in range(3):
        z = points[face[k], 2]
        if z <= _NEAR:
            return 0, count
        y = cy + focal * points[face[k], 1] / z
        low, high = min(low, y), max(high, y)
    first = max(0.0, min(float(count), np.ceil((low - y0) / dy - 1e-6)))
    last = max(-1.0, min(float(count - 1), np.floor((high - y0) / dy + 1e-6)))
    return int(first), int(last) + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _span(edges: Any, py: float) -> tuple[float, float]:
    """Return the interval of `x` on the row `py` that a triangle covers, both in units of the focal length."""
    low, high = -1e300, 1e300
    for k in range(3):
        slope, rest = edges[3 * k], edges[3 * k + 1] * py + edges[3 * k + 2]
        if slope > 0:
            low = max(low, -rest / slope)
        elif slope < 0:
            high = min(high, -rest / slope)
        elif rest < 0:
            return 1.0, 0.0
    return low, high


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(uv: Float, face: Any, e0: float, e1: float, e2: float, mask: Any) -> bool:
    """Return whether a cut-out mask has a hole at a point; the point is the weights of the corners."""
    total = e0 + e1 + e2
    s = (e0 * uv[face[0], 2] + e1 * uv[face[1], 2] + e2 * uv[face[2], 2]) / total
    t = (e0 * uv[face[0], 3] + e1 * uv[face[1], 3] + e2 * uv[face[2], 3]) / total
    column = int(np.floor(s * MASK_SIZE)) & (MASK_SIZE - 1)
    row = int(np.floor(t * MASK_SIZE)) & (MASK_SIZE - 1)
    return bool(mask[row, column] == 0)


@njit(cache=True, nogil=True, error_model="numpy")
def visible(
    points: Float,
    faces: NDArray[np.int32],
    edges: Float,
    uv: Float,
    face_mask: NDArray[np.int32],
    masks: NDArray[np.uint8],
    focal: float,
    cx: float,
    cy: float,
    x0: float,
    dx: float,
    columns: int,
    y0: float,
    dy: float,
    rows: int,
) -> tuple[NDArray[np.int32], Float]:
    """Return which triangle each sample shows, and its inverse depth.

    Parameters
    ----------
    points, faces : (N, 3) float64, (M, 3) int32
        The triangles, in the view's camera coordinates.
    edges : (M, 10) float64
        Of `edge_functions`.
    uv : (N, 4) float64
        Coordinates of the corners; the last two address the cut-out mask.
    face_mask : (M,) int32
        Which mask a triangle is cut by, -1 for none.
    masks : (K, MASK_SIZE, MASK_SIZE) uint8
        0 where there is a hole.
    focal, cx, cy : float
        Camera, pixels.
    x0, dx, columns, y0, dy, rows : float and int
        Positions of the samples, pixels: ``x0 + k * dx``, ``y0 + k * dy``.

    Returns
    -------
    face : (rows, columns) int32
        Row of `faces`, -1 where nothing is.
    inverse : (rows, columns) float64
        1 / Z, 0 where nothing is.
    """
    shown = np.full((rows, columns), -1, np.int32)
    inverse = np.zeros((rows, columns))
    rays = (x0 + dx * np.arange(columns) - cx) / focal
    for m in range(faces.shape[0]):
        e = edges[m]
        scale = e[9]
        if scale == 0:
            continue
        first, last = _rows(points, faces[m], focal, cy, y0, dy, rows)
        mask = face_mask[m]
        for r in range(first, last):
            py = (y0 + r * dy - cy) / focal
            low, high = _span(e, py)
            if low > high + 1e-9:
                continue
            left = max(0.0, min(float(columns), np.ceil((cx + focal * low - x0) / dx - 1e-6)))
            right = max(-1.0, min(float(columns - 1), np.floor((cx + focal * high - x0) / dx + 1e-6)))
            c0, c1, c2 = e[1] * py + e[2], e[4] * py + e[5], e[7] * py + e[8]
            for k in range(int(left), int(right) + 1):
                px = rays[k]
                e0, e1, e2 = e[0] * px + c0, e[3] * px + c1, e[6] * px + c2
                if e0 < 0 or e1 < 0 or e2 < 0:
                    continue
                near = (e0 + e1 + e2) * scale
                if near > inverse[r, k]:
                    if mask >= 0 and _cut(uv, faces[m], e0, e1, e2, masks[mask]):
                        continue
                    inverse[r, k] = near
                    shown[r, k] = m
    return shown, inverse


@njit(cache=True, nogil=True, error_model="numpy")
def hidden(
    points: Float,
    faces: NDArray[np.int32],
    edges: Float,
    uv: Float,
    face_mask: NDArray[np.int32],
    masks: NDArray[np.uint8],
    focal: float,
    cx: float,
    cy: float,
    x: Float,
    inverse: Float,
    slack: float,
) -> NDArray[np.bool_]:
    """Return which points something nearer covers in a view; exact at their positions.

    Parameters
    ----------
    points, faces, edges, uv, face_mask, masks, focal, cx, cy
        As for `visible`.
    x : (H, W) float64
        Columns of the points, ascending along each row; row k of the view holds row k of the points.
    inverse : (H, W) float64
        Their inverse depths.
    slack : float
        What is nearer by less than this inverse depth does not hide.

    Returns
    -------
    (H, W) bool
    """
    out = np.zeros(x.shape, np.bool_)
    for m in range(faces.shape[0]):
        e = edges[m]
        scale = e[9]
        if scale == 0:
            continue
        first, last = _rows(points, faces[m], focal, cy, 0.0, 1.0, x.shape[0])
        mask = face_mask[m]
        for r in range(first, last):
            py = (r - cy) / focal
            low, high = _span(e, py)
            if low > high + 1e-9:
                continue
            begin, end = cx + focal * low - 1e-6, cx + focal * high + 1e-6
            c0, c1, c2 = e[1] * py + e[2], e[4] * py + e[5], e[7] * py + e[8]
            for k in range(np.searchsorted(x[r], begin), x.shape[1]):
                if x[r, k] > end:
                    break
                px = (x[r, k] - cx) / focal
                e0, e1, e2 = e[0] * px + c0, e[3] * px + c1, e[6] * px + c2
                if e0 < 0 or e1 < 0 or e2 < 0 or (e0 + e1 + e2) * scale <= inverse[r, k] + slack:
                    continue
                if mask >= 0 and _cut(uv, faces[m], e0, e1, e2, masks[mask]):
                    continue
                out[r, k] = True
    return out
