"""Decoders that talk: OpenCV, libpng, libjpeg and FFmpeg write lines of their own to standard error.

What they have to say of a broken file is said by the `FileError`. OpenCV has a switch; the C libraries write to the
descriptor itself, which is pointed elsewhere for as long as a decoder works. That must not swallow what others write
meanwhile, so it is done only where nobody else can: the program has moved its own standard error to another descriptor
(as the command line does: `keep_stderr`), or no thread but this package's is there.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

__all__ = ["keep_stderr", "quiet_decoders"]

_STDERR = 2
_lock = threading.Lock()
_inside = 0  # threads that decode
_before: tuple[int, int | None] = (0, None)  # OpenCV's level; a copy of the descriptor if that points elsewhere now
_moved = False


def keep_stderr() -> None:
    """Move ``sys.stderr`` to a descriptor of its own, so that decoders can be silenced while others write.

    For programs, at their start; nothing happens where ``sys.stderr`` is not the standard one.
    """
    global _moved
    try:
        if sys.stderr.fileno() != _STDERR:
            return
        stream = open(os.dup(_STDERR), "w", buffering=1, encoding=sys.stderr.encoding, errors="backslashreplace")
    except (AttributeError, OSError, ValueError):  # there is none, or it is no file
        return
    sys.stderr = stream
    _moved = True


@contextmanager
def quiet_decoders() -> Iterator[None]:
    """Silence decoders for the length of a ``with`` block, in which nothing but a decoder is called."""
    global _inside, _before
    with _lock:
        if _inside == 0:
            level = cv2.utils.logging.getLogLevel()
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            _before = level, _point_elsewhere() if _alone() else None
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                level, saved = _before
                cv2.utils.logging.setLogLevel(level)
                if saved is not None:
                    os.dup2(saved, _STDERR)
                    os.close(saved)


def _alone() -> bool:
    """Return whether nobody but decoders can write to the descriptor now."""
    this = threading.current_thread()
    return _moved or all(one is this or one.name.startswith("stereokit") for one in threading.enumerate())


def _point_elsewhere() -> int | None:
    """Point the descriptor at nothing and return a copy of what it was, None if there is none."""
    try:
        saved = os.dup(_STDERR)
    except OSError:
        return None
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, _STDERR)
    os.close(nowhere)
    return saved
