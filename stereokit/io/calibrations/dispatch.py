"""Which format a calibration file has, told by what it holds."""

from __future__ import annotations

import hashlib
import json
import os
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereokit.errors import FileError, OptionError
from stereokit.io.calibrations.chains import from_euroc, from_kalibr, is_euroc, is_kalibr
from stereokit.io.calibrations.content import Content, Size
from stereokit.io.calibrations.keyed import from_keys, joined_files, known_keys
from stereokit.io.calibrations.rectified import (
    from_cityscapes,
    from_fields,
    from_kitti,
    from_middlebury,
    from_numbers,
)
from stereokit.io.calibrations.trees import from_json, from_xml, from_yaml
from stereokit.io.calibrations.zed import from_zed
from stereokit.io.reading import parsing, read_text

__all__ = ["KNOWN", "digest", "name_of", "read_content"]

KNOWN = (
    "known are OpenCV's YAML, XML, JSON and npz (K1 D1 K2 D2 R T, P1 P2 or Q), "
    "ROS camera_info (left.yaml and right.yaml), "
    "Kalibr's camchain, EuRoC's sensor.yaml, ZED's .conf, KITTI, Middlebury's calib.txt, K.txt with a baseline, "
    "and JSON with fx, fy, cx0, cy, baseline_m"
)
_MOST_BYTES = 2**20
_FOLDER = (
    ("left.yaml", "right.yaml"), ("left.yml", "right.yml"), ("cam0/sensor.yaml", "cam1/sensor.yaml"),
    ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml"), ("intrinsics.yml", "extrinsics.yml"),
    ("intrinsics.yaml", "extrinsics.yaml"), ("intrinsics.xml", "extrinsics.xml"), ("rig.yml",), ("stereo.yml",),
    ("camchain.yaml",), ("calib_cam_to_cam.txt",), ("calib.txt",), ("K.txt",),
)  # fmt: skip
"""What is looked for in a folder, in this order."""
_KITTI = r"^[ \t]*(P\d|P_rect_\d\d|K_\d\d|calib_time)[ \t]*:[ \t]*[-+.\d]"
_NUMBERS = r"\A[-+.\deE\s,;\[\]()]+\Z"
_FOREIGN = {
    "a BoofCV calibration": r"^[ \t]*leftToRight\s*:|boofcv",
    "a COLMAP file": r"^#.*CAMERA_ID, MODEL, WIDTH",
    "a MATLAB file": r"\AMATLAB ",
}
"""What is known and not read."""


def read_content(
    paths: Sequence[str | os.PathLike[str]], cameras: tuple[int, int] | None = None, size: Size | None = None
) -> Content:
    """Read a calibration: a file, a folder of files, or two files that belong together.

    Parameters
    ----------
    paths : sequence of path
        One or two: of the left and the right camera, or such as intrinsics.yml and extrinsics.yml.
    cameras : pair of int or None
        Left and right camera of files that have more: (2, 3) of KITTI, (0, 1) of Kalibr where they are not told.
    size : (width, height) or None
        Of the images, for files that hold several resolutions.

    Raises
    ------
    FileError
        If a file is missing or none that is known, or if something in it is wrong.
    """
    files = [part for path in paths for part in _in_folder(Path(path))]
    texts = [_text(path) for path in files]
    with parsing(name_of(files), "calibration"):
        return _parsed(files, texts, cameras, size)


def digest(paths: Sequence[str | os.PathLike[str]]) -> str:
    """Return what identifies the content of a calibration of one file or two, or of a folder.

    Raises
    ------
    FileError
        If a file is missing or too large.
    """
    files = [part for path in paths for part in _in_folder(Path(path))]
    return hashlib.sha256("\0".join(_text(path) for path in files).encode()).hexdigest()[:16]


def name_of(paths: Sequence[str | os.PathLike[str]]) -> str:
    """Return what messages call a calibration of one file or two."""
    return " and ".join(str(path) for path in paths)


