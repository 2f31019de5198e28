"""The command ``stereokit batch``: maps of all pairs of a folder, a list or a video, on this machine or on a cluster.

Existing maps stay, so that the same command resumes after an interrupt, a kill or a full disk. A pair that fails is
named, and the others go on. For scripts there is `stereokit_evaluation.batch.run.run_batch`; the formats of folders and
lists are in `stereokit_evaluation.batch.pairs`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console

from stereokit.calibration import Calibration
from stereokit.cli.options import (
    DeviceOption,
    FillOption,
    JsonOption,
    LayoutOption,
    MaxDisparityOption,
    MethodOption,
    MinDisparityOption,
    RefinerOption,
    ScaleOption,
    SettingsOption,
    WeightsOption,
    check_fits_png,
    check_json,
    parse_settings,
    write_json,
)
from stereokit.cli.output import Table
from stereokit.cli.pair import AlignOption, MaskOption, NodataOption, RightMaskOption, StrictOption
from stereokit.cli.rig import AlphaOption, RigOption, check_rig_options, rig_files
from stereokit.errors import FileError, OptionError, StereokitError, one_line
from stereokit.images.check import check_integer
from stereokit.io import DISPARITY_SUFFIXES, LAYOUTS, READABLE_SUFFIXES, read_disparity, read_image
from stereokit.rig import read_rig
from stereokit_evaluation.batch.bags import Bag, is_bag, write_bag
from stereokit_evaluation.batch.combined import CombinedFiles
from stereokit_evaluation.batch.job import Job, matcher_of
from stereokit_evaluation.batch.pairs import LIST_SUFFIXES, PairFiles, folder_pairs, folders_pairs, list_pairs
from stereokit_evaluation.batch.run import Engine, Summary, identity, on_threads, run_batch
from stereokit_evaluation.batch.store import write_document
from stereokit_evaluation.batch.video import Frames, Video
from stereokit_evaluation.common.progress import progress

__all__ = ["batch", "find_pairs"]

_OWN_OPTIONS = frozenset("method max_disparity min_disparity scale refiner weights fill device threads".split())
_FORMATS = tuple(suffix[1:] for suffix in DISPARITY_SUFFIXES)
_SHOWN_ERRORS = 10


def batch(
    inputs: Annotated[list[Path], typer.Argument(help="A folder, a list or a video; or two folders or two videos.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the maps, NAME.FORMAT.")],
    method: MethodOption = "census+sgm",
    max_disparity: MaxDisparityOption = 128,
    min_disparity: MinDisparityOption = 0,
    scale: ScaleOption = 1.0,
    refiner: RefinerOption = None,
    weights: WeightsOption = None,
    fill: FillOption = None,
    device: DeviceOption = "auto",
    settings: SettingsOption = None,
    mask: MaskOption = None,
    right_mask: RightMaskOption = None,
    nodata: NodataOption = None,
    align: AlignOption = False,
    strict: StrictOption = False,
    file_format: Annotated[str, typer.Option("--format", help="png (KITTI), pfm, npy or tiff.")] = "png",
    color: Annotated[bool, typer.Option("--color", help="Also coloured pictures, in DIR/color.")] = False,
    rig: RigOption = None,
    alpha: AlphaOption = None,
    pattern: Annotated[
        tuple[str, str] | None, typer.Option(metavar="LEFT RIGHT", help="Files of a folder, '*_l.png' '*_r.png'.")
    ] = None,
    layout: LayoutOption = None,
    topics: Annotated[str | None, typer.Option(metavar="LEFT,RIGHT", help="Image topics of a ROS bag.")] = None,
    bag: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Of a ROS bag: also a bag of the maps, in metres.")
    ] = None,
    engine: Annotated[str, typer.Option(help="local or dask.")] = "local",
    scheduler: Annotated[str | None, typer.Option(help="Address or file of the Dask scheduler.")] = None,
    workers: Annotated[int | None, typer.Option(help="Pairs at a time, local; all processors by default.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Make all maps anew.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Match all pairs of a folder, a list or a video; resume where an earlier run ended.

    A folder has left and right, or image_2 and image_3, or files NAME_left and NAME_right, or others by --pattern; a
    list has lines left,right[,name]; a video has both views side by side, or is two files. Existing maps stay,
    and must come from the same inputs and options. Pairs that fail are named, and the exit status is then 1.
    With --rig the images are raw ones, and are rectified first.
    """
    check_json(json_file)
    if file_format not in _FORMATS:
        raise OptionError(f"format must be one of {', '.join(_FORMATS)}, got {file_format!r}")
    if file_format == "png":
        check_fits_png("--format png", min_disparity, max_disparity)
    options: dict[str, Any] = {"max_disparity": max_disparity, "min_disparity": min_disparity, "scale": scale}
    user_options = {"refiner": refiner, "weights": weights, "fill": fill, "nodata": nodata}
    options.update({name: value for name, value in user_options.items() if value is not None})
    options["device"] = device
    options.update(parse_settings(settings or (), _OWN_OPTIONS))
    for name in ("right", "confidence"):
        if options.get(name):
            raise OptionError(f"{name} is not written by batch, only the map of the left view is")
    if refiner is not None and refiner.endswith(".safetensors"):
        options["refiner"] = os.path.abspath(refiner)
    if weights is not None and weights.endswith(".safetensors"):
        options["weights"] = os.path.abspath(weights)
    folder = os.path.abspath(output)
    check_rig_options(rig, alpha)
    raw = () if rig is None else tuple(os.path.abspath(path) for path in rig_files(rig))
    if raw:
        read_rig(*raw)  # refuses what is none, before each pair fails of it
    left_mask, other_mask = (None if path is None else os.path.abspath(path) for path in (mask, right_mask))
    for path in (mask, right_mask):
        if path is not None:
            read_image(path)  # refuses what is none
    ordered = tuple(sorted(options.items()))
    job = Job(folder, f".{file_format}", color, method, ordered, raw, alpha, left_mask, other_mask, align, strict)
    matcher_of(job)  # refuses bad options
    run_on, engine_options, client = _engine(engine, scheduler, workers)
    try:
        source, origin = find_pairs(inputs, pattern, layout, topics)
        camera = _check_bag(bag, source, rig)
        total = source.expected if isinstance(source, Frames) else len(source)
        summary = _run(job, source, run_on, origin, overwrite, total)
    finally:
        if client is not None:
            client.close()
    if isinstance(source, Frames) and source.expected and summary.pairs < source.expected and not summary.interrupted:
        summary.notes.append(f"{source.expected} frames were expected, {summary.pairs} could be read")
    document = {**summary.as_json(), "output": folder, **engine_options, "options": identity(job, origin)}
    if Path(folder).is_dir() and not summary.vanished:
        write_document(Path(folder) / "summary.json", document)
    if bag is not None and camera is not None and not (summary.interrupted or summary.stopped):
        limits = float(min_disparity), float(max_disparity)
        summary.notes.append(f"{write_bag(bag, _maps(job), camera, limits=limits)} maps are in the bag {str(bag)!r}")
    printed = write_json(json_file, document)
    _finish(summary, job, printed)


