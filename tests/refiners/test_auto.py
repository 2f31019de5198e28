"""The refiner "auto": which of the two it takes, and that it is that one to the bit."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from refining import coarse_of, image_of

import stereokit
from stereokit.errors import OptionError, StereokitError, StereokitWarning
from stereokit_refiners.auto import SMALLEST, AutoRefiner
from stereokit_refiners.general import EvidenceRefiner
from stereokit_refiners.linear import Linear
from stereokit_refiners.runtimes import choice


def maps_of(refiner, size, scale=0.5):
    images = [np.roll(image_of(size, 1), -shift, axis=1) for shift in (0, 4)]
    matcher = stereokit.Matcher("S2", max_disparity=16, scale=scale, refiner=refiner, confidence=True, device="cpu")
    result = matcher(*images)
    return result.disparity, result.valid, result.confidence


@pytest.mark.parametrize("scale", [1, 0.5, 0.25])
@pytest.mark.parametrize("size", [(SMALLEST, 80), (SMALLEST - 1, 80), (80, SMALLEST - 1), (70, 90)])
def test_it_is_the_general_one_but_for_small_images(size, scale):
    other = Linear() if min(size) < SMALLEST else EvidenceRefiner(precision="fp32")
    for one, expected in zip(
        maps_of(AutoRefiner(precision="fp32"), size, scale), maps_of(other, size, scale), strict=True
    ):
        np.testing.assert_array_equal(one, expected)


def test_it_is_linear_with_one_warning_where_nothing_computes_the_network_rightly(monkeypatch):
    monkeypatch.setattr(choice, "_sound", {})
    monkeypatch.setattr(choice, "mistake", lambda *arguments: 5.0)
    with pytest.warns(StereokitWarning, match=r"^refiner 'auto' is linear: no runtime here computes") as messages:
        refiner = AutoRefiner()
    assert len(messages) == 1 and refiner.general is None and not refiner.needs_right and not refiner.needs_candidates
    coarse, left = coarse_of((64, 80)), image_of((64, 80))
    np.testing.assert_array_equal(refiner(coarse, left).disparity, Linear()(coarse, left).disparity)
    assert refiner.fingerprint == "linear"


def test_it_is_linear_where_no_runtime_is_installed(monkeypatch):
    monkeypatch.setattr(choice, "_installed", list)
    with pytest.warns(StereokitWarning, match=r"^refiner 'auto' is linear: learned refiners need"):
        assert AutoRefiner().general is None


def test_a_wrong_option_is_no_reason_to_be_linear():
    with pytest.raises(OptionError, match="backend must be one of"):
        stereokit.Matcher("S2", scale=0.5, refiner="auto", backend="tensorrt")
    with pytest.raises(StereokitError, match="weights"):
        stereokit.Matcher("S2", scale=0.5, refiner="auto", weights="kitti")


def test_it_is_a_refiner_by_name_told_apart_and_pickled():
    matcher = stereokit.Matcher("S2", max_disparity=16, scale=0.25, refiner="auto")
    assert isinstance(matcher.refine, AutoRefiner) and matcher.refine.needs_right
    assert matcher.identity()["weights"] == AutoRefiner().fingerprint != EvidenceRefiner().fingerprint
    copy = pickle.loads(pickle.dumps(matcher))
    assert copy.identity() == matcher.identity()
