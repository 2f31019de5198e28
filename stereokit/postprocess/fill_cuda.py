"""The CUDA twin of filling, and the map of what was measured: a warp fills a row, 32 columns at a time.

A vote tells which of the 32 are valid, and its bits give every gap its ends. What lies further left is carried along;
what lies further right is looked for once and remembered. Only gaps are written and only valid pixels read, so that
the row is filled in place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.cuda.kernel import FULL, Queue, array, blocks_for, cuda, f32, i32, kernel, u8, u32
from stereokit.postprocess.fill import gap_value

__all__ = ["fill"]

_MODES = {None: 0, "background": 1, "nearest": 2}


@kernel(array(f32), array(u8), array(u8), i32, i32, i32)
def fill_rows(disparity, valid, some, height, width, mode):  # type: ignore[no-untyped-def]
    """Write which pixels are valid and which rows have some, and fill those rows unless mode is 0."""
    lane = i32(i32(cuda.threadIdx.x) & i32(31))
    y = i32(i32(cuda.grid(1)) >> i32(5))
    if y >= height:  # the whole warp
        return
    base = u32(u32(y) * u32(width))
    behind = i32(-1)  # the last valid column of the chunks before
    ahead = i32(-1)  # a valid column of the chunks after, `width` if there is none; too low when not known
    chunk = i32(0)
    while chunk < width:
        x = i32(chunk + lane)
        d = f32(np.nan)
        if x < width:
            d = disparity[u32(base + u32(x))]
        measured = d == d
        votes = u32(cuda.ballot_sync(FULL, measured))
        if mode > 0:
            if ahead < i32(chunk + 32) and u32(votes >> u32(31)) == u32(0):
                ahead = width
                look = i32(chunk + 32)
                while look < width:
                    e = f32(np.nan)
                    if i32(look + lane) < width:
                        e = disparity[u32(base + u32(i32(look + lane)))]
                    seen = u32(cuda.ballot_sync(FULL, e == e))
                    if seen != u32(0):
                        ahead = i32(look + i32(cuda.ffs(seen)) - 1)
                        look = width
                    look = i32(look + 32)
            lower = u32(votes & u32(u32(u32(1) << u32(lane)) - u32(1)))
            upper = u32(u32(votes >> u32(lane)) >> u32(1))
            left = i32(chunk + 31 - i32(cuda.clz(lower))) if lower != u32(0) else behind
            right = i32(x + i32(cuda.ffs(upper))) if upper != u32(0) else ahead
            if x < width and not measured and (left >= 0 or right < width):
                if left < 0:
                    left = right
                if right >= width:
                    right = left
                start, end = disparity[u32(base + u32(left))], disparity[u32(base + u32(right))]
                to_start, to_end = abs(i32(x - left)), abs(i32(right - x))
                disparity[u32(base + u32(x))] = gap_value(start, end, to_start, to_end, mode == 2)
        if votes != u32(0):
            behind = i32(chunk + 31 - i32(cuda.clz(votes)))
        if x < width:
            valid[u32(base + u32(x))] = u8(measured)
        chunk = i32(chunk + 32)
    if lane == 0:
        some[u32(y)] = u8(behind >= 0)


@kernel(array(f32), array(u8), u32, u32, f32)
def fill_empty(disparity, some, height, width, empty_value):  # type: ignore[no-untyped-def]
    """Copy the nearest row that has valid pixels, the upper of equals, to the row of the block that has none."""
    y = u32(cuda.blockIdx.x)
    if some[y] != u8(0):  # the whole block
        return
    source = height
    away = u32(1)
    while away < height and source == height:
        if u32(y + away) < height and some[u32(y + away)] != u8(0):
            source = u32(y + away)
        if y >= away and some[u32(y - away)] != u8(0):
            source = u32(y - away)
        away = u32(away + u32(1))
    x = u32(cuda.threadIdx.x)
    while x < width:
        value = f32(empty_value)
        if source < height:
            value = disparity[u32(u32(source * width) + x)]
        disparity[u32(u32(y * width) + x)] = value
        x = u32(x + u32(cuda.blockDim.x))


def fill(queue: Queue, disparity: Any, mode: str | None, empty_value: float, shape: tuple[int, int]) -> Any:
    """Fill a map in place and return which of its pixels were valid before.

    Parameters
    ----------
    queue : Queue
        Queue of launches.
    disparity : (H * W,) float32, pixels, NaN where invalid
    mode : {"background", "nearest"} or None
        Rule of filling; None leaves gaps.
    empty_value : float
        Disparity of a filled map in which no pixel was valid.
    shape : (int, int)
        Height and width, pixels.

    Returns
    -------
    (H * W,) uint8
        1 where the pixel was valid.
    """
    height, width = shape
    valid = queue.array("post.valid", height * width, np.uint8)
    some = queue.array("post.some", height, np.uint8)
    blocks = blocks_for(32 * height, fill_rows.block)
    queue.launch(fill_rows, blocks, disparity, valid, some, height, width, _MODES[mode])
    if mode is not None:
        queue.launch(fill_empty, height, disparity, some, height, width, np.float32(empty_value))
    return valid
