"""Models from files (OBJ with its MTL, GLB, glTF), made ready for scenes: one size, few triangles, grey.

trimesh parses the files. What comes out is centred, its longest side is 1, y points down and z away from the viewer,
as in `meshes`. A model of more than `MOST` triangles is simplified: its corners move to the means of the cells of a
grid, the finest that leaves so few (Rossignac and Borrel, "Multi-resolution 3D approximations", 1993).
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import StereokitError
from stereokit_evaluation.synthetic.patterns import SIZE
from stereokit_evaluation.synthetic.raster import MASK_SIZE

__all__ = ["LARGEST", "MODEL_SUFFIXES", "MOST", "READABLE", "Model", "import_trimesh", "pack", "read_model", "unpack"]

Float = NDArray[np.float64]
Bytes = NDArray[np.uint8]

MODEL_SUFFIXES = (".obj", ".glb", ".gltf")
MOST = 8_000
"""Triangles of a model in a scene."""
READABLE = 1_000_000
"""Triangles of a file; one with more is refused."""
LARGEST = 128 * 2**20
"""Bytes of a file; a larger one is refused."""

_PICTURES = 4  # of one model; further parts have the mean of theirs
_PIXELS = 64_000_000  # of one picture
_GRIDS = (1024, 724, 512, 362, 256, 181, 128, 91, 64, 45, 32, 23, 16, 11, 8)
_WEIGHTS = np.array([0.299, 0.587, 0.114])
_EXTENSIONS = ("KHR_materials_", "KHR_texture_transform")  # those that can be ignored


@dataclass(frozen=True, eq=False)
class Model:
    """A model.

    Attributes
    ----------
    points, normals : (3 * M, 3) float32
        Corners of the M triangles, no two of them shared. The longest side is 1.
    uv : (3 * M, 2) float32
        Where the corners lie on the pictures, repeats, downwards; of a part without picture lengths on its surface.
    part : (M,) int32
        Row of `looks` of each triangle, ascending.
    looks : (P, 5) float64
        Of each part: brightness (0..1, linear), share of the light that it lets through, strength of its highlights,
        row of `pictures` (-1 for none), and the length that one repeat covers.
    pictures : (K, 512, 512) uint8
        Brightness, linear.
    holes : (K, 256, 256) uint8
        0 where a picture is transparent.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32]
    part: NDArray[np.int32]
    looks: Float
    pictures: Bytes
    holes: Bytes


