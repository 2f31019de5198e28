"""The CUDA twin of the removal of speckles: union-find by atomics.

A pixel's parent is a pixel of its region with a lower number, and the lowest is the root. A warp first gives every
run of like pixels, within its 32 columns, the run's first pixel as parent, so that only runs are united: across the
edge of a warp's columns, and with the row above where the pixel to the left does not say the same already. Uniting
lowers a root's parent by an atomic minimum and goes on from what was there before (Playne, Hawick 2018). Which tree
comes out depends on the order of threads, but not which pixels share a root, so the same pixels are erased as on the
CPU. Counting shortens the trees as it climbs: every run takes its grandparent for parent until that is the root.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.cuda.kernel import (
    FULL,
    Queue,
    array,
    blocks_for,
    cuda,
    device,
    f32,
    i32,
    kernel,
    load_relaxed,
    shuffle_from,
    shuffle_up,
    u32,
)
from stereokit.postprocess.speckle import alike

__all__ = ["remove"]


@device
def _place(width):  # type: ignore[no-untyped-def]
    """Return lane, column and pixel of the thread; whole blocks stand on a row, the last of them past its end."""
    blocks = u32(u32(u32(width + u32(cuda.blockDim.x)) - u32(1)) // u32(cuda.blockDim.x))
    y = u32(u32(cuda.blockIdx.x) // blocks)
    x = u32(u32(u32(u32(cuda.blockIdx.x) - u32(y * blocks)) * u32(cuda.blockDim.x)) + u32(cuda.threadIdx.x))
    return u32(x & u32(31)), x, u32(u32(y * width) + min(x, u32(width - u32(1))))


@device
def _starts(disparity, lane, x, at, width, limit):  # type: ignore[no-untyped-def]
    """Return a bit for every lane that begins a run; lanes past the row are runs of their own."""
    d = disparity[at]
    before = shuffle_up(d, 1)
    return u32(cuda.ballot_sync(FULL, lane == u32(0) or x >= width or not alike(d, before, limit)))


@device
def _first_of_run(starts, lane):  # type: ignore[no-untyped-def]
    """Return the lane that begins the run of `lane`."""
    upto = u32(starts & u32(u32(FULL) >> u32(u32(31) - lane)))
    return u32(u32(31) - u32(cuda.clz(upto)))


@device
def _root_of(parent, a):  # type: ignore[no-untyped-def]
    up = load_relaxed(parent, a)
    while up != a:
        a = up
        up = load_relaxed(parent, a)
    return a


@device
def _unite(parent, a, b):  # type: ignore[no-untyped-def]
    """Join two regions under the lower root; when another thread was first at a root, go on from where it points."""
    apart = True
    while apart:
        a = _root_of(parent, a)
        b = _root_of(parent, b)
        low, high = min(a, b), max(a, b)
        apart = low != high
        if apart:
            a = u32(cuda.atomic.min(parent, high, low))
            apart = a != high
            b = low


@kernel(array(f32), array(u32), array(u32), u32, f32)
def speckle_runs(disparity, parent, count, width, limit):  # type: ignore[no-untyped-def]
    """Give every pixel the first of its run as parent."""
    lane, x, at = _place(width)
    starts = _starts(disparity, lane, x, at, width, limit)
    if x < width:
        parent[at] = u32(at - u32(lane - _first_of_run(starts, lane)))
        count[at] = u32(0)


@kernel(array(f32), array(u32), u32, f32)
def speckle_join(disparity, parent, width, limit):  # type: ignore[no-untyped-def]
    """Unite the runs that touch."""
    lane, x, at = _place(width)
    if x >= width:
        return
    d = disparity[at]
    left = d
    beside = False
    if x > u32(0):
        left = disparity[u32(at - u32(1))]
        beside = alike(d, left, limit)
        if beside and lane == u32(0):
            _unite(parent, at, u32(at - u32(1)))
    if at >= width:
        over = u32(at - width)
        above = disparity[over]
        if alike(d, above, limit):
            known = False
            if beside:
                corner = disparity[u32(over - u32(1))]
                known = alike(above, corner, limit) and alike(left, corner, limit)
            if not known:
                _unite(parent, at, over)


@kernel(array(f32), array(u32), array(u32), array(u32), u32, f32)
def speckle_count(disparity, parent, root, count, width, limit):  # type: ignore[no-untyped-def]
    """Write every pixel's root and count the pixels of each region at its root."""
    lane, x, at = _place(width)
    starts = _starts(disparity, lane, x, at, width, limit)
    top = at
    if x < width and u32(u32(starts >> lane) & u32(1)) != u32(0):
        up = load_relaxed(parent, at)
        top = load_relaxed(parent, up)
        while top != up:
            cuda.atomic.min(parent, at, top)
            up = top
            top = load_relaxed(parent, up)
        later = u32(u32(starts >> lane) >> u32(1))
        length = u32(u32(32) - lane)
        if later != u32(0):
            length = u32(cuda.ffs(later))
        cuda.atomic.add(count, top, length)
    top = u32(shuffle_from(i32(top), i32(_first_of_run(starts, lane))))
    if x < width:
        root[at] = top


@kernel(array(f32), array(u32), array(u32), u32, u32)
def speckle_erase(disparity, root, count, pixels, size):  # type: ignore[no-untyped-def]
    """Invalidate the pixels of regions of `size` pixels or fewer."""
    at = u32(cuda.grid(1))
    if at < pixels and count[root[at]] <= size:
        disparity[at] = f32(np.nan)


def remove(queue: Queue, disparity: Any, size: int, shape: tuple[int, int], difference: float = 1.0) -> None:
    """Invalidate, in place, the regions of `size` pixels or fewer.

    Parameters
    ----------
    queue : Queue
        Queue of launches.
    disparity : (H * W,) float32, pixels, NaN where invalid
    size : int
        Largest region that is removed, pixels.
    shape : (int, int)
        Height and width, pixels.
    difference : float
        Largest difference of neighbours in one region, pixels.
    """
    height, width = shape
    pixels = height * width
    parent, root, count = (queue.array(f"post.{name}", pixels, np.uint32) for name in ("parent", "root", "count"))
    limit = np.float32(difference)
    blocks = height * blocks_for(width, speckle_runs.block)
    queue.launch(speckle_runs, blocks, disparity, parent, count, width, limit)
    queue.launch(speckle_join, blocks, disparity, parent, width, limit)
    queue.launch(speckle_count, blocks, disparity, parent, root, count, width, limit)
    queue.launch(speckle_erase, blocks_for(pixels, speckle_erase.block), disparity, root, count, pixels, size)
