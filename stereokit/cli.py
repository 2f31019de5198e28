"""The command line: ``stereokit match``, ``list``, ``info`` and the commands of other packages.

Other packages add commands through the entry-point group ``stereokit.commands``: each entry is a plain
function with typer annotations. It is imported only when its command (or the list of all commands) is asked
for, and one that cannot be imported says so without harming the rest. Everything heavy is imported inside the
functions.

Bad input ends with one line, ``error: ...``, on standard error and exit status 2; an interrupt with 130.
"""

from __future__ import annotations

import inspect
import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from typer.core import TyperGroup

from stereokit import commandline
from stereokit.commandline import (
    DeviceOption,
    FillOption,
    JsonOption,
    MaxDisparityOption,
    MethodOption,
    MinDisparityOption,
    RefinerOption,
    ScaleOption,
    SettingsOption,
)
from stereokit.errors import InputError, OptionError, StereokitError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stereokit.calibration import Calibration
    from stereokit.result import Disparity

__all__ = ["app", "main"]

_GROUP = "stereokit.commands"
_STAGES = {
    "census": "Census cost",
    "zncc": "ZNCC cost",
    "sgm": "semi-global matching",
    "dt": "domain transform",
}


class _Commands(TyperGroup):
    """The built-in commands and those found through entry points."""

    def list_commands(self, ctx: Any) -> list[str]:
        own = super().list_commands(ctx)
        return [*own, *sorted({entry.name for entry in metadata.entry_points(group=_GROUP)} - set(own))]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        if command is None:
            for entry in metadata.entry_points(group=_GROUP, name=cmd_name):
                return _plugin(entry)
        return command

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except StereokitError as error:
            _fail(str(error), error)
        except ModuleNotFoundError as error:
            if (error.name or "stereokit").startswith("stereokit"):
                raise
            _fail(f"this needs the package {error.name!r}, which is not installed", error)
        except MemoryError as error:
            _fail(f"not enough memory: {error}" if str(error) else "not enough memory", error)
        except KeyboardInterrupt as error:  # typer 0.12 would end with 1
            raise typer.Exit(130) from error


