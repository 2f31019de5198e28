"""What is worth knowing but stops nothing: warnings, raised in one place.

In Python they are warnings of the standard library, and the filters of `warnings` apply. Who has a better place for
them, such as a command with a line to print or a batch with a report to fill, takes them with `collecting`; each thread
does so for itself.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from stereokit.errors import StereokitWarning

__all__ = ["PairWarning", "collecting", "warn"]


class PairWarning(StereokitWarning):
    """The two images do not look like a rectified pair, left and right."""


_taker: ContextVar[Callable[[str], object] | None] = ContextVar("stereokit_notices", default=None)


def warn(message: str, category: type[StereokitWarning] = StereokitWarning) -> None:
    """Hand `message`, one line, to who collects in this thread; where nobody does, warn where the package was called.

    Parameters
    ----------
    message : str
    category : type
        Of the warning.
    """
    taker = _taker.get()
    if taker is None:
        warnings.warn(message, category, stacklevel=_outside())
    else:
        taker(message)


@contextmanager
def collecting(taker: Callable[[str], object] | None = None) -> Iterator[list[str]]:
    """Collect the warnings of this thread for the length of a ``with`` block.

    Parameters
    ----------
    taker : callable or None
        Called with each line, the first time that it comes.

    Yields
    ------
    list of str
        The lines so far, each once.
    """
    lines: list[str] = []

    def take(line: str) -> None:
        if line not in lines:
            lines.append(line)
            if taker is not None:
                taker(line)

    token = _taker.set(take)
    try:
        yield lines
    finally:
        _taker.reset(token)


def _outside() -> int:
    """Return the stack level, as `warnings.warn` in `warn` counts, of the nearest caller outside of this package."""
    level, frame = 2, sys._getframe(2)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0].startswith("stereokit"):
        level, frame = level + 1, frame.f_back
    return level
