"""The CUDA twin of `stereokit.postprocess.chain`: all of post-processing as launches, on maps that stay on the GPU."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.cuda.kernel import Queue, array, blocks_for, cuda, f32, kernel, u8, u32
from stereokit.postprocess.chain import PostProcessing
from stereokit.postprocess.fill_cuda import fill
from stereokit.postprocess.median_cuda import median
from stereokit.postprocess.smp_cuda import resolve
from stereokit.postprocess.speckle_cuda import remove

__all__ = ["hold", "post_process"]


@kernel(array(f32), array(u8), u32)
def invalidate(disparity, bad, pixels):  # type: ignore[no-untyped-def]
    """Invalidate the pixels that carry no evidence."""
    at = u32(cuda.grid(1))
    if at < pixels and bad[at] != u8(0):
        disparity[at] = f32(np.nan)


@kernel(array(f32), f32, f32, u32)
def hold(disparity, low, high, pixels):  # type: ignore[no-untyped-def]
    """Raise what lies below the lowest disparity to it, lower what lies above the highest; NaN stays."""
    at = u32(cuda.grid(1))
    if at < pixels:
        value = disparity[at]
        if value < low:
            disparity[at] = low
        elif value > high:
            disparity[at] = high


def post_process(
    queue: Queue, disparity: Any, cost: Any, bad: Any, chain: PostProcessing, shape: tuple[int, int]
) -> tuple[Any, Any]:
    """Return the finished map and which of its pixels were measured, both on the device; nothing is waited for.

    Parameters
    ----------
    queue : Queue
        Queue of launches.
    disparity : (H * W,) float32, pixels, NaN where invalid
        As selected; overwritten, and returned where there is no median.
    cost : (H * W,) uint16 or float32
        Aggregated cost of each pixel's match.
    bad : (H * W,) uint8 or None
        1 where a pixel has no evidence.
    chain : PostProcessing
        Options.
    shape : (int, int)
        Height and width, pixels.

    Returns
    -------
    disparity : (H * W,) float32, pixels
    valid : (H * W,) uint8
    """
    pixels = shape[0] * shape[1]
    if bad is not None:
        queue.launch(invalidate, blocks_for(pixels, invalidate.block), disparity, bad, pixels)
    if chain.smp:
        resolve(queue, disparity, cost, shape)
    if chain.speckle:
        remove(queue, disparity, chain.speckle, shape)
    valid = fill(queue, disparity, chain.fill, chain.empty_value, shape)
    if chain.median:
        disparity = median(queue, disparity, chain.median, shape)
    return disparity, valid
