"""Zero-mean normalised cross-correlation (StereoVAE paper, equations 1-3).

``rho = sum(dL * dR) / (sL * sR)`` over a square window with clamped borders, and ``C = min(1 - rho, 1)``. The
printed range of C is [0, 1] while ``1 - rho`` reaches 2, so it is clipped; a window without variance on either
side has C = 1.

With n pixels in the window, ``rho = (n*sum(LR) - sum(L)*sum(R)) / (sqrt(vL) * sqrt(vR))`` where
``v = n*sum(I*I) - sum(I)**2``. The numerator is computed exactly in 32-bit integers: it may wrap on the way, but
its value is at most ``(n * range / 2)**2``, and images are brought into a range for which that fits. Sums slide:
the column sums of the products take one row in and one out, the window takes one column in and one out, so the
work per cell does not grow with the window. The cost is rounded to `steps` levels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from stereokit.costs.rows import Cells, Pair, cells_of, close_row, implements, pad_pair
from stereokit.errors import OptionError
from stereokit.inputs import check_integer
from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.pool import run, spans
from stereokit.kernels.simd import LANES, add, convert, load, maximum, multiply, splat, store, subtract
from stereokit.kernels.workspace import Workspace
from stereokit.registry import COSTS

__all__ = ["Zncc"]


class ZnccRows(NamedTuple):
    """Padded images, window statistics and the running sums of one worker, for `cost_row`."""

    cells: Cells
    half: int  # half the window
    left: NDArray[Any]  # padded image, element (y + half) * left_stride + half + x
    left_stride: int
    right: NDArray[Any]  # padded and reversed, element (y + half) * right_stride + half + k
    right_stride: int
    left_sum: NDArray[np.int32]  # sum over the window, element y * W + x
    left_scale: NDArray[np.float32]  # steps / sqrt(variance), 0 where there is none
    right_sum: NDArray[np.int32]  # element y * right_width + k
    right_scale: NDArray[np.float32]  # 1 / sqrt(variance), 0 where there is none
    right_width: int
    steps: int
    sums: NDArray[np.int32]  # n times the column sums around row `at`, element ((d // 64) * C + half + x) * 64 + d % 64
    at: NDArray[np.int64]  # (1,): the row whose column sums are held, or -1


@COSTS.register("zncc")
@dataclass(frozen=True)
class Zncc:
    """``min(1 - rho, 1)`` in `steps` levels, rho the correlation of the two windows.

    Parameters
    ----------
    window : int
        Side of the square window in pixels, odd, 3 or more.
    steps : int
        The cost 1 as an integer, 1 to 254.
    """

    window: int = 5
    steps: int = 31
    name: ClassVar[str] = "zncc"

    def __post_init__(self) -> None:
        window = check_integer("window", self.window, 3, 255)
        if window % 2 == 0:
            raise OptionError(f"window must be odd, got {window}")
        object.__setattr__(self, "window", window)
        object.__setattr__(self, "steps", check_integer("steps", self.steps, 1, 254))

    @property
    def cost_max(self) -> int:
        """Largest cost."""
        return self.steps

    @property
    def unit(self) -> int:
        """Penalties are given on the scale of C = min(1 - rho, 1), which `steps` units of cost make up."""
        return self.steps

    @property
    def range_max(self) -> int:
        """Largest grey range for which the numerator fits 32 bits."""
        return int(2 * np.sqrt(2.0**31 - 1) / (self.window * self.window))

    def prepare(self, pair: Pair, workspace: Workspace, workers: int) -> list[ZnccRows]:
        """Compute the window statistics; return the row producers of `workers` sweeps."""
        half = self.window // 2
        height, width = pair.left.shape
        padded = pair.levels.padded
        pair = replace(
            pair,
            left=self._in_range(pair.left, "zncc.left", workspace, pair.threads),
            right=self._in_range(pair.right, "zncc.right", workspace, pair.threads),
        )
        left, right = pad_pair(pair, half, workspace)
        right_width = width + padded
        left_sum = workspace.array("zncc.left_sum", (height, width), np.int32)
        left_scale = workspace.array("zncc.left_scale", (height, width), np.float32)
        right_sum = workspace.array("zncc.right_sum", (height, right_width), np.int32)
        right_scale = workspace.array("zncc.right_scale", (height, right_width), np.float32)
        tasks: list[Any] = []
        for k, (y0, y1) in enumerate(spans(height, pair.threads)):
            work = workspace.array(f"zncc.work{k}", (2, 4, right_width + 2 * half), np.int64)
            tasks.append(partial(_statistics, left, y0, y1, self.window, self.steps, work[0], left_sum, left_scale))
            tasks.append(partial(_statistics, right, y0, y1, self.window, 1, work[1], right_sum, right_scale))
        run(tasks, pair.threads)
        cells = cells_of(pair, self.cost_max, workspace)
        rows = []
        for worker in range(workers):
            sums = workspace.array(f"zncc.sums{worker}", (width + 2 * half) * padded, np.int32)
            at = workspace.array(f"zncc.at{worker}", 1, np.int64)
            at[0] = -1
            rows.append(
                ZnccRows(
                    cells,
                    half,
                    left.ravel(),
                    left.shape[1],
                    right.ravel(),
                    right.shape[1],
                    left_sum.ravel(),
                    left_scale.ravel(),
                    right_sum.ravel(),
                    right_scale.ravel(),
                    right_width,
                    self.steps,
                    sums,
                    at,
                )
            )
        return rows

    def _in_range(self, image: NDArray[Any], name: str, workspace: Workspace, threads: int) -> NDArray[Any]:
        """Return `image` centred around 0 and, if need be, scaled to `range_max`: rho does not change."""
        if image.dtype == np.uint8 and self.range_max >= 255:
            return np.asarray((image ^ np.uint8(128)).view(np.int8))
        low, high = int(image.min()), int(image.max())
        factor = np.float32(min(1.0, self.range_max / max(high - low, 1)))
        middle = (low + high) // 2  # whole, or every pixel would be rounded from a half
        out = workspace.array(name, image.shape, np.int16)
        run([partial(_rescale, image, y0, y1, middle, factor, out) for y0, y1 in spans(len(image), threads)], threads)
        return out


@kernel
def _statistics(
    image: NDArray[Any], y0: int, y1: int, window: int, scale: int, work: NDArray[np.int64],
    out_sum: NDArray[np.int32], out_scale: NDArray[np.float32],
) -> None:  # fmt: skip
    """Window sums and scale / sqrt(variance) of rows y0..y1; columns beyond the output's width are not read."""
    width = out_sum.shape[1]
    sums = work[0, : width + window - 1]
    squares = work[1, : width + window - 1]
    total = work[2, :width]
    square = work[3, :width]
    sums[:] = 0
    squares[:] = 0
    n = np.int64(window * window)
    for y in range(y0, y1):
        if y == y0:
            for row in range(y, y + window):
                for k in range(sums.size):
                    value = np.int64(image[row, k])
                    sums[k] += value
                    squares[k] += value * value
        else:
            for k in range(sums.size):
                new = np.int64(image[y + window - 1, k])
                old = np.int64(image[y - 1, k])
                sums[k] += new - old
                squares[k] += new * new - old * old
        # Whole rows at a time, not a sliding sum: each of these loops becomes vector code.
        total[:] = 0
        square[:] = 0
        for j in range(window):
            for x in range(width):
                total[x] += sums[x + j]
                square[x] += squares[x + j]
        for x in range(width):
            variance = n * square[x] - total[x] * total[x]
            out_sum[y, x] = np.int32(total[x])
            root = np.sqrt(np.float64(max(variance, np.int64(1))))
            out_scale[y, x] = np.float32(scale / root) if variance > 0 else np.float32(0)


