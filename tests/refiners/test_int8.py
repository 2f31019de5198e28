"""Networks in 8 bits: sums are exact on every processor, and the maps are as near as 256 steps allow.

Processors with VNNI add products of 8 bits in 32 bits; others add two of them in 16 bits and saturate. The last test
runs this file again in a process that is held to AVX2, so that both are covered by any x86 machine.
"""

from __future__ import annotations

import os
import platform
from typing import ClassVar

import numpy as np
import pytest
from refining import NAMES, encoded_of, random_arrays, tuned_to_kitti

import stereokit
from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.networks.layers import Layer
from stereokit_refiners.weights import NETWORKS

pytest.importorskip("openvino")

AVX2 = "AVX2"


class TwoLayers:
    """A network of two convolutions, the second of which reads 8 bits."""

    name: ClassVar[str] = "two"
    inputs: ClassVar[dict[str, int]] = {"image": 1}
    multiple: ClassVar[int] = 1
    innermost: ClassVar[bool] = False

    def __init__(self, channels, kernel, stride=1):
        self.layers = Layer("a", 1, channels, kernel=1), Layer("b", channels, 16, kernel=kernel, stride=stride)

    def forward(self, ops, inputs):
        return {"map": ops.conv("b", [ops.conv("a", [inputs["image"]])], activate=False)}


