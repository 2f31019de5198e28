"""What commands show: tables or JSON, a spinner while something takes long, versions."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from stereokit.cli.options import write_json

__all__ = ["report", "version_of", "waiting"]


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
    """Write `content` as JSON, or print the tables where no file was asked for."""
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
