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
    """The requested device is not there, or does not support the request."""


class UnknownNameError(OptionError):
    """A method, stage, refiner or data set has no such name."""


class FileError(StereokitError):
    """A file is missing, cannot be read in its format, or cannot be written."""


class StereokitWarning(UserWarning):
    """An input or option that is accepted, but probably not intended."""


def shown(value: object) -> str:
    """Return the text of a value for messages: one short line."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # such as integers of thousands of digits
        text = f"a value of type {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:77]}..."


def did_you_mean(kind: str, name: object, known: Iterable[str]) -> str:
    """Return the message for a `name` that no `kind` has, with the nearest known name.

    Parameters
    ----------
    kind : str
        The kind of thing, such as ``"cost"``.
    name : object
        The unknown name, or another value in its place.
    known : iterable of str
        The names that exist.
    """
    names = sorted(known)
    close = difflib.get_close_matches(name.lower(), names, n=1) if isinstance(name, str) else []
    hint = f"; did you mean {close[0]!r}?" if close else "."
    return f"no {kind} named {shown(name)}{hint} Known: {', '.join(names) or 'none'}"


def one_line(text: str) -> str:
    """Return `text` as one printable line.

    Runs of white space become one blank. Control characters, and surrogates for bytes of a file name that are not
    UTF-8, are written as escapes.

    Parameters
    ----------
    text : str
        For example a path, or the message of a library.
    """
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in words)
