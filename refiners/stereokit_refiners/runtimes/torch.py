"""Networks in torch: what is trained, and what runs on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from stereokit_refiners.networks.layers import Layer, Network, sub_pixel_taps
from stereokit_refiners.runtimes.contract import Run

__all__ = ["Module", "calibrate", "runner"]


class Module(nn.Module):
    """A network's weights, and its `forward` in torch.

    Parameters
    ----------
    network : Network
    generator : torch.Generator, optional
        Draws the initial weights.
    """

    def __init__(self, network: Network, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.network = network
        self.table = {layer.name: layer for layer in network.layers}
        self.weights = nn.ParameterDict()
        for layer in network.layers:
            fan = layer.inputs * layer.kernel**2 / (4 if layer.up else 1)
            scale = (2 / (1.01 * fan)) ** 0.5  # He et al. 2015, for a leaky ReLU of 0.1
            values = torch.randn(layer.weight_shape, generator=generator) * scale
            self.weights[_key(layer.name, "weight")] = nn.Parameter(values)
            self.weights[_key(layer.name, "bias")] = nn.Parameter(torch.zeros(layer.outputs))
        self._soften()

    def _soften(self) -> None:
        """Start near the identity: a small last layer, weak residual blocks, and the nearest coarse value."""
        with torch.no_grad():
            last = self.network.layers[-1].name
            self.weights[_key(last, "weight")].mul_(0.1)
            for name in self.table:
                if name.startswith("block_") and name.endswith("b"):
                    self.weights[_key(name, "weight")].mul_(0.3)
            for rule in self.network.outputs.values():
                if rule is not None and rule.initial_bias is not None:
                    self.weights[_key(last, "bias")].copy_(torch.from_numpy(rule.initial_bias))

    def forward(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the network's heads for (B, C, h, w) inputs by name."""
        return self.network.forward(_TorchOps(self), inputs)

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of the weights under the names of weight files."""
        return {_name(key): value.detach().float().cpu().numpy().copy() for key, value in self.weights.items()}

    def load(self, arrays: Mapping[str, NDArray[np.float32]]) -> None:
        """Take over the weights of a file."""
        with torch.no_grad():
            for key, value in self.weights.items():
                value.copy_(torch.from_numpy(np.array(arrays[_name(key)])))


def _key(layer: str, part: str) -> str:
    return f"{layer}-{part}"  # a ParameterDict's keys must not hold a dot


def _name(key: str) -> str:
    layer, _, part = key.rpartition("-")
    return f"{layer}.{part}"


class _TorchOps:
    def __init__(self, module: Module) -> None:
        self.module = module

    def _layer(self, name: str) -> tuple[Layer, Tensor, Tensor]:
        weights = self.module.weights
        return self.module.table[name], weights[_key(name, "weight")], weights[_key(name, "bias")]

    def conv(self, name: str, inputs: Sequence[Tensor], *, activate: bool = True) -> Tensor:
        layer, weight, bias = self._layer(name)
        if layer.up:
            y = F.pixel_shuffle(self.conv_transpose_phases(name, inputs), 2)
        else:
            y = F.conv2d(_joined(inputs), weight, bias, layer.stride, layer.kernel // 2)
        return self.activate(name, y) if activate else y

    def conv_transpose_phases(self, name: str, inputs: Sequence[Tensor]) -> Tensor:
        _, weight, bias = self._layer(name)
        return F.conv2d(_joined(inputs), _sub_pixel(weight), bias.repeat_interleave(4), padding=1)

    def sample(self, mean: Tensor, log_sigma: Tensor) -> Tensor:
        if not self.module.training:
            return mean
        return mean + torch.randn_like(mean) * torch.exp(log_sigma)

    def add(self, a: Tensor, b: Tensor) -> Tensor:
        return a + b

    def shift(self, x: Tensor, by: float) -> Tensor:
        return x + by

    def activate(self, name: str, x: Tensor) -> Tensor:
        return F.leaky_relu(x, 0.1)

    def upsample2x(self, x: Tensor) -> Tensor:
        return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)

    def repeat(self, x: Tensor) -> Tensor:
        return F.interpolate(x, scale_factor=2, mode="nearest")


def _joined(inputs: Sequence[Tensor]) -> Tensor:
    return inputs[0] if len(inputs) == 1 else torch.cat(list(inputs), 1)


def _sub_pixel(weight: Tensor) -> Tensor:
    """Return `stereokit_refiners.networks.layers.sub_pixel_kernel` of `weight`, differentiable."""
    inputs, outputs = weight.shape[:2]
    kernel = weight.new_zeros(outputs, 2, 2, inputs, 3, 3)
    swapped = weight.transpose(0, 1)
    taps = sub_pixel_taps()
    for i, ky, ty in taps:
        for j, kx, tx in taps:
            kernel[:, i, j, :, ty, tx] = swapped[:, :, ky, kx]
    return kernel.reshape(4 * outputs, inputs, 3, 3)


def runner(network: Network, arrays: Mapping[str, NDArray[np.float32]]) -> Run:
    """Return the network, on the GPU if torch has one."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    module = Module(network)
    module.load(arrays)
    module.to(device, memory_format=torch.channels_last).eval().requires_grad_(False)  # type: ignore[call-overload]

    def run(inputs: dict[str, NDArray[Any]], use: Callable[[NDArray[np.float32]], Any] = np.array) -> Any:
        with torch.inference_mode():
            tensors = {name: torch.from_numpy(inputs[name])[None].to(device).float() for name in network.inputs}
            head = module(tensors)["map"][0].permute(1, 2, 0)
            return use(np.ascontiguousarray(head.cpu().numpy()))

    return run


def calibrate(module: Module, batches: Iterable[Mapping[str, Tensor]], share: float = 0.999) -> dict[str, list[float]]:
    """Return the range of each channel of each activation.

    It is the largest, over `batches`, of the absolute value that a share of the channel stays below; channels of an
    activation that is added to another have one range, the largest of theirs.
    """
    ranges: dict[str, Tensor] = {}
    added: set[str] = set()

    class Watching(_TorchOps):
        def __init__(self, module: Module) -> None:
            super().__init__(module)
            self.names: dict[int, tuple[str, Tensor]] = {}  # with the tensor, so that its id stays its own

        def activate(self, name: str, x: Tensor) -> Tensor:
            y = super().activate(name, x)
            size = y.abs().transpose(0, 1).flatten(1).float()
            largest = max(1, round(size.shape[1] * (1 - share)))
            bound = size.topk(largest, dim=1).values[:, -1]
            ranges[name] = torch.maximum(ranges[name], bound) if name in ranges else bound
            self.names[id(y)] = name, y
            return y

        def add(self, a: Tensor, b: Tensor) -> Tensor:
            added.update(self.names[id(x)][0] for x in (a, b) if id(x) in self.names)
            return super().add(a, b)

    module.eval()
    with torch.inference_mode():
        for inputs in batches:
            module.network.forward(Watching(module), inputs)
    for name in added:
        ranges[name] = torch.full_like(ranges[name], float(ranges[name].max()))
    return {name: [float(f"{value:.4g}") for value in bound.tolist()] for name, bound in ranges.items()}
