"""The contract of an aggregation, for those who bring their own (entry-point group ``stereokit.aggregations``).

An aggregation is a frozen dataclass whose fields are its options. It sweeps over the rows of a cost, sums the costs and
selects as it goes, so that no volume need be stored (`stereokit.aggregation.sgm.Sgm` and
`stereokit.aggregation.dt.Dt` are two). It may further have

- ``fitting(cost, defaults)``, a class method: changes to default options that a cost calls for;
- ``check_cost(cost)``: raises `stereokit.OptionError` where options do not go with a cost;
- ``narrow``: True where `sweep` takes a further argument ``search``, a `stereokit.costs.rows.Search` that says what
  each pixel tries instead of all levels (the rows then have ``LANES`` levels);
- ``cuda``: the name of the module with its CUDA twin, whose ``aggregate`` has the arguments of
  `stereokit.aggregation.sgm_cuda.aggregate`. Without one the method runs on the CPU only.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import Cost, Levels
from stereokit.kernels.workspace import Workspace
from stereokit.selection.wta import SelectionOutput

__all__ = ["Aggregation"]


class Aggregation(Protocol):
    """Sweeps over the rows of a cost, sums and selects."""

    name: ClassVar[str]

    @property
    def total_dtype(self) -> Any:
        """Type of the aggregated costs of ``uint8`` rows."""

    @property
    def accepts_floats(self) -> bool:
        """Whether `stereokit.aggregate` may hand it a ``float32`` volume, as a further argument ``volume``."""

    def sweep(
        self, rows: list[Any], levels: Levels, cost: Cost, guide: NDArray[np.uint8], workspace: Workspace,
        threads: int, out: SelectionOutput, total: NDArray[Any] | None = None,
    ) -> None:  # fmt: skip
        """Aggregate the rows of a cost and select.

        Parameters
        ----------
        rows : list of row producers
            As `stereokit.costs.rows.Cost.prepare` returns them: at least two, and one for each thread.
        levels : Levels
            Disparities.
        cost : Cost
            The cost that produces the rows; its range and unit scale penalties.
        guide : (H, W) uint8
            Left grey image, along whose edges costs are not mixed.
        workspace : Workspace
            Buffers.
        threads : int
            Threads to use; the result must not depend on it.
        out : SelectionOutput
            Maps that `stereokit.selection.wta.select_row` writes.
        total : (H, W, P) of `total_dtype`, optional
            Volume for the aggregated costs, if they are wanted.
        """
