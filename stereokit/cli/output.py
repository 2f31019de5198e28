"""Output of commands: tables or JSON, a spinner during long work, versions."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import rich.table
from rich.console import Console
from rich.text import Text

from stereokit.cli.options import write_json
from stereokit.errors import one_line

__all__ = ["Table", "report", "version_of", "waiting"]


class Table(rich.table.Table):
    """A table of plain text: rich's markup in paths and names has no effect, and unprintable characters are escaped."""

    def __init__(self, *heads: str, title: str | None = None, **options: Any) -> None:
        super().__init__(*heads, title=None if title is None else Text(one_line(title), "table.title"), **options)

    def add_column(self, header: Any = "", *arguments: Any, **options: Any) -> None:
        """Add a column with a plain head; long cells are folded."""
        options.setdefault("overflow", "fold")
        super().add_column(Text(header) if isinstance(header, str) else header, *arguments, **options)

    def add_row(self, *cells: Any, **options: Any) -> None:
        """Add a row; strings are plain text, rich's own objects are rendered."""
        super().add_row(*(Text(one_line(cell)) if isinstance(cell, str) else cell for cell in cells), **options)


def version_of(package: str) -> str | None:
    """Return the version of an installed package, or None."""
    if package == "stereokit":
        from stereokit import __version__

        return __version__
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def report(content: dict[str, Any], tables: list[Table], path: Path | None) -> None:
    """Write `content` as JSON, or print the tables where there is no JSON file."""
    if write_json(path, content):
        return
    console = Console()
    for table in tables:
        console.print(table)


@contextmanager
def waiting(text: str) -> Iterator[None]:
    """Show a spinner on standard error when the body takes over a second."""
    status = Console(stderr=True).status(text)
    timer = threading.Timer(1.0, status.start)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()
        status.stop()
