"""Whether there is a GPU: asked of the driver itself, so that asking imports nothing.

``stereokit info`` must not pay for numba.cuda on a machine without a GPU, and ``device="cuda"`` must say in one line
what is missing there. ``device="auto"`` does not ask: it is the CPU until the kernels have run on a GPU.
"""

from __future__ import annotations

import ctypes
import importlib.util
import sys
from functools import lru_cache
from typing import Any

from stereokit.errors import DeviceError

__all__ = ["describe", "has_device", "require_device"]


@lru_cache(maxsize=1)
def _driver() -> tuple[Any, str]:
    """Return the initialised driver library and an empty string, or None and why there is none."""
    try:
        library: Any = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return None, "no NVIDIA driver is installed"
    status = library.cuInit(0)
    count = ctypes.c_int(0)
    if status != 0 or library.cuDeviceGetCount(ctypes.byref(count)) != 0 or count.value < 1:
        return None, "the NVIDIA driver finds no GPU"
    return library, ""


def missing() -> str:
    """Return the words that say what ``device="cuda"`` lacks here; empty if nothing."""
    library, reason = _driver()
    if library is None:
        return reason
    if importlib.util.find_spec("numba_cuda") is None:
        return "numba-cuda is not installed"
    return ""


def has_device() -> bool:
    """Return whether ``device="cuda"`` can be used."""
    return not missing()


def require_device() -> None:
    """Raise DeviceError, with what is missing and what to do, unless ``device="cuda"`` can be used."""
    reason = missing()
    if reason:
        raise DeviceError(
            f"device 'cuda' cannot be used here: {reason}; it needs an NVIDIA GPU, its driver and "
            "pip install 'stereokit[cuda]'"
        )


def describe() -> str:
    """Return the first GPU's name and compute capability, or why none can be used."""
    reason = missing()
    if reason:
        return f"none ({reason})"
    library, _ = _driver()
    device = ctypes.c_int(0)
    library.cuDeviceGet(ctypes.byref(device), 0)
    name = ctypes.create_string_buffer(256)
    library.cuDeviceGetName(name, len(name), device)
    major, minor = ctypes.c_int(0), ctypes.c_int(0)
    library.cuDeviceGetAttribute(ctypes.byref(major), 75, device)  # compute capability
    library.cuDeviceGetAttribute(ctypes.byref(minor), 76, device)
    return f"{name.value.decode(errors='replace')}, compute capability {major.value}.{minor.value}"
