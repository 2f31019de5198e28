"""What commands do with a pair beside matching it: masks, alignment of rows, strictness, and ``stereokit check``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereokit.cli.options import JsonOption, MaxDisparityOption, MinDisparityOption, check_json
from stereokit.cli.output import Table, report, version_of
from stereokit.errors import InputError
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
    left: Annotated[Path, typer.Argument(metavar="LEFT", help="Left image of a pair.")],
    right: Annotated[Path, typer.Argument(metavar="RIGHT", help="Right image, of the same size.")],
    max_disparity: MaxDisparityOption = 128,
    min_disparity: MinDisparityOption = 0,
    nodata: NodataOption = None,
    json_file: JsonOption = None,
) -> None:
    """Tell whether a pair is rectified, left and right, sharp and within the range.

    Says how the rows of the two views lie, which disparities their common points have, and what is wrong. The exit
    status is 1 if the map would suffer from it.
    """
    from stereokit import io
    from stereokit.pairs import check_pair

    check_json(json_file)
    images = io.read_pair(left, right, alpha=True)
    quality = check_pair(*images, max_disparity=max_disparity, min_disparity=min_disparity, nodata=nodata)
    values = {name: getattr(quality, name) for name in quality.__dataclass_fields__ if name != "faults"}
    faults = [{"kind": fault.kind, "message": fault.message, "serious": fault.serious} for fault in quality.faults]
    content = {"left": str(left), "right": str(right), **values, "faults": faults, "version": version_of("stereokit")}
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
