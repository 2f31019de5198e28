"""Black borders of images that are read in blocks: those of `stereokit.images.evidence.black_border`, pixel by pixel.

Whether a black pixel belongs to a border depends on the whole image. So components are labelled block by block and
joined at the seams (union-find), and a second pass keeps the runs of those that are borders. An image without a black
pixel at its sides, as most are, is only read at its sides.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.images.evidence import SMALLEST_BORDER, THICK
from stereokit.large.sources import Source

__all__ = ["BlackBorder", "find_border"]

_LABEL_NBYTES = 32
"""Memory that labels take, bytes per pixel."""


@dataclass(frozen=True, eq=False)
class BlackBorder:
    """The pixels of the black borders of an image, as runs.

    Attributes
    ----------
    first : (H + 1,) int64
        Index of the first run of each row, and the number of runs.
    runs : (N, 2) int32
        First column of a run, and the first behind it.
    """

    first: NDArray[np.int64]
    runs: NDArray[np.int32]

    def window(self, y0: int, y1: int, x0: int, x1: int) -> NDArray[np.bool_] | None:
        """Return which pixels of a window belong to a border, (y1 - y0, x1 - x0) bool, None if none do."""
        counts = np.diff(self.first[y0 : y1 + 1])
        columns = np.clip(self.runs[self.first[y0] : self.first[y1]], x0, x1) - x0
        if not (columns[:, 0] < columns[:, 1]).any():
            return None
        rows = np.repeat(np.arange(y1 - y0), counts)
        change = np.zeros((y1 - y0, x1 - x0 + 1), np.int8)
        np.add.at(change, (rows, columns[:, 0]), 1)
        np.subtract.at(change, (rows, columns[:, 1]), 1)
        return np.cumsum(change, axis=1, dtype=np.int8)[:, :-1] > 0


def find_border(source: Source, nbytes: int) -> BlackBorder | None:
    """Return the black borders of an image, None if it has none.

    Parameters
    ----------
    source : Source
    nbytes : int
        Approximate memory of the blocks that are read, with their labels, bytes.
    """
    height, width = source.shape[:2]
    sides = ((0, 1, 0, width), (height - 1, height, 0, width), (0, height, 0, 1), (0, height, width - 1, width))
    if not any(_black(source, *side).any() for side in sides):
        return None
    channels = source.shape[2] if len(source.shape) == 3 else 1
    row_nbytes = width * max(source.dtype.itemsize * channels, _LABEL_NBYTES)
    rows = max(1, nbytes // max(row_nbytes, 1) // source.row_step) * source.row_step
    border = _components(source, rows)
    if border is None:
        return None
    counts, runs = [np.zeros(1, np.int64)], []
    for labels, offset in _labelled(source, rows):
        is_border = border[_unique(labels, offset)]
        change = np.diff(is_border.astype(np.int8), axis=1, prepend=0, append=0)
        y, start = np.nonzero(change == 1)
        runs.append(np.column_stack([start, np.nonzero(change == -1)[1]]).astype(np.int32))
        counts.append(np.bincount(y, minlength=len(labels)))
    return BlackBorder(np.cumsum(np.concatenate(counts)), np.concatenate(runs))


def _black(source: Source, y0: int, y1: int, x0: int, x1: int) -> NDArray[np.bool_]:
    """Return which pixels of a window are 0 in all colours; alpha does not count."""
    block = source.read(y0, y1, x0, x1)
    zero: NDArray[np.bool_] = block == 0 if block.ndim == 2 else (block[:, :, :3] == 0).all(axis=2)
    return zero


def _labelled(source: Source, rows: int) -> Iterator[tuple[NDArray[np.int32], int]]:
    """Yield the labels of each block of rows, and what to add to them, unless they are 0, to make them unique.

    Black pixels that reach no side of their block belong to no border and are 0, as pixels are that are not black: an
    image may have a million of them.
    """
    height, width = source.shape[:2]
    offset = 0
    for top in range(0, height, rows):
        zero = _black(source, top, min(top + rows, height), 0, width)
        count, labels = cv2.connectedComponents(zero.view(np.uint8), connectivity=4)
        at_sides = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        at_sides = at_sides[at_sides > 0]
        number = np.zeros(count, np.int32)
        number[at_sides] = np.arange(1, len(at_sides) + 1)
        yield number[labels], offset
        offset += len(at_sides)


def _unique(labels: NDArray[np.int32], offset: int) -> NDArray[np.int64]:
    """Return the unique numbers of a block's labels."""
    return np.where(labels > 0, labels + np.int64(offset), 0)


def _components(source: Source, rows: int) -> NDArray[np.bool_] | None:
    """Return which labels belong to borders, by their unique number, None if none do."""
    height, width = source.shape[:2]
    parents = [0]
    area, inner, sides = (np.zeros(1, np.int64) for _ in range(3))

    def root(label: int) -> int:
        while parents[label] != label:
            parents[label] = parents[parents[label]]
            label = parents[label]
        return label

    last: NDArray[Any] | None = None
    top = 0
    for labels, offset in _labelled(source, rows):
        bottom = top + len(labels)
        first, final = _unique(labels[[0, -1]], offset)
        count = int(labels.max())
        parents += range(offset + 1, offset + count + 1)
        halo = max(top - 1, 0), min(bottom + 1, height)
        zero = _black(source, *halo, 0, width).view(np.uint8)
        thick = cv2.erode(zero, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
        thick = thick[top - halo[0] : len(zero) - (halo[1] - bottom)]
        at_side = np.zeros(labels.shape, np.bool_)
        at_side[:, [0, -1]] = True
        at_side[0] |= top == 0
        at_side[-1] |= bottom == height
        numbers = [np.bincount(labels[where], minlength=count + 1)[1:] for where in (labels > 0, thick > 0, at_side)]
        area, inner, sides = (np.append(old, new) for old, new in zip((area, inner, sides), numbers, strict=True))
        if last is not None:
            both = (last > 0) & (first > 0)
            for above, below in np.unique(np.column_stack([last, first])[both], axis=0):
                parents[root(int(below))] = root(int(above))
        last, top = final, bottom
    roots = np.array([root(label) for label in range(len(parents))])
    area, inner, sides = (
        np.bincount(roots, numbers, minlength=len(roots)).astype(np.int64) for numbers in (area, inner, sides)
    )
    is_border = (sides > 0) & (area >= SMALLEST_BORDER) & (inner >= THICK * area)
    is_border[0] = False
    if not is_border.any() or area[is_border].sum() == height * width:
        return None
    border: NDArray[np.bool_] = is_border[roots]
    return border
