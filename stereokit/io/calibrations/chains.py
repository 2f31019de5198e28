"""Kalibr's camera chains and the sensor files of EuRoC: cameras with transformations.

Sources: Kalibr's wiki, "yaml formats" and "supported models"; Burri and others, The EuRoC micro aerial vehicle
datasets, 2016, and the ``sensor.yaml`` of its cameras (``T_BS`` takes a point of the sensor to the body).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.errors import OptionError, shown
from stereokit.io.calibrations.content import Array, Content, Lens, Size, lens, matrix, vector
from stereokit.io.calibrations.trees import is_matrix

__all__ = ["from_euroc", "from_kalibr", "is_euroc", "is_kalibr"]


def is_kalibr(tree: Any) -> bool:
    """Return whether a YAML tree is a camera chain."""
    parts = [part for name, part in tree.items() if str(name).startswith("cam")] if isinstance(tree, dict) else []
    return any(isinstance(part, dict) and "intrinsics" in part and "T_BS" not in part for part in parts)


def is_euroc(tree: Any) -> bool:
    """Return whether a YAML tree is of a camera of EuRoC."""
    return isinstance(tree, dict) and "T_BS" in tree and "intrinsics" in tree


def from_kalibr(tree: dict[str, Any], cameras: tuple[int, int]) -> Content:
    """Return what a camera chain says of two of its cameras.

    Raises
    ------
    OptionError
        If one of them, or the way between them, is not there.
    """
    names = f"cam{cameras[0]}", f"cam{cameras[1]}"
    for name in names:
        if not isinstance(tree.get(name), dict):
            there = ", ".join(str(key) for key in list(tree)[:8])
            raise OptionError(f"it has no camera {name!r}; it has {there}")
    left, right = (_lens(name, tree[name]) for name in names)
    between = _from_imu(tree, names)
    if between is None:
        between = _along_the_chain(tree, *cameras)
    return Content("a Kalibr camchain", (left, right), (between[:3, :3], between[:3, 3]), unit="m", names=names)


def _from_imu(tree: dict[str, Any], names: tuple[str, str]) -> Array | None:
    if any("T_cn_cnm1" in tree[name] for name in names) or not all("T_cam_imu" in tree[name] for name in names):
        return None
    left, right = (_transformation(f"{name}.T_cam_imu", tree[name]["T_cam_imu"]) for name in names)
    return right @ np.linalg.inv(left)


def _along_the_chain(tree: dict[str, Any], first: int, last: int) -> Array:
    """Return the transformation from one camera to another, each of which tells that from the one before."""
    between: Array = np.eye(4)
    for number in range(min(first, last) + 1, max(first, last) + 1):
        part = tree.get(f"cam{number}")
        if not isinstance(part, dict) or "T_cn_cnm1" not in part:
            raise OptionError(f"cam{number} has no T_cn_cnm1, which says how it stands to cam{number - 1}")
        between = _transformation(f"cam{number}.T_cn_cnm1", part["T_cn_cnm1"]) @ between
    return between if first < last else np.asarray(np.linalg.inv(between), np.float64)


def from_euroc(left: dict[str, Any], right: dict[str, Any]) -> Content:
    """Return what the files of two cameras say.

    Raises
    ------
    OptionError
        If something in them is wrong.
    """
    bodies = [_transformation(f"{name}.T_BS", part["T_BS"]) for name, part in (("left", left), ("right", right))]
    between = np.linalg.inv(bodies[1]) @ bodies[0]
    lenses = _lens("left", left), _lens("right", right)
    return Content("a pair of EuRoC sensor files", lenses, (between[:3, :3], between[:3, 3]), unit="m")


def _lens(name: str, part: dict[str, Any]) -> Lens:
    model = str(part.get("camera_model", "pinhole")).lower()
    if model not in ("pinhole", "none"):
        raise OptionError(f"{name}: the camera model must be pinhole, with radtan or equidistant, got {shown(model)}")
    distortion = part.get("distortion_coeffs", part.get("distortion_coefficients"))
    size = part.get("resolution")
    pixels: Size | None = None
    if size is not None:
        width, height = vector(f"{name}.resolution", size, 2)
        pixels = int(width), int(height)
    word = part.get("distortion_model")
    if str(word).lower() == "none":
        distortion = None
    names = f"{name}.intrinsics", f"{name}.distortion_coeffs"
    return lens(names, vector(names[0], part.get("intrinsics", ()), 4), distortion, word, pixels)


def _transformation(name: str, value: Any) -> Array:
    whole = matrix(name, value["data"] if is_matrix(value) else value, 4, 4)
    if abs(np.linalg.det(whole[:3, :3]) - 1) > 1e-2 or np.abs(whole[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise OptionError(f"{name} must be a rotation and a translation, with a last row of 0 0 0 1")
    return whole
