"""Zero-mean normalised cross-correlation (StereoVAE paper, equations 1-3).

``rho = sum(dL * dR) / (sL * sR)`` over a square window with clamped borders, and ``C = min(1 - rho, 1)``. The
printed range of C is [0, 1] while ``1 - rho`` reaches 2, so it is clipped; a window without variance on either
side has C = 1.

With n pixels in the window, ``rho = (n*sum(LR) - sum(L)*sum(R)) / (sqrt(vL) * sqrt(vR))`` where
``v = n*sum(I*I) - sum(I)**2``. Images are centred and brought into a range for which n times a pixel fits 16 bits
(`Zncc.range_max`): then every sum, variance and numerator is an exact 32-bit integer, at most 2**30, and the n is
multiplied into the left pixel, not into the products. Only the two last factors, ``1 / sqrt(v)``, are floats, and
the product of the three is rounded once to `steps` levels.

Sums slide: those of the columns take one row in and one out, and a window's is the difference of two sums over all
columns up to one, so the work per cell does not grow with the window. (These wrap; their difference does not.) The
right pixels of the row that comes and of the one that goes make pairs, and so do their left factors, ``n * new`` and
``-n * old``. Where one instruction multiplies pairs and adds the two products, they lie side by side in one 32-bit
lane (`add_pairs`), and the window's own sums in such lanes, for what the numerator loses.

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
    PART,
    add,
    add_firsts,
    add_pairs,
    add_scaled,
    bits_of,
    convert,
    each_part,
    load_pairs,
    load_part,
    maximum,
    multiply,
    splat_pair_at,
    splat_part,
    splat_part_at,
    splat_parts,
    store,
    store_pair,
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
    sums: NDArray[np.int32]  # n times those of all columns up to c, element ((d // 64) * (C + 1) + c + 1) * 64 + d % 64
    factors: NDArray[np.int32]  # n * left pixels of the row that comes (low half), -n * those of the one that goes
    pairs: NDArray[np.int32]  # right pixels of the row that comes and of the one that goes, as of `store_pair`


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
    a lane, and `sums` those of the columns of one window, column c in place ``c % window``.
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
        sums, pairs = ((width + 2 * half + 1) * padded, 1) if pair.starts is None else (self.window * LANES, half + 1)
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
    at = place * images.right_stride
    right_low = images.right[new : new + count]
    right_high = images.right[old : old + count]
    for k in range(count):
        store_pair(rows.columns.pairs, at, images.right_stride, first + k, right_low[k], right_high[k])
    count = x1 - x0 + 2 * rows.half
    new = max(low_row, 0) * images.left_stride + x0
    old = max(high_row, 0) * images.left_stride + x0
    at = place * images.left_stride + x0
    n_low = np.int32(low_n if low_row >= 0 else 0)
    n_high = np.int32(high_n << 16 if high_row >= 0 else 0)
    left_low = images.left[new : new + count]
    left_high = images.left[old : old + count]
    factors = rows.columns.factors[at : at + count]
    for c in range(count):
        # Numba multiplies 64 bits; as they are cut once, at the end, LLVM makes it 32, and vectors.
        low = np.int64(n_low) * np.int64(left_low[c]) & 0xFFFF
        factors[c] = np.int32(low + np.int64(n_high) * np.int64(left_high[c]))


@inline
def _pair_rows(rows: ZnccRows, x0: int, x1: int, row_in: int, row_out: int) -> None:
    """Fill `pairs` and `factors` for a row of the padded images that comes and one that goes; -1 is none."""
    n = (2 * rows.half + 1) ** 2
    _write_pairs(rows, x0, x1, 0, row_in, row_out, n, -n)


class _Column(NamedTuple):
    """A padded column and 64 levels of it, for the steps of a row."""

    rows: ZnccRows
    c: int
    block: int  # the first level
    at: int  # element of the column's sums
    factors: Any


@inline
def _column(rows: ZnccRows, c: int, block: int) -> _Column:
    columns = rows.columns.factors.size
    at = (block // LANES * (columns + 1) + c + 1) * LANES
    return _Column(rows, c, block, at, splat_pair_at(rows.columns.factors, c))


@inline
def _gain(gained: Any, lane: int, column: _Column) -> Any:
    """Bring the sums up to a column to the row that `pairs` and `factors` lead to.

    `gained` is what those up to the column before have gained; return it with what this one gains.
    """
    columns = column.rows.columns
    k = columns.factors.size - 1 - column.c + column.block + lane
    gained = add_pairs(gained, load_pairs(columns.pairs, 0, columns.pairs.size, k), column.factors)
    store(columns.sums, column.at + lane, add(load_part(columns.sums, column.at + lane), gained))
    return gained


@inline
def _start_sums(rows: ZnccRows, y: int, x0: int, x1: int) -> None:
    """Fill the sums of columns x0..x1 with all rows of the window around row `y` but the last."""
    columns = rows.columns.factors.size
    for n in range(len(rows.cells.blocks)):
        for c in range(x0 - 1, x1 + 2 * rows.half):  # before column x0 they are 0
            for lane in range(0, LANES, PART):
                store(rows.columns.sums, (n * (columns + 1) + c + 1) * LANES + lane, splat_part(np.int32(0)))
    for row in range(y, y + 2 * rows.half):
        _pair_rows(rows, x0, x1, row, -1)
        for n in range(len(rows.cells.blocks)):
            gained = splat_parts(np.int32(0))
            for c in range(x0, x1 + 2 * rows.half):
                gained = each_part(_gain, gained, 0, _column(rows, c, n * LANES))


@by_types
def _to_costs(rho: Any, steps: Any, wide: Any) -> Any:
    """Return ``steps - max(round(rho), 0)`` as bytes; compiled code only."""
    # Adding this leaves the float's last bits no fraction: they hold the nearest integer, ties to even.
    magic = np.float32(1.5 * 2**23)

    def of_bytes(rho: Any, steps: Any, wide: Any) -> Any:
        whole = convert(bits_of(add(rho, splat_part(magic))), np.int8(0))
        return subtract(splat_part(np.uint8(steps)), convert(maximum(whole, splat_part(np.int8(0))), np.uint8(0)))

    def of_words(rho: Any, steps: Any, wide: Any) -> Any:
        whole = convert(bits_of(add(rho, splat_part(magic))), np.int16(0))
        return subtract(splat_part(np.uint8(steps)), convert(maximum(whole, splat_part(np.int16(0))), np.uint8(0)))

    return of_words if len(wide) > 0 else of_bytes


class _Pixel(NamedTuple):
    """A pixel and what its costs need besides the products of its windows; lanes of a vector are all the same."""

    rows: ZnccRows
    k: int  # right pixel of the first level
    to: int  # element of the costs
    left_sum: Any
    left_scale: Any
    out: NDArray[np.uint8]


@inline
def _pixel(rows: ZnccRows, y: int, x: int, level: int, to: int, out: NDArray[np.uint8]) -> _Pixel:
    k = y * rows.statistics.right_width + rows.cells.width - 1 - x + level
    here = y * rows.cells.width + x
    left_sum = splat_part_at(rows.statistics.left_sum, here)
    return _Pixel(rows, k, to, left_sum, splat_part_at(rows.statistics.left_scale, here), out)


@inline
def _write_costs(total: Any, lane: int, pixel: _Pixel) -> None:
    """Write the costs of a pixel, `PART` levels, from n times the products of their windows."""
    statistics = pixel.rows.statistics
    numerator = add_scaled(total, load_part(statistics.right_sum, pixel.k + lane), pixel.left_sum)
    rho = multiply(convert(numerator, np.float32(0)), load_part(statistics.right_scale, pixel.k + lane))
    costs = _to_costs(multiply(rho, pixel.left_scale), pixel.rows.steps, pixel.rows.wide_steps)
    store(pixel.out, pixel.to + lane, costs)


class _Window(NamedTuple):
    """A pixel and the newest column of its windows."""

    pixel: _Pixel
    column: _Column


@inline
def _slide(gained: Any, lane: int, window: _Window) -> Any:
    """Bring the newest column to this row and write the costs of the window; return what `_gain` does."""
    rows = window.pixel.rows
    gained = _gain(gained, lane, window.column)
    newest = window.column.at + lane
    before = load_part(rows.columns.sums, newest - (2 * rows.half + 1) * LANES)
    _write_costs(subtract(load_part(rows.columns.sums, newest), before), lane, window.pixel)
    return gained


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
    for n in range(len(cells.blocks)):
        block = n * LANES
        gained = splat_parts(np.int32(0))
        for c in range(x0, x0 + window - 1):
            gained = each_part(_gain, gained, 0, _column(rows, c, block))
        for x in range(x0, x1):
            pixel = _pixel(rows, y, x, block, x * padded + block, out)
            gained = each_part(_slide, gained, 0, _Window(pixel, _column(rows, x + window - 1, block)))
    mask_row(cells, y, x0, x1, out)


class _NarrowPair(NamedTuple):
    """A pair of rows of a padded column, for the steps of the narrow row."""

    rows: ZnccRows
    start: int  # of the pair in `pairs`
    k: int  # right pixel of the first level
    factors: Any


@inline
def _add_pair(sums: Any, lane: int, pair: _NarrowPair) -> Any:
    """Add the products of a pair of rows to the sums of columns."""
    pairs = load_pairs(pair.rows.columns.pairs, pair.start, pair.rows.images.right_stride, pair.k + lane)
    return add_pairs(sums, pairs, pair.factors)


@inline
def _add_last_row(sums: Any, lane: int, pair: _NarrowPair) -> Any:
    """Add the products of the last row of a window, whose pair has no second row."""
    pairs = load_pairs(pair.rows.columns.pairs, pair.start, pair.rows.images.right_stride, pair.k + lane)
    return add_firsts(sums, pairs, pair.factors)


@inline
def _narrow_pair(rows: ZnccRows, pair: int, c: int, start: int) -> _NarrowPair:
    images = rows.images
    factors = splat_pair_at(rows.columns.factors, pair * images.left_stride + c)
    return _NarrowPair(rows, pair * images.right_stride, images.left_stride - 1 - c + start, factors)


@inline
def _add_column(rows: ZnccRows, sums: Any, c: int, start: int) -> Any:
    """Add n times the products of padded column `c` of the window, for the levels from `start` on."""
    for pair in range(rows.half):
        sums = each_part(_add_pair, sums, 0, _narrow_pair(rows, pair, c, start))
    return each_part(_add_last_row, sums, 0, _narrow_pair(rows, rows.half, c, start))


class _Place(NamedTuple):
    """A pixel and the place of one column's sums."""

    pixel: _Pixel
    at: int


