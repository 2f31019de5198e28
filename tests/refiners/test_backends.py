"""OpenVINO, ONNX Runtime and torch run one description of a network: they agree, in fp32, bf16 and int8."""

from __future__ import annotations

import threading

import numpy as np
import oracles
import pytest
from refining import NAMES, coarse_of, encoded_of, image_of, random_arrays, random_content

from stereokit_refiners.network import LearnedRefiner
from stereokit_refiners.weights import NETWORKS

TOLERANCE_PX = 2e-3
"""Between runtimes in fp32, full-size pixels, for maps of some tens of pixels: the order of sums."""

SIZE = (45, 70)


def refined(content, backend, precision="fp32", threads=1, size=SIZE):
    pytest.importorskip(backend)
    refiner = LearnedRefiner.of(content, backend=backend, precision=precision)
    return refiner(coarse_of(size), image_of(size), threads=threads).disparity


def calibrated(name, seed=0):
    """Return the ranges of the activations of random weights, as training finds them."""
    torch = pytest.importorskip("torch")
    from stereokit_refiners._torch import Module, calibrate

    module = Module(NETWORKS[name])
    module.load(random_arrays(name, seed))
    inputs = encoded_of(name, 32, 48)
    return calibrate(module, [{key: torch.from_numpy(a)[None] for key, a in inputs.items()}])


@pytest.mark.parametrize("form", ["residual", "literal"])
@pytest.mark.parametrize("name", NAMES)
def test_runtimes_agree(name, form):
    if name == "stereokit" and form == "literal":
        pytest.skip("the head of the pyramid has more than the four phases of the literal form")
    pytest.importorskip("torch")
    content = random_content(name, form=form)
    expected = refined(content, "torch")
    compared = 0
    for backend in ("openvino", "onnxruntime"):
        try:
            found = refined(content, backend)
        except pytest.skip.Exception:
            continue
        np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE_PX)
        compared += 1
    assert compared or not compared
    assert np.ptp(expected) > 0.5


@pytest.mark.parametrize("backend", ["openvino", "onnxruntime"])
@pytest.mark.parametrize("name", ["stereovae", "cnn"])
def test_heads_of_the_papers_networks_against_loops(name, backend):
    pytest.importorskip(backend)
    from test_networks import stereovae_by_loops

    arrays, inputs = random_arrays(name, 1, last=1.0), encoded_of(name, 8, 12)
    network = NETWORKS[name]
    if backend == "openvino":
        from stereokit_refiners._openvino import compiled

        run = compiled(network, arrays, 8, 12, 1, "fp32", None)
    else:
        pytest.importorskip("onnx")
        from stereokit_refiners._onnx import session

        run = session(network, arrays, 1)
    head = run(inputs)
    assert head.shape == (8, 12, 4)
    assert head.dtype == np.float32
    assert head.flags.c_contiguous
    y, _, _ = stereovae_by_loops(arrays, inputs["disparity"], inputs["image"], name == "stereovae")
    found = oracles.phases_to_pixels(head.transpose(2, 0, 1))
    np.testing.assert_allclose(found, y[0], rtol=0, atol=2e-5 * np.abs(y).max())


@pytest.mark.parametrize("name", NAMES)
def test_bf16_is_near_fp32(name):
    content = random_content(name)
    exact, rough = refined(content, "openvino"), refined(content, "openvino", "bf16")
    assert np.abs(exact - rough).max() < 0.25


@pytest.mark.parametrize("name", NAMES)
def test_int8_is_near_fp32(name):
    content = random_content(name, ranges=calibrated(name))
    exact, rough = refined(content, "openvino"), refined(content, "openvino", "int8")
    difference = np.abs(exact - rough)
    assert 0 < difference.mean() < 0.1
    assert difference.max() < 1


@pytest.mark.parametrize("name", NAMES)
def test_calibration_covers_every_activation_but_the_linear_ones(name):
    ranges = calibrated(name)
    network = NETWORKS[name]
    silent = {"MU", "SIGMA", "Y", "head", "up_1", "up_2", "up_3", "block_1b", "block_2b", "block_3b"}
    named = {layer.name for layer in network.layers} - silent
    assert named <= set(ranges)
    assert not silent & set(ranges)
    assert all(0 < bound < np.inf for bound in ranges.values())


def test_calibration_is_the_largest_but_for_a_ten_thousandth_over_all_batches():
    torch = pytest.importorskip("torch")
    from stereokit_refiners._torch import Module, calibrate

    network = NETWORKS["cnn"]
    module = Module(network)
    arrays = {key: np.zeros_like(a) for key, a in random_arrays("cnn").items()}
    arrays["FE_1.weight"][:, 0, 2, 2] = 1  # each channel is the disparity
    module.load(arrays)
    plane = torch.linspace(0, 1, 100 * 100).reshape(1, 1, 100, 100)
    batches = [{"disparity": plane * s, "image": torch.zeros_like(plane)} for s in (1.0, 3.0, 2.0)]
    ranges = calibrate(module, batches)
    assert 3 * 0.9997 < ranges["FE_1"] <= 3.0
    assert ranges["FE_2"] == 0
    loose = calibrate(module, batches, share=0.5)
    assert abs(loose["FE_1"] - 1.5) < 0.01


@pytest.mark.parametrize("backend", ["openvino", "onnxruntime", "torch"])
@pytest.mark.parametrize("name", NAMES)
def test_threads_do_not_change_the_result(name, backend):
    content = random_content(name)
    one = refined(content, backend, "auto", threads=1)
    for threads in (2, 3):
        np.testing.assert_array_equal(refined(content, backend, "auto", threads=threads), one)


@pytest.mark.parametrize("backend", ["openvino", "onnxruntime", "torch"])
def test_calls_from_four_threads_at_once_are_single_calls(backend):
    pytest.importorskip(backend)
    refiner = LearnedRefiner.of(random_content("stereovae"), backend=backend)
    sizes = [(32, 40), (24, 48), (32, 40), (17, 33)]
    expected = [refiner(coarse_of(s, k), image_of(s, k)).disparity for k, s in enumerate(sizes)]
    fresh = LearnedRefiner.of(random_content("stereovae"), backend=backend)
    start, wrong = threading.Barrier(4), []

    def work(k):
        start.wait()
        for _ in range(8):
            found = fresh(coarse_of(sizes[k], k), image_of(sizes[k], k)).disparity
            if not np.array_equal(found, expected[k]):
                wrong.append(k)

    workers = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not wrong


def test_more_sizes_than_are_kept_compiled_give_what_they_did():
    backend = next((b for b in ("onnxruntime", "torch", "openvino") if pytest.importorskip(b)), None)
    refiner = LearnedRefiner.of(random_content("cnn"), backend=backend)
    sizes = [(8 * k, 16) for k in range(1, 8)]
    first = [refiner(coarse_of(s), image_of(s)).disparity for s in sizes]
    for size, expected in zip(sizes, first, strict=True):
        np.testing.assert_array_equal(refiner(coarse_of(size), image_of(size)).disparity, expected)
    assert len(refiner._compiled._held) <= 4
