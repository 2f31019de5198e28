"""``stereokit match --memory``: the large form of the command, with its progress and its report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from stereokit.cli.options import matcher_report
from stereokit.cli.output import Table
from stereokit.large.matching import OVERLAP, match_large

__all__ = ["match_in_windows"]


def match_in_windows(
    left: Path, right: Path, output: Path, method: str, memory: str | None, overlap: int | None, options: dict[str, Any]
) -> tuple[dict[str, Any], Table]:
    """Match two files window by window; return the report and the table of the command.

    Parameters
    ----------
    left, right, output : Path
    method : str
    memory, overlap
        Of `match_large`; None takes its default.
    options : dict
        Of `stereokit.Matcher`.

    Raises
    ------
    StereokitError
        As `match_large`.
    """
    console = Console(stderr=True)
    start = time.perf_counter()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("Windows", total=None)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        result = match_large(
            left,
            right,
            output,
            method,
            memory=memory,
            overlap=OVERLAP if overlap is None else overlap,
            progress=show,
            **options,
        )
    seconds = time.perf_counter() - start
    matcher = result.matcher
    report = {
        "left": str(left),
        "right": str(right),
        "outputs": {"output": str(output)},
        "width": result.width,
        "height": result.height,
        **matcher_report(matcher),
        "memory": memory,
        "overlap": result.overlap,
        "windows": result.windows,
        "window": {"height": result.window[0], "width": result.window[1]},
        "density": result.density,
        "seconds": seconds,
    }
    table = Table("Method", "Size", "Windows", "Overlap", "Density", "Seconds", "Output")
    table.add_row(
        matcher.method,
        f"{result.width}x{result.height}",
        f"{result.windows} of {result.window[1]}x{result.window[0]}",
        str(result.overlap),
        f"{100 * result.density:.1f} %",
        f"{seconds:.1f}",
        str(output),
    )
    return report, table