@kernel
def _rescale(image: NDArray[Any], y0: int, y1: int, middle: int, factor: np.float32, out: NDArray[np.int16]) -> None:
    """Write ``(image - middle) * factor``, rounded, for rows y0..y1."""
    for y in range(y0, y1):
        for x in range(image.shape[1]):
            out[y, x] = np.int16(np.rint(np.float32(np.int32(image[y, x]) - np.int32(middle)) * factor))


def _products(n: int, a: Any, row_a: Any, b: Any, row_b: Any) -> Any:
    """Return ``n * (a * row_a - b * row_b)`` as int32 vectors, modulo 2**32; compiled code only."""
    raise NotImplementedError("compiled code only")


@overload(_products, strict=False, jit_options={"forceinline": True})
def _choose_products(n: Any, a: Any, row_a: Any, b: Any, row_b: Any) -> Any:
    narrow = row_a.scalar == types.int8

    def of_bytes(n: Any, a: Any, row_a: Any, b: Any, row_b: Any) -> Any:
        # Products of int8 are at most 2**14 and at least -2**14 + 2**7, so that their difference fits int16.
        first = multiply(splat(np.int16(a)), convert(row_a, np.int16(0)))
        second = multiply(splat(np.int16(b)), convert(row_b, np.int16(0)))
        return multiply(convert(subtract(first, second), np.int32(0)), splat(np.int32(n)))

    def of_words(n: Any, a: Any, row_a: Any, b: Any, row_b: Any) -> Any:
        first = multiply(splat(np.int32(n * a)), convert(row_a, np.int32(0)))
        second = multiply(splat(np.int32(n * b)), convert(row_b, np.int32(0)))
        return subtract(first, second)

    return of_bytes if narrow else of_words


