"""Semi-global matching (StereoVAE paper, equations 4-5; Hirschmueller 2008, equation 13).

Costs are aggregated along 4, 5 or 8 straight paths through the image and summed. Two sweeps carry the paths that
come from above and from below, a row at a time: each computes the costs of a row when it gets there, so that no
cost volume is stored (`stereokit.aggregation.paths` has the picture).

The down sweep visits the upper half first while the up sweep visits the lower half; each leaves the sum of its
three paths. Then each goes on into the half where the other has been, adds the other's sums and the two paths
along the row, and selects. The two never meet in a row, so two threads give what one thread gives, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
from stereokit.kernels.threads import run_stages
from stereokit.kernels.trace import span
from stereokit.kernels.workspace import Workspace
from stereokit.registry import AGGREGATIONS
from stereokit.selection.wta import SelectionOutput, select_row

__all__ = ["Sgm"]

NEAR = 4 << 20
"""Elements that a first visit writes last and leaves in the caches: the last visits begin where the first ones end."""


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
        """Aggregate the rows of two producers and select.

        Parameters
        ----------
        rows : two row producers
            One per sweep.
        levels : Levels
            Disparities.
        cost : Cost
            The cost that produces the rows; its range and unit scale the penalties.
        guide : (H, W) uint8
            The left image, which the penalties may follow.
        workspace : Workspace
            Buffers.
        threads : int
            1 or more; two are used.
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
        height = guide.shape[0]
        key = self, guide.shape, levels, cost.cost_max, cost.unit, cost.costly_to_recompute
        penalties, sums, workers = workspace.cached(
            "sgm", key, lambda: self._buffers(guide.shape, levels, cost, workspace)
        )
        total_out = np.empty(0, np.uint16) if total is None else total.reshape(-1)
        if len(workers) == 1:
            start(workers[0])
            _last_visit(rows[0], workers[0], guide, penalties, 0, height, 1, 0, sums, False, out, total_out)
            return

        def first(k: int, y0: int, y1: int) -> None:
            start(workers[k])
            first_visit(rows[k], workers[k], guide, penalties, y0, y1, sums, NEAR)

        def last(k: int, y0: int, y1: int, step: int, visited: int) -> None:
            _last_visit(rows[k], workers[k], guide, penalties, y0, y1, step, visited, sums, True, out, total_out)

        _meet(first, last, height, threads)

    def _narrow_sweep(
        self, rows: list[Any], search: Search, cost: Cost, guide: NDArray[np.uint8], workspace: Workspace,
        threads: int, out: SelectionOutput,
    ) -> None:  # fmt: skip
        """Aggregate and select where each pixel has a search of its own."""
        height = guide.shape[0]
        key = self, guide.shape, cost.cost_max, cost.unit, "narrow"
        penalties, sums, paths = workspace.cached(
            "sgm", key, lambda: self._buffers(guide.shape, Levels(0, LANES), cost, workspace, LANES)
        )
        edges = np.full(3 * LANES, 255, np.uint8)
        edges[LANES : 2 * LANES] = 0
        below, above = np.zeros((2, 2 * LANES), np.uint8)
        below[:LANES] = above[LANES + 1 :] = UNEXPECTED
        flat = Search(search.starts.ravel(), search.low.ravel(), search.high.ravel())
        workers = [NarrowBuffers(buffers, flat, edges, below, above) for buffers in paths]
        if len(workers) == 1:
            start_narrow(workers[0])
            _last_narrow_visit(rows[0], workers[0], guide, penalties, 0, height, 1, 0, sums, False, out)
            return

        def first(k: int, y0: int, y1: int) -> None:
            start_narrow(workers[k])
            first_narrow_visit(rows[k], workers[k], guide, penalties, y0, y1, sums, NEAR)

        def last(k: int, y0: int, y1: int, step: int, visited: int) -> None:
            _last_narrow_visit(rows[k], workers[k], guide, penalties, y0, y1, step, visited, sums, True, out)

        _meet(first, last, height, threads)

    def _buffers(
        self, shape: tuple[int, int], levels: Levels, cost: Cost, workspace: Workspace, margin: int = 0
    ) -> tuple[Penalties, NDArray[Any], list[PathBuffers]]:
        """Return the penalties, the volume of sums and the buffers of each sweep, with a margin around path costs."""
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
        workers = [
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
                state=workspace.array(f"sgm.state{k}", 3 * size + 2 * margin, np.uint8),
                lowest=workspace.array(f"sgm.lowest{k}", 3 * width, np.uint8),
                penalties=workspace.array(f"sgm.penalties{k}", 16 * width, np.uint8),
                total=workspace.array(f"sgm.total{k}", CHUNK * levels.padded, np.uint16),
                path_minimum=path_minimum,
                padding=padding,
            )
            for k in range(2 if two_sweeps else 1)
        ]
        return penalties, sums, workers


