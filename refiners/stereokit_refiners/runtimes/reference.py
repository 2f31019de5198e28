"""Networks in plain numpy: slow and simple, what the fast runtimes are checked against on the machine at hand.

A runtime picks its code by the processor, and some of that code is wrong: OpenVINO's Winograd convolutions with SVE
gave maps that were off by up to 29 pixels, without an error, under emulation. So before a runtime is trusted with a
network, it refines a small scene, and the map is compared with that of this module.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit_refiners.networks.layers import Network, Weights, output_rule, sub_pixel_kernel
from stereokit_refiners.runtimes.contract import Run
from stereokit_refiners.runtimes.encode import encode
from stereokit_refiners.runtimes.evidence import hypotheses
from stereokit_refiners.runtimes.features import network_input
from stereokit_refiners.runtimes.mixture import mixture
from stereokit_refiners.weights import WeightFile, network_named

__all__ = ["SCENE_SIZE", "TOLERANCES_PX", "forward", "input_size", "mistake"]

Array = NDArray[np.float32]

SCENE_SIZE = (32, 48)
"""Rows and columns of the scene's half-size map: a multiple of what any network wants."""

TOLERANCES_PX = {"fp32": 0.01, "bf16": 0.5, "int8": 1.0}
"""How far a map may be off on average, full-size pixels, by the precision.

With the shipped weights right runtimes are off by 3e-6, 0.02 and 0.3; one with a wrong convolution was off by 2.
"""


class _PlainOps:
    """Ops on (channels, rows, columns) float32."""

    def __init__(self, network: Network, weights: Weights) -> None:
        self.table = {layer.name: layer for layer in network.layers}
        self.weights = weights

    def conv(self, name: str, inputs: Sequence[Array], *, activate: bool = True) -> Array:
        y = self.conv_transpose_phases(name, inputs)
        if self.table[name].up:
            y = _shuffled(y)
        return self.activate(name, y) if activate else y

    def conv_transpose_phases(self, name: str, inputs: Sequence[Array]) -> Array:
        layer = self.table[name]
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        if layer.up:
            weight, bias = sub_pixel_kernel(weight), np.repeat(bias, 4)
        size, stride = weight.shape[-1], layer.stride
        side = size // 2
        x = np.concatenate(inputs)
        rows, columns = (-(-length // stride) for length in x.shape[1:])
        x = np.pad(x, ((0, 0), (side, side), (side, side)))
        y = np.repeat(bias.astype(np.float32)[:, None], rows * columns, axis=1)
        for i in range(size):
            for j in range(size):
                seen = x[:, i : i + stride * (rows - 1) + 1 : stride, j : j + stride * (columns - 1) + 1 : stride]
                y += weight[:, :, i, j] @ seen.reshape(len(x), -1)
        return np.asarray(y.reshape(-1, rows, columns), np.float32)

    def sample(self, mean: Array, log_sigma: Array) -> Array:
        return mean

    def add(self, a: Array, b: Array) -> Array:
        return a + b

    def shift(self, x: Array, by: float) -> Array:
        return np.asarray(x + np.float32(by), np.float32)

    def activate(self, name: str, x: Array) -> Array:
        return np.asarray(np.where(x < 0, x * np.float32(0.1), x), np.float32)

    def upsample2x(self, x: Array) -> Array:
        for axis in (1, 2):
            last = x.shape[axis] - 1
            here = np.arange(last + 1)
            halves = [
                np.float32(0.75) * x + np.float32(0.25) * np.take(x, beside, axis)
                for beside in (np.maximum(here - 1, 0), np.minimum(here + 1, last))
            ]
            shape = list(x.shape)
            shape[axis] *= 2
            x = np.stack(halves, axis + 1).reshape(shape)
        return x

    def repeat(self, x: Array) -> Array:
        return np.repeat(np.repeat(x, 2, axis=1), 2, axis=2)


def _shuffled(x: Array) -> Array:
    """Return four phases, (4 C, h, w), as one map at twice the size."""
    channels, rows, columns = x.shape[0] // 4, *x.shape[1:]
    phases = x.reshape(channels, 2, 2, rows, columns).transpose(0, 3, 1, 4, 2)
    return np.asarray(phases.reshape(channels, 2 * rows, 2 * columns), np.float32)


def forward(network: Network, weights: Weights, inputs: dict[str, NDArray[Any]]) -> Array:
    """Return the (h, w, C) head for (C, h, w) inputs."""
    floats = {name: np.asarray(each, np.float32) for name, each in inputs.items()}
    head = network.forward(_PlainOps(network, weights), floats)["map"]
    return np.ascontiguousarray(head.transpose(1, 2, 0))


def _scene() -> dict[str, Any]:
    """Return a board before a slanted wall, as the matcher sees them, and a noisy image of blocks."""
    rows, columns = SCENE_SIZE
    rng = np.random.default_rng(0)
    y, x = np.indices(SCENE_SIZE, np.float32)
    wall = np.float32(12) + x / 4 + y / 8
    board = (abs(y - 16) < 8) & (abs(x - 20) < 9)
    disparity = np.where(board, np.float32(44), wall).astype(np.float32)
    blocks = np.kron(rng.integers(40, 200, (rows // 4, columns // 4)), np.ones((8, 8), np.int64))
    left = (blocks + rng.integers(0, 16, blocks.shape)).astype(np.uint8)
    confidence = rng.random(SCENE_SIZE).astype(np.float32)
    other = disparity + rng.integers(-6, 7, SCENE_SIZE).astype(np.float32)
    return {"disparity": disparity, "left": left, "confidence": confidence, "candidates": np.stack([disparity, other])}


def input_size(content: WeightFile) -> tuple[int, int]:
    """Return the rows and columns of a network's inputs for the scene."""
    rows, columns = SCENE_SIZE
    return (rows // 2, columns // 2) if _weighs(content) else SCENE_SIZE


def _weighs(content: WeightFile) -> bool:
    """Return whether a network's input is evidence from both images, at a quarter of their size."""
    return "evidence" in network_named(content.network).inputs


def _prepared(content: WeightFile) -> tuple[dict[str, NDArray[Any]], Callable[[Array], Array]]:
    """Return a network's inputs for the scene, and what makes a map of its head."""
    network, scene = network_named(content.network), _scene()
    rows, columns = (2 * length for length in SCENE_SIZE)
    inputs: dict[str, NDArray[Any]]
    if not _weighs(content):
        rule = output_rule(network, content.output_mode)
        inputs = encode(tuple(network.inputs), rule.unit_inputs, **scene)
        return inputs, lambda head: rule.map(head, scene["disparity"], rows, columns, candidates=scene["candidates"])
    left = scene["left"]
    right = np.roll(left, -24, axis=1)
    values = hypotheses(scene["disparity"], scene["candidates"], left, right, 2)
    inputs = {"evidence": network_input(values, scene["confidence"], left, columns)}
    return inputs, lambda head: mixture(head, values, rows, columns)[0]


def mistake(content: WeightFile, run: Run) -> float:
    """Return how far a runtime's map of a small scene is off on average, full-size pixels; infinite if not a number.

    Parameters
    ----------
    content : WeightFile
    run : Run
        The network, compiled for inputs of `input_size`.
    """
    inputs, finish = _prepared(content)
    right = forward(network_named(content.network), content.arrays, inputs)
    off = float(np.abs(run(inputs, finish) - finish(right)).mean())
    return off if np.isfinite(off) else float("inf")
