"""Warnings about a pair: equal or exchanged views, rows that are not aligned, disparities out of range.

The sign is the density, the share of measured pixels. Good pairs have 0.65 to 0.95 on KITTI and Middlebury. Pairs with
exchanged views, rows that lie some pixels apart or disparities out of range have 0.03 to 0.23 with 64 levels and more.
Noise agrees by chance, the more the fewer levels there are: up to 0.31 with 128 levels, 0.37 with 64, 0.43 with 32.
Dark and blank scenes have a low density too, so it gives a warning and no error.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stereokit.result import Disparity

__all__ = ["density_warnings", "min_density", "pair_warnings", "same_pixels", "view_warnings"]

_MIN_DENSITY, _DENSITY_PER_HALVING, _MAX_MIN_DENSITY = 0.3, 0.05, 0.45
"""Least density of a map of 128 levels without a warning; its increase for each halving of the levels; its maximum."""


def min_density(levels: int) -> float:
    """Return the density below which a map of so many levels gets a warning."""
    return min(_MAX_MIN_DENSITY, _MIN_DENSITY + _DENSITY_PER_HALVING * max(0.0, math.log2(128 / levels)))


def same_pixels(left: Any, right: Any) -> bool:
    """Return whether two images, or parts of images, have equal pixels; mostly the first rows decide."""
    a, b = np.asarray(left), np.asarray(right)
    return a.shape == b.shape and bool(np.array_equal(a[:1], b[:1])) and bool(np.array_equal(a, b))


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


def pair_warnings(left: Any, right: Any, result: Disparity, min_disparity: int, max_disparity: int) -> list[str]:
    """Return the warnings about a pair and its map, a line each.

    Parameters
    ----------
    left, right : array
        The images, before any conversion.
    result : Disparity
    min_disparity, max_disparity : int
        Of the matcher, pixels.
    """
    views = view_warnings(same_pixels(left, right))
    return views or density_warnings(result.density, min_disparity, max_disparity)