@inline
def _put_sums(sums: Any, lane: int, place: _Place) -> Any:
    """Write the sums up to a column; return them."""
    store(place.pixel.rows.columns.sums, place.at + lane, sums)
    return sums


@inline
def _narrow_slide(sums: Any, lane: int, place: _Place) -> Any:
    """Write the costs of the window whose last column `sums` lead up to.

    Those up to the column before the window are in the place where these are written.
    """
    _write_costs(subtract(sums, load_part(place.pixel.rows.columns.sums, place.at + lane)), lane, place.pixel)
    return _put_sums(sums, lane, place)


@implements(NarrowZnccRows)
@kernel
def _narrow_zncc_row(narrow: NarrowZnccRows, y: int, x0: int, x1: int, out: NDArray[np.uint8]) -> None:
    rows = narrow.window
    cells = rows.cells
    window = 2 * rows.half + 1
    n = window * window
    for pair in range(rows.half + 1):
        _write_pairs(rows, x0, x1, pair, y + 2 * pair, y + 2 * pair + 1 if pair < rows.half else -1, n, n)
    before = np.int64(-1)
    sums = splat_parts(np.int32(0))
    for x in range(x0, x1):
        start = np.int64(narrow.starts[y * cells.width + x])
        newest = x + window - 1
        pixel = _pixel(rows, y, x, start, x * LANES, out)
        if start != before:  # nothing slides: all columns of this window come anew
            sums = each_part(_put_sums, sums, 0, _Place(pixel, newest % window * LANES))
            for c in range(x, newest):
                sums = _add_column(rows, sums, c, start)
                sums = each_part(_put_sums, sums, 0, _Place(pixel, c % window * LANES))
        before = start
        sums = _add_column(rows, sums, newest, start)
        sums = each_part(_narrow_slide, sums, 0, _Place(pixel, newest % window * LANES))
    mask_narrow_row(cells, narrow.starts, y, x0, x1, out)
