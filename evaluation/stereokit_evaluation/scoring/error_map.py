"""The error maps of the KITTI benchmark: the error of each pixel of a disparity map in ten colours.

Source: ``io_disp.h`` (`errorImage` with logarithmic colours) and ``log_colormap.h`` of the KITTI 2015
development kit. The error is ``n = min(|e| / 3, 20 * |e| / gt)``, so that ``n > 1`` is a D1 error: blues are
correct, yellow to red are errors, and each colour spans a factor of two.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit.errors import InputError
from stereokit_evaluation.scoring.kitti import fill_background

__all__ = ["COLOURS", "EDGES", "error_map"]

EDGES = (0.0625, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""The normalised errors at which one colour ends and the next begins; an edge belongs to the upper colour."""
COLOURS = (
    (49, 54, 149),
    (69, 117, 180),
    (116, 173, 209),
    (171, 217, 233),
    (224, 243, 248),
    (254, 224, 144),
    (253, 174, 97),
    (244, 109, 67),
    (215, 48, 39),
    (165, 0, 38),
)
"""Red, green, blue of the ten colours, from no error to the largest."""


def error_map(
    estimate: ArrayLike,
    occ: ArrayLike,
    noc: ArrayLike | None = None,
    *,
    dilate: bool = True,
) -> NDArray[np.uint8]:
    """Draw the error of a disparity map where there is ground truth; the rest is black.

    Parameters
    ----------
    estimate : (H, W) array
        Estimated disparity, pixels; NaN, infinite or negative where unknown, filled as for scoring.
    occ : (H, W) array
        True disparity of all pixels; NaN, infinite or negative where unknown.
    noc : (H, W) array, optional
        True disparity of the pixels that both cameras see. Pixels of `occ` that it lacks are drawn at half
        brightness. None draws all at full brightness.
    dilate : bool
        Draw each ground-truth pixel as a 3x3 square, as the benchmark does, because sparse laser points are
        hard to see; later pixels, in reading order, lie on top, and the outermost pixels of the image start
        no square. False colours single pixels, all of them.

    Returns
    -------
    (H, W, 3) uint8
        RGB.

    Raises
    ------
    InputError
        If the sizes differ or a map is not two-dimensional.
    """
    filled = fill_background(estimate)
    truth = np.asarray(occ, np.float32)
    visible = truth if noc is None else np.asarray(noc, np.float32)
    for name, array in (("occ", truth), ("noc", visible)):
        if array.shape != filled.shape:
            raise InputError(f"{name} must have the size of the estimate, {filled.shape}, got {array.shape}")
    valid = np.isfinite(truth) & (truth >= 0)
    true_values = truth[valid]
    values = filled[valid]
    error = np.abs(np.where(np.isnan(values), np.float32(-1.0), values) - true_values).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        # 0 / 0 is no error: fmin takes the other, |e| / 3.
        normalised = np.fmin(error / 3.0, 20.0 * error / true_values).astype(np.float32)
    step = np.searchsorted(np.array(EDGES, np.float32), normalised, side="right")
    colour = np.array(COLOURS, np.uint8)[step]
    hidden = ~(np.isfinite(visible) & (visible >= 0))[valid]
    colour[hidden] //= 2
    picture = np.zeros((*filled.shape, 3), np.uint8)
    picture[valid] = colour
    return _dilated(picture, valid) if dilate else picture


def _dilated(picture: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Paint 3x3 squares; offsets run in reading order, so that the last of all neighbours stays on top."""
    height, width = valid.shape
    out = np.zeros_like(picture)
    if height < 3 or width < 3:
        return out
    centres, colours = valid[1:-1, 1:-1], picture[1:-1, 1:-1]
    # A centre further down or right is painted later; it reaches a pixel that lies up or left of it.
    for dy in (2, 1, 0):
        for dx in (2, 1, 0):
            out[dy : dy + height - 2, dx : dx + width - 2][centres] = colours[centres]
    return out
