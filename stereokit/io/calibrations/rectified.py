"""Formats of rectified pairs: Middlebury, KITTI (with its raw cameras), Cityscapes, K.txt, and this project's JSON.

Sources: Middlebury, stereo/data/scenes2014, "calib.txt"; KITTI, the development kits of 2012 and 2015 and of the raw
data (``P = K [I | t]``, ``b = -P[0, 3] / fx``); Cityscapes, "Camera calibration" (csCalibration.pdf); the readme
of FoundationStereo for K.txt: the nine numbers of the camera matrix and, in the next line, the baseline in metres.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from stereokit.errors import OptionError
from stereokit.io.calibrations.content import (
    CENTRE_PX,
    Array,
    Content,
    Lens,
    PartialSize,
    check_pinhole,
    check_rectified,
    lens,
    projection,
    vector,
)

__all__ = ["from_cityscapes", "from_fields", "from_kitti", "from_middlebury", "from_numbers"]

_NEEDED = ("fx", "fy", "cx0", "cy", "baseline_m")
_FIELDS = (*_NEEDED, "cx1", "width", "height")
"""What a calibration in this project's JSON has."""


def from_fields(content: dict[str, Any]) -> Content:
    """Return what a JSON object of this project says.

    Raises
    ------
    OptionError
        If a field is unknown, missing or no number.
    """
    for name, value in content.items():
        if name not in _FIELDS:
            raise OptionError(f"unknown field {name!r}. Known: {', '.join(_FIELDS)}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise OptionError(f"{name} must be a number, got {value!r}")
    missing = [name for name in _NEEDED if name not in content]
    if missing:
        raise OptionError(f"it has no field {missing[0]!r}, which a calibration in JSON has")
    one = {name: float(value) for name, value in content.items()}
    for name, value in one.items():
        if not np.isfinite(value):
            raise OptionError(f"{name} must be finite, got {content[name]}")
    for name in ("fx", "fy", "baseline_m"):
        if not one[name] > 0:
            raise OptionError(f"{name} must be positive, got {content[name]}")
    right = one.get("cx1", one["cx0"])
    both = (
        projection(one["fx"], one["fy"], one["cx0"], one["cy"]),
        projection(one["fx"], one["fy"], right, one["cy"], one["baseline_m"]),
    )
    return Content("a calibration in JSON", None, None, both, None, _size(one), "m", ("left", "right"))


def from_cityscapes(content: dict[str, Any]) -> Content:
    """Return what the JSON of Cityscapes says."""
    inner, outer = content["intrinsic"], content["extrinsic"]
    if not isinstance(inner, dict) or not isinstance(outer, dict):
        raise OptionError("intrinsic and extrinsic must be objects")
    values = {}
    for part, names in ((inner, ("fx", "fy", "u0", "v0")), (outer, ("baseline",))):
        for name in names:
            if name not in part:
                raise OptionError(f"it has no field {name!r}, which a Cityscapes calibration has")
            values[name] = float(vector(name, part[name], 1)[0])
    camera = values["fx"], values["fy"], values["u0"], values["v0"]
    both = projection(*camera), projection(*camera, values["baseline"])
    return Content("a Cityscapes calibration", None, None, both, unit="m")


def from_numbers(text: str) -> Content:
    """Return what a file of bare numbers says: a camera matrix and the baseline.

    Raises
    ------
    OptionError
        If there are not ten of them.
    """
    values = vector("K.txt", text.translate(str.maketrans("[];,()", "      ")).split())
    if len(values) == 9:
        raise OptionError("it has the nine numbers of a camera matrix, but no baseline, which must follow them")
    if len(values) != 10:
        raise OptionError(f"K.txt must hold the nine numbers of a camera matrix and the baseline, got {len(values)}")
    camera, baseline = values[:9].reshape(3, 3), float(values[9])
    check_pinhole("K", camera)
    if not baseline > 0:
        raise OptionError(f"the baseline after the camera matrix must be positive, got {baseline:g}")
    left, right = (projection(camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2], b) for b in (0.0, baseline))
    return Content("a camera matrix with a baseline (K.txt)", None, None, (left, right))


