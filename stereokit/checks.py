"""Signs that a pair is not rectified, not left and right, or out of the searched range: what `Matcher` warns of.

Good pairs have most of their pixels measured: 0.65 to 0.95 on KITTI and Middlebury. Pairs with exchanged views, rows
that lie some pixels apart or disparities out of range have few: there 0.03 to 0.23 with 64 levels and more. What agrees
by chance is more, the fewer levels there are: on noise up to 0.31 with 128 levels, 0.37 with 64, 0.43 with 32. Dark and
blank scenes have few too, so a low density is a warning and no error.

Where the density is low, or the rows at what was measured are apart (`stereokit.pairs.residual`), the pair is looked at
closely (`stereokit.pairs.check`), which costs more than many a match: a matcher does so at the first pair that looks
wrong, the second, the fourth, and so on, so that a long sequence from a bad rig costs little more than one from a good
one.
"""

from __future__ import annotations

import math
import threading

import numpy as np

from stereokit.images.gray import GrayPair
from stereokit.pairs.check import check_gray, same_pixels
from stereokit.pairs.residual import row_residual
from stereokit.result import Disparity

__all__ = ["PairWatch", "density_warnings", "min_density", "same_pixels", "view_warnings"]

_MIN_DENSITY, _DENSITY_PER_HALVING, _MAX_MIN_DENSITY = 0.3, 0.05, 0.45
"""Density below which a map of 128 levels gets a warning; the increase per halving of the levels; and its bound."""
_FAR_ROWS, _VERY_FAR_ROWS = 0.45, 0.75
"""Pixels of row offset beyond which a pair is looked at closely, and beyond which it is told of in any case."""


class PairWatch:
    """What looks wrong with the pairs that one matcher sees; may be used by many threads at the same time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen = 0  # pairs that looked wrong

    def warnings(self, pair: GrayPair, result: Disparity, min_disparity: int, max_disparity: int) -> list[str]:
        """Return the warnings about a pair and its map, a line each.

        Parameters
        ----------
        pair : GrayPair
        result : Disparity
        min_disparity, max_disparity : int
            Of the matcher, pixels.
        """
        usable = pair.left.size - (0 if pair.left_bad is None else int(np.count_nonzero(pair.left_bad)))
        if usable == 0:
            return ["no pixel is usable: mask, no-data value, alpha or black borders exclude them all"]
        if same_pixels(pair.left, pair.right):
            return view_warnings(True)
        density = np.count_nonzero(result.valid) / usable
        lines = density_warnings(density, min_disparity, max_disparity)
        residual = row_residual(pair, result.disparity, result.valid)
        apart = 0.0 if residual is None else abs(residual)
        if not lines and apart < _FAR_ROWS:
            return []
        with self._lock:
            self._seen += 1
            closely = self._seen & (self._seen - 1) == 0
        if closely:
            report = check_gray(pair, min_disparity, max_disparity, quick=True)
            serious = [fault.message for fault in report.faults if fault.serious]
            if serious:
                return serious
            if report.rows_known and not lines:
                return []
        if not lines and residual is not None and apart > _VERY_FAR_ROWS:
            side = "lower" if residual > 0 else "higher"
            lines = [
                f"rows do not meet: the right view lies about {apart:.1f} px {side}: rectify the pair, or see --align"
            ]
        return lines


def min_density(levels: int) -> float:
    """Return the density below which a map of so many levels gets a warning."""
    return min(_MAX_MIN_DENSITY, _MIN_DENSITY + _DENSITY_PER_HALVING * max(0.0, math.log2(128 / levels)))


def view_warnings(same: bool) -> list[str]:
    """Return a warning line if the two views are the `same`."""
    return ["left and right hold the same pixels: was one view given twice?"] if same else []


def density_warnings(density: float, min_disparity: int, max_disparity: int) -> list[str]:
    """Return a warning line if the density is too low.

    Parameters
    ----------
    density : float
        The share of measured pixels.
    min_disparity, max_disparity : int
        Of the matcher, pixels.
    """
    if density >= min_density(max_disparity - min_disparity):
        return []
    shown = f"{100 * density:.1f}" if density < 0.1 else f"{100 * density:.0f}"
    return [
        f"only {shown} % of the pixels could be measured: are the views exchanged, their rows not aligned, "
        f"or disparities outside of {min_disparity} .. {max_disparity - 1}?"
    ]
