"""Training samples: variants are functions of their name, crops keep map, image and truth together."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

import stereokit
from stereokit_refiners.training import samples
from stereokit_refiners.training.samples import Pair, Sample, crop, make_variant, whole

NAN = np.nan
FIELDS = ("disparity", "confidence", "candidates", "left", "truth", "weight")


def pair_of(size=(72, 120), shift=10, seed=0):
    """Return a textured pair of one disparity, with some truth missing and some of hidden pixels only."""
    rng = np.random.default_rng(seed)
    right = cv2.GaussianBlur(rng.integers(0, 256, size).astype(np.uint8), (0, 0), 1.0)
    right = cv2.normalize(right, None, 20, 235, cv2.NORM_MINMAX)
    left = np.roll(right, shift, axis=1)
    occ = np.full(size, shift, np.float32)
    occ[: size[0] // 4] = NAN
    noc = occ.copy()
    noc[:, : size[1] // 6] = NAN  # dense enough to be no map of objects
    return Pair("frame", left, right, noc, occ)


@pytest.fixture(scope="module")
def pair():
    return pair_of()


@pytest.fixture(scope="module")
def sample(pair):
    return make_variant(pair, "S2", 0, 0, 32)


def arrays(sample):
    return {f.name: np.asarray(getattr(sample, f.name)) for f in dataclasses.fields(sample)}


def assert_same(one, other):
    for name, array in arrays(one).items():
        actual = arrays(other)[name]
        assert actual.dtype == array.dtype, name
        np.testing.assert_array_equal(actual, array, err_msg=name)
    assert one.size == other.size


class Keeping:
    needs_candidates = True

    def __call__(self, coarse, left, *, threads=1):
        self.coarse = coarse
        return stereokit.Disparity(np.zeros(left.shape, np.float32), np.ones(left.shape, bool))


# --- variants ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(72, 120), (71, 119)])
@pytest.mark.parametrize(("method", "levels"), [("S2", 32), ("S4", 32), ("S4", 37), ("S1", 32), ("S3", 32)])
def test_variant_0_is_what_a_half_size_matcher_computes_inside(method, levels, size):
    pair = pair_of(size)
    keeping = Keeping()
    options = {"max_disparity": levels, "scale": 0.5, "refiner": keeping, "confidence": True}
    stereokit.Matcher(method, **options)(pair.left, pair.right)
    actual = make_variant(pair, method, 0, 0, levels)
    expected = np.clip(np.rint(keeping.coarse.disparity * 256), 0, 65535).astype(np.uint16)
    np.testing.assert_array_equal(actual.coarse, expected)
    original = np.clip(np.rint(keeping.coarse.candidates * 256), 0, 65535)
    assert actual.candidates.dtype == np.uint16
    np.testing.assert_array_equal(actual.candidates, original)
    assert actual.confidence.dtype == np.uint8
    np.testing.assert_array_equal(actual.confidence, np.rint(keeping.coarse.confidence * 255))
    assert (actual.confidence[~keeping.coarse.valid] == 0).all() and len(np.unique(actual.confidence)) > 20
    assert actual.size == size
    np.testing.assert_array_equal(actual.left[: size[0], : size[1]], pair.left)


def test_variant_0_does_not_depend_on_the_seed(pair, sample):
    assert_same(make_variant(pair, "S2", 99, 0, 32), sample)


def test_the_truth_is_kept_in_256ths_and_hidden_pixels_are_told_apart(pair, sample):
    both, hidden, unknown = np.isfinite(pair.noc), np.isnan(pair.noc) & np.isfinite(pair.occ), np.isnan(pair.occ)
    assert both.any() and hidden.any() and unknown.any()
    assert (sample.truth[both] == 10 * 256).all() and sample.seen[both].all()
    assert (sample.truth[hidden] == 10 * 256).all() and not sample.seen[hidden].any()
    assert (sample.truth[unknown] == 0).all() and not sample.seen[unknown].any()


def test_a_pixel_with_two_truths_takes_that_of_both_cameras(pair):
    mixed = Pair("x", pair.left, pair.right, pair.noc, np.where(np.isfinite(pair.occ), pair.occ + 5, NAN))
    mixed.occ.astype(np.float32)
    actual = make_variant(dataclasses.replace(mixed, occ=mixed.occ.astype(np.float32)), "S2", 0, 0, 32)
    assert set(np.unique(actual.truth[actual.seen])) == {10 * 256}
    assert set(np.unique(actual.truth[~actual.seen])) == {0, 15 * 256}


def test_odd_sizes_are_extended_by_pixels_without_truth():
    actual = make_variant(pair_of((71, 119)), "S2", 0, 0, 32)
    assert actual.left.shape == actual.truth.shape == (72, 120)
    assert actual.coarse.shape == (36, 60)
    assert (actual.truth[71] == 0).all() and (actual.truth[:, 119] == 0).all()
    np.testing.assert_array_equal(actual.left[71], actual.left[70])
    np.testing.assert_array_equal(actual.left[:, 119], actual.left[:, 118])


@pytest.mark.parametrize("number", [1, 2, 3])
def test_variants_are_functions_of_pair_method_seed_and_number(pair, number):
    first = make_variant(pair, "S2", 4, number, 32)
    assert_same(make_variant(pair, "S2", 4, number, 32), first)
    for seed, other in ((5, number), (4, number + 1)):
        changed = make_variant(pair, "S2", seed, other, 32)
        assert changed.coarse.shape != first.coarse.shape or (changed.coarse != first.coarse).any()
    assert first.coarse.shape == (first.left.shape[0] // 2, first.left.shape[1] // 2)


def test_rescaling_scales_the_truth_with_the_width(pair):
    widths = set()
    for number in range(1, 9):
        actual = make_variant(pair, "S2", 1, number, 64)
        rows, columns = actual.size
        widths.add(columns)
        assert 64 <= columns <= round(120 * 1.6) and 64 <= rows <= round(72 * 1.6)
        known = actual.truth[:rows, :columns]
        np.testing.assert_allclose(known[known > 0] / 256, 10 * columns / 120, atol=1 / 256)
        share = 0.75 if number % 2 else 0.75 * 100 / 120  # mirrored, what both cameras see
        assert abs((known > 0).mean() - share) < 0.05
    assert len(widths) > 4


def test_the_coarse_map_of_a_variant_still_fits_its_truth(pair):
    for number in range(1, 5):
        actual = make_variant(pair, "S2", 2, number, 64)
        columns = actual.size[1]
        inner = actual.coarse[:, 14:-4] / 128  # beyond what is hidden by the border
        assert np.mean(np.abs(inner - 10 * columns / 120) < 1.5) > 0.9


def test_every_other_variant_is_of_the_mirrored_pair_and_all_but_0_are_changed_before_matching(pair, monkeypatch):
    steps, calls = ("mirrored", "copy_paste", "rescaled", "photographed"), []

    def spied(name):
        real = getattr(samples, name)

        def step(*arguments):
            calls.append(name)
            return real(*arguments)

        return step

    for name in steps:
        monkeypatch.setattr(samples, name, spied(name))
    for number in range(5):
        calls.clear()
        make_variant(pair, "S2", 0, number, 32)
        assert calls == ([] if number == 0 else list(steps[number % 2 :]))


def test_the_pair_is_not_modified(pair):
    original = [np.copy(a) for a in (pair.left, pair.right, pair.noc, pair.occ)]
    make_variant(pair, "S2", 0, 1, 32)
    for before, after in zip(original, (pair.left, pair.right, pair.noc, pair.occ), strict=True):
        np.testing.assert_array_equal(before, after)


def test_options_of_the_matcher_are_valid_for_every_method():
    pair = pair_of((64, 80))
    for method in ("S1", "S2", "S3", "S4", "zncc+sgm"):
        for number in (1, 2):
            assert make_variant(pair, method, number, number, 32).coarse.size


def test_digests_tell_pairs_apart(pair):
    assert pair.digest == pair_of().digest
    assert pair.digest == dataclasses.replace(pair, name="other").digest
    changed = pair.left.copy()
    changed[3, 3] ^= 1
    assert dataclasses.replace(pair, left=changed).digest != pair.digest
    assert dataclasses.replace(pair, occ=pair.noc).digest != pair.digest


# --- crops ---------------------------------------------------------------------------------------------------------


def test_weights_are_2_1_and_0(pair, sample):
    part = whole(sample, 4)
    both, hidden = np.isfinite(pair.noc), np.isnan(pair.noc) & np.isfinite(pair.occ)
    expected = np.where(both, 2, np.where(hidden, 1, 0))
    np.testing.assert_array_equal(part.weight, expected)
    assert part.weight.dtype == np.float32
    np.testing.assert_array_equal(part.truth, np.where(expected > 0, 10, 0))
    # The paper's first loss, |noc - Y| + |occ - Y|, each over its own known pixels.
    y = np.random.default_rng(0).random(pair.noc.shape) * 20
    printed = np.nansum(np.abs(pair.noc - y)) + np.nansum(np.abs(pair.occ - y))
    assert (np.abs(part.truth - y) * part.weight).sum() == pytest.approx(printed, rel=1e-6)


def numbered(rows, columns):
    """Return a sample in which every value says where it is."""
    y, x = np.indices((rows, columns))
    large_y, large_x = np.indices((2 * rows, 2 * columns))
    coarse = (256 * y + x + 1).astype(np.uint16)
    truth = (128 * large_y + large_x + 1).astype(np.uint16)
    left = ((large_y + large_x) % 200 + 20).astype(np.uint8)
    confidence = (coarse * 37 % 256).astype(np.uint8)
    candidates = np.stack([coarse + 7, coarse * 3 % 5000]).astype(np.uint16)
    return Sample(coarse, confidence, candidates, left, truth, truth % 5 > 0, (2 * rows, 2 * columns))


def assert_extended(actual, original):
    """Check candidates in full-size pixels against those of a sample, whose border stands for what is beyond it."""
    _, rows, columns = original.shape
    for k, y, x in np.ndindex(actual.shape):
        assert actual[k, y, x] == original[k, min(y, rows - 1), min(x, columns - 1)] / 128


def test_crops_keep_map_truth_and_mask_together():
    sample = numbered(20, 30)
    places = set()
    for seed in range(40):
        part = crop(sample, 8, 16, np.random.default_rng(seed))
        value = round(float(part.disparity[0, 0]) * 128)
        y, x = (value - 1) // 256, (value - 1) % 256
        places.add((y, x))
        np.testing.assert_array_equal(part.disparity, sample.coarse[y : y + 8, x : x + 16] / 128)
        np.testing.assert_allclose(part.confidence, sample.confidence[y : y + 8, x : x + 16] / 255, rtol=1e-6)
        np.testing.assert_array_equal(part.candidates, sample.candidates[:, y : y + 8, x : x + 16] / 128)
        large = np.s_[2 * y : 2 * y + 16, 2 * x : 2 * x + 32]
        np.testing.assert_array_equal(part.truth, sample.truth[large] / 256)
        np.testing.assert_array_equal(part.weight, np.where(sample.seen[large], 2, 1))
        assert part.left.shape == (16, 32)
        assert part.left.dtype == np.float32
        assert 0 <= part.left.min() <= part.left.max() <= 255
    assert len(places) > 30
    assert {y for y, _ in places} >= {0, 12} and {x for _, x in places} >= {0}
    assert max(x for _, x in places) <= 14


def test_crops_change_the_exposure_only_and_by_a_rising_curve():
    sample = numbered(12, 12)
    gains = []
    for seed in range(8):
        part = crop(sample, 12, 12, np.random.default_rng(seed))
        order = np.argsort(sample.left, axis=None, kind="stable")
        seen = part.left.ravel()[order]
        assert (np.diff(seen) >= -1e-3).all()
        gains.append(np.abs(part.left - sample.left).max())
    assert max(gains) > 5
    assert part.truth.tobytes() == crop(sample, 12, 12, np.random.default_rng(99)).truth.tobytes()


def test_the_same_random_state_is_the_same_crop():
    sample = numbered(20, 30)
    one, other = (crop(sample, 8, 8, np.random.default_rng(3)) for _ in range(2))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_small_samples_are_extended_without_weight():
    sample = numbered(5, 20)
    part = crop(sample, 8, 24, np.random.default_rng(0))
    assert part.disparity.shape == part.confidence.shape == part.candidates.shape[1:] == (8, 24)
    assert_extended(part.candidates, sample.candidates)
    assert part.left.shape == part.truth.shape == part.weight.shape == (16, 48)
    assert (part.weight[:10, :40] > 0).all()
    assert (part.weight[10:] == 0).all() and (part.weight[:, 40:] == 0).all()
    assert (part.truth[10:] == 0).all()
    np.testing.assert_array_equal(part.confidence[5:, :20], np.tile(part.confidence[4, :20], (3, 1)))
    np.testing.assert_array_equal(part.confidence[:5, 20:], np.tile(part.confidence[:5, 19:20], (1, 4)))
    np.testing.assert_array_equal(part.disparity[:5, :20], sample.coarse / 128)
    np.testing.assert_array_equal(part.disparity[5:, :20], np.tile(part.disparity[4, :20], (3, 1)))
    assert all(getattr(part, name).dtype == np.float32 for name in FIELDS)
    taller = crop(numbered(20, 5), 8, 8, np.random.default_rng(1))
    assert taller.disparity.shape == (8, 8)


@pytest.mark.parametrize(
    ("size", "multiple", "expected"), [((5, 7), 8, (8, 8)), ((8, 16), 8, (8, 16)), ((1, 9), 4, (4, 12))]
)
def test_whole_is_everything_on_a_multiple(size, multiple, expected):
    sample = numbered(*size)
    part = whole(sample, multiple)
    rows, columns = size
    assert part.disparity.shape == expected
    assert part.left.shape == part.weight.shape == (2 * expected[0], 2 * expected[1])
    np.testing.assert_array_equal(part.disparity[:rows, :columns], sample.coarse / 128)
    np.testing.assert_allclose(part.confidence[:rows, :columns], sample.confidence / 255, rtol=1e-6)
    assert part.candidates.shape == (2, *expected) and part.candidates.dtype == np.float32
    assert_extended(part.candidates, sample.candidates)
    assert part.confidence.shape == expected and part.confidence.dtype == np.float32
    np.testing.assert_array_equal(part.left[: 2 * rows, : 2 * columns], sample.left)
    assert part.weight[2 * rows :].sum() == 0 and part.weight[:, 2 * columns :].sum() == 0