def from_middlebury(text: str) -> Content:
    """Return what a Middlebury calib.txt says.

    Raises
    ------
    OptionError
        If a field is missing or wrong, or the two cameras and doffs contradict each other.
    """
    kind = "a Middlebury calib.txt"
    lines = dict(re.findall(r"^[ \t]*(\w+)[ \t]*=(.*)$", text, re.MULTILINE))
    left = _numbers(lines, "cam0", 9, kind).reshape(3, 3)
    check_pinhole("cam0", left)
    doffs = None
    if "cam1" in lines:
        right = _numbers(lines, "cam1", 9, kind).reshape(3, 3)
        check_pinhole("cam1", right)
        check_rectified(("cam0", "cam1"), left, right)
        doffs = float(right[0, 2] - left[0, 2])
    if doffs is None or "doffs" in lines:
        stated = float(_numbers(lines, "doffs", 1, kind)[0])
        if doffs is not None and abs(stated - doffs) > CENTRE_PX:
            raise OptionError(f"doffs is {stated:g}, but cam0 and cam1 say {doffs:g} (cx1 - cx0)")
        doffs = stated
    baseline = float(_numbers(lines, "baseline", 1, kind)[0])
    if not baseline > 0:
        raise OptionError(f"baseline must be positive, got {baseline:g}")
    fx, cx, fy, cy = left[0, 0], left[0, 2], left[1, 1], left[1, 2]
    both = projection(fx, fy, cx, cy), projection(fx, fy, cx + doffs, cy, baseline)
    sizes = {name: float(_numbers(lines, name, 1, kind)[0]) for name in ("width", "height") if name in lines}
    return Content(kind, None, None, both, None, _size(sizes), "mm", ("cam0", "cam1"))


def from_kitti(text: str, cameras: tuple[int, int]) -> Content:
    """Return what a KITTI file says of two cameras; ``calib_cam_to_cam.txt`` tells of the raw ones too.

    Raises
    ------
    OptionError
        If a field is missing or wrong.
    """
    kind = "a KITTI calibration"
    lines = dict(re.findall(r"^[ \t]*(\w+):(.*)$", text, re.MULTILINE))
    raw = any(name.startswith("P_rect_") for name in lines)
    names = tuple(f"P_rect_{camera:02d}" if raw else f"P{camera}" for camera in cameras)
    left, right = (_numbers(lines, name, 12, kind).reshape(3, 4) for name in names)
    sizes = [f"S_rect_{camera:02d}" for camera in cameras]
    size = None
    if raw and sizes[0] in lines:
        width, height = _numbers(lines, sizes[0], 2, kind)
        size = _size({"width": width, "height": height})
    fields = [f"{letter}_{camera:02d}" for letter in "KDRT" for camera in cameras]
    fields += [f"R_rect_{camera:02d}" for camera in cameras]
    if not raw or not all(name in lines for name in fields):
        return Content(kind, None, None, (left, right), None, size, "m", (names[0], names[1]))
    lenses: list[Lens] = []
    for camera in cameras:
        own = f"S_{camera:02d}"
        s = _numbers(lines, own, 2, kind) if own in lines else None
        pixels = None if s is None else (int(s[0]), int(s[1]))
        k, d = f"K_{camera:02d}", f"D_{camera:02d}"
        lenses.append(lens((k, d), _numbers(lines, k, 9, kind), _numbers(lines, d, 5, kind), "pinhole", pixels))
    turns = [_numbers(lines, f"R_{camera:02d}", 9, kind).reshape(3, 3) for camera in cameras]
    steps = [_numbers(lines, f"T_{camera:02d}", 3, kind) for camera in cameras]
    rotation = turns[1] @ turns[0].T
    pose = rotation, steps[1] - rotation @ steps[0]
    into = [_numbers(lines, f"R_rect_{camera:02d}", 9, kind).reshape(3, 3) for camera in cameras]
    return Content(
        kind, (lenses[0], lenses[1]), pose, (left, right), (into[0], into[1]), size, "m", (names[0], names[1])
    )


def _numbers(lines: dict[str, str], name: str, count: int, kind: str) -> Array:
    if name not in lines:
        raise OptionError(f"it has no field {name!r}, which {kind} has")
    words = lines[name].translate(str.maketrans("[];,", "    ")).split()
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise OptionError(f"{name} must hold {count} numbers, got {lines[name].strip()!r}") from error
    if len(values) != count:
        raise OptionError(f"{name} must hold {count} numbers, got {len(values)}")
    if not np.isfinite(values).all():
        raise OptionError(f"{name} must hold finite numbers, got {lines[name].strip()!r}")
    return np.array(values)


def _size(fields: dict[str, float]) -> PartialSize | None:
    """Return what is told of a size."""
    for name in ("width", "height"):
        value = fields.get(name)
        if value is not None and (not np.isfinite(value) or value != int(value) or value < 1):
            raise OptionError(f"{name} must be a positive whole number of pixels, got {value:g}")
    width, height = (None if name not in fields else int(fields[name]) for name in ("width", "height"))
    return None if width is None and height is None else (width, height)
