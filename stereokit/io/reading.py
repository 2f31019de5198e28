"""Foreign files: whatever goes wrong while one is read becomes one `FileError`.

A file may hold anything, and the libraries that parse it raise what they like: so no reader lists the exceptions that
it knows. Each parses within `parsing`.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, StereokitError, one_line

__all__ = ["parsing", "read_bytes", "read_json", "read_npy", "read_text"]

_LONGEST_REASON = 200


@contextmanager
def parsing(path: str | os.PathLike[str], what: str, rule: str | None = None) -> Iterator[None]:
    """Turn everything that is raised in a ``with`` block into a `FileError` that names the file.

    An interrupt passes, and so do a `FileError` and a warning. That the memory does not suffice counts as a fault of
    the file: its size is what it claims.

    Parameters
    ----------
    path : path
        The file that is read.
    what : str
        What it should be, such as ``"image"``.
    rule : str or None
        What the message says instead of that it is not a readable `what`, such as ``"weights must be a safetensors
        file"``.

    Raises
    ------
    FileError
        For any other exception.
    """
    name = repr(str(path))
    try:
        yield
    except (FileError, Warning):  # a warning is one where the filters of `warnings` say so
        raise
    except StereokitError as error:  # a rule of ours that the content breaks
        raise FileError(f"{name}: {error}") from error
    except FileNotFoundError as error:
        raise FileError(f"no such file: {name}") from error
    except MemoryError as error:
        raise FileError(f"{name} needs more memory than there is") from error
    except RecursionError as error:
        raise FileError(_refusal(name, what, rule, "it is nested too deeply")) from error
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise FileError(f"cannot read {name}: {error.strerror}") from error
        reason = one_line(str(error))[:_LONGEST_REASON] or type(error).__name__
        raise FileError(_refusal(name, what, rule, reason)) from error


def _refusal(name: str, what: str, rule: str | None, reason: str) -> str:
    return f"{rule}, got {name} ({reason})" if rule else f"{name} is not a readable {what} ({reason})"


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file.

    Raises
    ------
    FileError
        If it is missing or cannot be read.
    """
    with parsing(path, "file"):
        return Path(path).read_bytes()


def read_text(path: str | os.PathLike[str], what: str = "text file") -> str:
    """Return the text of a file in UTF-8 or, where its first bytes say so, UTF-16; any line end becomes a line feed.

    Parameters
    ----------
    path : path
    what : str
        What it should be, for the message.

    Raises
    ------
    FileError
        If it is missing, cannot be read or is no text.
    """
    data = read_bytes(path)
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileError(f"{str(path)!r} is not a text file, or not in UTF-8, so no {what}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: str | os.PathLike[str], what: str) -> Any:
    """Return what a JSON file says.

    Parameters
    ----------
    path : path
    what : str
        What it should be, for the message.

    Raises
    ------
    FileError
        If it is missing, cannot be read or is no JSON.
    """
    text = read_text(path, what)
    with parsing(path, what):
        return json.loads(text)


def read_npy(path: str | os.PathLike[str], data: bytes | None = None) -> NDArray[Any]:
    """Return the array of an npy file; pickles are not opened.

    Parameters
    ----------
    path : path
    data : bytes or None
        Its content; None maps the file into memory instead of reading it.

    Raises
    ------
    FileError
        If it is missing, cannot be read or holds no array.
    """
    with parsing(path, "npy file"):
        if data is None:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        else:
            array = np.load(io.BytesIO(data), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive")
        return np.asarray(array)
