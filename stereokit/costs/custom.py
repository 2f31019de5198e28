"""Costs that a user writes as one plain numba function.

The costs of the whole image are computed once into a volume and then stream through the same sweeps as those of
the built-in costs; nothing needs to be compiled again but the function itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from stereokit.costs.rows import CostInput, VolumeRows
from stereokit.errors import OptionError
from stereokit.images.check import check_integer
from stereokit.kernels.threads import run, spans
from stereokit.kernels.workspace import Workspace

__all__ = ["RowCost"]


@dataclass(frozen=True)
class RowCost:
    """A cost made of one compiled function.

    Parameters
    ----------
    function : callable
        ``function(left, right, y, min_disparity, out)``, compiled with ``numba.njit(nogil=True)``. It writes the
        costs of row `y` into `out`, ``(W, D)`` ``uint8`` from 0 (equal) to `cost_max`; ``out[x, d]`` compares left
        column ``x`` with right column ``x - d - min_disparity``. Images are ``(H, W)`` ``uint8``, always: smoothed
        ones are rounded, and those of 16 bits or floats have 256 levels over the range of both views. Cells whose
        right pixel lies outside the image need not be written.
    cost_max : int
        Largest cost that it writes, 1 to 254.
    """

    function: Callable[..., None]
    cost_max: int
    name: str = "custom"

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise OptionError(f"function of a row cost must be callable, got {self.function!r}")
        object.__setattr__(self, "cost_max", check_integer("cost_max", self.cost_max, 1, 254))

    def __call__(self) -> RowCost:
        """Return itself: a row cost has no options, so it is its own factory in the registry."""
        return self

    @property
    def unit(self) -> int:
        """Penalties are given in units of cost."""
        return 1

    @property
    def eight_bits(self) -> bool:
        """Whether the images that it sees have 8 bits."""
        return True

    @property
    def costly_to_recompute(self) -> bool:
        """Whether a row costs more to compute again than to bring back from a volume."""
        return False

    def prepare(self, pair: CostInput, workspace: Workspace, workers: int) -> list[VolumeRows]:
        """Compute the cost volume; return its rows for `workers` sweeps."""
        height, width = pair.left.shape
        levels = pair.levels
        volume = workspace.array("custom.volume", (height, width, levels.count), np.uint8)
        border_cost = np.uint8(self.cost_max if pair.border_share is None else round(pair.border_share * self.cost_max))
        columns = np.arange(width)[:, None] - np.arange(levels.count)[None, :] - levels.minimum
        no_match = (columns < 0) | (columns >= width)
        margin = 0
        left, right = pair.left, pair.right
        if pair.border_share is None:  # the function sees images that go on with their border pixels
            margin = max(0, levels.minimum + levels.count - 1, -levels.minimum)
            left, right = (np.pad(image, ((0, 0), (margin, margin)), mode="edge") for image in (left, right))

        def fill(y0: int, y1: int) -> None:
            wide = np.empty((left.shape[1], levels.count), np.uint8)
            for y in range(y0, y1):
                row = volume[y]
                if pair.border_share is None:
                    self.function(left, right, y, levels.minimum, wide)
                    row[:] = wide[margin : margin + width]
                else:
                    self.function(left, right, y, levels.minimum, row)
                    np.copyto(row, border_cost, where=no_match)
                if pair.right_bad is not None:
                    np.copyto(row, border_cost, where=pair.right_bad[y, np.clip(columns, 0, width - 1)])
                if pair.left_bad is not None:
                    row[pair.left_bad[y]] = border_cost

        run([partial(fill, y0, y1) for y0, y1 in spans(height, pair.threads)], pair.threads)
        return [VolumeRows(volume, levels.padded)] * workers
