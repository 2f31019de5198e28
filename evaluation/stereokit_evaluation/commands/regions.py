"""The command ``stereokit regions``: where errors lie: objects, occlusions, distance, texture, hard regions."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console

from stereokit import METHODS, __version__
from stereokit.cli.options import DeviceOption, JsonOption, WeightsOption, check_json, parse_settings, write_json
from stereokit.cli.output import Table as PrintedTable
from stereokit.io import write_bytes
from stereokit_evaluation.bench.baselines import HH, THREE_WAY
from stereokit_evaluation.common.folders import check_folder, make_folder
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.data.datasets import dataset_names, load_frames, select_frames
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.report.tables import Column, Table
from stereokit_evaluation.study.configurations import available_variants, baseline, build, parse_variant
from stereokit_evaluation.study.regions import REGIONS, RegionRow, measure_regions
from stereokit_evaluation.synthetic.scenes import generate

__all__ = ["regions", "scene_masks"]

_DEFAULT_DISPARITIES = 128
_HARD = ("textureless", "specular", "brightness")


def regions(
    dataset: Annotated[str, typer.Option(help=f"One of {', '.join(dataset_names())}.")] = "scenes",
    root: Annotated[Path | None, typer.Option(help="Folder of the data set (none for scenes).")] = None,
    frames: Annotated[str | None, typer.Option(help="Numbers or names, such as 0-3,34-40.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="cost+aggregation or S1-S4; may repeat.")] = None,
    variant: Annotated[
        list[str] | None, typer.Option(help="original, linear, cnn, stereovae or a refiner; may repeat.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Option of a stage; may repeat.")
    ] = None,
    weights: WeightsOption = None,
    max_disparity: Annotated[int | None, typer.Option(help="Disparities; default by data set.")] = None,
    count: Annotated[int, typer.Option(help="Number of synthetic scenes.")] = 20,
    threads: Annotated[int | None, typer.Option(help="Threads of the matchers.")] = None,
    device: DeviceOption = "auto",
    with_baselines: Annotated[bool, typer.Option("--baselines/--no-baselines", help="OpenCV's modes too.")] = True,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder for the table as CSV, LaTeX, Markdown.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Measure D1 by kind of pixel: occluded or seen, object, disparity, texture, and the paper's hard regions.

    The hard regions (textureless, specular, of another brightness) are known on the synthetic scenes alone.
    """
    check_json(json_file)
    if output is not None:
        check_folder(output)
    selected = select_frames(load_frames(dataset, root, count=count), frames)
    suggested = max((f.max_disparity for f in selected if f.max_disparity is not None), default=_DEFAULT_DISPARITIES)
    levels = suggested if max_disparity is None else max_disparity
    options = {"max_disparity": levels, "threads": threads, "device": device, **parse_settings(settings or ())}
    options |= {} if weights is None else {"weights": weights}
    variants = [parse_variant(name) for name in variant or available_variants()]
    configurations = build(method or list(METHODS), variants, options)
    if with_baselines:
        configurations += [baseline(key, levels) for key in (THREE_WAY, HH)]
    with progress(len(selected) * len(configurations)) as (_, step):
        rows = measure_regions(selected, configurations, scene_masks if dataset == "scenes" else None, step=step)
    table = _table(rows, f"D1 error in percent by kind of pixel; {len(selected)} frames of {dataset}")
    if output is not None:
        make_folder(output)
        for ending, text in (("csv", table.csv()), ("tex", table.latex()), ("md", table.markdown())):
            write_bytes(output / f"regions.{ending}", text.encode())
    if not write_json(json_file, _as_json(rows, dataset, selected)):
        _print(table)
        for row in rows:
            if row.missing is not None:
                typer.echo(f"missing: {row.configuration.name}: {row.missing}")


def scene_masks(frame: Frame) -> Mapping[str, NDArray[np.bool_]]:
    """Return the hard regions of a scene, drawn once more by the number in its name."""
    height, width = frame.load_left().shape[:2]
    scene = generate(int(frame.name.rpartition("_")[2]), width, height)
    return {name: getattr(scene, name) for name in _HARD}


def _table(rows: list[RegionRow], title: str) -> Table:
    names = [name for name in REGIONS if any(name in row.tallies for row in rows)]
    cells = [(row.configuration.name, *(row.d1(name) for name in names)) for row in rows if row.missing is None]
    return Table(title, (Column("method", None), *(Column(name, best=True) for name in names)), tuple(cells))


def _print(table: Table) -> None:
    shown = PrintedTable(title=table.title, box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    for column in table.columns:
        shown.add_column(column.head, justify="left" if column.digits is None else "right")
    for row in table.rows:
        shown.add_row(row[0], *("-" if cell is None else f"{cell:.2f}" for cell in row[1:]))
    Console(width=None if sys.stdout.isatty() else 190).print(shown)


def _as_json(rows: list[RegionRow], dataset: str, frames: list[Frame]) -> dict[str, Any]:
    pixels = {name: row.tallies[name].pixels for row in rows for name in REGIONS if name in row.tallies}
    return {
        "dataset": dataset,
        "frames": [frame.name for frame in frames],
        "pixels": pixels,
        "results": [
            {
                "name": row.configuration.name,
                "missing": row.missing,
                "d1": {name: row.d1(name) for name in REGIONS if name in row.tallies},
                "epe": {name: row.tallies[name].epe() for name in REGIONS if name in row.tallies},
            }
            for row in rows
        ],
        "version": __version__,
    }
