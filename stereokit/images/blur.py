"""A Gaussian blur of a grey pair: OpenCV's of 16-bit images, to the last bit.

Its weights are whole numbers of 2**-16, sums are exact, and only the last one is rounded; so the order of the additions
does not matter. Windows end at about four sigma, borders repeat their last pixel.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.images.gray import GrayPair
from stereokit.images.intensity import scale_guide
from stereokit.kernels.jit import kernel
from stereokit.kernels.threads import run, spans
from stereokit.kernels.workspace import Workspace

__all__ = ["gaussian_weights", "smooth"]


@lru_cache(maxsize=64)
def gaussian_weights(sigma: float) -> NDArray[np.uint32]:
    """Return the weights of OpenCV's Gaussian of 16-bit images, in units of 2**-16; they sum to one.

    Parameters
    ----------
    sigma : float
        Standard deviation in pixels, above 0.
    """
    reach = int(8 * sigma) + 4  # OpenCV's window is about 8 sigma wide
    impulse = np.zeros((1, 2 * reach + 1), np.uint16)
    impulse[0, reach] = 65535
    spread = cv2.GaussianBlur(np.repeat(impulse, 3, axis=0), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)[1]
    half = reach - int(np.flatnonzero(spread)[0])
    weights: NDArray[np.uint32] = spread[reach - half : reach + half + 1].astype(np.uint32)
    weights[half] = 65536 - (int(weights.sum()) - int(weights[half]))
    return weights


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
    height, width = pair.left.shape
    weights = gaussian_weights(sigma)[gaussian_weights(sigma).size // 2 :]
    blurred, tasks = [], []
    for side, image in (("left", pair.left), ("right", pair.right)):
        image = np.ascontiguousarray(image)
        out = buffers.array(f"smooth.{side}", (height, width), np.uint16)
        for k, (y0, y1) in enumerate(spans(height, threads)):
            line = buffers.array(f"smooth.{side}.line{k}", width + 2 * (weights.size - 1), np.uint32)
            total = buffers.array(f"smooth.{side}.total{k}", width, np.uint64)
            tasks.append(partial(_blur, image, weights, y0, y1, line, total, out))
        blurred.append(out)
    run(tasks, threads)
    left, right = ((image + np.uint16(128) >> 8).astype(np.uint8) if eight_bits else image for image in blurred)
    return replace(pair, left=left, right=right)


@kernel
def _blur(
    image: NDArray[np.uint8], weights: NDArray[np.uint32], y0: int, y1: int, line: NDArray[np.uint32],
    total: NDArray[np.uint64], out: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Write rows y0 to y1; `weights` are those from the middle of the window on.

    Columns first: sums of 16 bits times weights that add up to 2**16 fit into 32.
    """
    height, width = image.shape
    reach = weights.size - 1
    inner = line[reach : reach + width]
    shift = np.uint64(32 if image.itemsize == 2 else 24)  # 8 bits are multiplied by 256
    for y in range(y0, y1):
        here = image[y]
        weight = weights[0]
        for x in range(width):
            inner[x] = weight * np.uint32(here[x])
        for k in range(1, reach + 1):
            weight = weights[k]
            above = image[max(y - k, 0)]
            below = image[min(y + k, height - 1)]
            for x in range(width):
                inner[x] += weight * (np.uint32(above[x]) + np.uint32(below[x]))
        for x in range(reach):
            line[x] = inner[0]
            line[reach + width + x] = inner[width - 1]
        wide = np.uint64(weights[0])
        for x in range(width):
            total[x] = wide * np.uint64(inner[x])
        for k in range(1, reach + 1):
            wide = np.uint64(weights[k])
            before = line[reach - k :]
            after = line[reach + k :]
            for x in range(width):
                total[x] += wide * np.uint64(before[x]) + wide * np.uint64(after[x])
        row = out[y]
        half = np.uint64(1) << (shift - np.uint64(1))
        for x in range(width):
            row[x] = np.uint16((total[x] + half) >> shift)
