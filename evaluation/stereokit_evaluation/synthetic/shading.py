"""The brightness of each sample: texture, sun with shadows, a lamp, gloss and mirrors that depend on the view."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.bank import LEVELS, SIZE, STARTS, TOTAL

__all__ = ["LIGHT", "MATERIAL", "shade"]

Float = NDArray[np.float64]

MATERIAL = (
    "texture",
    "turn_x",
    "turn_y",
    "shift_x",
    "shift_y",
    "albedo",
    "contrast",
    "detail",
    "detail_x",
    "detail_y",
    "detail_contrast",
    "gloss",
    "sharpness",
    "mirror",
    "emission",
    "clear",
)
"""Columns of a material: slots of its two textures, repeats per metre along their axes, and what they do."""

LIGHT = (
    "sun_x",
    "sun_y",
    "sun_z",
    "sun",
    "ambient",
    "up_x",
    "up_y",
    "up_z",
    "lamp_x",
    "lamp_y",
    "lamp_z",
    "lamp",
    "around",
    "around_level",
    "around_gain",
    "around_radius",
    "sky_low",
    "sky_high",
    "clouds",
    "fog",
    "fog_brightness",
    "shadow_bias",
)
"""Entries of the light; directions and places are in the left camera's coordinates."""

_LEVELS, _SIZE, _STRIDE = LEVELS, SIZE, TOTAL
_STARTS = tuple(int(start) for start in STARTS)


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(bank: Any, slot: int, u: float, v: float, level: int) -> float:
    """Return a texture at (u, v) repeats, bilinear, in -0.5..0.5."""
    side = _SIZE >> level
    x, y = u * side - 0.5, v * side - 0.5
    fx, fy = np.floor(x), np.floor(y)
    ax, ay = x - fx, y - fy
    x0, y0 = int(fx) & (side - 1), int(fy) & (side - 1)
    x1, y1 = (x0 + 1) & (side - 1), (y0 + 1) & (side - 1)
    start = slot * _STRIDE + _STARTS[level]
    top = (1 - ax) * bank[start + y0 * side + x0] + ax * bank[start + y0 * side + x1]
    low = (1 - ax) * bank[start + y1 * side + x0] + ax * bank[start + y1 * side + x1]
    return float(((1 - ay) * top + ay * low) / 255.0 - 0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _level(footprint: float) -> int:
    level = 0
    while footprint > 1.4 and level < _LEVELS - 1:
        footprint *= 0.5
        level += 1
    return level


@njit(cache=True, nogil=True, error_model="numpy")
def _around(bank: Any, light: Float, x: float, y: float, z: float) -> float:
    """Return the surroundings of the scene in a direction, on an octahedron unfolded to a square."""
    total = abs(x) + abs(y) + abs(z) + 1e-12
    u, v = x / total, z / total
    if y > 0:
        a, b = (1 - abs(v)) * (1 if u >= 0 else -1), (1 - abs(u)) * (1 if v >= 0 else -1)
        u, v = a, b
    got = _sample(bank, int(light[12]), 0.5 + 0.5 * u, 0.5 + 0.5 * v, int(light[13]))
    return float(max(0.0, 0.35 + got) * light[14])


@njit(cache=True, nogil=True, error_model="numpy")
def _lit(shadow: Float, turn: Float, focal: float, bias: float, x: float, y: float, z: float) -> float:
    """Return how much of the sun reaches a point, 0..1, from the inverse depths that the sun sees."""
    a = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + turn[0, 3]
    b = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + turn[1, 3]
    far = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + turn[2, 3]
    side = shadow.shape[0]
    px, py = focal * a / far + side / 2 - 0.5, focal * b / far + side / 2 - 0.5
    if px < 0 or py < 0 or px >= side - 1 or py >= side - 1:
        return 1.0
    ix, iy = int(px), int(py)
    ax, ay = px - ix, py - iy
    least = 1.0 / (far - bias)
    total = 0.0
    if shadow[iy, ix] <= least:
        total += (1 - ax) * (1 - ay)
    if shadow[iy, ix + 1] <= least:
        total += ax * (1 - ay)
    if shadow[iy + 1, ix] <= least:
        total += (1 - ax) * ay
    if shadow[iy + 1, ix + 1] <= least:
        total += ax * ay
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def shade(
    shown: NDArray[np.int32],
    inverse: Float,
    edges: Float,
    faces: NDArray[np.int32],
    uv: Float,
    normals: Float,
    face_material: NDArray[np.int32],
    materials: Float,
    bank: NDArray[np.uint8],
    light: Float,
    shadow: Float,
    sun_turn: Float,
    sun_focal: float,
    focal: float,
    cx: float,
    cy: float,
    x0: float,
    dx: float,
    y0: float,
    dy: float,
    baseline: float,
    roll_cos: float,
    roll_sin: float,
    behind: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the brightness of every sample of a view.

    Parameters
    ----------
    shown, inverse : (R, C) int32 and float64
        Of `raster.visible`.
    edges, faces, uv, normals : arrays
        The triangles as this view sees them; `normals` are in the left camera's coordinates.
    face_material : (M,) int32
        Row of `materials` of each triangle.
    materials : (K, len(MATERIAL)) float64
    bank : (slots * TOTAL,) uint8
        Pyramids of the textures in use.
    light : (len(LIGHT),) float64
    shadow, sun_turn, sun_focal : (S, S) float64, (3, 4) float64, float
        Inverse depths as the sun sees them, and its camera; (1, 1) for no shadows.
    focal, cx, cy, x0, dx, y0, dy : float
        Camera and positions of the samples, as for `raster.visible`.
    baseline, roll_cos, roll_sin : float
        Where this camera is from the left one, and how it is turned about its axis.
    behind : (R, C) float32
        What is seen through panes; (1, 1) where there are none.

    Returns
    -------
    (R, C) float32
        0 where `shown` is below -1, else about 0..1; above 1 is brighter than white.
    """
    rows, columns = shown.shape
    out = np.empty((rows, columns), np.float32)
    for r in range(rows):
        py = (y0 + r * dy - cy) / focal
        for k in range(columns):
            m = shown[r, k]
            if m < -1:
                out[r, k] = 0
                continue
            neighbour = k + 1 if r % 2 else k - 1
            if r % 2 != k % 2 and 0 <= neighbour < columns and shown[r, neighbour] == m:
                continue  # two of a pixel's four samples do where it shows one triangle: see below
            px = (x0 + k * dx - cx) / focal
            # the ray in the left camera's axes
            wx, wy = roll_cos * px + roll_sin * py, -roll_sin * px + roll_cos * py
            ray = 1.0 / np.sqrt(wx * wx + wy * wy + 1.0)
            if m < 0:
                up = -(wx * light[5] + wy * light[6] + light[7]) * ray
                value = light[16] + (light[17] - light[16]) * max(0.0, min(1.0, up * 2 + 0.1))
                if light[18] > 0:
                    value += light[18] * _sample(bank, int(light[12]), wx * ray * 0.4, wy * ray * 0.4, 1)
                out[r, k] = value
                continue
            e = edges[m]
            e0, e1, e2 = e[0] * px + e[1] * py + e[2], e[3] * px + e[4] * py + e[5], e[6] * px + e[7] * py + e[8]
            total = e0 + e1 + e2
            e0, e1, e2 = e0 / total, e1 / total, e2 / total
            a, b, c = faces[m, 0], faces[m, 1], faces[m, 2]
            z = 1.0 / inverse[r, k]
            x, y = wx * z + baseline, wy * z
            nx = e0 * normals[a, 0] + e1 * normals[b, 0] + e2 * normals[c, 0]
            ny = e0 * normals[a, 1] + e1 * normals[b, 1] + e2 * normals[c, 1]
            nz = e0 * normals[a, 2] + e1 * normals[b, 2] + e2 * normals[c, 2]
            length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
            facing = nx * wx + ny * wy + nz
            if facing > 0:
                length = -length
            nx, ny, nz = nx / length, ny / length, nz / length
            cosine = abs(facing / length) * ray
            u = e0 * uv[a, 0] + e1 * uv[b, 0] + e2 * uv[c, 0]
            v = e0 * uv[a, 1] + e1 * uv[b, 1] + e2 * uv[c, 1]
            mat = materials[face_material[m]]
            # how far a sample reaches (two of them share a pixel) on the surface, metres
            reach = 1.4 * z / focal * dx / np.sqrt(max(cosine, 0.04))
            albedo = mat[5]
            if mat[6] != 0:
                scale = np.sqrt(mat[1] * mat[1] + mat[2] * mat[2])
                albedo += mat[6] * _sample(
                    bank,
                    int(mat[0]),
                    mat[1] * u + mat[2] * v + mat[3],
                    -mat[2] * u + mat[1] * v + mat[4],
                    _level(reach * scale * _SIZE),
                )
            if mat[10] != 0:
                scale = np.sqrt(mat[8] * mat[8] + mat[9] * mat[9])
                albedo += mat[10] * _sample(
                    bank,
                    int(mat[7]),
                    mat[8] * u + mat[9] * v + mat[4],
                    -mat[9] * u + mat[8] * v + mat[3],
                    _level(reach * scale * _SIZE),
                )
                # once more, five times coarser and turned: real surfaces have detail from every distance
                albedo += mat[10] * _sample(
                    bank,
                    int(mat[7]),
                    0.2 * (mat[9] * u + mat[8] * v) + mat[3],
                    0.2 * (mat[8] * u - mat[9] * v) + mat[4],
                    _level(0.2 * reach * scale * _SIZE),
                )
            albedo = max(0.01, min(1.0, albedo))
            vx, vy, vz = -wx * ray, -wy * ray, -ray  # towards this camera
            bright = light[4] * (0.75 + 0.25 * (nx * light[5] + ny * light[6] + nz * light[7]))
            glint = 0.0
            if light[3] > 0:
                slope = nx * light[0] + ny * light[1] + nz * light[2]
                if slope > 0:
                    share = 1.0
                    if shadow.shape[0] > 1:
                        share = _lit(shadow, sun_turn, sun_focal, light[21], x, y, z)
                    bright += light[3] * slope * share
                    if mat[11] > 0 and share > 0:
                        hx, hy, hz = light[0] + vx, light[1] + vy, light[2] + vz
                        half = (nx * hx + ny * hy + nz * hz) / (np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12)
                        if half > 0:
                            for _ in range(int(mat[12])):
                                half *= half
                            glint += light[3] * half * share
            if light[11] > 0:
                lx, ly, lz = light[8] - x, light[9] - y, light[10] - z
                far = lx * lx + ly * ly + lz * lz + 1e-9
                root = np.sqrt(far)
                lx, ly, lz = lx / root, ly / root, lz / root
                slope = nx * lx + ny * ly + nz * lz
                if slope > 0:
                    strength = light[11] / far
                    bright += strength * slope
                    if mat[11] > 0:
                        hx, hy, hz = lx + vx, ly + vy, lz + vz
                        half = (nx * hx + ny * hy + nz * hz) / (np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12)
                        if half > 0:
                            for _ in range(int(mat[12])):
                                half *= half
                            glint += strength * half
            value = albedo * bright + mat[11] * glint + mat[14]
            if mat[13] > 0:
                twice = 2 * (nx * vx + ny * vy + nz * vz)
                rx, ry, rz = twice * nx - vx, twice * ny - vy, twice * nz - vz
                if light[15] > 0:  # what is around is not infinitely far: the point itself counts
                    rx, ry, rz = rx + x / light[15], ry + y / light[15], rz + z / light[15]
                graze = 1.0 - min(1.0, cosine)
                graze = graze * graze * graze * graze * graze
                share = mat[13] + (1 - mat[13]) * graze * 0.6
                value = value * (1 - share) + share * _around(bank, light, rx, ry, rz)
            if mat[15] > 0:
                value += mat[15] * behind[r, k]
            if light[19] > 0:
                clear = np.exp(-z * light[19])
                value = value * clear + light[20] * (1 - clear)
            out[r, k] = value
        for k in range(columns):
            neighbour = k + 1 if r % 2 else k - 1
            if r % 2 != k % 2 and 0 <= neighbour < columns and shown[r, neighbour] == shown[r, k]:
                out[r, k] = out[r, neighbour]
    return out
