"""The option `evidence_scale`: images of half the size are looked at, and the rest is linear."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import stereokit
from stereokit.errors import DeviceError, OptionError
from stereokit.images.resize import halved
from stereokit_refiners.auto import AutoRefiner
from stereokit_refiners.general import EvidenceRefiner
from stereokit_refiners.linear import Linear
from stereokit_refiners.weights import read, shipped, write


def images(rows, columns, seed=0):
    rng = np.random.default_rng(seed)
    return tuple(rng.integers(0, 256, (rows, columns), dtype=np.uint8) for _ in range(2))


def coarse_map(rows, columns, seed=1):
    rng = np.random.default_rng(seed)
    disparity = (rng.random((rows, columns)) * 5 + 2).astype(np.float32)
    candidates = (rng.random((2, rows, columns)) * 5 + 2).astype(np.float32)
    valid = rng.random((rows, columns)) < 0.8
    confidence = rng.random((rows, columns)).astype(np.float32)
    return stereokit.Disparity(disparity, valid, confidence, candidates=candidates)


@pytest.mark.parametrize("scale", [0.5, 0.25])
@pytest.mark.parametrize("size", [(64, 96), (53, 75), (17, 130)])
def test_the_map_is_that_of_half_size_images_upscaled_linearly(scale, size):
    left, right = images(*size)
    step = round(1 / scale)
    coarse = coarse_map(-(-size[0] // step), -(-size[1] // step))
    actual = EvidenceRefiner(precision="fp32", evidence_scale=0.5)(coarse, left, right=right, scale=scale)
    half = EvidenceRefiner(precision="fp32", refinements=1)(coarse, halved(left), right=halved(right), scale=2 * scale)
    expected = Linear()(half, left)
    np.testing.assert_array_equal(actual.disparity, expected.disparity)
    rows, columns = np.indices(size) // step
    np.testing.assert_array_equal(actual.valid, coarse.valid[rows, columns])
    np.testing.assert_array_equal(actual.confidence[actual.valid], expected.confidence[actual.valid])


def test_gaps_stay_gaps():
    left, right = images(64, 96)
    coarse = coarse_map(16, 24)
    coarse.disparity[4:8, 6:12] = np.nan
    full = EvidenceRefiner(evidence_scale=0.5)(coarse, left, right=right, scale=0.25)
    assert np.isnan(full.disparity[16:32, 24:48]).all() and not np.isnan(full.disparity[40:, 60:]).any()
    assert not full.valid[np.isnan(full.disparity)].any()


def test_a_wall_comes_out_flat_at_any_number_of_threads():
    texture = np.repeat(np.repeat(np.random.default_rng(2).integers(0, 256, (40, 80), dtype=np.uint8), 4, 0), 4, 1)
    left, right = np.ascontiguousarray(texture[:, :256]), np.ascontiguousarray(texture[:, 16:272])
    options = {"max_disparity": 64, "scale": 0.25, "refiner": "stereokit", "evidence_scale": 0.5, "device": "cpu"}
    maps = [stereokit.match(left, right, "S2", threads=threads, **options) for threads in (1, 2, 3)]
    assert abs(np.median(maps[0][:, 40:]) - 16) < 0.1
    for other in maps[1:]:
        np.testing.assert_array_equal(other, maps[0])


def test_it_is_told_apart_and_survives_a_copy(tmp_path):
    plain, half = EvidenceRefiner(), EvidenceRefiner(evidence_scale=0.5)
    assert plain != half and plain.fingerprint != half.fingerprint
    copy = pickle.loads(pickle.dumps(half))
    assert copy == half and copy.evidence_scale == 0.5
    write(tmp_path / "mine.safetensors", shipped("evidence"))
    assert read(tmp_path / "mine.safetensors").fingerprint == shipped("evidence").fingerprint
    assert EvidenceRefiner(str(tmp_path / "mine.safetensors"), evidence_scale=0.5) == half


def test_what_cannot_be_is_refused_in_one_line():
    for value in (0.25, 2, 0, True, "0.5", None):
        with pytest.raises(OptionError, match=r"^evidence_scale must be 1 or 0.5, got "):
            EvidenceRefiner(evidence_scale=value)
    left, right = images(32, 48)
    with pytest.raises(OptionError, match=r"^evidence_scale must be 1 with scale=1, got 0.5$"):
        stereokit.Matcher("S2", scale=1, refiner="stereokit", evidence_scale=0.5, max_disparity=16)
    for scale in (1 / 3, 0.125, 2, 0):
        with pytest.raises(OptionError, match=r"^scale must be 1, 0.5 or 0.25, got "):
            EvidenceRefiner()(coarse_map(8, 12), left, right=right, scale=scale)
    refiner = EvidenceRefiner(evidence_scale=0.5)
    with pytest.raises(OptionError, match="right must have the size of left"):
        refiner(coarse_map(8, 12), left, scale=0.25)
    with pytest.raises(OptionError, match="coarse map must be half the size of left"):
        refiner(coarse_map(7, 12), left, right=right, scale=0.25)
    with pytest.raises(DeviceError, match=r"^evidence_scale must be 1 for images on the device, got 0.5$"):
        refiner.on_device(coarse_map(8, 12), left, None, right=right, scale=0.25)


@pytest.mark.parametrize(("scale", "evidence_scale"), [(1, 1), (0.5, 1), (0.25, 1), (0.5, 0.5), (0.25, 0.5)])
def test_a_second_refinement_is_of_the_first_ones_map(scale, evidence_scale):
    size = (53, 75)
    left, right = images(*size)
    step = round(1 / scale)
    coarse = coarse_map(-(-size[0] // step), -(-size[1] // step))
    twice = EvidenceRefiner(precision="fp32", evidence_scale=evidence_scale, refinements=2)
    actual = twice(coarse, left, right=right, scale=scale)
    once = EvidenceRefiner(precision="fp32", refinements=1)
    views, step = (left, right), round(evidence_scale / scale)
    if evidence_scale == 0.5:
        views = halved(left), halved(right)
    first = once(coarse, views[0], right=views[1], scale=1 / step)
    rows, columns = np.indices(views[0].shape) // step
    candidates = coarse.candidates[:, rows, columns] * np.float32(step)
    again = stereokit.Disparity(first.disparity, first.valid, first.confidence, candidates=candidates)
    second = once(again, views[0], right=views[1], scale=1)
    expected = second if evidence_scale == 1 else Linear()(second, left)
    np.testing.assert_array_equal(actual.disparity, expected.disparity)
    assert np.abs(second.disparity - first.disparity).max() > 0.1
    usual = EvidenceRefiner(precision="fp32", evidence_scale=evidence_scale)(coarse, left, right=right, scale=scale)
    assert np.array_equal(usual.disparity, actual.disparity) == (scale == 1)


def test_a_number_of_refinements_that_cannot_be_is_refused():
    for value in (0, 5, 1.5, True):
        with pytest.raises(OptionError, match=r"^refinements must be"):
            EvidenceRefiner(refinements=value)
    assert pickle.loads(pickle.dumps(EvidenceRefiner(refinements=3))).refinements == 3
    prints = [EvidenceRefiner(refinements=count).fingerprint for count in (None, 1, 2)]
    assert len(set(prints)) == 3


def test_the_map_that_says_where_to_search_is_refined_once():
    left, right = images(64, 96)
    coarse = coarse_map(64, 96)
    for refiner in (EvidenceRefiner(precision="fp32"), AutoRefiner(precision="fp32")):
        searching = refiner.for_search(coarse, left, right=right, scale=1)
        once = EvidenceRefiner(precision="fp32", refinements=1)(coarse, left, right=right, scale=1)
        np.testing.assert_array_equal(searching.disparity, once.disparity)
        assert not np.array_equal(refiner(coarse, left, right=right, scale=1).disparity, once.disparity)


def test_a_match_from_coarse_to_fine_asks_for_it():
    left, right = images(64, 160)
    calls = []

    class Watched:
        needs_candidates = needs_confidence = needs_right = any_scale = True

        def __call__(self, coarse, left, **keywords):
            calls.append(("full", left.shape))
            return Linear()(coarse, left, scale=1)

        def for_search(self, coarse, left, **keywords):
            calls.append(("search", left.shape))
            return Linear()(coarse, left, scale=1)

    options = {"max_disparity": 96, "search": "coarse-to-fine", "device": "cpu"}
    stereokit.Matcher("S2", scale=1, refiner=Watched(), **options)(left, right)
    assert calls == [("search", (32, 80)), ("full", (64, 160))]


def test_refiners_say_how_much_memory_they_take():
    sizes = [EvidenceRefiner(backend=backend).bytes_per_pixel for backend in ("openvino", "opencv")]
    assert sizes[0] < sizes[1] and AutoRefiner(backend="opencv").bytes_per_pixel == sizes[1]
    assert Linear().bytes_per_pixel < 20
