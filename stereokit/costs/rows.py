"""The common part of all costs: levels of disparity, padded images, and the mask of the cells without evidence.

A cost is a *producer of rows*. It prepares an image pair once and returns, for each worker, a named tuple of
arrays; `cost_row` then writes the costs of a part of row `y`, ``(W, P)`` ``uint8``, disparity innermost, when a sweep
asks for it. Costs are cheap to compute again, so the cost volume is never stored.

The *type* of the named tuple decides, when a sweep is compiled, which code `cost_row` runs (see
`implements`): two producers times two sweeps are four specialisations of one source, and a third cost is one
more file.

The right image is stored reversed: level ``d`` of left column ``x`` needs right column ``x - d - min_disparity``,
which is element ``(W - 1 - x) + d`` of the reversed row. So the levels of one pixel are contiguous on the right
too, and one vector load brings 64 of them::

    right column   W-1-min  ...   x-min   x-min-1   x-min-2 ...
    element            0    ...   W-1-x   W-x       W-x+1   ...
    level of x                      0       1         2     ...
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError
from stereokit.kernels.jit import by_types, inline, kernel
from stereokit.kernels.simd import LANES, aligned, bitwise_or, load, maximum, minimum, splat, store
from stereokit.kernels.threads import run, spans
from stereokit.kernels.workspace import Workspace

__all__ = [
    "UNEXPECTED",
    "WORST",
    "CellMask",
    "Cost",
    "CostInput",
    "Levels",
    "Search",
    "VolumeRows",
    "cell_mask",
    "cost_row",
    "implements",
    "mask_narrow_row",
    "mask_row",
    "pad_pair",
    "produce_volume",
    "takes_8_bits",
]

WORST = np.uint8(255)
"""Cost of the levels that pad a row to a multiple of `LANES`; it saturates and can never win."""


@dataclass(frozen=True)
class Levels:
    """The disparities that are tried: ``minimum <= d < minimum + count``, in pixels."""

    minimum: int
    count: int

    @property
    def padded(self) -> int:
        """`count` rounded up to a multiple of `LANES`."""
        return -(-self.count // LANES) * LANES


UNEXPECTED = 1
"""Steps of cost that a level costs more where another one is expected."""


class Search(NamedTuple):
    """What each pixel tries instead of all levels: the `LANES` from its start on; (H, W) or flat."""

    starts: NDArray[np.int16]  # first level
    low: NDArray[np.uint8]  # first expected level, counted from the start
    high: NDArray[np.uint8]  # last expected level; those below and above cost `UNEXPECTED` more


@dataclass(frozen=True)
class CostInput:
    """A checked image pair, ready for a cost.

    Attributes
    ----------
    left, right : (H, W) uint8 or uint16, C-contiguous
        Grey images without gaps (invalid pixels are filled with a neighbour's value).
    left_bad, right_bad : (H, W) bool or None
        Pixels that were NaN or infinite and carry no evidence; None when there are none.
    levels : Levels
        Disparities to try.
    border_share : float or None
        Cost of a level whose right pixel lies outside the image, as a share of the cost's range; None takes
        the nearest border pixel instead.
    threads : int
        Threads that preparation may use.
    ranges : ((int, int), (int, int)) or None
        Smallest and largest value of the left and of the right image, where these are windows of larger ones; None
        where they are whole.
    starts : (H, W) int16, C-contiguous, or None
        First level of each pixel's search, which takes `LANES` levels; None where all pixels try all levels.
    """

    left: NDArray[Any]
    right: NDArray[Any]
    left_bad: NDArray[np.bool_] | None
    right_bad: NDArray[np.bool_] | None
    levels: Levels
    border_share: float | None
    threads: int = 1
    ranges: tuple[tuple[int, int], tuple[int, int]] | None = None
    starts: NDArray[np.int16] | None = None


class Cost(Protocol):
    """A matching cost: its range, the unit of its penalties, and rows.

    It may further have

    - ``cuda``: the name of the module with its CUDA twin, whose ``volume(queue, cost, pair)`` returns the volume of
      costs on the device as `stereokit.costs.rows_cuda` has it, and whose ``check(cost)``, if it has one, raises
      `stereokit.DeviceError` for options that the twin does not take. Without one, methods run on the CPU only;
    - ``narrow``: True where `prepare` makes rows of `LANES` levels from `CostInput.starts` on, if those are given;
    - ``needs_ranges``: its costs depend on the smallest and largest values of the whole images (`CostInput.ranges`),
      which `stereokit.match_large` then looks for first;
    - ``bytes_per_pixel``: memory that it takes beside its buffers.
    """

    @property
    def name(self) -> str:
        """Name in the registry."""

    @property
    def cost_max(self) -> int:
        """Largest cost, 1 to 254."""

    @property
    def unit(self) -> int:
        """Steps of cost per unit in which users give penalties."""

    @property
    def costly_to_recompute(self) -> bool:
        """Whether a row costs more to compute again than to bring back from a volume."""

    def prepare(self, pair: CostInput, workspace: Workspace, workers: int) -> list[Any]:
        """Prepare an image pair; return a row producer, a named tuple, for each of `workers` sweeps."""


def takes_8_bits(cost: Any) -> bool:
    """Return whether a cost is to see images of 8 bits only, smoothed or not: `RowCost` says so."""
    return bool(getattr(cost, "eight_bits", False))


class CellMask(NamedTuple):
    """Cells of a row of costs that have no evidence (flat arrays, for kernels)."""

    width: int
    blocks: tuple[int, ...]  # one element per 64 levels: its length is known to the compiler
    padded: int
    minimum: int
    border_cost: np.uint8  # of a cell without evidence
    low: NDArray[np.uint8]  # per element of the reversed right row: bounds to which the cost is clamped,
    high: NDArray[np.uint8]  # 0 and 255 where there is evidence, `border_cost` twice where there is none
    stride: int  # from one row of low and high to the next; 0 when all rows share one
    left_bad: NDArray[np.uint8]  # (H * W), or empty when every pixel is valid
    padding: NDArray[np.uint8]  # (P): 0 for levels that exist, 255 for those that pad


_PRODUCERS: dict[type, Callable[..., None]] = {}
"""The compiled function that writes a row, by the named tuple of its producer."""


@by_types
def cost_row(rows: Any, y: Any, x0: Any, x1: Any, out: Any) -> Any:
    """Write the costs of columns x0..x1 of row `y` to their places in the flat ``uint8`` row `out` (``W * P``).

    Compiled code only.
    """
    function = _PRODUCERS[rows.instance_class]
    return lambda rows, y, x0, x1, out: function(rows, y, x0, x1, out)


def implements(kind: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that makes a compiled function the `cost_row` of the named tuple `kind`."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        names = tuple(inspect.signature(getattr(function, "py_func", function)).parameters)
        if len(names) != 5:
            raise OptionError(f"function of cost rows must take (rows, y, x0, x1, out), got ({', '.join(names)})")
        _PRODUCERS[kind] = function
        return function

    return register


def cell_mask(pair: CostInput, cost_max: int, workspace: Workspace) -> CellMask:
    """Return the cells of `pair` without evidence, for costs of ``0..cost_max``; cached but for the invalid pixels."""
    if pair.right_bad is not None:
        cells = _new_mask(pair, cost_max)
    else:
        key = pair.left.shape, pair.levels, pair.border_share, cost_max
        cells = workspace.cached("cells", key, lambda: _new_mask(pair, cost_max))
    return cells if pair.left_bad is None else cells._replace(left_bad=pair.left_bad.view(np.uint8).ravel())


def _new_mask(pair: CostInput, cost_max: int) -> CellMask:
    height, width = pair.left.shape
    levels = pair.levels
    border_cost = np.uint8(cost_max if pair.border_share is None else round(pair.border_share * cost_max))
    stride = width + levels.padded
    shared = pair.right_bad is None
    low, high = (aligned((1 if shared else height, stride), np.uint8) for _ in range(2))
    columns = width - 1 - levels.minimum - np.arange(stride)
    inside = (columns >= 0) & (columns < width)
    evidence = np.broadcast_to(inside | (pair.border_share is None), low.shape)
    if pair.right_bad is not None:
        evidence = evidence & ~pair.right_bad[:, np.clip(columns, 0, width - 1)]
    low[...] = np.where(evidence, 0, border_cost)
    high[...] = np.where(evidence, 255, border_cost)
    padding = aligned((levels.padded,), np.uint8)
    padding[: levels.count] = 0
    padding[levels.count :] = WORST
    return CellMask(
        width=width,
        blocks=tuple(range(levels.padded // LANES)),
        padded=levels.padded,
        minimum=levels.minimum,
        border_cost=border_cost,
        low=low.ravel(),
        high=high.ravel(),
        stride=0 if shared else stride,
        left_bad=np.empty(0, np.uint8),
        padding=padding,
    )


@inline
def _clamp_cells(cells: CellMask, y: int, x: int, out: NDArray[np.uint8]) -> None:
    """Clamp the costs of pixel x of row y to the bounds of their right pixels."""
    right = y * cells.stride + cells.width - 1 - x
    for block in range(0, cells.padded, LANES):
        cost = load(out, x * cells.padded + block)
        cost = minimum(maximum(cost, load(cells.low, right + block)), load(cells.high, right + block))
        store(out, x * cells.padded + block, cost)


@kernel
def mask_row(cells: CellMask, y: int, x0: int, x1: int, out: NDArray[np.uint8]) -> None:
    """Set the cells of a part of a row without evidence to the border's cost, and the levels that pad to the worst."""
    if cells.stride > 0:
        for x in range(x0, x1):
            _clamp_cells(cells, y, x, out)
    else:
        for x in range(x0, min(x1, max(0, cells.padded - 1 + cells.minimum))):
            _clamp_cells(cells, y, x, out)
        for x in range(max(x0, cells.width + min(cells.minimum, 0)), x1):
            _clamp_cells(cells, y, x, out)
    if cells.left_bad.size > 0:
        for x in range(x0, x1):
            if cells.left_bad[y * cells.width + x] != 0:
                for block in range(0, cells.padded, LANES):
                    store(out, x * cells.padded + block, splat(cells.border_cost))
    if cells.padding[cells.padded - 1] != 0:
        last = cells.padded - LANES
        padding = load(cells.padding, last)
        for x in range(x0, x1):
            store(out, x * cells.padded + last, bitwise_or(load(out, x * cells.padded + last), padding))


@kernel
def mask_narrow_row(
    cells: CellMask, starts: NDArray[np.int16], y: int, x0: int, x1: int, out: NDArray[np.uint8]
) -> None:
    """Set the cells of a part of a row without evidence to the border's cost; a pixel has `LANES` levels."""
    for x in range(x0, x1):
        start = np.int64(starts[y * cells.width + x])
        column = x - cells.minimum - start  # right column of the first level
        at = x * LANES
        if cells.stride > 0 or column >= cells.width or column - LANES + 1 < 0:
            right = y * cells.stride + cells.width - 1 - x + start
            cost = minimum(maximum(load(out, at), load(cells.low, right)), load(cells.high, right))
            store(out, at, cost)
        if cells.left_bad.size > 0 and cells.left_bad[y * cells.width + x] != 0:
            store(out, at, splat(cells.border_cost))


@kernel
def _pad(image: NDArray[Any], y0: int, y1: int, margin: int, reversed_from: int, out: NDArray[Any]) -> None:
    """Copy rows of `image` with clamped borders; reversed, from column `reversed_from`, unless that is < -10**9."""
    height, width = image.shape
    for row in range(y0, y1):
        source = image[min(max(row - margin, 0), height - 1)]
        target = out[row]
        if reversed_from > -(10**9):
            for k in range(target.size):
                target[k] = source[min(max(reversed_from - k, 0), width - 1)]
        else:
            for k in range(target.size):
                target[k] = source[min(max(k - margin, 0), width - 1)]


def pad_pair(pair: CostInput, margin: int, workspace: Workspace) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the left image with clamped borders, and the right one reversed with clamped borders.

    Returns
    -------
    left : (H + 2 * margin, W' >= W + 2 * margin)
        Element ``[y + margin, x + margin]`` is pixel ``(y, x)``.
    right : (H + 2 * margin, W' >= W + P + 2 * margin)
        Element ``[y + margin, k + margin]`` is right column ``W - 1 - min_disparity - k``.
    """
    height, width = pair.left.shape
    rows = height + 2 * margin
    left = workspace.array("pad.left", (rows, width + 2 * margin + LANES), pair.left.dtype)
    right_width = width + pair.levels.padded + 2 * margin + LANES
    right = workspace.array("pad.right", (rows, right_width), pair.left.dtype)
    start = width - 1 - pair.levels.minimum + margin
    tasks: list[Callable[[], object]] = []
    for y0, y1 in spans(rows, pair.threads):
        tasks.append(partial(_pad, pair.left, y0, y1, margin, -(10**9), left))
        tasks.append(partial(_pad, pair.right, y0, y1, margin, start, right))
    run(tasks, pair.threads)
    return left, right


def produce_volume(rows: list[Any], shape: tuple[int, int], levels: Levels, threads: int) -> NDArray[np.uint8]:
    """Return the costs of all rows, ``(H, W, D)``; one row producer per thread."""
    height, width = shape
    padded = np.empty((height, width * levels.padded), np.uint8)
    parts = spans(height, threads)
    run([partial(_produce, rows[k], y0, y1, levels.padded, padded) for k, (y0, y1) in enumerate(parts)], threads)
    return np.ascontiguousarray(padded.reshape(height, width, levels.padded)[:, :, : levels.count])


@kernel
def _produce(rows: Any, y0: int, y1: int, padded: int, out: NDArray[np.uint8]) -> None:
    for y in range(y0, y1):
        row = out[y]
        cost_row(rows, y, 0, row.size // padded, row)


class VolumeRows(NamedTuple):
    """Rows of a cost volume in memory: ``(H, W, D)`` ``uint8``, not padded."""

    volume: NDArray[np.uint8]
    padded: int


@implements(VolumeRows)
@kernel
def _volume_row(rows: VolumeRows, y: int, x0: int, x1: int, out: NDArray[np.uint8]) -> None:
    _, _, count = rows.volume.shape
    for x in range(x0, x1):
        for d in range(count):
            out[x * rows.padded + d] = rows.volume[y, x, d]
        for d in range(count, rows.padded):
            out[x * rows.padded + d] = 255
