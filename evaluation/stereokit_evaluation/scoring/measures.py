"""Error figures over sets of pixels: D1, bad-x, mean, root mean square, quantiles, density; by visibility and at edges.

All figures are of the filled map (`stereokit_evaluation.scoring.kitti.fill_background`), so that a method cannot gain
by leaving pixels out; the density says how many it measured. Counts and sums add up over pairs, and are divided once.
Quantiles do not add up: those of many pairs are the mean of the pairs' quantiles, as in the tables of Middlebury and
ETH3D.

The sets of pixels, of those that have ground truth:

* ``noc``: both cameras see them. ``all``: every one. ``occluded``: in ``all`` and not in ``noc``, of pairs that have
  both.
* ``main``: ``noc`` where a pair has it, else ``all``.
* ``edges``: in ``main``, and at most `NEAR` pixels (of the larger offset, row or column) from a discontinuity.

A discontinuity lies between two pixels with truth that are neighbours in a row or a column, or have up to
`GAP` - 1 pixels without truth between them, and whose disparities differ by more than `JUMP` pixels. Jump and window
are those of the discontinuity regions of Scharstein and Szeliski, "A taxonomy and evaluation of dense two-frame stereo
correspondence algorithms", IJCV 2002; the gap lets sparse laser truth have edges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import InputError
from stereokit_evaluation.scoring.kitti import THRESHOLDS, fill_background, outliers

__all__ = [
    "FIGURES",
    "GAP",
    "JUMP",
    "NEAR",
    "QUANTILES",
    "SETS",
    "Errors",
    "Figure",
    "Measures",
    "counted_pixels",
    "error_quantiles",
    "errors_of",
    "measure_map",
    "near_edges",
]

QUANTILES = (0.5, 0.9, 0.95, 0.99)
"""The shares of the quantiles A50, A90, A95 and A99."""
NEAR, JUMP, GAP = 4, 2.0, 3
"""Reach of an edge, pixels; smallest jump of a discontinuity, pixels; largest distance of its two pixels."""
SETS = ("main", "noc", "all", "occluded", "edges")
"""The sets of pixels."""


@dataclass(frozen=True)
class Errors:
    """Counts and sums over one set of pixels of one or many pairs; they add up.

    Parameters
    ----------
    pixels : int
        Pixels with ground truth.
    measured : int
        Of these, those that the matcher measured.
    outliers : int
        D1 errors (`stereokit_evaluation.scoring.kitti.outliers`).
    bad : tuple of int
        Errors above each of `THRESHOLDS`.
    error_sum, square_sum : float
        Sums of ``|e|`` and ``e**2``, pixels and square pixels (float64).
    pairs : int
        Pairs with such pixels.
    quantile_sums : tuple of float
        The quantiles of `QUANTILES`, added up over pairs.
    """

    pixels: int = 0
    measured: int = 0
    outliers: int = 0
    bad: tuple[int, ...] = (0,) * len(THRESHOLDS)
    error_sum: float = 0.0
    square_sum: float = 0.0
    pairs: int = 0
    quantile_sums: tuple[float, ...] = (0.0,) * len(QUANTILES)

    def __add__(self, other: Errors) -> Errors:
        return Errors(
            self.pixels + other.pixels,
            self.measured + other.measured,
            self.outliers + other.outliers,
            tuple(a + b for a, b in zip(self.bad, other.bad, strict=True)),
            self.error_sum + other.error_sum,
            self.square_sum + other.square_sum,
            self.pairs + other.pairs,
            tuple(a + b for a, b in zip(self.quantile_sums, other.quantile_sums, strict=True)),
        )

    def figure(self, name: str) -> float | None:
        """Return one of `FIGURES`, None without ground truth."""
        return FIGURES[name].value(self)

    def figures(self) -> dict[str, float | None]:
        """Return all of `FIGURES`."""
        return {name: figure.value(self) for name, figure in FIGURES.items()}


@dataclass(frozen=True)
class Figure:
    """A figure that is a quotient of two sums: its value, unit and direction.

    Attributes
    ----------
    numerator, denominator : callable
        Of `Errors`.
    unit : {"%", "px"}
    root : bool
        The square root of the quotient is the figure.
    lower_is_better : bool
    """

    numerator: Callable[[Errors], float]
    denominator: Callable[[Errors], float]
    unit: str = "px"
    root: bool = False
    lower_is_better: bool = True

    def value(self, errors: Errors) -> float | None:
        """Return the figure in its unit, None where the denominator is 0."""
        below = self.denominator(errors)
        if not below:
            return None
        quotient = self.factor * self.numerator(errors) / below
        return float(np.sqrt(quotient)) if self.root else float(quotient)

    @property
    def factor(self) -> float:
        """100 for a percentage."""
        return 100.0 if self.unit == "%" else 1.0


def _pixels(errors: Errors) -> float:
    return errors.pixels


def _pairs(errors: Errors) -> float:
    return errors.pairs


def _bad(index: int) -> Callable[[Errors], float]:
    return lambda errors: errors.bad[index]


def _quantile(index: int) -> Callable[[Errors], float]:
    return lambda errors: errors.quantile_sums[index]


FIGURES: dict[str, Figure] = {
    "d1": Figure(lambda errors: errors.outliers, _pixels, "%"),
    **{f"bad-{x:g}": Figure(_bad(index), _pixels, "%") for index, x in enumerate(THRESHOLDS)},
    "epe": Figure(lambda errors: errors.error_sum, _pixels),
    "rmse": Figure(lambda errors: errors.square_sum, _pixels, root=True),
    **{f"a{100 * q:g}": Figure(_quantile(index), _pairs) for index, q in enumerate(QUANTILES)},
    "density": Figure(lambda errors: errors.measured, _pixels, "%", lower_is_better=False),
}
"""The figures by name: ``"d1"``, ``"bad-2"``, ``"epe"``, ``"rmse"``, ``"a90"``, ``"density"`` and others."""


@dataclass(frozen=True)
class Measures:
    """The errors of one or many maps by set of pixels (see the module); ``sum(all_measures, Measures())`` pools."""

    main: Errors = field(default_factory=Errors)
    noc: Errors = field(default_factory=Errors)
    all: Errors = field(default_factory=Errors)
    occluded: Errors = field(default_factory=Errors)
    edges: Errors = field(default_factory=Errors)

    def __add__(self, other: Measures) -> Measures:
        return Measures(*(getattr(self, name) + getattr(other, name) for name in SETS))


def counted_pixels(truth: NDArray[np.float32], mask: ArrayLike | None) -> NDArray[np.bool_]:
    """Return where there is truth and a mask does not exclude a pixel: (H, W) bool.

    Parameters
    ----------
    truth : (H, W) float32, pixels, not finite where unknown
    mask : (H, W) or None
        Not 0 where a pixel counts; None for all.

    Raises
    ------
    InputError
        If the mask has another size.
    """
    counts: NDArray[np.bool_] = np.isfinite(truth)
    if mask is not None:
        chosen = np.asarray(mask)
        if chosen.shape != truth.shape:
            raise InputError(f"mask must have the size of the truth, {truth.shape}, got {chosen.shape}")
        counts &= chosen.astype(bool)
    return counts


def error_quantiles(errors: NDArray[np.float32]) -> tuple[float, ...]:
    """Return the quantiles of `QUANTILES` of absolute errors, as ETH3D's program defines them.

    The quantile of a share ``q`` of ``n`` errors is the one at place ``floor(n * q)`` of the sorted errors, counted
    from 0, with the product in float32; there is no interpolation.

    Parameters
    ----------
    errors : (N,) float32
        One at least.
    """
    size = errors.size
    places = [min(int(np.floor(np.float32(size) * np.float32(q))), size - 1) for q in QUANTILES]
    ordered = np.partition(errors, sorted(set(places)))
    return tuple(float(ordered[place]) for place in places)


def errors_of(error: NDArray[np.float32], truth: NDArray[np.float32], measured: NDArray[np.bool_]) -> Errors:
    """Return the counts of one pair's pixels.

    Parameters
    ----------
    error, truth : (N,) float32
        ``|estimate - truth|`` and the true disparity, pixels.
    measured : (N,) bool
    """
    if not error.size:
        return Errors()
    return Errors(
        pixels=int(error.size),
        measured=int(np.count_nonzero(measured)),
        outliers=int(np.count_nonzero(outliers(error, truth))),
        bad=tuple(int(np.count_nonzero(error > np.float32(x))) for x in THRESHOLDS),
        error_sum=float(error.sum(dtype=np.float64)),
        square_sum=float(np.square(error, dtype=np.float64).sum()),
        pairs=1,
        quantile_sums=error_quantiles(error),
    )


def measure_map(
    estimate: ArrayLike,
    *,
    noc: NDArray[np.float32] | None = None,
    occ: NDArray[np.float32] | None = None,
    measured: ArrayLike | None = None,
) -> Measures:
    """Return the errors of one map by set of pixels.

    Parameters
    ----------
    estimate : (H, W) array
        Pixels; NaN, infinite or negative where unknown, which is filled.
    noc, occ : (H, W) float32, optional
        True disparity of the pixels that both cameras see, and of all; unknown as in `estimate`.
    measured : (H, W) bool, optional
        Where `estimate` was measured; known pixels by default.

    Raises
    ------
    InputError
        If `estimate` is no map of numbers.
    """
    values = np.asarray(estimate)
    known = np.isfinite(values) & (values >= 0)
    filled = fill_background(values)
    filled = np.where(np.isfinite(filled) & (filled >= 0), filled, np.float32(-1.0))
    if measured is not None:
        known = known & np.asarray(measured).astype(bool)
    truths = {"noc": _known(noc, values.shape), "all": _known(occ, values.shape)}
    sets: dict[str, tuple[NDArray[np.float32], NDArray[np.bool_]]] = {
        name: (truth, where) for name, (truth, where) in truths.items() if truth is not None
    }
    seen = truths["noc"][1]
    if seen.any() and truths["all"][1].any():
        truth, where = sets["all"]
        sets["occluded"] = truth, where & ~seen
    main = sets.get("noc" if seen.any() else "all")
    if main is not None:
        sets["main"] = main
        whole = sets["all"][0] if truths["all"][1].any() else main[0]
        sets["edges"] = main[0], main[1] & near_edges(whole)

    def errors(name: str) -> Errors:
        if name not in sets:
            return Errors()
        truth, where = sets[name]
        return errors_of(np.abs(truth[where] - filled[where]), truth[where], known[where])

    return Measures(**{name: errors(name) for name in SETS})


def near_edges(truth: NDArray[np.float32], near: int = NEAR, jump: float = JUMP, gap: int = GAP) -> NDArray[np.bool_]:
    """Return the pixels that lie at most `near` pixels from a discontinuity of the true disparity (see the module).

    Parameters
    ----------
    truth : (H, W) float32
        Pixels; NaN, infinite or negative where unknown.
    near : int
        Largest offset, in rows and in columns, from one of the two pixels of a discontinuity.
    jump : float
        A discontinuity differs by more than this, pixels.
    gap : int
        Largest distance of its two pixels, 1 for neighbours.
    """
    known = np.isfinite(truth) & (truth >= 0)
    values = np.where(known, truth, np.float32(0))
    edge = np.zeros(truth.shape, np.uint8)
    if not edge.size:
        return edge.astype(bool)
    for rows, known_rows, marks in ((values, known, edge), (values.T, known.T, edge.T)):
        width = rows.shape[1]
        for step in range(1, min(gap, width - 1) + 1):
            pair = known_rows[:, :-step] & known_rows[:, step:]
            for between in range(1, step):
                pair &= ~known_rows[:, between : between + width - step]
            pair &= np.abs(rows[:, step:] - rows[:, :-step]) > np.float32(jump)
            marks[:, :-step] |= pair
            marks[:, step:] |= pair
    return np.asarray(cv2.dilate(edge, np.ones((2 * near + 1, 2 * near + 1), np.uint8)) > 0)


def _known(
    truth: NDArray[np.float32] | None, shape: tuple[int, ...]
) -> tuple[NDArray[np.float32] | Any, NDArray[np.bool_]]:
    if truth is None:
        return None, np.zeros(shape, bool)
    return truth, np.isfinite(truth) & (truth >= 0)
