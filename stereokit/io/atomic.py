"""Files and folders as such: checked before work, read whole, written whole or not at all.

Every writer builds the whole file first, writes it to a temporary name beside the target and then renames it,
so that a failure never leaves half a file.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stereokit.errors import FileError

__all__ = [
    "check_output",
    "make_folder",
    "read_bytes",
    "replacing",
    "write_bytes",
]


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
    if not target.parent.is_dir():
        raise FileError(f"{name} {str(path)!r}: the folder {str(target.parent)!r} does not exist")
    if target.is_dir():
        raise FileError(f"{name} {str(path)!r} is a folder, expected a file")
    return target


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`; what is written there gets that name when the block ends well.

    Raises
    ------
    FileError
        If the folder is missing or the file cannot be written. An existing file is then left as it was.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileError(f"cannot write {str(path)!r}: the folder {str(target.parent)!r} does not exist")
    temporary = target.parent / f".{secrets.token_hex(8)}.tmp"
    try:
        try:
            yield temporary
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error


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


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file.

    Raises
    ------
    FileError
        If it is missing or cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except FileNotFoundError as error:
        raise FileError(f"no such file: {str(path)!r}") from error
    except OSError as error:
        raise FileError(f"cannot read {str(path)!r}: {error.strerror or error}") from error
