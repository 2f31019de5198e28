"""The command ``stereokit view``: one pair in the viewer of the reports, as one HTML file."""

from __future__ import annotations

import time
import webbrowser
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

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
from stereokit.io import IMAGE_SUFFIXES, check_output, read_disparity, read_image, write_bytes
from stereokit.matching import compile_kernels
from stereokit.notices import PairWarning, collecting, warn
from stereokit.pairs import check_pair
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
    truth: Annotated[
        Path | None, typer.Option(metavar="FILE", help="True disparity, of occluded pixels too where it is known.")
    ] = None,
    seen: Annotated[
        Path | None,
        typer.Option(
            "--noc", metavar="FILE", help="Truth of what both cameras see: a map, or a mask that is white there."
        ),
    ] = None,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Match LEFT and RIGHT and write a page with both images, disparity, error, differences and point cloud.

    What looks wrong with the pair is said on the page and on standard error. Without a calibration there is no depth,
    and the point cloud is in pixels. With --rig the images are raw ones, and are rectified first.
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
            name, refiner=refiner_name, **options, **weights_option(refiner_name, weights, refiner or ())
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
    noc, occ = _read_truth(truth, seen, images[0].shape[:2])
    masks = joined_masks(masks, mask, right_mask, images[0].shape[:2])
    if align:
        images = images[0], aligned(*images, nodata)
    maps: list[viewer.MethodMap] = []
    figures: list[dict[str, Any]] = []
    warnings = _lesser_faults(images, max_disparity, min_disparity)
    for name, matcher in matchers.items():
        compile_kernels(matcher, images[0].shape[2:], images[0].dtype)  # the time below is that of matching
        with collecting() as lines, strictly(strict):
            start = time.perf_counter()
            result = matcher(*images, **masks)
            seconds = time.perf_counter() - start
        warnings += [line for line in lines if line not in warnings]
        counts = score(result.disparity, noc=noc, occ=occ, measured=result.valid)
        figures.append(
            {
                "name": name,
                "ms": 1000 * seconds,
                "density": 100 * float(np.mean(result.valid)),
                "d1_noc": counts.noc.all.filled.d1(),
                "d1_all": counts.occ.all.filled.d1(),
            }
        )
        maps.append(viewer.MethodMap(name, result.disparity, result.valid, _note(figures[-1])))
    for line in warnings:
        warn(line, PairWarning)
    pictures = [image if image.ndim == 2 else image[:, :, :3] for image in images]
    pair = viewer.pair(left.name, pictures[0], maps, right=pictures[1], noc=noc, occ=occ, calibration=camera)
    page = render(
        "view.html.j2", [pair], title=_title(left, right), version=__version__,
        figures=figures, warnings=warnings, methods=[maps[0].name, maps[-1].name],
    )  # fmt: skip
    write_bytes(output, page)
    seconds_by_name = {row["name"]: row["ms"] / 1000 for row in figures}
    report = {
        "left": str(left), "right": None if right is None else str(right), "output": str(output), "bytes": len(page),
        "methods": list(matchers), "seconds": seconds_by_name,
        "calibration": None if calibration is None else str(calibration),
        "density": {row["name"]: row["density"] / 100 for row in figures}, "figures": figures, "warnings": warnings,
        "version": __version__,
    }  # fmt: skip
    if not write_json(json_file, report):
        hint = "" if camera is not None else "; no calibration: no depth, and the point cloud is in pixels"
        typer.echo(f"{output} ({len(page) / 1e6:.1f} MB){hint}")
    if open_browser:
        webbrowser.open(output.resolve().as_uri())


def _read_truth(
    truth: Path | None, seen: Path | None, size: tuple[int, ...]
) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """Return the true disparity of the pixels that both cameras see, and of all pixels; None where it is not known."""
    occ = None if truth is None else read_disparity(truth)
    if occ is not None and occ.shape != size:
        raise InputError(f"truth must have the size of the images, {size}, got {occ.shape}")
    if seen is None:
        return None, occ
    mask = read_image(seen, gray=True) if seen.suffix.lower() in IMAGE_SUFFIXES else None
    noc: NDArray[np.float32]
    if mask is None or mask.dtype != np.uint8:
        noc = read_disparity(seen)
    elif occ is None:
        raise OptionError(f"noc must go with --truth where it is a mask, got {str(seen)!r} alone")
    elif mask.shape == size:
        noc = np.where(mask == 255, occ, np.float32(np.nan))
    else:
        noc = mask  # of another size, which is refused below
    if noc.shape != size:
        raise InputError(f"noc must have the size of the images, {size}, got {noc.shape}")
    return noc, occ


def _lesser_faults(images: tuple[NDArray[Any], NDArray[Any]], max_disparity: int, min_disparity: int) -> list[str]:
    """Return what is worth knowing of a pair, in lines; what is seriously wrong with it the matcher says itself."""
    report = check_pair(*images, max_disparity=max_disparity, min_disparity=min_disparity)
    return [fault.message for fault in report.faults if not fault.serious]


def _note(row: dict[str, Any]) -> str:
    """Return the figures of a method in a few words, for the viewer."""
    errors = ((name, row[key]) for name, key in (("D1 noc", "d1_noc"), ("D1 all", "d1_all")))
    words = [f"{name} {value:.2f} %" for name, value in errors if value is not None]
    return ", ".join([*words, f"density {row['density']:.0f} %"])


def _title(left: Path, right: Path | None) -> str:
    """Return the files' names, with their folders where the names alone are the same."""
    if right is None:
        return left.name
    parts = 1 if left.name != right.name else 2
    return " and ".join("/".join(path.resolve().parts[-parts:]) for path in (left, right))
