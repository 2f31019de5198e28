"""The preparation of a grey pair: half size, and a Gaussian blur."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.images.gray import GrayPair
from stereokit.images.intensity import scale_guide
from stereokit.kernels.threads import run
from stereokit.kernels.workspace import Workspace

__all__ = ["half_size", "reduced", "reduced_mask", "smooth"]


def smooth(
    pair: GrayPair, sigma: float, workspace: Workspace | None = None, threads: int = 1, *, eight_bits: bool = False
) -> GrayPair:
    """Return the pair with both images smoothed by a Gaussian; the guide stays as sharp as it was.

    The result is 16 bit, so that nothing is lost to rounding: 8-bit images are multiplied by 256 first. For costs that
    take 8 bits only, it is rounded to 8 bits in the end, and images of 16 bits are brought to 256 levels first.

    Parameters
    ----------
    pair : GrayPair
    sigma : float
        Standard deviation in pixels; 0 returns the pair itself.
    workspace : Workspace or None
        The owner of the buffers of the smoothed images, which the next call overwrites; None makes new ones.
    threads : int
        Threads to use.
    eight_bits : bool
        Whether the result is of 8 bits, for pairs of 16 bits too.
    """
    if eight_bits and pair.left.dtype != np.uint8:
        left, right = scale_guide(pair.left, *pair.span), scale_guide(pair.right, *pair.span)
        pair = replace(pair, left=left, right=right, ranges=None, span=(0, 65535))
    if sigma == 0:
        return pair
    buffers = workspace or Workspace()
    images = pair.left, pair.right
    deep, blurred = ([buffers.array(f"smooth.{name}{k}", images[0].shape, np.uint16) for k in (0, 1)] for name in "wb")

    def blur(k: int) -> None:
        image = images[k]
        if image.dtype == np.uint8:
            image = np.multiply(image, np.uint16(256), out=deep[k])
        cv2.GaussianBlur(image, (0, 0), sigma, dst=blurred[k], borderType=cv2.BORDER_REPLICATE)

    run([partial(blur, 0), partial(blur, 1)], threads)
    left, right = ((image + np.uint16(128) >> 8).astype(np.uint8) if eight_bits else image for image in blurred)
    return replace(pair, left=left, right=right)


def reduced(pair: GrayPair, step: int) -> GrayPair:
    """Return the pair at 1/`step` of its size, 1, 2 or 4: halved as often as that takes."""
    while step > 1:
        pair, step = half_size(pair), step // 2
    return pair


def half_size(pair: GrayPair, *, tolerant: bool = False) -> GrayPair:
    """Return the pair at half size, ``(ceil(H/2), ceil(W/2))``: the mean of each 2x2 pixels.

    Odd sizes are extended by their last row or column. A pixel is bad if one of its four is.

    Parameters
    ----------
    pair : GrayPair
    tolerant : bool
        A pixel is bad only if all of its four are: where a fifth of the pixels are bad here and there, half of those of
        the half size would be, and nearly all of the quarter.
    """

    def shrink(image: NDArray[Any]) -> NDArray[Any]:
        height, width = image.shape
        even = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        size = (even.shape[1] // 2, even.shape[0] // 2)
        return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA)).reshape(size[1], size[0])

    left, right = shrink(pair.left), shrink(pair.right)
    guide = left if pair.left.dtype == np.uint8 else shrink(pair.guide)
    return replace(
        pair,
        left=left,
        right=right,
        guide=guide,
        left_bad=_half_mask(pair.left_bad, whole=tolerant),
        right_bad=_half_mask(pair.right_bad, whole=tolerant),
        left_blank=_half_mask(pair.left_blank),
    )


def reduced_mask(mask: NDArray[np.bool_] | None, step: int) -> NDArray[np.bool_] | None:
    """Return a mask at 1/`step` of its size, as `reduced` does it."""
    while step > 1:
        mask, step = _half_mask(mask), step // 2
    return mask


def _half_mask(mask: NDArray[np.bool_] | None, *, whole: bool = False) -> NDArray[np.bool_] | None:
    """Return where one of 2x2 pixels is True or, `whole`, all are."""
    if mask is None:
        return None
    height, width = mask.shape
    even = np.pad(mask, ((0, height % 2), (0, width % 2)), mode="edge")
    fours = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2)
    return np.asarray(fours.all(axis=(1, 3)) if whole else fours.any(axis=(1, 3)))
