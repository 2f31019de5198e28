"""The head corrects the coarse map, upscaled bilinearly: four phases of differences."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel
from stereokit.kernels.threads import run, spans
from stereokit_refiners.outputs.contract import GAIN

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Residual"]

_GAIN = np.float32(GAIN)


@dataclass(frozen=True)
class Residual:
    """Four phases of a correction; see `stereokit_refiners.outputs.contract.Output`."""

    channels: ClassVar[int] = 4
    unit_inputs: ClassVar[bool] = False
    initial_bias: ClassVar[NDArray[np.float32] | None] = None

    def map(
        self, head: NDArray[np.float32], coarse: NDArray[np.float32], rows: int, columns: int, threads: int = 1,
        candidates: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Return the map of a head, by compiled loops."""
        out = np.empty((rows, columns), np.float32)
        run(
            [partial(_correct_upscaled, head, coarse, y0, y1, out) for y0, y1 in spans(-(-rows // 2), threads)], threads
        )
        return out

    def tensor_map(self, head: Tensor, coarse: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Return the map of a head in torch."""
        from torch.nn import functional

        upscaled = functional.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)
        return upscaled + GAIN * functional.pixel_shuffle(head.float(), 2)

    def graph_map(self, graph: Any, head: str, coarse: str, candidates: str) -> str:
        """Add the map of a head to a graph."""
        return str(graph.add(graph.upsample2x(coarse), graph.multiply(graph.shuffle(head), GAIN)))


@kernel
def _correct_upscaled(
    head: NDArray[np.float32], coarse: NDArray[np.float32], y0: int, y1: int, out: NDArray[np.float32]
) -> None:
    """Add the correction to the bilinearly upscaled map; pixel centres are kept, so the weights are 3/4 and 1/4."""
    height, width = coarse.shape
    near = np.float32(0.75)
    far = np.float32(0.25)
    for y in range(y0, y1):
        for i in range(2):
            row = 2 * y + i
            if row >= out.shape[0]:
                continue
            other = coarse[min(max(y - 1 + 2 * i, 0), height - 1)]
            mine = coarse[y]
            before = near * mine[0] + far * other[0]
            here = before
            for x in range((out.shape[1] + 1) // 2):
                after = here
                if x + 1 < width:
                    after = near * mine[x + 1] + far * other[x + 1]
                out[row, 2 * x] = near * here + far * before + _GAIN * head[y, x, 2 * i]
                if 2 * x + 1 < out.shape[1]:
                    out[row, 2 * x + 1] = near * here + far * after + _GAIN * head[y, x, 2 * i + 1]
                before = here
                here = after
