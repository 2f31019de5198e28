"""The command ``stereokit study``: the paper's robustness study, on KITTI 2015 or on the built-in scenes.

Four matchers in the variants Mini+Linear, Original, Mini+CNN and Mini+StereoVAE, scored as in KITTI 2015, with our
figures and the published ones; a table, JSON, and a report. Results are stored by frame and configuration
(`stereokit_evaluation.study.store`), so that an interrupted run resumes where it ended.
"""

from __future__ import annotations

import itertools
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from stereokit import METHODS, __version__
from stereokit.cli.options import DeviceOption, JsonOption, WeightsOption, check_json, parse_settings, write_json
from stereokit.errors import OptionError
from stereokit.io import check_output
from stereokit.kernels.threads import available_threads
from stereokit_evaluation.bench.baselines import HH, THREE_WAY, opencv_threads
from stereokit_evaluation.bench.table import machine, system_load, versions
from stereokit_evaluation.common.folders import check_folder, make_folder
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.data.datasets import dataset_names, load_frames, select_frames
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.data.published import PAPER
from stereokit_evaluation.data.splits import comparison, count_frames, split
from stereokit_evaluation.report.exports import write_exports
from stereokit_evaluation.scoring.runner import seen_in_training
from stereokit_evaluation.study.configurations import available_variants, baseline, build, parse_variant
from stereokit_evaluation.study.run import Study, run_study
from stereokit_evaluation.study.store import Store
from stereokit_evaluation.study.table import as_json, print_tables
from stereokit_evaluation.training import per_matcher

__all__ = ["study"]

_DEFAULT_DISPARITIES = 128


def study(
    dataset: Annotated[str, typer.Option(help=f"One of {', '.join(dataset_names())}.")] = "scenes",
    root: Annotated[Path | None, typer.Option(help="Folder of the data set (none for scenes).")] = None,
    split_name: Annotated[
        str | None,
        typer.Option("--split", help="Of kitti2015: all, train or validation; default what can be scored."),
    ] = None,
    frames: Annotated[str | None, typer.Option(help="Numbers or names, such as 0-3,34-40.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="cost+aggregation or S1-S4; may repeat.")] = None,
    variant: Annotated[
        list[str] | None,
        typer.Option("--variant", "--setting", help="original, linear, cnn, stereovae or a refiner; may repeat."),
    ] = None,
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
        bool, typer.Option("--baselines/--no-baselines", "--peers/--no-peers", help="OpenCV's modes too.")
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
    """Run the robustness study: S1 to S4 with every refiner, and the published figures.

    Frames that cannot be read are named on standard error and left out; the exit status is then 1. An interrupted
    run has its results so far in the folder: the same command resumes.
    """
    check_json(json_file)
    check_folder(output)
    for name, value, least in (("repeats", repeats, 1), ("show", show, 0)):
        if value < least:
            raise OptionError(f"{name} must be at least {least}, got {value}")
    if split_name is not None and dataset != "kitti2015":
        raise OptionError(f"split must go with dataset kitti2015, got {dataset!r}")
    selected, part, warnings = _frames(dataset, root, split_name, frames, count)
    suggested = max((f.max_disparity for f in selected if f.max_disparity is not None), default=_DEFAULT_DISPARITIES)
    levels = suggested if max_disparity is None else max_disparity
    options = {"max_disparity": levels, "threads": threads, "device": device, **parse_settings(settings or ())}
    options |= {} if weights is None else {"weights": weights}
    methods, variants = method or list(METHODS), [parse_variant(name) for name in variant or available_variants()]
    if train_settings and not train:
        raise OptionError(f"train-set must go with train, got {train_settings[0]!r} alone")
    names = [cell.method for cell in build(methods, ["original"], {"max_disparity": levels, "device": device})]
    trained: dict[tuple[str, str], str] = {}
    training: dict[str, Any] | None = None
    if train:
        refiners = [name for name in variants if name in per_matcher.TRAINED]
        training_frames = per_matcher.training_frames(dataset, root, selected)
        training = {
            "frames": [frame.name for frame in training_frames],
            "settings": train_settings or [],
            "refiners": refiners,
        }
        for name, refiner in itertools.product(names, refiners):
            typer.echo(f"training {refiner} for {name}", err=True)
            trained[name, refiner] = per_matcher.retrain(
                name, refiner, training_frames, output / "trained", dataset=dataset, root=root, max_disparity=levels,
                settings=train_settings or (),
            )  # fmt: skip
    configurations = build(methods, variants, options, trained)
    notes = (seen_in_training(c.matcher, dataset, selected) for c in configurations)
    warnings += dict.fromkeys(line for line in notes if line is not None)
    if with_baselines:
        configurations += [baseline(key, levels) for key in (THREE_WAY, HH)]
    machine_info = machine(system_load())
    timing = {"threads": threads or available_threads(), "cpu": machine_info["cpu"]}
    steps = len(selected) * len(configurations)
    with opencv_threads(timing["threads"]), progress(steps) as (console, step):

        def print_line(line: str) -> None:
            console.print(line, markup=False, highlight=False, soft_wrap=True)

        for line in warnings:
            print_line(f"warning: {line}")
        store = Store(make_folder(output / "results"))
        result = run_study(
            selected, configurations, store, repeats=repeats, about_times=timing, step=step, report=print_line
        )
        if result.interrupted:
            print_line("interrupted: the figures cover the frames done so far; the same command goes on")
    scored = {frame.name for row in result.rows for frame in row.result.frames}
    used = [frame for frame in selected if frame.name in scored]
    document = {
        **as_json(result),
        "dataset": dataset,
        "split": part,
        "frames": [frame.name for frame in used],
        "frames_with_truth": _with_truth(result),
        "comparison": comparison(dataset, used),
        "source_of_published": PAPER,
        "warnings": warnings,
        "options": {**options, "repeats": repeats, "count": count},
        "training": training,
        "version": __version__,
        "versions": versions(),
        "machine": machine_info,
    }
    write_json(make_folder(output) / "study.json", document)
    if used:
        write_exports(document, output)
    if not write_json(json_file, document):
        counts = document["frames_with_truth"]
        heading = f"{dataset}{'' if part is None else ', ' + part}, {count_frames(used)} (noc {counts['noc']}, "
        heading += f"occ {counts['occ']}, with objects {counts['objects']})"
        print_tables(heading, result, document["comparison"])
    if report and used:
        _report(output / "report.html", document, result, used, show, print_path=str(json_file) != "-")
    _exit(result, explicit=variant is not None)


def _frames(
    dataset: str, root: Path | None, split_name: str | None, frames: str | None, count: int
) -> tuple[list[Frame], str | None, list[str]]:
    """Return the frames, the name of the split, and warnings."""
    all_frames = load_frames(dataset, root, count=count)
    if dataset == "scenes":
        all_frames[0].load_left()  # fails here if the package that draws them is missing
    if dataset != "kitti2015":
        return select_frames(all_frames, frames), None, []
    part, all_frames, warning = split(all_frames, split_name)
    return select_frames(all_frames, frames), part, [warning] if warning else []


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


def _exit(result: Study, explicit: bool) -> None:
    if result.interrupted:
        raise typer.Exit(130)
    if result.skipped or (explicit and any(row.missing for row in result.rows)):
        raise typer.Exit(1)
