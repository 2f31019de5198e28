"""The folder that a batch writes to: what it was made with, what is there already, and each output exactly once.

``manifest.json`` holds the options of the run that made the folder. A later run with the same options goes on where
that one ended; one with others is refused, so that maps of different options never lie side by side. An output is
written to ``.partial`` and then linked to its name, which fails where the name is taken: it appears whole, and once,
whatever dies when. One run at a time holds the folder.
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stereokit.errors import FileError, OptionError
from stereokit.io import parsing, read_bytes, write_bytes
from stereokit_evaluation.common.folders import check_folder, make_folder

__all__ = ["COLOR", "finished", "held", "make_below", "mark_of", "publish", "target_of", "write_document"]

COLOR = "color"
"""Folder of the coloured pictures."""

_MANIFEST = "manifest.json"
_PARTIAL = ".partial"


@contextmanager
def held(
    folder: Path, made_with: dict[str, Any], suffix: str, owned: Callable[[str], bool], overwrite: bool
) -> Iterator[set[str]]:
    """Hold the folder for the length of a ``with`` block, and say which names are finished.

    Parameters
    ----------
    folder : Path
        Made if need be.
    made_with : dict
        What all outputs depend on, as JSON can say it.
    suffix : str
        Of the maps, with its dot.
    owned : callable
        Says whether a name can be one of the batch's.
    overwrite : bool
        Take the folder whatever it was made with, and first remove the maps of those names: a run that is killed
        after that is resumed like any other.

    Raises
    ------
    FileError
        If the folder cannot be made or written to, or another run holds it.
    OptionError
        If it was made with other options.
    """
    check_folder(folder)
    make_folder(folder)
    with _locked(folder):
        shutil.rmtree(folder / _PARTIAL, ignore_errors=True)  # of a run that was killed
        made_with = json.loads(json.dumps(made_with))
        names = set(filter(owned, finished(folder, suffix)))
        if overwrite:
            for name in names:
                target_of(folder, name, suffix).unlink()
            names = set()
        else:
            _check_same(folder, _read(folder / _MANIFEST), made_with, names)
        write_document(folder / _MANIFEST, made_with)
        make_folder(folder / _PARTIAL)
        try:
            yield names
        finally:
            shutil.rmtree(folder / _PARTIAL, ignore_errors=True)


def write_document(path: Path, content: dict[str, Any]) -> None:
    """Write what a person may want to read: JSON with names as they are."""
    write_bytes(path, (json.dumps(content, indent=2, ensure_ascii=False) + "\n").encode("utf-8", "backslashreplace"))


def finished(folder: Path, suffix: str) -> set[str]:
    """Return the names of all maps in the folder."""
    found: set[str] = set()
    for place, folders, files in os.walk(folder):
        inside = os.path.relpath(place, folder).replace(os.sep, "/")
        prefix = "" if inside == "." else inside + "/"
        if not prefix:
            folders[:] = [name for name in folders if name not in (COLOR, _PARTIAL)]
        found.update(prefix + name[: -len(suffix)] for name in files if name.endswith(suffix))
    return found


def target_of(folder: Path, name: str, suffix: str) -> Path:
    """Return the path of a map."""
    return folder / (name + suffix)


def publish(folder: Path, target: Path, write: Callable[[Path], object]) -> bool:
    """Write a file under a temporary name and give it its own; return False if that was taken meanwhile.

    Parameters
    ----------
    folder : Path
        The batch's.
    target : Path
        Below it.
    write : callable
        Writes the file at the path that it is given.
    """
    partial = make_below(folder, _PARTIAL)
    temporary = partial / (secrets.token_hex(8) + target.suffix)
    try:
        write(temporary)
        make_below(folder, *target.parent.relative_to(folder).parts)
        try:
            os.link(temporary, target)
        except FileExistsError:
            return False
        except OSError as error:  # a file system without links: the name is looked up and then taken
            if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK):
                raise
            if target.exists():
                return False
            os.replace(temporary, target)
        return True
    finally:
        temporary.unlink(missing_ok=True)


def make_below(folder: Path, *parts: str) -> Path:
    """Make folders in the batch's folder and return the last, but not that folder: it may have been removed meanwhile.

    Raises
    ------
    OSError
        If one cannot be made.
    """
    for part in parts:
        folder = folder / part
        folder.mkdir(exist_ok=True)
    return folder


def mark_of(folder: Path) -> tuple[int, int] | None:
    """Return what tells a folder from another that is put in its place, None if it is not there."""
    try:
        state = os.stat(folder)
    except OSError:
        return None
    return state.st_dev, state.st_ino


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock the folder itself until the process ends, however it ends; where the system cannot, go on without."""
    try:
        import fcntl
    except ModuleNotFoundError:  # Windows
        yield
        return
    place = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FileError(f"output {str(folder)!r} is being written to by another run") from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(place)


def _read(path: Path) -> dict[str, Any] | None:
    if not os.path.lexists(path):
        return None
    with parsing(path, "manifest", "manifest must be one of this program's; use --overwrite"):
        content = json.loads(read_bytes(path))
        if not isinstance(content, dict):
            raise ValueError("it is no object")
        return content


def _check_same(folder: Path, previous: dict[str, Any] | None, made_with: dict[str, Any], names: set[str]) -> None:
    way_out = "use --overwrite or another folder"
    if previous is None:
        if names:
            raise OptionError(f"output {str(folder)!r} holds {min(names)!r}, which no batch has made; {way_out}")
        return
    for key in (*made_with, *previous):
        before, now = (content.get(key) for content in (previous, made_with))
        if before != now:
            raise OptionError(
                f"output {str(folder)!r} was made with {key} {_short(before)}, now it is {_short(now)}; {way_out}"
            )


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 200 else text[:197] + "..."
