"""The contract of a refiner.

A refiner is built without arguments (``factory()``) and called with the half-size map and the full-size left image.
Packages announce theirs in the entry-point group ``stereokit.refiners``.
"""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

from stereokit.result import Disparity

__all__ = ["Refiner"]


class Refiner(Protocol):
    """Brings a half-size map to full size."""

    def __call__(self, coarse: Disparity, left: NDArray[Any]) -> Disparity:
        """Return the full-size map.

        Parameters
        ----------
        coarse : Disparity, (ceil(H/2), ceil(W/2))
            Map of the half-size pair, in half-size pixels, NaN where invalid.
        left : (H, W) uint8
            Left grey image at full size.

        Returns
        -------
        Disparity, (H, W)
            In full-size pixels.
        """
