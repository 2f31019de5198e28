"""The ETH3D two-view evaluation: errors of one pair, and the average of its table.

Source: its program, ``ETH3DTwoViewEvaluation`` (Galliani and Schöps, 2017; `github.com/ETH3D/two-view-evaluation`), and
Schöps et al., "A multi-view stereo benchmark with high-resolution images and multi-camera videos", CVPR 2017. The rules
that are easy to miss:

* A pixel counts where its true disparity is finite; for "non-occluded", where the mask is 255 too (128 is hidden from
  the right camera, 0 is unknown).
* Disparities are **not filled**. One that is NaN, infinite, or beyond the image's width to either side has no estimate:
  it lowers the *coverage* and counts for **nothing else**. A negative one is an estimate.
* All other figures are shares and means of the pixels that have an estimate, so a sparse map can look better than a
  dense one. Without any estimate bad-x are 100 % and the rest is infinite.
* The quantile of a share is a value of the sorted errors, without interpolation
  (`stereokit_evaluation.scoring.measures.error_quantiles`).
* The table's average gives each pair the same weight.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from stereokit.errors import InputError
from stereokit_evaluation.scoring.measures import QUANTILES, counted_pixels, error_quantiles

__all__ = ["THRESHOLDS", "average", "score_pair"]

THRESHOLDS = (0.5, 1.0, 2.0, 4.0)
"""The x of bad-x, pixels."""


def score_pair(estimate: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> dict[str, float] | None:
    """Return the figures of one map; None where no pixel counts.

    Parameters
    ----------
    estimate : (H, W) array
        Pixels; NaN or infinite where there is no estimate.
    truth : (H, W) array
        True disparity, pixels; NaN or infinite where unknown.
    mask : (H, W) bool array, optional
        The pixels that count ("non-occluded": where the mask file is 255); all by default.

    Returns
    -------
    dict of str to float
        ``pixels``; ``coverage`` and ``bad-x`` in percent; ``avgerr``, ``rms``, ``a50``, ``a90``, ``a95``, ``a99`` in
        pixels.

    Raises
    ------
    InputError
        If the sizes differ.
    """
    disparity, reference = np.asarray(estimate, np.float32), np.asarray(truth, np.float32)
    if disparity.ndim != 2 or disparity.shape != reference.shape:
        raise InputError(f"truth must have the size of the map, {disparity.shape}, got {reference.shape}")
    counts = counted_pixels(reference, mask)
    pixels = int(np.count_nonzero(counts))
    if not pixels:
        return None
    width = disparity.shape[1]
    values = disparity[counts]
    has_estimate = np.isfinite(values) & (np.abs(values) <= width)
    error = np.abs(values[has_estimate] - reference[counts][has_estimate])
    figures = {"pixels": float(pixels), "coverage": 100.0 * error.size / pixels}
    names = [f"a{100 * q:g}" for q in QUANTILES]
    if not error.size:
        figures |= {f"bad-{x:g}": 100.0 for x in THRESHOLDS}
        return figures | dict.fromkeys(("avgerr", "rms", *names), np.inf)
    figures |= {f"bad-{x:g}": 100.0 * int(np.count_nonzero(error > np.float32(x))) / error.size for x in THRESHOLDS}
    squares = (error * error).sum(dtype=np.float64)  # float32 products, float64 sum
    figures |= {"avgerr": float(error.sum(dtype=np.float64) / error.size), "rms": float(np.sqrt(squares / error.size))}
    return figures | dict(zip(names, error_quantiles(error), strict=True))


def average(figures: Mapping[str, Mapping[str, float] | None]) -> dict[str, float] | None:
    """Return the mean over pairs, None if there is none.

    Parameters
    ----------
    figures : mapping
        Results of `score_pair` by the name of the pair.
    """
    rows = [values for values in figures.values() if values is not None]
    return {key: sum(row[key] for row in rows) / len(rows) for key in rows[0] if key != "pixels"} if rows else None
