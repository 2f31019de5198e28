"""Networks in OpenVINO: the fast way on a CPU, in fp32, bf16 or int8, without torch.

The graph is built from the network's own description; transposed convolutions stand in their sub-pixel form, which
is several times faster and equal up to rounding. For int8, each activation that calibration found ranges for passes
through one FakeQuantize node where it is made, and the weights of the convolutions that read it through another;
OpenVINO turns these into integer kernels. Inputs of the network stay in floating point, since 8 bits would be too
coarse for a disparity, unless they come in bytes: with their channels innermost.

Channels differ in range by a factor of ten and more, and one scale for all would leave the small ones a few steps of
the 256. A leaky ReLU commutes with positive factors, so each channel is brought to the range 1 where it is made, by
dividing its weights, and back where it is read, by multiplying those of the reader (Nagel et al. 2019, cross-layer
equalisation): exact in floating point, and all activations share one scale. Only activations that are added to
others keep one range for all their channels, so that the sum needs no further step.

Weights have 64 steps to either side, not 127. Processors without VNNI add two products of 8 bits in 16 bits and
saturate there (``vpmaddubsw``): 2 * 255 * 127 does not fit, 2 * 255 * 64 does. So all sums are exact everywhere, and
the maps are as good: on generated streets the mean error is within a hundredth of a pixel of that of 127 steps.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import openvino as ov
from numpy.typing import NDArray
from openvino import opset13 as op

from stereokit.kernels.threads import available_threads
from stereokit.kernels.workspace import Pool
from stereokit_refiners.networks.layers import Layer, Network, Weights, sub_pixel_kernel
from stereokit_refiners.runtimes.contract import Run

__all__ = ["build", "compiled"]


Ranges = Mapping[str, Sequence[float]]

WEIGHT_STEPS = 64
"""Steps of a weight of 8 bits between 0 and the largest of its output: two products still fit into 16 bits."""


class _OpenVinoOps:
    """Ops that make nodes."""

    def __init__(self, network: Network, weights: Weights, ranges: Ranges) -> None:
        self.table = {layer.name: layer for layer in network.layers}
        self.weights = weights
        self.ranges = ranges
        self.scales: dict[int, tuple[Any, NDArray[np.float32]]] = {}  # of the channels of nodes that hold 8 bits
        self.lifted: set[int] = set()  # those of them that stand for 128 less

    def conv(self, name: str, inputs: Sequence[Any], *, activate: bool = True) -> Any:
        layer = self.table[name]
        scale = self._scale(name) if activate else None
        bound = 1.0
        if scale is not None and (scale == scale[0]).all():  # one range for all: nothing to bring to it
            bound, scale = float(scale[0]), np.ones_like(scale)
        y = self._convolve(layer, inputs, scale)
        if layer.up:
            y = op.depth_to_space(y, "depth_first", 2)
        if not activate:
            return y
        y = op.prelu(y, _const([0.1]))
        return y if scale is None else self._rounded(y, bound, scale)

    def conv_transpose_phases(self, name: str, inputs: Sequence[Any]) -> Any:
        return self._convolve(self.table[name], inputs, None)

    def sample(self, mean: Any, log_sigma: Any) -> Any:
        return mean

    def add(self, a: Any, b: Any) -> Any:
        return op.add(self._unscaled(a), self._unscaled(b))

    def shift(self, x: Any, by: float) -> Any:
        return op.add(self._unscaled(x), _const(by))

    def activate(self, name: str, x: Any) -> Any:
        y = op.prelu(self._unscaled(x), _const([0.1]))
        scale = self._scale(name)
        return y if scale is None else self._rounded(y, float(scale.max()), np.ones_like(scale))

    def upsample2x(self, x: Any) -> Any:
        return self._doubled(x, mode="linear_onnx", coordinate_transformation_mode="half_pixel")

    def repeat(self, x: Any) -> Any:
        return self._doubled(x, mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor")

    def bytes(self, x: Any) -> Any:
        """Return a node of unsigned bytes, which stand for numbers 128 below them, as 8 bits."""
        ends = _const(0), _const(255)
        y = op.fake_quantize(op.convert(x, "f32"), *ends, *ends, 256)
        self.scales[id(y)] = y, np.ones(x.get_output_shape(0)[1], np.float32)
        self.lifted.add(id(y))
        return y

    def _doubled(self, x: Any, mode: str, **attributes: str) -> Any:
        rows, columns = x.get_output_shape(0)[2:]
        sizes = op.constant(np.array([2 * rows, 2 * columns], np.int64))
        axes = op.constant(np.array([2, 3], np.int64))
        return op.interpolate(self._unscaled(x), sizes, mode, "sizes", axes=axes, **attributes)

    def _scale(self, name: str) -> NDArray[np.float32] | None:
        return np.maximum(np.asarray(self.ranges[name], np.float32), 1e-3) if name in self.ranges else None

    def _rounded(self, x: Any, bound: float, scale: NDArray[np.float32]) -> Any:
        """Hold `x` to 8 bits over -bound to bound; what it stands for is `scale` times that."""
        low, high = _const(-bound * 128 / 127), _const(bound)
        y = op.fake_quantize(x, low, high, low, high, 256)
        self.scales[id(y)] = y, scale  # with the node, so that its id stays its own
        return y

    def _unscaled(self, x: Any) -> Any:
        """Return what `x` stands for."""
        if id(x) not in self.scales or (self.scales[id(x)][1] == 1).all():
            return x
        return op.multiply(x, _const(self.scales[id(x)][1].reshape(1, -1, 1, 1)))

    def _convolve(self, layer: Layer, inputs: Sequence[Any], scale: NDArray[np.float32] | None) -> Any:
        """Convolve and divide the channels by `scale`.

        Inputs in 8 bits are convolved together, and those in floating point by a convolution of their own.
        """
        weight, bias = self.weights[f"{layer.name}.weight"], self.weights[f"{layer.name}.bias"]
        if layer.up:
            weight, bias = sub_pixel_kernel(weight), np.repeat(bias, 4)
        if scale is not None:
            factor = np.repeat(scale, 4) if layer.up else scale
            weight, bias = weight / factor[:, None, None, None], bias / factor
        ends = np.cumsum([x.get_output_shape(0)[1] for x in inputs])
        parts = [
            part * self.scales[id(x)][1][None, :, None, None] if id(x) in self.scales else part
            for x, part in zip(inputs, np.split(weight, ends[:-1], axis=1), strict=True)
        ]
        side = weight.shape[-1] // 2
        y = None
        for integer in (True, False):
            members = [k for k, x in enumerate(inputs) if (id(x) in self.scales) == integer]
            if not members:
                continue
            x = inputs[members[0]] if len(members) == 1 else op.concat([inputs[k] for k in members], 1)
            taps = np.concatenate([parts[k] for k in members], 1)
            if id(x) in self.lifted:  # before all else: a border would not be lifted
                assert layer.kernel == 1
                taps = _rounded_to_steps(taps)
                bias = bias - 128 * taps.sum((1, 2, 3))
            z = op.convolution(x, _kernel(taps, integer), [layer.stride] * 2, [side] * 2, [side] * 2, [1, 1])
            y = z if y is None else op.add(y, z)
        return op.add(y, _const(bias.reshape(1, -1, 1, 1)))


def _const(values: Any) -> Any:
    return op.constant(np.asarray(values, np.float32))


def _bound(weight: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.maximum(np.abs(weight).max(axis=(1, 2, 3), keepdims=True), 1e-8), np.float32)


def _rounded_to_steps(weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return weights as `_kernel` will hold them."""
    step = _bound(weight) / np.float32(WEIGHT_STEPS)
    return np.asarray(np.rint(weight / step) * step, np.float32)


