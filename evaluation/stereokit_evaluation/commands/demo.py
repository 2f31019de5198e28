"""The command ``stereokit demo``: match a synthetic street, score every method, draw one picture of it all.

It needs no data set: the pair and its exact truth come from `stereokit_evaluation.synthetic.scenes`. Scores are those
of the KITTI 2015 development kit, on one image. `overview` draws the picture from any maps.
"""

from __future__ import annotations

import re
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.text import Text

from stereokit.cli.options import JsonOption, check_json, write_json
from stereokit.cli.output import Table
from stereokit.errors import InputError, OptionError, StereokitError
from stereokit.io import write_image
from stereokit.result import colorize
from stereokit_evaluation.common.folders import check_folder, make_folder
from stereokit_evaluation.scoring.error_map import error_map
from stereokit_evaluation.scoring.kitti import Score, score
from stereokit_evaluation.scoring.summary import d1
from stereokit_evaluation.synthetic.scenes import Scene, generate

__all__ = ["Panel", "demo", "overview"]

_RUNS = 3
_REFINER = "stereokit"
_CAPTION_PX, _GAP_PX = 26, 6
_PAPER, _INK = (250, 250, 250), (32, 32, 36)

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Panel:
    """One method in the overview.

    Attributes
    ----------
    name : str
        Such as ``"S4 zncc+sgm"``.
    disparity, error : (H, W, 3) uint8
        Pictures of the disparity map and of its error, RGB.
    d1 : float or None
        D1 error of the pixels that are visible in both views, percent.
    milliseconds : float or None
        Time of one call.
    """

    name: str
    disparity: Picture
    error: Picture
    d1: float | None = None
    milliseconds: float | None = None


@dataclass(frozen=True)
class _Outcome:
    """One method's map, score and median time."""

    matcher: Any
    label: str
    disparity: NDArray[np.float32]
    score: Score
    seconds: float


def overview(left: Picture, truth: Picture, panels: Sequence[Panel], *, tile_width: int = 621) -> Picture:
    """Draw a labelled table of pictures in two columns: left image and truth, then each method's disparity and error.

    Parameters
    ----------
    left, truth : (H, W, 3) uint8
        The left image and the picture of the true disparity, RGB.
    panels : sequence of Panel
        The methods, top to bottom, their pictures as large as `left`.
    tile_width : int
        Width of one picture, pixels; its height follows.

    Returns
    -------
    (rows, columns, 3) uint8
        RGB.

    Raises
    ------
    InputError
        If a picture has another shape or type than `left`.
    OptionError
        If `tile_width` is below 1.
    """
    if tile_width < 1:
        raise OptionError(f"tile_width must be at least 1, got {tile_width}")
    rows = [(("left image", left), ("true disparity", truth))]
    for panel in panels:
        time_taken = "" if panel.milliseconds is None else f"   {panel.milliseconds:.0f} ms"
        wrong = "error" if panel.d1 is None else f"error, D1 {panel.d1:.2f} %"
        rows.append(
            (
                (f"{panel.name}{time_taken}", panel.disparity),
                (f"{panel.name.split()[0]} {wrong}", panel.error),
            )
        )
    for caption, picture in (tile for row in rows for tile in row):
        if picture.shape != left.shape or picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise InputError(
                f"{caption!r} must be uint8 of shape {left.shape}, got {picture.dtype} of shape {picture.shape}"
            )
    tile_height = max(1, round(tile_width * left.shape[0] / left.shape[1]))
    step = tile_height + _CAPTION_PX + _GAP_PX
    sheet = np.full((len(rows) * step + _GAP_PX, 2 * tile_width + 3 * _GAP_PX, 3), _PAPER, np.uint8)
    shrink = cv2.INTER_AREA if tile_width < left.shape[1] else cv2.INTER_LINEAR
    for i, row in enumerate(rows):
        for j, (caption, picture) in enumerate(row):
            top, start = _GAP_PX + i * step, _GAP_PX + j * (tile_width + _GAP_PX)
            tile = cv2.resize(picture, (tile_width, tile_height), interpolation=shrink)
            sheet[top + _CAPTION_PX : top + _CAPTION_PX + tile_height, start : start + tile_width] = tile
            words = np.full((_CAPTION_PX, tile_width, 3), _PAPER, np.uint8)
            cv2.putText(words, caption, (2, _CAPTION_PX - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _INK, 1, cv2.LINE_AA)
            sheet[top : top + _CAPTION_PX, start : start + tile_width] = words
    return sheet


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the pictures.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Number of the synthetic street.")] = 0,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the pair, pixels.")] = "1242x375",
    max_disparity: Annotated[int, typer.Option(help="Disparities to search.")] = 128,
    method: Annotated[
        list[str] | None, typer.Option(help="cost+aggregation or S1-S4; may repeat. Default: S1 to S4.")
    ] = None,
    refiner: Annotated[
        str, typer.Option(help="Refiner of the last row, S4 at half size; none leaves it out.")
    ] = _REFINER,
    threads: Annotated[int | None, typer.Option(help="Threads of the matcher.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Match a synthetic street with every method, score it against the exact truth, and draw the results."""
    width, height = _parse_size(size)
    _check_places(output, json_file)
    from stereokit import METHODS, Matcher

    short = {method_name: name for name, method_name in METHODS.items()}
    matchers: dict[str, Any] = {}
    for name in method or list(METHODS):
        matcher = Matcher(name, max_disparity=max_disparity, threads=threads)
        method_name = str(matcher.method)
        matchers.setdefault(f"{short[method_name]} {method_name}" if method_name in short else method_name, matcher)
    console = Console(stderr=True)
    if refiner != "none":
        options: dict[str, Any] = {"max_disparity": max_disparity, "threads": threads, "scale": 0.5}
        try:
            label = f"S4/2+{Path(refiner).stem} {METHODS['S4']} at half size"
            matchers[label] = Matcher("S4", refiner=refiner, **options)
        except StereokitError as error:
            if refiner != _REFINER:
                raise
            console.print(f"without a refined map: {error}", markup=False, highlight=False, soft_wrap=True)
    scene = generate(seed, width, height, max_disparity)
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right))
    outcomes: list[_Outcome] = []
    for label, matcher in matchers.items():
        with console.status(Text(f"{label}: compiling, once")):
            result = matcher(left, right)
        times = []
        for _ in range(_RUNS):
            start = time.perf_counter()
            result = matcher(left, right)
            times.append(time.perf_counter() - start)
        scores = score(result.disparity, noc=scene.noc, occ=scene.occ, objects=scene.objects, measured=result.valid)
        outcomes.append(_Outcome(matcher, label, result.disparity, scores, statistics.median(times)))
    make_folder(output)
    _write_pictures(output, scene, outcomes)
    document = {"results": [_as_json(outcome) for outcome in outcomes]}
    if write_json(json_file, document):
        return
    _print_table(f"synthetic street {seed}, {width}x{height}, {max_disparity} disparities", outcomes)
    typer.echo(f"pictures in {output}, all at once in {output / 'overview.png'}")


