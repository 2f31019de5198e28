"""Public functions at their edges: one clear line for what cannot be used, and a right value for what can."""

from __future__ import annotations

import numpy as np
import pytest

import stereokit
from stereokit import Disparity, InputError, Matcher, OptionError, StereokitError
from stereokit.postprocess import fill, median, remove_speckles, single_matching_phase

MAP = np.ones((3, 4), np.float32)
VOLUME = np.ones((3, 4, 5), np.uint16)
HUGE = 10**5000  # cannot even be printed

NO_MAPS = {
    "list of words": ["a", "b"],
    "ragged": [[1, 2], [3]],
    "none": None,
    "one row": np.ones(4, np.float32),
    "no columns": np.ones((3, 0), np.float32),
    "no rows": np.ones((0, 3), np.float32),
    "complex": np.ones((3, 4), complex),
    "flags": np.ones((3, 4), bool),
    "objects": np.full((3, 4), None),
    "masked": np.ma.masked_array(MAP),
    "three axes": np.ones((3, 4, 1), np.float32),
}


@pytest.mark.parametrize(
    "function", [fill, median, lambda d: remove_speckles(d, 2), lambda d: single_matching_phase(d, d)]
)
@pytest.mark.parametrize("content", NO_MAPS.values(), ids=NO_MAPS)
def test_what_is_no_map_is_refused(function, content):
    with pytest.raises(InputError, match=r"^disparity must be [^\n]*, got [^\n]*$"):
        function(content)


@pytest.mark.parametrize(
    "call",
    [
        lambda: median(MAP, 3.0),
        lambda: median(MAP, 4),
        lambda: median(MAP, "3"),
        lambda: fill(MAP, ["nearest"]),
        lambda: fill(MAP, np.array(["nearest", "none"])),
        lambda: fill(MAP, threads=0),
        lambda: remove_speckles(MAP, 2, threads=0),
        lambda: remove_speckles(MAP, 2, threads=1.5),
        lambda: remove_speckles(MAP, -1),
        lambda: remove_speckles(MAP, 2, np.nan),
        lambda: single_matching_phase(MAP, MAP, threads=HUGE),
        lambda: Matcher(threads=HUGE),
        lambda: Matcher(max_disparity=HUGE),
        lambda: Matcher(max_disparity=np.ones((3, 3))),
        lambda: Matcher(smooth=1j),
        lambda: Matcher(smooth=np.complex64(1)),
        lambda: Matcher(fill=np.array([1, 2])),
        lambda: Matcher(fill=HUGE),
        lambda: fill(MAP, HUGE),
        lambda: Matcher(nodata=HUGE),
        lambda: Matcher(scale=np.ones(2)),
        lambda: Matcher(["S1"]),
        lambda: Matcher("S1", mode=np.array([1, 2])),
        lambda: Matcher("S1", mode=HUGE),
        lambda: Matcher("x" * 10000),
        lambda: Matcher(device=np.ones((40, 40))),
        lambda: Matcher(scale=0.5, refiner=5),
        lambda: stereokit.warmup(None),
        lambda: stereokit.warmup("S1", max_disparity=0),
        lambda: stereokit.match(MAP, MAP, "S1", right=True),
        lambda: stereokit.select(VOLUME, min_disparity=HUGE),
        lambda: stereokit.select(VOLUME, subpixel=1),
        lambda: stereokit.cost_volume(MAP, MAP, 5),
        lambda: stereokit.cost_volume(MAP, MAP, threads=0),
        lambda: stereokit.aggregate(np.ones((3, 4, 5), np.uint8), np.ones((3, 4), np.uint8), 7),
    ],
)  # fmt: skip
def test_an_option_out_of_its_rule_is_one_line(call):
    with pytest.raises(OptionError) as caught:
        call()
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "call",
    [
        lambda: single_matching_phase(MAP, MAP[:2]),
        lambda: single_matching_phase(MAP, None),
        lambda: single_matching_phase(MAP, MAP.astype(complex)),
        lambda: stereokit.select([[1, 2], [3]]),
        lambda: stereokit.select(None),
        lambda: stereokit.select(VOLUME[:, :, :0]),
        lambda: stereokit.select(-VOLUME.astype(np.float32)),
        lambda: stereokit.select(VOLUME.astype(np.float64)),
        lambda: stereokit.aggregate(None, np.ones((3, 4), np.uint8)),
        lambda: stereokit.aggregate([[1], [2, 3]], np.ones((3, 4), np.uint8)),
        lambda: stereokit.aggregate(np.ones((3, 4, 5), np.uint8), None),
        lambda: stereokit.aggregate(np.ones((3, 4, 5), np.uint8), [[1], [2, 3]]),
        lambda: stereokit.aggregate(np.full((3, 4, 5), np.nan, np.float32), np.ones((3, 4), np.uint8), "dt"),
        lambda: stereokit.cost_volume(None, None),
        lambda: stereokit.match([[1], [2, 3]], MAP, "S1"),
    ],
)
def test_an_array_that_cannot_be_used_is_one_line(call):
    with pytest.raises(InputError) as caught:
        call()
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_lists_and_other_numbers_are_maps_too():
    rows = [[np.nan, 2, 3], [4, 5, 6]]
    assert fill(rows).tolist() == [[2, 2, 3], [4, 5, 6]]
    assert median(rows).tolist()[1] == [4, 4, 5]
    for dtype in (np.float64, ">f4", np.int16, np.float16):
        values = np.array([[1, 2], [3, 4]], dtype)
        assert fill(values).tolist() == [[1, 2], [3, 4]]
        assert single_matching_phase(np.zeros((2, 2)), values).tolist() == [[0, 0], [0, 0]]
    assert np.isnan(remove_speckles(MAP, 2**70)).all()
    assert (remove_speckles(MAP, 11) == 1).all()


