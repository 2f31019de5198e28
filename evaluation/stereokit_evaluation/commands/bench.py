"""The command ``stereokit bench``: our methods and other libraries timed side by side, losses included.

A time is that of one whole call, from two grey ``uint8`` images to the returned map, with default options. Each
contender is called once to warm up; then all take turns, round by round, in one process, on the same images and with
the same number of threads (OpenCV's own is set to it as well, also for OpenCV's filters in our methods). Memory and
the first call are measured in separate processes (`stereokit_evaluation.bench.probes`).

OpenCV's SGBM and HH modes hardly use a second thread; they are reported for every number of threads all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
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
from stereokit_evaluation.bench.baselines import BASELINES, Call, baselines, label, make, opencv_threads
from stereokit_evaluation.bench.probes import ProbeError, first_call, image_files, memory_added
from stereokit_evaluation.bench.simulation import Simulated, print_simulated, simulate
from stereokit_evaluation.bench.stages import allocated_bytes, stage_times
from stereokit_evaluation.bench.table import BenchResult, as_json, machine, print_tables, system_load, versions
from stereokit_evaluation.bench.timing import round_robin
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.common.sizes import Size, parse_sizes, parse_threads
from stereokit_evaluation.data.published import PAPER
from stereokit_evaluation.gpu_model import table as gpu_report
from stereokit_evaluation.study.table2 import PipelineRow, print_pipeline, rows_of_a_method, time_pipeline
from stereokit_evaluation.study.table2 import as_json as pipeline_json
from stereokit_evaluation.synthetic.scenes import generate
from stereokit_refiners.learned import learned_names

__all__ = ["bench"]

_FIRST_CALLS = 3
_MEMORY_SIZES = ("K", "M")

Gray = NDArray[np.uint8]
Step = Callable[[str], None]


def bench(
    with_baselines: Annotated[
        bool,
        typer.Option("--baselines/--no-baselines", "--peers/--no-peers", help="Time other installed libraries too."),
    ] = True,
    sizes: Annotated[
        str | None,
        typer.Option(help="K, M, H or WxHxD such as 640x480x64, with commas; K,M,H by default, K for a GPU."),
    ] = None,
    threads: Annotated[str, typer.Option(help="Numbers of threads, with commas.")] = "1,2",
    method: Annotated[
        list[str] | None, typer.Option(help="cost+aggregation or S1-S4; may repeat; all four by default.")
    ] = None,
    rounds: Annotated[int, typer.Option(help="Timed calls of each contender.")] = 9,
    pipeline: Annotated[
        bool, typer.Option("--pipeline", help="The paper's table II instead: S4 with each refiner, end to end.")
    ] = False,
    runtimes: Annotated[
        str | None, typer.Option(help="With --pipeline: this refiner in every runtime and precision too.")
    ] = None,
    weights: WeightsOption = None,
    device: Annotated[str, typer.Option(help="cpu, or cuda: our methods on the GPU, and OpenCV.")] = "cpu",
    model: Annotated[
        bool, typer.Option("--model", help="No times but modelled ones: our methods on four GPUs; needs none.")
    ] = False,
    scale: Annotated[float, typer.Option(help="With cuda or --model: match at this size, 1 or 0.5.")] = 1.0,
    stages: Annotated[bool, typer.Option("--stages", help="Time the stages of our methods too.")] = False,
    simulate_cores: Annotated[
        str | None,
        typer.Option("--simulate", help="Instead: times on so many cores, such as 4,8,16, simulated from tasks."),
    ] = None,
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
    "x 3WAY" are the speed of a method relative to these modes of OpenCV; below 1 it is slower. MDE/s are millions of
    pixels times levels per second. --model prints modelled times of four GPUs and published times: nothing in these
    tables was measured here.
    """
    on_gpu = model or device == "cuda"
    problem_sizes, counts = parse_sizes(sizes or ("K" if on_gpu else "K,M,H")), parse_threads(threads)
    if rounds < 1:
        raise OptionError(f"rounds must be at least 1, got {rounds}")
    check_json(json_file)
    cores = [] if simulate_cores is None else parse_threads(simulate_cores, "simulate")
    _check_tables(model, device, pipeline, stages, bool(cores), scale, runtimes, weights)
    if (left is None) != (right is None):
        raise OptionError("left and right go together, got only one of them")
    pictures = None if left is None or right is None else (_read(left), _read(right))
    if pictures is not None and pictures[0].shape != pictures[1].shape:
        raise InputError(f"left and right must have the same size, got {pictures[0].shape} and {pictures[1].shape}")
    if pipeline:
        return _pipeline(
            problem_sizes, counts, method or ["S4"], rounds, pictures, with_baselines, runtimes, weights, json_file
        )
    methods = list(dict.fromkeys(parse_method(name) for name in method or METHODS))
    if model:
        if pictures is not None:
            raise OptionError(f"left must not come with model, which looks at no image, got {str(left)!r}")
        return gpu_report.model(problem_sizes, methods, scale, json_file)
    if cores:
        return _simulate(problem_sizes, methods, cores, rounds, pictures, json_file)
    build = None
    if device == "cuda":
        builders, counts = gpu_times.contenders(methods, scale), [max(counts)]  # only the baselines have threads
        methods, build, memory, first = list(builders), gpu_times.maker(builders), False, False
    contenders = [*methods, *(baselines() if with_baselines else ())]

    memory_sizes = [size for size in problem_sizes if (size.name in _MEMORY_SIZES if memory is None else memory)]
    steps = len(problem_sizes) * len(counts) * len(contenders) * (1 + rounds) + len(memory_sizes) * len(contenders)
    steps += len(methods) * (stages * len(problem_sizes) + first)
    result = BenchResult(methods=methods, sizes=problem_sizes, threads=counts, rounds=rounds)
    with progress(steps) as (console, step):
        try:
            for size in problem_sizes:
                step(f"{size.name}: images", 0)
                images = _images(size, pictures)
                for count in counts:
                    _time(size, count, contenders, images, result, step, build)
                if size in memory_sizes:
                    _weigh(size, max(counts), contenders, images, result, step)
                for name in methods if stages else ():
                    with opencv_threads(1):
                        result.stages[size.name, name] = stage_times(name, size.levels, *images, rounds)
                        result.allocated[size.name, name] = allocated_bytes(name, size.levels, *images, 1)
                    step(f"{size.name}: stages of {name}")
            if first:
                size = next((size for size in problem_sizes if size.name == "K"), problem_sizes[0])
                _time_first(size, max(counts), methods, _images(size, pictures), result, step)
        except KeyboardInterrupt:
            result.interrupted = True
            console.print("interrupted: the figures are those measured so far", highlight=False)
    options = {
        "sizes": [size.name for size in problem_sizes], "threads": counts, "methods": methods, "rounds": rounds,
        "peers": with_baselines, "memory": [size.name for size in memory_sizes], "stages": stages,
        "device": describe() if device == "cuda" else "cpu", "scale": scale,
        "images": "synthetic" if left is None else [str(left), str(right)],
    }  # fmt: skip
    if not write_json(json_file, as_json(result, options)):
        print_tables(result)
        if device == "cuda":
            typer.echo(f"GPU: {describe()}")
    if result.interrupted:
        raise typer.Exit(130)