def _parse_size(size: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,5})[xX]([0-9]{1,5})", size.strip())
    if not match or not int(match[1]) or not int(match[2]):
        raise OptionError(f"size must be WIDTHxHEIGHT in pixels, such as 1242x375, got {size!r}")
    return int(match[1]), int(match[2])


def _check_places(output: Path, json_file: Path | None) -> None:
    """Refuse outputs that cannot be written, before any work."""
    check_json(json_file)
    check_folder(output)


def _write_pictures(folder: Path, scene: Scene, outcomes: Sequence[_Outcome]) -> None:
    """Write left, right, truth, each method's maps and the overview; a colour means the same in all."""
    max_disparity = max(1.0, float(scene.disparity.max()))
    truth = colorize(scene.disparity, 0.0, max_disparity)
    panels: list[Panel] = []
    pictures = {"left": scene.left, "right": scene.right, "truth": truth}
    for outcome in outcomes:
        map_picture = colorize(outcome.disparity, 0.0, max_disparity)
        error_picture = error_map(outcome.disparity, scene.occ, scene.noc, dilate=False)
        stem = outcome.label.split()[0].replace("/2", "-half").replace("+", "-")
        pictures |= {stem: map_picture, f"{stem}_error": error_picture}
        panels.append(
            Panel(outcome.label, map_picture, error_picture, outcome.score.noc.all.filled.d1(), 1000 * outcome.seconds)
        )
    pictures["overview"] = overview(scene.left, truth, panels)
    for name, picture in pictures.items():
        write_image(folder / f"{name}.png", picture)


def _print_table(title: str, outcomes: Sequence[_Outcome]) -> None:
    table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("method", no_wrap=True)
    for head in ("D1 noc %", "D1 occ %", "EPE px", "density %", "ms"):
        table.add_column(head, justify="right")
    for outcome in outcomes:
        noc = outcome.score.noc.all
        figures = (noc.filled.d1(), outcome.score.occ.all.filled.d1(), noc.filled.epe(), noc.density())
        cells = ["-" if figure is None else f"{figure:.2f}" for figure in figures]
        table.add_row(outcome.label, *cells, f"{1000 * outcome.seconds:.1f}")
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def _as_json(outcome: _Outcome) -> dict[str, Any]:
    """Return one entry of ``results``, in the form of ``stereokit evaluate``."""
    main = outcome.score.main
    return {
        "method": outcome.matcher.method,
        "scale": outcome.matcher.scale,
        "refiner": outcome.matcher.refiner,
        "device": outcome.matcher.device,
        "images": 1,
        "d1": {"noc": d1(outcome.score.noc), "occ": d1(outcome.score.occ)},
        "epe": main.filled.epe(),
        "density": main.density(),
        "seconds_per_image": outcome.seconds,
    }
