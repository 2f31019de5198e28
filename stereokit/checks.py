"""Signs that a pair is not rectified, not left and right, or out of the searched range: what `Matcher` warns of.

Good pairs have most of their pixels measured: 0.65 to 0.95 on KITTI and Middlebury. Pairs with exchanged views, rows
that lie some pixels apart or disparities out of range have few: there 0.03 to 0.23 with 64 levels and more. What agrees
by chance is more, the fewer levels there are: on noise up to 0.31 with 128 levels, 0.37 with 64, 0.43 with 32. Dark and
blank scenes have few too, so a low density is a warning and no error.

Where the density is low, or the map shows other signs (`stereokit.pairs.signs`: rows that are apart, values that crowd
at an end of the range or at 0), the pair is looked at closely (`stereokit.pairs.check`), which costs more than many a
match: a matcher does so at the first pair that looks wrong, the second, the fourth, and so on, so that a long sequence
from a bad rig costs little more than one from a good one. The signs take a quarter of a millisecond, which is much
beside the match of a small pair: of those one in several is looked at, the first always.
"""

from __future__ import annotations

import math
import threading

import numpy as np

from stereokit.images.gray import GrayPair
from stereokit.pairs.check import Fault, check_gray, same_pixels, unusable_fault
from stereokit.pairs.signs import MapSigns, map_signs
from stereokit.result import Disparity

__all__ = ["PairWatch", "density_fault", "min_density", "same_fault", "same_pixels"]

_MIN_DENSITY, _DENSITY_PER_HALVING, _MAX_MIN_DENSITY = 0.3, 0.05, 0.45
"""Density below which a map of 128 levels gets a warning; the increase per halving of the levels; and its bound."""
_FAR_ROWS, _VERY_FAR_ROWS = 0.45, 0.75
"""Pixels of row offset beyond which a pair is looked at closely, and beyond which it is told of in any case."""
_WIDE_SPREAD, _STEEP_TILT, _CROWD, _MOST = 0.47, 0.45, 0.04, 0.5
"""Other signs beyond which a pair is looked at closely: pixels of row offsets whatever their sign, and of their
difference across the image; share of the measured pixels at an end of the range, and without disparity. Of 360 good
pairs, some of them darkened or flipped, 17 have one."""
_HARDLY_ANY = 0.1
"""Density below which also a pair that looks right from close is told of."""
_CELLS_PER_LOOK = 6e6
"""Pixels times levels that are matched, in 5 milliseconds or more, between two looks at the rows."""


class PairWatch:
    """What looks wrong with the pairs that one matcher sees; may be used by many threads at the same time.

    Parameters
    ----------
    scale : float
        Size of the matching, of which its time depends.
    searched : int or None
        Levels that a pixel tries at most; None for all of the range.
    """

    def __init__(self, scale: float = 1.0, searched: int | None = None) -> None:
        self._scale, self._searched = scale, searched
        self._lock = threading.Lock()
        self._seen = 0  # pairs that looked wrong
        self._looked_right = False  # the last of those that was looked at closely
        self._cells = _CELLS_PER_LOOK  # matched since the last look at the rows

    def faults(self, pair: GrayPair, result: Disparity, min_disparity: int, max_disparity: int) -> list[Fault]:
        """Return the faults of a pair and its map, mostly one at most.

        Parameters
        ----------
        pair : GrayPair
        result : Disparity
        min_disparity, max_disparity : int
            Of the matcher, pixels.
        """
        usable = pair.left.size - (0 if pair.left_bad is None else int(np.count_nonzero(pair.left_bad)))
        if usable == 0:
            return [unusable_fault()]
        if same_pixels(pair.left, pair.right):
            return [same_fault()]
        density = np.count_nonzero(result.valid) / usable
        low = density_fault(density, min_disparity, max_disparity, self._searched)
        cells = pair.left.size * (max_disparity - min_disparity) * self._scale**3
        signs = None
        if low is None:
            if not self._is_due(cells):
                return []
            signs = map_signs(pair, result.disparity, result.valid, min_disparity, max_disparity)
            if not _look_wrong(signs, min_disparity):
                return []
        with self._lock:
            self._seen += 1
            closely = self._seen & (self._seen - 1) == 0
        if closely:
            report = check_gray(pair, min_disparity, max_disparity, quick=True)
            serious = [fault for fault in report.faults if fault.serious]
            self._looked_right = report.rows_known and not serious
            if serious:
                return serious
            if low is not None and report.faults:
                return [Fault("density", f"{_shown(density)}: {report.faults[0].message}")]
            if signs is not None and report.rows_known:
                return []
        if low is not None:
            if not self._looked_right:
                return [low]
            hint = "rows and range look right: is there too little light or texture?"
            return [Fault("sparse", f"{_shown(density)}, though {hint}")] if density < _HARDLY_ANY else []
        offset = None if signs is None else signs.offset
        if offset is None or abs(offset) <= _VERY_FAR_ROWS:
            return []
        side = "lower" if offset > 0 else "higher"
        shown = f"about {abs(offset):.1f} px {side}"
        return [Fault("rows", f"rows do not meet: the right view lies {shown}: rectify the pair, or see --align")]

    def _is_due(self, cells: float) -> bool:
        """Return whether enough was matched since the last look at the rows; count `cells` more."""
        with self._lock:
            due = self._cells + cells >= _CELLS_PER_LOOK
            self._cells = 0.0 if due else self._cells + cells
        return due


def min_density(levels: int) -> float:
    """Return the density below which a map of so many levels gets a warning."""
    return min(_MAX_MIN_DENSITY, _MIN_DENSITY + _DENSITY_PER_HALVING * max(0.0, math.log2(128 / levels)))


def same_fault() -> Fault:
    """Return the fault of a pair whose views have equal pixels."""
    return Fault("same", "left and right hold the same pixels: was one view given twice?")


def density_fault(
    density: float, min_disparity: int, max_disparity: int, searched: int | None = None
) -> Fault | None:  # fmt: skip
    """Return the fault of a map whose density is too low, None if it is not.

    Parameters
    ----------
    density : float
        The share of measured pixels.
    min_disparity, max_disparity : int
        Of the matcher, pixels.
    searched : int or None
        Levels that a pixel tries at most; None for all of the range.
    """
    levels = max_disparity - min_disparity
    if density >= min_density(levels if searched is None else min(levels, searched)):
        return None
    return Fault(
        "density",
        f"{_shown(density)}: are the views exchanged, their rows not aligned, "
        f"or disparities outside of {min_disparity} .. {max_disparity - 1}?",
    )


def _shown(density: float) -> str:
    percent = f"{100 * density:.1f}" if density < 0.1 else f"{100 * density:.0f}"
    return f"only {percent} % of the pixels could be measured"


def _look_wrong(signs: MapSigns, min_disparity: int) -> bool:
    """Return whether a map has a sign of a bad pair. That values crowd at 0 is none: the sky is there."""
    return (
        (signs.offset is not None and abs(signs.offset) > _FAR_ROWS)
        or signs.spread > _WIDE_SPREAD
        or signs.tilt > _STEEP_TILT
        or signs.high > _CROWD
        or (min_disparity != 0 and signs.low > _CROWD)
        or signs.still > _MOST
    )
