"""Warnings, raised in one place.

In Python they are warnings of the standard library, and the filters of `warnings` apply. A caller with a better place
for them, such as a command that prints lines or a batch with a report, collects them with `collecting`; each thread
collects its own.
"""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from stereokit.errors import StereokitWarning

__all__ = ["PairWarning", "collecting", "say", "warn"]


class PairWarning(StereokitWarning):
    """The two images do not look like a rectified pair, left and right."""


_handler: ContextVar[Callable[[str], object] | None] = ContextVar("stereokit_notices", default=None)


def warn(message: str, category: type[StereokitWarning] = StereokitWarning) -> None:
    """Add `message`, one line, to the collection of this thread; without one, warn at the call of the package.

    Parameters
    ----------
    message : str
    category : type
        Of the warning.
    """
    handler = _handler.get()
    if handler is None:
        warnings.warn(message, category, stacklevel=_outside())
    else:
        handler(message)


def say(message: str) -> None:
    """Tell, in one line, what takes long: to the logger ``stereokit``, as information.

    Where nobody listens to it, an interactive session (a notebook, a prompt) has the line on standard error.
    """
    logger = logging.getLogger("stereokit")
    if logger.isEnabledFor(logging.INFO):
        logger.info(message)
    elif hasattr(sys, "ps1") and sys.stderr is not None:
        print(f"stereokit: {message}", file=sys.stderr, flush=True)


@contextmanager
def collecting(handler: Callable[[str], object] | None = None) -> Iterator[list[str]]:
    """Collect the warnings of this thread for the length of a ``with`` block.

    Parameters
    ----------
    handler : callable or None
        Called with each line, the first time that it comes.

    Yields
    ------
    list of str
        The lines so far, each once.
    """
    lines: list[str] = []

    def collect(line: str) -> None:
        if line not in lines:
            lines.append(line)
            if handler is not None:
                handler(line)

    token = _handler.set(collect)
    try:
        yield lines
    finally:
        _handler.reset(token)


def _outside() -> int:
    """Return the stack level, as `warnings.warn` in `warn` counts, of the nearest caller outside of this package."""
    level, frame = 2, sys._getframe(2)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0].startswith("stereokit"):
        level, frame = level + 1, frame.f_back
    return level
