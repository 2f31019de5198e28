"""The command ``stereokit study``: the paper's robustness study, on KITTI 2015 or on the built-in scenes.

Four matchers times the settings Mini+Linear, Original, Mini+CNN and Mini+StereoVAE, scored as KITTI 2015 does, with
the published figures beside ours; a table, JSON, and a report to look at. Results are kept by frame and
configuration (`stereokit_evaluation.study.store`), so that an interrupted run goes on where it ended.
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
from stereokit_evaluation.bench.peers import HH, THREE_WAY, opencv_threads
from stereokit_evaluation.bench.table import load as system_load
from stereokit_evaluation.bench.table import machine, versions
from stereokit_evaluation.common.folders import check_folder, make_folder
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.data.datasets import dataset_names, load, select
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.data.published import PAPER
from stereokit_evaluation.data.splits import comparison, count_frames, split
from stereokit_evaluation.scoring.runner import seen_in_training
from stereokit_evaluation.study.configurations import build, parse_setting, peer, settings_at_hand
from stereokit_evaluation.study.run import Study, run_study
from stereokit_evaluation.study.store import Store
from stereokit_evaluation.study.table import as_json, print_tables
from stereokit_evaluation.training import per_matcher

__all__ = ["study"]

_DEFAULT_DISPARITIES = 128


def study(
    dataset: Annotated[str, typer.Option(help=f"One of {', '.join(dataset_names())}.")] = "scenes",
    root: Annotated[Path | None, typer.Option(help="Folder of the data set (none for scenes).")] = None,
    which: Annotated[
        str | None,
        typer.Option("--split", help="Of kitti2015: all, train or validation; default what can be scored."),
    ] = None,
    frames: Annotated[str | None, typer.Option(help="Numbers or names, such as 0-3,34-40.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="cost+aggregation or S1-S4; may repeat.")] = None,
    setting: Annotated[
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
    repeats: Annotated[int, typer.Option(help="Timed calls for each frame; the median counts.")] = 3,
    with_peers: Annotated[bool, typer.Option("--peers/--no-peers", help="OpenCV's modes too.")] = True,
    train: Annotated[bool, typer.Option("--train", help="Train each refiner for each matcher first.")] = False,
    train_settings: Annotated[
        list[str] | None, typer.Option("--train-set", metavar="KEY=VALUE", help="Setting of the training; may repeat.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Results are kept here; a later run goes on.")
    ] = Path("study"),
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html to the folder.")] = True,
    show: Annotated[int, typer.Option(help="Frames to look at in the report.")] = 3,
    json_file: JsonOption = None,
) -> None:
    """Run the robustness study: S1 to S4 with every refiner, beside the published figures.

    Frames that cannot be read are named on standard error and left out; the exit status is then 1. An interrupted
    run keeps what it has: the same command goes on.
    """
    check_json(json_file)
    check_folder(output)
    for name, value, least in (("repeats", repeats, 1), ("show", show, 0)):
        if value < least:
            raise OptionError(f"{name} must be at least {least}, got {value}")
    if which is not None and dataset != "kitti2015":
        raise OptionError(f"split must go with dataset kitti2015, got {dataset!r}")
    chosen, part, warnings = _frames(dataset, root, which, frames, count)
    suggested = max((f.max_disparity for f in chosen if f.max_disparity is not None), default=_DEFAULT_DISPARITIES)
    levels = suggested if max_disparity is None else max_disparity
    options = {"max_disparity": levels, "threads": threads, "device": device, **parse_settings(settings or ())}
    options |= {} if weights is None else {"weights": weights}
    methods, wanted = method or list(METHODS), [parse_setting(name) for name in setting or settings_at_hand()]
    if train_settings and not train:
        raise OptionError(f"train-set must go with train, got {train_settings[0]!r} alone")
    names = [cell.method for cell in build(methods, ["original"], {"max_disparity": levels, "device": device})]
    trained: dict[tuple[str, str], str] = {}
    training: dict[str, Any] | None = None
    if train:
        learners = [name for name in wanted if name in per_matcher.TRAINED]
        given = per_matcher.training_frames(dataset, root, chosen)
        training = {"frames": [frame.name for frame in given], "settings": train_settings or [], "refiners": learners}
        for name, refiner in itertools.product(names, learners):
            typer.echo(f"training {refiner} for {name}", err=True)
            trained[name, refiner] = per_matcher.retrain(
                name, refiner, given, output / "trained", dataset=dataset, root=root, max_disparity=levels,
                settings=train_settings or (),
            )  # fmt: skip
    configurations = build(methods, wanted, options, trained)
    seen = (seen_in_training(c.matcher, dataset, chosen) for c in configurations)
    warnings += dict.fromkeys(line for line in seen if line is not None)
    if with_peers:
        configurations += [peer(key, levels) for key in (THREE_WAY, HH)]
    about = machine(system_load())
    timing = {"threads": threads or available_threads(), "cpu": about["cpu"]}
    steps = len(chosen) * len(configurations)
    with opencv_threads(timing["threads"]), progress(steps) as (console, step):

        def tell(line: str) -> None:
            console.print(line, markup=False, highlight=False, soft_wrap=True)

        for line in warnings:
            tell(f"warning: {line}")
        store = Store(make_folder(output / "results"))
        found = run_study(chosen, configurations, store, repeats=repeats, about_times=timing, step=step, tell=tell)
        if found.interrupted:
            tell("interrupted: the figures cover the frames done so far; the same command goes on")
    scored = {frame.name for row in found.rows for frame in row.result.frames}
    used = [frame for frame in chosen if frame.name in scored]
    document = {
        **as_json(found),
        "dataset": dataset,
        "split": part,
        "frames": [frame.name for frame in used],
        "frames_with_truth": _with_truth(found),
        "comparison": comparison(dataset, used),
        "source_of_published": PAPER,
        "warnings": warnings,
        "options": {**options, "repeats": repeats, "count": count},
        "training": training,
        "version": __version__,
        "versions": versions(),
        "machine": about,
    }
    if not write_json(json_file, document):
        counts = document["frames_with_truth"]
        heading = f"{dataset}{'' if part is None else ', ' + part}, {count_frames(used)} (noc {counts['noc']}, "
        heading += f"occ {counts['occ']}, with objects {counts['objects']})"
        print_tables(heading, found, document["comparison"])
    if report and used:
        _report(output / "report.html", document, found, used, show, print_path=str(json_file) != "-")
    _exit(found, explicit=setting is not None)


def _frames(
    dataset: str, root: Path | None, which: str | None, frames: str | None, count: int
) -> tuple[list[Frame], str | None, list[str]]:
    """Return the frames, the name of the split, and warnings."""
    every = load(dataset, root, count=count)
    if dataset == "scenes":
        every[0].load_left()  # the package that draws them is there, or this says that it is not
    if dataset != "kitti2015":
        return select(every, frames), None, []
    part, every, warning = split(every, which)
    return select(every, frames), part, [warning] if warning else []


def _with_truth(found: Study) -> dict[str, int]:
    """Return how many of the scored frames have which ground truth: D1 columns cover different frames."""
    scores = next((row.result.frames for row in found.rows if row.result.frames), ())
    return {
        "noc": sum(frame.score.noc.all.filled.pixels > 0 for frame in scores),
        "occ": sum(frame.score.occ.all.filled.pixels > 0 for frame in scores),
        "objects": sum((f.score.noc.bg + f.score.occ.bg).filled.pixels > 0 for f in scores),
    }


def _report(
    path: Path, document: dict[str, Any], found: Study, frames: list[Frame], show: int, print_path: bool
) -> None:
    absent = [name for name in ("plotly", "jinja2") if find_spec(name) is None]
    if absent:
        typer.echo(f'no report: this needs {" and ".join(absent)}; pip install "stereokit[report]"', err=True)
        return
    from stereokit_evaluation.report.page import write_report

    check_output(path, name="report")
    size = write_report(path, document, found, frames, show)
    if print_path:
        typer.echo(f"report: {path} ({size / 1e6:.1f} MB)")


def _exit(found: Study, explicit: bool) -> None:
    if found.interrupted:
        raise typer.Exit(130)
    if found.skipped or (explicit and any(row.missing for row in found.rows)):
        raise typer.Exit(1)
