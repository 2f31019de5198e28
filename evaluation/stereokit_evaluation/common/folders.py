"""Output folders of commands: checked before any work, created when they are needed."""

from __future__ import annotations

from pathlib import Path

from stereokit import io
from stereokit.errors import FileError

__all__ = ["check_folder", "make_folder"]


def check_folder(path: Path, name: str = "output") -> None:
    """Refuse a path that can never be a folder, because a part of it is a file.

    Raises
    ------
    FileError
        With `name`, the argument's name in the message.
    """
    nearest = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        raise FileError(f"{name} must be a folder, got {str(path)!r} ({str(nearest)!r} is a file)")


def make_folder(path: Path, name: str = "output") -> Path:
    """Create a folder, unless it exists, and return it.

    Raises
    ------
    FileError
        If it cannot be created.
    """
    io.make_folder(name, path)
    return path
