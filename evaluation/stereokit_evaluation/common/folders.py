"""Folders that commands write to: refused before any work is done, made when they are needed."""

from __future__ import annotations

from pathlib import Path

from stereokit import io
from stereokit.errors import FileError

__all__ = ["check_folder", "make_folder"]


def check_folder(place: Path, name: str = "output") -> None:
    """Refuse a place that can never be a folder, because a file stands in the way.

    Raises
    ------
    FileError
        With `name`, what the message calls the argument.
    """
    nearest = next(above for above in (place, *place.absolute().parents) if above.exists())
    if not nearest.is_dir():
        raise FileError(f"{name} must be a folder, got {str(place)!r} ({str(nearest)!r} is a file)")


def make_folder(place: Path, name: str = "output") -> Path:
    """Make a folder, unless it is there, and return it.

    Raises
    ------
    FileError
        If it cannot be made.
    """
    io.make_folder(name, place)
    return place
