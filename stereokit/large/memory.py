"""The memory of the process: its size, the free memory, and the bound that the user sets."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import psutil

from stereokit.errors import OptionError

__all__ = ["free_nbytes", "parse_memory", "resident_nbytes"]

_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12, "ki": 2**10, "mi": 2**20, "gi": 2**30, "ti": 2**40}
_MAX_NBYTES = 2**63


def parse_memory(memory: Any) -> int:
    """Return the bytes of a number or of a text such as ``"2GB"``, ``"1.5 GiB"``, ``"800M"``.

    Raises
    ------
    OptionError
        If it is neither.
    """
    original = memory
    if isinstance(memory, str):
        match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]*)?)\s*([kmgt]?i?)b?\s*", memory.lower())
        if match is not None and match[2] in _UNITS:
            memory = float(match[1]) * _UNITS[match[2]]
    if not isinstance(memory, bool) and isinstance(memory, (int, float, np.number)) and 0 < memory <= _MAX_NBYTES:
        return int(memory)
    raise OptionError(f"memory must be a number of bytes or such as '2GB', got {str(original)[:40]!r}")


def resident_nbytes() -> int:
    """Return the bytes of memory that the process occupies now."""
    return int(psutil.Process().memory_info().rss)


def free_nbytes() -> int:
    """Return the bytes that the machine could still give."""
    return int(psutil.virtual_memory().available)
