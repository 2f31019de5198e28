"""What commands do with a pair beside matching it: masks, alignment of rows, strictness, and ``stereokit check``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereokit.cli.options import JsonOption, LayoutOption, MaxDisparityOption, MinDisparityOption, check_json
from stereokit.cli.output import Table, report, version_of
from stereokit.errors import InputError, OptionError
from stereokit.notices import PairWarning, collecting, warn

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "AlignOption",
    "MaskOption",
    "NodataOption",
    "RightMaskOption",
    "StrictOption",
    "aligned",
    "check",
    "joined_masks",
    "read_images",
    "read_mask",
    "strictly",
]

MaskOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Usable pixels of the left view: not 0 (image or .npy).")
]
RightMaskOption = Annotated[Path | None, typer.Option(metavar="FILE", help="The same of the right view.")]
NodataOption = Annotated[float | None, typer.Option(metavar="VALUE", help="Value of pixels that hold nothing.")]
StrictOption = Annotated[bool, typer.Option("--strict", help="What would be warned of is an error; writes nothing.")]
AlignOption = Annotated[bool, typer.Option("--align", help="Align rows that are less than 2 pixels apart first.")]


def read_images(left: Path, right: Path | None, layout: str | None) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the images of LEFT and RIGHT, or of one file with both views.

    Raises
    ------
    OptionError
        If there are a layout and two files, or there is no such layout.
    InputError
        If the views differ in size.
    FileError
        If a file cannot be read.
    """
    from stereokit import io

    if layout is not None and right is not None:
        raise OptionError("--layout is for one file with both views, got LEFT and RIGHT")
    images = io.read_views(left, layout) if right is None else io.read_pair(left, right, alpha=True)
    if images[0].shape[:2] != images[1].shape[:2]:
        sizes = " and ".join(f"{image.shape[1]}x{image.shape[0]}" for image in images)
        raise InputError(f"LEFT and RIGHT must have the same size, got {sizes}")
    return images


def read_mask(name: str, path: Path | None, shape: tuple[int, int]) -> NDArray[Any] | None:
    """Return the usable pixels of a mask in a file, None if there is none.

    Raises
    ------
    InputError
        If it has another size than the images.
    FileError
        If the file cannot be read.
    """
    if path is None:
        return None
    from stereokit import io

    mask = io.read_image(path)
    usable: NDArray[Any] = mask != 0 if mask.ndim == 2 else (mask != 0).any(axis=2)
    if usable.shape != shape:
        sizes = f"{shape[1]}x{shape[0]}, got {usable.shape[1]}x{usable.shape[0]}"
        raise InputError(f"{name} must have the size of the images, {sizes} in {str(path)!r}")
    return usable


def joined_masks(
    masks: dict[str, NDArray[Any]], mask: Path | None, right_mask: Path | None, shape: tuple[int, int]
) -> dict[str, NDArray[Any]]:  # fmt: skip
    """Return the masks of a pair, such as those of its rectification, together with those of ``--mask`` files.

    Raises
    ------
    InputError
        If a mask has another size than the images.
    FileError
        If a file cannot be read.
    """
    total = dict(masks)
    for name, file in {"mask": mask, "right_mask": right_mask}.items():
        drawn, seen = read_mask(f"--{name.replace('_', '-')}", file, shape), total.get(name)
        if drawn is not None:
            total[name] = drawn if seen is None else drawn & seen
    return total


def aligned(left: Any, right: Any, nodata: float | None) -> Any:
    """Return the right view with its rows aligned, and say what was done."""
    from stereokit.pairs import align_rows

    image, seen = align_rows(left, right, nodata=nodata)
    assert seen.row_offset is not None
    typer.echo(
        f"aligned: the right view lay {seen.row_offset:+.2f} px lower, turned by {seen.roll:+.3f} degrees and "
        f"{seen.scale:.4f} times as high (from {seen.points} points)",
        err=True,
    )
    return image


@contextmanager
def strictly(strict: bool) -> Iterator[None]:
    """Collect the warnings of a ``with`` block; hand them on in the end, or raise the first if `strict`."""
    with collecting() as lines:
        yield
    if strict and lines:
        raise InputError(f"{lines[0]} (--strict)")
    for line in lines:
        warn(line, PairWarning)


def check(
    left: Annotated[Path, typer.Argument(metavar="LEFT", help="Left image of a pair, or one file with both.")],
    right: Annotated[Path | None, typer.Argument(metavar="[RIGHT]", help="Right image, of the same size.")] = None,
    layout: LayoutOption = None,
    max_disparity: MaxDisparityOption = 128,
    min_disparity: MinDisparityOption = 0,
    nodata: NodataOption = None,
    json_file: JsonOption = None,
) -> None:
    """Tell whether a pair is rectified, left and right, sharp and within the range.

    Says how the rows of the two views lie, which disparities their common points have, and what is wrong. The exit
    status is 1 if the map would suffer from it.
    """
    from stereokit.pairs import check_pair

    check_json(json_file)
    images = read_images(left, right, layout)
    quality = check_pair(*images, max_disparity=max_disparity, min_disparity=min_disparity, nodata=nodata)
    values = {name: getattr(quality, name) for name in quality.__dataclass_fields__ if name != "faults"}
    faults = [{"kind": fault.kind, "message": fault.message, "serious": fault.serious} for fault in quality.faults]
    content = {"left": str(left), "right": None if right is None else str(right), **values, "faults": faults}
    content["version"] = version_of("stereokit")
    table = Table("Common points", "Agree", "Row offset", "Roll", "Height", "Disparities", "Brightness", "Sharpness")
    unknown = "unknown"
    table.add_row(
        str(quality.points),
        f"{100 * quality.agreement:.0f} %",
        unknown if quality.row_offset is None else f"{quality.row_offset:+.2f} px",
        unknown if quality.roll is None else f"{quality.roll:+.3f} degrees",
        unknown if quality.scale is None else f"x {quality.scale:.4f}",
        unknown if quality.disparities is None else "{:.1f} .. {:.1f}".format(*quality.disparities),
        f"x {quality.brightness:.2f}",
        f"x {quality.sharpness:.2f}",
    )
    report(content, [table], json_file)
    for fault in quality.faults:
        typer.echo(f"{'fault' if fault.serious else 'note'}: {fault.message}", err=True)
    if not quality.faults and quality.row_offset is None:
        typer.echo("note: too few points are seen by both views to tell how their rows lie", err=True)
    if any(fault.serious for fault in quality.faults):
        raise typer.Exit(1)
