"""The command ``stereokit calibrate``: two cameras from images of a chessboard or a ChArUco board."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console

from stereokit.cli.options import JsonOption, check_json, write_json
from stereokit.cli.output import Table
from stereokit.errors import OptionError, one_line
from stereokit.images.check import check_integer
from stereokit.io import check_output, write_image
from stereokit.rig.boards import Board, parse_length
from stereokit.rig.calibrate import BoardCalibration, PairQuality, rectification_of, rows_picture
from stereokit.rig.calibrate import calibrate as calibrate_pairs
from stereokit_evaluation.batch.pairs import PairFiles
from stereokit_evaluation.batch.video import Frames
from stereokit_evaluation.commands.batch import find_pairs
from stereokit_evaluation.commands.rectify import images_of
from stereokit_evaluation.common.progress import progress

__all__ = ["calibrate"]


def calibrate(
    inputs: Annotated[list[Path], typer.Argument(help="A folder, a list or a video; or two folders or two videos.")],
    board: Annotated[str, typer.Option(help="Inner corners of a chessboard, 9x6; squares of a ChArUco board.")],
    square: Annotated[str, typer.Option(help="Side of a square with its unit, such as 25mm.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="The rig: .yml, .yaml, .xml or .json.")
    ] = Path("rig.yml"),
    marker: Annotated[str | None, typer.Option(help="Side of a ChArUco marker, such as 18mm.")] = None,
    dictionary: Annotated[str, typer.Option(help="Of the ChArUco markers, by OpenCV's name.")] = "4X4_50",
    model: Annotated[str, typer.Option(help="Of the lenses: pinhole or fisheye.")] = "pinhole",
    coefficients: Annotated[int, typer.Option(help="Of a pinhole lens: 4, 5, 8, 12 or 14.")] = 5,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A rectified pair with row lines; FILE-rows.png beside the rig.")
    ] = None,
    pattern: Annotated[
        tuple[str, str] | None, typer.Option(metavar="LEFT RIGHT", help="Files of a folder, '*_l.png' '*_r.png'.")
    ] = None,
    every: Annotated[int, typer.Option(help="Take only each so-many-th pair, such as 15 of a video.")] = 1,
    json_file: JsonOption = None,
) -> None:
    """Calibrate two cameras from pairs of images of a board, and write the rig.

    Ten to twenty pairs, taken at the same moment, with the board near and far, tilted, and in all corners. Pairs
    without the whole chessboard, blurred ones and those that disagree with the others are named and left out. Errors
    are root mean squares in pixels: of reprojection, and of rows after rectification, which matter most to matching.
    """
    check_output(output, (".yml", ".yaml", ".xml", ".json"), "--output")
    picture = output.with_name(f"{output.stem}-rows.png") if picture is None else picture
    check_output(picture, (".png", ".jpg", ".jpeg"), "--picture")
    check_json(json_file)
    check_integer("every", every, 1)
    plate = _board(board, square, marker, dictionary)
    source = find_pairs(inputs, pattern)[0]
    total = source.expected if isinstance(source, Frames) else len(source)
    unread: list[PairQuality] = []
    with progress(None if total is None else -(-total // every)) as (_, step):
        calibration = calibrate_pairs(
            _pairs(source, every, unread, step), plate, model=model, coefficients=coefficients
        )
    calibration.pairs = sorted([*calibration.pairs, *unread], key=lambda pair: pair.name)
    calibration.rig.save(output)
    _draw(source, calibration, picture)
    content = _content(calibration, output, picture)
    if not write_json(json_file, content):
        _show(calibration, output, picture)


def _board(text: str, square: str, marker: str | None, dictionary: str) -> Board:
    match = re.fullmatch(r"\s*(\d{1,3})\s*[xX]\s*(\d{1,3})\s*", text)
    if match is None:
        raise OptionError(f"board must be COLUMNSxROWS, such as 9x6, got {text!r}")
    side = None if marker is None else parse_length("marker", marker)
    return Board(int(match[1]), int(match[2]), parse_length("square", square), side, dictionary)


def _pairs(
    source: list[PairFiles] | Frames, every: int, unread: list[PairQuality], step: Any
) -> Iterator[tuple[str, NDArray[Any], NDArray[Any]]]:
    """Yield each so-many-th pair that can be read; the others are told."""
    chosen: list[PairFiles] | Frames = source if isinstance(source, Frames) else source[::every]
    for number, (name, images, reason) in enumerate(images_of(chosen)):
        if isinstance(source, Frames) and number % every:
            continue
        if images is None:
            unread.append(PairQuality(name, reason))
        else:
            yield name, *images
        step("", 1)


def _draw(source: list[PairFiles] | Frames, calibration: BoardCalibration, picture: Path) -> None:
    """Write the pair whose rows differ most, of those that were used."""
    used = [pair for pair in calibration.pairs if not pair.reason]
    worst = max(used, key=lambda pair: pair.epipolar_px or 0.0).name
    if isinstance(source, Frames):
        frames = source.frames(lambda name: name == worst)
        images = next(((f.left, f.right) for f in frames if f.left is not None and f.right is not None), None)
    else:
        images = next((images for _, images, _ in images_of([p for p in source if p.name == worst])), None)
    if images is not None:
        write_image(picture, rows_picture(*rectification_of(calibration.rig)(*images)))


def _content(calibration: BoardCalibration, output: Path, picture: Path) -> dict[str, Any]:
    rig = calibration.rig
    return {
        "output": str(output), "picture": str(picture), "model": rig.left.model, "size": rig.size,
        "baseline_m": rig.baseline_m, "reprojection_px": calibration.reprojection_px,
        "epipolar_px": calibration.epipolar_px, "epipolar_max_px": calibration.epipolar_max_px,
        "coverage": calibration.coverage, "pairs": [asdict(pair) for pair in calibration.pairs],
        "doubts": calibration.doubts,
    }  # fmt: skip


def _show(calibration: BoardCalibration, output: Path, picture: Path) -> None:
    table = Table("PairFiles", "Reprojection, px", "Rows, px", "Left out because", box=SIMPLE_HEAD, pad_edge=False)
    for pair in calibration.pairs:
        errors = ("" if e is None else f"{e:.3f}" for e in (pair.reprojection_px, pair.epipolar_px))
        table.add_row(pair.name, *errors, pair.reason)
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    rig = calibration.rig
    used = sum(not pair.reason for pair in calibration.pairs)
    assert rig.size is not None
    lines = [
        f"{used} of {len(calibration.pairs)} pairs used; {rig.left.model}, {rig.size[0]}x{rig.size[1]}, "
        f"baseline {1000 * rig.baseline_m:.2f} mm",
        f"reprojection error {calibration.reprojection_px:.3f} px, row error {calibration.epipolar_px:.3f} px "
        f"(largest {calibration.epipolar_max_px:.2f})",
        "coverage {:.0f} % of the left image, {:.0f} % of the right".format(*(100 * c for c in calibration.coverage)),
        f"written: {output}, {picture}",
    ]
    for line in lines:
        typer.echo(one_line(line))
    for line in calibration.doubts:
        typer.echo(f"warning: {one_line(line)}", err=True)
