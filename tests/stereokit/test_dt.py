"""Domain transform against loops written from Gastal and Oliveira 2011, and against OpenCV's own filter.

``dtfilter_vector.json`` holds what ``cv2.ximgproc.dtFilter`` of opencv-contrib returned; the call and the
versions stand in it (opencv-contrib cannot be installed beside the plain opencv that stereokit uses).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import oracles
import pytest

from stereokit import OptionError, RowCost, aggregate

SHAPES = [(7, 9), (1, 9), (9, 1), (1, 1), (5, 6)]
VECTOR = json.loads((Path(__file__).parent / "dtfilter_vector.json").read_text())
STEP = 64
"""Units of the fixed-point result to one unit of cost."""


def guide_of(shape, seed=0):
    """Return noise with a nearly flat part, so that weights of every size occur."""
    guide = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    guide[: shape[0] // 2 + 1, : shape[1] // 2 + 1] //= 64
    return guide


def cost_of(largest):
    """Return a cost whose range is 0 to `largest`."""
    return RowCost(lambda *_: None, largest)


def costs_of(shape, count, seed=0, largest=62):
    return np.random.default_rng(seed + 1).integers(0, largest + 1, (*shape, count), dtype=np.uint8)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("passes", [1, 2, 3])
def test_float_volumes_are_filtered_as_the_paper_says(shape, passes):
    guide, volume = guide_of(shape), costs_of(shape, 3).astype(np.float32) / 7
    for sigma_v in (None, 6, 31.5):
        total = aggregate(volume, guide, "dt", sigma_s=20, sigma_r=30, sigma_v=sigma_v, passes=passes)
        assert total.dtype == np.float32
        expected = oracles.slices(oracles.domain_transform, volume, guide, 20, 30, passes, sigma_v)
        np.testing.assert_allclose(total, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("case", VECTOR["results"], ids=lambda c: f"{c['passes']}-{c['sigma_s']}-{c['sigma_r']}")
def test_float_volumes_are_filtered_as_opencv_does(case):
    volume = np.array(VECTOR["source"], np.float32)[:, :, None]
    guide = np.array(VECTOR["guide"], np.uint8)
    options = {name: case[name] for name in ("sigma_s", "sigma_r", "passes")}
    total = aggregate(volume, guide, "dt", mode="rf", sigma_v=None, **options)
    np.testing.assert_allclose(total[:, :, 0], np.array(case["output"]), rtol=1e-5)


@pytest.mark.parametrize("case", VECTOR["results"], ids=lambda c: f"{c['passes']}-{c['sigma_s']}-{c['sigma_r']}")
def test_the_oracle_is_opencv(case):
    plane = oracles.domain_transform(
        VECTOR["source"], VECTOR["guide"], case["sigma_s"], case["sigma_r"], case["passes"]
    )
    np.testing.assert_allclose(plane, np.array(case["output"]), rtol=2e-6)


def fixed_point_error(volume, guide, largest, **options):
    """Return the largest distance from the float filter, in units of cost."""
    total = aggregate(volume, guide, "dt", cost=cost_of(largest), **options)
    assert total.dtype == np.int16
    assert total.min() >= 0
    assert total.max() <= largest * STEP
    arguments = (options["sigma_s"], options["sigma_r"], options["passes"], options["sigma_v"])
    expected = oracles.slices(oracles.domain_transform, volume, guide, *arguments)
    return np.abs(total / STEP - expected).max()


def bound(largest, passes=1):
    """Half a step of the stored bytes each time they are stored, and a tenth of a unit for the recursion."""
    step = 2.0 ** -(8 - largest.bit_length())
    return step / 2 * (2 * passes - 1) + 0.1


@pytest.mark.parametrize("shape", [*SHAPES, (12, 120)])
@pytest.mark.parametrize(("sigma_s", "sigma_v"), [(10, 6), (20, None), (5, 40)])
@pytest.mark.parametrize("largest", [1, 62, 63, 100, 254])
def test_fixed_point_stays_near_the_float_filter(shape, sigma_s, sigma_v, largest):
    guide, volume = guide_of(shape, 2), costs_of(shape, 4, 2, largest)
    options = {"sigma_s": sigma_s, "sigma_r": 30, "sigma_v": sigma_v, "passes": 1}
    assert fixed_point_error(volume, guide, largest, **options) < bound(largest)


@pytest.mark.parametrize("passes", [2, 3, 5])
@pytest.mark.parametrize("largest", [62, 254])
def test_fixed_point_stays_near_the_float_filter_over_passes(passes, largest):
    guide, volume = guide_of((9, 40), 3), costs_of((9, 40), 4, 3, largest)
    options = {"sigma_s": 20, "sigma_r": 30, "sigma_v": None, "passes": passes}
    assert fixed_point_error(volume, guide, largest, **options) < bound(largest, passes)


@pytest.mark.parametrize("pattern", ["noise", "step", "sparse"])
def test_fixed_point_on_a_flat_guide(pattern):
    guide = np.full((12, 200), 9, np.uint8)
    volume = {
        "noise": costs_of((12, 200), 2, 4),
        "step": np.repeat(np.arange(200)[None, :, None] // 100 * 20, 12, axis=0).astype(np.uint8),
        "sparse": (costs_of((12, 200), 2, 5) > 55).astype(np.uint8) * 3,
    }[pattern]
    for sigma in (10, 60):
        options = {"sigma_s": sigma, "sigma_r": 30, "sigma_v": None, "passes": 1}
        # A recursion with feedback a that loses up to one unit in the last place at each step loses at most
        # 1 / (1 - a) of them; once along the rows and once along the columns.
        lost = 1 / STEP / (1 - np.exp(-np.sqrt(2) / sigma))
        assert fixed_point_error(volume, guide, 62, **options) < 2.0 ** -(8 - 6) / 2 + 2 * lost


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
    total = aggregate(volume, guide_of((6, 9)), "dt", cost=cost_of(254), passes=3)
    assert (total == value * STEP).all()


@pytest.mark.parametrize("passes", [1, 5])
@pytest.mark.parametrize("largest", [1, 3, 62, 127, 128, 254])
def test_rf_of_extreme_costs_never_overflows(passes, largest):
    volume = (np.random.default_rng(4).integers(0, 2, (12, 17, 5)) * largest).astype(np.uint8)
    options = {"sigma_s": 20, "sigma_r": 30, "sigma_v": None, "passes": passes}
    assert fixed_point_error(volume, guide_of((12, 17)), largest, **options) < bound(largest, passes)


@pytest.mark.parametrize("mode", ["rf", "sum"])
def test_volumes_do_not_depend_on_threads_and_are_not_modified(mode):
    volume, guide = costs_of((19, 23), 9), guide_of((19, 23))
    for source in (volume, volume.astype(np.float32)):
        before = source.copy()
        one = aggregate(source, guide, "dt", cost="census", mode=mode, threads=1)
        np.testing.assert_array_equal(source, before)
        for threads in (2, 3, 40):
            many = aggregate(source, guide, "dt", cost="census", mode=mode, threads=threads)
            np.testing.assert_array_equal(one, many)


@pytest.mark.parametrize("scale", ["tiny", "huge"])
@pytest.mark.parametrize("name", ["sigma_s", "sigma_v", "sigma_r"])
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
        ({"sigma_s": 0}, ["sigma_s", "0.01", "0"]),
        ({"sigma_s": float("nan")}, ["sigma_s", "nan"]),
        ({"sigma_r": float("inf")}, ["sigma_r", "inf"]),
        ({"sigma_r": "wide"}, ["sigma_r", "wide"]),
        ({"sigma_v": -1}, ["sigma_v", "-1"]),
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
