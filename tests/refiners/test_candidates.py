"""The matcher's candidates on their whole way through a refiner: what a head chooses comes out, where it belongs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from refining import LEARNED, NAMES, coarse_of, half_of, image_of, random_content

from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.linear import Linear
from stereokit_refiners.networks.pyramid import OFFSETS
from stereokit_refiners.weights import NETWORKS

SIZES = [(16, 32), (33, 47), (1, 1), (1, 9), (9, 1), (18, 31)]
CHOICES = [(0, 0, 0, 0), (1, 1, 1, 1), (0, 1, 1, 0), (1, 0, 0, 0)]
"""Which candidate each of the four phases takes: above left, above right, below left, below right."""


def choosing(choice):
    """Return weights of which each phase takes the candidate of `choice`, whatever the network sees."""
    content = random_content("pyramid", last=0.0)
    bias = content.arrays["head.bias"]
    bias[:] = 0
    bias[0] = 5  # corrects the coarse values, not the candidates
    for phase, k in enumerate(choice):
        bias[5 + 4 * (len(OFFSETS) + k) + phase] = 60
    return content


def chosen(candidates, choice, size):
    out = np.empty(size, np.float32)
    for y in range(size[0]):
        for x in range(size[1]):
            out[y, x] = 2 * candidates[choice[2 * (y % 2) + x % 2], y // 2, x // 2]
    return out


def test_there_are_two_beside_the_values_around():
    assert len(OFFSETS) + 2 == NETWORKS["pyramid"].outputs["residual"].values
    assert NETWORKS["pyramid"].inputs["candidates"] == 2
    assert NETWORKS["pyramid"].layers[-1].outputs == 5 + 4 * (len(OFFSETS) + 2)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("choice", CHOICES)
@pytest.mark.parametrize("backend", LEARNED)
def test_a_phase_that_is_sure_of_a_candidate_copies_it(backend, choice, size):
    coarse, left = coarse_of(size, 1), image_of(size, 1)
    refiner = LearnedRefiner.of(choosing(choice), backend=backend, precision="fp32")
    expected = chosen(coarse.candidates, choice, size)
    np.testing.assert_allclose(refiner(coarse, left, threads=2).disparity, expected, rtol=1e-6)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("choice", CHOICES)
def test_tensors_copy_the_same_candidate(choice, size):
    pytest.importorskip("torch")
    from stereokit_refiners.runtimes.tensors import TensorRefiner

    coarse = coarse_of(size, 1)
    arguments = coarse.disparity, coarse.confidence, image_of(size, 1), coarse.candidates
    actual = TensorRefiner(choosing(choice), "cpu")(*arguments).numpy()
    np.testing.assert_allclose(actual, chosen(coarse.candidates, choice, size), rtol=1e-6)


@pytest.mark.parametrize("choice", CHOICES)
def test_exported_graphs_copy_the_same_candidate(choice):
    onnxruntime = pytest.importorskip("onnxruntime")
    from stereokit_refiners.commands.export import onnx_model

    size = (16, 32)
    coarse, left = coarse_of(size, 1), image_of(size, 1).astype(np.float32)
    arguments = {
        "coarse": coarse.disparity,
        "confidence": coarse.confidence,
        "left": left,
        "candidates": coarse.candidates,
    }
    session = onnxruntime.InferenceSession(onnx_model(choosing(choice)), providers=["CPUExecutionProvider"])
    (actual,) = session.run(None, {k: v.reshape(1, -1, *v.shape[-2:]) for k, v in arguments.items()})
    np.testing.assert_allclose(actual[0, 0], chosen(coarse.candidates, choice, size), rtol=1e-6)


def test_candidates_do_not_fill_gaps_of_the_map():
    size = (24, 40)
    coarse, left = coarse_of(size, 2, gaps=0.2), image_of(size, 2)
    fine = LearnedRefiner.of(choosing((0, 1, 1, 0)), precision="fp32")(coarse, left)
    gap = np.isnan(coarse.disparity).repeat(2, 0).repeat(2, 1)
    assert gap.any() and not gap.all()
    expected = np.where(gap, np.nan, chosen(coarse.candidates, (0, 1, 1, 0), size))
    np.testing.assert_allclose(fine.disparity, expected, rtol=1e-6)


@pytest.mark.parametrize("size", [(16, 32), (18, 31)])
def test_candidates_are_read_in_any_layout(size):
    coarse, left = coarse_of(size, 3), image_of(size, 3)
    refiner = LearnedRefiner.of(random_content("pyramid"), precision="fp32")
    expected = refiner(coarse, left).disparity
    wide = np.zeros((2, *half_of(size), 3), np.float32)
    wide[..., 1] = coarse.candidates
    for other in (np.asfortranarray(coarse.candidates), wide[..., 1], coarse.candidates[::-1].copy()[::-1]):
        assert not other.flags.c_contiguous
        actual = refiner(dataclasses.replace(coarse, candidates=other), left).disparity
        np.testing.assert_array_equal(actual, expected)


@pytest.mark.parametrize("name", NAMES)
def test_refiners_say_whether_they_need_them(name):
    assert LearnedRefiner.of(random_content(name)).needs_candidates is (name == "pyramid")


def test_upscaling_does_not_look_at_them():
    assert not getattr(Linear(), "needs_candidates", False)
    coarse, left = coarse_of((17, 24)), image_of((17, 24))
    bare = dataclasses.replace(coarse, candidates=None)
    np.testing.assert_array_equal(Linear()(bare, left).disparity, Linear()(coarse, left).disparity)