def _check_tables(
    model: bool, device: str, pipeline: bool, stages: bool, simulated: bool, scale: float, runtimes: str | None,
    weights: str | None,
) -> None:  # fmt: skip
    """Refuse options that do not go together."""
    if device not in ("cpu", "cuda"):
        raise OptionError(f"device must be 'cpu' or 'cuda', got {device!r}")
    requests = {"model": model, "device cuda": device == "cuda", "pipeline": pipeline, "stages": stages}
    requests["simulate"] = simulated
    tables = [name for name, is_set in requests.items() if is_set]
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
    with_baselines: bool,
    runtimes: str | None,
    weights: str | None,
    json_file: Path | None,
) -> None:
    """Time table II of the paper, print it and write it."""
    rows: list[PipelineRow] = []
    interrupted = False
    calls_per_size = len(methods) * rows_of_a_method(runtimes) + 2 * with_baselines
    machine_info = machine(system_load())
    with progress(len(sizes) * len(counts) * calls_per_size * (1 + rounds)) as (console, step):
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
                        with_baselines=with_baselines,
                        runtimes=runtimes,
                        weights=weights,
                        step=step,
                    )
        except KeyboardInterrupt:
            interrupted = True
            console.print("interrupted: the figures are those measured so far", highlight=False)
    document = {
        "pipeline": pipeline_json(rows), "interrupted": interrupted, "source_of_published": PAPER,
        "machine": machine_info, "versions": versions(),
    }  # fmt: skip
    if not write_json(json_file, document):
        print_pipeline(sizes, rows)
    if interrupted:
        raise typer.Exit(130)