def pack(model: Model) -> bytes:
    """Return a model as the bytes of an npz file."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **vars(model))
    return buffer.getvalue()


def unpack(arrays: Any) -> Model:
    """Return the model of the arrays that `pack` stored."""
    return Model(**{name: arrays[name] for name in Model.__dataclass_fields__})


def read_model(name: str, data: bytes, fetch: Callable[[str], bytes]) -> Model:
    """Parse a model.

    Parameters
    ----------
    name : str
        Its file name; the suffix, one of `MODEL_SUFFIXES`, says what it is.
    data : bytes
        Its content.
    fetch : callable
        Returns the content of another file that it names, or raises KeyError.

    Raises
    ------
    Exception
        Of any type: the file cannot be used.
    """
    trimesh = import_trimesh()
    suffix = "." + name.rpartition(".")[2].lower()
    if len(data) > LARGEST:
        raise ValueError(f"it has {len(data)} bytes, more than {LARGEST}")
    if suffix != ".obj":
        _check_counts(data, suffix)
    elif data.count(b"\nf") > READABLE:
        raise ValueError(f"it has more than {READABLE} faces")

    class Fetcher(trimesh.resolvers.Resolver):  # type: ignore[misc, name-defined]
        """Other files of the model, by `fetch`."""

        def __init__(self) -> None: ...

        def get(self, key: str) -> bytes:
            return fetch(key)

        def keys(self) -> list[str]:
            return []

        def namespaced(self, namespace: str) -> Any:
            raise KeyError(namespace)

        def write(self, name: str, data: Any) -> None:
            raise KeyError(name)

    with np.errstate(all="ignore"):
        scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=Fetcher(), process=False)
        return _model(*_corners(scene))


def import_trimesh() -> Any:
    """Return the module trimesh.

    Raises
    ------
    StereokitError
        If it is not installed.
    """
    try:
        import trimesh
    except ImportError:
        raise StereokitError(
            "assets with models need trimesh, which is not installed: pip install 'stereokit[assets]'"
        ) from None
    return trimesh


def _check_counts(data: bytes, suffix: str) -> None:
    """Refuse a glTF whose header asks for more memory than its file holds, or for what trimesh does not decode."""
    if suffix == ".glb":
        if len(data) < 20 or data[:4] != b"glTF":
            raise ValueError("it does not begin like a GLB file")
        total, length = struct.unpack("<I", data[8:12])[0], struct.unpack("<I", data[12:16])[0]
        if total > len(data) or 20 + length > len(data):
            raise ValueError(f"it ends after {len(data)} of {max(total, 20 + length)} bytes")
        data = data[20 : 20 + length]
    header = json.loads(data)
    count = sum(int(entry.get("count", 0)) for entry in header.get("accessors", ()))
    if count > 12 * READABLE:  # a triangle has three corners, each with a place, a normal and coordinates
        raise ValueError(f"it has {count} values, more than {12 * READABLE}")
    for extension in header.get("extensionsRequired", ()):
        if not str(extension).startswith(_EXTENSIONS):
            raise ValueError(f"it needs the glTF extension {extension!r}")


def _corners(scene: Any) -> tuple[Float, Float, Float, NDArray[np.int32], list[Any]]:
    """Return corners (M, 3, 3), normals (M, 3, 3), (u, v) (M, 3, 2), part (M,) of a scene, and a material by part."""
    pieces: list[tuple[Float, Float, Float, NDArray[np.int32]]] = []
    materials: list[Any] = []
    numbers: dict[str, int] = {}
    count = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        shape = scene.geometry[name]
        faces = np.asarray(getattr(shape, "faces", np.zeros((0, 3))), np.int64)
        if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):  # lines and points
            continue
        count += len(faces)
        if count > READABLE:
            raise ValueError(f"it has more than {READABLE} triangles")
        vertices = np.asarray(shape.vertices, np.float64)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("a face names a corner that is not there")
        uv = getattr(shape.visual, "uv", None)
        uv = np.full((len(vertices), 2), np.nan) if uv is None or len(uv) != len(vertices) else np.asarray(uv)[:, :2]
        transform = np.asarray(transform, np.float64)
        points = (vertices @ transform[:3, :3].T + transform[:3, 3])[faces]
        normals = (np.asarray(shape.vertex_normals, np.float64) @ transform[:3, :3].T)[faces]
        if name not in numbers:
            numbers[name] = len(materials)
            materials.append(shape.visual)
        part = np.full(len(faces), numbers[name], np.int32)
        pieces.append((points, normals, np.asarray(uv, np.float64)[faces], part))
    if not pieces:
        raise ValueError("it has no triangles")
    points, normals, uv, part = (np.concatenate([piece[k] for piece in pieces]) for k in range(4))
    return points, normals, uv, part, materials


def _model(points: Float, normals: Float, uv: Float, part: NDArray[np.int32], materials: list[Any]) -> Model:
    if not np.isfinite(points).all() or np.abs(points).max() > 1e12:
        raise ValueError("a corner has no finite place")
    looks, pictures, holes = _looks(materials, np.bincount(part, _areas(points), len(materials)).astype(float))
    shown = (looks[part, 1] < 0.95) & (_areas(points) > 0)
    points, normals, uv, part = points[shown], normals[shown], uv[shown], part[shown]
    if not len(points):
        raise ValueError("it has no triangles that can be seen")
    flat = points.reshape(-1, 3)
    low, high = flat.min(axis=0), flat.max(axis=0)
    longest = float((high - low).max())
    points = (points - (low + high) / 2) / longest * np.array([1.0, -1.0, -1.0])
    normals = normals * np.array([1.0, -1.0, -1.0])
    if len(points) > MOST:
        remaining, points = _simplified(points)
        normals, uv, part = normals[remaining], uv[remaining], part[remaining]
    order = np.argsort(part, kind="stable")
    points, normals, uv, part = points[order], normals[order], uv[order], part[order]
    flat_normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    flat_normals /= np.maximum(np.sqrt((flat_normals**2).sum(axis=1, keepdims=True)), 1e-30)
    length = np.sqrt((normals**2).sum(axis=2, keepdims=True))
    normals = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), 0)
    agree = np.abs((normals * flat_normals[:, None]).sum(axis=2, keepdims=True)) > 0.7
    normals = np.where(agree, normals, flat_normals[:, None])  # a corner that smooths an edge of a box, or none
    present = np.asarray(np.isfinite(uv).all(axis=(1, 2)))
    uv = np.where(present[:, None, None], uv * [1.0, -1.0] + [0.0, 1.0], 0.0)
    areas, spread = _areas(points), np.abs(_cross(uv))
    for row in range(len(looks)):
        own = part == row
        covered, repeats = float(areas[own].sum()), float(spread[own].sum())
        if looks[row, 3] >= 0 and present[own].all() and repeats > 1e-9 and covered > 0:
            looks[row, 4] = np.sqrt(covered / repeats)
            continue
        looks[row, 3] = -1
        uv[own] = _projected(points[own], flat_normals[own])
    return Model(
        points.reshape(-1, 3).astype(np.float32), normals.reshape(-1, 3).astype(np.float32),
        uv.reshape(-1, 2).astype(np.float32), part.astype(np.int32), looks, pictures, holes,
    )  # fmt: skip


def _areas(points: Float) -> Float:
    normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    return np.asarray(np.sqrt((normals**2).sum(axis=1)) / 2)


def _cross(uv: Float) -> Float:
    """Return the signed areas of triangles (M, 3, 2)."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return np.asarray((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2)


