"""The exponential function in single IEEE operations: loops over it become vector code and are the same everywhere."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.kernels.jit import inline

__all__ = ["exponential"]


@inline
def exponential(x: Any) -> Any:
    """Return e**x of a ``float32`` to about 1e-6 of it, x held between -40 and 40.

    A polynomial times a power of two, which is made of its bits.
    """
    x = min(max(x, np.float32(-40)), np.float32(40)) * np.float32(1.4426950408889634)
    whole = np.floor(x + np.float32(0.5))
    z = (x - whole) * np.float32(0.6931471805599453)
    p = np.float32(1 / 720)
    p = p * z + np.float32(1 / 120)
    p = p * z + np.float32(1 / 24)
    p = p * z + np.float32(1 / 6)
    p = p * z + np.float32(0.5)
    p = p * z + np.float32(1)
    p = p * z + np.float32(1)
    return p * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)
