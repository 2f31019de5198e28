"""Silence for decoders: OpenCV, libpng, libjpeg and FFmpeg write lines of their own to standard error.

The `FileError` reports a broken file already. OpenCV has a switch; the C libraries write to the descriptor itself,
which is redirected while a decoder works. That must not swallow lines of others, so it is done only where nobody else
can write: the program has moved its own standard error to another descriptor (as the command line does:
`keep_stderr`), or all threads are this package's.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2

__all__ = ["keep_stderr", "quiet_decoders"]

_STDERR = 2
_SILENT = 0
_log: Any = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging  # as OpenCV 4, and OpenCV 5, have it
_lock = threading.Lock()
_decoder_count = 0  # threads that decode
_saved_state: tuple[int, int | None] = (0, None)  # OpenCV's level; a copy of the descriptor if it is redirected
_is_stderr_moved = False


def keep_stderr() -> None:
    """Move ``sys.stderr`` to a descriptor of its own, so that decoders can be silenced while others write.

    For programs, at their start; nothing happens where ``sys.stderr`` is not the standard one.
    """
    global _is_stderr_moved
    try:
        if sys.stderr.fileno() != _STDERR:
            return
        stream = open(os.dup(_STDERR), "w", buffering=1, encoding=sys.stderr.encoding, errors="backslashreplace")
    except (AttributeError, OSError, ValueError):  # there is none, or it is no file
        return
    sys.stderr = stream
    _is_stderr_moved = True


@contextmanager
def quiet_decoders() -> Iterator[None]:
    """Silence decoders for a ``with`` block that calls nothing but a decoder."""
    global _decoder_count, _saved_state
    with _lock:
        if _decoder_count == 0:
            level = _log.getLogLevel()
            _log.setLogLevel(_SILENT)
            _saved_state = level, _redirect_stderr() if _can_redirect() else None
        _decoder_count += 1
    try:
        yield
    finally:
        with _lock:
            _decoder_count -= 1
            if _decoder_count == 0:
                level, descriptor = _saved_state
                _log.setLogLevel(level)
                if descriptor is not None:
                    os.dup2(descriptor, _STDERR)
                    os.close(descriptor)


def _can_redirect() -> bool:
    """Return whether only decoders can write to the descriptor now."""
    current = threading.current_thread()
    return _is_stderr_moved or all(
        thread is current or thread.name.startswith("stereokit") for thread in threading.enumerate()
    )


def _redirect_stderr() -> int | None:
    """Redirect standard error to the null device; return a copy of its descriptor, None if there is none."""
    try:
        copy = os.dup(_STDERR)
    except OSError:
        return None
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, _STDERR)
    os.close(null)
    return copy
