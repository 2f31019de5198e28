"""The head is the map itself over 256, in four phases: the paper's form, with inputs scaled to [0, 1]."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel
from stereokit.kernels.threads import run, spans

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Direct"]

_RANGE = 256.0  # full-size pixels


@dataclass(frozen=True)
class Direct:
    """Four phases of the map; see `stereokit_refiners.outputs.contract.Output`."""

    channels: ClassVar[int] = 4
    unit_inputs: ClassVar[bool] = True
    initial_bias: ClassVar[NDArray[np.float32] | None] = None

    def map(
        self, head: NDArray[np.float32], coarse: NDArray[np.float32], rows: int, columns: int, threads: int = 1,
        candidates: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Return the map of a head, by compiled loops; `coarse` is not looked at."""
        out = np.empty((rows, columns), np.float32)
        run([partial(_interleave, head, y0, y1, out) for y0, y1 in spans(-(-rows // 2), threads)], threads)
        return out

    def tensor_map(self, head: Tensor, coarse: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Return the map of a head in torch."""
        from torch.nn import functional

        return functional.pixel_shuffle(head.float(), 2) * _RANGE

    def graph_map(self, graph: Any, head: str, coarse: str, candidates: str) -> str:
        """Add the map of a head to a graph."""
        return str(graph.multiply(graph.shuffle(head), _RANGE))


@kernel
def _interleave(head: NDArray[np.float32], y0: int, y1: int, out: NDArray[np.float32]) -> None:
    for y in range(2 * y0, min(2 * y1, out.shape[0])):
        for x in range(out.shape[1]):
            out[y, x] = np.float32(256) * head[y // 2, x // 2, 2 * (y % 2) + x % 2]
