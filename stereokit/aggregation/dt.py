"""Domain-transform aggregation: recursive edge-aware smoothing of every disparity slice.

Two published forms under one name:

``mode="rf"``
    The recursive filter of Gastal and Oliveira 2011 (section 5.2, equation 21), guided by the left grey image.
    With ``t = 1 + (sigma_s / sigma_r) * |I'|``, pass i of N uses ``sigma_i = sigma_s * sqrt(3) * 2**(N-i) /
    sqrt(4**N - 1)``, ``a = exp(-sqrt(2) / sigma_i)`` and ``J[n] = I[n] + a**t * (J[n-1] - I[n])``, forward then
    backward, rows then columns.
``mode="sum"``
    The cascade of the StereoVAE authors' CUDA code: one pass left to right, right to left, down, up, each
    ``A(p) = C(p) + w * A(p - 1)`` with ``w = exp(-|dI| / 52)``; vertically w is 0.8 where ``|dI| < 5``.

Rows are filtered as the cost produces them and written to the one volume; then narrow bands of columns are swept
down and up, and the upward sweep selects as it goes. Rows and bands are independent of one another, so any number
of threads gives the same result.

``rf`` runs in 16-bit fixed point, costs with 6 fractional bits and weights with 15, and the volume between rows and
columns holds bytes, costs with as many fractional bits as fit: a quarter of the memory of floats and the same result
on every processor. With the built-in costs (up to 63) rounding moves an aggregated cost by a fraction of one unit.
``sum`` grows without bound and runs in float32. `stereokit.aggregate` takes float volumes too and filters them in
float32.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from stereokit.costs.rows import Cost, Levels, cost_row
from stereokit.errors import OptionError, shown
from stereokit.images.check import check_integer, check_number
from stereokit.kernels.jit import by_types, inline, kernel
from stereokit.kernels.simd import (
    LANES,
    add,
    convert,
    load,
    minimum,
    multiply,
    multiply_high_doubled,
    shift_left,
    shift_right,
    splat,
    store,
    subtract,
)
from stereokit.kernels.threads import run, spans
from stereokit.kernels.trace import span
from stereokit.kernels.workspace import Workspace
from stereokit.registry import AGGREGATIONS
from stereokit.selection.wta import SelectionOutput, keys_of, select_pixel

__all__ = ["Dt", "edge_weights"]


class Weights(NamedTuple):
    """Feedback of one pass by grey difference of the step: (256,) float32, or int16 times 2**15."""

    row: NDArray[Any]
    column: NDArray[Any]
    normalised: NDArray[Any]  # (1,): 1 for the normalised recursion, 0 for the plain sum
    shift: int  # fixed point: the volume's bytes hold `_FRACTION_BITS - shift` fractional bits


_FRACTION_BITS = 6
"""Fixed-point costs: fractional bits while a row or column is filtered. Costs reach 255, and twice
a difference must fit int16."""


@AGGREGATIONS.register("dt")
@dataclass(frozen=True)
class Dt:
    """Edge-aware recursive smoothing.

    Parameters
    ----------
    sigma_s : float
        Spatial scale along rows in pixels (``rf``), 0.01 to 1e6.
    sigma_v : float or None
        Spatial scale along columns in pixels (``rf``); None takes `sigma_s`. Surfaces that people drive and walk on
        change their disparity from row to row, so that less is better.
    sigma_r : float
        Range scale in grey levels of 0..255 (``rf``).
    passes : int
        Passes N over the image (``rf``), 1 to 5.
    mode : {"rf", "sum"}
        One of the two published forms.
    """

    sigma_s: float = 20.0
    sigma_v: float | None = 6.0
    sigma_r: float = 30.0
    passes: int = 1
    mode: str = "rf"
    name: ClassVar[str] = "dt"
    accepts_floats: ClassVar[bool] = True
    cuda: ClassVar[str] = "stereokit.aggregation.dt_cuda"

    def __post_init__(self) -> None:
        if not isinstance(self.mode, str) or self.mode not in ("rf", "sum"):
            raise OptionError(f"mode of dt must be 'rf' or 'sum', got {shown(self.mode)}")
        for name in ("sigma_s", "sigma_v", "sigma_r"):
            value = getattr(self, name)
            if value is not None or name != "sigma_v":
                object.__setattr__(self, name, check_number(name, value, 0.01, 1e6))
        object.__setattr__(self, "passes", check_integer("passes", self.passes, 1, 5))

    @property
    def total_dtype(self) -> Any:
        """Type of the aggregated costs of ``uint8`` rows."""
        return np.int16 if self.mode == "rf" else np.float32

    def weights(self, dtype: Any, cost_max: int) -> list[Weights]:
        """Return the feedback of each pass for costs up to `cost_max`."""
        if self.mode == "sum":
            row, column = edge_weights()
            return [Weights(row, column, np.zeros(1, np.float32), 0)]
        shift = max(0, _FRACTION_BITS - (8 - int(cost_max).bit_length()))
        return [
            Weights(
                self._table(self.sigma_s, i, dtype),
                self._table(self.sigma_s if self.sigma_v is None else self.sigma_v, i, dtype),
                np.ones(1, dtype),
                shift,
            )
            for i in range(1, self.passes + 1)
        ]

    def _table(self, sigma_s: float, i: int, dtype: Any) -> NDArray[Any]:
        """Feedback of pass `i` by grey difference: ``a**t`` of equation 21."""
        sigma = sigma_s * math.sqrt(3) * 2.0 ** (self.passes - i) / math.sqrt(4.0**self.passes - 1)
        a = math.exp(-math.sqrt(2) / sigma)
        table = [a ** (1 + sigma_s / self.sigma_r * jump) for jump in range(256)]
        if dtype == np.int16:
            return np.array([min(round(w * 2**15), 2**15 - 1) for w in table], np.int16)
        return np.array(table, np.float32)

    def sweep(
        self, rows: list[Any], levels: Levels, cost: Cost, guide: NDArray[np.uint8], workspace: Workspace,
        threads: int, out: SelectionOutput, total: NDArray[Any] | None = None, volume: NDArray[Any] | None = None,
    ) -> None:  # fmt: skip
        """Aggregate the rows of a producer and select; parameters as of `stereokit.aggregation.sgm.Sgm.sweep`.

        `volume` are float32 costs ``(H, W, P)`` to filter, in place, instead of those of `rows`.
        """
        height, width = guide.shape
        padded = levels.padded
        blocks = tuple(range(padded // LANES))
        dtype = self.total_dtype if volume is None else np.dtype(np.float32)
        if volume is None:
            volume_dtype = np.uint8 if self.mode == "rf" else np.float32
            costs = workspace.array("dt.volume", height * width * padded, volume_dtype)
        else:
            costs = volume.reshape(-1)
        total_out = np.empty(0, dtype) if total is None else total.reshape(-1)
        passes = self.weights(dtype, cost.cost_max)
        # A band is narrow enough for its columns to stay in the caches between the way down and the way up.
        band = max(1, min(width, 2**20 // max(1, height * padded * np.dtype(dtype).itemsize)))
        bands = spans(width, -(-width // band))
        band = max(x1 - x0 for x0, x1 in bands)
        parts = spans(height, min(threads, len(rows)))
        shares = [bands[k::threads] for k in range(min(threads, len(bands)))]

        def filter_rows(k: int, y0: int, y1: int, weights: Weights, first: bool) -> None:
            row = workspace.array(f"dt.row{k}", width * padded, dtype)
            if first and volume is None:
                fresh = workspace.array(f"dt.cost{k}", width * padded, np.uint8)
                with span("match", "sweep: rows with costs"):
                    _produce_rows(rows[k], blocks, guide, weights, y0, y1, fresh, row, costs)
            else:
                with span("match", "sweep: rows"):
                    _filter_rows(blocks, guide, weights, y0, y1, row, costs)

        def filter_bands(k: int, weights: Weights, last: bool) -> None:
            column = workspace.array(f"dt.band{k}", height * band * padded, dtype)
            state = workspace.array(f"dt.state{k}", band * padded, dtype)
            for x0, x1 in shares[k]:
                with span("match", "sweep: columns"):
                    _filter_band(
                        blocks, guide, weights, x0, x1, costs, column, state, keys_of(state), last, out, total_out
                    )

        for number, weights in enumerate(passes):
            last = number == len(passes) - 1
            run([partial(filter_rows, k, *y, weights, number == 0) for k, y in enumerate(parts)], threads)
            run([partial(filter_bands, k, weights, last) for k in range(len(shares))], threads)


def edge_weights() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the feedback of the authors' cascade by grey difference, along rows and along columns, (256,)."""
    row = np.array([math.exp(-jump / 52) for jump in range(256)], np.float32)
    column = row.copy()
    column[:5] = 0.8
    return row, column


