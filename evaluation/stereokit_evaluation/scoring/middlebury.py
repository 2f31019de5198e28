"""The Middlebury stereo evaluation, version 3: errors of one pair, and the weighted average of its training table.

Source: the evaluation's development kit (``evaldisp``, as of January 2015; `vision.middlebury.edu/stereo/submit3`), the
description of its calibration files, and its table. The rules that are easy to miss:

* A pixel counts where its true disparity is known; with the mask "nonocc", where the mask is 255 too.
* Disparities are **not filled**. One that is infinite (here also: NaN) is *invalid*: it is no bad pixel of the column
  "bad", but of "total bad", bad and invalid together, by which dense results are ranked.
* Valid disparities are first clipped to 0 .. ``ndisp``, for methods that do not use the range.
* ``|e| > x`` is bad; the mean error is over valid pixels alone.
* Thresholds and errors are **pixels at full size**. A map at half or quarter size is enlarged by repeating each value
  2 or 4 times in both directions, times 2 or 4, and compared with the truth of full size. Against truth of its own
  size (the kit's "efficient" way) the threshold 1 becomes 0.5 or 0.25, and errors are multiplied by 2 or 4.
* Where the truth is of whole pixels (``isint=1``: Art, Computer, Teddy) valid disparities are rounded, half up.
* The table's average weighs PianoL, Playroom, Playtable, Shelves and Vintage by 0.5.

The kit gives no quantiles and no root mean square; the table does, and these are taken over valid pixels by the rule of
`stereokit_evaluation.scoring.measures.error_quantiles`. Sums are float64 here and float32 in the kit.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import InputError
from stereokit_evaluation.scoring.measures import QUANTILES, counted_pixels, error_quantiles

__all__ = ["FULL_WIDTHS", "THRESHOLDS", "WEIGHTS", "relative_size", "score_pair", "weighted_average"]

THRESHOLDS = (0.5, 1.0, 2.0, 4.0)
"""The x of the table's bad-x, pixels at full size."""
FULL_WIDTHS = {
    "Adirondack": 2880, "ArtL": 1390, "Jadeplant": 2632, "Motorcycle": 2964, "MotorcycleE": 2964, "Piano": 2820,
    "PianoL": 2820, "Pipes": 2940, "Playroom": 2800, "Playtable": 2720, "PlaytableP": 2720, "Recycle": 2880,
    "Shelves": 2952, "Teddy": 1800, "Vintage": 2912,
}  # fmt: skip
"""The 15 training pairs, with about the width of their full size, pixels: `relative_size` picks the nearest size."""
WEIGHTS = {
    name: 0.5 if name in ("PianoL", "Playroom", "Playtable", "Shelves", "Vintage") else 1.0 for name in FULL_WIDTHS
}
"""The training pairs' weights in the table's average."""


def relative_size(name: str, width: int) -> float:
    """Return the size of a pair as a share of its full size: 1, 0.5 or 0.25, and 1 for a pair that has no known width.

    Parameters
    ----------
    name : str
        The pair's name; folders before it do not count.
    width : int
        The width of its image, pixels.
    """
    full = FULL_WIDTHS.get(name.rpartition("/")[2])
    return 1.0 if full is None else min((1.0, 0.5, 0.25), key=lambda size: abs(np.log(width / (full * size))))


def score_pair(
    estimate: ArrayLike,
    truth: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    ndisp: float | None = None,
    integer: bool = False,
    size: float = 1.0,
) -> dict[str, float] | None:
    """Return the figures of one map; None where no pixel counts.

    Parameters
    ----------
    estimate : (H, W) array
        Pixels of its own size; infinite or NaN where invalid.
    truth : (H, W) array, or twice or four times as large in both directions
        True disparity, pixels of its own size; infinite or NaN where unknown.
    mask : array like `truth`, bool, optional
        The pixels that count ("nonocc": where the mask file is 255); all by default.
    ndisp : float, optional
        Largest valid disparity, pixels of the estimate; no limit by default.
    integer : bool
        The truth is of whole pixels.
    size : float
        The truth's size as a share of the full size: 1, 0.5 or 0.25.

    Returns
    -------
    dict of str to float
        ``pixels``; ``invalid``, ``bad-x``, ``total_bad-x`` in percent; ``avgerr``, ``rms``, ``a50``, ``a90``, ``a95``,
        ``a99`` in pixels at full size, infinite where no pixel is valid.

    Raises
    ------
    InputError
        If the sizes do not fit.
    """
    disparity, reference = np.asarray(estimate, np.float32), np.asarray(truth, np.float32)
    if disparity.ndim != 2 or reference.ndim != 2:
        raise InputError(f"estimate and truth must have shape (H, W), got {disparity.shape} and {reference.shape}")
    scale = reference.shape[1] // max(disparity.shape[1], 1)
    if scale not in (1, 2, 4) or tuple(scale * side for side in disparity.shape) != reference.shape:
        raise InputError(f"truth must be 1, 2 or 4 times as large as the map, {disparity.shape}, got {reference.shape}")
    counts = counted_pixels(reference, mask)
    pixels = int(np.count_nonzero(counts))
    if not pixels:
        return None
    large = disparity if scale == 1 else np.repeat(np.repeat(disparity, scale, axis=0), scale, axis=1)
    values = np.float32(scale) * large[counts]
    valid = np.isfinite(values)
    values = np.clip(values[valid], 0, None if ndisp is None else np.float32(scale * ndisp))
    if integer:
        values = np.trunc(values) + (values - np.trunc(values) >= 0.5)
    error = (np.abs(values - reference[counts][valid]) / np.float32(size)).astype(np.float32)
    invalid = pixels - int(error.size)
    bad = {x: int(np.count_nonzero(error > np.float32(x))) for x in THRESHOLDS}
    figures = {"pixels": float(pixels), "invalid": 100.0 * invalid / pixels}
    figures |= {f"bad-{x:g}": 100.0 * count / pixels for x, count in bad.items()}
    figures |= {f"total_bad-{x:g}": 100.0 * (count + invalid) / pixels for x, count in bad.items()}
    return figures | _spread(error)


def weighted_average(figures: Mapping[str, Mapping[str, float] | None]) -> dict[str, float] | None:
    """Return the table's average over training pairs, None if there is none of them.

    Parameters
    ----------
    figures : mapping
        Results of `score_pair` by the name of the pair; other pairs than those of `WEIGHTS` do not count.
    """
    short = {name.rpartition("/")[2]: values for name, values in figures.items()}
    rows = [(WEIGHTS[name], values) for name, values in short.items() if name in WEIGHTS and values is not None]
    if not rows:
        return None
    total = sum(weight for weight, _ in rows)
    return {key: sum(weight * values[key] for weight, values in rows) / total for key in rows[0][1] if key != "pixels"}


def _spread(error: NDArray[np.float32]) -> dict[str, float]:
    if not error.size:
        return dict.fromkeys(("avgerr", "rms", *(f"a{100 * q:g}" for q in QUANTILES)), np.inf)
    wide = error.astype(np.float64)
    quantiles = {f"a{100 * q:g}": value for q, value in zip(QUANTILES, error_quantiles(error), strict=True)}
    return {"avgerr": float(wide.mean()), "rms": float(np.sqrt(np.square(wide).mean())), **quantiles}
