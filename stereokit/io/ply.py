"""Point clouds as binary PLY."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import ArrayLike

from stereokit.errors import InputError
from stereokit.io.atomic import check_output, write_bytes
from stereokit.io.images import describe

__all__ = [
    "write_ply",
]


def write_ply(
    path: str | os.PathLike[str], points: ArrayLike, colors: ArrayLike | None = None, comment: str | None = None
) -> None:
    """Write a point cloud as binary little-endian PLY.

    Parameters
    ----------
    path : path
        Ends in ``.ply``.
    points : (N, 3) float
        Metres, finite; stored as float32.
    colors : (N, 3) uint8, optional
        RGB of each point.
    comment : str, optional
        A line of the header, ASCII: what the axes are, for instance.

    Raises
    ------
    InputError
        If a shape or type is wrong or a point is not finite.
    FileError
        If the suffix is unknown or the file cannot be written.
    """
    target = check_output(path, (".ply",))
    xyz = np.asarray(points)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind != "f":
        raise InputError(f"points must be (N, 3) float, got {describe(xyz)}")
    if not np.isfinite(xyz).all():
        raise InputError("points must be finite, got NaN or infinity; drop those points first")
    fields = [(name, "<f4") for name in ("x", "y", "z")]
    if colors is not None:
        rgb = np.asarray(colors)
        if rgb.shape != xyz.shape or rgb.dtype != np.uint8:
            raise InputError(f"colors must be {xyz.shape} uint8 as points, got {describe(rgb)}")
        fields += [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(xyz), dtype=fields)
    for k, (name, _) in enumerate(fields):
        vertices[name] = xyz[:, k] if k < 3 else rgb[:, k - 3]
    lines = ["ply", "format binary_little_endian 1.0"]
    if comment is not None:
        if not (comment.isascii() and comment.isprintable()):
            raise InputError(f"comment must be one line of ASCII, got {comment!r}")
        lines.append(f"comment {comment}")
    lines += [f"element vertex {len(xyz)}"]
    lines += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    write_bytes(target, "\n".join([*lines, "end_header", ""]).encode("ascii") + vertices.tobytes())
