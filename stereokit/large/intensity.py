"""Grey values that are the same in every window: the mapping of `stereokit.images.gray.gray_pair`, read in blocks.

Floating-point images are mapped to 16 bits over the range of both images, 16-bit ones to the guide's 256 levels. A
window alone has neither range; passes over the images, a block of rows at a time, find them first. Images of 8 bits
need none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.images.blur import smooth
from stereokit.images.evidence import joined, neutral, unusable
from stereokit.images.gray import GrayPair, gray_of
from stereokit.images.intensity import IntensityMapping, find_mapping
from stereokit.images.resize import reduced
from stereokit.large.border import BlackBorder
from stereokit.large.sources import Source

__all__ = ["BLOCK_NBYTES", "MaskedSource", "Ranges", "find_ranges", "intensity_mapping", "read_pair"]

BLOCK_NBYTES = 2**22
"""Approximate size of the blocks that are read and converted to grey, bytes."""

Ranges = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class MaskedSource:
    """An image, and which of its pixels are usable.

    Attributes
    ----------
    image : Source
    mask : Source or None
        Not 0 where a pixel is usable; None is everywhere.
    border : BlackBorder or None
        The black borders of the image; None if it has none.
    """

    image: Source
    mask: Source | None = None
    border: BlackBorder | None = None

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the image."""
        return self.image.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the image."""
        return self.image.shape

    def read(self, y0: int, y1: int, x0: int, x1: int) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return a window, and which of its pixels are masked or belong to a black border, None if none do."""
        block = self.image.read(y0, y1, x0, x1)
        usable = None if self.mask is None else self.mask.read(y0, y1, x0, x1) != 0
        border = None if self.border is None else self.border.window(y0, y1, x0, x1)
        excluded = joined(unusable(usable), border)
        return (block, None) if excluded is None else (neutral(block, ~excluded), excluded)


def intensity_mapping(left: MaskedSource, right: MaskedSource, nodata: float | None = None) -> IntensityMapping:
    """Return the mapping of two images of one type to grey integers, after a few passes over them."""
    return find_mapping(lambda: _blocks(left, right), left.dtype, left.shape, nodata)


def read_pair(
    left: MaskedSource,
    right: MaskedSource,
    mapping: IntensityMapping,
    window: tuple[int, int, int, int],
    ranges: Ranges | None = None,
) -> GrayPair:
    """Return rows y0 to y1 and columns x0 to x1 of both images as the matcher takes them.

    Parameters
    ----------
    left, right : MaskedSource
    mapping : IntensityMapping
    window : tuple of int
        y0, y1, x0, x1.
    ranges : ((int, int), (int, int)) or None
        The result of `find_ranges`, for costs that need it.
    """
    y0, y1, x0, x1 = window
    shape = y1 - y0, x1 - x0
    images, masks = [], []
    guide = np.empty(shape, np.uint8) if mapping.kind != np.uint8 else None
    for source in (left, right):
        image = np.empty(shape, mapping.kind)
        mask: NDArray[np.bool_] | None = None
        for top, bottom in _rows(source.image, y0, y1, x1 - x0):
            rows = slice(top - y0, bottom - y0)
            image[rows], bad = gray_of(mapping, *source.read(top, bottom, x0, x1))
            if bad is not None:
                mask = np.zeros(shape, np.bool_) if mask is None else mask
                mask[rows] = bad
            if guide is not None and source is left:
                guide[rows] = mapping.guide(image[rows])
        images.append(image)
        masks.append(mask)
    return GrayPair(
        images[0], images[1], masks[0], masks[1], images[0] if guide is None else guide, ranges, mapping.span
    )


def find_ranges(
    left: MaskedSource, right: MaskedSource, mapping: IntensityMapping, step: int, sigma: float, threads: int
) -> Ranges:
    """Return the smallest and the largest value of either image as a cost sees it: in grey, halved, smoothed.

    Parameters
    ----------
    left, right : MaskedSource
    mapping : IntensityMapping
    step : {1, 2, 4}
        Full-size pixels along a pixel of the matched size.
    sigma : float
        Standard deviation of the smoothing, pixels.
    threads : int
        Threads to use.
    """
    height, width = left.shape[:2]
    block_rows = max(4, BLOCK_NBYTES // (16 * width) * 4)
    margin = max(2, step) * (int(4 * sigma) + 2)  # OpenCV's Gaussian ends at four sigma
    extremes: tuple[list[int], list[int]] = ([], [])
    for top in range(0, height, block_rows):
        y0, y1 = max(top - margin, 0), min(top + block_rows + margin, height)
        pair = read_pair(left, right, mapping, (y0, y1, 0, width))
        pair = smooth(reduced(pair, step), sigma, threads=threads)
        rows = slice((top - y0) // step, -(-(min(top + block_rows, height) - y0) // step))
        for values, image in zip(extremes, (pair.left, pair.right), strict=True):
            values += [int(image[rows].min()), int(image[rows].max())]
    lefts, rights = ((min(values), max(values)) for values in extremes)
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


def _blocks(*sources: MaskedSource) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield the blocks of both images that have a usable pixel, or one black row."""
    usable = False
    for source in sources:
        height, width = source.shape[:2]
        for top, bottom in _rows(source.image, 0, height, width):
            block, excluded = source.read(top, bottom, 0, width)
            if excluded is None or not excluded.all():
                usable = True
                yield top, block
    if not usable:
        yield 0, np.zeros((1, *sources[0].shape[1:]), sources[0].dtype)
