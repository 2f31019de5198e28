"""The command ``stereokit study``: methods side by side on any number of data sets, and the paper's study.

By default the four matchers in the variants Mini+Linear, Original, Mini+CNN and Mini+StereoVAE and OpenCV's modes, with
the published figures; and with them any function, program or finished maps. Each data set has its measures with
intervals by scene, its benchmark's own figures, and, with ``--disturb``, errors against the strength of faults of the
cameras. Results are stored by frame and configuration (`stereokit_evaluation.study.store`), so that an interrupted run
resumes where it ended.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from stereokit import METHODS, __version__
from stereokit.cli.options import DeviceOption, JsonOption, WeightsOption, check_json, parse_settings, write_json
from stereokit.errors import FileError, OptionError
from stereokit.io import check_output, read_json
from stereokit.kernels.threads import available_threads
from stereokit_evaluation.bench.baselines import HH, THREE_WAY, opencv_threads
from stereokit_evaluation.bench.table import machine, system_load, versions
from stereokit_evaluation.common.folders import check_folder, make_folder
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.data.datasets import dataset_names
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.data.published import PAPER
from stereokit_evaluation.data.splits import comparison, count_frames
from stereokit_evaluation.report.exports import write_exports
from stereokit_evaluation.scoring.outside import is_function, outside_methods
from stereokit_evaluation.scoring.runner import seen_in_training
from stereokit_evaluation.study.configurations import (
    Configuration,
    available_variants,
    baseline,
    baseline_key,
    build,
    outside,
    parse_variant,
)
from stereokit_evaluation.study.data import DataPart, load_part, merge_studies, parse_data, spread_frames
from stereokit_evaluation.study.disturbances import DisturbedStudy, disturbances_json, run_disturbances
from stereokit_evaluation.study.run import Study, run_study
from stereokit_evaluation.study.store import Store
from stereokit_evaluation.study.table import (
    as_json,
    official_json,
    print_disturbances,
    print_measures,
    print_overview,
    print_tables,
)
from stereokit_evaluation.synthetic.disturbances import DISTURBANCES, parse_disturbances
from stereokit_evaluation.training import per_matcher

__all__ = ["study"]


def study(
    dataset: Annotated[str | None, typer.Option(help=f"One of {', '.join(dataset_names())}; default scenes.")] = None,
    root: Annotated[Path | None, typer.Option(help="Folder of the data set (none for scenes).")] = None,
    data: Annotated[
        list[str] | None, typer.Option(metavar="[NAME=]DATA:DIR", help="A data set and its folder; may repeat.")
    ] = None,
    split_name: Annotated[
        str | None,
        typer.Option("--split", help="Of kitti2015: all, train or validation; default what can be scored."),
    ] = None,
    frames: Annotated[
        list[str] | None, typer.Option(help="Numbers or names, such as 0-3,34-40, or DATA:0-3; may repeat.")
    ] = None,
    max_frames: Annotated[int | None, typer.Option(help="At most so many of each data set, evenly spaced.")] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(help="S1-S4, cost+aggregation, 'OpenCV HH', or a function [NAME=]module:function; may repeat."),
    ] = None,
    variant: Annotated[
        list[str] | None,
        typer.Option("--variant", "--setting", "--refiner", help="original, linear or another refiner; may repeat."),
    ] = None,
    command: Annotated[
        list[str] | None, typer.Option(metavar="NAME=LINE", help="A program: prog {left} {right} {out}; may repeat.")
    ] = None,
    time_limit: Annotated[float | None, typer.Option(help="Seconds that a program may take for a pair.")] = None,
    predictions: Annotated[
        list[str] | None, typer.Option(metavar="NAME=DIR", help="Finished maps, in DIR/DATA or DIR; may repeat.")
    ] = None,
    disturb: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND[:S1,S2]", help=f"Faults: all, {', '.join(DISTURBANCES)}; may repeat."),
    ] = None,
    disturb_frames: Annotated[int | None, typer.Option(help="Disturb at most so many frames of each data set.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Option of a stage; may repeat.")
    ] = None,
    weights: WeightsOption = None,
    max_disparity: Annotated[int | None, typer.Option(help="Disparities; default by data set.")] = None,
    count: Annotated[int, typer.Option(help="Number of synthetic scenes.")] = 20,
    threads: Annotated[int | None, typer.Option(help="Threads of the matchers.")] = None,
    device: DeviceOption = "auto",
    repeats: Annotated[int, typer.Option(help="Timed calls for each frame; the median counts.")] = 3,
    with_baselines: Annotated[
        bool, typer.Option("--baselines/--no-baselines", "--peers/--no-peers", help="OpenCV's 3WAY and HH too.")
    ] = True,
    train: Annotated[bool, typer.Option("--train", help="Train each refiner for each matcher first.")] = False,
    train_settings: Annotated[
        list[str] | None, typer.Option("--train-set", metavar="KEY=VALUE", help="Setting of the training; may repeat.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the results; a later run resumes.")
    ] = Path("study"),
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html to the folder.")] = True,
    show: Annotated[int, typer.Option(help="Frames in the report's viewer.")] = 3,
    json_file: JsonOption = None,
) -> None:
    """Compare methods over data sets: S1 to S4 with every refiner, OpenCV, your own, and the published figures.

    Frames that cannot be read, or that a method fails on, are named on standard error and left out; the exit status is
    then 1. An interrupted run has its results so far in the folder: the same command resumes.
    """
    check_json(json_file)
    check_folder(output)
    limits = (("repeats", repeats, 1), ("show", show, 0), ("max_frames", max_frames, 1))
    for name, value, least in (*limits, ("disturb_frames", disturb_frames, 1)):
        if value is not None and value < least:
            raise OptionError(f"{name} must be at least {least}, got {value}")
    strengths = parse_disturbances(disturb or [])
    if disturb_frames is not None and not strengths:
        raise OptionError(f"disturb_frames must go with disturb, got {disturb_frames} alone")
    if data and (dataset is not None or root is not None):
        raise OptionError(f"dataset and root must not be set with data, got {dataset or str(root)!r}")
    names_of_data = parse_data(data) if data else [(dataset or "scenes", dataset or "scenes", root)]
    if split_name is not None and all(kind != "kitti2015" for _, kind, _ in names_of_data):
        raise OptionError(f"split must go with dataset kitti2015, got {names_of_data[0][1]!r}")
    selections = _selections(frames or [], [name for name, _, _ in names_of_data])
    parts = [
        load_part(
            name, kind, folder, split_name=split_name, selection=selections.get(name), count=count,
            max_frames=max_frames, max_disparity=max_disparity,
        )
        for name, kind, folder in names_of_data
    ]  # fmt: skip
    options = {"threads": threads, "device": device, **parse_settings(settings or ())}
    options |= {} if weights is None else {"weights": weights}
    chosen = method or list(METHODS)
    functions = [text for text in chosen if is_function(text)]
    modes = [key for text in chosen if text not in functions and (key := baseline_key(text)) is not None]
    ours = [text for text in chosen if text not in functions and baseline_key(text) is None]
    modes += [key for key in (THREE_WAY, HH) if with_baselines]
    variants = [parse_variant(name) for name in variant or available_variants()]
    if train_settings and not train:
        raise OptionError(f"train-set must go with train, got {train_settings[0]!r} alone")
    if train and len(parts) > 1:
        raise OptionError(f"train must go with one data set, got {len(parts)}")
    trained, training = _train(parts[0], ours, variants, train_settings, output, device) if train else ({}, None)

    def configurations_of(part: DataPart) -> list[Configuration]:
        all_options = {"max_disparity": part.levels, **options}
        rows = build(ours, variants, all_options, trained) if ours else []
        rows += [baseline(key, part.levels) for key in dict.fromkeys(modes)]
        others = outside_methods(
            functions, command or (), predictions or (), max_disparity=part.levels, time_limit=time_limit,
            dataset=part.name,
        )  # fmt: skip
        rows += [outside(other) for other in others]
        names = [row.name for row in rows]
        for name in names:
            if names.count(name) > 1:
                raise OptionError(f"methods must have different names, got {name!r} twice; use another NAME=...")
        return rows

    rows_by_part = [configurations_of(part) for part in parts]
    for part, rows in zip(parts, rows_by_part, strict=True):
        notes = (seen_in_training(row.matcher, part.dataset, part.frames) for row in rows)
        part.warnings.extend(dict.fromkeys(line for line in notes if line is not None))
    machine_info = machine(system_load())
    timing = {"threads": threads or available_threads(), "cpu": machine_info["cpu"]}
    faults = sum(len(values) for values in strengths.values())
    to_disturb = [spread_frames(part.frames, disturb_frames) if faults else [] for part in parts]
    steps = sum(
        (len(part.frames) + faults * len(others)) * len(rows)
        for part, rows, others in zip(parts, rows_by_part, to_disturb, strict=True)
    )
    studies: list[Study] = []
    disturbed: list[DisturbedStudy] = []
    with opencv_threads(timing["threads"]), progress(steps) as (console, step):

        def print_line(line: str) -> None:
            console.print(line, markup=False, highlight=False, soft_wrap=True)

        store = Store(make_folder(output / "results"))
        for part, rows, others in zip(parts, rows_by_part, to_disturb, strict=True):
            for line in part.warnings:
                print_line(f"warning: {line}")
            studies.append(
                run_study(part.frames, rows, store, repeats=repeats, about_times=timing, step=step, report=print_line)
            )
            if not studies[-1].interrupted:
                disturbed.append(run_disturbances(others, rows, store, strengths, step=step, report=print_line))
            if studies[-1].interrupted or disturbed[-1].interrupted:
                print_line("interrupted: the figures cover the frames done so far; the same command goes on")
                break
    parts = parts[: len(studies)]
    documents = {
        part.name: _part_json(part, study_, faulty)
        for part, study_, faulty in itertools.zip_longest(parts, studies, disturbed)
    }
    whole, all_frames = (studies[0], parts[0].frames) if len(parts) == 1 else merge_studies(parts, studies)
    scored = {frame.name for row in whole.rows for frame in row.result.frames}
    used = [frame for frame in all_frames if frame.name in scored]
    title = ", ".join(part.name for part in parts)
    stopped = whole.interrupted or any(study.interrupted for study in disturbed)
    document = {
        **as_json(whole, parts[0].dataset if len(parts) == 1 else None),
        "interrupted": stopped,
        "dataset": title,
        "split": parts[0].split if len(parts) == 1 else None,
        "frames": [frame.name for frame in used],
        "frames_with_truth": _with_truth(whole),
        "comparison": _comparison(parts, studies, title, used),
        "source_of_published": PAPER,
        "warnings": list(itertools.chain.from_iterable(part.warnings for part in parts)),
        "options": {
            "max_disparity": parts[0].levels if len(parts) == 1 else {part.name: part.levels for part in parts},
            **options,
            "repeats": repeats,
            "count": count,
        },
        "training": training,
        "data": documents,
        "disturbances": disturbances_json(list(zip(disturbed, studies, strict=False))) if strengths else {},
        "version": __version__,
        "versions": versions(),
        "machine": machine_info,
    }
    before = _earlier(output / "study.json")
    write_json(make_folder(output) / "study.json", document)
    if used:
        write_exports(document, output, before)
    if not write_json(json_file, document):
        _print(parts, studies, documents, document)
    if report and used:
        _report(output / "report.html", document, whole, used, show, print_path=str(json_file) != "-")
    explicit = variant is not None or bool(functions or command or predictions)
    if stopped:
        raise typer.Exit(130)
    if whole.skipped or any(study.failed for study in disturbed):
        raise typer.Exit(1)
    if explicit and any(row.missing for row in whole.rows):
        raise typer.Exit(1)


def _selections(texts: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return the selection of frames of each data set: ``0-3`` is for all of them, ``DATA:0-3`` for one."""
    selections: dict[str, str] = {}
    for text in texts:
        name, separator, selection = text.partition(":")
        targets = [name] if separator else names
        if separator and name not in names:
            raise OptionError(f"frames must be DATA:SELECTION with DATA one of {', '.join(names)}, got {text!r}")
        for target in targets:
            selections[target] = f"{selections[target]},{selection}" if target in selections and separator else (
                selection if separator else text
            )  # fmt: skip
    return selections