@inline
def _change(rows: ZnccRows, row_in: int, row_out: int, c: int, block: int) -> Any:
    """Return what the column sums of padded column `c` gain when a row comes in and one goes; -1 stands for none."""
    new = rows.left[max(row_in, 0) * rows.left_stride + c]
    old = rows.left[max(row_out, 0) * rows.left_stride + c]
    zero = rows.left.dtype.type(0)
    k = rows.cells.width + 2 * rows.half - 1 - c + block
    theirs_new = load(rows.right, max(row_in, 0) * rows.right_stride + k)
    theirs_old = load(rows.right, max(row_out, 0) * rows.right_stride + k)
    n = (2 * rows.half + 1) ** 2
    return _products(n, new if row_in >= 0 else zero, theirs_new, old if row_out >= 0 else zero, theirs_old)


@inline
def _start_sums(rows: ZnccRows, y: int) -> None:
    """Fill the column sums with all rows of the window around row `y` but the last."""
    columns = rows.cells.width + 2 * rows.half
    for n in range(len(rows.cells.blocks)):
        for c in range(columns):
            at = (n * columns + c) * LANES
            total = splat(np.int32(0))
            for row in range(y, y + 2 * rows.half):
                total = add(total, _change(rows, row, -1, c, n * LANES))
            store(rows.sums, at, total)


@implements(ZnccRows)
@kernel
def _zncc_row(rows: ZnccRows, y: int, out: NDArray[np.uint8]) -> None:
    cells = rows.cells
    window = 2 * rows.half + 1
    last = rows.at[0]
    row_in = np.int64(-1)  # of the padded image: row y of it is the top of the window around row y
    row_out = np.int64(-1)
    if last >= 0 and y == last + 1:
        row_in = y + window - 1
        row_out = last
    elif last >= 0 and y == last - 1:
        row_in = np.int64(y)
        row_out = last + window - 1
    elif y != last:
        _start_sums(rows, y)
        row_in = y + window - 1
    rows.at[0] = y
    padded = LANES * len(cells.blocks)
    columns = cells.width + window - 1
    most = splat(np.float32(rows.steps) + np.float32(0.5))
    zero = splat(np.float32(0))
    for n in range(len(cells.blocks)):
        block = n * LANES
        total = splat(np.int32(0))
        for c in range(columns):
            # One pass: a column's sum is brought to this row, then it enters the window and the oldest leaves.
            at = (n * columns + c) * LANES
            column = add(load(rows.sums, at), _change(rows, row_in, row_out, c, block))
            store(rows.sums, at, column)
            total = add(total, column)
            x = c - window + 1
            if x < 0:
                continue
            k = y * rows.right_width + cells.width - 1 - x + block
            mine = splat(rows.left_sum[y * cells.width + x])
            numerator = subtract(total, multiply(mine, load(rows.right_sum, k)))
            scale = multiply(splat(rows.left_scale[y * cells.width + x]), load(rows.right_scale, k))
            rho = maximum(multiply(convert(numerator, np.float32(0)), scale), zero)
            store(out, x * padded + block, convert(subtract(most, rho), np.uint8(0)))
            total = subtract(total, load(rows.sums, at - (window - 1) * LANES))
    close_row(cells, y, out)
