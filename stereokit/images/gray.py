"""From images of any kind to a grey pair.

Whatever comes in (grey or RGB, 8 or 16 bit or floating point, strided, read-only, with NaN) leaves as two grey
C-contiguous ``uint8`` or ``uint16`` images and the masks of the pixels that carry no evidence. The images that come
in are not modified. `stereokit.images.intensity` maps the values of 16-bit and floating-point images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError
from stereokit.images.check import checked_image, writable
from stereokit.images.evidence import black_border, checked_mask, joined, neutral, unusable
from stereokit.images.intensity import IntensityMapping, fill_bad, find_mapping, scale_guide

__all__ = [
    "GrayPair",
    "check_same",
    "gray_of",
    "gray_pair",
    "guide_of",
]


@dataclass(frozen=True)
class GrayPair:
    """Two grey images of one shape and type.

    Attributes
    ----------
    left, right : (H, W) uint8 or uint16, C-contiguous
        Grey values; pixels without evidence hold a neighbour's value.
    left_bad, right_bad : (H, W) bool or None
        Pixels without evidence: masked, NaN, infinite, transparent, no-data, or of a black border; None when there are
        none.
    guide : (H, W) uint8
        The left image in 256 grey levels.
    ranges : ((int, int), (int, int)) or None
        Smallest and largest value of either image as a cost sees it, halved and smoothed, where this pair is a
        window of larger images; None where it is the whole.
    span : (int, int)
        Grey values, of 16 bits, from and to which the guide's 256 levels reach.
    left_blank : (H, W) bool or None
        Pixels around which the left view has no texture; None when there are none, or nobody has looked for them.
    """

    left: NDArray[Any]
    right: NDArray[Any]
    left_bad: NDArray[np.bool_] | None
    right_bad: NDArray[np.bool_] | None
    guide: NDArray[np.uint8]
    ranges: tuple[tuple[int, int], tuple[int, int]] | None = None
    span: tuple[int, int] = (0, 65535)
    left_blank: NDArray[np.bool_] | None = None


def gray_pair(left: Any, right: Any, nodata: float | None = None, mask: Any = None, right_mask: Any = None) -> GrayPair:
    """Check two images and return them as a grey pair.

    Parameters
    ----------
    left, right : (H, W), (H, W, 3) or (H, W, 4), numbers
        Of one shape (up to colour) and type. Any strides; read-only arrays are fine.
    nodata : float or None
        Value of pixels without evidence.
    mask, right_mask : (H, W) bool, or None
        True where a pixel of the left, and of the right image is usable.

    Raises
    ------
    InputError
        If an image or a mask has another shape or type, is empty, or the two differ.

    Warns
    -----
    StereokitWarning
        If few grey levels are left; see `stereokit.images.intensity.find_mapping`.
    """
    images = checked_image("left", left), checked_image("right", right)
    check_same(*images, *(getattr(image, "dtype", None) for image in (left, right)))
    excluded = [
        joined(unusable(checked_mask(name, user_mask, image.shape)), black_border(image))
        for name, user_mask, image in zip(("mask", "right_mask"), (mask, right_mask), images, strict=True)
    ]
    plain = [image if bad is None else neutral(image, ~bad) for image, bad in zip(images, excluded, strict=True)]
    mapping = find_mapping(lambda: [(0, image) for image in plain], plain[0].dtype, plain[0].shape, nodata)
    (a, left_bad), (b, right_bad) = (gray_of(mapping, *view) for view in zip(plain, excluded, strict=True))
    a, b = writable(a), writable(b)
    return GrayPair(a, b, left_bad, right_bad, mapping.guide(a), span=mapping.span)


def gray_of(
    mapping: IntensityMapping, image: NDArray[Any], excluded: NDArray[np.bool_] | None
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:  # fmt: skip
    """Return an image in grey, and which of its pixels have no evidence."""
    gray, bad = mapping.apply(image)
    if excluded is None:
        return gray, bad
    bad = joined(bad, excluded)
    assert bad is not None
    return fill_bad(gray, bad), bad


def check_same(left: Any, right: Any, *user_types: Any) -> None:
    """Raise InputError unless two images, or sources of them, have one type and size.

    The message names the `user_types`, where they are not those of the images.
    """
    if left.dtype != right.dtype:
        types = " and ".join(str(a or b.dtype) for a, b in zip(user_types or (None, None), (left, right), strict=True))
        raise InputError(f"left and right must have the same type, got {types}")
    if left.shape[:2] != right.shape[:2]:
        raise InputError(f"left and right must have the same size, got {left.shape[:2]} and {right.shape[:2]}")


def guide_of(left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.uint8]:
    """Return `left`, (H, W) uint8 or uint16, in 256 grey levels of the range that it shares with `right`."""
    if left.dtype == np.uint8:
        return left
    low = min(int(left.min()), int(right.min()))
    high = max(int(left.max()), int(right.max()))
    return scale_guide(left, low, high)
