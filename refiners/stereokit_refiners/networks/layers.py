"""How a network is written down: once, as a table of layers and a function over abstract operations.

A `Network` lists its layers (name, channels, kernel, stride: what the paper's table I gives) and says in
`Network.forward` how they are connected, in terms of `Ops`. Torch trains that description; it, OpenVINO, ONNX Runtime
and OpenCV run it (`stereokit_refiners.runtimes`), and the tests hold all of them to plain loops. No layer is described
twice, and weights are one flat mapping ``"LAYER.weight"``, ``"LAYER.bias"`` for all. `Network.outputs` are the rules by
which a map is made of the head.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError
from stereokit_refiners.outputs.contract import Output

__all__ = [
    "Layer",
    "Network",
    "Ops",
    "Weights",
    "activations",
    "added_to",
    "block",
    "check_output_mode",
    "cost",
    "output_rule",
    "shapes",
    "sub_pixel_kernel",
    "sub_pixel_taps",
]

T = TypeVar("T")
Weights = Mapping[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Layer:
    """One convolution.

    Parameters
    ----------
    name : str
        As in the table.
    inputs, outputs : int
        Channels.
    kernel : int
        Side of the window, odd; the border is zero-padded by half of it.
    stride : int
        1, or 2 to halve the size.
    up : bool
        A transposed convolution that doubles the size instead (stride 2, output padding 1 for kernels over 1).
    """

    name: str
    inputs: int
    outputs: int
    kernel: int = 5
    stride: int = 1
    up: bool = False

    @property
    def weight_shape(self) -> tuple[int, int, int, int]:
        """Shape of the weights: ``(outputs, inputs, k, k)``, and ``(inputs, outputs, k, k)`` for one that goes up."""
        first, second = (self.inputs, self.outputs) if self.up else (self.outputs, self.inputs)
        return first, second, self.kernel, self.kernel


class Ops(Protocol[T]):
    """The operations that a network is made of; tensors are (batch, channels, rows, columns)."""

    def conv(self, name: str, inputs: Sequence[T], *, activate: bool = True) -> T:
        """Apply the layer called `name` to `inputs`, joined along the channels; leaky ReLU 0.1 unless told not to.

        A layer that goes up returns its output at double size.
        """

    def conv_transpose_phases(self, name: str, inputs: Sequence[T]) -> T:
        """Apply a layer that goes up, without activation, and leave its output in four phases.

        Returns (batch, 4 * outputs, rows, columns): channel ``4*o + 2*i + j`` holds output ``o`` at row ``2y + i``,
        column ``2x + j``.
        """

    def sample(self, mean: T, log_sigma: T) -> T:
        """Draw from the normal distribution while training; return `mean` otherwise."""

    def add(self, a: T, b: T) -> T:
        """Return a + b."""

    def shift(self, x: T, by: float) -> T:
        """Return x + by."""

    def activate(self, name: str, x: T) -> T:
        """Return the leaky ReLU 0.1 of x; the result is called `name`."""

    def upsample2x(self, x: T) -> T:
        """Return x at double size, bilinearly, pixel centres kept."""

    def repeat(self, x: T) -> T:
        """Return x at double size, each pixel four times."""


class Network(Protocol):
    """A network as data and as a function."""

    @property
    def name(self) -> str:
        """Name of the architecture, as weight files give it."""

    @property
    def layers(self) -> tuple[Layer, ...]:
        """All layers, in the order in which they are applied."""

    @property
    def inputs(self) -> dict[str, int]:
        """Channels by input's name."""

    @property
    def stride(self) -> int:
        """Rows and columns of the input must be multiples of this."""

    @property
    def innermost(self) -> bool:
        """Whether inputs come with their channels innermost in memory."""

    @property
    def outputs(self) -> Mapping[str, Output | None]:
        """Rules for the head by output mode, the name that weight files give; None where its refiner makes the map."""

    def forward(self, ops: Ops[Any], inputs: Mapping[str, Any]) -> dict[str, Any]:
        """Return the heads, by name; an output rule makes the map of ``"map"``."""


def check_output_mode(network: Network, mode: str) -> str:
    """Return `mode`; raise OptionError if it is none of the network's."""
    if mode not in network.outputs:
        known = ", ".join(network.outputs)
        raise OptionError(f"output_mode of {network.name!r} must be one of {known}, got {mode!r}")
    return mode


def output_rule(network: Network, mode: str) -> Output:
    """Return the rule that makes a full-size map of the network's head and the coarse map.

    Raises
    ------
    OptionError
        If the network has no such mode, or needs more than the coarse map.
    """
    rule = network.outputs[check_output_mode(network, mode)]
    if rule is None:
        raise OptionError(f"network must be one that sees a half-size map alone here, got {network.name!r}")
    return rule


def block(ops: Ops[T], name: str, x: T) -> T:
    """Return `x` with what two convolutions make of it added: a residual block (He et al. 2016)."""
    inner = ops.conv(f"{name}b", [ops.conv(f"{name}a", [x])], activate=False)
    return ops.activate(name, ops.add(x, inner))


