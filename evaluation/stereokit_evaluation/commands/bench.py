"""The command ``stereokit bench``: our methods and other libraries timed side by side, losses included.

A time is that of one whole call, from two grey ``uint8`` images to the map that the caller gets, with default
options. Everyone is called once to warm up; then all take turns, round by round, in one process, on the same images
and with the same number of threads (OpenCV's own is set to it as well, also for the filters that our methods borrow
from it). Memory and the first call are measured in processes of their own (`stereokit_evaluation.bench.probes`).

OpenCV's SGBM and HH modes hardly use a second thread; they are reported for every number of threads all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from stereokit.cli.options import JsonOption, WeightsOption, check_json, write_json
from stereokit.cuda.driver import describe
from stereokit.defaults import METHODS
from stereokit.errors import InputError, OptionError
from stereokit.images.intensity import display_8bit
from stereokit.io import read_image
from stereokit.large.memory import free_nbytes
from stereokit.methods import parse_method
from stereokit_evaluation.bench import gpu as gpu_times
from stereokit_evaluation.bench.peers import PEERS, Call, label, make, opencv_threads, peers
from stereokit_evaluation.bench.probes import ProbeError, first_call, memory_added, stored
from stereokit_evaluation.bench.stages import allocated_bytes, stage_times
from stereokit_evaluation.bench.table import Findings, as_json, load, machine, print_tables, versions
from stereokit_evaluation.bench.timing import round_robin
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.common.sizes import Size, parse_sizes, parse_threads
from stereokit_evaluation.data.published import PAPER
from stereokit_evaluation.gpu_model import table as gpu_report
from stereokit_evaluation.study.configurations import settings_at_hand
from stereokit_evaluation.study.table2 import PipelineRow, print_pipeline, time_pipeline
from stereokit_evaluation.study.table2 import as_json as pipeline_json
from stereokit_evaluation.synthetic.scenes import generate
from stereokit_refiners.learned import learned_names

__all__ = ["bench"]

_FIRST_CALLS = 3
_MEMORY_SIZES = ("K", "M")

Gray = NDArray[np.uint8]
Step = Callable[[str], None]


def bench(
    with_peers: Annotated[
        bool, typer.Option("--peers/--no-peers", help="Time other libraries that are installed too.")
    ] = True,
    sizes: Annotated[
        str | None,
        typer.Option(help="K, M, H or WxHxD such as 640x480x64, with commas; K,M,H by default, K for a GPU."),
    ] = None,
    threads: Annotated[str, typer.Option(help="Numbers of threads, with commas.")] = "1,2",
    method: Annotated[
        list[str] | None, typer.Option(help="cost+aggregation or S1-S4; may repeat; all four by default.")
    ] = None,
    rounds: Annotated[int, typer.Option(help="Times that everyone is called.")] = 9,
    pipeline: Annotated[
        bool, typer.Option("--pipeline", help="The paper's table II instead: S4 with each refiner, end to end.")
    ] = False,
    runtimes: Annotated[
        str | None, typer.Option(help="With --pipeline: this refiner in every runtime and precision too.")
    ] = None,
    weights: WeightsOption = None,
    device: Annotated[str, typer.Option(help="cpu, or cuda: our methods on the GPU, OpenCV beside them.")] = "cpu",
    model: Annotated[
        bool, typer.Option("--model", help="No times but modelled ones: our methods on four GPUs; needs none.")
    ] = False,
    scale: Annotated[float, typer.Option(help="With cuda or --model: match at this size, 1 or 0.5.")] = 1.0,
    stages: Annotated[bool, typer.Option("--stages", help="Time the stages of our methods too.")] = False,
    left: Annotated[Path | None, typer.Option(help="Left image, instead of a synthetic one.")] = None,
    right: Annotated[Path | None, typer.Option(help="Right image.")] = None,
    memory: Annotated[
        bool | None,
        typer.Option("--memory/--no-memory", help="Memory that a call adds; by default for K and M."),
    ] = None,
    first: Annotated[
        bool, typer.Option("--first-call/--no-first-call", help="Time of the first call in a new process.")
    ] = True,
    json_file: JsonOption = None,
) -> None:
    """Time our methods against other libraries: median, quartiles, memory.

    Sizes are K = 1242x375 with 128 levels, M = 1342x1110 with 256 and H = 621x188 with 64. The columns "x HH" and
    "x 3WAY" say how many times faster than these modes of OpenCV a method is; below 1 it is slower. MDE/s are
    millions of pixels times levels per second. --model prints what four GPUs are modelled to take, beside published
    times: nothing in these tables was measured here.
    """
    on_gpu = model or device == "cuda"
    chosen, counts = parse_sizes(sizes or ("K" if on_gpu else "K,M,H")), parse_threads(threads)
    if rounds < 1:
        raise OptionError(f"rounds must be at least 1, got {rounds}")
    check_json(json_file)
    _check_tables(model, device, pipeline, stages, scale, runtimes, weights)
    if (left is None) != (right is None):
        raise OptionError("left and right go together, got only one of them")
    pictures = None if left is None or right is None else (_read(left), _read(right))
    if pictures is not None and pictures[0].shape != pictures[1].shape:
        raise InputError(f"left and right must have the same size, got {pictures[0].shape} and {pictures[1].shape}")
    if pipeline:
        return _pipeline(chosen, counts, method or ["S4"], rounds, pictures, with_peers, runtimes, weights, json_file)
    methods = list(dict.fromkeys(parse_method(name) for name in method or METHODS))
    if model:
        if pictures is not None:
            raise OptionError(f"left must not come with model, which looks at no image, got {str(left)!r}")
        return gpu_report.model(chosen, methods, scale, json_file)
    build = None
    if device == "cuda":
        ours, counts = gpu_times.contenders(methods, scale), [max(counts)]  # only the peers have threads
        methods, build, memory, first = list(ours), gpu_times.maker(ours), False, False
    contenders = [*methods, *(peers() if with_peers else ())]

    weighed = [size for size in chosen if (size.name in _MEMORY_SIZES if memory is None else memory)]
    steps = len(chosen) * len(counts) * len(contenders) * (1 + rounds) + len(weighed) * len(contenders)
    steps += len(methods) * (stages * len(chosen) + first)
    findings = Findings(methods=methods, sizes=chosen, threads=counts, rounds=rounds)
    with progress(steps) as (console, step):
        try:
            for size in chosen:
                step(f"{size.name}: images", 0)
                images = _images(size, pictures)
                for count in counts:
                    _time(size, count, contenders, images, findings, step, build)
                if size in weighed:
                    _weigh(size, max(counts), contenders, images, findings, step)
                for name in methods if stages else ():
                    with opencv_threads(1):
                        findings.stages[size.name, name] = stage_times(name, size.levels, *images, rounds)
                        findings.allocated[size.name, name] = allocated_bytes(name, size.levels, *images, 1)
                    step(f"{size.name}: stages of {name}")
            if first:
                size = next((size for size in chosen if size.name == "K"), chosen[0])
                _time_first(size, max(counts), methods, _images(size, pictures), findings, step)
        except KeyboardInterrupt:
            findings.interrupted = True
            console.print("interrupted: the figures are those measured so far", highlight=False)
    options = {
        "sizes": [size.name for size in chosen], "threads": counts, "methods": methods, "rounds": rounds,
        "peers": with_peers, "memory": [size.name for size in weighed], "stages": stages,
        "device": describe() if device == "cuda" else "cpu", "scale": scale,
        "images": "synthetic" if left is None else [str(left), str(right)],
    }  # fmt: skip
    if not write_json(json_file, as_json(findings, options)):
        print_tables(findings)
        if device == "cuda":
            typer.echo(f"GPU: {describe()}")
    if findings.interrupted:
        raise typer.Exit(130)


def _check_tables(
    model: bool, device: str, pipeline: bool, stages: bool, scale: float, runtimes: str | None, weights: str | None
) -> None:
    """Refuse options that do not go together."""
    if device not in ("cpu", "cuda"):
        raise OptionError(f"device must be 'cpu' or 'cuda', got {device!r}")
    asked = {"model": model, "device cuda": device == "cuda", "pipeline": pipeline, "stages": stages}
    tables = [name for name, wanted in asked.items() if wanted]
    if len(tables) > 1:
        raise OptionError(f"{tables[0]} and {tables[1]} are two tables, got both; choose one")
    if scale not in (1, 0.5):
        raise OptionError(f"scale must be 1 or 0.5, got {scale:g}")
    if scale != 1 and not (model or device == "cuda"):
        raise OptionError(f"scale must come with model or device cuda, got {scale:g} alone; see also pipeline")
    if weights is not None and not pipeline:
        raise OptionError(f"weights must come with pipeline, got {weights!r} alone")
    if runtimes is not None and not pipeline:
        raise OptionError(f"runtimes must come with pipeline, got {runtimes!r} alone")
    if runtimes is not None and runtimes not in learned_names():
        raise OptionError(f"runtimes must be one of {', '.join(learned_names())}, got {runtimes!r}")


def _pipeline(
    sizes: Sequence[Size],
    counts: Sequence[int],
    methods: Sequence[str],
    rounds: int,
    pictures: tuple[Gray, Gray] | None,
    with_peers: bool,
    runtimes: str | None,
    weights: str | None,
    json_file: Path | None,
) -> None:
    """Time table II of the paper, print it and write it."""
    rows: list[PipelineRow] = []
    interrupted = False
    each = len(methods) * (len(settings_at_hand()) + 5 * (runtimes is not None)) + 2 * with_peers
    about = machine(load())
    with progress(len(sizes) * len(counts) * each * (1 + rounds)) as (console, step):
        try:
            for size in sizes:
                images = _images(size, pictures)
                for count in counts:
                    time_pipeline(
                        size,
                        count,
                        methods,
                        images,
                        rounds,
                        rows,
                        with_peers=with_peers,
                        runtimes=runtimes,
                        weights=weights,
                        step=step,
                    )
        except KeyboardInterrupt:
            interrupted = True
            console.print("interrupted: the figures are those measured so far", highlight=False)
    document = {
        "pipeline": pipeline_json(rows), "interrupted": interrupted, "source_of_published": PAPER,
        "machine": about, "versions": versions(),
    }  # fmt: skip
    if not write_json(json_file, document):
        print_pipeline(sizes, rows)
    if interrupted:
        raise typer.Exit(130)


def _read(path: Path) -> Gray:
    image = read_image(path, gray=True)
    if image.dtype.kind == "f":
        raise InputError(f"images to time must be 8 or 16 bit, got {image.dtype} in {str(path)!r}")
    return display_8bit(image)


def _images(size: Size, pictures: tuple[Gray, Gray] | None) -> tuple[Gray, Gray]:
    """Return the pair of this size, grey: a synthetic street, or the given pictures resized."""
    if pictures is None:
        scene = generate(0, size.width, size.height, size.levels)
        made = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right)]
    else:
        wanted = (size.width, size.height)
        made = [cv2.resize(image, wanted, interpolation=cv2.INTER_AREA) for image in pictures]
    left, right = (np.ascontiguousarray(image, np.uint8).reshape(size.height, size.width) for image in made)
    return left, right


def _time(
    size: Size, threads: int, contenders: Sequence[str], images: tuple[Gray, Gray], findings: Findings, step: Step,
    build: Callable[[str, int, int], Call] | None = None,
) -> None:  # fmt: skip
    """Warm everyone up, then time them in turns; the seconds go to ``findings.times``."""
    build = build or make
    calls: dict[str, Call] = {}
    with opencv_threads(threads):
        for key in contenders:
            step(f"{size.name}, {threads} threads: {label(key)}, first call")
            reason = _too_large(key, size)
            if reason is None:
                call = build(key, size.levels, threads)
                try:
                    call(*images)
                    calls[key] = call
                except Exception as error:
                    if key not in PEERS and not isinstance(error, MemoryError):
                        raise
                    reason = " ".join(str(error).split()) or type(error).__name__
            if reason is not None:
                findings.skip(size, label(key), threads, reason)
        round_robin(
            {key: lambda call=call: call(*images) for key, call in calls.items()},  # type: ignore[misc]
            findings.rounds,
            findings.times.setdefault((size.name, threads), {}),
            most={key: most for key in calls if key in PEERS and (most := PEERS[key].most_rounds) is not None},
            step=lambda key: step(f"{size.name}, {threads} threads: {label(key)}"),
        )


def _weigh(
    size: Size, threads: int, contenders: Sequence[str], images: tuple[Gray, Gray], findings: Findings, step: Step
) -> None:
    with stored(*images) as files:
        for key in contenders:
            if _too_large(key, size) is None:
                try:
                    findings.memory[size.name, key] = memory_added(key, size.levels, threads, files)
                except ProbeError as error:
                    findings.skip(size, label(key), threads, str(error))
            step(f"{size.name}: memory of {label(key)}")


def _time_first(
    size: Size, threads: int, methods: Sequence[str], images: tuple[Gray, Gray], findings: Findings, step: Step
) -> None:
    """Time first calls in new processes; one process more, before them, sees to it that the disk cache is warm."""
    findings.first_size = size.name
    with stored(*images) as files:
        for key in methods:
            try:
                first_call(key, size.levels, threads, files)
                runs = [first_call(key, size.levels, threads, files) for _ in range(min(_FIRST_CALLS, findings.rounds))]
            except ProbeError as error:
                findings.skip(size, label(key), threads, str(error))
            else:
                findings.first[key] = {name: median(run[name] for run in runs) for name in runs[0]}
            step(f"{size.name}: first call of {label(key)}")


def _too_large(key: str, size: Size) -> str | None:
    """Return why this peer is left out: the machine's free memory does not hold what it is known to need."""
    needed = PEERS[key].bytes_per_cell * size.cells if key in PEERS else 0
    free = free_nbytes()
    if needed <= 0.8 * free:
        return None
    return f"needs {needed / 1e9:.1f} GB of memory, {free / 1e9:.1f} GB are free"
