"""Files and folders as such: checked before work, written whole or not at all.

Every writer builds the whole file first, writes it to a temporary name beside the target and then renames it, so that a
failure never leaves half a file. A link stays a link, what it points to is replaced, and a file keeps its permissions;
what is no file (a pipe, a device) is written to. A process that is killed leaves its temporary file: it was locked for
as long as it was being written, so the next process that writes to the folder knows that nobody needs it, and removes
it.
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
_swept: set[str] = set()  # folders
_locks: Any = None  # on Windows a file that is open cannot be renamed, and so is not locked
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
        What the message calls the argument.

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
    """Give a temporary path; what is written there gets the name `path` when the block ends well.

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
    """Give a temporary path beside `target`, and rename what is there."""
    _sweep(target.parent)
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
    """Give a temporary path, and pass what is there on to what is no file."""
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    with tempfile.TemporaryDirectory(prefix="stereokit-") as folder:
        temporary = Path(folder, "content")
        yield temporary
        try:
            place = os.open(target, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))  # a pipe that nobody reads is refused
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise OSError(errno.ENXIO, "nobody reads from the other end") from error
            raise
        os.set_blocking(place, True)
        with temporary.open("rb") as source, os.fdopen(place, "wb") as sink:
            shutil.copyfileobj(source, sink)


def _new_temporary(folder: Path) -> tuple[Path, int | None]:
    """Make an empty file in a folder; return its path and the descriptor that locks it."""
    while True:
        path = folder / f".stereokit-{secrets.token_hex(8)}.tmp"
        place = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if _locks is None:
            os.close(place)
            return path, None
        try:
            _locks.flock(place, _locks.LOCK_EX | _locks.LOCK_NB)
        except OSError:  # another process took it for one that was left, or the file system has no locks
            pass
        if path.exists():
            return path, place
        os.close(place)


def _sweep(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder, once in a process."""
    where = os.path.abspath(folder)
    if where in _swept or _locks is None:
        return
    _swept.add(where)
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries if _TEMPORARY.fullmatch(entry.name)]
    except OSError:
        return
    for name in names:
        try:
            place = os.open(folder / name, os.O_RDWR | os.O_NOFOLLOW)
        except OSError:
            continue
        try:
            _locks.flock(place, _locks.LOCK_EX | _locks.LOCK_NB)
            os.unlink(folder / name)
        except OSError:  # somebody is writing it
            pass
        finally:
            os.close(place)


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
    """Make the folder `path` and those above it, unless it is there.

    Parameters
    ----------
    name : str
        What the caller's argument is called, for the message.

    Raises
    ------
    FileError
        If it cannot be made.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"{name} must be a folder, got {str(path)!r} ({error.strerror or error})") from error
