"""Zero-mean normalised cross-correlation (StereoVAE paper, equations 1-3).

``rho = sum(dL * dR) / (sL * sR)`` over a square window with clamped borders, and ``C = min(1 - rho, 1)``. The
printed range of C is [0, 1] while ``1 - rho`` reaches 2, so it is clipped; a window without variance on either
side has C = 1.

With n pixels in the window, ``rho = (n*sum(LR) - sum(L)*sum(R)) / (sqrt(vL) * sqrt(vR))`` where
``v = n*sum(I*I) - sum(I)**2``. Images are centred and brought into a range for which n times a pixel fits 16 bits
(`Zncc.range_max`): then every sum, variance and numerator is an exact 32-bit integer, at most 2**30, and the n is
multiplied into the left pixel, not into the products. Only the two last factors, ``1 / sqrt(v)``, are floats, and
the product of the three is rounded once to `steps` levels.

Sums slide: the column sums of the products take one row in and one out, the window takes one column in and one out,
so the work per cell does not grow with the window. The right pixels of the row that comes and of the one that goes
lie side by side in one 32-bit lane, and so do their left factors, ``n * new`` and ``-n * old``: one instruction
(`multiply_pairs`) makes what a column gains, and with the window's own sums in such lanes, what the numerator loses.

Bound and measurement for 64 cells (512-bit vectors): column sums are read twice and written once, and the right
image's pairs, sums and factors are read once, at any alignment: 8 aligned loads at 0.29 ns, 12 others at 0.44 ns and
5 stores at 0.54 ns (each measured alone on a Zen 4 at 3.65 GHz) make 10.3 ns. The 47 operations on vectors (8
multiplications of pairs, 8 additions and subtractions that slide, 16 for conversion, two factors and rounding, 9 to
pack and to turn rho into a cost, and copies) would take 6.4 ns. Measured: 12.4 ns, 11.6 ms for 1242x375 with 128
levels on one thread. Memory ports bind, not the arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import CellMask, CostInput, cell_mask, implements, mask_narrow_row, mask_row
from stereokit.errors import OptionError
from stereokit.images.check import check_integer
from stereokit.kernels.jit import by_types, inline, kernel
from stereokit.kernels.simd import (
    LANES,
    add,
    bits_of,
    convert,
    load,
    maximum,
    multiply,
    multiply_pairs,
    splat,
    splat_at,
    store,
    subtract,
)
from stereokit.kernels.threads import run_stages, spans
from stereokit.kernels.workspace import Workspace
from stereokit.registry import COSTS

__all__ = ["Zncc"]


class Images(NamedTuple):
    """Padded images, grey values centred and brought into range; flat."""

    left: NDArray[np.int16]  # element (y + half) * left_stride + half + x
    left_stride: int
    right: NDArray[np.int16]  # reversed, element (y + half) * right_stride + half + k
    right_stride: int


class Statistics(NamedTuple):
    """Sums over windows and reciprocal roots of their variances; flat."""

    left_sum: NDArray[np.int32]  # negative, in the low half; element y * W + x
    left_scale: NDArray[np.float32]  # steps / sqrt(variance), 0 where there is none
    right_sum: NDArray[np.int32]  # element y * right_width + k
    right_scale: NDArray[np.float32]  # 1 / sqrt(variance), 0 where there is none
    right_width: int


class ColumnSums(NamedTuple):
    """Sums of products over the columns of the windows around one row, which slide with it; of one worker."""

    row: NDArray[np.int64]  # (3,): that row, or -1, the first column and the one behind the last
    sums: NDArray[np.int32]  # n times the sums, element ((d // 64) * C + half + x) * 64 + d % 64
    factors: NDArray[np.int32]  # n * left pixels of the row that comes (low half), -n * those of the one that goes
    pairs: NDArray[np.int32]  # right pixels of the row that comes (low half) and of the one that goes (high half)


class ZnccRows(NamedTuple):
    """Padded images, window statistics and the column sums of one worker, for `cost_row`."""

    cells: CellMask
    half: int  # half the window
    images: Images
    statistics: Statistics
    columns: ColumnSums
    steps: int
    wide_steps: tuple[int, ...]  # not empty when steps do not fit a signed byte; known to the compiler


class NarrowZnccRows(NamedTuple):
    """The same for pixels that search `LANES` levels from `starts` on.

    Nothing slides from row to row there: `columns` has the pairs and the factors of all rows of a window, two rows to
    a lane, and `sums` those of the columns of one window.
    """

    window: ZnccRows
    starts: NDArray[np.int16]  # (H * W)


@COSTS.register("zncc")
@dataclass(frozen=True)
class Zncc:
    """``min(1 - rho, 1)`` in `steps` levels, rho the correlation of the two windows.

    Parameters
    ----------
    window : int
        Side of the square window in pixels, odd, 3 to 127.
    steps : int
        The cost 1 as an integer, 1 to 254.
    """

    window: int = 5
    steps: int = 31
    name: ClassVar[str] = "zncc"
    narrow: ClassVar[bool] = True
    cuda: ClassVar[str] = "stereokit.costs.zncc_cuda"
    needs_ranges: ClassVar[bool] = True
    bytes_per_pixel: ClassVar[int] = 4

    def __post_init__(self) -> None:
        window = check_integer("window", self.window, 3, 127)
        if window % 2 == 0:
            raise OptionError(f"window must be odd, got {window}")
        object.__setattr__(self, "window", window)
        object.__setattr__(self, "steps", check_integer("steps", self.steps, 1, 254))

    @property
    def cost_max(self) -> int:
        """Largest cost."""
        return self.steps

    @property
    def reach(self) -> tuple[int, int]:
        """Half of the window across and down, pixels."""
        return self.window // 2, self.window // 2

    @property
    def unit(self) -> int:
        """Penalties are given on the scale of C = min(1 - rho, 1), which `steps` units of cost make up."""
        return self.steps

    @property
    def range_max(self) -> int:
        """Largest grey range for which n times a centred pixel fits 16 bits."""
        return 2 * ((2**15 - 1) // (self.window * self.window))

    @property
    def costly_to_recompute(self) -> bool:
        """Whether a row costs more to compute again than to bring back from a volume."""
        return True

    def prepare(self, pair: CostInput, workspace: Workspace, workers: int) -> list[Any]:
        """Compute the window statistics; return the row producers of `workers` sweeps."""
        half = self.window // 2
        height, width = pair.left.shape
        padded = pair.levels.padded
        rows = height + 2 * half
        left = workspace.array("zncc.left", (rows, width + 2 * half), np.int16)
        right_width = width + padded
        right = workspace.array("zncc.right", (rows, right_width + 2 * half), np.int16)
        start = width - 1 - pair.levels.minimum + half
        left_sum = workspace.array("zncc.left_sum", (height, width), np.int32)
        left_scale = workspace.array("zncc.left_scale", (height, width), np.float32)
        right_sum = workspace.array("zncc.right_sum", (height, right_width), np.int32)
        right_scale = workspace.array("zncc.right_scale", (height, right_width), np.float32)
        scales: dict[bool, tuple[int, np.float32]] = {}
        grey = {True: pair.left, False: pair.right}

        def measure(of_left: bool) -> None:
            image = grey[of_left]
            if pair.ranges is None:
                low, high = int(image.min()), int(image.max())
            else:  # smoothing at the side of a window may leave the range
                low, high = pair.ranges[0 if of_left else 1]
                grey[of_left] = np.clip(image, low, high)
            scales[of_left] = self._scale(low, high)

        def centre(y0: int, y1: int, of_left: bool) -> None:
            if of_left:
                _centre(grey[True], y0, y1, half, 1, -half, *scales[True], left)
            else:
                _centre(grey[False], y0, y1, half, -1, start, *scales[False], right)

        def summarise(k: int, y0: int, y1: int) -> None:
            work = workspace.array(f"zncc.work{k}", (4, right_width + 2 * half), np.int32)
            _statistics(left, y0, y1, self.window, self.steps, True, work, left_sum, left_scale)
            _statistics(right, y0, y1, self.window, 1, False, work, right_sum, right_scale)

        stages: list[list[Any]] = [
            [partial(measure, True), partial(measure, False)],
            [partial(centre, y0, y1, of_left) for y0, y1 in spans(rows, pair.threads) for of_left in (True, False)],
            [partial(summarise, k, y0, y1) for k, (y0, y1) in enumerate(spans(height, pair.threads))],
        ]
        run_stages(stages, pair.threads)
        cells = cell_mask(pair, self.cost_max, workspace)
        images = Images(left=left.ravel(), left_stride=left.shape[1], right=right.ravel(), right_stride=right.shape[1])
        statistics = Statistics(
            left_sum=left_sum.ravel(),
            left_scale=left_scale.ravel(),
            right_sum=right_sum.ravel(),
            right_scale=right_scale.ravel(),
            right_width=right_width,
        )
        producers: list[Any] = []
        sums, pairs = ((width + 2 * half) * padded, 1) if pair.starts is None else (self.window * LANES, half + 1)
        for worker in range(workers):
            columns = ColumnSums(
                row=workspace.array(f"zncc.row{worker}", 3, np.int64),
                sums=workspace.array(f"zncc.sums{worker}", sums, np.int32),
                factors=workspace.array(f"zncc.factors{worker}", pairs * (width + 2 * half), np.int32),
                pairs=workspace.array(f"zncc.pairs{worker}", pairs * (right_width + 2 * half), np.int32),
            )
            columns.row[0] = -1
            producer = ZnccRows(
                cells=cells,
                half=half,
                images=images,
                statistics=statistics,
                columns=columns,
                steps=self.steps,
                wide_steps=(0,) if self.steps > 127 else (),
            )
            producers.append(producer if pair.starts is None else NarrowZnccRows(producer, pair.starts.ravel()))
        return producers

    def _scale(self, low: int, high: int) -> tuple[int, np.float32]:
        """Return the middle of a range and the factor that brings it into `range_max`, 1 at most."""
        factor = np.float32(min(1.0, self.range_max / max(high - low, 1)))
        return (low + high) // 2, factor  # whole, or every pixel would be rounded from a half


@kernel
def _centre(
    image: NDArray[Any], y0: int, y1: int, margin: int, step: int, start: int, middle: int, factor: np.float32,
    out: NDArray[np.int16],
) -> None:  # fmt: skip
    """Write ``(image - middle) * factor``, rounded: rows y0..y1 of `out`, whose borders are clamped.

    Element k of a row is column ``start + step * k``.
    """
    height, width = image.shape
    for row in range(y0, y1):
        source = image[min(max(row - margin, 0), height - 1)]
        target = out[row]
        # From element `low` to before `high` the column lies inside.
        low = min(max(-start if step > 0 else start - width + 1, 0), target.size)
        high = min(max(width - start if step > 0 else start + 1, low), target.size)
        if step > 0:
            for k in range(low, high):
                grey = np.float32(np.int32(source[start + k]) - np.int32(middle)) * factor
                target[k] = np.int16(np.rint(grey))
        else:
            for k in range(low, high):
                grey = np.float32(np.int32(source[start - k]) - np.int32(middle)) * factor
                target[k] = np.int16(np.rint(grey))
        first = np.float32(np.int32(source[0 if step > 0 else width - 1]) - np.int32(middle)) * factor
        last = np.float32(np.int32(source[width - 1 if step > 0 else 0]) - np.int32(middle)) * factor
        target[:low] = np.int16(np.rint(first))
        target[high:] = np.int16(np.rint(last))


@kernel
def _statistics(
    image: NDArray[np.int16], y0: int, y1: int, window: int, scale: int, left: bool, work: NDArray[np.int32],
    out_sum: NDArray[np.int32], out_scale: NDArray[np.float32],
) -> None:  # fmt: skip
    """Window sums and scale / sqrt(variance) of rows y0..y1 of a padded image; sums in the form of the `left` ones."""
    width = out_sum.shape[1]
    sums = work[0, : width + window - 1]
    squares = work[1, : width + window - 1]
    total = work[2, :width]
    square = work[3, :width]
    sums[:] = 0
    squares[:] = 0
    n = np.int32(window * window)
    for y in range(y0, y1):
        if y == y0:
            for row in range(y, y + window):
                for k in range(sums.size):
                    value = np.int32(image[row, k])
                    sums[k] += value
                    squares[k] += np.int32(value * value)
        else:
            for k in range(sums.size):
                new = np.int32(image[y + window - 1, k])
                old = np.int32(image[y - 1, k])
                sums[k] += np.int32(new - old)
                squares[k] += np.int32(np.int32(new * new) - np.int32(old * old))
        # Whole rows at a time, not a sliding sum: each of these loops becomes vector code.
        total[:] = 0
        square[:] = 0
        for j in range(window):
            for x in range(width):
                total[x] += sums[x + j]
                square[x] += squares[x + j]
        for x in range(width):
            variance = np.int32(np.int32(n * square[x]) - np.int32(total[x] * total[x]))
            out_sum[y, x] = np.int32(-total[x]) & np.int32(0xFFFF) if left else total[x]
            root = np.sqrt(np.float32(max(variance, np.int32(1))))
            out_scale[y, x] = np.float32(scale) / root if variance > 0 else np.float32(0)


@inline
def _write_pairs(
    rows: ZnccRows, x0: int, x1: int, place: int, low_row: int, high_row: int, low_n: int, high_n: int
) -> None:
    """Write two rows of the padded right image into the halves of lanes, and those of the left one times a factor.

    What the windows around columns x0..x1 need of them. `place` counts pairs of rows; a row that is -1 is none.
    """
    images = rows.images
    first = rows.cells.width - x1  # right pixel of level 0 of the last column
    count = min(x1 - x0 + rows.cells.padded + 2 * rows.half, images.right_stride - first)
    new = max(low_row, 0) * images.right_stride + first
    old = max(high_row, 0) * images.right_stride + first
    at = place * images.right_stride + first
    right_low = images.right[new : new + count]
    right_high = images.right[old : old + count]
    pairs = rows.columns.pairs[at : at + count]
    for k in range(count):
        low = np.int32(right_low[k]) & np.int32(0xFFFF)
        high = np.int32(np.int32(right_high[k]) << np.int32(16))
        pairs[k] = np.int32(low | high)
    count = x1 - x0 + 2 * rows.half
    new = max(low_row, 0) * images.left_stride + x0
    old = max(high_row, 0) * images.left_stride + x0
    at = place * images.left_stride + x0
    n_low = np.int32(low_n) if low_row >= 0 else np.int32(0)
    n_high = np.int32(high_n) if high_row >= 0 else np.int32(0)
    left_low = images.left[new : new + count]
    left_high = images.left[old : old + count]
    factors = rows.columns.factors[at : at + count]
    for c in range(count):
        low = np.int32(n_low * np.int32(left_low[c])) & np.int32(0xFFFF)
        high = np.int32(np.int32(n_high * np.int32(left_high[c])) << np.int32(16))
        factors[c] = np.int32(low | high)


@inline
def _pair_rows(rows: ZnccRows, x0: int, x1: int, row_in: int, row_out: int) -> None:
    """Fill `pairs` and `factors` for a row of the padded images that comes and one that goes; -1 is none."""
    n = (2 * rows.half + 1) ** 2
    _write_pairs(rows, x0, x1, 0, row_in, row_out, n, -n)


@inline
def _column(rows: ZnccRows, at: int, c: int, block: int) -> Any:
    """Bring the sums of padded column `c`, at element `at`, to the row that `pairs` and `factors` lead to."""
    right = load(rows.columns.pairs, rows.columns.factors.size - 1 - c + block)
    column = add(load(rows.columns.sums, at), multiply_pairs(right, splat_at(rows.columns.factors, c)))
    store(rows.columns.sums, at, column)
    return column


@inline
def _start_sums(rows: ZnccRows, y: int, x0: int, x1: int) -> None:
    """Fill the column sums of columns x0..x1 with all rows of the window around row `y` but the last."""
    columns = rows.columns.factors.size
    for n in range(len(rows.cells.blocks)):
        for c in range(x0, x1 + 2 * rows.half):
            store(rows.columns.sums, (n * columns + c) * LANES, splat(np.int32(0)))
    for row in range(y, y + 2 * rows.half):
        _pair_rows(rows, x0, x1, row, -1)
        for n in range(len(rows.cells.blocks)):
            for c in range(x0, x1 + 2 * rows.half):
                _column(rows, (n * columns + c) * LANES, c, n * LANES)


@by_types
def _to_costs(rho: Any, steps: Any, wide: Any) -> Any:
    """Return ``steps - max(round(rho), 0)`` as bytes; compiled code only."""
    # Adding this leaves the float's last bits no fraction: they hold the nearest integer, ties to even.
    magic = np.float32(1.5 * 2**23)

    def of_bytes(rho: Any, steps: Any, wide: Any) -> Any:
        whole = convert(bits_of(add(rho, splat(magic))), np.int8(0))
        return subtract(splat(np.uint8(steps)), convert(maximum(whole, splat(np.int8(0))), np.uint8(0)))

    def of_words(rho: Any, steps: Any, wide: Any) -> Any:
        whole = convert(bits_of(add(rho, splat(magic))), np.int16(0))
        return subtract(splat(np.uint8(steps)), convert(maximum(whole, splat(np.int16(0))), np.uint8(0)))

    return of_words if len(wide) > 0 else of_bytes


@inline
def _cost_of(rows: ZnccRows, y: int, x: int, k: int, total: Any) -> Any:
    """Return the costs of 64 levels of a pixel whose first right pixel is element `k`, from n times their products."""
    left_sum = splat_at(rows.statistics.left_sum, y * rows.cells.width + x)
    numerator = add(total, multiply_pairs(load(rows.statistics.right_sum, k), left_sum))
    rho = multiply(convert(numerator, np.float32(0)), load(rows.statistics.right_scale, k))
    rho = multiply(rho, splat_at(rows.statistics.left_scale, y * rows.cells.width + x))
    return _to_costs(rho, rows.steps, rows.wide_steps)


@implements(ZnccRows)
@kernel
def _zncc_row(rows: ZnccRows, y: int, x0: int, x1: int, out: NDArray[np.uint8]) -> None:
    cells = rows.cells
    window = 2 * rows.half + 1
    state = rows.columns.row
    last = state[0] if state[1] == x0 and state[2] == x1 else np.int64(-1)
    row_in = np.int64(-1)  # of the padded image: row y of it is the top of the window around row y
    row_out = np.int64(-1)
    if last >= 0 and y == last + 1:
        row_in = y + window - 1
        row_out = last
    elif last >= 0 and y == last - 1:
        row_in = np.int64(y)
        row_out = last + window - 1
    elif y != last:
        _start_sums(rows, y, x0, x1)
        row_in = y + window - 1
    state[0] = y
    state[1] = x0
    state[2] = x1
    _pair_rows(rows, x0, x1, row_in, row_out)
    padded = LANES * len(cells.blocks)
    columns = cells.width + window - 1
    for n in range(len(cells.blocks)):
        block = n * LANES
        base = n * columns * LANES
        # One pass: a column's sum is brought to this row, then it enters the window and the oldest leaves.
        total = splat(np.int32(0))
        for c in range(x0, x0 + window - 1):
            total = add(total, _column(rows, base + c * LANES, c, block))
        for x in range(x0, x1):
            at = base + x * LANES  # of the oldest column
            total = add(total, _column(rows, at + (window - 1) * LANES, x + window - 1, block))
            k = y * rows.statistics.right_width + cells.width - 1 - x + block
            store(out, x * padded + block, _cost_of(rows, y, x, k, total))
            total = subtract(total, load(rows.columns.sums, at))
    mask_row(cells, y, x0, x1, out)


@inline
def _narrow_column(rows: ZnccRows, c: int, start: int) -> Any:
    """Return n times the products of padded column `c` of the window, for the levels from `start` on."""
    total = splat(np.int32(0))
    for pair in range(rows.half + 1):
        right = load(rows.columns.pairs, pair * rows.images.right_stride + rows.images.left_stride - 1 - c + start)
        factors = splat_at(rows.columns.factors, pair * rows.images.left_stride + c)
        total = add(total, multiply_pairs(right, factors))
    return total


@implements(NarrowZnccRows)
@kernel
def _narrow_zncc_row(narrow: NarrowZnccRows, y: int, x0: int, x1: int, out: NDArray[np.uint8]) -> None:
    rows = narrow.window
    cells = rows.cells
    window = 2 * rows.half + 1
    n = window * window
    for pair in range(rows.half + 1):
        _write_pairs(rows, x0, x1, pair, y + 2 * pair, y + 2 * pair + 1 if pair < rows.half else -1, n, n)
    sums = rows.columns.sums
    before = np.int64(-1)
    total = splat(np.int32(0))
    for x in range(x0, x1):
        start = np.int64(narrow.starts[y * cells.width + x])
        if start == before:  # the window slides: its oldest column leaves, in whose place the next one is kept
            at = (x - 1) % window * LANES
            column = _narrow_column(rows, x + window - 1, start)
            total = add(subtract(total, load(sums, at)), column)
            store(sums, at, column)
        else:
            total = splat(np.int32(0))
            for c in range(x, x + window):
                column = _narrow_column(rows, c, start)
                total = add(total, column)
                store(sums, c % window * LANES, column)
        before = start
        k = y * rows.statistics.right_width + cells.width - 1 - x + start
        store(out, x * LANES, _cost_of(rows, y, x, k, total))
    mask_narrow_row(cells, narrow.starts, y, x0, x1, out)
