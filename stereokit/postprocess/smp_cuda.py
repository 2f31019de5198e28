"""The CUDA twin of the single matching phase: a block resolves a row.

Every left pixel bids for its right pixel with one number, and the lowest bid stays: the cost first, then the column
from the right. Among pixels that round to one right pixel the larger column is the larger disparity, so the order of
bids is the CPU's order, and an atomic minimum finds the same winner in any order of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.cuda.kernel import Kernel, Queue, array, cuda, device, f32, kernel, u16, u32, u64
from stereokit.postprocess.smp import right_column

__all__ = ["resolve"]


@device
def _bits_of_short(costs, at):  # type: ignore[no-untyped-def]
    return u32(costs[at])


@device
def _bits_of_float(costs, at):  # type: ignore[no-untyped-def]
    """Return an integer that sorts as costs do, which are not negative."""
    return u32(cuda.libdevice.float_as_int(costs[at]))


def _make_resolve(name: str, cost: Any, bits: Any) -> Kernel:
    @device
    def bid_of(costs, at, x):  # type: ignore[no-untyped-def]
        return u64(u64(u64(bits(costs, at)) << u64(32)) | u64(u32(~x)))

    @kernel(array(f32), array(cost), array(u64), u32, block=256, name=name)
    def resolve(disparity, costs, bids, width):  # type: ignore[no-untyped-def]
        base = u32(u32(cuda.blockIdx.x) * width)
        first = u32(cuda.threadIdx.x)
        step = u32(cuda.blockDim.x)
        x = first
        while x < width:
            bids[u32(base + x)] = u64(0xFFFFFFFFFFFFFFFF)
            x = u32(x + step)
        cuda.syncthreads()
        x = first
        while x < width:
            at = u32(base + x)
            column = right_column(x, disparity[at], width)
            if column >= 0:
                cuda.atomic.min(bids, u32(base + u32(column)), bid_of(costs, at, x))
            x = u32(x + step)
        cuda.syncthreads()
        x = first
        while x < width:
            at = u32(base + x)
            column = right_column(x, disparity[at], width)
            lost = True
            if column >= 0:
                lost = bids[u32(base + u32(column))] != bid_of(costs, at, x)
            if lost:
                disparity[at] = f32(np.nan)
            x = u32(x + step)

    result: Kernel = resolve
    return result


_resolve_short = _make_resolve("smp_short", u16, _bits_of_short)
_resolve_float = _make_resolve("smp_float", f32, _bits_of_float)


def resolve(queue: Queue, disparity: Any, cost: Any, shape: tuple[int, int]) -> None:
    """Invalidate, in place, all but the best of the pixels that match one right pixel.

    Parameters
    ----------
    queue : Queue
        Queue of launches.
    disparity : (H * W,) float32, pixels, NaN where invalid
    cost : (H * W,) uint16 or float32
        Aggregated cost of each pixel's match.
    shape : (int, int)
        Height and width, pixels.
    """
    height, width = shape
    bids = queue.array("post.bids", height * width, np.uint64)
    what = _resolve_float if cost.dtype == np.float32 else _resolve_short
    queue.launch(what, height, disparity, cost, bids, width)
