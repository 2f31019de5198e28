"""The contract of an output rule.

A network's head has half of the map's rows and columns; a rule makes the full-size map of it. Each rule stands in one
file with all its forms: compiled loops for the processor, torch for training and for the GPU, nodes for ONNX. Torch is
imported by the methods that need it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["GAIN", "Output"]

GAIN = 4.0
"""Unit of what a head adds to a map, pixels."""


class Output(Protocol):
    """From a head and the coarse map to the full-size map."""

    @property
    def channels(self) -> int:
        """Channels of the head."""

    @property
    def unit_inputs(self) -> bool:
        """Whether the network's inputs are scaled to [0, 1]; see `stereokit_refiners.runtimes.encode.encode`."""

    @property
    def initial_bias(self) -> NDArray[np.float32] | None:
        """Bias of the head, (channels,), from which training starts; None for zeros."""

    def map(
        self, head: NDArray[np.float32], coarse: NDArray[np.float32], rows: int, columns: int, threads: int = 1,
        candidates: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Return the map of a head.

        Rows do not depend on one another, so the result does not depend on how they are shared out between threads.

        Parameters
        ----------
        head : (h, w, channels) float32, C-contiguous
            Channels innermost, as convolutions leave them in memory.
        coarse : (h, w) float32
            Coarse map, full-size pixels.
        rows, columns : int
            Size of the map, at most ``2h`` x ``2w``.
        threads : int
        candidates : (2, h, w) float32 or None
            The matcher's candidates, full-size pixels, for rules that choose among them.

        Returns
        -------
        (rows, columns) float32, full-size pixels
        """

    def tensor_map(self, head: Tensor, coarse: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Return the map of a head in torch, differentiable: (B, channels, h, w) and (B, 1, h, w) to (B, 1, 2h, 2w)."""

    def graph_map(self, graph: Any, head: str, coarse: str, candidates: str) -> str:
        """Add the map of a head to a graph, the operations of `stereokit_refiners.runtimes.onnx`; return its name."""
