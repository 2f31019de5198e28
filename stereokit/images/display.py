"""Grey levels for people: what an image of any type looks like in 8 bits, in clouds and in pages.

A camera of 12 bits leaves most of 16 unused, and one reflection outshines a floating-point image: so the range that is
shown is that of nearly all pixels, not that of the type or of the extremes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["to_display"]

_SHARES = 0.5, 99.5  # percentiles that become black and white
_MOST_SAMPLES = 1_000_000


def to_display(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return an image in 8 bits.

    Parameters
    ----------
    image : (H, W) or (H, W, 3), uint8, uint16 or float
        8 bits stay as they are.

    Returns
    -------
    uint8, of the same shape
        From the 0.5th to the 99.5th percentile of all finite values, the channels together; not finite is 0.
    """
    if image.dtype == np.uint8:
        return image
    known = np.isfinite(image)
    values = image[known]
    if values.size == 0:
        return np.zeros(image.shape, np.uint8)
    low, high = np.percentile(values[:: 1 + values.size // _MOST_SAMPLES].astype(np.float64), _SHARES)
    if high <= low:  # one level: white, or black if it is not positive
        low, high = min(low - 1, 0.0), max(low, 0.0)
    scaled = (np.where(known, image, low).astype(np.float64) - low) / (high - low)
    scaled[~known] = 0
    shown: NDArray[np.uint8] = np.rint(np.clip(scaled, 0, 1) * 255).astype(np.uint8)
    return shown
