"""The command ``stereokit evaluate``: methods, programs and finished maps, scored on a data set in one table.

Scores are those of the KITTI 2015 development kit (`stereokit_evaluation.scoring.kitti`), pooled over images. A
column counts only the images that have its ground truth. For scripts there is `run`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console

from stereokit import __version__
from stereokit.cli.options import DeviceOption, JsonOption, WeightsOption, check_json, parse_settings, write_json
from stereokit.cli.output import Table
from stereokit.errors import OptionError, one_line
from stereokit.io import write_image
from stereokit_evaluation.bench.baselines import padded
from stereokit_evaluation.common.folders import make_folder
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.common.weights import check_weights, weights_option
from stereokit_evaluation.data.datasets import dataset_names, load_frames, select_frames
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.error_map import error_map
from stereokit_evaluation.scoring.outside import MapFolder, OutsideMethod, is_function, outside_methods
from stereokit_evaluation.scoring.runner import (
    Estimate,
    Estimator,
    Result,
    Scored,
    Skipped,
    from_files,
    run,
    score_frames,
    seen_in_training,
    with_matcher,
    with_outside,
)
from stereokit_evaluation.scoring.summary import pixels_line, summary
from stereokit_evaluation.study.configurations import baseline_key

__all__ = ["Result", "evaluate", "run"]

_DEFAULT_METHOD = "census+sgm"
_DEFAULT_DISPARITIES = 128
_OWN_OPTIONS = frozenset(("method", "scale", "refiner", "weights", "device", "threads", "max_disparity"))


@dataclass(frozen=True)
class _Run:
    """One row of the table: an estimator and its description."""

    estimate: Estimator
    method: str
    scale: float | None = None
    refiner: str | None = None
    device: str | None = None
    matcher: Any = None
    kind: str = "stereokit"

    @property
    def folder(self) -> str:
        """The unique name of the folder of its pictures."""
        name = self.method.replace("/", "_").replace(":", "_")
        return name if self.refiner is None else f"{name}-{Path(self.refiner).name}"


def evaluate(
    dataset: Annotated[str, typer.Option(help=f"One of {', '.join(dataset_names())}.")],
    root: Annotated[Path | None, typer.Option(help="Folder of the data set (none for scenes).")] = None,
    frames: Annotated[str | None, typer.Option(help="Numbers or names, such as 0-3,34-40.")] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(help="S1-S4, cost+aggregation, 'OpenCV HH', or a function [NAME=]module:function; may repeat."),
    ] = None,
    scale: Annotated[float, typer.Option(help="1, or 0.5 or 0.25 to match at a smaller size.")] = 1.0,
    refiner: Annotated[list[str] | None, typer.Option(help="Refiner of the map; may repeat.")] = None,
    weights: WeightsOption = None,
    predictions: Annotated[
        list[str] | None,
        typer.Option(metavar="[NAME=]DIR", help="Score the maps FRAME.png, .pfm, .npy from here; may repeat."),
    ] = None,
    command: Annotated[
        list[str] | None, typer.Option(metavar="NAME=LINE", help="A program: prog {left} {right} {out}; may repeat.")
    ] = None,
    time_limit: Annotated[float | None, typer.Option(help="Seconds that a program may take for a pair.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of the matcher.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", help="Stage option key=value; may repeat.")] = None,
    max_disparity: Annotated[int | None, typer.Option(help="Disparities; default by data set.")] = None,
    device: DeviceOption = "auto",
    color: Annotated[bool, typer.Option("--color/--gray", help="Images as stored, or grey.")] = False,
    count: Annotated[int, typer.Option(help="Number of synthetic scenes.")] = 20,
    error_maps: Annotated[Path | None, typer.Option(help="Write error maps to METHOD/NAME.png here.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Score matching methods, or finished disparity maps, against ground truth as KITTI 2015 does.

    Frames that cannot be read are named on standard error and left out; the exit status is then 1.
    """
    check_json(json_file)
    selected = select_frames(load_frames(dataset, root, count=count), frames)
    chosen = method or ([] if predictions or command else [_DEFAULT_METHOD])
    functions = [text for text in chosen if is_function(text)]
    modes = [key for text in chosen if text not in functions and (key := baseline_key(text)) is not None]
    ours = [text for text in chosen if text not in functions and baseline_key(text) is None]
    own: dict[str, Any] = {"refiner": refiner, "weights": weights, "set": settings, "threads": threads}
    own["scale"] = None if scale == 1.0 else scale
    for name in (name for name, value in own.items() if value is not None and value != [] and not ours):
        raise OptionError(f"{name} must go with a method of ours, got {own[name]!r} without one")
    suggested = [frame.max_disparity for frame in selected if frame.max_disparity is not None]
    levels = max(suggested, default=_DEFAULT_DISPARITIES) if max_disparity is None else max_disparity
    others = outside_methods(functions, command or (), predictions or (), max_disparity=levels, time_limit=time_limit)
    stage_options = {"threads": threads, **parse_settings(settings or (), _OWN_OPTIONS)}
    options: dict[str, Any] = {"max_disparity": levels, **stage_options}
    check_weights(refiner or (), weights)
    runs = [
        _matcher_run(name, scale, refine, device, options | weights_option(refine, weights, refiner or ()), color)
        for name in ours
        for refine in (dict.fromkeys(refiner) if refiner else (None,))
    ]
    runs += [_Run(with_matcher(padded(key, levels)), key, kind="opencv") for key in dict.fromkeys(modes)]
    runs += [_outside_run(other) for other in others]
    options |= {} if not predictions else {"predictions": [str(place) for place in predictions]}
    notes = (seen_in_training(job.matcher, dataset, selected) for job in runs)
    for line in dict.fromkeys(line for line in notes if line is not None):
        typer.echo(f"note: {line}", err=True)
    results, interrupted = _execute(runs, selected, error_maps)
    skipped = list(dict.fromkeys(skip for result in results for skip in result.skipped))
    document = {
        "results": [_as_json(job, result) for job, result in zip(runs, results, strict=False)],
        "dataset": dataset,
        "options": {**options, "weights": weights, "color": color, "frames": frames},
        "skipped": [{"frame": skip.name, "reason": skip.reason} for skip in skipped],
        "interrupted": interrupted,
        "version": __version__,
    }
    if not write_json(json_file, document):
        _print_table(f"{dataset}, {len(selected)} frames", runs, results)
        if results and results[0].frames:
            typer.echo(f"{pixels_line(results[0])}{_columns_line(results[0])}")
    if interrupted:
        raise typer.Exit(130)
    if skipped:
        raise typer.Exit(1)


