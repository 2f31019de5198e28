"""The errors that stereokit raises: one family under ``ValueError``.

Every message is one line that names the argument, the value received and the rule, so that the command line
can print it as it is.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = [
    "DeviceError",
    "FileError",
    "InputError",
    "OptionError",
    "StereokitError",
    "StereokitWarning",
    "UnknownNameError",
    "did_you_mean",
    "one_line",
    "shown",
]


class StereokitError(ValueError):
    """Base of every error that stereokit raises on purpose."""


class InputError(StereokitError):
    """An image, volume or map has a shape, type or content that cannot be used."""


class OptionError(StereokitError):
    """An option has a value outside its rule, or does not exist."""


class DeviceError(OptionError):
    """The device that was asked for is not there, or cannot do what was asked."""


class UnknownNameError(OptionError):
    """A method, stage, refiner or data set has no such name."""


class FileError(StereokitError):
    """A file is missing, cannot be read as what it should be, or cannot be written."""


class StereokitWarning(UserWarning):
    """Something that was not refused, but hardly gives what was meant."""


def shown(value: object) -> str:
    """Return a value as a message shows it: on one line, and not long."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # such as integers of thousands of digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:77]}..."


def did_you_mean(kind: str, name: object, known: Iterable[str]) -> str:
    """Return the line that says that no `kind` is called `name`, with the nearest known name.

    Parameters
    ----------
    kind : str
        What was looked for, such as ``"cost"``.
    name : object
        The name that was asked for, or whatever came instead of one.
    known : iterable of str
        The names that exist.
    """
    names = sorted(known)
    close = difflib.get_close_matches(name.lower(), names, n=1) if isinstance(name, str) else []
    hint = f"; did you mean {close[0]!r}?" if close else "."
    return f"no {kind} named {shown(name)}{hint} Known: {', '.join(names) or 'none'}"


def one_line(text: str) -> str:
    """Return `text` as something that can be printed anywhere, on one line.

    Runs of white space become one blank; control characters, and what stands for the bytes of a file name that is no
    UTF-8, are written as escapes.

    Parameters
    ----------
    text : str
        Such as a path, or the message of a library.
    """
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in words)
