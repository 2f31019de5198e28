"""What the commands of all packages share: ``--set KEY=VALUE``, ``--json FILE`` and how results leave.

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
    "MaxDisparityOption",
    "MethodOption",
    "MinDisparityOption",
    "RefinerOption",
    "ScaleOption",
    "SettingsOption",
    "WeightsOption",
    "check_fits_png",
    "check_json",
    "described",
    "parse_settings",
    "write_json",
]

_OWN_OPTIONS = frozenset(  # not through --set
    "method max_disparity min_disparity scale refiner weights fill threads device right confidence".split()
)
MethodOption = Annotated[str, typer.Option("--method", "-m", help="cost+aggregation, S1 to S4.")]
MaxDisparityOption = Annotated[int, typer.Option(help="Disparities searched end below this, pixels.")]
MinDisparityOption = Annotated[int, typer.Option(help="Disparities searched start here, pixels.")]
ScaleOption = Annotated[float, typer.Option(help="Match at this size, such as 0.5.")]
RefinerOption = Annotated[str | None, typer.Option(help="Brings a scaled map to full size; see list.")]
WeightsOption = Annotated[str | None, typer.Option(help="Of the refiner: a file, or a collection such as kitti.")]
FillOption = Annotated[str | None, typer.Option(help="Of invalid pixels: nearest, background, none.")]
DeviceOption = Annotated[str, typer.Option(help="auto (the CPU, for now), cpu or cuda.")]
SettingsOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Option of a stage, such as p1=10.")
]
"""Types of the parameters that commands which match have in common; the defaults are theirs."""
JsonOption = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Also write the result as JSON; - prints it.")
]
"""The type of a command's ``--json`` parameter, whose default is None."""


def parse_settings(settings: Iterable[str], own: frozenset[str] = _OWN_OPTIONS) -> dict[str, Any]:
    """Return the options of ``--set KEY=VALUE``: whole numbers, finite numbers, true, false, none or text.

    Parameters
    ----------
    settings : iterable of str
        As given on the command line.
    own : frozenset of str
        Names that have an option of their own and are refused here.

    Raises
    ------
    OptionError
        If one is not ``KEY=VALUE``, is given twice, or has an option of its own.
    """
    options: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        key = key.strip().replace("-", "_")
        if not equals or not key.isidentifier():
            raise OptionError(f"--set must be KEY=VALUE, got {setting!r}")
        if key in own:
            raise OptionError(f"--set {key}: use --{key.replace('_', '-')} instead")
        if key in options:
            raise OptionError(f"--set {key} must be given once, got it twice")
        options[key] = _value(text.strip())
    return options


def check_fits_png(name: str, min_disparity: int, max_disparity: int) -> None:
    """Refuse disparities that a KITTI png does not hold, for the option `name`.

    Raises
    ------
    OptionError
        If some lie outside 0 .. 256.
    """
    if min_disparity < 0 or max_disparity > 256:
        span = f"{min_disparity} .. {max_disparity}"
        raise OptionError(f"{name}: a KITTI .png holds disparities in 0 .. 256, got {span}; use .pfm or .npy")


def check_json(path: Path | None) -> dict[str, Path]:
    """Check ``--json`` before any work is done for it; return it under its name, or nothing if it is no file.

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


def described(matcher: Matcher) -> dict[str, Any]:
    """Return what the reports of commands say of a matcher."""
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