def _train(
    part: DataPart,
    methods: Sequence[str],
    variants: Sequence[str],
    settings: list[str] | None,
    output: Path,
    device: str,
) -> tuple[dict[tuple[str, str], str], dict[str, Any]]:
    """Train each refiner for each matcher; return their weights, and the training for the JSON."""
    cells = build(methods, ["original"], {"max_disparity": part.levels, "device": device}) if methods else []
    refiners = [name for name in variants if name in per_matcher.TRAINED]
    training_frames = per_matcher.training_frames(part.dataset, part.root, part.frames)
    training = {
        "frames": [frame.name for frame in training_frames],
        "settings": settings or [],
        "refiners": refiners,
    }
    trained: dict[tuple[str, str], str] = {}
    for name, refiner in itertools.product([cell.method for cell in cells], refiners):
        typer.echo(f"training {refiner} for {name}", err=True)
        trained[name, refiner] = per_matcher.retrain(
            name, refiner, training_frames, output / "trained", dataset=part.dataset, root=part.root,
            max_disparity=part.levels, settings=settings or (),
        )  # fmt: skip
    return trained, training


def _part_json(part: DataPart, result: Study, faulty: DisturbedStudy | None) -> dict[str, Any]:
    """Return one data set's entry of ``data``."""
    benchmarks = {frame.name: frame.benchmark.name for frame in part.frames if frame.benchmark is not None}
    return {
        **as_json(result, part.dataset),
        "dataset": part.dataset,
        "frames_with_truth": _with_truth(result),
        "root": None if part.root is None else str(part.root),
        "split": part.split,
        "frames": [frame.name for frame in part.frames],
        "max_disparity": part.levels,
        "warnings": part.warnings,
        "official": official_json(result, benchmarks),
        "disturbances": {} if faulty is None else disturbances_json([(faulty, result)]),
    }