def _matcher_run(
    method: str, scale: float, refiner: str | None, device: str, options: dict[str, Any], color: bool
) -> _Run:
    from stereokit import Matcher

    matcher = Matcher(method, scale=scale, refiner=refiner, device=device, **options)
    estimate = with_matcher(matcher, gray=not color)
    return _Run(estimate, str(matcher.method), scale, refiner, str(matcher.device), matcher)


def _outside_run(method: OutsideMethod) -> _Run:
    estimate = from_files(method.folder) if isinstance(method, MapFolder) else with_outside(method)
    return _Run(estimate, method.name, kind=method.kind)


def _execute(runs: Sequence[_Run], frames: Sequence[Frame], maps: Path | None) -> tuple[list[Result], bool]:
    """Run all and print skipped frames at once; an interrupt ends the work, and the results so far are returned."""
    results: list[Result] = []
    printed: set[str] = set()
    with progress(len(runs) * len(frames)) as (console, step):
        for job in runs:
            scored: list[Scored] = []
            skipped: list[Skipped] = []
            draw = None if maps is None else _draws(maps / job.folder)
            try:
                for outcome in score_frames(frames, job.estimate, draw):
                    if isinstance(outcome, Scored):
                        scored.append(outcome)
                        lines = [f"warning: {outcome.name}: {line}" for line in outcome.warnings]
                    else:
                        skipped.append(outcome)
                        lines = [f"skipped {outcome.name}: {outcome.reason}"]
                    for line in map(one_line, lines):
                        if line not in printed:
                            console.print(line, markup=False, highlight=False, soft_wrap=True)
                            printed.add(line)
                    step(f"{job.method} {outcome.name}")
            except KeyboardInterrupt:
                console.print("interrupted: the figures cover the frames done so far", highlight=False)
                return [*results, Result(tuple(scored), tuple(skipped))], True
            results.append(Result(tuple(scored), tuple(skipped)))
    return results, False


def _draws(folder: Path) -> Callable[..., None]:
    make_folder(folder, "error_maps")

    def draw(frame: Frame, estimate: Estimate, noc: NDArray[Any] | None, occ: NDArray[Any] | None) -> None:
        truth = noc if occ is None else occ
        if truth is None:
            return
        name = frame.name.replace("/", "_")
        write_image(folder / f"{name}.png", error_map(estimate.disparity, truth, noc))

    return draw


def _print_table(title: str, runs: Sequence[_Run], results: Sequence[Result]) -> None:
    table = Table(title=title, box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    table.add_column("method", no_wrap=True)
    heads = ("images", "D1 noc", "bg", "fg", "D1 occ", "bad-1", "bad-2", "EPE", "RMSE", "A90", "density", "ms")
    for head in heads:
        table.add_column(head, justify="right")
    for job, result in zip(runs, results, strict=False):
        noc, occ = result.score.noc, result.score.occ
        seconds = result.seconds_per_image
        figures = (
            *(part.filled.d1() for part in (noc.all, noc.bg, noc.fg, occ.all)),
            *(result.measures.main.figure(name) for name in ("bad-1", "bad-2", "epe", "rmse", "a90")),
        )
        table.add_row(
            " ".join(str(word) for word in (job.method, job.refiner, _half(job.scale)) if word),
            str(len(result.frames)),
            *("-" if figure is None else f"{figure:.2f}" for figure in figures),
            "-" if (density := result.measures.main.figure("density")) is None else f"{density:.1f}",
            "-" if seconds is None else f"{1000 * seconds:.1f}",
        )
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def _columns_line(result: Result) -> str:
    """Return how many pairs the D1 columns count, where these are not all."""
    pairs, noc, occ = (getattr(result.measures, name).pairs for name in ("main", "noc", "all"))
    return "" if noc in (0, pairs) else f" D1 noc, bg, fg: {noc} of the pairs; D1 occ: {occ}."


def _half(scale: float | None) -> str:
    return "" if scale in (None, 1.0) else f"x{scale:g}"


def _as_json(job: _Run, result: Result) -> dict[str, Any]:
    """Return one entry of ``results``."""
    entry = {"method": job.method, "scale": job.scale, "refiner": job.refiner, "device": job.device, "kind": job.kind}
    return {**entry, **summary(result)}