def _in_folder(path: Path) -> list[Path]:
    with parsing(path, "calibration"):
        if not path.is_dir():
            return [path]
    for names in _FOLDER:
        if all((path / name).is_file() for name in names):
            return [path / name for name in names]
    shown = ", ".join(" and ".join(names) for names in _FOLDER)
    raise FileError(f"no calibration in the folder {str(path)!r}; looked for {shown}")


def _text(path: Path) -> str:
    with parsing(path, "calibration"):
        size = os.stat(path).st_size
    if size > _MOST_BYTES:
        raise FileError(f"{str(path)!r} is no calibration: it has {size} bytes, and one has some thousand")
    with parsing(path, "calibration"), path.open("rb") as file:
        archive = file.read(4) == b"PK\3\4"
    return _archive_text(path) if archive else read_text(path, "calibration")


def _archive_text(path: Path) -> str:
    """Return the arrays of an npz file as JSON; pickles are not opened, nor what unpacks to more than it should."""
    with parsing(path, "calibration"):
        with zipfile.ZipFile(path) as archive:
            if sum(part.file_size for part in archive.infolist()) > _MOST_BYTES:
                raise OptionError("it is no calibration: its arrays are too large for one")
        with np.load(path, allow_pickle=False) as arrays:
            return json.dumps({name: arrays[name].tolist() for name in arrays.files}, default=str)


def _parsed(paths: Sequence[Path], texts: Sequence[str], cameras: tuple[int, int] | None, size: Size | None) -> Content:
    if len(paths) > 2:
        raise OptionError(f"a calibration is one file or two, got {len(paths)}")
    for path, text in zip(paths, texts, strict=True):
        for what, pattern in _FOREIGN.items():
            if re.search(pattern, text.lstrip(), re.MULTILINE):
                raise FileError(f"{str(path)!r} looks like {what}, which is not read; {KNOWN}")
    if len(texts) == 1:
        content = _of_text(texts[0], cameras, size)
        if content is not None:
            return content
    trees = [_tree(path, text) for path, text in zip(paths, texts, strict=True)]
    if all(map(is_euroc, trees)):
        if len(trees) == 1:
            raise FileError(
                f"{str(paths[0])!r} is the sensor file of one camera; give both, cam0/sensor.yaml and cam1/sensor.yaml"
            )
        return from_euroc(trees[0], trees[1])
    if len(trees) == 1 and is_kalibr(trees[0]):
        return from_kalibr(trees[0], cameras or (0, 1))
    for path, tree in zip(paths, trees, strict=True):
        if not known_keys(tree):
            raise FileError(f"{str(path)!r} is no calibration known here; {KNOWN}")
    return from_keys(*joined_files(trees))


def _of_text(text: str, cameras: tuple[int, int] | None, size: Size | None) -> Content | None:
    """Return what a file says that is no tree of keys; None if it is one."""
    start = text.lstrip()
    if start.startswith("{"):
        tree = from_json(text)
        if "intrinsic" in tree and "extrinsic" in tree and "baseline" in str(tree["extrinsic"]):
            return from_cityscapes(tree)
        other = '"opencv-matrix"' in text or ("fx" not in tree and known_keys(tree))
        return None if other else from_fields(tree)
    if re.match(_NUMBERS, start):
        return from_numbers(text)
    if re.search(r"^[ \t]*\[(LEFT|RIGHT)_CAM_\w+\]", text, re.MULTILINE | re.IGNORECASE):
        return from_zed(text, size)
    if re.search(r"^[ \t]*(cam[01]|doffs|baseline)[ \t]*=", text, re.MULTILINE):
        return from_middlebury(text)
    if re.search(_KITTI, text, re.MULTILINE):
        return from_kitti(text, cameras or (2, 3))
    return None


def _tree(path: Path, text: str) -> Any:
    start = text.lstrip()
    if start.startswith("<"):
        return from_xml(text)
    if start.startswith("{"):
        return from_json(text)
    if ":" not in text:
        raise FileError(f"{str(path)!r} is no calibration known here; {KNOWN}")
    return from_yaml(text)
