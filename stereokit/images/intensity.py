"""The mapping of grey values of any type to 8 or 16 bits: one rule for whole images and for windows of them.

8-bit images stay as they are, and so do floats that hold whole numbers from 0 to 255. For all others a few values
must not decide: one hot pixel, or GDAL's -3.4e38 for missing pixels, would leave the rest of the pair a handful of
levels. So the range comes from the **core** of both views together, all values but half a percent at either end:

1. Extreme values that lie apart from the core of the rest, by `_MARK_WIDTHS` times its width, mark pixels without
   evidence, as NaN does. At most `_MAX_MARKS` different values at either end can be marks.
   Negative marks of images that have no other negative value (-9999, -1) need lie apart by half its width only:
   intensities are not negative.
2. Values beyond the core by more than half its width are clipped. A pair of a smaller range keeps every level.
3. Whole numbers of 16 bits keep their values, other floats are brought to 0 .. 65535.

The core is that of a sample: all pixels of images of up to `_SAMPLE` pixels, else those of a regular grid.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.images.check import checked_image
from stereokit.kernels.jit import kernel
from stereokit.notices import collecting, warn

__all__ = [
    "Blocks",
    "IntensityMapping",
    "display_8bit",
    "fill_bad",
    "find_mapping",
    "missing_pixels",
    "scale_guide",
    "to_gray",
]

Blocks = Callable[[], Iterable[tuple[int, NDArray[Any]]]]
"""A function that yields the rows of both images in blocks: the first row's number and (h, W) or (h, W, C) values."""

_SAMPLE = 2**16
_TAIL_SHARE = 0.005  # of the pixels, at either end, that are not of the core
_CLIP_WIDTHS = 0.5  # widths of the core that are not clipped on either side of it
_MARK_WIDTHS = 10.0  # widths of the core
_NEGATIVE_MARK_WIDTHS = 0.5
_MAX_MARKS = 3
_ROUNDS = 4  # of the search for marks, each without the marks of the rounds before
_MIN_VALUES = 16  # different values that the rest must have for an extreme one to be a mark
_MIN_LEVELS = 64  # of the guide's 256 for `_LEVEL_SHARE` of the pixels; fewer give a warning
_LEVEL_SHARE = 0.99
_UINT8, _UINT16 = np.dtype(np.uint8), np.dtype(np.uint16)
_INTEGER_TYPES = ((255, _UINT8), (65535, _UINT16))


