"""The one home of numba's flags.

Every kernel is compiled on first use for the types that it meets, kept in numba's disk cache, releases the
interpreter lock so that plain threads run it side by side, and divides as numpy does (no zero-division
exception inside loops). There is no ``fastmath``: results must not depend on the processor. There is no
``parallel=True`` either: kernels are serial over a range of rows or columns, and `stereokit.kernels.threads` runs
several of them at once, which is safe from any number of calling threads and compiles in half the time.

Numba files a compiled kernel under the name of its function and looks only at the file which that stands in, not
at the functions that are compiled into it. So each name carries a fingerprint of the whole package's source: after
an upgrade, or an edit anywhere, nothing stale is ever loaded.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

__all__ = ["FINGERPRINT", "inline", "kernel"]

F = TypeVar("F", bound=Callable[..., Any])


def _fingerprint() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


FINGERPRINT = _fingerprint()
"""A digest of the package's source: it changes with anything that a result may depend on."""


# Without numba's runtime (``_nrt``) no array is counted in and out of every helper, which costs more than the work of
# a pixel; for the same reason kernels cannot allocate: buffers come in as arguments.
_FLAGS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}


def kernel(function: F) -> F:
    """Compile `function` as a kernel that Python code calls."""
    function.__qualname__ = f"{function.__qualname__}_{FINGERPRINT}"
    compiled: F = numba.njit(cache=True, **_FLAGS)(function)
    return compiled


def inline(function: F) -> F:
    """Compile `function` as a helper that kernels call and that is always inlined into them."""
    compiled: F = numba.njit(forceinline=True, **_FLAGS)(function)
    return compiled
