"""The contract of a refiner.

A refiner is built by its factory (with options, if it is a dataclass that has some) and called with the half-size
map and the full-size left image. Packages announce theirs in the entry-point group ``stereokit.refiners``.
"""

from __future__ import annotations

from typing import Any, Protocol

from numpy.typing import NDArray

from stereokit.result import Disparity

__all__ = ["Refiner"]


class Refiner(Protocol):
    """Brings a half-size map to full size.

    One that looks at the matcher's confidence has an attribute ``needs_confidence`` that is True; others may leave it
    out. `stereokit.Matcher` then gives it a coarse map with ``confidence``.
    """

    def __call__(self, coarse: Disparity, left: NDArray[Any], *, threads: int = 1) -> Disparity:
        """Return the full-size map.

        Must be safe to call from several threads at once.

        Parameters
        ----------
        coarse : Disparity, (ceil(H/2), ceil(W/2))
            Map of the half-size pair, in half-size pixels, NaN where invalid.
        left : (H, W) uint8
            Left grey image at full size.
        threads : int
            How many threads this call may use; the result must not depend on it.

        Returns
        -------
        Disparity, (H, W)
            In full-size pixels, on arrays of its own.
        """
