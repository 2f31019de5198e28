"""Networks as ONNX graphs: what ONNX Runtime runs, and what `stereokit export` writes.

Built from the network's own description, with transposed convolutions in their sub-pixel form. Rows and columns are
left open, so that one file serves every size (multiples of ``2 * network.multiple`` in full-size pixels).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from stereokit.errors import OptionError
from stereokit_refiners.networks.layers import Network, Weights, sub_pixel_kernel
from stereokit_refiners.networks.pyramid import CANDIDATES, OFFSETS

__all__ = ["head_graph", "map_graph", "session"]

_OPSET = 18


class _OnnxOps:
    """Ops that append nodes; a tensor is its name."""

    def __init__(self, network: Network, weights: Weights) -> None:
        self.table = {layer.name: layer for layer in network.layers}
        self.weights = weights
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def node(self, kind: str, inputs: Sequence[str], count: int = 1, **attributes: Any) -> Any:
        names = [f"t{len(self.nodes)}_{k}" for k in range(count)]
        self.nodes.append(helper.make_node(kind, list(inputs), names, **attributes))
        return names[0] if count == 1 else names

    def constant(self, values: Any, dtype: Any = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(np.asarray(values, dtype)), name))
        return name

    def conv(self, name: str, inputs: Sequence[str], *, activate: bool = True) -> str:
        layer = self.table[name]
        y = self._convolve(name, inputs)
        if layer.up:
            y = self.shuffle(y)
        return self.activate(name, y) if activate else y

    def conv_split(self, name: str, inputs: Sequence[str]) -> str:
        return self._convolve(name, inputs)

    def _convolve(self, name: str, inputs: Sequence[str]) -> str:
        layer = self.table[name]
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        if layer.up:
            weight, bias = sub_pixel_kernel(weight), np.repeat(bias, 4)
        x = inputs[0] if len(inputs) == 1 else self.node("Concat", inputs, axis=1)
        side = weight.shape[-1] // 2
        given = [x, self.constant(weight), self.constant(bias)]
        return str(self.node("Conv", given, pads=[side] * 4, strides=[layer.stride] * 2))

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

    def twice(self, x: str) -> str:
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


def _model(ops: _OnnxOps, name: str, inputs: dict[str, list[Any]], output: str, shape: list[Any]) -> onnx.ModelProto:
    given = [helper.make_tensor_value_info(n, TensorProto.FLOAT, dims) for n, dims in inputs.items()]
    ops.nodes.append(helper.make_node("Identity", [output], [name]))
    result = helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
    graph = helper.make_graph(ops.nodes, "stereokit", given, [result], ops.constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], producer_name="stereokit")
    model.ir_version = 9
    onnx.checker.check_model(model)
    return model


def head_graph(network: Network, weights: Weights) -> onnx.ModelProto:
    """Return the graph from encoded inputs, (1, C, h, w), to the ``head``, (1, h, w, C)."""
    ops = _OnnxOps(network, weights)
    inputs = {name: [1, channels, "h", "w"] for name, channels in network.inputs.items()}
    head = network.forward(ops, {name: name for name in inputs})["map"]
    return _model(ops, "head", inputs, ops.node("Transpose", [head], perm=[0, 2, 3, 1]), [1, "h", "w", None])


def map_graph(network: Network, weights: Weights, form: str) -> onnx.ModelProto:
    """Return the whole refiner as a graph, with what `encode` and `compose` do.

    Inputs ``coarse``, (1, 1, h, w), half-size pixels, filled; ``left``, (1, 1, 2h, 2w), grey levels 0 to 255; for
    networks that use them ``confidence``, (1, 1, h, w), 0 to 1, and ``candidates``, (1, 2, h, w), half-size pixels.
    Output ``disparity``, (1, 1, 2h, 2w), full-size pixels.

    Raises
    ------
    OptionError
        If the network sees more than that.
    """
    if "disparity" not in network.inputs:
        raise OptionError(f"network must be one that sees a half-size map alone to be exported, got {network.name!r}")
    ops = _OnnxOps(network, weights)
    literal = form == "literal"
    inputs: dict[str, list[Any]] = {"coarse": [1, 1, "h", "w"], "left": [1, 1, "2h", "2w"]}
    coarse = ops.multiply("coarse", 2)
    gray = ops.multiply("left", 1 / 255) if literal else ops.shift(ops.multiply("left", 4 / 255), -1.6)
    encoded = {"disparity": ops.multiply(coarse, 1 / 256) if literal else ops.shift(ops.multiply(coarse, 1 / 16), -1.5)}
    if "image" in network.inputs:
        encoded["image"] = ops.node("AveragePool", [gray], kernel_shape=[2, 2], strides=[2, 2])
    if "phases" in network.inputs:
        encoded["phases"] = ops.node("SpaceToDepth", [gray], blocksize=2)
    if "confidence" in network.inputs:
        inputs["confidence"] = [1, 1, "h", "w"]
        encoded["confidence"] = ops.shift(ops.multiply("confidence", 4), -2)
    two = ""
    if "candidates" in network.inputs:
        inputs["candidates"] = [1, 2, "h", "w"]
        two = ops.multiply("candidates", 2)
        encoded["candidates"] = ops.shift(ops.multiply(two, 1 / 16), -1.5)
    head = network.forward(ops, encoded)["map"]
    if literal:
        full = ops.multiply(ops.shuffle(head), 256)
    elif network.name == "stereokit":
        full = _mixture(ops, head, coarse, two)
    else:
        full = ops.add(ops.twice(coarse), ops.multiply(ops.shuffle(head), 4))
    return _model(ops, "disparity", inputs, full, [1, 1, "2h", "2w"])


def _mixture(ops: _OnnxOps, head: str, coarse: str, candidates: str) -> str:
    reach = max(max(abs(dy), abs(dx)) for dy, dx in OFFSETS)
    corrected = ops.add(coarse, ops.multiply(ops.slice(head, 1, 0, 1), 4))
    pads = ops.constant([0, 0, reach, reach, 0, 0, reach, reach], np.int64)
    padded = ops.node("Pad", [corrected, pads], mode="edge")
    around = []
    for dy, dx in OFFSETS:
        # A slice that ends `reach - d` before the border of the padded map; its end counts from the far side.
        rows = ops.slice(padded, 2, reach + dy, dy - reach if dy < reach else 2**31)
        around.append(ops.slice(rows, 3, reach + dx, dx - reach if dx < reach else 2**31))
    values = ops.node("Concat", [*around, candidates], axis=1)
    values = ops.node("Unsqueeze", [values, ops.constant([2], np.int64)])
    logits = ops.slice(head, 1, 5, 5 + 4 * CANDIDATES)
    size = ops.node("Shape", [head])
    tail = ops.node("Slice", [size, *(ops.constant([v], np.int64) for v in (2, 4, 0))])
    shape = ops.node("Concat", [ops.constant([1, CANDIDATES, 4], np.int64), tail], axis=0)
    share = ops.node("Softmax", [ops.node("Reshape", [logits, shape])], axis=1)
    mixed = ops.node("ReduceSum", [ops.node("Mul", [share, values]), ops.constant([1], np.int64)], keepdims=0)
    return ops.shuffle(ops.add(mixed, ops.multiply(ops.slice(head, 1, 1, 5), 4)))


def session(
    network: Network, weights: Weights, threads: int
) -> Callable[[dict[str, NDArray[Any]]], NDArray[np.float32]]:
    """Return a function from (C, h, w) inputs to the (h, w, C) head that ONNX Runtime computes."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    graph = head_graph(network, weights).SerializeToString()
    held = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def run(inputs: dict[str, NDArray[Any]]) -> NDArray[np.float32]:
        given = {name: np.ascontiguousarray(inputs[name][None], np.float32) for name in network.inputs}
        return np.ascontiguousarray(held.run(["head"], given)[0][0])

    return run
