"""The output folder of a batch: its manifest, its finished maps, and each output exactly once.

``manifest.json`` has the options of the run that created the folder. A later run with the same options resumes where
that one ended; one with others is refused, so that a folder never mixes maps of different options. An output is
written to ``.partial`` and then linked to its name, which fails where the name is taken: so it appears whole, and once,
even if a process is killed at any time. One run at a time owns the folder.
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

__all__ = [
    "COLOR",
    "finished",
    "folder_identity",
    "make_below",
    "open_output",
    "publish",
    "target_of",
    "write_document",
]

COLOR = "color"
"""Folder of the coloured pictures."""

_MANIFEST = "manifest.json"
_PARTIAL = ".partial"


@contextmanager
def open_output(
    folder: Path, identity: dict[str, Any], suffix: str, is_own: Callable[[str], bool], overwrite: bool
) -> Iterator[set[str]]:
    """Lock the folder for a ``with`` block, and yield the names of the finished maps.

    Parameters
    ----------
    folder : Path
        Created if missing.
    identity : dict
        Everything that all outputs depend on, as JSON values.
    suffix : str
        Of the maps, with its dot.
    is_own : callable
        ``is_own(name)`` is whether a name can be one of the batch's.
    overwrite : bool
        Accept a folder of other options, and first remove the maps of those names: a run that is killed after that is
        resumed like any other.

    Raises
    ------
    FileError
        If the folder cannot be created or written to, or another run has locked it.
    OptionError
        If it has maps of other options.
    """
    check_folder(folder)
    make_folder(folder)
    with _locked(folder):
        shutil.rmtree(folder / _PARTIAL, ignore_errors=True)  # of a run that was killed
        identity = json.loads(json.dumps(identity))
        names = set(filter(is_own, finished(folder, suffix)))
        if overwrite:
            for name in names:
                target_of(folder, name, suffix).unlink()
            names = set()
        else:
            _check_same(folder, _read(folder / _MANIFEST), identity, names)
        write_document(folder / _MANIFEST, identity)
        make_folder(folder / _PARTIAL)
        try:
            yield names
        finally:
            shutil.rmtree(folder / _PARTIAL, ignore_errors=True)


def write_document(path: Path, content: dict[str, Any]) -> None:
    """Write JSON for people: indented, with names in plain Unicode."""
    write_bytes(path, (json.dumps(content, indent=2, ensure_ascii=False) + "\n").encode("utf-8", "backslashreplace"))


def finished(folder: Path, suffix: str) -> set[str]:
    """Return the names of all maps in the folder."""
    names: set[str] = set()
    for path, folders, files in os.walk(folder):
        relative = os.path.relpath(path, folder).replace(os.sep, "/")
        prefix = "" if relative == "." else relative + "/"
        if not prefix:
            folders[:] = [name for name in folders if name not in (COLOR, _PARTIAL)]
        names.update(prefix + name[: -len(suffix)] for name in files if name.endswith(suffix))
    return names


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
        Writes the file at its argument, a path.
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
    """Create folders in the batch's folder and return the last; the batch's folder itself is not created again.

    Raises
    ------
    OSError
        If one cannot be created.
    """
    for part in parts:
        folder = folder / part
        folder.mkdir(exist_ok=True)
    return folder


def folder_identity(folder: Path) -> tuple[int, int] | None:
    """Return the device and inode of a folder, which differ from those of a replacement; None if it is missing."""
    try:
        state = os.stat(folder)
    except OSError:
        return None
    return state.st_dev, state.st_ino


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock the folder itself for a ``with`` block or until the process ends; do nothing on a system without locks."""
    try:
        import fcntl
    except ModuleNotFoundError:  # Windows
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FileError(f"output {str(folder)!r} is being written to by another run") from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(descriptor)


def _read(path: Path) -> dict[str, Any] | None:
    if not os.path.lexists(path):
        return None
    with parsing(path, "manifest", "manifest must be one of this program's; use --overwrite"):
        content = json.loads(read_bytes(path))
        if not isinstance(content, dict):
            raise ValueError("it is no object")
        return content


def _check_same(folder: Path, previous: dict[str, Any] | None, identity: dict[str, Any], names: set[str]) -> None:
    advice = "use --overwrite or another folder"
    if previous is None:
        if names:
            raise OptionError(f"output {str(folder)!r} holds {min(names)!r}, which no batch has made; {advice}")
        return
    for key in (*identity, *previous):
        old, new = (content.get(key) for content in (previous, identity))
        if old != new:
            raise OptionError(
                f"output {str(folder)!r} was made with {key} {_short(old)}, now it is {_short(new)}; {advice}"
            )


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 200 else text[:197] + "..."
