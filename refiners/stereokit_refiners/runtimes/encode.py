"""What a network sees: the coarse map and the image as floating-point tensors of about unit size.

Two scales, by the network's output rule. Networks that correct a map see ``disparity / 16 - 1.5`` in full-size pixels
and ``4 * (grey / 255 - 0.4)``. The paper's form, whose output is the map itself, has both inputs scaled to [0, 1]:
``disparity / 256`` and ``grey / 255``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError

__all__ = ["BEGINNING", "base_of", "encode", "half_image"]

BEGINNING = 4.0
"""Where maps of the training begin at most, half-size pixels."""


def base_of(maps: Sequence[NDArray[np.float32]]) -> float:
    """Return what a network's maps are lowered by, whole half-size pixels, so that they begin as those of the training.

    Parameters
    ----------
    maps : sequence of (..., h, w) float32
        The coarse map, half-size pixels, and, if the network sees them, its candidates.

    Returns
    -------
    float
        Below zero, where a map goes below: its lowest value. Above zero, where the coarse map begins above
        `BEGINNING`: by as much. It begins where a hundredth of its pixels lies below, but for the columns at the left
        that lie outside the right view at the map's median: what stands there was not measured.
    """
    lowest = min(np.floor(one.min()) for one in maps)
    if lowest < 0:
        return float(lowest)
    values = maps[0]
    middle = np.partition(values, (values.size - 1) // 2, axis=None)[(values.size - 1) // 2]
    columns = np.arange(values.shape[1])
    seen = np.where(columns >= min(middle, values.shape[1] // 2), values, np.inf)
    first = np.partition(seen, values.size // 100, axis=None)[values.size // 100]
    return max(0.0, float(np.floor(first - BEGINNING)))


def half_image(left: NDArray[Any]) -> NDArray[np.float32]:
    """Return the mean of each 2x2 pixels of an image with even sides, (2h, 2w) -> (h, w) float32."""
    size = (left.shape[1] // 2, left.shape[0] // 2)
    halved = cv2.resize(left.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(halved, np.float32).reshape(size[1], size[0])


def encode(
    names: tuple[str, ...],
    unit: bool,
    disparity: NDArray[np.float32],
    left: NDArray[Any],
    confidence: NDArray[np.float32] | None = None,
    candidates: NDArray[np.float32] | None = None,
) -> dict[str, NDArray[np.float32]]:
    """Return a network's inputs.

    Parameters
    ----------
    names : tuple of str
        Which: "disparity", "image", "confidence", "candidates", "phases".
    unit : bool
        Whether inputs are scaled to [0, 1]: `stereokit_refiners.outputs.Output.unit_inputs`.
    disparity : (h, w) float32
        Coarse map in full-size pixels, without NaN.
    left : (2h, 2w) uint8 or float32
        Left image, grey levels 0 to 255.
    confidence : (h, w) float32 or None
        The matcher's confidence, 0 to 1, 0 where nothing was measured; None for networks that do not look at it.
    candidates : (2, h, w) float32 or None
        The matcher's candidates in full-size pixels; None for networks that do not look at them.

    Returns
    -------
    dict of (C, h, w) float32, C-contiguous
    """

    def gray(image: NDArray[Any]) -> NDArray[np.float32]:
        values = image.astype(np.float32) * np.float32(1 / 255)
        return values if unit else np.asarray((values - np.float32(0.4)) * np.float32(4), np.float32)

    def scaled(pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        values = pixels * np.float32(1 / 256) if unit else pixels * np.float32(1 / 16) - np.float32(1.5)
        return np.asarray(values, np.float32)

    makers: dict[str, Callable[[], NDArray[np.float32]]] = {
        "disparity": lambda: scaled(disparity),
        "candidates": lambda: scaled(_present("candidates", candidates)),
        "image": lambda: gray(half_image(left)),
        "confidence": lambda: _present("confidence", confidence) * np.float32(4) - np.float32(2),
        "phases": lambda: np.stack([gray(left[i::2, j::2]) for i in (0, 1) for j in (0, 1)]),
    }
    return {
        name: np.ascontiguousarray(makers[name]().reshape(-1, *disparity.shape), dtype=np.float32) for name in names
    }


def _present(name: str, map: NDArray[np.float32] | None) -> NDArray[np.float32]:
    if map is None:
        raise OptionError(f"coarse must come with {name} for this refiner, as stereokit.Matcher gives it, got none")
    return map
