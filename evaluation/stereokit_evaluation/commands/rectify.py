"""The command ``stereokit rectify``: raw images of a rig as rectified pairs, which `stereokit batch` takes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from stereokit.calibration import Calibration
from stereokit.cli.options import JsonOption, check_json, write_json
from stereokit.cli.rig import parse_size, read_rig_option
from stereokit.errors import InputError, OptionError, StereokitError, one_line
from stereokit.io import IMAGE_SUFFIXES, READABLE_SUFFIXES, make_folder, read_pair, write_bytes, write_image
from stereokit.rig import Rectification
from stereokit.rig.calibrate import rows_picture
from stereokit_evaluation.batch.pairs import PairFiles
from stereokit_evaluation.batch.video import Frames
from stereokit_evaluation.commands.batch import find_pairs
from stereokit_evaluation.common.progress import progress

__all__ = ["raw_pairs", "rectify"]

_FORMATS = tuple(suffix[1:] for suffix in IMAGE_SUFFIXES)


def rectify(
    inputs: Annotated[
        list[Path], typer.Argument(help="LEFT RIGHT images; a folder, a list or a video; or two folders or videos.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the rectified images.")],
    rig: Annotated[str, typer.Option("--rig", metavar="FILE", help="Raw cameras. A file, LEFT,RIGHT, or a folder.")],
    alpha: Annotated[float | None, typer.Option(help="0: filled images; 1: all that the sensors saw.")] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Of the rectified images; the raw size.")] = None,
    crop: Annotated[bool, typer.Option("--crop", help="Cut away blank sides.")] = False,
    focal: Annotated[float | None, typer.Option(help="Rectified focal length, pixels; for wide lenses.")] = None,
    file_format: Annotated[str, typer.Option("--format", help="png, tiff, jpg ...")] = "png",
    pattern: Annotated[
        tuple[str, str] | None, typer.Option(metavar="LEFT RIGHT", help="Files of a folder, '*_l.png' '*_r.png'.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Rectify raw pairs: images, a folder, a list or a video, as batch takes them.

    DIR gets left/NAME.png and right/NAME.png, calibration.json of the rectified pair, mask.png and right_mask.png,
    white where the sensors saw something, and rows.png, the first pair with lines along its rows: what lies on a line
    in one view must lie on it in the other.
    """
    check_json(json_file)
    if file_format not in _FORMATS:
        raise OptionError(f"format must be one of {', '.join(_FORMATS)}, got {file_format!r}")
    options: dict[str, Any] = {"alpha": alpha, "size": parse_size("--size", size), "crop": crop, "focal": focal}
    source = raw_pairs(inputs, pattern)
    total = source.expected if isinstance(source, Frames) else len(source)
    rectification: Rectification | None = None
    failed: list[tuple[str, str]] = []
    count = 0
    with progress(total) as (console, step):
        for name, images, reason in images_of(source):
            try:
                if images is None:
                    raise InputError(reason)
                shape = images[0].shape[1], images[0].shape[0]
                if rectification is None:
                    rectification = read_rig_option(rig, shape).rectification(**options)
                    _start(output, rectification)
                rectified = rectification(*images)
                if count == 0:
                    write_image(output / "rows.png", rows_picture(*rectified))
                for side, image in zip(("left", "right"), rectified, strict=True):
                    target = output / side / f"{name}.{file_format}"
                    make_folder("output", target.parent)
                    write_image(target, image)
                count += 1
            except StereokitError as error:
                if rectification is None and images is not None:
                    raise  # of the rig, and so of all pairs
                failed.append((name, str(error)))
                console.print(one_line(f"failed {name}: {error}"), markup=False, highlight=False, soft_wrap=True)
            step("", 1)
    content: dict[str, Any] = {
        "output": str(output), "rig": rig, **options, "pairs": count + len(failed), "written": count,
        "errors": [{"name": name, "reason": reason} for name, reason in failed],
        "calibration": None if rectification is None else _fields(rectification.calibration),
        "valid": None if rectification is None else float(rectification.mask.mean()),
    }  # fmt: skip
    if not write_json(json_file, content):
        text = "nothing was rectified"
        if rectification is not None:
            camera = rectification.calibration
            text = (
                f"{count} pairs in {output}: {camera.width}x{camera.height}, fx {camera.fx:.1f} px, "
                f"baseline {camera.baseline_m:.4g} m, {100 * rectification.mask.mean():.1f} % valid"
            )
        typer.echo(one_line(text))
    if failed:
        raise typer.Exit(1)


def raw_pairs(inputs: list[Path], pattern: tuple[str, str] | None = None) -> list[PairFiles] | Frames:
    """Return the pairs of the inputs: two images, or what `stereokit batch` takes.

    Raises
    ------
    FileError
        If there are none, or a file cannot be read.
    OptionError
        If the inputs do not go together.
    """
    if len(inputs) == 2 and all(path.suffix.lower() in READABLE_SUFFIXES and path.is_file() for path in inputs):
        return [PairFiles(inputs[0].stem, str(inputs[0]), str(inputs[1]))]
    return find_pairs(inputs, pattern)[0]


def images_of(
    source: list[PairFiles] | Frames,
) -> Iterator[tuple[str, tuple[NDArray[Any], NDArray[Any]] | None, str]]:
    """Yield name and images of each pair, None and the reason where there are none."""
    for pair in source.frames() if isinstance(source, Frames) else source:
        left, right = pair.left, pair.right
        if left is None or right is None:
            yield pair.name, None, pair.reason
        elif isinstance(left, str) and isinstance(right, str):
            try:
                yield pair.name, read_pair(left, right), ""
            except StereokitError as error:
                yield pair.name, None, str(error)
        else:
            yield pair.name, (np.asarray(left), np.asarray(right)), ""


def _start(output: Path, rectification: Rectification) -> None:
    make_folder("output", output)
    write_bytes(output / "calibration.json", (json.dumps(_fields(rectification.calibration), indent=2) + "\n").encode())
    for name, mask in (("mask", rectification.mask), ("right_mask", rectification.right_mask)):
        write_image(output / f"{name}.png", mask.astype(np.uint8) * 255)


def _fields(camera: Calibration) -> dict[str, Any]:
    return {name: getattr(camera, name) for name in ("fx", "fy", "cx0", "cx1", "cy", "baseline_m", "width", "height")}
