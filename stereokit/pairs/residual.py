"""How far the rows of two views are apart, from a map that was measured: it needs no features, and a millisecond.

At up to two hundred measured pixels, those with the steepest slopes down the image, the right view is taken where the
map says, and the shift is looked for that makes it most like the left view: one step of Lucas and Kanade (1981) in both
directions. The median of the shifts down the rows is within a tenth of a pixel for offsets of up to a third of a pixel
(of up to one on streets and rooms), and short of larger ones where the texture is fine.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.images.gray import GrayPair

__all__ = ["row_residual"]

_CANDIDATES, _POINTS, _FEWEST = 2500, 200, 30
_HALF = 2  # of the windows, pixels
_SLOPE = 2.0  # grey levels of 256 a pixel that a point must have


def row_residual(pair: GrayPair, disparity: NDArray[np.float32], valid: NDArray[np.bool_]) -> float | None:
    """Return how much lower the right view shows what the map says is the same, pixels; None if too little tells.

    Parameters
    ----------
    pair : GrayPair
    disparity : (H, W) float32
        The left view's map, pixels.
    valid : (H, W) bool
        Where it was measured.
    """
    height, width = disparity.shape
    margin = _HALF + 1
    if min(height, width) <= 4 * margin:
        return None
    step = max(1, int(np.sqrt(height * width / _CANDIDATES)))
    y, x = (grid.ravel() for grid in np.mgrid[margin : height - margin : step, margin : width - margin : step])
    right_x = x - np.where(valid[y, x], disparity[y, x], np.float32(0))
    usable = valid[y, x] & (right_x >= margin) & (right_x < width - margin - 1)
    y, x, right_x = y[usable], x[usable], right_x[usable]
    scale = np.float32(1 if pair.left.dtype == np.uint8 else 255 / max(pair.span[1] - pair.span[0], 1))
    slope = np.abs(_values(pair.left, y + 1, x) - _values(pair.left, y - 1, x)) * (scale / 2)
    order = np.argsort(-slope, kind="stable")[:_POINTS]
    order = order[slope[order] > _SLOPE]
    if order.size < _FEWEST:
        return None
    y, x, right_x = y[order], x[order], right_x[order]
    dy, dx = (grid[None] for grid in np.mgrid[-margin : margin + 1, -margin : margin + 1])
    left = _values(pair.left, y[:, None, None] + dy, x[:, None, None] + dx)
    whole = np.floor(right_x).astype(np.int64)
    part = (right_x - whole).astype(np.float32)[:, None, None]
    rows, columns = y[:, None, None] + dy, whole[:, None, None] + dx
    right = (1 - part) * _values(pair.right, rows, columns) + part * _values(pair.right, rows, columns + 1)
    inner = np.s_[:, 1:-1, 1:-1]
    down = (left[:, 2:, 1:-1] - left[:, :-2, 1:-1] + right[:, 2:, 1:-1] - right[:, :-2, 1:-1]) / 4
    across = (left[:, 1:-1, 2:] - left[:, 1:-1, :-2] + right[:, 1:-1, 2:] - right[:, 1:-1, :-2]) / 4
    less = left[inner] - right[inner]
    less = less - less.mean(axis=(1, 2), keepdims=True)  # brightness may differ
    yy, xx, xy = (np.einsum("nij,nij->n", a, b) for a, b in ((down, down), (across, across), (down, across)))
    yt, xt = (np.einsum("nij,nij->n", slopes, less) for slopes in (down, across))
    determinant = yy * xx - xy * xy
    known = determinant > 0.02 * yy * yy
    if np.count_nonzero(known) < _FEWEST:
        known = yy > 0
    shift = np.where(known, (xx * yt - xy * xt) / np.maximum(determinant, 1e-6), yt / np.maximum(yy, 1e-6))
    return float(np.median(shift[known]))


def _values(image: NDArray[Any], y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float32]:
    return image[y, x].astype(np.float32)