def _check_bag(bag: Path | None, source: list[PairFiles] | Frames, rig: str | None) -> Calibration | None:
    """Return the calibration of the maps of ``--bag``; refuse what cannot be before anything is matched."""
    if bag is None:
        return None
    if not isinstance(source, Bag) or rig is not None:
        raise OptionError("--bag needs a ROS bag of rectified images as input")
    if bag.exists():
        raise OptionError(f"--bag must not exist, got {str(bag)!r}")
    camera = source.calibration()
    if camera is None:
        raise OptionError("--bag needs the camera_info of a rectified pair beside the images, which the input lacks")
    return camera


def _maps(job: Job) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield the stamps and maps of a folder, in the order of time."""
    folder = Path(job.folder)
    for path in sorted(path for path in folder.iterdir() if path.suffix == job.suffix and path.stem.isdigit()):
        yield int(path.stem), read_disparity(path)


def find_pairs(
    inputs: Sequence[Path], pattern: tuple[str, str] | None = None, layout: str | None = None, topics: str | None = None
) -> tuple[list[PairFiles] | Frames, list[str]]:
    """Return the pairs of the command's inputs, and the names of the inputs in a manifest.

    Parameters
    ----------
    inputs : sequence of Path
        One folder, list, video or ROS bag; or two folders or videos, left and right.
    pattern : (left, right) or None
        For one folder: names of files with one ``*``.
    layout : str or None
        For one folder of images, or one video, that hold both views: where they are.
    topics : str or None
        ``LEFT,RIGHT`` of a bag.

    Raises
    ------
    FileError
        If there are no pairs, or a file cannot be read.
    OptionError
        If the inputs do not go together.
    """
    for path in inputs:
        if not path.exists():
            raise FileError(f"no such file or folder: {str(path)!r}")
        if path.is_file() and path.suffix.lower() in READABLE_SUFFIXES:  # OpenCV would take it for a video of one frame
            raise OptionError(
                f"inputs must be folders, lists, videos or bags, got the image {str(path)!r}; for one pair: match"
            )
    origin = [os.path.abspath(path) for path in inputs]
    if layout is not None and layout not in LAYOUTS:
        raise OptionError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    if len(inputs) == 1 and is_bag(inputs[0]):
        if pattern is not None or layout is not None:
            raise OptionError("pattern and layout are not for ROS bags")
        chosen = None if topics is None else topics.split(",")
        return Bag(inputs[0], chosen), [*origin, *(chosen or ())]
    if topics is not None:
        raise OptionError("topics needs one ROS bag as input")
    if pattern is not None:
        if len(inputs) != 1 or not inputs[0].is_dir() or layout is not None:
            raise OptionError("pattern needs one folder as input, and no layout")
        return folder_pairs(inputs[0], pattern), [*origin, *pattern]
    if layout is not None:
        if len(inputs) != 1 or inputs[0].suffix.lower() in LIST_SUFFIXES:
            raise OptionError("layout needs one folder or one video as input")
        if inputs[0].is_dir():
            return CombinedFiles(inputs[0], layout), [*origin, layout]
        return Video(inputs[0], layout=layout), [*origin, layout]
    if len(inputs) == 1:
        if inputs[0].is_dir():
            return folder_pairs(inputs[0]), origin
        if inputs[0].suffix.lower() in LIST_SUFFIXES:
            return list_pairs(inputs[0]), origin
        return Video(inputs[0]), origin
    if len(inputs) != 2:
        raise OptionError(f"inputs must be one or two, got {len(inputs)}")
    if all(path.is_dir() for path in inputs):
        return folders_pairs(*inputs), origin
    if any(path.is_dir() or path.suffix.lower() in LIST_SUFFIXES for path in inputs):
        raise OptionError("two inputs must be two folders or two videos, left and right")
    return Video(inputs[0], inputs[1]), origin


def _engine(name: str, scheduler: str | None, workers: int | None) -> tuple[Engine, dict[str, Any], Any]:
    if name not in ("local", "dask"):
        raise OptionError(f"engine must be local or dask, got {name!r}")
    if (name == "dask") != (scheduler is not None):
        raise OptionError("--engine dask and --scheduler go together, got only one of them")
    if name == "local":
        if workers is not None:
            check_integer("workers", workers, 1, 1024)
        return partial(on_threads, workers=workers), {"engine": name, "workers": workers}, None
    if workers is not None:
        raise OptionError("--workers is for --engine local; a cluster has its own")
    assert scheduler is not None
    from stereokit_evaluation.batch.dask import connect, on_cluster

    client = connect(scheduler)
    return partial(on_cluster, client=client), {"engine": name, "scheduler": scheduler}, client


def _run(
    job: Job, source: list[PairFiles] | Frames, run_on: Engine, origin: list[str], overwrite: bool, total: int | None
) -> Summary:
    pair_count = error_count = warning_count = 0
    with progress(total) as (console, step):

        def report(line: str) -> None:
            console.print(one_line(line), markup=False, highlight=False, soft_wrap=True)

        def show(summary: Summary) -> None:
            nonlocal pair_count, error_count, warning_count
            for name, reason in summary.errors[error_count:_SHOWN_ERRORS]:
                report(f"failed {name}: {reason}")
                error_count += 1
            for name, line in summary.warnings[warning_count:_SHOWN_ERRORS]:
                report(f"warning: {name}: {line}")
                warning_count += 1
            rate = summary.pairs_per_second
            step("" if rate is None else f"{rate:.1f} pairs/s", summary.pairs - pair_count)
            pair_count = summary.pairs

        summary = run_batch(job, source, run_on, inputs=origin, overwrite=overwrite, progress=show)
        for kind, count in (
            ("failed", len(summary.errors) - error_count),
            ("doubtful", len(summary.warnings) - warning_count),
        ):
            if count > 0:
                report(f"... and {count} more {kind}, all in summary.json")
        if summary.interrupted:
            report("interrupted: the same command goes on from here")
    return summary


def _finish(summary: Summary, job: Job, printed: bool) -> None:
    for note in summary.notes:
        typer.echo(f"note: {one_line(note)}", err=True)
    if not printed:
        table = Table(box=SIMPLE_HEAD, pad_edge=False)
        for head in ("method", "pairs", "written", "there before", "failed", "seconds", "pairs/s"):
            table.add_column(head, justify="left" if head == "method" else "right", no_wrap=True)
        rate = summary.pairs_per_second
        counts = (summary.pairs, summary.written, summary.existing, summary.failed)
        seconds = f"{summary.seconds:.1f}", "-" if rate is None else f"{rate:.2f}"
        table.add_row(matcher_of(job).method, *map(str, counts), *seconds)
        Console(width=None if sys.stdout.isatty() else 120).print(table)
        if summary.lowest:
            density, name = summary.lowest[0]
            typer.echo(f"lowest density: {100 * density:.1f} % in {one_line(name)}")
    if summary.interrupted:
        raise typer.Exit(130)
    if summary.vanished:
        typer.echo(f"error: {one_line(summary.stopped)}", err=True)
        raise typer.Exit(1)
    if summary.stopped:
        raise StereokitError(f"{summary.stopped}; {summary.written} maps were written")
    if summary.failed:
        raise typer.Exit(1)
