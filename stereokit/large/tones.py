"""Grey values that are the same in every window: what `stereokit.images.gray.gray_pair` decides from the whole images.

Floating-point images are brought to 16 bits over the range of both images, 16-bit ones to the guide's 256 levels. A
window alone knows neither range; passes over the images, a block of rows at a time, find them first. Images of 8 bits
need none.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.images.gray import GrayPair
from stereokit.images.intensity import Tone, find_tone
from stereokit.images.resize import reduced, smooth
from stereokit.large.sources import Source

__all__ = ["BLOCK_NBYTES", "Ranges", "find_ranges", "read_pair", "tone_of"]

BLOCK_NBYTES = 2**22
"""About as many bytes of an image are read and turned grey at a time."""

Ranges = tuple[tuple[int, int], tuple[int, int]]


def tone_of(left: Source, right: Source, nodata: float | None = None) -> Tone:
    """Return how two images of one type become grey integers: what a few passes over them tell."""
    return find_tone(lambda: _blocks(left, right), left.dtype, left.shape, nodata)


def read_pair(
    left: Source, right: Source, tone: Tone, window: tuple[int, int, int, int], ranges: Ranges | None = None
) -> GrayPair:
    """Return rows y0 to y1 and columns x0 to x1 of both images as the matcher takes them.

    Parameters
    ----------
    left, right : Source
    tone : Tone
    window : tuple of int
        y0, y1, x0, x1.
    ranges : ((int, int), (int, int)) or None
        What `find_ranges` found, if it is needed.
    """
    y0, y1, x0, x1 = window
    shape = y1 - y0, x1 - x0
    images, masks = [], []
    guide = np.empty(shape, np.uint8) if tone.kind != np.uint8 else None
    for source in (left, right):
        image = np.empty(shape, tone.kind)
        mask: NDArray[np.bool_] | None = None
        for top, bottom in _rows(source, y0, y1, x1 - x0):
            rows = slice(top - y0, bottom - y0)
            image[rows], bad = tone.apply(source.read(top, bottom, x0, x1))
            if bad is not None:
                mask = np.zeros(shape, np.bool_) if mask is None else mask
                mask[rows] = bad
            if guide is not None and source is left:
                guide[rows] = tone.guide(image[rows])
        images.append(image)
        masks.append(mask)
    return GrayPair(images[0], images[1], masks[0], masks[1], images[0] if guide is None else guide, ranges, tone.span)


def find_ranges(left: Source, right: Source, tone: Tone, part: int, sigma: float, threads: int) -> Ranges:
    """Return the smallest and the largest value of either image as a cost sees it: in grey, halved, smoothed.

    Parameters
    ----------
    left, right : Source
    tone : Tone
    part : {1, 2, 4}
        Matching is at one over this of the size.
    sigma : float
        Standard deviation of the smoothing, pixels.
    threads : int
        Threads to use.
    """
    height, width = left.shape[:2]
    step = max(4, BLOCK_NBYTES // (16 * width) * 4)
    margin = max(2, part) * (int(4 * sigma) + 2)  # OpenCV's Gaussian ends at four sigma
    found: tuple[list[int], list[int]] = ([], [])
    for top in range(0, height, step):
        y0, y1 = max(top - margin, 0), min(top + step + margin, height)
        pair = read_pair(left, right, tone, (y0, y1, 0, width))
        pair = smooth(reduced(pair, part), sigma, threads=threads)
        kept = slice((top - y0) // part, -(-(min(top + step, height) - y0) // part))
        for values, image in zip(found, (pair.left, pair.right), strict=True):
            values += [int(image[kept].min()), int(image[kept].max())]
    lefts, rights = ((min(values), max(values)) for values in found)
    return lefts, rights


def _rows(source: Source, y0: int, y1: int, width: int) -> Iterator[tuple[int, int]]:
    """Yield spans of rows of about `BLOCK_NBYTES`, which end where tiles end."""
    step = source.row_step
    row_nbytes = width * source.dtype.itemsize * (source.shape[2] if len(source.shape) == 3 else 1)
    count = max(step, BLOCK_NBYTES // max(row_nbytes, 1) // step * step)
    top = y0
    while top < y1:
        bottom = min((top // step) * step + count, y1)
        yield top, bottom
        top = bottom


def _blocks(*sources: Source) -> Iterator[tuple[int, NDArray[Any]]]:
    for source in sources:
        height, width = source.shape[:2]
        for top, bottom in _rows(source, 0, height, width):
            yield top, source.read(top, bottom, 0, width)
