"""The settings of a ZED camera (SN12345.conf): all its resolutions in one file, lengths in millimetres.

Source: zed-opencv-native of Stereolabs, which rectifies with them: the rotation is the vector (RX, CV, RZ), the
translation (-Baseline, TY, TZ).
"""

from __future__ import annotations

import configparser

import cv2
import numpy as np

from stereokit.errors import OptionError
from stereokit.io.calibrations.content import Array, Content, Lens, Size, lens, vector

__all__ = ["from_zed"]

_SIZES = {
    "2K": (2208, 1242), "FHD": (1920, 1080), "FHD1200": (1920, 1200), "HD": (1280, 720), "SVGA": (960, 600),
    "VGA": (672, 376),
}  # fmt: skip


def from_zed(text: str, size: Size | None) -> Content:
    """Return what the file says of the resolution `size`.

    Raises
    ------
    OptionError
        If `size` is not told and the file has several, or if it has not that one.
    """
    file = configparser.ConfigParser(strict=False, interpolation=None, allow_no_value=True)
    try:
        file.read_string(text)
    except configparser.Error as error:
        raise OptionError(f"not a ZED settings file: {str(error).splitlines()[0]}") from error
    sections = {name.upper(): name for name in file.sections()}
    there = {name: pixels for name, pixels in _SIZES.items() if f"LEFT_CAM_{name}" in sections}
    matches = [name for name, pixels in there.items() if size in (None, pixels)]
    if len(matches) != 1:
        known = ", ".join(f"{name} {w}x{h}" for name, (w, h) in there.items()) or "none that is known"
        which = "several resolutions, so the size of the images must be told" if size is None else "other resolutions"
        raise OptionError(f"it has {which}: {known}")
    name = matches[0]
    both: list[Lens] = []
    for side in ("LEFT", "RIGHT"):
        title = f"{side}_CAM_{name}"
        if title not in sections:
            raise OptionError(f"it has no section [{title}]")
        part = file[sections[title]]
        camera = np.array([_number(title, part, key) for key in ("fx", "fy", "cx", "cy")])
        more = [_number(title, part, key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
        distortion = more if any(more[5:]) else more[:5]
        both.append(lens((title, title), camera, distortion, "pinhole", _SIZES[name]))
    if "STEREO" not in sections:
        raise OptionError("it has no section [STEREO], which holds the baseline")
    stereo = file[sections["STEREO"]]

    def value(key: str, default: float | None = 0.0) -> float:
        own = f"{key}_{name}"
        return _number("STEREO", stereo, own if own.lower() in stereo else key, default)

    turn: Array = np.array([value("RX"), value("CV"), value("RZ")])
    rotation = np.asarray(cv2.Rodrigues(turn)[0], np.float64)
    translation = np.array([-value("Baseline", None), value("TY"), value("TZ")])
    return Content("a ZED settings file", (both[0], both[1]), (rotation, translation), unit="mm")


def _number(title: str, section: configparser.SectionProxy, key: str, default: float | None = None) -> float:
    value = section.get(key)
    if value is None:
        if default is None:
            raise OptionError(f"[{title}] has no {key}")
        return default
    return float(vector(f"{key} of [{title}]", value, 1)[0])
