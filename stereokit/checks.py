"""Signs that a pair is not what it should be: rectified, left and right, and within the range that is searched.

Good pairs have most of their pixels measured (0.6 to 0.95), and pairs with exchanged views, rows that lie four pixels
apart or disparities out of range hardly any (0.02 to 0.2); dark and blank scenes have few too, so a sign is a warning
and no error.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.result import Disparity

__all__ = ["LOW_DENSITY", "doubts", "doubts_about_density", "doubts_about_views", "same_pixels"]

LOW_DENSITY = 0.25
"""Share of measured pixels below which a map is doubted."""


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
    if density >= LOW_DENSITY:
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
