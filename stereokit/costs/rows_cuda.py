"""Common parts of the costs' CUDA twins: the layout of the volume, and the cells without evidence.

A volume holds four levels to a 32-bit word, ``padded / 4`` words to a pixel: byte b of word w is level ``4 * w + b``.
Levels that only pad hold 255. A thread computes one word of each pixel of a strip of a row: the right pixels of its
four levels move on by one level from pixel to pixel, so that a thread loads one new right pixel where it needs four.

The right image goes on beyond its borders with its border pixels, far enough for all levels: element ``u`` of such a
row is column ``u - minimum - (padded - 1)``, and level d of left column x needs element ``x + padded - 1 - d``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stereokit.costs.rows import Levels
from stereokit.cuda.kernel import array, device, i32, u8, u32
from stereokit.images.prepare_cuda import clamped

__all__ = ["EVIDENCE", "DevicePair", "apply_border", "masked_cost", "pad_levels", "padding"]


def pad_levels(count: int) -> int:
    """Return the levels of a volume that holds `count`: 32, 64, or a multiple of 128, as the warps of SGM want it."""
    for padded in (32, 64):
        if count <= padded:
            return padded
    return -(-count // 128) * 128


@dataclass(frozen=True)
class DevicePair:
    """A grey pair on the device, ready for a cost.

    Attributes
    ----------
    images : (2 * H * W,) uint8 or uint16 on the device
        Left and right image.
    dtype : numpy dtype
        Type of the images.
    bad : (2 * H * W,) uint8 on the device, or (1,) where every pixel has evidence
        Not 0 where a pixel has none.
    masked : bool
        Whether `bad` is there.
    height, width : int
        Size of an image, pixels.
    levels : Levels
        Disparities to try.
    border_share : float or None
    ranges : ((int, int), (int, int)) or None
        As of `stereokit.costs.rows.Pair`.
    """

    images: Any
    dtype: Any
    bad: Any
    masked: bool
    height: int
    width: int
    levels: Levels
    border_share: float | None
    ranges: tuple[tuple[int, int], tuple[int, int]] | None = None

    @property
    def padded(self) -> int:
        """Levels of the volume."""
        return pad_levels(self.levels.count)

    @property
    def reach(self) -> int:
        """Columns of the right image with what lies beyond its borders."""
        return self.width + self.padded - 1

    def evidence(self, cost_max: int) -> tuple[Any, ...]:
        """Return the last arguments of a cost's kernel, of the types `EVIDENCE`."""
        border_cost = cost_max if self.border_share is None else round(self.border_share * cost_max)
        clamp_border = int(self.border_share is None)
        size = self.height, self.width, self.padded // 4
        return self.bad, *size, self.levels.count, self.levels.minimum, border_cost, clamp_border


EVIDENCE = (array(u8), i32, i32, i32, i32, i32, i32, i32)
"""Types of `bad`, height, width, words of a pixel, levels, lowest disparity, `border_cost` and `clamp_border`."""


@device
def padding(level, count):  # type: ignore[no-untyped-def]
    """Return the padding levels of the word that begins with `level`: 255 each."""
    existing = i32(min(max(i32(count - level), i32(0)), i32(4)))
    return u32(0) if existing == 4 else u32(u32(0xFFFFFFFF) << u32(u32(8) * u32(existing)))


@device
def apply_border(cost, column, width, border_cost, clamp_border):  # type: ignore[no-untyped-def]
    """Return the cost of a cell whose right pixel lies in `column`: `border_cost` outside the image, unless clamped."""
    return i32(cost) if clamp_border != 0 or u32(column) < u32(width) else i32(border_cost)


@device
def masked_cost(cost, column, y, x, bad, height, width, border_cost):  # type: ignore[no-untyped-def]
    """Return the cost of a cell, or what it is where one of its two pixels is bad."""
    right = u32(u32(height + y) * u32(width) + u32(clamped(column, width - 1)))
    if bad[u32(u32(y) * u32(width) + u32(x))] != 0 or bad[right] != 0:
        return i32(border_cost)
    return i32(cost)