def _projected(points: Float, normals: Float) -> Float:
    """Return coordinates of triangles on the side of a box that each faces most, (M, 3, 2)."""
    axis = np.abs(normals).argmax(axis=1)
    across, down = np.array([2, 0, 0])[axis], np.array([1, 2, 1])[axis]
    return np.stack([np.take_along_axis(points, k[:, None, None], axis=2)[..., 0] for k in (across, down)], axis=2)


def _simplified(points: Float) -> tuple[NDArray[np.intp], Float]:
    """Return which triangles (M, 3, 3) of a model of size 1 stay, `MOST` at most, and where their corners are then."""
    flat = points.reshape(-1, 3)
    for cells in _GRIDS:
        place = np.floor((flat + 0.5) * cells).astype(np.int64)
        key = (place[:, 0] * 4096 + place[:, 1]) * 4096 + place[:, 2]
        _, cell = np.unique(key, return_inverse=True)
        corner = cell.reshape(-1, 3)
        whole = (corner[:, 0] != corner[:, 1]) & (corner[:, 1] != corner[:, 2]) & (corner[:, 0] != corner[:, 2])
        remaining = np.flatnonzero(whole)
        _, first = np.unique(np.sort(corner[remaining], axis=1), axis=0, return_index=True)
        remaining = remaining[np.sort(first)]
        if len(remaining) <= MOST:
            break
    if not 0 < len(remaining) <= MOST:
        raise ValueError(f"it cannot be simplified to {MOST} triangles")
    size = np.bincount(cell)
    mean = np.stack([np.bincount(cell, flat[:, k]) / size for k in range(3)], axis=1)
    return remaining, mean[corner[remaining]]


