"""The command ``stereokit submit``: an archive for the server of a benchmark, from a matcher or from finished maps."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from stereokit import Matcher, __version__
from stereokit.cli.options import (
    DeviceOption,
    JsonOption,
    WeightsOption,
    check_json,
    parse_settings,
    write_json,
)
from stereokit.errors import FileError, OptionError
from stereokit.io import DISPARITY_SUFFIXES, check_output, read_text
from stereokit.notices import collecting
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.common.weights import check_weights, weights_option
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.runner import Estimate, Estimator, from_files, with_matcher
from stereokit_evaluation.scoring.submissions import BENCHMARKS, Submission, expected_frames, write_archive

__all__ = ["submit"]

_DEFAULT_DISPARITIES = 192
_SHOWN = 3


def submit(
    benchmark: Annotated[str, typer.Argument(help=f"One of {', '.join(BENCHMARKS)}.")],
    root: Annotated[Path, typer.Option(help="Folder of the data set, as its archives unpack.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The .zip file to write.")],
    method: Annotated[str | None, typer.Option("--method", "-m", help="cost+aggregation or S1-S4; default S2.")] = None,
    scale: Annotated[float, typer.Option(help="1, or 0.5 or 0.25 to match at a smaller size.")] = 1.0,
    refiner: Annotated[str | None, typer.Option(help="Refiner of the map.")] = None,
    weights: WeightsOption = None,
    max_disparity: Annotated[int | None, typer.Option(help="Disparities; default by data set and pair.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Option of a stage; may repeat.")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of the matcher.")] = None,
    device: DeviceOption = "auto",
    color: Annotated[bool, typer.Option("--color/--gray", help="Images as stored, or grey.")] = False,
    predictions: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Finished maps NAME.png, .pfm, .npy or .tiff instead.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="Time of each finished map, where no NAME.txt beside it says it.")
    ] = None,
    name: Annotated[str, typer.Option(help="The method's name in Middlebury's files.")] = "stereokit",
    part: Annotated[
        str | None, typer.Option(help="test (KITTI, its default), training (the others' default) or all.")
    ] = None,
    resolution: Annotated[str | None, typer.Option(help="F, H or Q, of Middlebury.")] = None,
    sparse: Annotated[bool, typer.Option("--sparse", help="Keep pixels that were not measured unknown.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Write the archive that a benchmark's server takes: all its pairs, in its layout, checked.

    Nothing is written before every map is there, has the size of its image, and is finite and in range.
    """
    check_json(json_file)
    check_output(output, (".zip",), "output")
    submission = expected_frames(benchmark, root, part, resolution)
    if predictions is not None:
        conflicts: dict[str, Any] = {
            "method": method,
            "refiner": refiner,
            "weights": weights,
            "set": settings,
            "threads": threads,
        }
        conflicts |= {"max_disparity": max_disparity, "scale": None if scale == 1.0 else scale}
        for option in (option for option, value in conflicts.items() if value):
            raise OptionError(f"{option} must not be set with predictions, got {conflicts[option]!r}")
        _check_maps(predictions, submission)
        estimate, time = from_files(predictions), _times(predictions, seconds)
    else:
        if seconds is not None:
            raise OptionError(f"seconds must go with predictions, got {seconds:g} alone")
        check_weights([refiner] if refiner else (), weights)
        options: dict[str, Any] = {"scale": scale, "refiner": refiner, "threads": threads, "device": device}
        options |= {"fill": None} if sparse else {}
        options |= {**parse_settings(settings or ()), **weights_option(refiner, weights)}
        estimate, time = _matching(method or "S2", max_disparity, options, gray=not color), _no_time
    with progress(len(submission.frames)) as (_, step):
        files = write_archive(output, submission, estimate, method=name, sparse=sparse, seconds=time, step=step)
    report = {
        "benchmark": benchmark, "output": str(output), "bytes": output.stat().st_size, "maps": len(submission.frames),
        "files": files, "version": __version__,
    }  # fmt: skip
    if not write_json(json_file, report):
        typer.echo(f"{output} ({output.stat().st_size / 1e6:.1f} MB): {len(submission.frames)} maps of {benchmark}")


def _matching(method: str, max_disparity: int | None, options: dict[str, Any], *, gray: bool) -> Estimator:
    """Return an estimator that has a matcher for every number of disparities that the pairs ask for."""

    @cache
    def estimator(levels: int) -> Estimator:
        return with_matcher(Matcher(method, max_disparity=levels, **options), gray=gray)

    def estimate(frame: Frame) -> Estimate:
        with collecting():
            return estimator(max_disparity or frame.max_disparity or _DEFAULT_DISPARITIES)(frame)

    return estimate


def _check_maps(folder: Path, submission: Submission) -> None:
    """Refuse a folder that lacks maps, before the first is read."""
    if not folder.is_dir():
        raise FileError(f"predictions must be a folder, got {str(folder)!r}, which is not")
    missing = [frame.name for frame in submission.frames if _map_path(folder, frame) is None]
    if missing:
        more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        count = len(submission.frames)
        raise FileError(
            f"predictions must have {count} maps, got {count - len(missing)}; missing "
            f"{', '.join(missing[:_SHOWN])}{more} in {str(folder)!r}"
        )


def _map_path(folder: Path, frame: Frame) -> Path | None:
    names = (frame.name, frame.name.rpartition("/")[2])
    paths = (folder / f"{name}{ending}" for name in names for ending in (*DISPARITY_SUFFIXES, ".tif"))
    return next((path for path in paths if path.is_file()), None)


def _times(folder: Path, seconds: float | None) -> Callable[[Frame], float | None]:
    """Return a function that reads the time of a map: ``NAME.txt`` with a number, or with ``runtime`` before it."""

    def time(frame: Frame) -> float | None:
        path = _map_path(folder, frame)
        note = None if path is None else path.with_suffix(".txt")
        if note is None or not note.is_file():
            return seconds
        text = read_text(note, "time").strip().removeprefix("runtime").strip()
        try:
            return float(text)
        except ValueError as error:
            raise FileError(f"{str(note)!r} must hold a number of seconds, got {text[:30]!r}") from error

    return time


def _no_time(frame: Frame) -> float | None:
    return None
