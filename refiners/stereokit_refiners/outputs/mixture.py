"""Each full-size pixel is a weighted mean of coarse values nearby and of the matcher's candidates.

The head's channels: a correction of the coarse map; four phases of a small residual; and for each value four phases of
the logit of its weight. A softmax makes the weights (as convex upsampling in Teed and Deng 2020, with a longer reach).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel
from stereokit.kernels.threads import run, spans
from stereokit_refiners.outputs.contract import GAIN
from stereokit_refiners.outputs.exponential import exponential

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Mixture"]

_GAIN = np.float32(GAIN)
_CANDIDATES = 2
_FIRST = 5  # channel of the logits
_SLOPE = -1.5  # of the initial logits, by the squared distance in half-size pixels


@dataclass(frozen=True)
class Mixture:
    """A softmax over values; see `stereokit_refiners.outputs.contract.Output`.

    Parameters
    ----------
    offsets : tuple of (int, int)
        Where the coarse values lie that a pixel chooses from, rows and columns of the half-size map. The matcher's two
        candidates come after them.
    """

    offsets: tuple[tuple[int, int], ...]
    unit_inputs: ClassVar[bool] = False

    @property
    def values(self) -> int:
        """How many values a pixel chooses from."""
        return len(self.offsets) + _CANDIDATES

    @property
    def channels(self) -> int:
        """Channels of the head."""
        return _FIRST + 4 * self.values

    @property
    def initial_bias(self) -> NDArray[np.float32]:
        """Bias of the head that favours the nearest coarse value."""
        bias = np.zeros(self.channels, np.float32)
        logits = bias[_FIRST:].reshape(self.values, 4)
        for phase in range(4):
            for k, (dy, dx) in enumerate(self.offsets):
                square = (dy - (phase // 2 - 0.5) * 0.5) ** 2 + (dx - (phase % 2 - 0.5) * 0.5) ** 2
                logits[k, phase] = _SLOPE * square
            logits[len(self.offsets) :, phase] = _SLOPE
        return bias

    def map(
        self, head: NDArray[np.float32], coarse: NDArray[np.float32], rows: int, columns: int, threads: int = 1,
        candidates: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Return the map of a head, by compiled loops."""
        assert candidates is not None
        out = np.empty((rows, columns), np.float32)
        dy, dx = (np.array([offset[axis] for offset in self.offsets], np.int64) for axis in (0, 1))
        corrected = np.empty(coarse.shape, np.float32)
        run([partial(_correct, head, coarse, y0, y1, corrected) for y0, y1 in spans(len(coarse), threads)], threads)
        parts = spans(-(-rows // 2), threads)
        shares = np.empty((len(parts), 4 * self.values + 4), np.float32)
        candidates = np.ascontiguousarray(candidates)
        run(
            [
                partial(_mix, head, corrected, candidates, dy, dx, y0, y1, shares[k], out)
                for k, (y0, y1) in enumerate(parts)
            ],
            threads,
        )
        return out

    def tensor_map(self, head: Tensor, coarse: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Return the map of a head in torch."""
        import torch
        from torch.nn import functional

        assert candidates is not None
        head = head.float()
        rows, columns = head.shape[-2:]
        reach = self._reach
        padded = functional.pad(coarse + GAIN * head[:, :1], (reach,) * 4, mode="replicate")
        around = [
            padded[:, :, reach + dy : reach + dy + rows, reach + dx : reach + dx + columns] for dy, dx in self.offsets
        ]
        values = torch.stack([*around, candidates[:, :1], candidates[:, 1:]], 1)
        share = head[:, _FIRST:].reshape(-1, self.values, 4, rows, columns).softmax(1)
        return functional.pixel_shuffle((share * values).sum(1) + GAIN * head[:, 1:_FIRST], 2)

    def graph_map(self, graph: Any, head: str, coarse: str, candidates: str) -> str:
        """Add the map of a head to a graph."""
        reach = self._reach
        corrected = graph.add(coarse, graph.multiply(graph.slice(head, 1, 0, 1), GAIN))
        pads = graph.constant([0, 0, reach, reach, 0, 0, reach, reach], np.int64)
        padded = graph.node("Pad", [corrected, pads], mode="edge")
        around = []
        for dy, dx in self.offsets:
            # A slice that ends `reach - d` before the border of the padded map; its end counts from the far side.
            rows = graph.slice(padded, 2, reach + dy, dy - reach if dy < reach else 2**31)
            around.append(graph.slice(rows, 3, reach + dx, dx - reach if dx < reach else 2**31))
        values = graph.node("Concat", [*around, candidates], axis=1)
        values = graph.node("Unsqueeze", [values, graph.constant([2], np.int64)])
        logits = graph.slice(head, 1, _FIRST, self.channels)
        size = graph.node("Shape", [head])
        tail = graph.node("Slice", [size, *(graph.constant([v], np.int64) for v in (2, 4, 0))])
        shape = graph.node("Concat", [graph.constant([1, self.values, 4], np.int64), tail], axis=0)
        share = graph.node("Softmax", [graph.node("Reshape", [logits, shape])], axis=1)
        product = graph.node("Mul", [share, values])
        mean = graph.node("ReduceSum", [product, graph.constant([1], np.int64)], keepdims=0)
        return str(graph.shuffle(graph.add(mean, graph.multiply(graph.slice(head, 1, 1, _FIRST), GAIN))))

    @property
    def _reach(self) -> int:
        return max(max(abs(dy), abs(dx)) for dy, dx in self.offsets)


@kernel
def _correct(
    head: NDArray[np.float32], coarse: NDArray[np.float32], y0: int, y1: int, out: NDArray[np.float32]
) -> None:
    for y in range(y0, y1):
        for x in range(coarse.shape[1]):
            out[y, x] = coarse[y, x] + _GAIN * head[y, x, 0]


@kernel
def _mix(
    head: NDArray[np.float32], corrected: NDArray[np.float32], candidates: NDArray[np.float32],
    dy: NDArray[np.int64], dx: NDArray[np.int64],
    y0: int, y1: int, share: NDArray[np.float32], out: NDArray[np.float32],
) -> None:  # fmt: skip
    """Softmax-weighted mean of the values to choose from, for each of the four phases, plus its residual."""
    height, width = corrected.shape
    around = dy.size
    count = around + len(candidates)
    for y in range(y0, y1):
        for x in range((out.shape[1] + 1) // 2):
            pixel = head[y, x]
            peak = share[4 * count :]  # the largest logit of each phase
            for phase in range(4):
                peak[phase] = pixel[5 + phase]
            for k in range(1, count):
                for phase in range(4):
                    peak[phase] = max(peak[phase], pixel[5 + 4 * k + phase])
            for k in range(count):
                for phase in range(4):
                    share[4 * k + phase] = pixel[5 + 4 * k + phase] - peak[phase]
            for k in range(4 * count):  # one long loop: vector code
                share[k] = exponential(share[k])
            total_0 = np.float32(0)
            total_1 = np.float32(0)
            total_2 = np.float32(0)
            total_3 = np.float32(0)
            sum_0 = np.float32(0)
            sum_1 = np.float32(0)
            sum_2 = np.float32(0)
            sum_3 = np.float32(0)
            for k in range(count):
                if k < around:
                    value = corrected[min(max(y + dy[k], 0), height - 1), min(max(x + dx[k], 0), width - 1)]
                else:
                    value = candidates[k - around, y, x]
                total_0 += share[4 * k]
                total_1 += share[4 * k + 1]
                total_2 += share[4 * k + 2]
                total_3 += share[4 * k + 3]
                sum_0 += share[4 * k] * value
                sum_1 += share[4 * k + 1] * value
                sum_2 += share[4 * k + 2] * value
                sum_3 += share[4 * k + 3] * value
            row = 2 * y
            column = 2 * x
            out[row, column] = sum_0 / total_0 + _GAIN * pixel[1]
            if column + 1 < out.shape[1]:
                out[row, column + 1] = sum_1 / total_1 + _GAIN * pixel[2]
            if row + 1 < out.shape[0]:
                out[row + 1, column] = sum_2 / total_2 + _GAIN * pixel[3]
                if column + 1 < out.shape[1]:
                    out[row + 1, column + 1] = sum_3 / total_3 + _GAIN * pixel[4]
