"""The command ``stereokit train``: a refiner for the maps of one or more matchers, from data sets, streets, or both.

The result is a folder with ``weights.safetensors`` (for the option ``--refiner``), ``curves.csv``, ``curves.png``, and
a checkpoint: after a kill the same command resumes from it. With ``--folds`` each group of frames is held out once, and
the pooled score over all of them is printed: an estimate for unseen frames, where the groups are whole drives.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console

from stereokit.cli.options import JsonOption, check_json, write_json
from stereokit.cli.output import Table
from stereokit_evaluation.data.datasets import DATASETS
from stereokit_evaluation.training.run import run_training

__all__ = ["train"]


def train(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the result; created if missing.")],
    refiner: Annotated[str, typer.Option(help="stereokit (general), stereovae, cnn or pyramid.")] = "stereovae",
    dataset: Annotated[str | None, typer.Option(help=f"One of {', '.join(DATASETS)}.")] = None,
    root: Annotated[Path | None, typer.Option(help="Folder of the data set.")] = None,
    frames: Annotated[str | None, typer.Option(help="Frames to train on, such as 13-33,46.")] = None,
    validation: Annotated[str | None, typer.Option(help="Frames to validate on.")] = None,
    folds: Annotated[str | None, typer.Option(help="Groups to hold out in turn: 0-3/13-17/18-33.")] = None,
    extra: Annotated[
        list[str] | None, typer.Option(metavar="DATASET:ROOT", help="More frames to train on, never held out.")
    ] = None,
    extra_share: Annotated[float, typer.Option(help="Share of the crops that are of extra frames.")] = 0.2,
    streets: Annotated[int, typer.Option(help="Synthetic streets to train on.")] = 0,
    generated: Annotated[int, typer.Option(help="Generated pairs of all kinds to train on.")] = 0,
    assets: Annotated[
        Path | None, typer.Option(help="Folder of photographs and models that generated pairs may show.")
    ] = None,
    street_share: Annotated[float, typer.Option(help="Share of the crops of streets and generated pairs.")] = 0.5,
    method: Annotated[list[str] | None, typer.Option(help="Matchers; may repeat. Default S1 to S4.")] = None,
    variants: Annotated[int, typer.Option(help="Variants of each frame and matcher.")] = 9,
    start: Annotated[Path | None, typer.Option(help="Weights to begin with.")] = None,
    preset: Annotated[str, typer.Option(help="default, or paper for its recipe as printed.")] = "default",
    settings: Annotated[list[str] | None, typer.Option("--set", help="Setting KEY=VALUE; may repeat.")] = None,
    max_disparity: Annotated[int, typer.Option(help="Disparities of the matchers, full-size pixels.")] = 128,
    cache: Annotated[Path | None, typer.Option(help="Folder of coarse maps; default OUTPUT/cache.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Train a refiner. After a kill, the same command resumes from the checkpoint."""
    check_json(json_file)
    matchers = {"method": method} if method else {}
    document = run_training(
        output, refiner, dataset=dataset, root=root, frames=frames, validation=validation, folds=folds,
        extra=extra or (), extra_share=extra_share, streets=streets, generated=generated,
        street_share=street_share, variants=variants, start=start, preset=preset, settings=settings or (),
        max_disparity=max_disparity, cache=cache, assets=assets, **matchers,
    )  # fmt: skip
    if document.pop("rank") == 0 and not write_json(json_file, document):
        _print(document)


def _print(document: dict[str, Any]) -> None:
    table = Table(title=f"{document['refiner']}: held-out frames", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("matcher")
    table.add_column("D1 noc, %", justify="right")
    for name, value in document["pooled"].items():
        table.add_row(name, "-" if value is None else f"{value:.2f}")
    console = Console()
    if document["pooled"]:
        console.print(table)
    for result in document["results"]:
        console.print(
            f"wrote {json.dumps(result['folder'])[1:-1]}/weights.safetensors", highlight=False, soft_wrap=True
        )