@pytest.mark.parametrize("count", [3, 64, 70])
def test_selection_of_pixels_without_costs_is_nan(count):
    volume = np.full((1, 4, count), np.inf, np.float32)
    volume[0, 1] = np.nan
    volume[0, 2] = -np.nan
    volume[0, 3, count - 1] = 5
    disparity, cost, confidence = stereokit.select(volume, min_disparity=7)
    assert np.isnan(disparity[0, :3]).all() and np.isnan(cost[0, :3]).all() and not confidence[0, :3].any()
    assert (disparity[0, 3], cost[0, 3], confidence[0, 3]) == (7 + count - 1, 5, 1)


def test_selection_beside_a_level_without_a_cost_is_whole():
    volume = np.array([[[9, 4, np.nan, 8], [9, 4, 6, 8], [np.inf, 4, 6, 8], [0.0, -0.0, 1, 2]]], np.float32)
    disparity, cost, _ = stereokit.select(volume)
    offset = np.float32((9 - 6) / (2 * (9 + 6 - 8)))  # of the parabola through 9, 4, 6
    np.testing.assert_allclose(disparity[0], [1, 1 + offset, 1, 0], rtol=1e-6)
    assert cost[0].tolist() == [4, 4, 4, 0]


class Wrong:
    """A refiner that returns something else than it should."""

    def __init__(self, result):
        self.result = result

    def __call__(self, coarse, left, *, threads=1):
        return self.result


@pytest.mark.parametrize(
    "result", [None, MAP, Disparity(MAP, np.ones((3, 4), bool)), (MAP, MAP)], ids=["none", "array", "size", "tuple"]
)
def test_a_refiner_that_returns_no_map_of_the_size_is_refused(random_pair, result):
    matcher = Matcher("S1", max_disparity=8, scale=0.5, refiner=Wrong(result))
    with pytest.raises(OptionError, match=r"^refiner 'wrong' must return a Disparity of the image's \(9, 20\), got "):
        matcher(*random_pair(9, 20))


@pytest.mark.parametrize("low", [5, -7, 1, 4, -8])
def test_at_half_size_nothing_lies_below_the_minimum(low, random_pair):
    blank = np.zeros((20, 40), np.uint8)
    options = {"scale": 0.5, "min_disparity": low, "max_disparity": low + 32}
    assert low < 0 or (stereokit.match(blank, blank, "S1", **options) == low).all()
    left, _ = random_pair(40, 80)
    result = Matcher("S1", right=True, **options)(left, np.roll(left, -low, axis=1))
    for disparity in (result.disparity, result.right):
        assert low <= disparity.min() and disparity.max() < low + 32


def test_an_odd_minimum_at_half_size_is_found():
    """Half a pixel below the first whole level lies what is searched for: it is as near as at any other offset."""
    left = np.random.default_rng(0).integers(0, 256, (60, 160), dtype=np.uint8).repeat(2, 0).repeat(2, 1)
    right = np.roll(left, -5, axis=1)
    disparity = stereokit.match(left, right, "S2", scale=0.5, min_disparity=5, max_disparity=37)
    assert np.median(np.abs(disparity[20:-20, 60:-60] - 5)) <= 0.5


def test_errors_are_one_family():
    assert issubclass(OptionError, StereokitError) and issubclass(InputError, StereokitError)