@dataclass(frozen=True)
class IntensityMapping:
    """The mapping of both images of a pair to grey integers.

    Attributes
    ----------
    kind : numpy.dtype
        uint8 or uint16: of the result.
    nodata : float or None
        Value of pixels without evidence, as the user gave it.
    integer_type : numpy.dtype or None
        The type that floats with whole numbers are cast to before the conversion to grey.
    scaled : bool
        Floats are brought from `low` .. `high` to 16 bits.
    low, high : float
        Grey values are clipped to this range.
    below, above : float
        Grey values beyond these mark pixels without evidence.
    """

    kind: np.dtype[Any]
    nodata: float | None = None
    integer_type: np.dtype[Any] | None = None
    scaled: bool = False
    low: float = 0.0
    high: float = 65535.0
    below: float = -math.inf
    above: float = math.inf

    def gray(self, block: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return a block in grey, not clipped yet, and the mask of its pixels without evidence, if there are any."""
        colors, missing = block[:, :, :3] if block.ndim == 3 else block, missing_pixels(block, self.nodata)
        gray = to_gray(colors)
        if gray.dtype == np.uint8:
            return gray, missing
        marks: NDArray[np.bool_] | None = None
        if gray.dtype.kind == "f":
            marks = ~np.isfinite(gray)
        if math.isfinite(self.below) or math.isfinite(self.above):
            out_of_range = (gray < self.below) | (gray > self.above)
            marks = out_of_range if marks is None else marks | out_of_range
        if marks is not None and marks.any():
            missing = marks if missing is None else missing | marks
        if self.integer_type is not None:
            if missing is not None:
                colors = np.where(missing if colors.ndim == 2 else missing[:, :, None], 0, colors)
            gray = to_gray(colors.astype(self.integer_type))
        return gray, missing

    def apply(self, block: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return a block as grey integers of `kind` and, if there are any, the mask of its pixels without evidence.

        Pixels without evidence hold a neighbour's value.
        """
        gray, missing = self.gray(block)
        if missing is not None:
            gray = fill_bad(gray, missing)
        if self.scaled:
            return _scale_to_16_bits(gray, self.low, self.high).astype(self.kind, copy=False), missing
        if gray.dtype != np.uint8:
            gray = np.clip(gray, int(self.low), int(self.high))
        return gray.astype(self.kind, copy=False), missing

    def guide(self, gray: NDArray[Any]) -> NDArray[np.uint8]:
        """Return grey values of `kind` in the guide's 256 levels."""
        if gray.dtype == np.uint8:
            return gray
        return scale_guide(gray, *self.span)

    @property
    def span(self) -> tuple[int, int]:
        """Grey values, of 16 bits, from and to which the guide's levels reach."""
        return (0, 65535) if self.scaled else (int(self.low), int(self.high))


def find_mapping(
    blocks: Blocks, dtype: np.dtype[Any], shape: tuple[int, ...], nodata: float | None = None
) -> IntensityMapping:  # fmt: skip
    """Return the mapping of two images of one type to grey integers.

    Parameters
    ----------
    blocks : callable
        Gives both images block by block, each time it is called.
    dtype : numpy.dtype
        uint8, uint16, float32 or float64.
    shape : tuple of int
        Of one image.
    nodata : float or None
        Value of pixels without evidence.

    Warns
    -----
    StereokitWarning
        If fewer than 64 of the guide's 256 levels hold 99 % of the pixels, of an image that has more.
    """
    mapping = IntensityMapping(_UINT8, nodata)
    if dtype == np.uint8:
        return mapping
    step = max(1, math.ceil(math.sqrt(shape[0] * shape[1] / _SAMPLE)))
    for _ in range(_ROUNDS):
        if dtype.kind == "f":
            mapping = replace(mapping, integer_type=_integer_type(replace(mapping, integer_type=None), blocks))
        if mapping.integer_type == _UINT8:
            return mapping
        sample, low, high = _grey_sample(mapping, blocks, step)
        if dtype == np.uint16 and high <= 255:
            return mapping
        below, above = _mark_limits(sample)
        if math.isinf(below) and math.isinf(above):
            break
        mapping = replace(mapping, below=max(mapping.below, below), above=min(mapping.above, above))
    if sample.size > 0:
        first, last = _core(sample)
        reach = _CLIP_WIDTHS * last - _CLIP_WIDTHS * first
        low, high = max(low, first - reach), min(high, last + reach)
    if dtype.kind == "f" and mapping.integer_type is None:
        mapping = replace(mapping, kind=_UINT16 if high > low else _UINT8, scaled=True, low=low, high=high)
    elif high >= low:
        low, high = math.floor(low), math.ceil(high)
        mapping = replace(mapping, kind=_UINT16 if high > 255 else _UINT8, low=low, high=high)
    if mapping.kind == _UINT16:
        _check_levels(sample, low, high)
    return mapping


def display_8bit(image: Any, nodata: float | None = None) -> NDArray[np.uint8]:
    """Return an image for display: 8 bits over the range of its values without outliers.

    Parameters
    ----------
    image : (H, W), (H, W, 3) or (H, W, 4), any type that `stereokit.match` takes
    nodata : float or None
        Value of pixels without evidence.

    Returns
    -------
    (H, W) or (H, W, 3) uint8
        8-bit images as they are; black where there is no evidence.

    Raises
    ------
    InputError
        If the image has another shape or type, or is empty.
    """
    array = checked_image("image", image)
    missing = missing_pixels(array, nodata)
    colors = array[:, :, :3] if array.ndim == 3 else array
    plane = colors.reshape(colors.shape[0], -1)  # colours side by side: one range for all
    with collecting():
        mapping = find_mapping(lambda: [(0, plane)], plane.dtype, plane.shape, nodata)
    gray, marked = mapping.apply(plane)
    picture: NDArray[np.uint8] = mapping.guide(gray).reshape(colors.shape).copy()
    if mapping.low == mapping.high > 0:  # one level: white
        picture[:] = 255
    if marked is not None:
        picture.reshape(plane.shape)[marked] = 0
    if missing is not None:
        picture[missing] = 0
    return picture


def to_gray(array: NDArray[Any]) -> NDArray[Any]:
    """Return a checked image in grey: 0.299 R + 0.587 G + 0.114 B; see `_gray_of_floats` for floating point."""
    if array.ndim == 2:
        return array
    if array.dtype.kind == "f":
        return _gray_of_floats(array)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(array), cv2.COLOR_RGB2GRAY))