app = typer.Typer(
    name="stereokit",
    cls=_Commands,
    help="Classical stereo matching: disparity maps from rectified pairs.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line; the console entry point."""
    try:
        app(prog_name="stereokit")
    except KeyboardInterrupt:
        sys.exit(130)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"stereokit {_version('stereokit')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def match(
    left: Annotated[Path, typer.Argument(metavar="LEFT", help="Left image of a rectified pair.")],
    right_image: Annotated[Path, typer.Argument(metavar="RIGHT", help="Right image, of the same size.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help=".png (KITTI, x256), .pfm, .npy or .tiff."),
    ],
    method: MethodOption = "zncc+sgm",
    max_disparity: MaxDisparityOption = 128,
    min_disparity: MinDisparityOption = 0,
    scale: ScaleOption = 1.0,
    refiner: RefinerOption = None,
    fill: FillOption = None,
    threads: Annotated[int | None, typer.Option(help="Threads; all processors by default.")] = None,
    device: DeviceOption = "auto",
    settings: SettingsOption = None,
    color: Annotated[Path | None, typer.Option(metavar="FILE", help="Also a Turbo coloured picture.")] = None,
    right: Annotated[Path | None, typer.Option(metavar="FILE", help="Also the right view's map.")] = None,
    confidence: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also the confidence: .npy, or .png (16-bit, x65535).")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Middlebury, KITTI or JSON calibration, for --ply.")
    ] = None,
    cameras: Annotated[tuple[int, int], typer.Option(help="Camera pair of a KITTI calibration.")] = (2, 3),
    ply: Annotated[Path | None, typer.Option(metavar="FILE", help="Also a point cloud, metres.")] = None,
    memory: Annotated[str | None, typer.Option(metavar="BYTES", help="Match in windows that fit, such as 2GB.")] = None,
    overlap: Annotated[int | None, typer.Option(help="Margin of the windows of --memory, pixels.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Match LEFT and RIGHT and write the disparity map.

    Everything is checked before matching starts. The first run on a machine also compiles, once. With --memory the
    images (.npy, .tiff or any other) are matched in windows, and the map goes to .npy or tiled .tiff as it grows.
    """
    import numpy as np

    from stereokit import io

    suffixes = {
        "--output": (*io.DISPARITY_SUFFIXES, ".tif"),
        "--color": (".png", ".jpg", ".jpeg", ".tiff", ".tif", ".bmp", ".ppm"),
        "--right": (*io.DISPARITY_SUFFIXES, ".tif"),
        "--confidence": (".npy", ".png"),
        "--ply": (".ply",),
    }
    paths = (output, color, right, confidence, ply)
    outputs = {name: path for name, path in zip(suffixes, paths, strict=True) if path is not None}
    for name, path in outputs.items():
        io.check_output(path, suffixes[name], name)
        if name in ("--output", "--right") and path.suffix.lower() == ".png":
            commandline.check_fits_png(name, min_disparity, max_disparity)
    outputs.update(commandline.check_json(json_file))
    _check_distinct({"LEFT": left, "RIGHT": right_image, "--calibration": calibration}, outputs)
    if (ply is None) != (calibration is None):
        raise OptionError("--ply and --calibration go together, got only one of them")
    options = commandline.parse_settings(settings or [])
    wanted = {"fill": fill, "right": right and True, "confidence": confidence and True}
    options.update({name: value for name, value in wanted.items() if value is not None})
    matching: dict[str, Any] = {
        "max_disparity": max_disparity,
        "min_disparity": min_disparity,
        "scale": scale,
        "refiner": refiner,
        "threads": threads,
        "device": device,
    }
    if memory is not None or overlap is not None:
        for name in ("--color", "--right", "--confidence", "--ply"):
            if name in outputs:
                raise OptionError(f"{name} is not available with --memory and --overlap")
        from stereokit.large.command import match_in_windows

        done, shown = match_in_windows(left, right_image, output, method, memory, overlap, {**matching, **options})
        _report({**done, "options": options, "version": _version("stereokit")}, [shown], json_file)
        return

    from stereokit.matching import Matcher

    matcher = Matcher(method, **matching, **options)
    images = io.read_image(left), io.read_image(right_image)
    height, width = images[0].shape[:2]
    if images[1].shape[:2] != (height, width):
        sizes = " and ".join(f"{image.shape[1]}x{image.shape[0]}" for image in images)
        raise InputError(f"LEFT and RIGHT must have the same size, got {sizes}")
    camera = _read_camera(calibration, cameras, width, height)

    with _waiting("Matching (the first run also compiles) ..."):
        small = [np.zeros((32, 32, *image.shape[2:]), image.dtype) for image in images]
        matcher(*small)  # compiles, so that the time below is that of matching
        start = time.perf_counter()
        result = matcher(*images)
        seconds = time.perf_counter() - start

    result.save(output)
    if color is not None:
        io.write_image(color, result.color())
    if right is not None:
        io.write_disparity(right, _present(result.right, "--right", matcher.method))
    if confidence is not None:
        _write_confidence(confidence, _present(result.confidence, "--confidence", matcher.method))
    if ply is not None and camera is not None:
        _write_cloud(ply, result, camera, images[0])
    report = {
        "left": str(left),
        "right": str(right_image),
        "outputs": {name.removeprefix("--"): str(path) for name, path in outputs.items() if name != "--json"},
        "width": width,
        "height": height,
        **commandline.described(matcher),
        "options": options,
        "density": result.density,
        "seconds": seconds,
        "version": _version("stereokit"),
    }
    table = Table("Method", "Size", "Disparities", "Density", "Seconds", "Output")
    table.add_row(
        matcher.method,
        f"{width}x{height}",
        f"{matcher.min_disparity} .. {matcher.max_disparity - 1}",
        f"{100 * result.density:.1f} %",
        f"{seconds:.3f}",
        str(output),
    )
    _report(report, [table], json_file)


@app.command("list")
def list_(json_file: JsonOption = None) -> None:
    """List the methods and the stages they are made of."""
    commandline.check_json(json_file)
    from stereokit.matching import METHODS
    from stereokit.registry import AGGREGATIONS, COSTS, REFINERS

    methods = {
        name: {"method": stages, "description": " + ".join(_STAGES.get(s, s) for s in stages.split("+"))}
        for name, stages in METHODS.items()
    }
    stages = {"costs": COSTS.names(), "aggregations": AGGREGATIONS.names(), "refiners": REFINERS.names()}
    table = Table("Method", "Stages", "What it is")
    for name, entry in methods.items():
        table.add_row(name, entry["method"], entry["description"])
    parts = Table("Stage", "Names")
    for kind, names in stages.items():
        parts.add_row(kind, ", ".join(names) or "none")
    _report({"methods": methods, **stages}, [table, parts], json_file)


@app.command()
def info(json_file: JsonOption = None) -> None:
    """Show versions, processor, threads and devices, for bug reports."""
    commandline.check_json(json_file)
    import cv2
    import llvmlite.binding
    import numba

    from stereokit.kernels import device, pool, simd

    vector_bits = getattr(simd, "vector_bits", None)
    content: dict[str, Any] = {
        "stereokit": _version("stereokit"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "numpy": _version("numpy"),
        "numba": _version("numba"),
        "llvmlite": _version("llvmlite"),
        "opencv": cv2.__version__,
        "torch": _version("torch"),
        "processor": str(llvmlite.binding.get_host_cpu_name()),
        "vector_bits": None if vector_bits is None else vector_bits(),
        "threads": pool.available_threads(),
        "numba_cache": numba.config.CACHE_DIR or "beside the modules, in __pycache__",
        "cuda": device.has_device(),
        "gpu": device.describe(),
        "numba_cuda": _version("numba-cuda"),
    }
    table = Table("What", "Value")
    for name, value in content.items():
        shown = {None: "not known" if name == "vector_bits" else "not installed", True: "yes", False: "no"}
        table.add_row(name, shown[value] if value is None or isinstance(value, bool) else str(value))
    _report(content, [table], json_file)


def _plugin(entry: metadata.EntryPoint) -> Any:
    single = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    try:
        function: Callable[..., Any] = entry.load()
        summary = (inspect.getdoc(function) or "").split("\n\nParameters\n")[0]  # the rest is for programmers
        single.command(entry.name, help=summary)(function)
        command = typer.main.get_command(single)
    except Exception as error:
        reason = f"command {entry.name!r} cannot be loaded: {type(error).__name__}: {error}"

        def unavailable(ctx: typer.Context) -> None:
            raise StereokitError(reason)

        single = typer.Typer(add_completion=False, rich_markup_mode=None)
        anything = {"allow_extra_args": True, "ignore_unknown_options": True}
        single.command(entry.name, help=f"Not available: {reason}", context_settings=anything, add_help_option=False)(
            unavailable
        )
        command = typer.main.get_command(single)
    command.name = entry.name
    return command


def _fail(message: str, error: BaseException) -> None:
    typer.echo(f"error: {' '.join(message.splitlines())}", err=True)
    raise typer.Exit(2) from error


def _version(package: str) -> str | None:
    if package == "stereokit":
        from stereokit import __version__

        return __version__
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _check_distinct(inputs: dict[str, Path | None], outputs: dict[str, Path]) -> None:
    taken = {os.path.realpath(path): name for name, path in inputs.items() if path is not None}
    for name, path in outputs.items():
        other = taken.setdefault(os.path.realpath(path), name)
        if other != name:
            raise OptionError(f"{name} and {other} must be different files, got {str(path)!r} for both")


def _read_camera(path: Path | None, cameras: tuple[int, int], width: int, height: int) -> Calibration | None:
    if path is None:
        return None
    from stereokit.calibration import read_calibration

    camera = read_calibration(path, cameras)
    camera.check_size(width, height)
    return camera


def _present(array: NDArray[Any] | None, option: str, method: str) -> NDArray[Any]:
    if array is None:
        raise OptionError(f"{option}: method {method!r} with these options gives none")
    return array


def _write_confidence(path: Path, confidence: NDArray[Any]) -> None:
    import numpy as np

    from stereokit import io

    if path.suffix.lower() == ".npy":
        io.write_disparity(path, confidence)
    else:
        steps = np.rint(np.clip(np.nan_to_num(confidence), 0, 1) * 65535)
        io.write_image(path, steps.astype(np.uint16))


def _write_cloud(path: Path, result: Disparity, camera: Calibration, image: NDArray[Any]) -> None:
    import numpy as np

    from stereokit import io

    points = result.points(camera)
    kept = np.isfinite(points).all(axis=2)
    white = {"uint8": 255.0, "uint16": 65535.0}.get(str(image.dtype)) or max(float(np.nanmax(image)), 1e-9)
    colors = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    scaled = np.rint(np.clip(np.nan_to_num(colors[kept] / white), 0, 1) * 255).astype(np.uint8)
    io.write_ply(path, points[kept], scaled)


def _report(content: dict[str, Any], tables: list[Table], path: Path | None) -> None:
    if commandline.write_json(path, content):
        return
    console = Console()
    for table in tables:
        console.print(table)


@contextmanager
def _waiting(text: str) -> Iterator[None]:
    """Show a spinner on standard error when the body takes over a second."""
    status = Console(stderr=True).status(text)
    timer = threading.Timer(1.0, status.start)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()
        status.stop()


if __name__ == "__main__":
    main()
