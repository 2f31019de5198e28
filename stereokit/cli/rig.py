"""The command ``stereokit rig``, which shows and rewrites the raw cameras of a file; ``--rig`` of other commands."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereokit.cli.options import JsonOption, check_json
from stereokit.cli.output import Table, report
from stereokit.errors import OptionError

if TYPE_CHECKING:
    from stereokit.rig import StereoRig

__all__ = ["AlphaOption", "RigOption", "check_rig_options", "parse_size", "read_rig_option", "rig", "rig_files"]

RigOption = Annotated[
    str | None,
    typer.Option("--rig", metavar="FILE", help="Raw cameras: rectify first. A file, LEFT,RIGHT, or a folder."),
]
AlphaOption = Annotated[
    float | None, typer.Option(help="With --rig: 0 for filled images, 1 for all that the sensors saw.")
]


def rig_files(text: str) -> list[str]:
    """Return the paths of ``--rig``: one, or two divided by a comma.

    Raises
    ------
    OptionError
        If there are more.
    """
    paths = [text] if os.path.exists(text) else [part.strip() for part in text.split(",")]
    if len(paths) > 2 or not all(paths):
        raise OptionError(f"--rig must be a file, a folder or LEFT,RIGHT, got {text!r}")
    return paths


def read_rig_option(text: str, size: tuple[int, int] | None = None) -> StereoRig:
    """Return the rig of ``--rig`` for images of a size.

    Raises
    ------
    FileError
        If a file is missing or of an unknown format.
    InputError
        If it is for images of another size.
    """
    from stereokit.rig import read_rig

    paths = rig_files(text)
    return read_rig(paths[0], paths[1] if len(paths) == 2 else None, size=size)


def check_rig_options(rig: str | None, alpha: float | None, calibration: Path | None = None) -> None:
    """Refuse options that do not go with ``--rig``, or without it.

    Raises
    ------
    OptionError
        If ``--calibration`` comes with ``--rig``, or ``--alpha`` without.
    """
    if rig is not None and calibration is not None:
        raise OptionError(f"--calibration must not come with --rig, which gives the calibration, got {rig!r}")
    if alpha is not None and rig is None:
        raise OptionError(f"--alpha must come with --rig, got {alpha:g} alone")


def parse_size(name: str, text: str | None) -> tuple[int, int] | None:
    """Return a size such as ``1280x720``.

    Raises
    ------
    OptionError
        If it is none.
    """
    if text is None:
        return None
    words = text.lower().split("x")
    if len(words) != 2 or not all(word.isdecimal() and 0 < int(word) <= 2**15 for word in words):
        raise OptionError(f"{name} must be WIDTHxHEIGHT, such as 1280x720, got {text!r}")
    return int(words[0]), int(words[1])


def rig(
    files: Annotated[list[Path], typer.Argument(metavar="FILE [RIGHT]", help="Calibration: a file, two, or a folder.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Rewritten: .yml, .yaml, .xml or .json.")
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Of the file's lengths: m, cm, mm or in.")] = None,
    model: Annotated[str | None, typer.Option(help="Of the lenses: pinhole or fisheye.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Of the raw images, if the file has none.")] = None,
    cameras: Annotated[tuple[int, int] | None, typer.Option(help="Camera pair of a KITTI or Kalibr file.")] = None,
    exchange: Annotated[bool, typer.Option("--exchange", help="Left and right are the other way round.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Show the raw cameras of a calibration file of any known format, and rewrite them for OpenCV and stereokit.

    Formats: OpenCV (YAML, XML, JSON), ROS camera_info, Kalibr, EuRoC, ZED, KITTI, Middlebury, K.txt, JSON. What is
    rewritten has metres, a size and a lens model, so that no option is needed any more.
    """
    from stereokit import io
    from stereokit.rig import read_rig

    if len(files) > 2:
        raise OptionError(f"FILE must be one calibration or two files of one, got {len(files)}")
    if output is not None:
        io.check_output(output, (".yml", ".yaml", ".xml", ".json"), "--output")
    check_json(json_file)
    pair = read_rig(
        files[0], files[1] if len(files) == 2 else None, size=parse_size("--size", size), unit=unit, model=model,
        cameras=cameras, exchange=exchange,
    )  # fmt: skip
    if output is not None:
        pair.save(output)
    report(_content(pair, files, output), [_table(pair)], json_file)


def _content(pair: StereoRig, files: list[Path], output: Path | None) -> dict[str, Any]:
    return {
        "files": [str(path) for path in files],
        "output": None if output is None else str(output),
        "model": pair.left.model,
        "size": pair.size,
        "baseline_m": pair.baseline_m,
        "rotation": pair.rotation.tolist(),
        "translation_m": pair.translation_m.tolist(),
        "cameras": [
            {"matrix": camera.matrix.tolist(), "distortion": camera.distortion.tolist()}
            for camera in (pair.left, pair.right)
        ],
    }


def _table(pair: StereoRig) -> Table:
    import cv2
    import numpy as np

    table = Table("", "Left", "Right")
    table.add_row("model", *(f"{camera.model}, {len(camera.distortion)}" for camera in (pair.left, pair.right)))
    size = "not in the file" if pair.size is None else "{}x{}".format(*pair.size)
    table.add_row("image size", size, size)
    for name, row, column in (("fx", 0, 0), ("fy", 1, 1), ("cx", 0, 2), ("cy", 1, 2)):
        table.add_row(name, *(f"{camera.matrix[row, column]:.2f}" for camera in (pair.left, pair.right)))
    table.add_row(
        "distortion", *(" ".join(f"{value:.4g}" for value in camera.distortion) for camera in (pair.left, pair.right))
    )
    table.add_row("baseline", "", f"{pair.baseline_m:.5g} m")
    angles = np.degrees(cv2.Rodrigues(pair.rotation)[0].ravel())
    table.add_row("turned by (x, y, z)", "", ", ".join(f"{angle:.3f}" for angle in angles) + " degrees")
    return table