def _print(
    parts: Sequence[DataPart], studies: Sequence[Study], documents: dict[str, Any], document: dict[str, Any]
) -> None:
    for part, result in zip(parts, studies, strict=True):
        heading = f"{part.name}{'' if part.split is None else ', ' + part.split}"
        scored = {frame.name for row in result.rows for frame in row.result.frames}
        used = [frame for frame in part.frames if frame.name in scored]
        if len(parts) == 1:
            counts = document["frames_with_truth"]
            long = f"{heading}, {count_frames(used)} (noc {counts['noc']}, occ {counts['occ']}, "
            heading_of_all = f"{long}with objects {counts['objects']})"
            print_tables(heading_of_all, result, document["comparison"], part.dataset)
        print_measures(f"{heading}, {count_frames(used)}", result, documents[part.name]["official"])
    if len(parts) > 1:
        print_overview({part.name: result for part, result in zip(parts, studies, strict=True)})
    print_disturbances(document["disturbances"])


def _earlier(path: Path) -> dict[str, Any] | None:
    """Return the JSON of the study that was in the folder, None where there is none that can be read."""
    try:
        document = read_json(path, "study")
    except FileError:
        return None
    return document if isinstance(document, dict) else None


def _comparison(parts: Sequence[DataPart], studies: Sequence[Study], title: str, used: Sequence[Frame]) -> str:
    """Return the line about the published figures: they are of KITTI 2015, and stand beside that alone."""
    for part, result in zip(parts, studies, strict=True):
        if part.dataset == "kitti2015":
            scored = {frame.name for row in result.rows for frame in row.result.frames}
            return comparison("kitti2015", [frame for frame in part.frames if frame.name in scored])
    return comparison(title, used)


def _with_truth(result: Study) -> dict[str, int]:
    """Return the numbers of scored frames by kind of ground truth: D1 columns cover different frames."""
    scores = next((row.result.frames for row in result.rows if row.result.frames), ())
    return {
        "noc": sum(frame.score.noc.all.filled.pixels > 0 for frame in scores),
        "occ": sum(frame.score.occ.all.filled.pixels > 0 for frame in scores),
        "objects": sum((f.score.noc.bg + f.score.occ.bg).filled.pixels > 0 for f in scores),
    }


def _report(
    path: Path, document: dict[str, Any], result: Study, frames: list[Frame], show: int, print_path: bool
) -> None:
    absent = [name for name in ("plotly", "jinja2") if find_spec(name) is None]
    if absent:
        typer.echo(f'no report: this needs {" and ".join(absent)}; pip install "stereokit[report]"', err=True)
        return
    from stereokit_evaluation.report.page import write_report

    check_output(path, name="report")
    size = write_report(path, document, result, frames, show)
    if print_path:
        typer.echo(f"report: {path} ({size / 1e6:.1f} MB)")
