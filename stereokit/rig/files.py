"""Rigs from and to files."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from stereokit.errors import FileError, OptionError, StereokitError
from stereokit.io import check_output, parsing, write_bytes
from stereokit.io.calibrations import Content, check_projections, read_content
from stereokit.io.calibrations.content import Lens, Size, model_of
from stereokit.io.calibrations.dispatch import name_of
from stereokit.io.calibrations.units import in_metres
from stereokit.io.quiet import quiet_decoders
from stereokit.notices import warn
from stereokit.rig.model import Camera, StereoRig
from stereokit.rig.rectification import RectifiedCameras

__all__ = ["read_rig", "save_rig"]

_SUFFIXES = (".yml", ".yaml", ".xml", ".json")


def read_rig(
    path: str | os.PathLike[str],
    right: str | os.PathLike[str] | None = None,
    *,
    size: Size | None = None,
    unit: str | None = None,
    model: str | None = None,
    cameras: tuple[int, int] | None = None,
    exchange: bool = False,
) -> StereoRig:
    """Read how two cameras stand and what their lenses do; the content of the files tells which format they have.

    Parameters
    ----------
    path : path
        OpenCV's FileStorage (YAML, XML, JSON), a Kalibr camchain, a ZED .conf, KITTI's ``calib_cam_to_cam.txt``; or the
        left of two files; or a folder with files of the usual names. Formats of rectified pairs (Middlebury, KITTI,
        K.txt, JSON) give a rig with which nothing is left to rectify.
    right : path or None
        The second of two files: ROS camera_info (left.yaml, right.yaml), EuRoC (cam0/sensor.yaml, cam1/sensor.yaml),
        OpenCV's intrinsics.yml and extrinsics.yml.
    size : (width, height) or None
        Of the raw images, pixels, for files that do not tell it, or that hold several resolutions.
    unit : {"m", "cm", "mm", "in"} or None
        Of the lengths in the file. None is what file or format say, or else metres; without either, a baseline of 10
        or more is taken for millimetres, with a warning.
    model : {"pinhole", "fisheye"} or None
        Of the lenses, for files that do not tell: OpenCV writes the same keys for both.
    cameras : pair of int or None
        Left and right camera of a KITTI file, (2, 3) by default, or of a Kalibr camchain, (0, 1).
    exchange : bool
        Left and right are the other way round.

    Returns
    -------
    StereoRig

    Warns
    -----
    StereokitWarning
        If a length, the principal points or the angle between the cameras look wrong.

    Raises
    ------
    InputError
        If it is for images of another `size`.
    FileError
        If a file is missing, is of none of these formats, lacks something or contradicts itself.
    """
    paths = [path] if right is None else [path, right]
    name = name_of(paths)
    content = read_content(paths, cameras, size)
    content = in_metres(content, unit, name)
    with parsing(name, "calibration"):
        if model is not None:
            content = _of_model(content, model)
        rig = _rig(content, exchange)
    if size is not None:
        rig = rig.sized(*size)
    _doubt_centers(rig, name)
    return rig


def _of_model(content: Content, model: str) -> Content:
    kind = model_of(model)
    if content.lenses is None:
        raise OptionError("model is for raw cameras, and the file tells only of rectified ones")
    left, right = (replace(one, model=kind) for one in content.lenses)
    for one in (left, right):
        Camera(one.matrix, one.distortion, kind)  # refuses the wrong number of coefficients
    return replace(content, lenses=(left, right))


def _rig(content: Content, exchange: bool) -> StereoRig:
    if content.lenses is None or content.pose is None:
        if content.projections is None:
            raise OptionError(_missing(content))
        if exchange:
            raise OptionError("exchange is for raw cameras, and the file tells only of rectified ones")
        return _of_rectified(content)
    left, right = (_camera(one) for one in content.lenses)
    if exchange:
        turn, step = content.pose
        return StereoRig(right, left, turn.T, -turn.T @ step)
    rectified_cameras = None
    if content.projections is not None and content.turns is not None:
        check_projections(content)
        rectified_cameras = RectifiedCameras(content.turns, content.projections, _whole(content))
    return StereoRig(left, right, *content.pose, rectified_cameras)


def _camera(one: Lens) -> Camera:
    return Camera(one.matrix, one.distortion, one.model, *(one.size or (None, None)))


def _of_rectified(content: Content) -> StereoRig:
    """Return the rig of cameras that are rectified as they are."""
    assert content.projections is not None
    baseline = check_projections(content)
    size = _whole(content)
    if size is None and content.lenses is not None:
        size = content.lenses[0].size
    left, right = (Camera(p[:, :3], np.zeros(0), "pinhole", *(size or (None, None))) for p in content.projections)
    same = np.eye(3)
    return StereoRig(left, right, same, (-baseline, 0, 0), RectifiedCameras((same, same), content.projections, size))


def _whole(content: Content) -> Size | None:
    if content.size is None or content.size[0] is None or content.size[1] is None:
        return None
    return content.size[0], content.size[1]


def _missing(content: Content) -> str:
    if content.lenses is None and content.pose is None:
        what = "the cameras (K1 and D1, K2 and D2) and how they stand to each other (R and T, or P1 and P2)"
    elif content.lenses is None:
        what = "the matrices of both cameras (K1 and K2, M1 and M2, cameraMatrix1 and cameraMatrix2, left and right)"
    else:
        what = "how the cameras stand to each other (R and T, or R1, R2, P1 and P2)"
    hint = "; it may be in a second file, such as extrinsics.yml or right.yaml, to be given as well"
    return f"it is {content.kind} that does not tell {what}{hint}"


def _doubt_centers(rig: StereoRig, name: str) -> None:
    if rig.size is None:
        return
    for side, camera in (("left", rig.left), ("right", rig.right)):
        for axis, center, pixels in zip("xy", camera.matrix[:2, 2], rig.size, strict=True):
            if not -0.5 <= center <= pixels - 0.5:
                warn(
                    f"{name!r} has the principal point of the {side} camera outside of the image: "
                    f"c{axis} is {center:g} of {pixels} pixels"
                )
                return


def save_rig(rig: StereoRig, path: str | os.PathLike[str]) -> None:
    """Write a rig as OpenCV's FileStorage does; see `StereoRig.save`.

    Raises
    ------
    FileError
        If the suffix is unknown or the file cannot be written.
    """
    target = check_output(path, _SUFFIXES)
    with quiet_decoders():
        file = cv2.FileStorage(
            ".yml" if target.suffix.lower() == ".yaml" else target.suffix.lower(),
            cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY,
        )
        for key, value in _entries(rig).items():
            file.write(key, value)
        text = file.releaseAndGetString()
    if not text:
        raise FileError(f"cannot write {str(path)!r}")
    write_bytes(target, text.encode())


def _entries(rig: StereoRig) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    if rig.size is not None:
        entries |= {"image_width": rig.size[0], "image_height": rig.size[1]}
    entries |= {"camera_model": rig.left.model, "unit": "m"}
    for number, camera in enumerate((rig.left, rig.right), start=1):
        entries[f"K{number}"] = np.array(camera.matrix)
        entries[f"D{number}"] = np.array(camera.distortion if len(camera.distortion) else np.zeros(5)).reshape(1, -1)
    entries |= {"R": np.array(rig.rotation), "T": np.array(rig.translation_m).reshape(3, 1)}
    try:
        rectified = rig.rectification()
    except StereokitError:  # no size, or too wide a lens: others can rectify it their way
        return entries
    if rectified.size != rig.size:  # the file format has one size
        return entries
    for number in (0, 1):
        entries[f"R{number + 1}"] = rectified.turns[number]
    for number in (0, 1):
        entries[f"P{number + 1}"] = rectified.projections[number]
    entries["Q"] = rectified.calibration.Q
    return entries