@by_types
def _feed_back(value: Any, before: Any, weight: Any, normalised: Any) -> Any:
    """Return ``value + weight * (before - normalised * value)`` of int16 or float32 vectors; compiled code only.

    Fixed point rounds down.
    """
    if value.scalar == types.int16:
        return lambda value, before, weight, normalised: add(
            value, multiply_high_doubled(subtract(before, value), weight)
        )
    return lambda value, before, weight, normalised: add(
        value, multiply(weight, subtract(before, multiply(normalised, value)))
    )


@by_types
def _feed_back_up(value: Any, before: Any, weight: Any, normalised: Any) -> Any:
    """Return the value of `_feed_back`, but fixed point rounds up: the way back makes up for the way there."""
    if value.scalar == types.int16:
        return lambda value, before, weight, normalised: subtract(
            value, multiply_high_doubled(subtract(value, before), weight)
        )
    return lambda value, before, weight, normalised: _feed_back(value, before, weight, normalised)


@by_types
def _unpack(costs: Any, at: Any, shift: Any, like: Any) -> Any:
    """Return 64 costs of the volume in the type of `like`; compiled code only."""
    if costs.dtype == types.uint8:
        return lambda costs, at, shift, like: shift_left(convert(load(costs, at), like), shift)
    return lambda costs, at, shift, like: load(costs, at)