def _meet(first: Callable[..., None], last: Callable[..., None], height: int, threads: int) -> None:
    """Let the down and the up sweep visit their own half of the rows first, and the other's last."""
    middle = height // 2

    def visit(name: str, function: Callable[..., None], *args: Any) -> None:
        with span("match", name):
            function(*args)

    begin, end = (partial(visit, "sweep: first visit", first), partial(visit, "sweep: last visit", last))
    run_stages(
        [
            [partial(begin, 0, 0, middle), partial(begin, 1, height - 1, middle - 1)],
            [partial(end, 0, middle, height, 1, middle), partial(end, 1, middle - 1, -1, -1, height - middle)],
        ],
        threads,
    )


@kernel
def _last_narrow_visit(
    rows: Any, buffers: NarrowBuffers, guide: NDArray[np.uint8], penalties: Penalties, y0: int, y1: int, step: int,
    k0: int, sums: NDArray[Any], both: bool, out: SelectionOutput,
) -> None:  # fmt: skip
    """Sweep from row `y0` to before row `y1`, sum all paths and select; `k0` rows came before in this sweep."""
    paths = buffers.paths
    for k in range(abs(y1 - y0)):
        y = y0 + k * step
        half = k % 2
        if half == 0:
            prepare_narrow_rows(rows, buffers, guide, penalties, y, step, min(2, abs(y1 - y0) - k))
        for x0 in range(0, paths.width, CHUNK):
            x1 = min(x0 + CHUNK, paths.width)
            finish_narrow_part(buffers, guide, half, y, step, k0 + k, x0, x1, sums, both)
            select_row(paths.total, paths.total, x1 - x0, paths.blocks, y * paths.width + x0, out)


@kernel
def _last_visit(
    rows: Any, buffers: PathBuffers, guide: NDArray[np.uint8], penalties: Penalties, y0: int, y1: int, step: int,
    k0: int, sums: NDArray[Any], both: bool, out: SelectionOutput, total: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Sweep from row `y0` to before row `y1`, sum all paths and select; `k0` rows came before in this sweep.

    If there are `both` sweeps, the other one left its part in `sums`. The sums also go to `total`, unless it is empty.
    """
    padded = LANES * len(buffers.blocks)
    visits = abs(y1 - y0)
    for k in range(visits):
        y = y0 + k * step
        half = k % 2
        if half == 0:
            prepare_rows(rows, buffers, guide, penalties, y, step, min(2, visits - k), sums)
        for x0 in range(0, buffers.width, CHUNK):
            x1 = min(x0 + CHUNK, buffers.width)
            finish_part(buffers, half, y, k0 + k, x0, x1, sums, both)
            if total.size > 0:
                for at in range(0, (x1 - x0) * padded, LANES):
                    store(total, (y * buffers.width + x0) * padded + at, load(buffers.total, at))
            select_row(buffers.total, buffers.total, x1 - x0, buffers.blocks, y * buffers.width + x0, out)
