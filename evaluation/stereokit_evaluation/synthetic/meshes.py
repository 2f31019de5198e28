"""Shapes as triangles: sheets, boxes, bodies of revolution, tubes, blobs, leaves.

Lengths are metres, x to the right, y down, z forward. A mesh carries two pairs of surface coordinates: (u, v) in
metres for the texture, and (s, t) for a cut-out mask, which covers 0..1 once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Mesh",
    "blob",
    "box",
    "cards",
    "grid",
    "heightfield",
    "lathe",
    "merge",
    "prism",
    "rotation",
    "sheet",
    "tube",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles.

    Attributes
    ----------
    points : (N, 3) float64
        Corners, metres.
    normals : (N, 3) float64
        Unit normals of the corners; the side does not matter.
    uv : (N, 4) float64
        ``u, v`` metres, ``s, t`` of the mask.
    faces : (M, 3) int32
        Rows of `points`.
    """

    points: Float
    normals: Float
    uv: Float
    faces: NDArray[np.int32]

    def moved(self, turn: Float | None = None, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
        """Return the mesh turned by the (3, 3) matrix `turn`, then shifted."""
        turn = np.eye(3) if turn is None else turn
        return Mesh(self.points @ turn.T + np.asarray(shift, np.float64), self.normals @ turn.T, self.uv, self.faces)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Return all meshes as one."""
    starts = np.cumsum([0] + [len(mesh.points) for mesh in meshes])[:-1]
    return Mesh(
        np.concatenate([mesh.points for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]),
    )


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Float:
    """Return the matrix that rolls about z, then pitches about x, then yaws about y; radians."""
    a, b, c = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll]), np.zeros((3, 3, 3))
    c[0] = [[a[0], 0, b[0]], [0, 1, 0], [-b[0], 0, a[0]]]
    c[1] = [[1, 0, 0], [0, a[1], -b[1]], [0, b[1], a[1]]]
    c[2] = [[a[2], -b[2], 0], [b[2], a[2], 0], [0, 0, 1]]
    return np.asarray(c[0] @ c[1] @ c[2])


def grid(points: Float, uv: Float) -> Mesh:
    """Return the surface through a grid of points.

    Parameters
    ----------
    points : (R, C, 3) float64
        Its corners.
    uv : (R, C, 4) float64
        Their coordinates.
    """
    rows, columns = points.shape[:2]
    down, across = np.empty_like(points), np.empty_like(points)
    down[1:-1], across[:, 1:-1] = points[2:] - points[:-2], points[:, 2:] - points[:, :-2]
    down[0], down[-1] = points[1] - points[0], points[-1] - points[-2]
    across[:, 0], across[:, -1] = points[:, 1] - points[:, 0], points[:, -1] - points[:, -2]
    normals = np.cross(across, down)
    length = np.sqrt((normals * normals).sum(axis=-1, keepdims=True))
    normals = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])
    k = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    return Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 4), faces)


def _coordinates(u: Float, v: Float) -> Float:
    """Return the coordinates of a grid with `u` metres across and `v` metres down."""
    s, t = np.meshgrid(np.linspace(0, 1, u.size), np.linspace(0, 1, v.size))
    across, down = np.meshgrid(u, v)
    return np.stack([across, down, s, t], axis=-1)


def sheet(
    width: float, height: float, bend: float = 0.0, wave: float = 0.0, waves: float = 1.0, steps: int = 1
) -> Mesh:
    """Return an upright sheet that faces the camera, centred; bent into an arc of `bend` radians, or waved.

    `wave` is the height of `waves` sine waves across, metres.
    """
    columns = steps + 1
    u, v = np.linspace(-width / 2, width / 2, columns), np.linspace(-height / 2, height / 2, 2 if steps == 1 else 5)
    if abs(bend) > 1e-6:
        radius = width / bend
        x, z = radius * np.sin(u / radius), radius * (1 - np.cos(u / radius))
    else:
        x, z = u.copy(), np.zeros(columns)
    z = z + wave * np.sin(u / width * 2 * np.pi * waves)
    points = np.empty((v.size, columns, 3))
    points[..., 0], points[..., 1], points[..., 2] = x[None], v[:, None], z[None]
    return grid(points, _coordinates(u, v))


def _cube() -> tuple[Float, Float, NDArray[np.int64], NDArray[np.int32]]:
    """Return a cube of side 1: corners and normals (24, 3), the axes across and down of each, and the faces (12, 3)."""
    corners, normals, axes, faces = [], [], [], []
    for side in range(6):
        out, sign = side // 2, 1.0 - 2 * (side % 2)
        across, down = ((2, 1), (0, 2), (0, 1))[out]
        for v in (-0.5, 0.5):
            for u in (-0.5, 0.5):
                corner, normal = np.zeros(3), np.zeros(3)
                corner[across], corner[down], corner[out], normal[out] = u, v, 0.5 * sign, sign
                corners.append(corner)
                normals.append(normal)
                axes.append((across, down))
        faces += [(4 * side, 4 * side + 1, 4 * side + 2), (4 * side + 1, 4 * side + 3, 4 * side + 2)]
    return np.array(corners), np.array(normals), np.array(axes), np.array(faces, np.int32)


_CUBE = _cube()


def box(width: float, height: float, depth: float) -> Mesh:
    """Return a box, centred; each side has its own coordinates."""
    corners, normals, axes, faces = _CUBE
    size = np.array([width, height, depth])
    points = corners * size
    uv = np.empty((24, 4))
    uv[:, :2] = np.take_along_axis(points, axes, axis=1) + 0.37 * np.repeat(np.arange(6), 4)[:, None]
    uv[:, 2:] = np.take_along_axis(corners, axes, axis=1) + 0.5
    return Mesh(points, normals, uv, faces)


def lathe(radii: Float, heights: Float, steps: int = 48, squash: float = 1.0, share: float = 1.0) -> Mesh:
    """Return a body of revolution about the y axis.

    Parameters
    ----------
    radii, heights : (n,) float64
        Its profile, metres.
    steps : int
        Sides.
    squash : float
        Depth over width.
    share : float
        Part of the turn that is there, 1 for all of it.
    """
    angle = np.linspace(0, 2 * np.pi * share, steps + 1)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(radii), np.diff(heights)))])
    points = np.empty((radii.size, steps + 1, 3))
    points[..., 0] = radii[:, None] * np.sin(angle)
    points[..., 1] = heights[:, None]
    points[..., 2] = -squash * radii[:, None] * np.cos(angle)
    return grid(points, _coordinates(angle * max(float(radii.max()), 1e-6), along))


def blob(radius: float, bumps: Float | None = None, power: float = 1.0, steps: int = 40) -> Mesh:
    """Return a ball; `bumps` (steps + 1, 2 * steps + 1) raises its surface, `power` below 1 makes it box-like."""
    down = np.linspace(0, np.pi, steps + 1)
    angle = np.linspace(0, 2 * np.pi, 2 * steps + 1)

    def bent(value: Float) -> Float:
        return np.asarray(np.sign(value) * np.abs(value) ** power)

    points = np.empty((steps + 1, 2 * steps + 1, 3))
    points[..., 0] = bent(np.sin(down))[:, None] * bent(np.sin(angle))
    points[..., 1] = -bent(np.cos(down))[:, None]
    points[..., 2] = -bent(np.sin(down))[:, None] * bent(np.cos(angle))
    points *= radius if bumps is None else radius * (1 + bumps[..., None])
    return grid(points, _coordinates(angle * radius, down * radius))


def tube(path: Float, radius: float, sides: int = 8, taper: float = 1.0) -> Mesh:
    """Return a tube along a path (n, 3); its radius at the end is `taper` times that at the start."""
    direction = np.gradient(path, axis=0)
    direction /= np.maximum(np.sqrt((direction * direction).sum(axis=1, keepdims=True)), 1e-12)
    aside = np.where(np.abs(direction[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(direction, aside)
    first /= np.maximum(np.sqrt((first * first).sum(axis=1, keepdims=True)), 1e-12)
    second = np.cross(direction, first)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    width = radius * np.linspace(1, taper, len(path))
    ring = np.cos(angle)[None, :, None] * first[:, None] + np.sin(angle)[None, :, None] * second[:, None]
    along = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(path, axis=0) ** 2).sum(axis=1)))])
    return grid(path[:, None] + width[:, None, None] * ring, _coordinates(angle * radius, along))


def heightfield(height: Float, width: float, depth: float) -> Mesh:
    """Return a ground of `width` (x) by `depth` (z) metres, centred in x, from z = 0; `height` (R, C) points up."""
    rows, columns = height.shape
    x, z = np.linspace(-width / 2, width / 2, columns), np.linspace(0, depth, rows)
    points = np.empty((rows, columns, 3))
    points[..., 0], points[..., 1], points[..., 2] = x[None], -height, z[:, None]
    return grid(points, _coordinates(x, z))


def prism(outline: Float, depth: float) -> Mesh:
    """Return the side walls of a shape with the outline (n, 2) in x and y; from z = 0 to `depth`."""
    ring = np.concatenate([outline, outline[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ring, axis=0).T))])
    pieces = []
    for k in range(len(outline)):
        points = np.empty((2, 2, 3))
        points[..., :2] = ring[k : k + 2][None]
        points[0, :, 2], points[1, :, 2] = 0.0, depth
        pieces.append(grid(points, _coordinates(along[k : k + 2], np.array([0.0, depth]))))
    return merge(pieces)


def cards(centres: Float, turns: Float, sizes: Float) -> Mesh:
    """Return many small upright sheets.

    Parameters
    ----------
    centres : (n, 3) float64
        Where they are.
    turns : (n, 3) float64
        Yaw, pitch and roll of each, radians.
    sizes : (n, 2) float64
        Width and height.
    """
    count = len(centres)
    corner = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])
    flat = np.zeros((count, 4, 3))
    flat[..., :2] = corner * sizes[:, None]
    matrices = np.stack([rotation(*turn) for turn in turns])
    points = np.einsum("nij,nkj->nki", matrices, flat) + centres[:, None]
    normals = np.repeat(matrices[:, None, :, 2], 4, axis=1)
    uv = np.empty((count, 4, 4))
    uv[..., :2] = corner * sizes[:, None] + (centres[:, None, :2] * 7.31 + centres[:, None, 2:] * 3.17)
    uv[..., 2:] = np.clip(corner + 0.5, 0, 1 - 1e-9)
    first = 4 * np.arange(count, dtype=np.int32)[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2], np.int32), first + np.array([1, 3, 2], np.int32)])
    return Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 4), faces.astype(np.int32))
