"""Output files and folders: checked before work, written whole or not at all.

Every writer builds the whole file first, writes it to a temporary name in the target's folder and then renames it, so
that a failure never leaves half a file. A link stays a link and its target is replaced; a file keeps its permissions; a
pipe or a device is written to. A killed process leaves its temporary file. The lock of that file ends with the process,
so the next process that writes to the folder recognises the file as abandoned, and removes it.
"""

from __future__ import annotations

import errno
import importlib
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from stereokit.errors import FileError

__all__ = [
    "check_output",
    "make_folder",
    "replacing",
    "write_bytes",
]

_TEMPORARY = re.compile(r"\.stereokit-[0-9a-f]{16}\.tmp")
_clean_folders: set[str] = set()  # without abandoned files, once in a process
_locks: Any = None  # none on Windows, where an open file cannot be renamed
with suppress(ModuleNotFoundError):
    _locks = importlib.import_module("fcntl")


def check_output(path: str | os.PathLike[str], suffixes: tuple[str, ...] = (), name: str = "path") -> Path:
    """Return `path`, checked before any work is done for it: known suffix, existing folder.

    Parameters
    ----------
    path : path
        A file that is to be written.
    suffixes : tuple of str
        The suffixes that are known, lower case with their dot; empty to take any.
    name : str
        The argument's name in messages.

    Raises
    ------
    FileError
        If the suffix is unknown, the folder is missing or `path` is a folder.
    """
    target = Path(path)
    if suffixes and target.suffix.lower() not in suffixes:
        raise FileError(f"{name} must end in one of {', '.join(suffixes)}, got {str(path)!r}")
    folder = _behind_link(target).parent
    if "\0" in str(path) or not folder.is_dir():
        raise FileError(f"{name} {str(path)!r}: the folder {str(folder)!r} does not exist")
    if target.is_dir():
        raise FileError(f"{name} {str(path)!r} is a folder, expected a file")
    return target


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path; the file there gets the name `path` when the block ends without an error.

    Raises
    ------
    FileError
        If the folder is missing or the file cannot be written. An existing file is then left as it was.
    """
    target = _behind_link(Path(path))
    if "\0" in str(path) or not target.parent.is_dir():
        raise FileError(f"cannot write {str(path)!r}: the folder {str(target.parent)!r} does not exist")
    try:
        mode = os.stat(target).st_mode if target.exists() else None
        with _piped(target) if mode is not None and not stat.S_ISREG(mode) else _renamed(target, mode) as temporary:
            yield temporary
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error


def _behind_link(path: Path) -> Path:
    return Path(os.path.realpath(path)) if os.path.islink(path) else path


@contextmanager
def _renamed(target: Path, mode: int | None) -> Iterator[Path]:
    """Give a temporary path in the folder of `target`, and rename the file there."""
    _remove_leftovers(target.parent)
    temporary, lock = _new_temporary(target.parent)
    try:
        try:
            if mode is not None:
                os.chmod(temporary, stat.S_IMODE(mode))
            yield temporary
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    finally:
        if lock is not None:
            os.close(lock)


@contextmanager
def _piped(target: Path) -> Iterator[Path]:
    """Give a temporary path, and copy its content to `target`, a pipe or a device."""
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    with tempfile.TemporaryDirectory(prefix="stereokit-") as folder:
        temporary = Path(folder, "content")
        yield temporary
        try:
            # O_NONBLOCK refuses a pipe that nobody reads.
            descriptor = os.open(target, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise OSError(errno.ENXIO, "nobody reads from the other end") from error
            raise
        os.set_blocking(descriptor, True)
        with temporary.open("rb") as source, os.fdopen(descriptor, "wb") as sink:
            shutil.copyfileobj(source, sink)


def _new_temporary(folder: Path) -> tuple[Path, int | None]:
    """Create an empty file in a folder; return its path and the descriptor that locks it."""
    while True:
        path = folder / f".stereokit-{secrets.token_hex(8)}.tmp"
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if _locks is None:
            os.close(descriptor)
            return path, None
        try:
            _locks.flock(descriptor, _locks.LOCK_EX | _locks.LOCK_NB)
        except OSError:  # another process took it for an abandoned one, or the file system has no locks
            pass
        if path.exists():
            return path, descriptor
        os.close(descriptor)


def _remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder, once in a process."""
    folder_path = os.path.abspath(folder)
    if folder_path in _clean_folders or _locks is None:
        return
    _clean_folders.add(folder_path)
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries if _TEMPORARY.fullmatch(entry.name)]
    except OSError:
        return
    for name in names:
        try:
            descriptor = os.open(folder / name, os.O_RDWR | os.O_NOFOLLOW)
        except OSError:
            continue
        try:
            _locks.flock(descriptor, _locks.LOCK_EX | _locks.LOCK_NB)
            os.unlink(folder / name)
        except OSError:  # somebody is writing it
            pass
        finally:
            os.close(descriptor)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to `path`, all of it or nothing.

    Raises
    ------
    FileError
        If the folder is missing or the file cannot be written. An existing file is then left as it was.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def make_folder(name: str, path: str | os.PathLike[str]) -> None:
    """Create the folder `path` and its parents, unless it exists.

    Parameters
    ----------
    name : str
        The caller's argument, for the message.

    Raises
    ------
    FileError
        If it cannot be created.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{name} must be a folder, got {str(path)!r} ({error.strerror or error})") from error
