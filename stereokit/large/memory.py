"""How much memory the process has, may have, and a window will take."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stereokit.errors import OptionError
from stereokit.images.gray import GrayPair
from stereokit.kernels.workspace import Workspace

__all__ = ["free_nbytes", "parse_memory", "resident_nbytes", "window_model"]

_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12, "ki": 2**10, "mi": 2**20, "gi": 2**30, "ti": 2**40}
_PROBES = (256, 512)
"""Sides of the windows that are matched to see how buffers grow, pixels."""
_UNKNOWN_NBYTES = 400_000_000
"""What is taken for the process where the system does not tell."""


def parse_memory(memory: Any) -> int:
    """Return bytes given as a number or as text such as ``"2GB"``, ``"1.5 GiB"``, ``"800M"``.

    Raises
    ------
    OptionError
        If it is neither.
    """
    if isinstance(memory, str):
        found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]*)?)\s*([kmgt]?i?)b?\s*", memory.lower())
        if found is not None and found[2] in _UNITS:
            return int(float(found[1]) * _UNITS[found[2]])
    elif not isinstance(memory, bool) and isinstance(memory, (int, float, np.number)) and 0 < memory < float("inf"):
        return int(memory)
    raise OptionError(f"memory must be a number of bytes or such as '2GB', got {memory!r}")


def resident_nbytes() -> int:
    """Return the bytes of memory that the process occupies now."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):  # not on Linux
        return _UNKNOWN_NBYTES


def free_nbytes() -> int:
    """Return the bytes that the machine could still give, 4 GB where the system does not tell."""
    try:
        found = re.search(r"MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text())
    except OSError:
        found = None
    return 4 * 10**9 if found is None else 1024 * int(found[1])


def window_model(match: Callable[[GrayPair, Workspace], object], kind: Any) -> Callable[[int, int], float]:
    """Return how many bytes of buffers a window of a height and a width takes, from matching four small ones.

    Parameters
    ----------
    match : callable
        Matches a pair with buffers of a workspace.
    kind : dtype
        Of the grey images.
    """
    sizes = [(height, width) for height in _PROBES for width in _PROBES]
    held = []
    for height, width in sizes:
        image = (np.arange(height * width, dtype=np.uint32) * 2654435761 >> 16).astype(kind).reshape(height, width)
        guide = image.astype(np.uint8)
        workspace = Workspace()
        match(GrayPair(image, image, None, None, guide), workspace)
        held.append(workspace.nbytes)
    terms = np.array([(1, height, width, height * width) for height, width in sizes], float)
    factors = np.linalg.solve(terms, np.array(held, float))

    def needed(height: int, width: int) -> float:
        return float(factors @ (1, height, width, height * width))

    return needed
