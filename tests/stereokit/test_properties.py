"""Properties that hold for any images, held on examples that hypothesis draws (the same ones every time)."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stereokit
from stereokit import Matcher, RowCost, aggregate, cost_volume, match, select
from stereokit.postprocess import fill, median, remove_speckles, single_matching_phase

METHODS = sorted(stereokit.METHODS.values())
SEEDS = st.integers(0, 2**32 - 1)


def noise(seed, height, width, high=256, dtype=np.uint8):
    return np.random.default_rng(seed).integers(0, high, (height, width)).astype(dtype)


def maps(seed, height, width, gaps):
    rng = np.random.default_rng(seed)
    disparity = (rng.integers(-32, 160, (height, width)) / 16).astype(np.float32)
    disparity[rng.random((height, width)) < gaps] = np.nan
    return disparity, rng.integers(0, 6, (height, width)).astype(np.uint16)


@given(seed=SEEDS, method=st.sampled_from(METHODS), shift=st.integers(-12, 40), height=st.integers(8, 20))
def test_a_shifted_image_returns_its_shift(seed, method, shift, height):
    left = noise(seed, height, 90)
    right = np.roll(left, -shift, axis=1)
    disparity = match(left, right, method, min_disparity=-16, max_disparity=48, subpixel=False)
    seen = disparity[:, max(shift, 0) + 6 : 90 + min(shift, 0) - 6]
    assert (seen == shift).mean() > 0.99


@given(seed=SEEDS, method=st.sampled_from(METHODS), low=st.integers(-8, 4), count=st.integers(1, 40))
def test_mirrored_pairs_mirror(seed, method, low, count):
    left, right = noise(seed, 9, 31), noise(seed + 1, 9, 31)
    matcher = Matcher(method, min_disparity=low, max_disparity=low + count, right=True, fill=None)
    result, mirrored = matcher(left, right), matcher(right[:, ::-1], left[:, ::-1])
    np.testing.assert_array_equal(result.right, mirrored.disparity[:, ::-1])
    np.testing.assert_array_equal(result.disparity, mirrored.right[:, ::-1])


@pytest.mark.filterwarnings("ignore:left and right.* grey levels hold:stereokit.errors.StereokitWarning")
@given(
    seed=SEEDS,
    gains=st.tuples(st.integers(1, 30), st.integers(1, 30)),
    offsets=st.tuples(st.integers(0, 20000), st.integers(0, 20000)),
)
def test_zncc_does_not_change_under_gain_and_offset(seed, gains, offsets):
    left, right = noise(seed, 11, 23, 110, np.uint16), noise(seed + 1, 11, 23, 110, np.uint16)
    right[:, :-3] = (left[:, 3:] + right[:, :-3]) // 2
    plain = cost_volume(left, right, "zncc", window=5, max_disparity=9).astype(int)
    moved = cost_volume(left * gains[0] + offsets[0], right * gains[1] + offsets[1], "zncc", window=5, max_disparity=9)
    assert abs(moved - plain).max() <= 1  # float32 may fall on either side of a half,
    assert (moved != plain).mean() < 0.01  # which is rare


@given(seed=SEEDS, window=st.sampled_from(["5x5", "7x7", "9x7"]), data=st.data())
def test_census_does_not_change_under_monotone_maps(seed, window, data):
    left, right = noise(seed, 9, 17), noise(seed + 1, 9, 17)
    steps = np.random.default_rng(data.draw(SEEDS)).integers(1, 250, 256)
    table = np.cumsum(steps).astype(np.uint16)
    other = (np.arange(256) + 300).astype(np.uint16)
    plain = cost_volume(left, right, "census", window=window, max_disparity=9)
    moved = cost_volume(table[left], other[right], "census", window=window, max_disparity=9)
    np.testing.assert_array_equal(plain, moved)


@given(
    seed=SEEDS,
    shape=st.tuples(st.integers(1, 4), st.integers(1, 5), st.sampled_from([1, 2, 9, 63, 64, 65, 128])),
    largest=st.sampled_from([1, 30, 62, 120, 254]),  # of few sizes of the sums: each compiles kernels of its own
    share=st.floats(0, 1),
    paths=st.sampled_from([4, 5, 8]),
)
@settings(max_examples=30)
def test_worst_costs_and_penalties_never_overflow(seed, shape, largest, share, paths):
    rng = np.random.default_rng(seed)
    volume = (rng.integers(0, 2, shape) * largest).astype(np.uint8)
    p2 = 255 - largest
    p1 = int(share * p2)
    guide = noise(seed, *shape[:2])
    options = {"p1": p1, "p2": p2, "paths": paths, "edge": 60, "edge_factor": 0.5}
    total = aggregate(volume, guide, "sgm", cost=RowCost(lambda *_: None, largest), **options)
    expected = oracles.sgm(volume, p1, p2, oracles.DIRECTIONS[paths], guide, 60, 0.5)
    np.testing.assert_array_equal(total, expected)
    disparity, _, confidence = select(total)
    assert ((disparity >= 0) & (disparity < shape[2])).all()
    assert ((confidence >= 0) & (confidence <= 1)).all()


@given(seed=SEEDS, passes=st.integers(1, 5), sigma_s=st.floats(0.1, 50), sigma_r=st.floats(1, 300))
def test_the_domain_transform_stays_between_the_extremes(seed, passes, sigma_s, sigma_r):
    volume = (np.random.default_rng(seed).integers(0, 2, (5, 8, 6)) * 254).astype(np.uint8)
    options = {
        "sigma_s": sigma_s,
        "sigma_r": sigma_r,
        "passes": passes,
        "cost": RowCost(lambda *_: None, 254),
    }
    total = aggregate(volume, noise(seed, 5, 8), "dt", **options)
    assert total.min() >= 0
    assert total.max() <= 254 * 128
    confidence = select(total)[2]
    assert ((confidence >= 0) & (confidence <= 1)).all()


@given(seed=SEEDS, method=st.sampled_from(METHODS), scale=st.sampled_from([1, 0.5]), contrast=st.integers(1, 256))
def test_maps_are_dense_in_range_and_confidence_is_a_share(seed, method, scale, contrast):
    left, right = noise(seed, 13, 41, contrast), noise(seed + 1, 13, 41, contrast)
    result = Matcher(method, max_disparity=24, scale=scale, confidence=True)(left, right)
    assert ((result.disparity >= -1) & (result.disparity <= 24)).all()
    assert ((result.confidence >= 0) & (result.confidence <= 1)).all()


@given(seed=SEEDS, height=st.integers(1, 6), width=st.integers(1, 24), gaps=st.sampled_from([0, 0.2, 0.7, 1]))
def test_post_processing_of_any_map(seed, height, width, gaps):
    disparity, cost = maps(seed, height, width, gaps)
    consistent = single_matching_phase(disparity, cost)
    np.testing.assert_array_equal(consistent, oracles.single_matching_phase(disparity, cost))
    np.testing.assert_array_equal(single_matching_phase(consistent, cost), consistent)
    for mode in ("background", "nearest"):
        filled = fill(consistent, mode)
        np.testing.assert_array_equal(filled, oracles.fill(consistent, mode))
        np.testing.assert_array_equal(filled[~np.isnan(consistent)], consistent[~np.isnan(consistent)])
    np.testing.assert_array_equal(remove_speckles(consistent, 2), oracles.remove_speckles(consistent, 2))
    for size in (3, 5):
        np.testing.assert_array_equal(median(consistent, size), oracles.median(consistent, size))


@given(
    seed=SEEDS,
    view=st.sampled_from(["rows", "columns", "both", "skip"]),
    dtype=st.sampled_from(["u1", "u2", "f4"]),
)
def test_views_are_their_copies(seed, view, dtype):
    cut = {
        "rows": np.s_[::-1],
        "columns": np.s_[:, ::-1],
        "both": np.s_[::-1, ::-1],
        "skip": np.s_[::2, 1::2],
    }[view]
    left, right = (noise(seed + k, 12, 40, 256, dtype)[cut] for k in range(2))
    expected = match(left.copy(), right.copy(), "census+sgm", max_disparity=12)  # `copy` is contiguous
    np.testing.assert_array_equal(match(left, right, "census+sgm", max_disparity=12), expected)


@pytest.mark.parametrize("method", METHODS)
def test_a_tilted_plane_is_found_between_the_levels(method):
    """Sub-pixel: the right image is the left one warped by disparity 6 + x / 40, smooth noise, interior."""
    rng = np.random.default_rng(5)
    height, width = 24, 160
    waves = rng.normal(size=(height, 12, 2))
    x_left = np.arange(width, dtype=float)

    def scene(x):  # one smooth function of the surface per row
        phase = np.outer(x, np.arange(4, 16) / 20)
        return waves[:, :, 0] @ np.cos(phase).T + waves[:, :, 1] @ np.sin(phase).T

    truth = 6 + x_left / 40
    # A right column u sees the left column x with x - truth(x) = u, so x = (u + 6) / (1 - 1 / 40).
    left, right = scene(x_left), scene((x_left + 6) / (1 - 1 / 40))
    scale = max(abs(left).max(), abs(right).max())
    left, right = (np.rint(127 + 120 * image / scale).astype(np.uint8) for image in (left, right))
    disparity = match(left, right, method, max_disparity=24)
    error = abs(disparity - truth)[4:-4, 24:-8]
    whole = abs(match(left, right, method, max_disparity=24, subpixel=False) - truth)[4:-4, 24:-8]
    assert np.median(error) < 0.2
    assert np.mean(error) < np.mean(whole)
