"""A progress bar for commands that measure times: it is drawn between the timed calls only, never during one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["progress"]

_BAR_AFTER_S = 1.0
_REDRAW_S = 0.2


@contextmanager
def progress(total: int | None) -> Iterator[tuple[Console, Callable[..., None]]]:
    """Show a bar on standard error after the first second, where that is a terminal.

    Parameters
    ----------
    total : int or None
        Number of steps, None where it is unknown.

    Yields
    ------
    console : Console
        Writes to standard error, above the bar.
    step : callable
        ``step(text, advance=1)`` reports a finished step.
    """
    console = Console(stderr=True, emoji=False)  # a method may be called mine:boom:
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=console, transient=True, auto_refresh=False, disable=not console.is_terminal)
    task = bar.add_task("", total=total)
    begun, shown = time.monotonic(), -math.inf

    def step(text: str, advance: int = 1) -> None:
        nonlocal shown
        bar.update(task, advance=advance, description=text)
        now = time.monotonic()
        if now - begun > _BAR_AFTER_S and now - shown > _REDRAW_S:
            shown = now
            if not bar.live.is_started:
                bar.start()
            bar.refresh()

    try:
        yield console, step
    finally:
        bar.stop()
