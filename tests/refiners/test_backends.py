"""OpenVINO, ONNX Runtime, torch and OpenCV run one description of a network: they agree, in fp32, bf16 and int8."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import oracles
import pytest
from refining import LEARNED, NAMES, coarse_of, encoded_of, image_of, network_map, random_arrays, random_content

from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.weights import NETWORKS

TOLERANCE_PX = 2e-3
"""Between runtimes in fp32, full-size pixels, for maps of some tens of pixels: the order of sums."""

SIZE = (45, 70)
FORMS = [(name, "residual") for name in NAMES] + [("stereovae", "direct"), ("cnn", "direct")]


def refined(content, backend, precision="fp32", threads=1, size=SIZE):
    if backend not in LEARNED:
        pytest.skip(f"needs {backend}")
    refiner = LearnedRefiner.of(content, backend=backend, precision=precision)
    return network_map(refiner, coarse_of(size), image_of(size), threads)


def calibrated(name, seed=0):
    """Return the ranges of the activations of random weights, as training finds them."""
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes.torch import Module, calibrate

    module = Module(NETWORKS[name])
    module.load(random_arrays(name, seed))
    inputs = encoded_of(name, 32, 48)
    return calibrate(module, [{key: torch.from_numpy(a)[None] for key, a in inputs.items()}])


@pytest.mark.parametrize("backend", ["openvino", "onnxruntime", "opencv"])
@pytest.mark.parametrize(("name", "mode"), FORMS)
def test_runtimes_agree(name, mode, backend):
    pytest.importorskip("torch")
    content = random_content(name, output_mode=mode)
    expected = refined(content, "torch")
    np.testing.assert_allclose(refined(content, backend), expected, rtol=0, atol=TOLERANCE_PX)
    assert np.ptp(expected) > 0.5


@pytest.mark.parametrize("backend", ["openvino", "onnxruntime"])
@pytest.mark.parametrize("name", ["stereovae", "cnn"])
def test_heads_of_the_papers_networks_against_loops(name, backend):
    pytest.importorskip(backend)
    from test_networks import stereovae_by_loops

    arrays, inputs = random_arrays(name, 1, last=1.0), encoded_of(name, 8, 12)
    network = NETWORKS[name]
    if backend == "openvino":
        from stereokit_refiners.runtimes.openvino import compiled

        run = compiled(network, arrays, 8, 12, 1, "fp32", None)
    else:
        from stereokit_refiners.runtimes.onnx import session

        run = session(network, arrays, 1)
    head = run(inputs)
    assert head.shape == (8, 12, 4)
    assert head.dtype == np.float32
    assert head.flags.c_contiguous
    y, _, _ = stereovae_by_loops(arrays, inputs["disparity"], inputs["image"], name == "stereovae")
    actual = oracles.phases_to_pixels(head.transpose(2, 0, 1))
    np.testing.assert_allclose(actual, y[0], rtol=0, atol=2e-5 * np.abs(y).max())


@pytest.mark.parametrize("name", NAMES)
def test_bf16_is_near_fp32(name):
    content = random_content(name)
    exact, rough = refined(content, "openvino"), refined(content, "openvino", "bf16")
    assert np.abs(exact - rough).max() < 0.25


def test_int8_does_not_drown_small_channels():
    """Channels of a convolution may differ in range by orders of magnitude."""
    content = random_content("cnn", last=0.5)
    arrays = dict(content.arrays)
    factors = np.geomspace(1e-2, 1e2, 16).astype(np.float32)
    arrays["EN_1.weight"] = arrays["EN_1.weight"] * factors[:, None, None, None]
    arrays["EN_1.bias"] = arrays["EN_1.bias"] * factors
    for reader, first in (("EN_1_R", 0), ("EN_2", 0), ("D_2_R", 16), ("D", 16)):
        weight = arrays[f"{reader}.weight"].copy()
        view = weight.swapaxes(0, 1) if reader == "D" else weight
        view[:, first : first + 16] /= factors[None, :, None, None]
        arrays[f"{reader}.weight"] = weight
    scaled = dataclasses.replace(content, arrays=arrays)
    np.testing.assert_allclose(refined(scaled, "openvino"), refined(content, "openvino"), atol=TOLERANCE_PX)
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes.torch import Module, calibrate

    errors = []
    for one in (content, scaled):
        module = Module(NETWORKS["cnn"])
        module.load(one.arrays)
        inputs = {key: torch.from_numpy(a)[None] for key, a in encoded_of("cnn", 32, 48).items()}
        rounded = dataclasses.replace(one, ranges=calibrate(module, [inputs]))
        errors.append(np.abs(refined(rounded, "openvino", "int8") - refined(one, "openvino")).mean())
    assert errors[1] < 1.5 * errors[0]


@pytest.mark.parametrize("name", NAMES)
def test_calibration_covers_every_activation_but_the_linear_ones(name):
    ranges = calibrated(name)
    network = NETWORKS[name]
    silent = {"MU", "SIGMA", "Y", "head", "up_1", "up_2", "up_3", "block_1b", "block_2b", "block_3b"}
    named = {layer.name for layer in network.layers} - silent
    assert named <= set(ranges)
    assert not silent & set(ranges)
    outputs = {layer.name: layer.outputs for layer in network.layers}
    for activation, bounds in ranges.items():
        assert len(bounds) == outputs.get(activation, len(bounds))
        assert all(0 <= bound < np.inf for bound in bounds)
        assert max(bounds) > 0


def test_calibration_is_the_largest_but_for_a_thousandth_over_all_batches():
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes.torch import Module, calibrate

    network = NETWORKS["cnn"]
    module = Module(network)
    arrays = {key: np.zeros_like(a) for key, a in random_arrays("cnn").items()}
    factors = np.linspace(0.5, 4, 32).astype(np.float32)
    arrays["FE_1.weight"][:, 0, 2, 2] = factors  # each channel is the disparity times its factor
    module.load(arrays)
    plane = torch.linspace(0, 1, 100 * 100).reshape(1, 1, 100, 100)
    batches = [{"disparity": plane * s, "image": torch.zeros_like(plane)} for s in (1.0, 3.0, 2.0)]
    ranges = calibrate(module, batches)
    np.testing.assert_allclose(ranges["FE_1"], 3 * factors, rtol=2e-3)
    assert ranges["FE_2"] == [0] * 32
    loose = calibrate(module, batches, share=0.5)
    np.testing.assert_allclose(loose["FE_1"], 1.5 * factors, rtol=2e-3)


WAYS = [
    *(("openvino", precision) for precision in ("fp32", "bf16", "int8")),
    ("onnxruntime", "auto"),
    ("torch", "auto"),
]


@pytest.mark.parametrize(("backend", "precision"), WAYS)
@pytest.mark.parametrize("name", NAMES)
def test_threads_do_not_change_the_result(name, backend, precision):
    content = random_content(name, ranges=calibrated(name) if precision == "int8" else {})
    one = refined(content, backend, precision, threads=1)
    for threads in (2, 3):
        np.testing.assert_array_equal(refined(content, backend, precision, threads=threads), one)


@pytest.mark.parametrize("backend", LEARNED)
def test_calls_from_four_threads_at_once_are_single_calls(backend):
    refiner = LearnedRefiner.of(random_content("stereovae"), backend=backend)
    sizes = [(32, 40), (24, 48), (32, 40), (17, 33)]
    expected = [refiner(coarse_of(s, k), image_of(s, k)).disparity for k, s in enumerate(sizes)]
    fresh = LearnedRefiner.of(random_content("stereovae"), backend=backend)
    start, wrong = threading.Barrier(4), []

    def work(k):
        start.wait()
        for _ in range(8):
            actual = fresh(coarse_of(sizes[k], k), image_of(sizes[k], k)).disparity
            if not np.array_equal(actual, expected[k]):
                wrong.append(k)

    workers = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not wrong


def test_more_sizes_than_are_kept_compiled_give_what_they_did():
    refiner = LearnedRefiner.of(random_content("cnn"))
    sizes = [(8 * k, 16) for k in range(1, 8)]
    first = [refiner(coarse_of(s), image_of(s)).disparity for s in sizes]
    for size, expected in zip(sizes, first, strict=True):
        np.testing.assert_array_equal(refiner(coarse_of(size), image_of(size)).disparity, expected)
    assert len(refiner._compiled._runs) <= 4
