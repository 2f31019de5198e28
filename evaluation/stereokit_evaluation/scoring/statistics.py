"""Intervals and comparisons of figures that are quotients of sums over scenes: bootstrap and permutation.

A scene, not a pixel nor a pair, is what is drawn anew: the errors of neighbouring pixels, and of frames that follow one
another, depend on each other, and counting them as independent would make every difference look certain.

* The interval of a figure is the percentile interval of the bootstrap (Efron and Tibshirani, "An introduction to the
  bootstrap", 1993, chapter 13): scenes are drawn with replacement, sums are added over the draw and divided once.
* Two methods on the same scenes are compared by the figure's difference on each draw, so that what makes a scene hard
  for both cancels; and by a permutation test, in which the two methods exchange their sums on some scenes. Its p-value
  is the share of exchanges whose difference is at least as large; all are tried up to 2**14, and `_EXCHANGES` random
  ones beyond. With ``n`` scenes it cannot be below ``2 / 2**n``.

All draws come from a seed: the same sums give the same figures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import InputError

__all__ = ["DRAWS", "LEVEL", "Comparison", "Sums", "compare", "interval"]

DRAWS = 2000
"""Draws of the bootstrap."""
LEVEL = 0.95
"""The share of draws inside an interval."""

_EXCHANGES = 9999
_MOST_ENUMERATED = 14  # scenes


@dataclass(frozen=True, eq=False)
class Sums:
    """Numerators and denominators of a figure, one of each for a scene.

    Parameters
    ----------
    numerators, denominators : (N,) float
        Sums over a scene's pairs.
    factor : float
        Of the quotient: 100 for percent.
    root : bool
        The figure is the square root of the quotient.
    """

    numerators: NDArray[np.float64]
    denominators: NDArray[np.float64]
    factor: float = 1.0
    root: bool = False

    def __post_init__(self) -> None:
        for name in ("numerators", "denominators"):
            values = np.asarray(getattr(self, name), np.float64)
            if values.ndim != 1 or not np.isfinite(values).all():
                raise InputError(f"{name} must be a list of finite numbers, got {getattr(self, name)!r}")
            object.__setattr__(self, name, values)
        if self.numerators.shape != self.denominators.shape:
            raise InputError(
                f"denominators must be as many as numerators, {self.numerators.size}, got {self.denominators.size}"
            )

    def value(self, weights: ArrayLike = 1.0) -> NDArray[np.float64]:
        """Return the figure of weighted scenes, (...) for weights (..., N); NaN where the denominators add up to 0."""
        weights = np.broadcast_to(np.asarray(weights, np.float64), (*np.shape(weights)[:-1], self.numerators.size))
        return self._quotient(weights @ self.numerators, weights @ self.denominators)

    def _quotient(self, above: NDArray[np.float64], below: NDArray[np.float64]) -> NDArray[np.float64]:
        with np.errstate(divide="ignore", invalid="ignore"):
            quotient = self.factor * np.asarray(above) / np.asarray(below)
        quotient = np.where(np.asarray(below) > 0, quotient, np.nan)
        return np.sqrt(quotient) if self.root else quotient


@dataclass(frozen=True)
class Comparison:
    """The difference of a figure between two methods, first minus second.

    Attributes
    ----------
    difference : float
        In the figure's unit.
    low, high : float or None
        The bootstrap interval, None with fewer than two scenes.
    p : float or None
        Of the permutation test, None with fewer than two scenes.
    scenes : int
        Scenes that have such pixels.
    """

    difference: float
    low: float | None
    high: float | None
    p: float | None
    scenes: int


def interval(sums: Sums, *, draws: int = DRAWS, level: float = LEVEL, seed: int = 0) -> tuple[float, float] | None:
    """Return the ends of the bootstrap interval of a figure, None with fewer than two scenes.

    Parameters
    ----------
    sums : Sums
    draws : int
        Draws of the bootstrap.
    level : float
        The share of draws inside the interval.
    seed : int
    """
    sums = _with_pixels(sums)
    if sums.numerators.size < 2:
        return None
    return _ends(sums.value(_draws(sums.numerators.size, draws, seed)), level)


def compare(first: Sums, second: Sums, *, draws: int = DRAWS, level: float = LEVEL, seed: int = 0) -> Comparison | None:
    """Return the difference of two methods on the same scenes, None where there are no pixels.

    Parameters
    ----------
    first, second : Sums
        Of the same scenes in the same order.
    draws, level, seed
        As in `interval`.

    Raises
    ------
    InputError
        If the numbers of scenes differ.
    """
    if first.numerators.size != second.numerators.size:
        raise InputError(f"second must have as many scenes as first, {first.numerators.size}, got "
                         f"{second.numerators.size}")  # fmt: skip
    used = (first.denominators > 0) & (second.denominators > 0)
    first, second = _subset(first, used), _subset(second, used)
    scenes = int(first.numerators.size)
    if not scenes:
        return None
    difference = float(first.value() - second.value())
    if scenes < 2:
        return Comparison(difference, None, None, None, scenes)
    weights = _draws(scenes, draws, seed)
    low, high = _ends(first.value(weights) - second.value(weights), level)
    return Comparison(difference, low, high, _p_value(first, second, difference, seed), scenes)


def _p_value(first: Sums, second: Sums, difference: float, seed: int) -> float:
    """Return the share of exchanges of the two methods, scene by scene, whose difference is at least as large."""
    scenes = first.numerators.size
    swap = _exchanges(scenes, seed)

    def value(one: Sums, other: Sums) -> NDArray[np.float64]:
        above = one.numerators.sum() + swap @ (other.numerators - one.numerators)
        below = one.denominators.sum() + swap @ (other.denominators - one.denominators)
        return one._quotient(above, below)

    differences = np.abs(value(first, second) - value(second, first))
    larger = int(np.count_nonzero(differences >= abs(difference) * (1 - 1e-9) - 1e-12))
    return larger / len(swap) if scenes <= _MOST_ENUMERATED else (1 + larger) / (1 + len(swap))


@lru_cache(maxsize=8)
def _exchanges(scenes: int, seed: int) -> NDArray[np.float64]:
    """Return which scenes are exchanged, 0 or 1, (exchanges, scenes)."""
    if scenes <= _MOST_ENUMERATED:
        return ((np.arange(2**scenes)[:, None] >> np.arange(scenes)) & 1).astype(np.float64)
    return np.random.default_rng(seed).integers(0, 2, (_EXCHANGES, scenes)).astype(np.float64)


@lru_cache(maxsize=8)
def _draws(scenes: int, draws: int, seed: int) -> NDArray[np.float64]:
    """Return how often each scene is in each draw, (draws, scenes)."""
    places = np.random.default_rng(seed).integers(0, scenes, (draws, scenes))
    counts = np.zeros((draws, scenes))
    np.add.at(counts, (np.arange(draws)[:, None], places), 1.0)
    return counts


def _ends(values: NDArray[np.float64], level: float) -> tuple[float, float]:
    low, high = np.quantile(values[np.isfinite(values)], [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def _with_pixels(sums: Sums) -> Sums:
    return _subset(sums, sums.denominators > 0)


def _subset(sums: Sums, used: NDArray[np.bool_]) -> Sums:
    return Sums(sums.numerators[used], sums.denominators[used], sums.factor, sums.root)
