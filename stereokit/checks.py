"""Signs that a pair is not what it should be: rectified, left and right, and within the range that is searched.

Good pairs have most of their pixels measured: 0.65 to 0.95 on KITTI and Middlebury. Pairs with exchanged views, rows
that lie some pixels apart or disparities out of range have few: there 0.03 to 0.23 with 64 levels and more. What agrees
by chance is more, the fewer levels there are: on noise up to 0.31 with 128 levels, 0.37 with 64, 0.43 with 32. Dark and
blank scenes have few too, so a sign is a warning and no error.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stereokit.result import Disparity

__all__ = ["doubts", "doubts_about_density", "doubts_about_views", "low_density", "same_pixels"]

_LOW, _MORE, _MOST = 0.3, 0.05, 0.45
"""Density below which a map of 128 levels is doubted; what is added for each halving of them; and the highest bound."""


def low_density(levels: int) -> float:
    """Return the share of measured pixels below which a map of so many levels is doubted."""
    return min(_MOST, _LOW + _MORE * max(0.0, math.log2(128 / levels)))


def same_pixels(left: Any, right: Any) -> bool:
    """Return whether two images, or parts of images, hold the same pixels; their first rows mostly tell."""
    a, b = np.asarray(left), np.asarray(right)
    return a.shape == b.shape and bool(np.array_equal(a[:1], b[:1])) and bool(np.array_equal(a, b))


def doubts_about_views(same: bool) -> list[str]:
    """Return a line if the two views are the `same`."""
    return ["left and right hold the same pixels: was one view given twice?"] if same else []


def doubts_about_density(density: float, min_disparity: int, max_disparity: int) -> list[str]:
    """Return a line if too little was measured.

    Parameters
    ----------
    density : float
        The share of pixels that were measured.
    min_disparity, max_disparity : int
        Of the matcher, pixels.
    """
    if density >= low_density(max_disparity - min_disparity):
        return []
    shown = f"{100 * density:.1f}" if density < 0.1 else f"{100 * density:.0f}"
    return [
        f"only {shown} % of the pixels could be measured: are the views exchanged, their rows not aligned, "
        f"or disparities outside of {min_disparity} .. {max_disparity - 1}?"
    ]


def doubts(left: Any, right: Any, found: Disparity, min_disparity: int, max_disparity: int) -> list[str]:
    """Return what is to be doubted about a pair and its map, a line each.

    Parameters
    ----------
    left, right : array
        The images, as they were given.
    found : Disparity
    min_disparity, max_disparity : int
        Of the matcher, pixels.
    """
    views = doubts_about_views(same_pixels(left, right))
    return views or doubts_about_density(found.density, min_disparity, max_disparity)
