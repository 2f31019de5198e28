"""The command ``stereokit live``: matching of cameras, videos or folders as they come, on a local page."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from stereokit.calibration import read_calibration
from stereokit.cli.options import (
    DeviceOption,
    MaxDisparityOption,
    MethodOption,
    MinDisparityOption,
    RefinerOption,
    ScaleOption,
    SettingsOption,
    parse_settings,
)
from stereokit.cli.rig import AlphaOption, RigOption, check_rig_options, read_rig_option, rig_files
from stereokit.errors import OptionError, StereokitError
from stereokit.rig import Rectification
from stereokit_evaluation.live.engine import Engine
from stereokit_evaluation.live.source import open_source

__all__ = ["live"]


def live(
    sources: Annotated[
        list[str], typer.Argument(metavar="SOURCE [SOURCE]", help="Camera numbers, videos or folders; one or two.")
    ],
    method: MethodOption = "census+sgm",
    max_disparity: MaxDisparityOption = 128,
    min_disparity: MinDisparityOption = 0,
    scale: ScaleOption = 1.0,
    refiner: RefinerOption = None,
    threads: Annotated[int | None, typer.Option(help="Threads; all processors by default.")] = None,
    device: DeviceOption = "auto",
    settings: SettingsOption = None,
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Calibration of the rectified pair, for metres.")
    ] = None,
    cameras: Annotated[tuple[int, int], typer.Option(help="Camera pair of a KITTI calibration.")] = (2, 3),
    rig: RigOption = None,
    alpha: AlphaOption = None,
    fps: Annotated[float | None, typer.Option(help="Speed of a folder or a video, frames per second.")] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    until_end: Annotated[bool, typer.Option("--until-end", help="End with the source, not with Ctrl-C.")] = False,
    port: Annotated[int, typer.Option(help="Of the page; 0 takes a free one.")] = 8600,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
) -> None:
    """Match cameras, videos or folders as they come, and show image, disparity and depth on a local page.

    One SOURCE holds both views side by side (or is a folder of pairs); two are left and right. With --rig they are raw
    ones, and are rectified first. The page is for this machine only.
    """
    try:
        from stereokit_evaluation.live.server import serve
    except ModuleNotFoundError as error:
        raise StereokitError('live needs aiohttp: pip install "stereokit[live]"') from error
    if not 0 <= port <= 65535:
        raise OptionError(f"--port must be from 0 to 65535, got {port}")
    check_rig_options(rig, alpha, calibration)
    if rig is not None:
        rig_files(rig)  # refuses what is not there

    def rectify(size: tuple[int, int]) -> Rectification:
        assert rig is not None
        return read_rig_option(rig, size).rectification(alpha=alpha)

    camera = None if calibration is None else read_calibration(calibration, cameras)
    options = parse_settings(settings or ())
    source = open_source(sources, fps, loop)
    engine = Engine(
        source, camera, threads=threads, device=device, method=method, max_disparity=max_disparity,
        min_disparity=min_disparity, scale=scale, refiner=refiner, rectify=None if rig is None else rectify, **options,
    )  # fmt: skip

    def ready(address: str) -> None:
        typer.echo(f"{address} (Ctrl-C ends)")
        if open_browser:
            webbrowser.open(address)

    try:
        serve(engine, port, ready, until_end)
    except KeyboardInterrupt:  # the usual end
        pass
    finally:
        engine.close()
    typer.echo(f"{engine.matched} frames matched, {source.dropped} dropped")
    if engine.message and engine.view is None:
        raise OptionError(engine.message)
