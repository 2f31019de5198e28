"""The command ``stereokit view``: one pair in the viewer of the reports, as one HTML file."""

from __future__ import annotations

import time
import webbrowser
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from stereokit import Matcher, __version__
from stereokit.calibration import read_calibration
from stereokit.cli.options import (
    DeviceOption,
    JsonOption,
    LayoutOption,
    MaxDisparityOption,
    MinDisparityOption,
    ScaleOption,
    WeightsOption,
    check_json,
    parse_settings,
    write_json,
)
from stereokit.cli.pair import (
    AlignOption,
    MaskOption,
    NodataOption,
    RightMaskOption,
    StrictOption,
    aligned,
    joined_masks,
    read_images,
    strictly,
)
from stereokit.cli.rig import AlphaOption, RigOption, check_rig_options, read_rig_option
from stereokit.errors import InputError, OptionError
from stereokit.io import check_output, read_disparity, write_bytes
from stereokit.matching import compile_kernels
from stereokit_evaluation.common.weights import check_weights, weights_option
from stereokit_evaluation.report import viewer
from stereokit_evaluation.report.page import render, require
from stereokit_evaluation.scoring.kitti import score
from stereokit_evaluation.study.configurations import title

__all__ = ["view"]


def view(
    left: Annotated[Path, typer.Argument(metavar="LEFT", help="Left image of a rectified pair.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The .html file to write.")],
    right: Annotated[
        Path | None, typer.Argument(metavar="[RIGHT]", help="Right image, of the same size; none if LEFT holds both.")
    ] = None,
    layout: LayoutOption = None,
    method: Annotated[list[str] | None, typer.Option("--method", "-m", help="S1 to S4; may repeat.")] = None,
    max_disparity: MaxDisparityOption = 128,
    min_disparity: MinDisparityOption = 0,
    scale: ScaleOption = 1.0,
    refiner: Annotated[list[str] | None, typer.Option(help="For --scale 0.5; may repeat.")] = None,
    weights: WeightsOption = None,
    threads: Annotated[int | None, typer.Option(help="Threads; all processors by default.")] = None,
    device: DeviceOption = "auto",
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Option of a stage; may repeat.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Calibration of a rectified pair, for metres.")
    ] = None,
    cameras: Annotated[tuple[int, int], typer.Option(help="Camera pair of a KITTI calibration.")] = (2, 3),
    rig: RigOption = None,
    alpha: AlphaOption = None,
    mask: MaskOption = None,
    right_mask: RightMaskOption = None,
    nodata: NodataOption = None,
    align: AlignOption = False,
    strict: StrictOption = False,
    truth: Annotated[Path | None, typer.Option(metavar="FILE", help="True disparity, for errors.")] = None,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Match LEFT and RIGHT and write a page with image, disparity, error and point cloud.

    Without a calibration there is no depth, and the point cloud is in pixels. With --rig the images are raw ones, and
    are rectified first.
    """
    check_output(output, (".html", ".htm"), "output")
    check_json(json_file)
    require("jinja2")
    if refiner and scale == 1:
        raise OptionError(f"refiner needs --scale 0.5, got {', '.join(refiner)} with scale 1")
    check_rig_options(rig, alpha, calibration)
    options: dict[str, Any] = {"max_disparity": max_disparity, "min_disparity": min_disparity, "scale": scale}
    options |= {"threads": threads, "device": device, **parse_settings(settings or ())}
    if nodata is not None:
        options["nodata"] = nodata
    names = list(dict.fromkeys(method or ["S2"]))
    check_weights(refiner or (), weights)
    refiners: list[str | None] = [*refiner] if refiner else [None]
    matchers = {
        f"{name} {title(refiner_name or 'linear') if scale != 1 else ''}".strip(): Matcher(
            name, refiner=refiner_name, **options, **weights_option(refiner_name, weights)
        )
        for name in names
        for refiner_name in refiners
    }
    images = read_images(left, right, layout)
    size = images[0].shape[1], images[0].shape[0]
    camera = None if calibration is None else read_calibration(calibration, cameras, size)
    masks: dict[str, Any] = {}
    if rig is not None:
        rectification = read_rig_option(rig, size).rectification(alpha=alpha)
        images, masks, camera = rectification(*images), rectification.masks, rectification.calibration
    true_disparity = None if truth is None else read_disparity(truth)
    if true_disparity is not None and true_disparity.shape != images[0].shape[:2]:
        raise InputError(f"truth must have the size of the images, {images[0].shape[:2]}, got {true_disparity.shape}")
    masks = joined_masks(masks, mask, right_mask, images[0].shape[:2])
    if align:
        images = images[0], aligned(*images, nodata)
    maps, seconds = [], {}
    for name, matcher in matchers.items():
        compile_kernels(matcher, images[0].shape[2:], images[0].dtype)  # the time below is that of matching
        with strictly(strict):
            start = time.perf_counter()
            result = matcher(*images, **masks)
            seconds[name] = time.perf_counter() - start
        note = f"{1000 * seconds[name]:.0f} ms"
        if true_disparity is not None:
            d1 = score(result.disparity, occ=true_disparity, measured=result.valid).occ.all.filled.d1()
            note += "" if d1 is None else f", D1 {d1:.2f} %"
        maps.append(viewer.MethodMap(name, result.disparity, result.valid, note))
    picture = images[0] if images[0].ndim == 2 else images[0][:, :, :3]
    pair = viewer.pair(left.name, picture, maps, occ=true_disparity, calibration=camera)
    page = render(
        "view.html.j2", [pair], title=_title(left, right), version=__version__,
        maps=maps, methods=[maps[0].name, maps[-1].name],
    )  # fmt: skip
    write_bytes(output, page)
    report = {
        "left": str(left), "right": None if right is None else str(right), "output": str(output), "bytes": len(page),
        "methods": list(matchers), "seconds": seconds, "calibration": None if calibration is None else str(calibration),
        "density": {shown.name: float(np.mean(shown.valid)) for shown in maps}, "version": __version__,
    }  # fmt: skip
    if not write_json(json_file, report):
        hint = "" if camera is not None else "; no calibration: no depth, and the point cloud is in pixels"
        typer.echo(f"{output} ({len(page) / 1e6:.1f} MB){hint}")
    if open_browser:
        webbrowser.open(output.resolve().as_uri())


def _title(left: Path, right: Path | None) -> str:
    """Return the files' names, with their folders where the names alone are the same."""
    if right is None:
        return left.name
    parts = 1 if left.name != right.name else 2
    return " and ".join("/".join(path.resolve().parts[-parts:]) for path in (left, right))