def _gray_of_floats(array: NDArray[Any]) -> NDArray[Any]:
    """Return floats in grey, by single operations in a fixed order: OpenCV and BLAS differ between processors."""
    with np.errstate(over="ignore", invalid="ignore"):  # inf - inf, inf * 0: such pixels are bad ones
        gray = array[:, :, 0] * array.dtype.type(0.299)
        for channel, weight in ((1, 0.587), (2, 0.114)):
            gray += array[:, :, channel] * array.dtype.type(weight)
    return np.asarray(gray)


def missing_pixels(block: NDArray[Any], nodata: float | None) -> NDArray[np.bool_] | None:
    """Return the mask of pixels whose alpha is 0 or whose channels are all `nodata`; None if there are none."""
    missing = np.zeros(block.shape[:2], np.bool_)
    colors = block
    if block.ndim == 3 and block.shape[2] == 4:
        missing |= block[:, :, 3] == 0
        colors = block[:, :, :3]
    if nodata is not None:
        with np.errstate(over="ignore"):
            same = colors == (np.asarray(nodata).astype(block.dtype) if block.dtype.kind == "f" else nodata)
        missing |= same if same.ndim == 2 else same.all(axis=2)
    return missing if missing.any() else None


def fill_bad(image: NDArray[Any], bad: NDArray[np.bool_]) -> NDArray[Any]:
    """Return `image` with bad pixels replaced by the nearest good one before them on the row, else behind, else 0."""
    filled = np.array(image, order="C")
    bits = filled.view(f"u{filled.dtype.itemsize}")  # zero is zero in every type
    _fill_rows(bits, np.ascontiguousarray(bad))
    return filled


@kernel
def _fill_rows(bits: NDArray[Any], bad: NDArray[np.bool_]) -> None:
    height, width = bits.shape
    for y in range(height):
        good = 0
        while good < width and bad[y, good]:
            good += 1
        value = bits[y, good] if good < width else bits[y, 0] ^ bits[y, 0]
        for x in range(width):
            if bad[y, x]:
                bits[y, x] = value
            else:
                value = bits[y, x]


def scale_guide(image: NDArray[Any], low: int, high: int) -> NDArray[np.uint8]:
    """Return grey values from `low` to `high` in 256 levels."""
    scaled = (image.astype(np.float32) - np.float32(low)) * np.float32(255 / max(high - low, 1))
    return np.asarray(np.rint(scaled), np.uint8)


def _scale_to_16_bits(image: NDArray[Any], low: float, high: float) -> NDArray[np.uint16]:
    """Return floats, clipped to `low` .. `high`, as whole numbers from 0 to 65535."""
    if high <= low:
        return np.zeros(image.shape, np.uint16)
    share = (np.clip(image.astype(np.float64), low, high) / 2 - low / 2) / (high / 2 - low / 2)  # halves: no overflow
    return np.rint(share * 65535).astype(np.uint16)


def _integer_type(mapping: IntensityMapping, blocks: Blocks) -> np.dtype[Any] | None:
    """Return the smallest type that holds all values with evidence as whole numbers, None if there is none."""
    index = 0
    for _, block in blocks():
        missing = mapping.gray(block)[1]
        colors = block[:, :, :3] if block.ndim == 3 else block
        values = colors if missing is None else colors[~missing]
        with np.errstate(invalid="ignore"):
            while index < 2 and values.size and not _are_integers(values, *_INTEGER_TYPES[index]):
                index += 1
        if index == 2:
            return None
    return _INTEGER_TYPES[index][1]