@by_types
def _pack(costs: Any, at: Any, value: Any, shift: Any) -> Any:
    """Put 64 costs into the volume, rounded to its fractional bits; compiled code only."""
    if costs.dtype == types.uint8:
        # Half a step is added before the shift; the largest cost, 255, must not leave the byte.
        return lambda costs, at, value, shift: store(
            costs,
            at,
            convert(
                minimum(shift_right(add(value, splat(np.int16((1 << shift) >> 1))), shift), splat(np.int16(255))),
                np.uint8(0),
            ),
        )
    return lambda costs, at, value, shift: store(costs, at, value)


@inline
def _jump(guide: NDArray[np.uint8], y: int, x: int, y2: int, x2: int) -> int:
    difference: int = abs(np.int32(guide[y, x]) - np.int32(guide[y2, x2]))
    return difference


@inline
def _filter_row(
    blocks: tuple[int, ...], guide: NDArray[np.uint8], weights: Weights, y: int, base: int, row: NDArray[Any]
) -> None:
    """Forward, then backward along one row of levels at ``row[base:]``, in place."""
    width = guide.shape[1]
    padded = LANES * len(blocks)
    normalised = splat(weights.normalised[0])
    for x in range(1, width):
        weight = splat(weights.row[_jump(guide, y, x, y, x - 1)])
        at = base + x * padded
        for n in range(len(blocks)):
            to = at + n * LANES
            store(row, to, _feed_back(load(row, to), load(row, to - padded), weight, normalised))
    for back in range(1, width):
        x = width - 1 - back
        weight = splat(weights.row[_jump(guide, y, x + 1, y, x)])
        at = base + x * padded
        for n in range(len(blocks)):
            to = at + n * LANES
            store(row, to, _feed_back_up(load(row, to), load(row, to + padded), weight, normalised))


@kernel
def _produce_rows(
    rows: Any, blocks: tuple[int, ...], guide: NDArray[np.uint8], weights: Weights, y0: int, y1: int,
    cost: NDArray[np.uint8], row: NDArray[Any], costs: NDArray[Any],
) -> None:  # fmt: skip
    """Costs of rows y0..y1, filtered along the row, into the volume."""
    size = row.size
    like = row[0]
    unit = splat(row.dtype.type(1 << _FRACTION_BITS if row.itemsize == 2 else 1))
    for y in range(y0, y1):
        cost_row(rows, y, 0, guide.shape[1], cost)
        for at in range(0, size, LANES):
            store(row, at, multiply(convert(load(cost, at), like), unit))
        _filter_row(blocks, guide, weights, y, 0, row)
        for at in range(0, size, LANES):
            _pack(costs, y * size + at, load(row, at), weights.shift)


@kernel
def _filter_rows(
    blocks: tuple[int, ...], guide: NDArray[np.uint8], weights: Weights, y0: int, y1: int,
    row: NDArray[Any], costs: NDArray[Any],
) -> None:  # fmt: skip
    size = row.size
    like = row[0]
    for y in range(y0, y1):
        for at in range(0, size, LANES):
            store(row, at, _unpack(costs, y * size + at, weights.shift, like))
        _filter_row(blocks, guide, weights, y, 0, row)
        for at in range(0, size, LANES):
            _pack(costs, y * size + at, load(row, at), weights.shift)


@kernel
def _filter_band(
    blocks: tuple[int, ...], guide: NDArray[np.uint8], weights: Weights, x0: int, x1: int, costs: NDArray[Any],
    column: NDArray[Any], state: NDArray[Any], keys: NDArray[Any], last: bool, out: SelectionOutput,
    total: NDArray[Any],
) -> None:  # fmt: skip
    """Down, then up the columns x0..x1; select on the way up of the last pass, else write the costs back."""
    height, width = guide.shape
    padded = LANES * len(blocks)
    size = (x1 - x0) * padded
    normalised = splat(weights.normalised[0])
    none = state.dtype.type(0)
    state[:] = none
    for y in range(height):
        base = (y * width + x0) * padded
        for x in range(x0, x1):
            weight = splat(weights.column[_jump(guide, y, x, y - 1, x)] if y > 0 else none)
            for n in range(len(blocks)):
                at = (x - x0) * padded + n * LANES
                value = _unpack(costs, base + at, weights.shift, none)
                value = _feed_back(value, load(state, at), weight, normalised)
                store(state, at, value)
                store(column, y * size + at, value)
    for back in range(height):
        y = height - 1 - back
        base = (y * width + x0) * padded
        for x in range(x0, x1):
            weight = splat(weights.column[_jump(guide, y + 1, x, y, x)] if back > 0 else none)
            for n in range(len(blocks)):
                at = (x - x0) * padded + n * LANES
                store(state, at, _feed_back_up(load(column, y * size + at), load(state, at), weight, normalised))
            if last:
                select_pixel(keys, state, (x - x0) * padded, blocks, y * width + x, out)
        if not last:
            for at in range(0, size, LANES):
                _pack(costs, base + at, load(state, at), weights.shift)
        elif total.size > 0:
            for at in range(0, size, LANES):
                store(total, base + at, load(state, at))
