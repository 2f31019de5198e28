"""The CUDA twin of the median: a thread a pixel, in registers, without branches.

Invalid values of a window count as minus and plus infinity in turn, minus first: so the middle of all values is the
lower of the middle two of the valid ones. The middle is found by forgetting (McGuire 2008): of half the values and
two more, the lowest and the highest cannot be the middle; they are dropped and one more value is newest in, until
three are left.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereokit.cuda.kernel import Kernel, Queue, array, blocks_for, cuda, device, f32, i32, kernel, u32

__all__ = ["median"]

_LOWEST, _HIGHEST = np.float32(-np.inf), np.float32(np.inf)


@device
def _middle_of_three(values):  # type: ignore[no-untyped-def]
    low, high = min(values[0], values[1]), max(values[0], values[1])
    return max(low, min(high, values[2]))


def _forgetting(count: int, newest: int, then: Any) -> Any:
    """Return the helper that drops the extremes of the first `count` values, takes in another and goes on."""

    @device
    def forget(values):  # type: ignore[no-untyped-def]
        for k in range(count // 2):
            a, b = values[k], values[count - 1 - k]
            values[k], values[count - 1 - k] = min(a, b), max(a, b)
        for k in range(1, (count + 1) // 2):
            a, b = values[0], values[k]
            values[0], values[k] = min(a, b), max(a, b)
        for k in range(count // 2, count - 1):
            a, b = values[k], values[count - 1]
            values[k], values[count - 1] = min(a, b), max(a, b)
        values[0] = values[newest]  # the lowest makes room; the highest is out of the range of the next helper
        return then(values)

    return forget


def _make_median(size: int) -> Kernel:
    half, area = size // 2, size * size
    first = area // 2 + 2
    middle = _middle_of_three
    for count, newest in enumerate(range(area - 1, first - 1, -1), 4):
        middle = _forgetting(count, newest, middle)

    @kernel(array(f32), array(f32), i32, i32, name=f"median_{size}")
    def median(source, out, height, width):  # type: ignore[no-untyped-def]
        at = u32(cuda.grid(1))
        if at >= u32(u32(height) * u32(width)):
            return
        y = i32(at // u32(width))
        x = i32(at - u32(u32(y) * u32(width)))
        values = cuda.local.array(area, f32)
        below = True
        for dy in range(size):
            row = u32(u32(min(max(i32(y + dy - half), 0), i32(height - 1))) * u32(width))
            for dx in range(size):
                value = source[u32(row + u32(min(max(i32(x + dx - half), 0), i32(width - 1))))]
                if value != value:
                    value = _LOWEST if below else _HIGHEST
                    below = not below
                values[dy * size + dx] = value
        value = source[at]
        if value == value:
            value = middle(values)
        out[at] = value

    result: Kernel = median
    return result


_KERNELS = {size: _make_median(size) for size in (3, 5)}


def median(queue: Queue, disparity: Any, size: int, shape: tuple[int, int]) -> Any:
    """Return the median-filtered map, (H * W,) float32; what is invalid stays so.

    Parameters
    ----------
    queue : Queue
        Queue of launches.
    disparity : (H * W,) float32, pixels, NaN where invalid
    size : {3, 5}
        Side of the window in pixels.
    shape : (int, int)
        Height and width, pixels.
    """
    height, width = shape
    out = queue.array("post.median", height * width, np.float32)
    what = _KERNELS[size]
    queue.launch(what, blocks_for(height * width, what.block), disparity, out, height, width)
    return out
