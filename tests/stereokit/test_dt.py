"""Domain transform against loops written from Gastal and Oliveira 2011, and against OpenCV's own filter.

``dtfilter_vector.json`` holds what ``cv2.ximgproc.dtFilter`` of opencv-contrib returned; the call and the versions
stand in it (opencv-contrib cannot be installed beside the plain opencv that stereokit uses).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import oracles
import pytest

from stereokit import OptionError, aggregate

SHAPES = [(7, 9), (1, 9), (9, 1), (1, 1), (5, 6)]
VECTOR = json.loads((Path(__file__).parent / "dtfilter_vector.json").read_text())
STEP = 128
"""Units of the fixed-point result to one unit of cost."""


def guide_of(shape, seed=0):
    """Return noise with a nearly flat part, so that weights of every size occur."""
    guide = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    guide[: shape[0] // 2 + 1, : shape[1] // 2 + 1] //= 64
    return guide


def costs_of(shape, count, seed=0, largest=62):
    return np.random.default_rng(seed + 1).integers(0, largest + 1, (*shape, count), dtype=np.uint8)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("passes", [1, 2, 3])
def test_float_volumes_are_filtered_as_the_paper_says(shape, passes):
    guide, volume = guide_of(shape), costs_of(shape, 3).astype(np.float32) / 7
    total = aggregate(volume, guide, "dt", sigma_s=20, sigma_r=30, passes=passes)
    assert total.dtype == np.float32
    expected = oracles.slices(oracles.domain_transform, volume, guide, 20, 30, passes)
    np.testing.assert_allclose(total, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("case", VECTOR["results"], ids=lambda c: f"{c['passes']}-{c['sigma_s']}-{c['sigma_r']}")
def test_float_volumes_are_filtered_as_opencv_does(case):
    volume = np.array(VECTOR["source"], np.float32)[:, :, None]
    guide = np.array(VECTOR["guide"], np.uint8)
    options = {name: case[name] for name in ("sigma_s", "sigma_r", "passes")}
    total = aggregate(volume, guide, "dt", mode="rf", **options)
    np.testing.assert_allclose(total[:, :, 0], np.array(case["output"]), rtol=1e-5)


@pytest.mark.parametrize("case", VECTOR["results"], ids=lambda c: f"{c['passes']}-{c['sigma_s']}-{c['sigma_r']}")
def test_the_oracle_is_opencv(case):
    plane = oracles.domain_transform(
        VECTOR["source"], VECTOR["guide"], case["sigma_s"], case["sigma_r"], case["passes"]
    )
    np.testing.assert_allclose(plane, np.array(case["output"]), rtol=2e-6)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("sigma_s", "sigma_r", "passes"), [(20, 30, 1), (20, 30, 3), (5, 10, 2), (40, 80, 1)])
def test_fixed_point_stays_near_the_float_filter(shape, sigma_s, sigma_r, passes):
    guide, volume = guide_of(shape, 2), costs_of(shape, 4, 2)
    total = aggregate(volume, guide, "dt", cost="census", sigma_s=sigma_s, sigma_r=sigma_r, passes=passes)
    assert total.dtype == np.int16
    expected = oracles.slices(oracles.domain_transform, volume, guide, sigma_s, sigma_r, passes)
    assert np.abs(total / STEP - expected).max() < 0.1  # units of cost


@pytest.mark.parametrize("sigma_s", [60, 200, 2000])
def test_fixed_point_stays_below_one_unit_of_cost_for_wide_filters(sigma_s):
    """The module promises rounding far below one unit of cost; the feedback of wide filters is near 1."""
    guide, volume = guide_of((24, 40), 3) // 16, costs_of((24, 40), 4, 3)
    total = aggregate(volume, guide, "dt", cost="census", sigma_s=sigma_s, sigma_r=30)
    expected = oracles.slices(oracles.domain_transform, volume, guide, sigma_s, 30, 1)
    assert np.abs(total / STEP - expected).max() < 0.5


@pytest.mark.parametrize("count", [1, 64, 65, 130])
@pytest.mark.parametrize("mode", ["rf", "sum"])
def test_levels_do_not_mix(count, mode):
    guide, volume = guide_of((5, 7)), costs_of((5, 7), count)
    total = aggregate(volume, guide, "dt", cost="census", mode=mode, passes=1)
    for level in {0, count // 2, count - 1}:
        one = aggregate(volume[:, :, level : level + 1], guide, "dt", cost="census", mode=mode, passes=1)
        np.testing.assert_array_equal(total[:, :, level], one[:, :, 0])


@pytest.mark.parametrize("shape", SHAPES)
def test_sum_is_the_cascade_of_the_authors(shape):
    guide, volume = guide_of(shape), costs_of(shape, 5)
    expected = oracles.slices(oracles.cascade, volume, guide)
    total = aggregate(volume, guide, "dt", cost="census", mode="sum")
    assert total.dtype == np.float32
    np.testing.assert_allclose(total, expected, rtol=1e-5)
    floats = aggregate(volume.astype(np.float32), guide, "dt", mode="sum")
    np.testing.assert_allclose(floats, expected, rtol=1e-5)


@pytest.mark.parametrize("value", [0, 1, 62, 254])
def test_rf_leaves_a_constant_volume_as_it_is(value):
    volume = np.full((6, 9, 3), value, np.uint8)
    total = aggregate(volume, guide_of((6, 9)), "dt", cost=largest_cost(), passes=3)
    assert (total == value * STEP).all()


def largest_cost():
    from stereokit import RowCost

    return RowCost(lambda *_: None, 254)


@pytest.mark.parametrize("passes", [1, 5])
def test_rf_of_extreme_costs_never_overflows(passes):
    volume = (np.random.default_rng(4).integers(0, 2, (12, 17, 5)) * 254).astype(np.uint8)
    guide = guide_of((12, 17))
    total = aggregate(volume, guide, "dt", cost=largest_cost(), passes=passes)
    expected = oracles.slices(oracles.domain_transform, volume, guide, 20, 30, passes)
    assert total.min() >= 0
    assert total.max() <= 254 * STEP
    assert np.abs(total / STEP - expected).max() < 0.25


@pytest.mark.parametrize("mode", ["rf", "sum"])
def test_volumes_do_not_depend_on_threads_and_are_not_modified(mode):
    volume, guide = costs_of((19, 23), 9), guide_of((19, 23))
    for source in (volume, volume.astype(np.float32)):
        kept = source.copy()
        one = aggregate(source, guide, "dt", cost="census", mode=mode, threads=1)
        np.testing.assert_array_equal(source, kept)
        for threads in (2, 3, 40):
            many = aggregate(source, guide, "dt", cost="census", mode=mode, threads=threads)
            np.testing.assert_array_equal(one, many)


@pytest.mark.parametrize("scale", ["tiny", "huge"])
@pytest.mark.parametrize("name", ["sigma_s", "sigma_r"])
def test_any_positive_sigma_is_a_filter_or_a_clear_error(name, scale):
    volume, guide = costs_of((4, 5), 3), guide_of((4, 5))
    value = {"tiny": 1e-308, "huge": 1e308}[scale]
    try:
        total = aggregate(volume, guide, "dt", cost="census", **{name: value})
    except OptionError as error:
        assert name in str(error)
    else:
        assert total.min() >= 0
        assert total.max() <= 62 * STEP


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mode": "nc"}, ["mode", "rf", "sum", "nc"]),
        ({"sigma_s": 0}, ["sigma_s", "positive", "0"]),
        ({"sigma_s": float("nan")}, ["sigma_s", "nan"]),
        ({"sigma_r": float("inf")}, ["sigma_r", "inf"]),
        ({"sigma_r": "wide"}, ["sigma_r", "wide"]),
        ({"passes": 0}, ["passes", "1 to 5", "0"]),
        ({"passes": 2.5}, ["passes", "2.5"]),
        ({"paths": 8}, ["paths"]),
    ],
)
def test_options_outside_their_rule(options, words):
    with pytest.raises(OptionError) as caught:
        aggregate(costs_of((2, 3), 4), guide_of((2, 3)), "dt", cost="census", **options)
    assert all(word in str(caught.value) for word in words)
    assert "\n" not in str(caught.value)
