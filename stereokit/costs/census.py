"""Census transform and Hamming distance (Zabih and Woodfill 1994).

Bit ``k`` of a pixel's census tells whether neighbour ``k`` of its window is darker, ``I(q) < I(p)``; the cost of a
match is the number of bits that differ. All neighbours of the window count (62 of 9x7). Borders are clamped.

The bits lie in byte planes, eight neighbours to a plane: then the Hamming distances of 64 levels are, plane
by plane, one load, one exclusive or, one population count and one addition of bytes.

Bound and measurement: 5x5 has 3 planes, so 64 cells take 9 operations on 512-bit vectors, 3 loads and a store, or
1.2 ms for 1242x375 with 128 levels on one thread of a Zen 4 at two operations per cycle of 3.65 GHz and 1.9 ms for the
loads and stores; measured 2.5 ms.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import CellMask, CostInput, cell_mask, implements, mask_narrow_row, mask_row, pad_pair
from stereokit.errors import OptionError, shown
from stereokit.kernels.jit import kernel
from stereokit.kernels.simd import LANES, add, bitwise_or, count_bits, load, mark_less, splat, store, xor
from stereokit.kernels.threads import run, spans
from stereokit.kernels.workspace import Workspace
from stereokit.registry import COSTS

__all__ = ["Census"]

WINDOWS = {"5x5": (5, 5), "7x7": (7, 7), "9x7": (9, 7)}


class CensusRows(NamedTuple):
    """Byte planes of both images, for `cost_row`."""

    cells: CellMask
    planes: tuple[int, ...]  # 0, 1, ..: its length is known to the compiler
    left: NDArray[np.uint8]  # element (y * planes + p) * left_stride + x
    left_stride: int
    right: NDArray[np.uint8]  # reversed, element (y * planes + p) * right_stride + k
    right_stride: int


class NarrowCensusRows(NamedTuple):
    """Byte planes of both images, for pixels that search `LANES` levels from `starts` on."""

    planes: CensusRows
    starts: NDArray[np.int16]  # (H * W)


@COSTS.register("census")
@dataclass(frozen=True)
class Census:
    """Hamming distance of census transforms, one unit per neighbour that differs.

    Parameters
    ----------
    window : {"9x7", "7x7", "5x5"}
        Width x height of the window; 62, 48 or 24 neighbours, which is also the largest cost.
    """

    window: str = "9x7"
    name: ClassVar[str] = "census"
    narrow: ClassVar[bool] = True
    cuda: ClassVar[str] = "stereokit.costs.census_cuda"

    def __post_init__(self) -> None:
        if not isinstance(self.window, str) or self.window not in WINDOWS:
            raise OptionError(f"window of census must be one of {', '.join(WINDOWS)}, got {shown(self.window)}")

    @property
    def cost_max(self) -> int:
        """Largest cost."""
        width, height = WINDOWS[self.window]
        return width * height - 1

    @property
    def reach(self) -> tuple[int, int]:
        """Half of the window across and down, pixels."""
        width, height = WINDOWS[self.window]
        return width // 2, height // 2

    @property
    def unit(self) -> int:
        """Penalties are given in neighbours that differ: one unit of cost."""
        return 1

    @property
    def costly_to_recompute(self) -> bool:
        """Whether a row costs more to compute again than to bring back from a volume."""
        return self.window == "9x7"

    def prepare(self, pair: CostInput, workspace: Workspace, workers: int) -> list[Any]:
        """Transform both images; return the row producers of `workers` sweeps."""
        height, width = pair.left.shape
        across, down = (size // 2 for size in WINDOWS[self.window])
        margin = max(across, down)
        offsets = [(dy, dx) for dy in range(-down, down + 1) for dx in range(-across, across + 1) if (dy, dx) != (0, 0)]
        dy, dx = (np.array(part, np.int64) for part in zip(*offsets, strict=True))
        planes = -(-len(offsets) // 8)
        left, right = pad_pair(pair, margin, workspace)
        left_stride = -(-width // LANES) * LANES
        right_stride = width + pair.levels.padded + LANES
        left_planes = workspace.array("census.left", height * planes * left_stride, np.uint8)
        right_planes = workspace.array("census.right", height * planes * right_stride, np.uint8)
        left_image = (left.ravel(), left.shape[1], margin, width)
        right_image = (right.ravel(), right.shape[1], margin, width + pair.levels.padded)
        tasks: list[Any] = []
        for y0, y1 in spans(height, pair.threads):
            tasks.append(partial(_transform, *left_image, dy, dx, y0, y1, left_planes, left_stride))
            tasks.append(partial(_transform, *right_image, dy, -dx, y0, y1, right_planes, right_stride))
        run(tasks, pair.threads)
        cells = cell_mask(pair, self.cost_max, workspace)
        rows = CensusRows(
            cells=cells,
            planes=tuple(range(planes)),
            left=left_planes,
            left_stride=left_stride,
            right=right_planes,
            right_stride=right_stride,
        )
        return [rows if pair.starts is None else NarrowCensusRows(rows, pair.starts.ravel())] * workers


@kernel
def _transform(
    image: NDArray[Any], image_stride: int, margin: int, width: int, dy: NDArray[np.int64],
    dx: NDArray[np.int64], y0: int, y1: int, out: NDArray[np.uint8], out_stride: int,
) -> None:  # fmt: skip
    planes = (dy.size + 7) // 8
    for y in range(y0, y1):
        for x in range(0, width, LANES):
            at = (y + margin) * image_stride + margin + x
            centre = load(image, at)
            for plane in range(planes):
                bits = splat(np.uint8(0))
                for k in range(8 * plane, min(8 * plane + 8, dy.size)):
                    neighbour = load(image, at + dy[k] * image_stride + dx[k])
                    bits = bitwise_or(bits, mark_less(neighbour, centre, np.uint8(1 << (k - 8 * plane))))
                store(out, (y * planes + plane) * out_stride + x, bits)


@implements(CensusRows)
@kernel
def _census_row(rows: CensusRows, y: int, x0: int, x1: int, out: NDArray[np.uint8]) -> None:
    cells = rows.cells
    planes = len(rows.planes)
    left = y * planes * rows.left_stride
    right = y * planes * rows.right_stride
    for x in range(x0, x1):
        k = cells.width - 1 - x
        for n in range(len(cells.blocks)):
            block = n * LANES
            cost = splat(np.uint8(0))
            for p in range(planes):
                left_bits = splat(rows.left[left + p * rows.left_stride + x])
                right_bits = load(rows.right, right + p * rows.right_stride + k + block)
                cost = add(cost, count_bits(xor(left_bits, right_bits)))
            store(out, x * LANES * len(cells.blocks) + block, cost)
    mask_row(cells, y, x0, x1, out)


@implements(NarrowCensusRows)
@kernel
def _narrow_census_row(rows: NarrowCensusRows, y: int, x0: int, x1: int, out: NDArray[np.uint8]) -> None:
    planes = rows.planes
    width = planes.cells.width
    count = len(planes.planes)
    left = y * count * planes.left_stride
    right = y * count * planes.right_stride
    for x in range(x0, x1):
        k = width - 1 - x + np.int64(rows.starts[y * width + x])
        cost = splat(np.uint8(0))
        for p in range(count):
            left_bits = splat(planes.left[left + p * planes.left_stride + x])
            right_bits = load(planes.right, right + p * planes.right_stride + k)
            cost = add(cost, count_bits(xor(left_bits, right_bits)))
        store(out, x * LANES, cost)
    mask_narrow_row(planes.cells, rows.starts, y, x0, x1, out)
