"""What the tests of the refiners share: random weights, coarse maps, and small worlds to train on."""

from __future__ import annotations

import importlib.util

import cv2
import numpy as np
import pytest

from stereokit import Disparity
from stereokit.errors import FileError
from stereokit_refiners.weights import NETWORKS, WeightFile, find, write

NAN = np.nan
NAMES = tuple(name for name, network in NETWORKS.items() if "disparity" in network.inputs)
LEARNED = [*(name for name in ("openvino", "onnxruntime", "torch") if importlib.util.find_spec(name)), "opencv"]
"""Runtimes of networks that are installed."""


def random_arrays(name, seed=0, last=0.05):
    """Return weights of a network: He et al. 2015 for all layers, `last` of that for the last; small biases."""
    rng = np.random.default_rng(seed)
    layers = NETWORKS[name].layers
    arrays = {}
    for layer in layers:
        fan = layer.inputs * layer.kernel**2 / (4 if layer.up else 1)
        scale = np.sqrt(2 / fan) * (last if layer is layers[-1] else 1)
        arrays[f"{layer.name}.weight"] = (rng.standard_normal(layer.weight_shape) * scale).astype(np.float32)
        arrays[f"{layer.name}.bias"] = (rng.standard_normal(layer.outputs) * 0.1).astype(np.float32)
    return arrays


def flat_ranges(name, bound, leave=()):
    """Return one range for all channels of all layers but the last, and of what `leave` names."""
    layers = NETWORKS[name].layers[:-1]
    return {layer.name: [float(bound)] * layer.outputs for layer in layers if layer.name not in leave}


def random_content(name, seed=0, output_mode="residual", ranges=None, last=0.05):
    return WeightFile(name, output_mode, random_arrays(name, seed, last), ranges or {}, {"note": "random"})


def weight_file(folder, name, seed=0, **arguments):
    path = folder / f"{name}-{seed}.safetensors"
    write(path, random_content(name, seed, **arguments))
    return str(path)


def tuned_to_kitti(name):
    """Return the weights of a network in the package stereokit-kitti-weights, or skip where it is not installed."""
    try:
        return find(name, "kitti")
    except FileError as error:
        pytest.skip(str(error))


def half_of(size):
    return tuple(-(-side // 2) for side in size)


def coarse_of(size, seed=0, gaps=0.0, low=2.0, high=30.0):
    """Return a smooth half-size map for an image of `size`, with some of it not measured."""
    rng = np.random.default_rng(seed)
    shape = half_of(size)
    rough = cv2.GaussianBlur(rng.random(shape), (0, 0), 2).reshape(shape)
    disparity = (low + (high - low) * rough).astype(np.float32)
    disparity[rng.random(shape) < gaps] = NAN
    valid = ~np.isnan(disparity) & (rng.random(shape) < 0.85)
    confidence = np.where(valid, rng.random(shape), 0).astype(np.float32)
    candidates = (low + (high - low) * rng.random((2, *shape))).astype(np.float32)
    return Disparity(disparity, valid, confidence, candidates=candidates)


def sure(disparity, valid=None):
    """Return a map of which all that is valid, or all of it, was measured with full confidence and without rivals."""
    valid = np.ones(disparity.shape, bool) if valid is None else valid
    candidates = np.nan_to_num(np.stack([disparity] * 2))
    return Disparity(disparity, valid, valid.astype(np.float32), candidates=candidates)


def image_of(size, seed=0):
    return np.random.default_rng([seed, 7]).integers(0, 256, size).astype(np.uint8)


def encoded_of(name, rows, columns, seed=0):
    """Return random inputs of a network, (C, h, w) each."""
    rng = np.random.default_rng([seed, 5])
    return {key: rng.normal(0, 1, (count, rows, columns)).astype(np.float32) for key, count in
            NETWORKS[name].inputs.items()}  # fmt: skip


def one_line(error):
    text = str(error)
    assert text and "\n" not in text, text
    return text


def network_map(refiner, coarse, left, threads=1):
    """Return what the network itself makes of a coarse map, neither lowered nor held to a range."""
    candidates = coarse.candidates if refiner.needs_candidates else None
    return refiner.network_map(coarse.disparity, candidates, coarse.confidence, left, threads)
