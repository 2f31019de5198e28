"""A grey pair at half size."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.images.gray import GrayPair
from stereokit.kernels.jit import kernel
from stereokit.kernels.threads import run, spans

__all__ = ["half_size", "halved", "reduced", "reduced_mask"]


def reduced(pair: GrayPair, step: int, threads: int = 1) -> GrayPair:
    """Return the pair at 1/`step` of its size, 1, 2 or 4: halved as often as that takes."""
    while step > 1:
        pair, step = half_size(pair, threads), step // 2
    return pair


def half_size(pair: GrayPair, threads: int = 1, *, tolerant: bool = False) -> GrayPair:
    """Return the pair at half size, ``(ceil(H/2), ceil(W/2))``: the mean of each 2x2 pixels, halves rounded up.

    Odd sizes are extended by their last row or column. A pixel is bad if one of its four is.

    Parameters
    ----------
    pair : GrayPair
    threads : int
        Threads to use.
    tolerant : bool
        A pixel is bad only if all of its four are: where a fifth of the pixels are bad here and there, half of those of
        the half size would be, and nearly all of the quarter.
    """
    shape = tuple(-(-length // 2) for length in pair.left.shape)
    bands = spans(shape[0], threads)
    tasks: list[Any] = []

    def shrink(image: NDArray[Any]) -> NDArray[Any]:
        out = np.empty(shape, image.dtype)
        tasks.extend(partial(_halve, image, y0, y1, out) for y0, y1 in bands)
        return out

    def shrink_mask(mask: NDArray[np.bool_] | None, whole: bool = False) -> NDArray[np.bool_] | None:
        if mask is None:
            return None
        out = np.empty(shape, np.bool_)
        tasks.extend(partial(_halve_mask, np.ascontiguousarray(mask), whole, y0, y1, out) for y0, y1 in bands)
        return out

    left, right = shrink(pair.left), shrink(pair.right)
    guide = left if pair.left.dtype == np.uint8 else shrink(pair.guide)
    half = replace(
        pair,
        left=left,
        right=right,
        guide=guide,
        left_bad=shrink_mask(pair.left_bad, tolerant),
        right_bad=shrink_mask(pair.right_bad, tolerant),
        left_blank=shrink_mask(pair.left_blank),
    )
    run(tasks, threads)
    return half


def halved(image: NDArray[Any], threads: int = 1) -> NDArray[Any]:
    """Return an image at half size, as `half_size` does it: (H, W) uint8 or uint16 -> (ceil(H/2), ceil(W/2))."""
    out = np.empty(tuple(-(-length // 2) for length in image.shape), image.dtype)
    image = np.ascontiguousarray(image)
    run([partial(_halve, image, y0, y1, out) for y0, y1 in spans(len(out), threads)], threads)
    return out


def reduced_mask(mask: NDArray[np.bool_] | None, step: int) -> NDArray[np.bool_] | None:
    """Return a mask at 1/`step` of its size, as `reduced` does it."""
    while step > 1 and mask is not None:
        out = np.empty(tuple(-(-length // 2) for length in mask.shape), np.bool_)
        _halve_mask(np.ascontiguousarray(mask), False, 0, out.shape[0], out)
        mask, step = out, step // 2
    return mask


@kernel
def _halve(image: NDArray[Any], y0: int, y1: int, out: NDArray[Any]) -> None:
    """Write rows y0..y1 of the image at half size."""
    height, width = image.shape
    two = np.uint32(2)
    for y in range(y0, y1):
        upper = image[2 * y]
        lower = image[min(2 * y + 1, height - 1)]
        row = out[y]
        for x in range(width // 2):
            four = np.uint32(upper[2 * x]) + np.uint32(upper[2 * x + 1])
            four += np.uint32(lower[2 * x]) + np.uint32(lower[2 * x + 1])
            row[x] = (four + two) >> two
        if width % 2 == 1:
            row[width // 2] = (np.uint32(upper[width - 1]) + np.uint32(lower[width - 1]) + np.uint32(1)) >> np.uint32(1)


@kernel
def _halve_mask(mask: NDArray[np.bool_], whole: bool, y0: int, y1: int, out: NDArray[np.bool_]) -> None:
    """Write rows y0..y1 of a mask at half size: where one of 2x2 pixels is True or, if `whole`, all are."""
    height, width = mask.shape
    for y in range(y0, y1):
        upper = mask[2 * y]
        lower = mask[min(2 * y + 1, height - 1)]
        row = out[y]
        for x in range(width // 2):
            if whole:
                row[x] = upper[2 * x] & upper[2 * x + 1] & lower[2 * x] & lower[2 * x + 1]
            else:
                row[x] = upper[2 * x] | upper[2 * x + 1] | lower[2 * x] | lower[2 * x + 1]
        if width % 2 == 1:
            above, below = upper[width - 1], lower[width - 1]
            row[width // 2] = above & below if whole else above | below
