"""Learned refiners inside a matcher: by name, by weight file, as objects; options, sequences, the command line."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
from refining import LEARNED, NAMES, one_line, random_content, tuned_to_kitti, weight_file
from typer.testing import CliRunner

import stereokit
from stereokit.cli.app import app
from stereokit.errors import OptionError, StereokitError
from stereokit_refiners.learned import LearnedRefiner

METHOD = {"method": "census+sgm", "max_disparity": 24, "scale": 0.5}


@pytest.fixture
def pair():
    rng = np.random.default_rng(0)
    right = cv2.GaussianBlur(rng.integers(0, 256, (41, 70)).astype(np.uint8), (0, 0), 0.8)
    return np.roll(right, 6, axis=1), right


@pytest.fixture
def path(tmp_path):
    return weight_file(tmp_path, "stereovae")


def matcher(**arguments):
    return stereokit.Matcher(**{**METHOD, **arguments})


class Keeping:
    """A refiner that keeps what it was given."""

    needs_candidates = True

    def __call__(self, coarse, left, *, threads=1):
        self.coarse, self.left, self.threads = coarse, left, threads
        return stereokit.Disparity(np.zeros(left.shape, np.float32), np.ones(left.shape, bool))


def test_a_name_with_weights_a_file_and_an_object_are_the_same(pair, path):
    by_file = matcher(refiner=path)
    results = [
        by_file(*pair),
        matcher(refiner="stereovae", weights=path)(*pair),
        matcher(refiner="StereoVAE", weights=path)(*pair),
        matcher(refiner="file", weights=path)(*pair),
        matcher(refiner=LearnedRefiner(path))(*pair),
        matcher(refiner=LearnedRefiner.of(random_content("stereovae")))(*pair),
    ]
    for result in results:
        assert result.disparity.shape == pair[0].shape
        np.testing.assert_array_equal(result.disparity, results[0].disparity)
    assert by_file.refiner == path
    linear = matcher()(*pair).disparity
    assert np.abs(results[0].disparity - linear).max() > 0.05


def test_the_refiner_sees_the_half_size_map_and_the_full_size_image(pair, path):
    keeping = Keeping()
    matcher(refiner=keeping, confidence=True, threads=2)(*pair)
    assert keeping.coarse.disparity.shape == (21, 35)
    np.testing.assert_array_equal(keeping.left, pair[0])
    assert keeping.threads == 2
    expected = LearnedRefiner(path)(keeping.coarse, pair[0])
    actual = matcher(refiner=path, confidence=True)(*pair)
    np.testing.assert_array_equal(actual.disparity, expected.disparity)
    np.testing.assert_array_equal(actual.confidence, expected.confidence)


@pytest.mark.parametrize("name", NAMES)
def test_a_matcher_gives_the_confidence_and_keeps_it_back_unless_asked(pair, tmp_path, name):
    path, keeping = weight_file(tmp_path, name), Keeping()
    matcher(refiner=keeping, confidence=True)(*pair)
    expected = LearnedRefiner(path)(keeping.coarse, pair[0])
    plain, asked = (matcher(refiner=path, confidence=confidence)(*pair) for confidence in (False, True))
    for actual in (plain, asked):
        np.testing.assert_array_equal(actual.disparity, expected.disparity)
        np.testing.assert_array_equal(actual.valid, expected.valid)
    assert plain.confidence is None
    np.testing.assert_array_equal(asked.confidence, expected.confidence)
    assert [r.confidence for r in matcher(refiner=path, threads=2).map([pair] * 3)] == [None] * 3


@pytest.mark.parametrize("name", NAMES)
def test_refiners_by_name_with_a_collection_of_weights(pair, name):
    tuned_to_kitti(name)
    result = matcher(refiner=name, weights="kitti")(*pair)
    assert result.disparity.shape == pair[0].shape
    assert np.isfinite(result.disparity).all()


@pytest.mark.parametrize("backend", LEARNED)
def test_options_reach_the_refiner(pair, path, backend):
    subject = matcher(refiner=path, backend=backend, precision="fp32")
    assert (subject.refine.backend, subject.refine.precision) == (backend, "fp32")
    expected = LearnedRefiner(path, backend=backend, precision="fp32").fingerprint
    assert subject.refine.fingerprint == expected
    assert subject(*pair).disparity.shape == pair[0].shape


def test_unknown_options_are_refused_with_the_known_ones(path):
    with pytest.raises(OptionError) as caught:
        matcher(refiner=path, precison="fp32")
    text = one_line(caught.value)
    for word in ("precison", "precision", "backend", "p1"):
        assert word in text
    with pytest.raises(OptionError, match="backend"):
        matcher(backend="torch")  # linear has none
    with pytest.raises(OptionError, match="backend"):
        matcher(refiner=LearnedRefiner(path), backend="torch")  # an object has its own
    with pytest.raises(OptionError, match=r"^refiner '.*' needs scale=0\.5, got scale=1"):
        matcher(refiner=path, scale=1)


@pytest.mark.parametrize("refiner", [7, 1.5, ["stereovae"], b"stereovae"])
def test_refiners_that_are_none(refiner):
    with pytest.raises(OptionError, match=r"^refiner must be a name, a weight file or callable, got "):
        matcher(refiner=refiner)


def test_errors_come_when_the_matcher_is_made(tmp_path, path):
    cases = {
        "no refiner named 'sterovae'; did you mean 'stereovae'": {"refiner": "sterovae"},
        "not there": {"refiner": str(tmp_path / "none.safetensors")},
        "must be one of auto, openvino": {"refiner": path, "backend": "tensorrt"},
        "must be one of auto, fp32": {"refiner": path, "precision": "fp8"},
        "must be its own": {"refiner": "cnn", "weights": path},
    }
    for message, arguments in cases.items():
        with pytest.raises(StereokitError, match=message) as caught:
            matcher(**arguments)
        one_line(caught.value)


@pytest.mark.parametrize("weights", [7, 1.5, ["a"]])
def test_weights_that_are_no_path(weights):
    with pytest.raises(StereokitError, match="weights"):
        matcher(refiner="cnn", weights=weights)


def test_a_sequence_is_single_calls_in_order(path):
    rng = np.random.default_rng(2)
    sizes = [(40, 64), (40, 64), (33, 47), (40, 64), (16, 50), (40, 64)]
    pairs = [tuple(rng.integers(0, 256, (2, *size)).astype(np.uint8)) for size in sizes]
    subject = matcher(refiner=path, threads=2)
    expected = [matcher(refiner=path, threads=1)(*p) for p in pairs]
    actual = list(subject.map(pairs))
    assert len(actual) == len(pairs)
    for one, other in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(one.disparity, other.disparity)
        np.testing.assert_array_equal(one.valid, other.valid)


def test_match_uses_the_refiner_that_it_is_given(pair):
    options = {**METHOD, "method": "census+sgm"}
    refiners = [LearnedRefiner.of(random_content("cnn", seed, last=0.5)) for seed in (0, 1)]
    actual = [stereokit.match(*pair, refiner=refiner, **options) for refiner in refiners]
    expected = [matcher(refiner=refiner)(*pair).disparity for refiner in refiners]
    np.testing.assert_array_equal(actual[0], expected[0])
    np.testing.assert_array_equal(actual[1], expected[1])


def test_gaps_survive_without_fill(pair, path):
    coarse_gaps = matcher(fill=None, median=0, smp=True)(*pair)
    actual = matcher(refiner=path, fill=None, median=0, smp=True)(*pair)
    assert np.isnan(actual.disparity).any()
    assert not actual.valid[np.isnan(actual.disparity)].any()
    assert np.isnan(coarse_gaps.disparity[np.isnan(actual.disparity)]).all()


def test_negative_ranges_and_color_pairs(pair, path):
    actual = matcher(refiner=path, min_disparity=-16)(*(np.dstack([view] * 3) for view in pair))
    assert actual.disparity.shape == pair[0].shape
    assert np.isfinite(actual.disparity).all()


def test_the_right_view_is_refined_too(pair, path):
    actual = matcher(refiner=path, right=True)(*pair)
    mirrored = matcher(refiner=path)(pair[1][:, ::-1].copy(), pair[0][:, ::-1].copy())
    np.testing.assert_array_equal(actual.right, mirrored.disparity[:, ::-1])


def test_a_pickled_matcher_is_the_same(pair, path):
    subject = matcher(refiner=path)
    again = pickle.loads(pickle.dumps(subject))
    np.testing.assert_array_equal(again(*pair).disparity, subject(*pair).disparity)


def test_the_command_match_takes_a_weight_file(pair, path, tmp_path):
    names = [str(tmp_path / f"{side}.png") for side in ("left", "right")]
    for name, view in zip(names, pair, strict=True):
        cv2.imwrite(name, view)
    out = tmp_path / "map.npy"
    options = ["--method", "census+sgm", "--max-disparity", "24", "--scale", "0.5", "--set", "precision=fp32"]
    result = CliRunner().invoke(app, ["match", *names, "-o", str(out), "--refiner", path, *options])
    assert result.exit_code == 0, result.output
    np.testing.assert_array_equal(np.load(out), matcher(refiner=path, precision="fp32")(*pair).disparity)
    missing = str(tmp_path / "none.safetensors")
    result = CliRunner().invoke(app, ["match", *names, "-o", str(tmp_path / "b.npy"), "--refiner", missing, *options])
    assert result.exit_code == 2
    assert next(line for line in result.output.splitlines() if line).startswith("error: weights must name a file")
    assert not (tmp_path / "b.npy").exists()