@pytest.mark.parametrize(("kernel", "stride"), [(1, 1), (3, 1), (3, 2), (5, 1)])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_largest_sums_do_not_saturate(kernel, stride, sign):
    """All activations and all weights are as large as 8 bits hold."""
    from stereokit_refiners.runtimes.openvino import compiled

    channels, side = 64, 12
    network = TwoLayers(channels, kernel, stride)
    arrays = {
        "a.weight": np.ones((channels, 1, 1, 1), np.float32),
        "a.bias": np.zeros(channels, np.float32),
        "b.weight": np.full((16, channels, kernel, kernel), sign, np.float32),
        "b.bias": np.zeros(16, np.float32),
    }
    run = compiled(network, arrays, side, side, 1, "int8", {"a": [1.0] * channels})
    head = run({"image": np.ones((1, side, side), np.float32)})
    middle = head[head.shape[0] // 2, head.shape[1] // 2]
    np.testing.assert_allclose(middle, sign * channels * kernel**2, rtol=1e-5)


def test_weights_that_alternate_are_summed_to_the_step():
    """Each weight and each activation is a whole number of its steps, so nothing is rounded and the sum is exact."""
    from stereokit_refiners.runtimes.openvino import WEIGHT_STEPS, compiled

    rng = np.random.default_rng(0)
    channels, side = 48, 6
    network = TwoLayers(channels, 3)
    steps = rng.integers(-WEIGHT_STEPS, WEIGHT_STEPS + 1, (16, channels, 3, 3))
    steps[:, 0, 0, 0] = WEIGHT_STEPS  # the largest, which decides what a step is
    values = rng.integers(-12, 128, channels)  # of 127; a leaky ReLU makes tenths of the negative ones
    arguments = np.where(values < 0, 10 * values, values) / 127
    arrays = {
        "a.weight": np.zeros((channels, 1, 1, 1), np.float32),
        "a.bias": arguments.astype(np.float32),
        "b.weight": (steps / WEIGHT_STEPS).astype(np.float32),
        "b.bias": np.zeros(16, np.float32),
    }
    run = compiled(network, arrays, side, side, 1, "int8", {"a": [1.0] * channels})
    head = run({"image": np.zeros((1, side, side), np.float32)})
    expected = (steps.sum(axis=(2, 3)) * values).sum(axis=1) / (127 * WEIGHT_STEPS)
    np.testing.assert_allclose(head[3, 3], expected, rtol=0, atol=1e-4)


def heads(name, ranges):
    """Return a network's head in 8 bits, in floating point, and with rounding to the steps drawn at random.

    In the last, by torch in floating point, all weights and the activations of `ranges` are off by up to half a step.
    """
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes import torch as runtime
    from stereokit_refiners.runtimes.openvino import WEIGHT_STEPS, compiled

    draw = torch.Generator().manual_seed(0)

    def waver(values, step):
        return values + (torch.rand(values.shape, generator=draw) - 0.5) * step

    class Wavering(runtime._TorchOps):
        def activate(self, layer, x):
            y = super().activate(layer, x)
            return waver(y, torch.tensor(ranges[layer]).reshape(1, -1, 1, 1) / 127) if layer in ranges else y

    network, plain = NETWORKS[name], random_arrays(name)
    off = dict(plain)
    for key, values in plain.items():
        if values.ndim == 4:
            step = np.abs(values).max(axis=(1, 2, 3), keepdims=True) / WEIGHT_STEPS
            off[key] = waver(torch.from_numpy(values), torch.from_numpy(step)).numpy()
    arguments = encoded_of(name, 32, 48)
    inputs = {key: torch.from_numpy(a)[None] for key, a in arguments.items()}
    module = runtime.Module(network)
    actual = [compiled(network, plain, 32, 48, 1, "int8", ranges)(arguments)]
    with torch.inference_mode():
        for arrays, ops in ((plain, runtime._TorchOps), (off, Wavering)):
            module.load(arrays)
            actual.append(network.forward(ops(module), inputs)["map"][0].permute(1, 2, 0).numpy())
    return actual


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("which", ["all", "even", "odd"])
def test_heads_are_off_by_what_rounding_to_the_steps_allows(name, which):
    """What has no range stays in floating point, and so do the convolutions that read it."""
    pytest.importorskip("torch")
    from test_backends import calibrated

    ranges = calibrated(name)
    start, step = {"all": (0, 1), "even": (0, 2), "odd": (1, 2)}[which]
    some = {key: ranges[key] for key in list(ranges)[start::step]}
    rounded, exact, drawn = heads(name, some)
    difference, allowed = np.abs(rounded - exact).mean(), np.abs(drawn - exact).mean()
    assert 0 < difference < 2 * allowed


@pytest.fixture(scope="module")
def street():
    """Return both views, the half-size map, and the exact disparity where there is one."""
    pytest.importorskip("skimage")
    from stereokit_evaluation.synthetic.scenes import generate

    scene = generate(seed=3, width=414, height=126, max_disparity=64)
    keeping = Keeping()
    stereokit.Matcher("S2", max_disparity=64, scale=0.5, refiner=keeping, threads=1)(scene.left, scene.right)
    return keeping.left, keeping.right, keeping.coarse, scene.occ


class Keeping:
    """A refiner that keeps what it is given."""

    needs_candidates = True
    needs_right = True

    def __call__(self, coarse, left, *, right, threads=1):
        self.coarse, self.left, self.right = coarse, left, right
        return stereokit.Disparity(np.zeros(left.shape, np.float32), np.ones(left.shape, bool))


@pytest.mark.parametrize("name", NAMES)
def test_weights_tuned_to_kitti_are_as_good_in_8_bits_on_a_street_whose_truth_is_known(name, street):
    left, _, coarse, truth = street
    known = np.isfinite(truth)
    off = {}
    for precision in ("fp32", "int8"):
        refiner = LearnedRefiner.of(tuned_to_kitti(name), backend="openvino", precision=precision)
        off[precision] = np.abs(refiner(coarse, left).disparity - truth)[known]
    assert off["int8"].mean() < off["fp32"].mean() + 0.15
    assert (off["int8"] > 3).mean() < (off["fp32"] > 3).mean() + 0.01


def test_the_general_refiner_tuned_to_kitti_is_as_good_in_8_bits(street):
    left, right, coarse, truth = street
    known = np.isfinite(truth)
    off = {}
    for precision in ("fp32", "int8"):
        refiner = LearnedRefiner.of(tuned_to_kitti("evidence"), backend="openvino", precision=precision)
        off[precision] = np.abs(refiner(coarse, left, right=right).disparity - truth)[known]
    assert off["int8"].mean() < 1.02 * off["fp32"].mean() + 0.01
    assert (off["int8"] > 3).mean() < 1.02 * (off["fp32"] > 3).mean() + 0.001


@pytest.mark.skipif(os.environ.get("ONEDNN_MAX_CPU_ISA") == AVX2, reason="this is the process that is held to AVX2")
def test_all_of_this_file_passes_on_a_processor_with_avx2_and_no_more(run_python):
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("needs an x86 processor, which can be held to AVX2")
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", __file__]
    assert " passed" in run_python(*words, ONEDNN_MAX_CPU_ISA=AVX2)
