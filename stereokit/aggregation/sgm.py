"""Semi-global matching (StereoVAE paper, equations 4-5; Hirschmueller 2008, equation 13).

Costs are aggregated along 4, 5 or 8 straight paths through the image and summed. Two sweeps carry the paths that
come from above and from below, a row at a time: each computes the costs of a row when it gets there, so that no
cost volume is stored (`stereokit.aggregation.paths` has the picture).

The down sweep visits the upper half first while the up sweep visits the lower half; each leaves the sum of its
three paths. Then each goes on into the half where the other has been, adds the other's sums and the two paths
along the row, and selects. The two never meet in a row.

With 4 paths any number of threads takes part, and gives what one gives, bit for bit. Of the first visits each takes a
band of columns, which the vertical path never leaves. In the last visits it claims two rows at a time: it walks the
paths along them by itself, then the vertical one from block to block behind the thread that has the rows before.
Diagonal paths leave every band and reach ahead, so 8 paths use two threads, and 5 paths, which have one sweep, one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stereokit.aggregation.paths.narrow import (
    NarrowBuffers,
    finish_narrow_part,
    first_narrow_visit,
    prepare_narrow_rows,
    start_narrow,
)
from stereokit.aggregation.paths.penalties import Penalties
from stereokit.aggregation.paths.steps import PathBuffers
from stereokit.aggregation.paths.visits import CHUNK, finish_part, first_visit, prepare_rows, start
from stereokit.costs.rows import UNEXPECTED, WORST, Cost, Levels, Search
from stereokit.errors import OptionError
from stereokit.images.check import check_integer, check_number
from stereokit.kernels.jit import kernel
from stereokit.kernels.simd import LANES, load, store
from stereokit.kernels.spin import WORDS_APART, claim, publish, wait_until
from stereokit.kernels.threads import run_stages, spans
from stereokit.kernels.trace import runner, span
from stereokit.kernels.workspace import Workspace
from stereokit.registry import AGGREGATIONS
from stereokit.selection.wta import SelectionOutput, select_row

__all__ = ["Sgm"]

NEAR = 4 << 20
"""Elements that a first visit writes last and leaves in the caches: the last visits begin where the first ones end."""

BLOCK = 2 * CHUNK
"""Columns of two rows that a last visit does before it lets the next two rows follow."""


@AGGREGATIONS.register("sgm")
@dataclass(frozen=True)
class Sgm:
    """Sum of the path costs along 4, 5 or 8 directions.

    Parameters
    ----------
    p1 : float or None
        Penalty for a step of one level, in the cost's own unit: neighbours that differ for census, the scale of
        ``C = min(1 - rho, 1)`` for ZNCC. None takes half the cost's range.
    p2 : float or None
        Penalty for a larger step, in the same unit. None takes 2.75 times the range. Costs and p2 together must
        not exceed 255 steps of the 8-bit path costs.
    paths : {4, 5, 8}
        Directions: left, right, up and down; the five that need only one sweep (all but those from below; one
        thread and next to no memory); all eight.
    edge : float
        Grey difference of two neighbours, in levels of 0..255, from which the penalties of the step between them
        are lower: disparity jumps where the image does (Hirschmueller 2008, section II-B, in two levels).
    edge_factor : float
        Factor of the penalties there, 0 to 1; 1 for penalties that do not follow the image.
    """

    p1: float | None = None
    p2: float | None = None
    paths: int = 4
    edge: float = 8.0
    edge_factor: float = 0.5
    name: ClassVar[str] = "sgm"
    total_dtype: ClassVar[Any] = np.uint16
    accepts_floats: ClassVar[bool] = False
    narrow: ClassVar[bool] = True
    cuda: ClassVar[str] = "stereokit.aggregation.sgm_cuda"

    def __post_init__(self) -> None:
        if check_integer("paths", self.paths) not in (4, 5, 8):
            raise OptionError(f"paths must be 4, 5 or 8, got {self.paths!r}")
        object.__setattr__(self, "paths", int(self.paths))
        check_number("edge", self.edge, 0, 1e6)
        check_number("edge_factor", self.edge_factor, 0, 1)

    @classmethod
    def fitting(cls, cost: Cost, defaults: dict[str, Any]) -> dict[str, Any]:
        """Return changes to default options that a cost calls for: p2 takes no more than the cost leaves of 8 bits."""
        p2 = defaults.get("p2")
        return {} if p2 is None else {"p2": min(p2, (255 - cost.cost_max) / cost.unit)}

    def check_cost(self, cost: Cost) -> None:
        """Raise OptionError if the penalties do not go with a cost."""
        self.penalties(cost.cost_max, cost.unit)

    def penalties(self, cost_max: int, unit: int, unexpected: int = 0) -> Penalties:
        """Return P1 and P2 in steps of cost; P2 leaves room in 8 bits for costs that are `unexpected` steps higher.

        Raises
        ------
        OptionError
            If p1 is not from 0 to p2, or p2 does not fit 8-bit path costs.
        """
        p1 = 0.5 * cost_max / unit if self.p1 is None else check_number("p1", self.p1, 0, 255)
        p2 = 2.75 * cost_max / unit if self.p2 is None else check_number("p2", self.p2, 0, 255)
        if p1 > p2:
            raise OptionError(f"p1 must be at most p2, got p1={p1:g} and p2={p2:g}")
        if cost_max + round(p2 * unit) > 255 and self.p2 is not None:
            raise OptionError(f"p2 must be at most {(255 - cost_max) / unit:.4g} with this cost, got {p2:g}")
        high = min(round(p2 * unit), 255 - cost_max - unexpected)
        low = min(round(p1 * unit), high)
        at_edge = (np.uint8(np.rint(step * self.edge_factor)) for step in (low, high))
        edge = np.int16(min(math.ceil(self.edge), 256))  # 256: no two grey levels are so far apart
        return Penalties(edge, np.uint8(low), np.uint8(high), *at_edge)

    def sweep(
        self, rows: list[Any], levels: Levels, cost: Cost, guide: NDArray[np.uint8], workspace: Workspace,
        threads: int, out: SelectionOutput, total: NDArray[np.uint16] | None = None,
        search: Search | None = None,
    ) -> None:  # fmt: skip
        """Aggregate the rows of producers and select.

        Parameters
        ----------
        rows : list of row producers
            One per thread, but two at least: two sweeps do not share one.
        levels : Levels
            Disparities.
        cost : Cost
            The cost that produces the rows; its range and unit scale the penalties.
        guide : (H, W) uint8
            The left image, which the penalties may follow.
        workspace : Workspace
            Buffers.
        threads : int
            1 or more. All are used with 4 paths, two with 8, one with 5.
        out : SelectionOutput
            Maps of the selection.
        total : (H, W, P) uint16 or None
            Volume for the sums over all paths, if they are wanted.
        search : Search or None
            What each pixel tries; None where all pixels try all levels.
        """
        if search is not None:
            self._narrow_sweep(rows, search, cost, guide, workspace, threads, out)
            return
        penalties, sums, sweeps = self._cached(guide.shape, levels, cost, workspace, threads)
        total_out = np.empty(0, np.uint16) if total is None else total.reshape(-1)
        kernels = start, first_visit, _last_visit
        self._visit(kernels, rows, sweeps, guide, penalties, sums, threads, out, total_out)

    def _narrow_sweep(
        self, rows: list[Any], search: Search, cost: Cost, guide: NDArray[np.uint8], workspace: Workspace,
        threads: int, out: SelectionOutput,
    ) -> None:  # fmt: skip
        """Aggregate and select where each pixel has a search of its own."""
        penalties, sums, paths = self._cached(guide.shape, Levels(0, LANES), cost, workspace, threads, LANES)
        edges = np.full(3 * LANES, 255, np.uint8)
        edges[LANES : 2 * LANES] = 0
        below, above = np.zeros((2, 2 * LANES), np.uint8)
        below[:LANES] = above[LANES + 1 :] = UNEXPECTED
        flat = Search(search.starts.ravel(), search.low.ravel(), search.high.ravel())
        sweeps = [[NarrowBuffers(buffers, flat, edges, below, above) for buffers in workers] for workers in paths]
        kernels = start_narrow, first_narrow_visit, _last_narrow_visit
        self._visit(kernels, rows, sweeps, guide, penalties, sums, threads, out)

    def _visit(
        self, kernels: tuple[Callable[..., None], ...], rows: list[Any], sweeps: list[list[Any]],
        guide: NDArray[np.uint8], penalties: Penalties, sums: NDArray[Any], threads: int, *out: Any,
    ) -> None:  # fmt: skip
        """Visit all rows with the kernels that begin a sweep, visit rows first and visit rows last."""
        begin, first_of, last_of = kernels
        both = len(sweeps) == 2
        if not both:
            begin(sweeps[0][0], 0, guide.shape[1])

        def first(sweep: int, k: int, part: _Part) -> None:
            first_of(rows[k], sweeps[sweep][k], guide, penalties, *part, sums, NEAR)

        def last(sweep: int, k: int, part: _Part, words: NDArray[np.int64]) -> None:
            last_of(rows[k], sweeps[sweep][k], guide, penalties, *part, sums, both, *out, words)

        _meet(first, last, guide.shape, len(sweeps), len(sweeps[0]), self.paths == 4, threads)

    def _cached(
        self, shape: tuple[int, int], levels: Levels, cost: Cost, workspace: Workspace, threads: int, margin: int = 0
    ) -> tuple[Penalties, NDArray[Any], list[list[PathBuffers]]]:
        """Return what `_buffers` makes, from the call before if it fits."""
        workers = {4: min(threads, -(-shape[0] // 4)), 5: 1, 8: 2}[self.paths]
        key = self, shape, levels, cost.cost_max, cost.unit, cost.costly_to_recompute, margin, workers
        return workspace.cached("sgm", key, lambda: self._buffers(shape, levels, cost, workspace, workers, margin))

    def _buffers(
        self, shape: tuple[int, int], levels: Levels, cost: Cost, workspace: Workspace, workers: int, margin: int
    ) -> tuple[Penalties, NDArray[Any], list[list[PathBuffers]]]:
        """Return the penalties, the volume of sums and the buffers of each sweep for each worker.

        There is a `margin` around path costs.
        """
        unexpected = UNEXPECTED if margin else 0
        cost_max = cost.cost_max + unexpected
        penalties = self.penalties(cost.cost_max, cost.unit, unexpected)
        height, width = shape
        size = width * levels.padded
        diagonals = self.paths != 4
        two_sweeps = self.paths != 5
        most = int(max(penalties.p2, penalties.p2_edge))  # largest bracket
        sums_dtype = np.uint8 if (3 if diagonals else 1) * most <= 255 else np.uint16
        across_dtype = np.uint8 if 2 * most <= 255 else np.uint16
        sums = workspace.array("sgm.sums", height * size if two_sweeps else 1, sums_dtype)
        recovers = self.paths == 4 and cost.costly_to_recompute and margin == 0
        path_minimum = workspace.array("sgm.path_minimum", height * width if recovers else 0, np.uint8)
        whole = levels.count == levels.padded  # or the 255 of levels that pad would wrap, and might win
        padding = np.zeros(levels.padded, np.uint8)
        padding[levels.count :] = WORST
        buffers = [
            PathBuffers(
                blocks=tuple(range(levels.padded // LANES)),
                diagonals=(0,) if diagonals else (),
                paths=self.paths,
                width=width,
                byte_costs=whole and self.paths == 4 and 4 * cost_max + most <= 255,
                byte_brackets=whole and (5 if diagonals else 3) * most + (cost_max if recovers else 0) <= 255,
                cost=workspace.array(f"sgm.cost{k}", 2 * size, np.uint8),
                across=workspace.array(f"sgm.across{k}", 2 * size, across_dtype),
                chains=workspace.array(f"sgm.chains{k}", 4 * levels.padded + 2 * margin, np.uint8),
                state=np.empty(0, np.uint8),  # of a sweep
                lowest=np.empty(0, np.uint8),
                penalties=workspace.array(f"sgm.penalties{k}", 16 * width, np.uint8),
                total=workspace.array(f"sgm.total{k}", CHUNK * levels.padded, np.uint16),
                path_minimum=path_minimum,
                padding=padding,
            )
            for k in range(workers)
        ]
        sweeps = []
        for sweep in range(2 if two_sweeps else 1):
            state = workspace.array(f"sgm.state{sweep}", 3 * size + 2 * margin, np.uint8)
            lowest = workspace.array(f"sgm.lowest{sweep}", 3 * width, np.uint8)
            sweeps.append([one._replace(state=state, lowest=lowest) for one in buffers])
        return penalties, sums, sweeps


_Part = tuple[int, int, int, int]
"""What a visit works on: `_meet` says what the numbers are."""


def _meet(
    first: Callable[..., None], last: Callable[..., None], shape: tuple[int, int], sweeps: int, workers: int,
    free: bool, threads: int,
) -> None:  # fmt: skip
    """Let the down and the up sweep visit their own half of the rows first, and the other's last.

    Parameters
    ----------
    first : callable
        ``first(sweep, worker, part)``, part of `first_visit`: y0, y1, x0, x1.
    last : callable
        ``last(sweep, worker, part, words)``, part of `_last_visit`: y0, y1, step, k0.
    shape : (int, int)
    sweeps : {1, 2}
        One visits all rows, last.
    workers, threads : int
    free : bool
        Whether workers may share a sweep; else each has its own.
    """
    height, width = shape
    middle = height // 2 if sweeps == 2 else 0
    ways = [(0, middle), (height - 1, middle - 1)][: sweeps if sweeps == 2 else 0]
    parts = [(middle, height, 1, middle), (middle - 1, -1, -1, height - middle)][:sweeps]
    shares = workers if workers % 2 else workers // 2  # of each sweep: no worker has more to do than another
    bands = spans(width, min(shares, width // CHUNK)) if free and workers > 1 else [(0, width)]
    idle = deque(range(workers))

    def begin(sweep: int, part: _Part) -> None:
        with span("match", "sweep: first visit"):
            k = idle.popleft() if free else sweep
            first(sweep, k, part)
            if free:
                idle.append(k)

    def end(sweep: int, k: int, part: _Part, words: NDArray[np.int64]) -> None:
        with span("match", "sweep: last visit"):
            try:
                last(sweep, k, part, words)
            except BaseException:  # of a cost of the user's: nobody may wait for its rows
                words[:] = 1 << 40
                raise

    def words_for(rows: int) -> NDArray[np.int64]:
        return np.zeros((2 + rows // 2) * WORDS_APART, np.int64)

    begins = [partial(begin, sweep, (*way, *band)) for band in bands for sweep, way in enumerate(ways)]
    if (own := runner()) is not None:
        if begins:
            own.side_by_side(begins)

        def line(sweep: int) -> Iterator[Callable[[], None]]:
            return (partial(end, sweep, sweep % workers, pair, words_for(2)) for pair in _pairs(parts[sweep]))

        own.in_line([line(sweep) for sweep in range(sweeps)], -(-width // BLOCK), free)
        return
    words = [words_for(height) for _ in parts]

    def end_all(k: int) -> None:
        for n in range(sweeps) if free else (0,):
            sweep = (n + k) % sweeps
            end(sweep, k, parts[sweep], words[sweep])

    run_stages([begins, [partial(end_all, k) for k in range(workers)]], min(threads, workers))


def _pairs(part: _Part) -> Iterator[_Part]:
    """Yield the pairs of rows of a last visit, each as a last visit of its own."""
    y0, y1, step, visited = part
    for k in range(0, abs(y1 - y0), 2):
        last = y0 + (k + 2) * step
        yield y0 + k * step, last if (last - y1) * step < 0 else y1, step, visited + k


@kernel
def _last_narrow_visit(
    rows: Any, buffers: NarrowBuffers, guide: NDArray[np.uint8], penalties: Penalties, y0: int, y1: int, step: int,
    k0: int, sums: NDArray[Any], both: bool, out: SelectionOutput, words: NDArray[np.int64],
) -> None:  # fmt: skip
    """Sweep, sum all paths and select; see `_last_visit`."""
    paths = buffers.paths
    visits = abs(y1 - y0)
    columns = paths.width if len(paths.diagonals) > 0 else BLOCK  # diagonal paths reach ahead into the next block
    while True:
        pair = claim(words, 0)
        k = 2 * pair
        if k >= visits:
            break
        count = min(2, visits - k)
        prepare_narrow_rows(rows, buffers, guide, penalties, y0 + k * step, step, count)
        for block in range(0, paths.width, columns):
            end = min(block + columns, paths.width)
            if pair > 0:
                wait_until(words, pair * WORDS_APART, end)
            for half in range(count):
                y = y0 + (k + half) * step
                for x0 in range(block, end, CHUNK):
                    x1 = min(x0 + CHUNK, end)
                    finish_narrow_part(buffers, guide, half, y, step, k0 + k + half, x0, x1, sums, both)
                    select_row(paths.total, paths.total, x1 - x0, paths.blocks, y * paths.width + x0, out)
            publish(words, (pair + 1) * WORDS_APART, end)


@kernel
def _last_visit(
    rows: Any, buffers: PathBuffers, guide: NDArray[np.uint8], penalties: Penalties, y0: int, y1: int, step: int,
    k0: int, sums: NDArray[Any], both: bool, out: SelectionOutput, total: NDArray[np.uint16], words: NDArray[np.int64],
) -> None:  # fmt: skip
    """Sweep from row `y0` to before row `y1`, sum all paths and select; `k0` rows came before in this sweep.

    If there are `both` sweeps, the other one left its part in `sums`. The sums also go to `total`, unless it is empty.
    Workers that share the sweep share `words`, which begin as zeros: the first counts the pairs of rows that were
    claimed, each of the others says how many columns of a pair are done.
    """
    padded = LANES * len(buffers.blocks)
    visits = abs(y1 - y0)
    columns = buffers.width if len(buffers.diagonals) > 0 else BLOCK  # diagonal paths reach ahead into the next block
    while True:
        pair = claim(words, 0)
        k = 2 * pair
        if k >= visits:
            break
        count = min(2, visits - k)
        prepare_rows(rows, buffers, guide, penalties, y0 + k * step, step, count, sums)
        for block in range(0, buffers.width, columns):
            end = min(block + columns, buffers.width)
            if pair > 0:
                wait_until(words, pair * WORDS_APART, end)
            for half in range(count):
                y = y0 + (k + half) * step
                for x0 in range(block, end, CHUNK):
                    x1 = min(x0 + CHUNK, end)
                    finish_part(buffers, half, y, k0 + k + half, x0, x1, sums, both)
                    if total.size > 0:
                        for at in range(0, (x1 - x0) * padded, LANES):
                            store(total, (y * buffers.width + x0) * padded + at, load(buffers.total, at))
                    select_row(buffers.total, buffers.total, x1 - x0, buffers.blocks, y * buffers.width + x0, out)
            publish(words, (pair + 1) * WORDS_APART, end)
