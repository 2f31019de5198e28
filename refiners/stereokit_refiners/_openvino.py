"""Networks in OpenVINO: the fast way on a CPU, in fp32, bf16 or int8, without torch.

The graph is built from the network's own description; transposed convolutions stand in their sub-pixel form, which
is several times faster and equal up to rounding. For int8, each activation that calibration found a range for passes
through one FakeQuantize node where it is made, and the weights of the convolutions that read it through another;
OpenVINO turns these into integer kernels. Inputs of the network stay in floating point: 8 bits would be too coarse for
a disparity.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import openvino as ov
from numpy.typing import NDArray
from openvino import opset13 as op

from stereokit.kernels.pool import available_threads
from stereokit_refiners.layers import Layer, Network, Weights, sub_pixel_kernel

__all__ = ["build", "compiled"]


class _OpenVinoOps:
    """Ops that make nodes."""

    def __init__(self, network: Network, weights: Weights, ranges: Mapping[str, float]) -> None:
        self.table = {layer.name: layer for layer in network.layers}
        self.weights = weights
        self.ranges = ranges
        self.rounded: set[int] = set()  # nodes that hold 8 bits

    def conv(self, name: str, inputs: Sequence[Any], *, activate: bool = True) -> Any:
        layer = self.table[name]
        y = self._convolve(layer, inputs)
        if layer.up:
            y = op.depth_to_space(y, "depth_first", 2)
        return self.activate(name, y) if activate else y

    def conv_split(self, name: str, inputs: Sequence[Any]) -> Any:
        return self._convolve(self.table[name], inputs)

    def sample(self, mean: Any, log_sigma: Any) -> Any:
        return mean

    def add(self, a: Any, b: Any) -> Any:
        return op.add(a, b)

    def shift(self, x: Any, by: float) -> Any:
        return op.add(x, _const(by))

    def activate(self, name: str, x: Any) -> Any:
        y = op.prelu(x, _const([0.1]))
        if name not in self.ranges:
            return y
        bound = max(float(self.ranges[name]), 1e-6)
        low, high = _const(-bound * 128 / 127), _const(bound)
        y = op.fake_quantize(y, low, high, low, high, 256)
        self.rounded.add(id(y))
        return y

    def twice(self, x: Any) -> Any:
        rows, columns = x.get_output_shape(0)[2:]
        sizes = op.constant(np.array([2 * rows, 2 * columns], np.int64))
        return op.interpolate(
            x, sizes, "linear_onnx", "sizes", coordinate_transformation_mode="half_pixel",
            axes=op.constant(np.array([2, 3], np.int64)),
        )  # fmt: skip

    def _convolve(self, layer: Layer, inputs: Sequence[Any]) -> Any:
        """Convolve; inputs in 8 bits together, and those in floating point by a convolution of their own."""
        weight, bias = self.weights[f"{layer.name}.weight"], self.weights[f"{layer.name}.bias"]
        if layer.up:
            weight, bias = sub_pixel_kernel(weight), np.repeat(bias, 4)
        ends = np.cumsum([x.get_output_shape(0)[1] for x in inputs])
        parts = np.split(weight, ends[:-1], axis=1)
        side = weight.shape[-1] // 2
        y = None
        for integer in (True, False):
            members = [k for k, x in enumerate(inputs) if (id(x) in self.rounded) == integer]
            if not members:
                continue
            x = inputs[members[0]] if len(members) == 1 else op.concat([inputs[k] for k in members], 1)
            kernel = _kernel(np.concatenate([parts[k] for k in members], 1), integer)
            z = op.convolution(x, kernel, [layer.stride] * 2, [side] * 2, [side] * 2, [1, 1])
            y = z if y is None else op.add(y, z)
        return op.add(y, _const(bias.reshape(1, -1, 1, 1)))


def _const(values: Any) -> Any:
    return op.constant(np.asarray(values, np.float32))


def _kernel(weight: NDArray[np.float32], integer: bool) -> Any:
    node = _const(np.ascontiguousarray(weight))
    if not integer:
        return node
    bound = np.maximum(np.abs(weight).max(axis=(1, 2, 3), keepdims=True), 1e-8)
    low, high = _const(-bound), _const(bound)
    return op.fake_quantize(node, low, high, low, high, 255)


def build(
    network: Network, weights: Weights, rows: int, columns: int, ranges: Mapping[str, float] | None = None
) -> ov.Model:
    """Return the graph for inputs of ``rows`` x ``columns``; its output is the head, (1, h, w, C).

    Parameters
    ----------
    ranges : mapping, optional
        Largest absolute value of each activation by name, for int8.
    """
    ops = _OpenVinoOps(network, weights, ranges or {})
    inputs = {
        name: op.parameter([1, channels, rows, columns], np.float32, name=name)
        for name, channels in network.inputs.items()
    }
    head = network.forward(ops, inputs)["map"]
    head = op.transpose(head, op.constant(np.array([0, 2, 3, 1], np.int64)))  # the layout that it has in memory
    return ov.Model([op.result(head)], list(inputs.values()), network.name)


@lru_cache(maxsize=1)
def _core() -> ov.Core:
    return ov.Core()


def compiled(
    network: Network, weights: Weights, rows: int, columns: int, threads: int, precision: str,
    ranges: Mapping[str, float] | None,
) -> Callable[[dict[str, NDArray[np.float32]]], NDArray[np.float32]]:  # fmt: skip
    """Compile for a size; return a function from (C, h, w) inputs to the (h, w, C) head, safe to call in parallel.

    With one thread a call, as many calls run side by side as there are processors; with more, one call uses them all.
    """
    streams = available_threads() if threads == 1 else 1
    model = _core().compile_model(
        build(network, weights, rows, columns, ranges),
        "CPU",
        {
            "NUM_STREAMS": streams,
            "INFERENCE_NUM_THREADS": threads * streams,
            "INFERENCE_PRECISION_HINT": "bf16" if precision == "bf16" else "f32",
            "ENABLE_CPU_PINNING": False,
        },
    )
    idle: deque[Any] = deque()
    made = threading.Lock()

    def run(inputs: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
        try:
            request = idle.pop()
        except IndexError:
            with made:
                request = model.create_infer_request()
        try:
            given = [inputs[name][None] for name in network.inputs]
            request.infer(given, share_inputs=True)
            return np.array(request.get_output_tensor().data[0])
        finally:
            idle.append(request)

    return run
