"""Table I of the paper, its arithmetic, and the torch networks against plain loops."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
from refining import NAMES, encoded_of, random_arrays

from stereokit_refiners.networks.layers import Layer, cost, shapes, sub_pixel_kernel, sub_pixel_taps
from stereokit_refiners.networks.pyramid import Pyramid
from stereokit_refiners.networks.stereovae import NonVae, StereoVae
from stereokit_refiners.weights import NETWORKS

TABLE_1 = [
    # output, inputs, input size (the full size over this), output size, kernels, kernel size; paper, table I
    ("FE_1", ["X_0"], 2, 2, 32, 5),
    ("FE_2", ["X_1"], 2, 2, 32, 5),
    ("EN_1", ["FE_1", "FE_2"], 2, 4, 16, 5),
    ("EN_1_R", ["EN_1"], 4, 4, 8, 5),
    ("EN_2", ["EN_1", "EN_1_R"], 4, 8, 32, 5),
    ("EN_2_R", ["EN_2"], 8, 8, 16, 5),
    ("mu & sigma", ["EN_2", "EN_2_R"], 8, 8, 2, 1),
    ("D_1", ["sigma * gaussian + mu"], 8, 8, 32, 1),
    ("D_1_R", ["D_1", "EN_2", "EN_2_R"], 8, 8, 16, 5),
    ("D_2", ["D_1", "EN_2", "EN_2_R", "D_1_R"], 8, 4, 16, 5),
    ("D_2_R", ["D_2", "EN_1", "EN_1_R"], 4, 4, 8, 5),
    ("D", ["D_2", "EN_1", "EN_1_R", "D_2_R"], 4, 2, 16, 5),
    ("Y", ["D", "X_0", "FE_1", "FE_2"], 2, 1, 1, 5),
]
HEIGHT, WIDTH = 384, 1248
CHANNELS = {"X_0": 1, "X_1": 1, "sigma * gaussian + mu": 1} | {row[0]: row[4] for row in TABLE_1}

TOLERANCE = 2e-5
"""Of the largest value of a result: float32 arithmetic against float64, or in another order."""


def close(actual, expected, tolerance=TOLERANCE):
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * max(1.0, np.abs(expected).max()))


def test_parameters_are_those_that_a_count_of_the_table_gives():
    counted = sum(
        sum(CHANNELS[name] for name in inputs) * kernels * kernel**2 + kernels
        for _, inputs, _, _, kernels, kernel in TABLE_1
    )
    assert counted == 162_380
    assert cost(StereoVae(), HEIGHT // 2, WIDTH // 2)[1] == counted
    assert cost(NonVae(), HEIGHT // 2, WIDTH // 2)[1] == 136_618


@pytest.mark.parametrize("row", TABLE_1, ids=lambda row: row[0])
def test_every_row_of_table_1(row):
    name, inputs, before, after, kernels, kernel = row
    layers = {layer.name: layer for layer in StereoVae().layers}
    _, _, outputs = cost(StereoVae(), HEIGHT // 2, WIDTH // 2)
    parts = ["MU", "SIGMA"] if name == "mu & sigma" else [name]
    actual = [outputs[part] for part in parts]
    assert sum(shape[0] for shape in actual) == kernels
    assert {shape[1:] for shape in actual} == {(HEIGHT // after, WIDTH // after)}
    for part in parts:
        layer = layers[part]
        assert layer.kernel == kernel
        assert layer.inputs == sum(CHANNELS[i] for i in inputs)
        assert (layer.stride, layer.up) == {1: (1, False), 2: (2, False), 0.5: (1, True)}[after / before]
    for other in inputs:
        if other in outputs:
            assert outputs[other][1:] == (HEIGHT // before, WIDTH // before)


def test_the_table_is_complete_and_in_order():
    names = [part for row in TABLE_1 for part in (["MU", "SIGMA"] if row[0] == "mu & sigma" else [row[0]])]
    assert [layer.name for layer in StereoVae().layers] == names
    assert [layer.name for layer in NonVae().layers] == [n for n in names if n not in ("MU", "SIGMA", "D_1")]
    assert list(cost(StereoVae(), 8, 12)[2]) == names


def test_multiplications_are_counted_as_a_hand_count_gives():
    total = 0
    for _, inputs, before, after, kernels, kernel in TABLE_1:
        # A transposed convolution uses each input pixel k * k times; the other kind each output pixel.
        per = max(before, after)
        pixels = (HEIGHT // per) * (WIDTH // per)
        total += pixels * sum(CHANNELS[i] for i in inputs) * kernels * kernel**2
    assert cost(StereoVae(), HEIGHT // 2, WIDTH // 2)[0] == total


def test_the_pyramid_costs_at_most_what_stereovae_does():
    ours, paper = (cost(network, HEIGHT // 2, WIDTH // 2)[:2] for network in (Pyramid(), StereoVae()))
    assert ours[0] <= paper[0]


@pytest.mark.parametrize("name", NAMES)
def test_names_and_shapes_agree(name):
    network = NETWORKS[name]
    actual = shapes(network)
    assert network.name == name
    assert len(actual) == 2 * len(network.layers)
    assert set(cost(network, 16, 24)[2]) == {layer.name for layer in network.layers}
    for layer in network.layers:
        assert actual[f"{layer.name}.weight"] == layer.weight_shape
        assert actual[f"{layer.name}.bias"] == (layer.outputs,)
    up = Layer("up", 3, 7, up=True)
    assert up.weight_shape == (3, 7, 5, 5)


def test_sub_pixel_taps_use_each_tap_of_the_transposed_kernel_once():
    taps = sub_pixel_taps()
    assert sorted(k for _, k, _ in taps) == [0, 1, 2, 3, 4]
    assert all(0 <= tap <= 2 for _, _, tap in taps)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 4)])
def test_the_sub_pixel_kernel_is_the_transposed_convolution(size):
    rng = np.random.default_rng(0)
    image = rng.standard_normal((3, *size))
    weight, bias = rng.standard_normal((3, 2, 5, 5)).astype(np.float32), rng.standard_normal(2)
    kernel = sub_pixel_kernel(weight)
    assert kernel.shape == (8, 3, 3, 3)
    assert kernel.dtype == np.float32
    phases = oracles.convolve(image, kernel, np.repeat(bias, 4))
    expected = oracles.convolve_up(image, weight, bias)
    for output in range(2):
        np.testing.assert_allclose(
            oracles.phases_to_pixels(phases[4 * output : 4 * output + 4]), expected[output], atol=1e-12
        )


# --- torch against loops -------------------------------------------------------------------------------------------


def stereovae_by_loops(arrays, x0, x1, latent):
    """Return the last layer, (1, 2h, 2w), mean and log deviation, as the specification writes StereoVAE."""

    def conv(name, *inputs, stride=1, activate=True):
        y = oracles.convolve(np.concatenate(inputs), arrays[f"{name}.weight"], arrays[f"{name}.bias"], stride)
        return oracles.leaky(y) if activate else y

    def deconv(name, *inputs, activate=True):
        y = oracles.convolve_up(np.concatenate(inputs), arrays[f"{name}.weight"], arrays[f"{name}.bias"])
        return oracles.leaky(y) if activate else y

    fe_1, fe_2 = conv("FE_1", x0), conv("FE_2", x1)
    en_1 = conv("EN_1", fe_1, fe_2, stride=2)
    en_1_r = conv("EN_1_R", en_1)
    en_2 = conv("EN_2", en_1, en_1_r, stride=2)
    en_2_r = conv("EN_2_R", en_2)
    mean = log_sigma = None
    below = (en_2, en_2_r)
    if latent:
        mean = conv("MU", en_2, en_2_r, activate=False) - 1
        log_sigma = conv("SIGMA", en_2, en_2_r, activate=False) - 1
        below = (conv("D_1", mean), en_2, en_2_r)
    d_1_r = conv("D_1_R", *below)
    d_2 = deconv("D_2", *below, d_1_r)
    d_2_r = conv("D_2_R", d_2, en_1, en_1_r)
    d = deconv("D", d_2, en_1, en_1_r, d_2_r)
    return deconv("Y", d, x0, fe_1, fe_2, activate=False), mean, log_sigma


def pyramid_by_loops(arrays, disparity, confidence, phases, candidates):
    def conv(name, *inputs, stride=1, activate=True):
        y = oracles.convolve(np.concatenate(inputs), arrays[f"{name}.weight"], arrays[f"{name}.bias"], stride)
        return oracles.leaky(y) if activate else y

    def block(name, x):
        return oracles.leaky(x + conv(f"{name}b", conv(f"{name}a", x), activate=False))

    def up(name, low, skip):
        low = conv(name, low, activate=False)
        _, height, width = low.shape
        return oracles.leaky(skip + np.stack([oracles.double(plane, 2 * height, 2 * width) for plane in low]))

    a = conv("stem", disparity, confidence, phases, candidates)
    b = block("block_1", conv("down_1", a, stride=2))
    c = block("block_2", conv("down_2", b, stride=2))
    d = block("block_3", conv("down_3", c, stride=2))
    c = conv("merge_2", up("up_3", d, c))
    b = conv("merge_1", up("up_2", c, b))
    a = conv("merge_0", up("up_1", b, a))
    return conv("head", a, activate=False)


def module_of(name, arrays):
    pytest.importorskip("torch")
    from stereokit_refiners.runtimes.torch import Module

    module = Module(NETWORKS[name])
    module.load(arrays)
    return module.eval()


def heads_of(module, inputs):
    import torch

    with torch.no_grad():
        heads = module({name: torch.from_numpy(array)[None] for name, array in inputs.items()})
    return {name: tensor[0].numpy() for name, tensor in heads.items()}


@pytest.mark.parametrize("name", ["stereovae", "cnn"])
def test_the_papers_networks_are_what_loops_compute(name):
    arrays, inputs = random_arrays(name, 1, last=1.0), encoded_of(name, 8, 12)
    heads = heads_of(module_of(name, arrays), inputs)
    y, mean, log_sigma = stereovae_by_loops(arrays, inputs["disparity"], inputs["image"], name == "stereovae")
    assert heads["map"].shape == (4, 8, 12)
    close(oracles.phases_to_pixels(heads["map"]), y[0])
    assert ("mean" in heads) == (mean is not None)
    if mean is not None:
        close(heads["mean"], mean)
        close(heads["log_sigma"], log_sigma)


def test_the_pyramid_is_what_loops_compute():
    arrays, inputs = random_arrays("pyramid", 2, last=1.0), encoded_of("pyramid", 8, 16)
    heads = heads_of(module_of("pyramid", arrays), inputs)
    assert list(heads) == ["map"]
    close(
        heads["map"],
        pyramid_by_loops(arrays, *(inputs[n] for n in ("disparity", "confidence", "phases", "candidates"))),
    )


def test_the_latent_is_its_mean_at_inference_and_drawn_in_training():
    torch = pytest.importorskip("torch")
    module = module_of("stereovae", random_arrays("stereovae", 3))
    inputs = {name: torch.from_numpy(a)[None] for name, a in encoded_of("stereovae", 8, 8).items()}

    def run(seed):
        torch.manual_seed(seed)
        with torch.no_grad():
            return module(inputs)

    fixed = [run(0), run(1)]
    assert torch.equal(fixed[0]["map"], fixed[1]["map"])
    module.train()
    drawn = [run(0), run(0), run(1)]
    assert torch.equal(drawn[0]["map"], drawn[1]["map"])
    assert not torch.equal(drawn[0]["map"], drawn[2]["map"])
    assert not torch.equal(drawn[0]["map"], fixed[0]["map"])
    assert torch.equal(drawn[0]["mean"], fixed[0]["mean"])  # only what follows is drawn


def test_the_latent_has_the_mean_and_the_deviation_that_it_is_drawn_with():
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes.torch import Module, _TorchOps

    ops = _TorchOps(Module(StereoVae()).train())
    torch.manual_seed(0)
    drawn = ops.sample(torch.full((40_000,), 1.5), torch.full((40_000,), float(np.log(0.25))))
    assert abs(drawn.mean().item() - 1.5) < 5 * 0.25 / 200
    assert abs(drawn.std().item() - 0.25) < 5 * 0.25 / np.sqrt(2 * 40_000)


@pytest.mark.parametrize("name", NAMES)
def test_weights_go_in_and_come_out_as_they_were(name):
    arrays = random_arrays(name, 4)
    actual = module_of(name, arrays).arrays()
    assert set(actual) == set(shapes(NETWORKS[name]))
    for key, array in arrays.items():
        np.testing.assert_array_equal(actual[key], array)


@pytest.mark.parametrize("name", NAMES)
def test_first_weights_are_those_of_the_seed(name):
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes.torch import Module

    first, again, other = (Module(NETWORKS[name], torch.Generator().manual_seed(seed)).arrays() for seed in (5, 5, 6))
    last = f"{NETWORKS[name].layers[-1].name}.weight"
    np.testing.assert_array_equal(first[last], again[last])
    assert (first[last] != other[last]).any()


@pytest.mark.parametrize("name", NAMES)
def test_gradients_reach_every_weight(name):
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes.torch import Module

    rule = NETWORKS[name].outputs["residual"]
    module = Module(NETWORKS[name], torch.Generator().manual_seed(0)).train()
    inputs = {key: torch.from_numpy(a)[None] for key, a in encoded_of(name, 16, 16).items()}
    heads = module(inputs)
    values = torch.rand(1, 2, 16, 16) * 30
    loss = rule.tensor_map(heads["map"], inputs["disparity"] * 10 + 20, values).square().mean()
    if "log_sigma" in heads:
        loss = loss + heads["log_sigma"].square().mean()
    loss.backward()
    for key, value in module.weights.items():
        assert value.grad is not None and value.grad.abs().max() > 0, key
