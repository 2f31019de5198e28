"""Grey values that are the same in every window: what `stereokit.images.gray.gray_pair` decides from the whole images.

Floating-point images are brought to 16 bits over the range of both images, 16-bit ones to the guide's 256 levels. A
window alone knows neither range; one pass over the images, a block of rows at a time, finds them first. Images of
8 bits need none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.images.gray import GrayPair, fill_bad, reduced, scale_guide, scale_to_16_bits, smooth, to_gray
from stereokit.large.sources import Source

__all__ = ["BLOCK_NBYTES", "Tone", "find_ranges", "find_tone", "read_pair"]

BLOCK_NBYTES = 2**22
"""About as many bytes of an image are read and turned grey at a time."""

Ranges = tuple[tuple[int, int], tuple[int, int]]

_KINDS = ((255, np.dtype(np.uint8)), (65535, np.dtype(np.uint16)))


@dataclass(frozen=True)
class Tone:
    """How both images become grey integers.

    Attributes
    ----------
    kind : numpy.dtype
        uint8 or uint16: of the result.
    whole : numpy.dtype or None
        Floats hold whole numbers and are cast to this before they go grey.
    scaled : bool
        Floats are brought from `low` .. `high` to 16 bits.
    low, high : float
        Range of the grey values of both images.
    """

    kind: np.dtype[Any]
    whole: np.dtype[Any] | None = None
    scaled: bool = False
    low: float = 0.0
    high: float = 0.0

    def apply(self, block: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return a block in grey and, if there are any, the mask of its pixels without evidence."""
        gray = to_gray(block if self.whole is None else block.astype(self.whole))
        bad = None
        if gray.dtype.kind == "f":
            missing = ~np.isfinite(gray)
            if missing.any():
                bad, gray = missing, fill_bad(gray, missing)
            if self.scaled and self.high > self.low:
                gray = scale_to_16_bits(np.clip(gray, self.low, self.high), self.low, self.high)
            elif self.scaled:
                gray = np.zeros_like(gray)
        return gray.astype(self.kind, copy=False), bad

    def guide(self, gray: NDArray[Any]) -> NDArray[np.uint8]:
        """Return grey values of `kind` in the guide's 256 levels."""
        if gray.dtype == np.uint8:
            return gray
        low, high = (0, 65535) if self.scaled else (int(self.low), int(self.high))
        return scale_guide(gray, low, high)


def find_tone(left: Source, right: Source) -> Tone:
    """Return what one pass over two images of one type tells."""
    eight, sixteen = _KINDS[0][1], _KINDS[1][1]
    if left.dtype == np.uint8:
        return Tone(eight)
    if left.dtype == np.uint16:
        low, high = _range(to_gray(block) for block in _blocks(left, right))
        return Tone(eight if high <= 255 else sixteen, low=low, high=high)
    whole = _whole(_blocks(left, right))
    if whole is not None:
        low, high = _range(to_gray(block.astype(whole)) for block in _blocks(left, right))
        return Tone(eight if high <= 255 else sixteen, whole, low=low, high=high)
    low, high = _range(_finite(block) for block in _blocks(left, right))
    after = _whole(_finite(block) for block in _blocks(left, right))  # whole but for pixels without evidence
    if after is not None:
        return Tone(eight if high <= 255 else sixteen, low=low, high=high)
    return Tone(sixteen if high > low else eight, scaled=True, low=low, high=high)


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
    return GrayPair(images[0], images[1], masks[0], masks[1], images[0] if guide is None else guide, ranges)


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


def _blocks(*sources: Source) -> Iterator[NDArray[Any]]:
    for source in sources:
        height, width = source.shape[:2]
        for top, bottom in _rows(source, 0, height, width):
            yield source.read(top, bottom, 0, width)


def _finite(block: NDArray[Any]) -> NDArray[Any]:
    gray = to_gray(block)
    missing = ~np.isfinite(gray)
    return fill_bad(gray, missing) if missing.any() else gray


def _range(blocks: Iterator[NDArray[Any]]) -> tuple[float, float]:
    low, high = np.inf, -np.inf
    for block in blocks:
        low, high = min(low, float(block.min())), max(high, float(block.max()))
    return low, high


def _whole(blocks: Iterator[NDArray[Any]]) -> np.dtype[Any] | None:
    """Return the smallest type that holds all values as whole numbers, None if there is none."""
    found = 0
    with np.errstate(invalid="ignore"):
        for block in blocks:
            while found < 2 and not (
                np.array_equal(block.astype(_KINDS[found][1]), block) and block.max() <= _KINDS[found][0]
            ):
                found += 1
            if found == 2:
                return None
    return _KINDS[found][1]