def _simulate(
    sizes: Sequence[Size], methods: Sequence[str], cores: Sequence[int], rounds: int,
    pictures: tuple[Gray, Gray] | None, json_file: Path | None,
) -> None:  # fmt: skip
    """Simulate matches on more cores; print the table, or write it."""
    simulated: dict[tuple[str, str], list[Simulated]] = {}
    machine_info = machine(system_load())
    with progress(len(sizes) * len(methods)) as (_, step):
        for size in sizes:
            images = _images(size, pictures)
            for name in methods:
                with opencv_threads(1):
                    simulated[size.name, label(name)] = simulate(name, size.levels, *images, cores, rounds)
                step(f"{size.name}: {label(name)}")
    rows = [
        {"size": size, "method": name, **asdict(row), "speed_up": row.speed_up, "serial_share": row.serial_share}
        for (size, name), matches in simulated.items()
        for row in matches
    ]
    if not write_json(json_file, {"simulated": rows, "machine": machine_info, "versions": versions()}):
        print_simulated(simulated)


def _read(path: Path) -> Gray:
    image = read_image(path, gray=True)
    if image.dtype.kind == "f":
        raise InputError(f"images to time must be 8 or 16 bit, got {image.dtype} in {str(path)!r}")
    return display_8bit(image)


def _images(size: Size, pictures: tuple[Gray, Gray] | None) -> tuple[Gray, Gray]:
    """Return the pair of this size, grey: a synthetic street, or the user's pictures resized."""
    if pictures is None:
        scene = generate(0, size.width, size.height, size.levels)
        images = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right)]
    else:
        size_px = (size.width, size.height)
        images = [cv2.resize(image, size_px, interpolation=cv2.INTER_AREA) for image in pictures]
    left, right = (np.ascontiguousarray(image, np.uint8).reshape(size.height, size.width) for image in images)
    return left, right


def _time(
    size: Size, threads: int, contenders: Sequence[str], images: tuple[Gray, Gray], result: BenchResult, step: Step,
    build: Callable[[str, int, int], Call] | None = None,
) -> None:  # fmt: skip
    """Warm all contenders up, then time them in turns; the seconds go to ``result.times``."""
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
                    if key not in BASELINES and not isinstance(error, MemoryError):
                        raise
                    reason = " ".join(str(error).split()) or type(error).__name__
            if reason is not None:
                result.skip(size, label(key), threads, reason)
        round_robin(
            {key: lambda call=call: call(*images) for key, call in calls.items()},  # type: ignore[misc]
            result.rounds,
            result.times.setdefault((size.name, threads), {}),
            max_rounds={
                key: rounds for key in calls if key in BASELINES and (rounds := BASELINES[key].max_rounds) is not None
            },
            step=lambda key: step(f"{size.name}, {threads} threads: {label(key)}"),
        )


def _weigh(
    size: Size, threads: int, contenders: Sequence[str], images: tuple[Gray, Gray], result: BenchResult, step: Step
) -> None:
    with image_files(*images) as files:
        for key in contenders:
            if _too_large(key, size) is None:
                try:
                    result.memory[size.name, key] = memory_added(key, size.levels, threads, files)
                except ProbeError as error:
                    result.skip(size, label(key), threads, str(error))
            step(f"{size.name}: memory of {label(key)}")


def _time_first(
    size: Size, threads: int, methods: Sequence[str], images: tuple[Gray, Gray], result: BenchResult, step: Step
) -> None:
    """Time first calls in new processes; one further process before them warms the disk cache."""
    result.first_size = size.name
    with image_files(*images) as files:
        for key in methods:
            try:
                first_call(key, size.levels, threads, files)
                runs = [first_call(key, size.levels, threads, files) for _ in range(min(_FIRST_CALLS, result.rounds))]
            except ProbeError as error:
                result.skip(size, label(key), threads, str(error))
            else:
                result.first[key] = {name: median(run[name] for run in runs) for name in runs[0]}
            step(f"{size.name}: first call of {label(key)}")


def _too_large(key: str, size: Size) -> str | None:
    """Return the reason to leave this baseline out, if its known need of memory exceeds the free memory."""
    needed = BASELINES[key].bytes_per_cell * size.cells if key in BASELINES else 0
    free = free_nbytes()
    if needed <= 0.8 * free:
        return None
    return f"needs {needed / 1e9:.1f} GB of memory, {free / 1e9:.1f} GB are free"
