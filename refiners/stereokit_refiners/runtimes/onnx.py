"""Networks as ONNX graphs: what ONNX Runtime and OpenCV run, and what `stereokit export` writes.

Built from the network's own description, with transposed convolutions in their sub-pixel form. Rows and columns are
left open, so that one file serves every size (multiples of ``2 * network.stride`` in full-size pixels).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit_refiners.networks.layers import Network, Weights, output_rule, sub_pixel_kernel
from stereokit_refiners.runtimes.contract import Run
from stereokit_refiners.runtimes.onnx_file import Node, model_bytes
from stereokit_refiners.runtimes.planes import planar

__all__ = ["head_graph", "map_graph", "session"]


class _GraphOps:
    """Ops that append nodes; a tensor is its name."""

    def __init__(self, network: Network, weights: Weights) -> None:
        self.table = {layer.name: layer for layer in network.layers}
        self.weights = weights
        self.nodes: list[Node] = []
        self.constants: dict[str, NDArray[Any]] = {}

    def node(self, kind: str, inputs: Sequence[str], count: int = 1, **attributes: Any) -> Any:
        names = [f"t{len(self.nodes)}_{k}" for k in range(count)]
        self.nodes.append(Node(kind, list(inputs), names, attributes))
        return names[0] if count == 1 else names

    def constant(self, values: Any, dtype: Any = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants[name] = np.asarray(values, dtype)
        return name

    def conv(self, name: str, inputs: Sequence[str], *, activate: bool = True) -> str:
        layer = self.table[name]
        y = self._convolve(name, inputs)
        if layer.up:
            y = self.shuffle(y)
        return self.activate(name, y) if activate else y

    def conv_transpose_phases(self, name: str, inputs: Sequence[str]) -> str:
        return self._convolve(name, inputs)

    def _convolve(self, name: str, inputs: Sequence[str]) -> str:
        layer = self.table[name]
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        if layer.up:
            weight, bias = sub_pixel_kernel(weight), np.repeat(bias, 4)
        x = inputs[0] if len(inputs) == 1 else self.node("Concat", inputs, axis=1)
        side = weight.shape[-1] // 2
        operands = [x, self.constant(weight), self.constant(bias)]
        return str(
            self.node("Conv", operands, kernel_shape=[2 * side + 1] * 2, pads=[side] * 4, strides=[layer.stride] * 2)
        )

    def shuffle(self, x: str) -> str:
        return str(self.node("DepthToSpace", [x], blocksize=2, mode="CRD"))

    def sample(self, mean: str, log_sigma: str) -> str:
        return mean

    def add(self, a: str, b: str) -> str:
        return str(self.node("Add", [a, b]))

    def multiply(self, x: str, by: float) -> str:
        return str(self.node("Mul", [x, self.constant(by)]))

    def shift(self, x: str, by: float) -> str:
        return self.add(x, self.constant(by))

    def activate(self, name: str, x: str) -> str:
        return str(self.node("LeakyRelu", [x], alpha=0.1))

    def upsample2x(self, x: str) -> str:
        scales = self.constant([1, 1, 2, 2])
        return str(self.node("Resize", [x, "", scales], mode="linear", coordinate_transformation_mode="half_pixel"))

    def repeat(self, x: str) -> str:
        scales = self.constant([1, 1, 2, 2])
        return str(
            self.node(
                "Resize", [x, "", scales], mode="nearest", coordinate_transformation_mode="asymmetric",
                nearest_mode="floor",
            )
        )  # fmt: skip

    def slice(self, x: str, axis: int, start: int, stop: int) -> str:
        where = [self.constant([value], np.int64) for value in (start, stop, axis)]
        return str(self.node("Slice", [x, *where]))


def _model(ops: _GraphOps, name: str, inputs: dict[str, list[Any]], output: str, shape: list[Any]) -> bytes:
    return model_bytes([*ops.nodes, Node("Identity", [output], [name], {})], ops.constants, inputs, {name: shape})


def head_graph(network: Network, weights: Weights, rows: int | None = None, columns: int | None = None) -> bytes:
    """Return the graph from encoded inputs, (1, C, h, w), to the ``head``, (1, h, w, C), as the content of a file.

    Parameters
    ----------
    network : Network
    weights : mapping
    rows, columns : int or None
        Of the inputs; None leaves them open.
    """
    ops = _GraphOps(network, weights)
    size = ["h" if rows is None else rows, "w" if columns is None else columns]
    inputs = {name: [1, channels, *size] for name, channels in network.inputs.items()}
    head = network.forward(ops, {name: name for name in inputs})["map"]
    return _model(ops, "head", inputs, ops.node("Transpose", [head], perm=[0, 2, 3, 1]), [1, *size, None])


def map_graph(network: Network, weights: Weights, output_mode: str) -> bytes:
    """Return the whole refiner as a graph, the content of a file, with what `encode` and the output rule do.

    Inputs ``coarse``, (1, 1, h, w), half-size pixels, filled; ``left``, (1, 1, 2h, 2w), grey levels 0 to 255; for
    networks that use them ``confidence``, (1, 1, h, w), 0 to 1, and ``candidates``, (1, 2, h, w), half-size pixels.
    Output ``disparity``, (1, 1, 2h, 2w), full-size pixels.

    Raises
    ------
    OptionError
        If the network sees more than that.
    """
    rule = output_rule(network, output_mode)
    ops = _GraphOps(network, weights)
    unit = rule.unit_inputs
    inputs: dict[str, list[Any]] = {"coarse": [1, 1, "h", "w"], "left": [1, 1, "2h", "2w"]}
    coarse = ops.multiply("coarse", 2)
    gray = ops.multiply("left", 1 / 255) if unit else ops.shift(ops.multiply("left", 4 / 255), -1.6)
    encoded = {"disparity": ops.multiply(coarse, 1 / 256) if unit else ops.shift(ops.multiply(coarse, 1 / 16), -1.5)}
    if "image" in network.inputs:
        encoded["image"] = ops.node("AveragePool", [gray], kernel_shape=[2, 2], strides=[2, 2])
    if "phases" in network.inputs:
        encoded["phases"] = ops.node("SpaceToDepth", [gray], blocksize=2)
    if "confidence" in network.inputs:
        inputs["confidence"] = [1, 1, "h", "w"]
        encoded["confidence"] = ops.shift(ops.multiply("confidence", 4), -2)
    candidates = ""
    if "candidates" in network.inputs:
        inputs["candidates"] = [1, 2, "h", "w"]
        candidates = ops.multiply("candidates", 2)
        encoded["candidates"] = ops.shift(ops.multiply(candidates, 1 / 16), -1.5)
    head = network.forward(ops, encoded)["map"]
    full = rule.graph_map(ops, head, coarse, candidates)
    return _model(ops, "disparity", inputs, full, [1, 1, "2h", "2w"])


def session(network: Network, weights: Weights, threads: int) -> Run:
    """Return the network as ONNX Runtime computes it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    graph = head_graph(network, weights)
    model = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def run(inputs: dict[str, NDArray[Any]], use: Callable[[NDArray[np.float32]], Any] = np.array) -> Any:
        feeds = {name: planar(inputs[name], threads) for name in network.inputs}
        return use(np.ascontiguousarray(model.run(["head"], feeds)[0][0]))

    return run
