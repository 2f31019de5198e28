"""The KITTI 2015 stereo evaluation, pixel for pixel, and the bad-x and end-point errors.

Source: the official development kit, ``evaluate_scene_flow.cpp`` (`disparityErrorsOutlier`) and ``io_disp.h``
(`interpolateBackground`, `readDisparityMap`, `writeDisparityMap`); Menze and Geiger, "Object scene flow for
autonomous vehicles", CVPR 2015. Four of its details are easy to miss and are reproduced:

* Errors are **pooled**: pixel counts are added over all images and divided once. So a score is a record of
  counts that can be added, and percentages appear only at the end.
* ``|e| / gt`` is a float32 quotient that is compared with the float64 number 0.05. A quotient of exactly 5 %
  rounds to the float32 next to 0.05, which is larger: such a pixel **is** an error when ``|e| > 3``.
  Comparing in float32, or dividing in float64, would call it correct. ``|e| = 3`` is exact and is never an
  error.
* The fill extends columns only above the first and below the last filled row. An empty row between two filled
  ones stays empty, and an empty pixel is compared as the disparity -1, the mark of the development kit.
* A disparity is valid where it is ``>= 0``; 0 itself is a measurement in memory and becomes 1/256 in a file.

Infinite and NaN values count as unknown here; the development kit cannot meet them, as it reads 16-bit files.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import InputError, OptionError

__all__ = [
    "D1_PIXELS",
    "D1_SHARE",
    "THRESHOLDS",
    "Counts",
    "Regions",
    "Score",
    "Tally",
    "as_written",
    "fill_background",
    "outliers",
    "score",
    "tally",
]

D1_PIXELS = 3.0
"""A D1 error is larger than this, in pixels (``ABS_THRESH``)."""
D1_SHARE = 0.05
"""and larger than this share of the true disparity (``REL_THRESH``)."""
THRESHOLDS = (0.5, 1.0, 2.0, 3.0, 4.0)
"""The x of bad-x, in pixels; bad-3 is the KITTI 2012 measure."""

_NO_BAD = (0,) * len(THRESHOLDS)
_EMPTY = np.float32(-1.0)


@dataclass(frozen=True)
class Tally:
    """Counts over one set of ground-truth pixels; tallies add up, over images or regions.

    Parameters
    ----------
    pixels : int
        Pixels with ground truth.
    outliers : int
        Of these, D1 errors.
    bad : tuple of int
        Of these, pixels with ``|e| > x``, for each x of `THRESHOLDS`.
    error_sum : float
        Sum of ``|e|`` in pixels (float64).
    """

    pixels: int = 0
    outliers: int = 0
    bad: tuple[int, ...] = _NO_BAD
    error_sum: float = 0.0

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.pixels + other.pixels,
            self.outliers + other.outliers,
            tuple(a + b for a, b in zip(self.bad, other.bad, strict=True)),
            self.error_sum + other.error_sum,
        )

    def d1(self) -> float | None:
        """Return the D1 error in percent, None without ground truth."""
        return 100.0 * self.outliers / self.pixels if self.pixels else None

    def bad_x(self, threshold: float) -> float | None:
        """Return the bad-x error in percent for one x of `THRESHOLDS`, None without ground truth."""
        if threshold not in THRESHOLDS:
            raise OptionError(f"threshold must be one of {THRESHOLDS}, got {threshold!r}")
        return 100.0 * self.bad[THRESHOLDS.index(threshold)] / self.pixels if self.pixels else None

    def epe(self) -> float | None:
        """Return the end-point error, the mean of ``|e|`` in pixels, None without ground truth."""
        return self.error_sum / self.pixels if self.pixels else None


@dataclass(frozen=True)
class Counts:
    """Two tallies of the same pixels: of the filled map, and of the measured pixels before the fill.

    Parameters
    ----------
    filled : Tally
        All ground-truth pixels, scored on the filled map (the figure of the KITTI table).
    measured : Tally
        Only those that the estimate had before the fill (the table's "est" variant).
    """

    filled: Tally = Tally()
    measured: Tally = Tally()

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.filled + other.filled, self.measured + other.measured)

    def density(self) -> float | None:
        """Return the share of ground-truth pixels that were measured, in percent, None without any."""
        return 100.0 * self.measured.pixels / self.filled.pixels if self.filled.pixels else None


@dataclass(frozen=True)
class Regions:
    """Counts against one ground truth: all pixels, and its background and foreground.

    `bg` and `fg` stay empty where no object map says which is which, so they may cover fewer images than
    `all`.
    """

    all: Counts = field(default_factory=Counts)
    bg: Counts = field(default_factory=Counts)
    fg: Counts = field(default_factory=Counts)

    def __add__(self, other: Regions) -> Regions:
        return Regions(self.all + other.all, self.bg + other.bg, self.fg + other.fg)


@dataclass(frozen=True)
class Score:
    """The scores of one or many images against both ground truths; ``sum(scores, Score())`` pools.

    Parameters
    ----------
    noc : Regions
        Against the pixels that both cameras see.
    occ : Regions
        Against all pixels ("All" in the KITTI table).
    """

    noc: Regions = field(default_factory=Regions)
    occ: Regions = field(default_factory=Regions)

    def __add__(self, other: Score) -> Score:
        return Score(self.noc + other.noc, self.occ + other.occ)

    @property
    def main(self) -> Counts:
        """The non-occluded counts, or the counts of all pixels where there are no others."""
        return self.noc.all if self.noc.all.filled.pixels else self.occ.all


def fill_background(disparity: ArrayLike) -> NDArray[np.float32]:
    """Fill unknown pixels as the development kit does before it scores (`interpolateBackground`).

    On each row a gap takes the smaller of the two values at its ends, and the outermost values extend to the
    image borders. Then each column extends its first value to the top and its last to the bottom.

    Parameters
    ----------
    disparity : (H, W) array
        Pixels; NaN, infinite or negative where unknown.

    Returns
    -------
    (H, W) float32
        Values are copied, never computed. NaN remains on empty rows between filled ones, and everywhere if no
        pixel was known.

    Raises
    ------
    InputError
        If `disparity` is not a two-dimensional array of numbers.
    """
    values = _as_map("disparity", disparity)
    known = _known(values)
    rows = np.flatnonzero(known.any(axis=1))
    out = np.full(values.shape, np.nan, np.float32)
    if not rows.size:
        return out
    width = values.shape[1]
    line = np.arange(width)
    before = np.maximum.accumulate(np.where(known, line, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, line, width)[:, ::-1], axis=1)[:, ::-1]
    known_values = np.where(known, values, np.float32(np.nan))
    left = np.where(before >= 0, np.take_along_axis(known_values, np.maximum(before, 0), axis=1), np.nan)
    right = np.where(after < width, np.take_along_axis(known_values, np.minimum(after, width - 1), axis=1), np.nan)
    out[:] = np.fmin(left, right)  # of two ends the smaller, of one end that one
    out[: rows[0]] = out[rows[0]]
    out[rows[-1] + 1 :] = out[rows[-1]]
    return out


def as_written(disparity: ArrayLike) -> NDArray[np.float32]:
    """Return a map after a round trip through the development kit's 16-bit PNG.

    A known value becomes ``floor(max(256 * d, 1)) / 256``: steps of 1/256 px, rounded down, and a value below
    1/256 px becomes 1/256, because 0 marks the unknown.

    Parameters
    ----------
    disparity : (H, W) array
        Pixels; NaN, infinite or negative where unknown.

    Returns
    -------
    (H, W) float32
        NaN where unknown.

    Raises
    ------
    InputError
        If `disparity` is no map, or has values of 256 px or more, beyond the format's range.
    """
    values = _as_map("disparity", disparity)
    known = _known(values)
    top = float(values[known].max()) if known.any() else 0.0
    if top >= 256.0:
        raise InputError(f"disparity must stay below 256 px for a 16-bit PNG, got {top:g}")
    steps = np.floor(np.maximum(values.astype(np.float64) * 256.0, 1.0, where=known, out=np.ones(values.shape)))
    return np.where(known, steps / 256.0, np.nan).astype(np.float32)


def outliers(error: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which pixels are D1 errors, with the rounding of the development kit.

    Parameters
    ----------
    error, truth : float32 arrays of one shape
        ``|estimate - truth|`` and the true disparity, pixels.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (error / np.abs(truth)).astype(np.float64)  # float32 quotient, float64 comparison
    bad: NDArray[np.bool_] = (error > np.float32(D1_PIXELS)) & (share > D1_SHARE)
    return bad


def tally(error: NDArray[np.float32], truth: NDArray[np.float32]) -> Tally:
    """Count the errors of a set of pixels.

    Parameters
    ----------
    error, truth : (N,) float32
        ``|estimate - truth|`` and the true disparity at the pixels that count, pixels.
    """
    return Tally(
        pixels=int(error.size),
        outliers=int(np.count_nonzero(outliers(error, truth))),
        bad=tuple(int(np.count_nonzero(error > np.float32(x))) for x in THRESHOLDS),
        error_sum=float(error.sum(dtype=np.float64)),
    )


def score(
    estimate: ArrayLike,
    *,
    noc: ArrayLike | None = None,
    occ: ArrayLike | None = None,
    objects: ArrayLike | None = None,
    measured: ArrayLike | None = None,
) -> Score:
    """Score one disparity map as the development kit does: fill it, then count errors by region.

    Parameters
    ----------
    estimate : (H, W) array
        Estimated disparity, pixels; NaN, infinite or negative where unknown. A dense map stays as it is.
    noc, occ : (H, W) array, optional
        True disparity of the pixels that both cameras see, and of all pixels; unknown as in `estimate`.
    objects : (H, W) array of integers, optional
        Object map: 0 is background, anything else foreground. Without it `bg` and `fg` stay empty.
    measured : (H, W) bool array, optional
        Where `estimate` was measured, for a map that its matcher filled already. Known pixels by default.

    Returns
    -------
    Score

    Raises
    ------
    InputError
        If a map is not two-dimensional or the sizes differ.
    """
    values = _as_map("estimate", estimate)
    known = _known(values)
    filled = values if known.all() else fill_background(values)
    if measured is not None:
        known = known & _same_size("measured", np.asarray(measured), values).astype(bool)
    fg = None if objects is None else _same_size("objects", np.asarray(objects), values) != 0
    # Pixels that even the fill leaves unknown are -1.
    filled = np.where(_known(filled), filled, _EMPTY)
    return Score(
        noc=_regions(filled, known, _truth("noc", noc, values), fg),
        occ=_regions(filled, known, _truth("occ", occ, values), fg),
    )


def _regions(
    filled: NDArray[np.float32],
    known: NDArray[np.bool_],
    truth: NDArray[np.float32] | None,
    fg: NDArray[np.bool_] | None,
) -> Regions:
    if truth is None:
        return Regions()
    has_truth = _known(truth)
    true_values, was_measured = truth[has_truth], known[has_truth]
    error = np.abs(true_values - filled[has_truth])

    def count(where: NDArray[np.bool_] | None) -> Counts:
        if where is None:
            return Counts(tally(error, true_values), tally(error[was_measured], true_values[was_measured]))
        both = where & was_measured
        return Counts(tally(error[where], true_values[where]), tally(error[both], true_values[both]))

    if fg is None:
        return Regions(all=count(None))
    is_foreground = fg[has_truth]
    return Regions(all=count(None), bg=count(~is_foreground), fg=count(is_foreground))


def _known(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.isfinite(disparity) & (disparity >= 0)


def _as_map(name: str, values: ArrayLike) -> NDArray[np.float32]:
    array = np.asarray(values)
    if array.ndim != 2:
        raise InputError(f"{name} must have shape (H, W), got {array.shape}")
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} must hold numbers, got {array.dtype}")
    return array.astype(np.float32, copy=False)


def _truth(name: str, values: ArrayLike | None, like: NDArray[Any]) -> NDArray[np.float32] | None:
    return None if values is None else _same_size(name, _as_map(name, values), like)


def _same_size(name: str, array: NDArray[Any], like: NDArray[Any]) -> NDArray[Any]:
    if array.shape != like.shape:
        raise InputError(f"{name} must have the size of the estimate, {like.shape}, got {array.shape}")
    return array