def _are_integers(values: NDArray[Any], highest: int, dtype: np.dtype[Any]) -> bool:
    return bool(np.array_equal(values.astype(dtype), values) and values.max() <= highest)


def _grey_sample(mapping: IntensityMapping, blocks: Blocks, step: int) -> tuple[NDArray[Any], float, float]:
    """Return the sorted sample of the grey values with evidence, and the smallest and largest of all such."""
    parts = []
    low, high = math.inf, -math.inf
    for y0, block in blocks():
        gray, missing = mapping.gray(block)
        values = gray if missing is None else gray[~missing]
        if values.size:
            low, high = min(low, float(values.min())), max(high, float(values.max()))
        grid = slice(-y0 % step, None, step), slice(None, None, step)
        parts.append(gray[grid].ravel() if missing is None else gray[grid][~missing[grid]])
    sample = np.concatenate(parts)
    sample.sort(kind="stable" if sample.dtype == np.uint16 else None)  # by radix, or by vectors
    return sample, low, high


def _core(sample: NDArray[Any]) -> tuple[float, float]:
    """Return the smallest and the largest value of a sorted sample without its tails."""
    tail = int(_TAIL_SHARE * sample.size)
    return float(sample[tail]), float(sample[sample.size - 1 - tail])


def _mark_limits(sample: NDArray[Any]) -> tuple[float, float]:
    """Return the limits of a sorted sample beyond which values mark missing pixels; infinite where there are none."""
    tail = int(_TAIL_SHARE / 2 * sample.size)
    for part in (
        sample[tail : sample.size - tail],
        sample,
    ):  # without hot pixels beyond a mark, and with them
        limits = _extreme_marks(part)
        if limits is not None:
            return limits
    return -math.inf, math.inf


def _extreme_marks(sample: NDArray[Any]) -> tuple[float, float] | None:
    starts = np.concatenate([[0], np.flatnonzero(sample[1:] != sample[:-1]) + 1, [sample.size]])
    limits, mark_count = None, 0
    for lower, upper in itertools.product(range(_MAX_MARKS + 1), repeat=2):
        if lower + upper <= mark_count or starts.size - 1 - lower - upper < _MIN_VALUES:
            continue
        rest = sample[starts[lower] : starts[-1 - upper]]
        low, high = _core(rest)
        if high <= low:
            continue
        below, above = -math.inf, math.inf
        if lower > 0:
            mark = float(sample[starts[lower] - 1])
            if low - mark <= (high - low) * (_NEGATIVE_MARK_WIDTHS if mark < 0 <= rest[0] else _MARK_WIDTHS):
                continue
            below = 0.999 * mark + 0.001 * low  # grey of colours may differ from the mark in its last bits
        if upper > 0:
            mark = float(sample[starts[-1 - upper]])
            if mark - high <= (high - low) * _MARK_WIDTHS:
                continue
            above = 0.999 * mark + 0.001 * high
        limits, mark_count = (below, above), lower + upper
    return limits


def _check_levels(sample: NDArray[Any], low: float, high: float) -> None:
    """Warn where the range leaves most pixels of a sorted sample few of the guide's levels."""
    if sample.size == 0:
        return
    levels = scale_guide(_scale_to_16_bits(sample, low, high), 0, 65535)
    counts = np.sort(np.bincount(levels, minlength=256))[::-1]
    level_count = 1 + int(np.searchsorted(np.cumsum(counts), _LEVEL_SHARE * sample.size))
    value_count = 1 + np.count_nonzero(sample[1:] != sample[:-1])
    if level_count < _MIN_LEVELS and value_count > 2 * level_count:
        warn(
            f"left and right: {level_count} of 256 grey levels hold 99 % of the pixels between {low:g} and {high:g}; "
            "if some of these values mark missing pixels, give it as nodata"
        )
