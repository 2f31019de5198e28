"""Options that the commands of all packages share, such as ``--set KEY=VALUE`` and ``--json FILE``.

Everything heavy is imported inside the functions: commands are loaded to print their help.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereokit.errors import OptionError

if TYPE_CHECKING:
    from stereokit.matching import Matcher

__all__ = [
    "DeviceOption",
    "FillOption",
    "JsonOption",
    "LayoutOption",
    "MaxDisparityOption",
    "MethodOption",
    "MinDisparityOption",
    "RefinerOption",
    "ScaleOption",
    "SettingsOption",
    "WeightsOption",
    "check_fits_png",
    "check_json",
    "matcher_report",
    "parse_settings",
    "write_json",
]

_RESERVED_OPTIONS = frozenset(  # not through --set
    "method max_disparity min_disparity scale refiner weights fill threads device right confidence".split()
)
MethodOption = Annotated[str, typer.Option("--method", "-m", help="cost+aggregation, S1 to S4.")]
MaxDisparityOption = Annotated[int, typer.Option(help="Disparities searched end below this, pixels.")]
MinDisparityOption = Annotated[int, typer.Option(help="Disparities searched start here, pixels.")]
ScaleOption = Annotated[float, typer.Option(help="Match at this size, such as 0.5.")]
RefinerOption = Annotated[str | None, typer.Option(help="Brings a scaled map to full size; see list.")]
WeightsOption = Annotated[str | None, typer.Option(help="Of the refiner: a file, or a collection such as kitti.")]
LayoutOption = Annotated[
    str | None, typer.Option(help="Both views in one: side-by-side, right-left, top-bottom, bottom-top, pages.")
]
FillOption = Annotated[str | None, typer.Option(help="Of invalid pixels: nearest, background, none.")]
DeviceOption = Annotated[str, typer.Option(help="auto (the CPU, for now), cpu or cuda.")]
SettingsOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Option of a stage, such as p1=10.")
]
"""Types of the parameters that the matching commands share; each command has its own defaults."""
JsonOption = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Also write the result as JSON; - prints it.")
]
"""The type of a command's ``--json`` parameter, whose default is None."""


def parse_settings(settings: Iterable[str], reserved: frozenset[str] = _RESERVED_OPTIONS) -> dict[str, Any]:
    """Return the options of ``--set KEY=VALUE``: whole numbers, finite numbers, true, false, none or text.

    Parameters
    ----------
    settings : iterable of str
        The values on the command line.
    reserved : frozenset of str
        Names with an option of their own, which are refused here.

    Raises
    ------
    OptionError
        If one is not ``KEY=VALUE``, appears twice, or has an option of its own.
    """
    options: dict[str, Any] = {}
    for text in settings:
        key, separator, value = text.partition("=")
        key = key.strip().replace("-", "_")
        if not separator or not key.isidentifier():
            raise OptionError(f"--set must be KEY=VALUE, got {text!r}")
        if key in reserved:
            raise OptionError(f"--set {key}: use --{key.replace('_', '-')} instead")
        if key in options:
            raise OptionError(f"--set {key} must be given once, got it twice")
        options[key] = _value(value.strip())
    return options


def check_fits_png(name: str, min_disparity: int, max_disparity: int) -> None:
    """Refuse disparities beyond the range of a KITTI png, for the option `name`.

    Raises
    ------
    OptionError
        If some lie outside 0 .. 256.
    """
    if min_disparity < 0 or max_disparity > 256:
        span = f"{min_disparity} .. {max_disparity}"
        raise OptionError(f"{name}: a KITTI .png holds disparities in 0 .. 256, got {span}; use .pfm or .npy")


def check_json(path: Path | None) -> dict[str, Path]:
    """Check ``--json`` before any work; return its path under its name, or an empty dict if it is no file.

    Raises
    ------
    FileError
        If it cannot be a file.
    """
    if path is None or str(path) == "-":
        return {}
    from stereokit.io import check_output

    return {"--json": check_output(path, name="--json")}


def write_json(path: Path | None, content: dict[str, Any]) -> bool:
    """Write `content` to the file of ``--json``, or print it for ``-``; return whether it was printed.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    if path is None:
        return False
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    if str(path) == "-":
        typer.echo(text, nl=False)
        return True
    from stereokit.io import write_bytes

    write_bytes(path, text.encode())
    return False


def matcher_report(matcher: Matcher) -> dict[str, Any]:
    """Return the entries of a command's report about its matcher."""
    names = ("method", "max_disparity", "min_disparity", "scale", "refiner", "device")
    return {name: getattr(matcher, name) for name in names}


def _value(text: str) -> int | float | bool | str | None:
    for kind in (int, float):
        try:
            value = kind(text)
        except ValueError:
            continue
        if math.isfinite(value):
            return value
    words = {"true": True, "false": False, "none": None}
    return words.get(text.lower(), text)