def added_to(ops: Ops[T], name: str, skip: T, low: T, upsample: Callable[[T], T]) -> T:
    """Return `skip` with `low`, of half its size, added: brought to as many channels, then upsampled."""
    return ops.activate(f"{name}_sum", ops.add(skip, upsample(ops.conv(name, [low], activate=False))))


def shapes(network: Network) -> dict[str, tuple[int, ...]]:
    """Return the shape of each weight array of `network`, by name."""
    table: dict[str, tuple[int, ...]] = {}
    for layer in network.layers:
        table[f"{layer.name}.weight"] = layer.weight_shape
        table[f"{layer.name}.bias"] = (layer.outputs,)
    return table


class _Sizes:
    """Ops that only follow sizes, and count multiplications: tensors are (channels, rows, columns)."""

    def __init__(self, network: Network) -> None:
        self.layers = {layer.name: layer for layer in network.layers}
        self.macs = 0
        self.outputs: dict[str, tuple[int, int, int]] = {}
        self.activations: dict[str, int] = {}

    def conv(self, name: str, inputs: Sequence[tuple[int, int, int]], *, activate: bool = True) -> Any:
        layer = self.layers[name]
        channels, (_, rows, columns) = sum(shape[0] for shape in inputs), inputs[0]
        if channels != layer.inputs or any(shape[1:] != (rows, columns) for shape in inputs):
            raise AssertionError(f"{name} takes {layer.inputs} channels of one size, got {list(inputs)}")
        if layer.up and layer.kernel > 1:
            self.macs += rows * columns * channels * layer.outputs * layer.kernel**2
            out = layer.outputs, 2 * rows, 2 * columns
        else:
            out = layer.outputs, -(-rows // layer.stride), -(-columns // layer.stride)
            self.macs += out[0] * out[1] * out[2] * channels * layer.kernel**2
        self.outputs[name] = out
        if activate:
            self.activations[name] = layer.outputs
        return out

    def conv_transpose_phases(self, name: str, inputs: Sequence[tuple[int, int, int]]) -> Any:
        outputs, rows, columns = self.conv(name, inputs, activate=False)
        return 4 * outputs, rows // 2, columns // 2

    def sample(self, mean: Any, log_sigma: Any) -> Any:
        return mean

    def add(self, a: Any, b: Any) -> Any:
        if a != b:
            raise AssertionError(f"sizes differ: {a} and {b}")
        return a

    def shift(self, x: Any, by: float) -> Any:
        return x

    def activate(self, name: str, x: Any) -> Any:
        self.activations[name] = x[0]
        return x

    def upsample2x(self, x: Any) -> Any:
        return x[0], 2 * x[1], 2 * x[2]

    repeat = upsample2x


def activations(network: Network) -> dict[str, int]:
    """Return the channels of each activation of `network`, by name: those of layers, and of sums that are activated."""
    sizes = _Sizes(network)
    network.forward(sizes, {name: (channels, 8, 8) for name, channels in network.inputs.items()})
    return sizes.activations


def cost(network: Network, rows: int, columns: int) -> tuple[int, int, dict[str, tuple[int, int, int]]]:
    """Return the multiplications, the parameters, and the output shape of each layer for inputs of a size.

    Parameters
    ----------
    rows, columns : int
        Size of the inputs (half of the map's), multiples of ``network.stride``.

    Returns
    -------
    macs : int
        Multiply-accumulate operations of one map.
    parameters : int
    outputs : dict
        ``(channels, rows, columns)`` by layer.
    """
    sizes = _Sizes(network)
    network.forward(sizes, {name: (channels, rows, columns) for name, channels in network.inputs.items()})
    parameters = sum(int(np.prod(shape)) for shape in shapes(network).values())
    return sizes.macs, parameters, sizes.outputs


def sub_pixel_taps() -> list[tuple[int, int, int]]:
    """Return which tap of a 5x5 transposed convolution is which of a 3x3 convolution's, by phase, along one axis.

    Output ``2y + i`` of a stride-2 transposed convolution (padding 2, output padding 1) is the sum over kernel
    index ``k`` with ``k`` and ``i`` of one parity of ``w[k] * x[y + (i + 2 - k) / 2]``.

    Returns
    -------
    list of (phase, k, tap)
        Tap 0, 1, 2 reads ``x[y - 1]``, ``x[y]``, ``x[y + 1]``.
    """
    return [(i, k, (i + 2 - k) // 2 + 1) for i in (0, 1) for k in range(5) if (i - k) % 2 == 0]


def sub_pixel_kernel(weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the kernel of the 3x3 convolution to four phases that equals a 5x5 transposed convolution of stride 2.

    Parameters
    ----------
    weight : (inputs, outputs, 5, 5) float32

    Returns
    -------
    (4 * outputs, inputs, 3, 3) float32
        Output channel ``4*o + 2*i + j`` is phase ``(i, j)`` of output ``o`` (Shi et al. 2016, sub-pixel convolution).
    """
    inputs, outputs = weight.shape[:2]
    kernel = np.zeros((outputs, 2, 2, inputs, 3, 3), np.float32)
    taps = sub_pixel_taps()
    for i, ky, ty in taps:
        for j, kx, tx in taps:
            kernel[:, i, j, :, ty, tx] = weight[:, :, ky, kx].T
    return kernel.reshape(4 * outputs, inputs, 3, 3)