def _looks(visuals: list[Any], areas: Float) -> tuple[Float, Bytes, Bytes]:
    """Return a row of `Model.looks` for each part, and the pictures that cover most."""
    looks = np.zeros((len(visuals), 5))
    looks[:, 3:] = -1, 1
    pictures: list[Bytes] = []
    holes: list[Bytes] = []
    for row in np.argsort(-areas, kind="stable"):
        brightness, clear, gloss, image, cut = _look(visuals[row])
        looks[row, :3] = brightness, clear, gloss
        if image is None:
            continue
        if image.size[0] * image.size[1] > _PIXELS:
            raise ValueError(f"a picture has {image.size[0]}x{image.size[1]} pixels, more than {_PIXELS}")
        grey, opaque = _picture(image)
        looks[row, 0] = float(grey[opaque > 0].mean() / 255) if opaque.any() else 0.5
        if len(pictures) < _PICTURES:
            looks[row, 3] = len(pictures)
            pictures.append(grey)
            holes.append(
                opaque[:: SIZE // MASK_SIZE, :: SIZE // MASK_SIZE] if cut else np.ones((MASK_SIZE,) * 2, np.uint8)
            )
    looks[:, 0] = np.clip(looks[:, 0], 0.03, 0.9)
    return (
        looks,
        np.asarray(pictures, np.uint8).reshape(-1, SIZE, SIZE),
        np.asarray(holes, np.uint8).reshape(-1, MASK_SIZE, MASK_SIZE),
    )


def _look(visual: Any) -> tuple[float, float, float, Any, bool]:
    """Return brightness, clearness, gloss, a picture or None, and whether that has holes."""
    material = getattr(visual, "material", None)
    if material is None:  # colours of corners
        colours = np.asarray(getattr(visual, "vertex_colors", np.full((1, 4), 160)), np.float64).reshape(-1, 4)
        return _linear(colours[:, :3].mean(axis=0) / 255), 0.0, 0.0, None, False
    if hasattr(material, "baseColorFactor"):
        factor = material.baseColorFactor
        colour = np.full(4, 255.0) if factor is None else np.asarray(factor, np.float64)
        clear = 1 - colour[3] / 255 if material.alphaMode == "BLEND" else 0.0
        rough = 0.8 if material.roughnessFactor is None else float(material.roughnessFactor)
        gloss, image, cut = 0.8 * (1 - rough), material.baseColorTexture, material.alphaMode in ("MASK", "BLEND")
    else:
        colour = np.asarray(material.diffuse, np.float64)
        opaque = material.kwargs.get("d", [1])
        clear = 1 - float(opaque[0] if isinstance(opaque, list | tuple) else opaque)
        gloss = 0.5 * float(np.asarray(material.specular, np.float64)[:3].mean() / 255)
        image, cut = material.image, True
    clear = float(np.clip(np.nan_to_num(clear), 0, 1))
    return _linear(colour[:3] / 255), clear, float(np.clip(np.nan_to_num(gloss), 0, 1)), image, cut


def _linear(colour: Float) -> float:
    """Return the brightness of a colour in 0..1."""
    return float(_WEIGHTS @ np.clip(np.nan_to_num(colour), 0, 1) ** 2.2)


def _picture(image: Any) -> tuple[Bytes, Bytes]:
    """Return a picture's brightness and where it is opaque, each (512, 512) uint8."""
    rgba = np.asarray(image.convert("RGBA"))
    opaque = cv2.resize(rgba[..., 3], (SIZE, SIZE), interpolation=cv2.INTER_AREA) >= 128
    small = cv2.resize(np.ascontiguousarray(rgba[..., :3]), (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    linear = (np.arange(256) / 255) ** 2.2
    return np.rint(255 * (linear[small] @ _WEIGHTS)).astype(np.uint8), opaque.astype(np.uint8)
