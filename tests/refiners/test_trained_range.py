"""Learned refiners away from their training: large offsets, blank images, disparities beyond what they have seen."""

from __future__ import annotations

import dataclasses
import warnings

import cv2
import numpy as np
import pytest
from refining import NAMES, coarse_of, image_of, random_content, sure, tuned_to_kitti

import stereokit
from stereokit import Matcher
from stereokit.errors import StereokitWarning
from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.linear import Linear
from stereokit_refiners.runtimes.encode import BEGINNING, base_of

HEIGHT, WIDTH = 128, 512
OFFSETS = (0, 60, 120, 200)
"""Added to all disparities, pixels."""


class Keeper:
    """A refiner that keeps what it is given."""

    needs_confidence = needs_candidates = True

    def __call__(self, coarse, left, *, threads=1):
        self.arguments = coarse, left.copy()
        return stereokit.REFINERS.get("linear")()(coarse, left, threads=threads)


@pytest.fixture(scope="module")
def coarse_maps():
    """Return the true disparity of a scene, 6 to 44 px, and S4's half-size maps and left image by offset."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    truth = 6 + 30 * (y / HEIGHT) ** 2 + 8 * ((x > 300) & (x < 380) & (y > 40)).astype(np.float32)
    coarse = np.kron(rng.normal(size=(HEIGHT // 4, WIDTH // 4 + 100)), np.ones((4, 4))) * 40
    texture = cv2.GaussianBlur(coarse + rng.normal(size=coarse.shape) * 30, (0, 0), 0.9).astype(np.float32) + 120
    actual = {}
    for offset in OFFSETS:
        # The left view stays, the right one shows what lies further to the right.
        views = (
            cv2.remap(texture, x + 150 - truth, y, cv2.INTER_LINEAR),
            texture[:, 150 + offset : 150 + offset + WIDTH],
        )
        noisy = [view + rng.normal(size=view.shape) * 2 for view in views]
        keeper = Keeper()
        matcher = Matcher("S4", max_disparity=256, scale=0.5, refiner=keeper)
        matcher(*(np.clip(np.rint(view), 0, 255).astype(np.uint8) for view in noisy))
        actual[offset] = keeper.arguments
    return truth, actual


@pytest.mark.parametrize("name", ["linear", *NAMES])
def test_an_offset_of_all_disparities_hardly_changes_the_error(coarse_maps, name):
    truth, maps = coarse_maps
    refiner = Linear() if name == "linear" else LearnedRefiner.of(tuned_to_kitti(name), precision="fp32")
    errors = {offset: (refiner(*maps[offset]).disparity - truth - offset)[:, offset + 60 :] for offset in OFFSETS}
    medians = {offset: float(np.median(error)) for offset, error in errors.items()}
    wrong = {offset: np.mean(np.abs(error) > 2) for offset, error in errors.items()}
    for offset in OFFSETS[1:]:
        assert abs(medians[offset] - medians[0]) < 0.15, medians
        assert wrong[offset] < wrong[0] + 0.04, wrong


def test_maps_are_lowered_only_if_they_begin_above_those_of_the_training():
    rng = np.random.default_rng(4)
    rough = rng.uniform(3, 40, (50, 80)).astype(np.float32)
    assert base_of([rough]) == 0
    for offset in (5, 60, 500):
        moved = rough + np.float32(offset)
        first = np.sort(moved[:, min(int(np.ceil(np.sort(moved, axis=None)[1999])), 40) :], axis=None)[40]
        assert base_of([moved]) == np.floor(first - BEGINNING)
    hidden = rough + 60
    hidden[:, :20] = 1  # columns that lie outside the right view at such disparities
    assert base_of([hidden]) >= 55
    assert base_of([rough - 10, rough]) == np.floor(rough.min() - 10)
    assert base_of([rough, rough - 10]) == np.floor(rough.min() - 10)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("offset", [0, 33, 400, -20])
def test_tensors_are_lowered_as_arrays_are(name, offset):
    pytest.importorskip("torch")
    from stereokit_refiners.runtimes.tensors import TensorRefiner

    content = random_content(name)
    coarse = coarse_of((34, 50), low=8, high=20)
    coarse = dataclasses.replace(
        coarse, disparity=coarse.disparity + np.float32(offset), candidates=coarse.candidates + np.float32(offset)
    )
    arrays = LearnedRefiner.of(content, precision="fp32")(coarse, image_of((34, 50))).disparity
    tensors = TensorRefiner(content, "cpu")(coarse.disparity, coarse.confidence, image_of((34, 50)), coarse.candidates)
    np.testing.assert_allclose(tensors.numpy(), arrays, rtol=0, atol=2e-3)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("low", "high"), [(0, 64), (0, 8), (200, 264), (-64, 0)])
def test_blank_images_stay_inside_the_range(name, low, high):
    blank = np.full((64, 96), 255, np.uint8)
    noise = np.random.default_rng(5).integers(0, 256, blank.shape, np.uint8)
    matcher = Matcher(
        "S2", min_disparity=low, max_disparity=high, scale=0.5, refiner=LearnedRefiner.of(tuned_to_kitti(name))
    )
    for left, right in ((blank, blank), (blank // 2, blank), (noise, blank)):
        disparity = matcher(left, right).disparity
        assert low <= disparity.min() and disparity.max() <= high


@pytest.mark.parametrize("name", NAMES)
def test_nothing_lies_beyond_what_the_matcher_has_found(name):
    coarse, left = coarse_of((34, 50)), image_of((34, 50))
    fine = LearnedRefiner.of(random_content(name, last=50.0), precision="fp32")(coarse, left)
    maps = [coarse.disparity, coarse.candidates] if name == "pyramid" else [coarse.disparity]
    low, high = 2 * float(min(one.min() for one in maps)), 2 * float(max(one.max() for one in maps))
    assert fine.disparity.min() >= low - 1e-4 and fine.disparity.max() <= high + 1e-4
    assert (fine.disparity == np.float32(low)).any() or (fine.disparity == np.float32(high)).any()


def messages(call):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return [str(one.message) for one in caught if issubclass(one.category, StereokitWarning)]


def test_disparities_beyond_the_training_are_warned_of_once():
    content = random_content("cnn")
    ramp = np.repeat(np.linspace(3, 90, 32, dtype=np.float32)[:, None], 48, axis=1)  # to 180 px
    left = image_of((64, 96))
    refiner = LearnedRefiner.of(content, precision="fp32")
    assert refiner.trained_disparities == (0, 128)
    notices = messages(lambda: refiner(sure(ramp), left))
    assert len(notices) == 1 and "128 px" in notices[0] and "linear" in notices[0] and "\n" not in notices[0]
    assert messages(lambda: refiner(sure(ramp), left)) == []  # once is enough
    wider = dataclasses.replace(content, notes={"disparities": [0, 256]})
    refiner = LearnedRefiner.of(wider, precision="fp32")
    assert refiner.trained_disparities == (0, 256)
    assert messages(lambda: refiner(sure(ramp), left)) == []
    far = LearnedRefiner.of(content, precision="fp32")  # lowered, they lie within
    assert messages(lambda: far(sure(ramp / 2 + 200), left)) == []
