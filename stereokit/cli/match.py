"""The command ``stereokit match``: one pair, its map, and further files from the map."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereokit.cli.options import (
    DeviceOption,
    FillOption,
    JsonOption,
    LayoutOption,
    MaxDisparityOption,
    MethodOption,
    MinDisparityOption,
    RefinerOption,
    ScaleOption,
    SettingsOption,
    WeightsOption,
    check_fits_png,
    check_json,
    matcher_report,
    parse_settings,
)
from stereokit.cli.output import Table, report, version_of, waiting
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
from stereokit.cli.rig import AlphaOption, RigOption, check_rig_options, read_rig_option, rig_files
from stereokit.errors import OptionError, UnknownNameError, did_you_mean

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stereokit.calibration import Calibration

__all__ = ["match"]


def match(
    left: Annotated[Path, typer.Argument(metavar="LEFT", help="Left image of a rectified pair.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help=".png (KITTI, x256), .pfm, .npy or .tiff."),
    ],
    right_image: Annotated[
        Path | None, typer.Argument(metavar="[RIGHT]", help="Right image, of the same size; none if LEFT holds both.")
    ] = None,
    layout: LayoutOption = None,
    method: MethodOption = "census+sgm",
    max_disparity: MaxDisparityOption = 128,
    min_disparity: MinDisparityOption = 0,
    scale: ScaleOption = 1.0,
    refiner: RefinerOption = None,
    weights: WeightsOption = None,
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
        Path | None, typer.Option(metavar="FILE", help="Calibration of a rectified pair, for --ply and --depth.")
    ] = None,
    calibration_scale: Annotated[
        float, typer.Option(metavar="FACTOR", help="The images are so many times the size of the calibration's.")
    ] = 1.0,
    cameras: Annotated[tuple[int, int], typer.Option(help="Camera pair of a KITTI calibration.")] = (2, 3),
    rig: RigOption = None,
    alpha: AlphaOption = None,
    ply: Annotated[Path | None, typer.Option(metavar="FILE", help="Also a point cloud, metres.")] = None,
    depth: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also the depth: .png (16-bit mm), .tiff or .npy (metres).")
    ] = None,
    max_depth: Annotated[
        float | None, typer.Option(metavar="METRES", help="No points and no depth beyond this.")
    ] = None,
    filled: Annotated[
        bool, typer.Option("--filled", help="Points and depth also where values were filled in, not measured.")
    ] = False,
    frame: Annotated[
        str, typer.Option(help="Axes of --ply: y-up (viewers), optical (y down, z forward) or ros (x forward, z up).")
    ] = "y-up",
    mask: MaskOption = None,
    right_mask: RightMaskOption = None,
    nodata: NodataOption = None,
    align: AlignOption = False,
    strict: StrictOption = False,
    memory: Annotated[str | None, typer.Option(metavar="BYTES", help="Match in windows that fit, such as 2GB.")] = None,
    overlap: Annotated[int | None, typer.Option(help="Margin of the windows of --memory, pixels.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Match LEFT and RIGHT and write the disparity map.

    Everything is checked before matching starts. The first run on a machine also compiles, once. With --memory the
    images (.npy, .tiff or any other) are matched in windows, and the map goes to .npy or tiled .tiff as it grows.
    With --rig the images are raw ones: they are rectified first, and the map is that of the rectified left view.
    """
    from stereokit import io

    suffixes = {
        "--output": (*io.DISPARITY_SUFFIXES, ".tif"),
        "--color": (".png", ".jpg", ".jpeg", ".tiff", ".tif", ".bmp", ".ppm"),
        "--right": (*io.DISPARITY_SUFFIXES, ".tif"),
        "--confidence": (".npy", ".png"),
        "--ply": (".ply",),
        "--depth": io.DEPTH_SUFFIXES,
    }
    paths = (output, color, right, confidence, ply, depth)
    outputs = {name: path for name, path in zip(suffixes, paths, strict=True) if path is not None}
    for name, path in outputs.items():
        io.check_output(path, suffixes[name], name)
        if name in ("--output", "--right") and path.suffix.lower() == ".png":
            check_fits_png(name, min_disparity, max_disparity)
    outputs.update(check_json(json_file))
    inputs = {"--calibration": calibration, "--mask": mask, "--right-mask": right_mask}
    if rig is not None:
        inputs.update(
            {f"--rig {part}": Path(file) for part, file in zip(("LEFT", "RIGHT"), rig_files(rig), strict=False)}
        )
    _check_distinct({"LEFT": left, "RIGHT": right_image, **inputs}, outputs)
    if layout is not None and right_image is not None:
        raise OptionError("--layout is for one file with both views, got LEFT and RIGHT")
    check_rig_options(rig, alpha, calibration)
    if rig is None and (ply is None and depth is None) != (calibration is None):
        raise OptionError("--ply and --depth go together with --calibration, got only one of them")
    _check_metres(frame, max_depth, calibration_scale)
    options = parse_settings(settings or [])
    flags = {
        "fill": fill,
        "nodata": nodata,
        "weights": weights,
        "right": right and True,
        "confidence": confidence and True,
    }
    options.update({name: value for name, value in flags.items() if value is not None})
    matcher_options: dict[str, Any] = {
        "max_disparity": max_disparity,
        "min_disparity": min_disparity,
        "scale": scale,
        "refiner": refiner,
        "threads": threads,
        "device": device,
    }
    if memory is not None or overlap is not None:
        for name in ("--color", "--right", "--confidence", "--ply", "--depth"):
            if name in outputs:
                raise OptionError(f"{name} is not available with --memory and --overlap")
        if rig is not None:
            raise OptionError("--rig is not available with --memory and --overlap; stereokit rectify comes before them")
        for name, wanted in (("--align", align), ("--strict", strict)):
            if wanted:
                raise OptionError(f"{name} is not available with --memory and --overlap")
        if right_image is None:
            raise OptionError("RIGHT must be given with --memory and --overlap: one file with both views is read whole")
        from stereokit.cli.match_large import match_in_windows

        mask_files = {"mask": mask, "right_mask": right_mask}
        content, table = match_in_windows(
            left, right_image, output, method, memory, overlap, {**matcher_options, **options, **mask_files}
        )
        report({**content, "options": options, "version": version_of("stereokit")}, [table], json_file)
        return

    from stereokit.matching import Matcher, compile_kernels

    matcher = Matcher(method, **matcher_options, **options)
    images = read_images(left, right_image, layout)
    height, width = images[0].shape[:2]
    camera = _read_camera(calibration, cameras, calibration_scale, width, height)
    masks: dict[str, NDArray[Any]] = {}
    if rig is not None:
        rectification = read_rig_option(rig, (width, height)).rectification(alpha=alpha)
        images, camera = rectification(*images), rectification.calibration
        masks.update(rectification.masks)
        width, height = rectification.size
    masks = joined_masks(masks, mask, right_mask, (height, width))
    if align:
        images = images[0], aligned(*images, nodata)

    with waiting("Matching (the first run also compiles) ..."):
        compile_kernels(matcher, images[0].shape[2:], images[0].dtype)
        with strictly(strict):
            start = time.perf_counter()
            result = matcher(*images, **masks)
            seconds = time.perf_counter() - start

    result.save(output, clip=True)  # its range was checked; a refiner may add a pixel
    if color is not None:
        io.write_image(color, result.color())
    if right is not None:
        io.write_disparity(right, _require(result.right, "--right", matcher.method), clip=True)
    if confidence is not None:
        _write_confidence(confidence, _require(result.confidence, "--confidence", matcher.method))
    if ply is not None and camera is not None:
        points = result.points(camera, filled=filled, max_depth=max_depth, frame=frame)
        _write_cloud(ply, points, frame, images[0], nodata)
    if depth is not None and camera is not None:
        result.save_depth(depth, camera, filled=filled, max_depth=max_depth)
    content = {
        "left": str(left),
        "right": None if right_image is None else str(right_image),
        "outputs": {name.removeprefix("--"): str(path) for name, path in outputs.items() if name != "--json"},
        "width": width,
        "height": height,
        **matcher_report(matcher),
        "options": options,
        **({} if rig is None else {"rig": rig, "alpha": alpha}),
        "density": result.density,
        "seconds": seconds,
        "version": version_of("stereokit"),
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
    report(content, [table], json_file)


def _check_distinct(inputs: dict[str, Path | None], outputs: dict[str, Path]) -> None:
    names = {os.path.realpath(path): name for name, path in inputs.items() if path is not None}
    for name, path in outputs.items():
        first_name = names.setdefault(os.path.realpath(path), name)
        if first_name != name:
            raise OptionError(f"{name} and {first_name} must be different files, got {str(path)!r} for both")


def _check_metres(frame: str, max_depth: float | None, calibration_scale: float) -> None:
    """Check the options of depth and points before anything is matched."""
    from stereokit.calibration import FRAMES

    if frame not in FRAMES:
        raise UnknownNameError(did_you_mean("--frame", frame, FRAMES))
    for name, value in (("--max-depth", max_depth), ("--calibration-scale", calibration_scale)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise OptionError(f"{name} must be positive, got {value:g}")


def _read_camera(
    path: Path | None, cameras: tuple[int, int], factor: float, width: int, height: int
) -> Calibration | None:  # fmt: skip
    if path is None:
        return None
    from stereokit.calibration import read_calibration

    if factor == 1:
        return read_calibration(path, cameras, (width, height))
    camera = read_calibration(path, cameras).scaled(factor)
    camera.check_size(width, height)
    return camera


def _require(array: NDArray[Any] | None, option: str, method: str) -> NDArray[Any]:
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


def _write_cloud(path: Path, points: NDArray[Any], frame: str, image: NDArray[Any], nodata: float | None) -> None:
    import numpy as np

    from stereokit import io
    from stereokit.calibration import FRAMES
    from stereokit.images.intensity import display_8bit

    finite = np.isfinite(points).all(axis=2)
    picture = display_8bit(image, nodata)
    colors = picture if picture.ndim == 3 else np.repeat(picture[:, :, None], 3, axis=2)
    io.write_ply(path, points[finite], colors[finite], f"frame {frame}: {FRAMES[frame]}; metres")