def _kernel(weight: NDArray[np.float32], integer: bool) -> Any:
    node = _const(np.ascontiguousarray(weight))
    if not integer:
        return node
    bound = _bound(weight) * (127 / WEIGHT_STEPS)  # OpenVINO wants all 255 levels; the outer ones stay without use
    low, high = _const(-bound), _const(bound)
    return op.fake_quantize(node, low, high, low, high, 255)


def build(network: Network, weights: Weights, rows: int, columns: int, ranges: Ranges | None = None) -> ov.Model:
    """Return the graph for inputs of ``rows`` x ``columns``; its output is the head, (1, h, w, C).

    Parameters
    ----------
    ranges : mapping, optional
        Largest absolute value of each channel of each activation, by name, for int8.
    """
    ops = _OpenVinoOps(network, weights, ranges or {})
    parameters, inputs = {}, {}
    for name, channels in network.inputs.items():
        size = [1, rows, columns, channels] if network.innermost else [1, channels, rows, columns]
        whole = network.innermost and bool(ranges)
        parameters[name] = inputs[name] = op.parameter(size, np.uint8 if whole else np.float32, name=name)
        if network.innermost:
            inputs[name] = op.transpose(parameters[name], op.constant(np.array([0, 3, 1, 2], np.int64)))
        if whole:
            inputs[name] = ops.bytes(inputs[name])
    head = network.forward(ops, inputs)["map"]
    head = op.transpose(head, op.constant(np.array([0, 2, 3, 1], np.int64)))  # the layout that it has in memory
    return ov.Model([op.result(head)], list(parameters.values()), network.name)


@lru_cache(maxsize=1)
def _core() -> ov.Core:
    return ov.Core()


def compiled(
    network: Network, weights: Weights, rows: int, columns: int, threads: int, precision: str,
    ranges: Ranges | None,
) -> Run:  # fmt: skip
    """Compile for a size.

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
    lock = threading.Lock()

    def request() -> Any:
        with lock:
            return model.create_infer_request()

    requests: Pool[Any] = Pool(request)

    def run(inputs: dict[str, NDArray[Any]], use: Callable[[NDArray[np.float32]], Any] = np.array) -> Any:
        with requests.take() as free:
            if network.innermost:
                for k, name in enumerate(network.inputs):
                    array, tensor = np.moveaxis(inputs[name], 0, 2), free.get_input_tensor(k).data[0]
                    if tensor.dtype == np.uint8:
                        np.bitwise_xor(array.view(np.uint8), np.uint8(128), out=tensor)  # 128 more
                    else:
                        np.copyto(tensor, array)
                free.infer()
            else:
                free.infer([inputs[name][None] for name in network.inputs], share_inputs=True)
            return use(free.get_output_tensor().data[0])

    return run
