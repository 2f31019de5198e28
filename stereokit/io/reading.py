"""Reading of foreign files: any error becomes one `FileError`.

A file may have any content, and the libraries that parse it raise any exception: so no reader lists exceptions. Each
parses within `parsing`.
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

from stereokit.errors import FileError, StereokitError, StereokitWarning, one_line

__all__ = ["parsing", "read_bytes", "read_json", "read_npy", "read_text"]

_LONGEST_REASON = 200


@contextmanager
def parsing(path: str | os.PathLike[str], kind: str, rule: str | None = None) -> Iterator[None]:
    """Turn every exception of a ``with`` block into a `FileError` that names the file.

    An interrupt passes, and so do a `FileError` and a warning of ours. A lack of memory counts as a fault of the file,
    whose header states its size.

    Parameters
    ----------
    path : path
        The file that is read.
    kind : str
        The expected content, such as ``"image"``.
    rule : str or None
        The message's beginning in place of "is not a readable <kind>", such as ``"weights must be a safetensors
        file"``.

    Raises
    ------
    FileError
        For any other exception.
    """
    name = repr(str(path))
    try:
        yield
    except (FileError, StereokitWarning):  # a warning of ours is raised where the filters of `warnings` say so
        raise
    except StereokitError as error:  # a rule of ours that the content breaks
        raise FileError(f"{name}: {error}") from error
    except FileNotFoundError as error:
        raise FileError(f"no such file: {name}") from error
    except MemoryError as error:
        raise FileError(f"{name} needs more memory than there is") from error
    except RecursionError as error:
        raise FileError(_refusal(name, kind, rule, "it is nested too deeply")) from error
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise FileError(f"cannot read {name}: {error.strerror}") from error
        reason = one_line(str(error))[:_LONGEST_REASON] or type(error).__name__
        raise FileError(_refusal(name, kind, rule, reason)) from error


def _refusal(name: str, kind: str, rule: str | None, reason: str) -> str:
    return f"{rule}, got {name} ({reason})" if rule else f"{name} is not a readable {kind} ({reason})"


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file.

    Raises
    ------
    FileError
        If it is missing or cannot be read.
    """
    with parsing(path, "file"):
        return Path(path).read_bytes()


def read_text(path: str | os.PathLike[str], kind: str = "text file") -> str:
    """Return the text of a file in UTF-8 or, where its first bytes say so, UTF-16; any line end becomes a line feed.

    Parameters
    ----------
    path : path
    kind : str
        The expected content, for the message.

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
        raise FileError(f"{str(path)!r} is not a text file, or not in UTF-8, so no {kind}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: str | os.PathLike[str], kind: str) -> Any:
    """Return the content of a JSON file.

    Parameters
    ----------
    path : path
    kind : str
        The expected content, for the message.

    Raises
    ------
    FileError
        If it is missing, cannot be read or is no JSON.
    """
    text = read_text(path, kind)
    with parsing(path, kind):
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
        If it is missing, cannot be read or has no array.
    """
    with parsing(path, "npy file"):
        if data is None:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        else:
            array = np.load(io.BytesIO(data), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive")
        return np.asarray(array)
