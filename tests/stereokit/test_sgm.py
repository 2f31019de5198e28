"""Semi-global matching against loops written from Hirschmueller 2008: sums are exact.

Each further block of 64 levels is compiled anew, so that more than two are compared here once only; `cpu.checks` has
more, up to eight blocks, where kernels are interpreted.
"""

from __future__ import annotations

import numpy as np
import oracles
import pytest

from stereokit import InputError, OptionError, RowCost, Zncc, aggregate

SHAPES = [(6, 7), (5, 1), (1, 6), (1, 1), (2, 2), (3, 8)]


def cost_of(largest):
    """Return a cost whose unit is 1 and whose range is 0 to `largest`."""
    return RowCost(lambda *_: None, largest)


class CostlyCost(RowCost):
    """A cost that the second sweep takes back from the path costs of the first."""

    costly_to_recompute = True


def volume_of(shape, count, largest, seed=0):
    return np.random.default_rng(seed).integers(0, largest + 1, (*shape, count)).astype(np.uint8)


def guide_of(shape, seed=0):
    return np.random.default_rng(seed + 100).integers(0, 256, shape, dtype=np.uint8)


def sums(volume, largest, p1, p2, paths=8, edge_factor=1, **options):
    """Aggregate, unless said otherwise along eight paths and with penalties that do not follow the image."""
    guide = guide_of(volume.shape[:2])
    options = {"p1": p1, "p2": p2, "paths": paths, "edge_factor": edge_factor, **options}
    return aggregate(volume, guide, "sgm", cost=cost_of(largest), **options)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("paths", [4, 5, 8])
def test_sums_of_paths(shape, paths):
    volume = volume_of(shape, 9, 62)
    total = sums(volume, 62, 7, 100, paths)
    assert total.dtype == np.uint16
    np.testing.assert_array_equal(total, oracles.sgm(volume, 7, 100, oracles.DIRECTIONS[paths]))


@pytest.mark.parametrize("count", [1, 2, 3, 63, 64, 65, 128, 130])
def test_every_number_of_levels(count):
    volume = volume_of((4, 5), count, 62, seed=1)
    expected = oracles.sgm(volume, 9, 193, oracles.DIRECTIONS[8])
    np.testing.assert_array_equal(sums(volume, 62, 9, 193), expected)


@pytest.mark.parametrize(("p1", "p2"), [(0, 0), (0, 40), (40, 40), (85, 85), (86, 86), (127, 128), (193, 193)])
def test_penalties_of_every_size(p1, p2):
    volume = volume_of((5, 6), 12, 62, seed=2)
    expected = oracles.sgm(volume, p1, p2, oracles.DIRECTIONS[8])
    np.testing.assert_array_equal(sums(volume, 62, p1, p2), expected)


@pytest.mark.parametrize("shape", [*SHAPES, (7, 40)])
@pytest.mark.parametrize("count", [1, 5, 64, 65])
@pytest.mark.parametrize("largest", [31, 254])
def test_costs_that_are_recovered_are_those_that_were_computed(shape, count, largest):
    volume = volume_of(shape, count, largest, seed=3)
    volume[::2] //= 3
    guide, p1, p2 = guide_of(shape) // 8, (255 - largest) // 3, 255 - largest
    expected = oracles.sgm(volume, p1, p2, oracles.DIRECTIONS[4], guide, 8, 0.5)
    for threads in (1, 2):
        options = {"p1": p1, "p2": p2, "edge": 8, "edge_factor": 0.5, "threads": threads}
        total = aggregate(volume, guide, "sgm", cost=CostlyCost(lambda *_: None, largest), **options)
        np.testing.assert_array_equal(total, expected)


@pytest.mark.parametrize("largest", [1, 62, 127, 254])
@pytest.mark.parametrize("count", [1, 5, 64, 70])
@pytest.mark.parametrize("pattern", ["random", "checks", "worst"])
def test_extreme_costs_at_the_largest_penalty_never_overflow(largest, count, pattern):
    shape, p2 = (4, 5), 255 - largest
    rng = np.random.default_rng(3)
    if pattern == "random":
        volume = rng.integers(0, 2, (*shape, count)) * largest
    elif pattern == "checks":  # a step of many levels at every pixel
        y, x, d = np.indices((*shape, count))
        volume = ((y + x + (d > count // 2)) % 2) * largest
    else:
        volume = np.full((*shape, count), largest)
    volume = volume.astype(np.uint8)
    for p1 in {0, p2 // 2, p2}:
        expected = oracles.sgm(volume, p1, p2, oracles.DIRECTIONS[8])
        np.testing.assert_array_equal(sums(volume, largest, p1, p2), expected)


@pytest.mark.parametrize("paths", [4, 5, 8])
@pytest.mark.parametrize(("edge", "edge_factor"), [(8, 0.5), (100, 0.3), (0, 0.5), (128, 0), (256, 0.5), (1e6, 0)])
def test_penalties_are_lower_across_edges_of_the_guide(paths, edge, edge_factor):
    volume = volume_of((5, 6), 10, 62, seed=9)
    guide = guide_of((5, 6), 9) // 2  # differences of 0 to 127
    guide[:, :3] //= 16
    options = {"p1": 21, "p2": 193, "edge": edge, "edge_factor": edge_factor, "paths": paths}
    total = aggregate(volume, guide, "sgm", cost="census", **options)
    expected = oracles.sgm(volume, 21, 193, oracles.DIRECTIONS[paths], guide, edge, edge_factor)
    np.testing.assert_array_equal(total, expected)


def test_penalties_left_out_fit_every_range():
    for largest in (1, 30, 62, 127, 200, 254):
        volume = volume_of((4, 5), 8, largest, seed=10)
        total = aggregate(volume, guide_of((4, 5)), "sgm", cost=cost_of(largest), paths=8)
        assert total.min() >= 0
        assert total.max() <= 8 * 255


def test_penalties_are_in_the_unit_of_the_cost():
    guide = guide_of((5, 6))
    for cost, steps in ((Zncc(steps=63), 63), (Zncc(steps=20), 20), ("zncc", Zncc().steps)):
        volume = volume_of((5, 6), 8, steps, seed=5)
        expected = oracles.sgm(volume, round(0.3 * steps), round(2 * steps), oracles.DIRECTIONS[8])
        total = aggregate(volume, guide, "sgm", cost=cost, p1=0.3, p2=2, paths=8, edge_factor=1)
        np.testing.assert_array_equal(total, expected)


def test_census_penalties_are_neighbours_that_differ():
    volume = volume_of((4, 5), 6, 62, seed=6)
    total = aggregate(volume, guide_of((4, 5)), "sgm", cost="census", p1=6, p2=96, paths=8, edge_factor=1)
    np.testing.assert_array_equal(total, oracles.sgm(volume, 6, 96, oracles.DIRECTIONS[8]))


@pytest.mark.parametrize("paths", [4, 5, 8])
def test_rows_of_more_columns_than_are_summed_at_a_time(paths):
    volume, guide = volume_of((6, 150), 6, 62, seed=12), guide_of((6, 150), 12)
    expected = oracles.sgm(volume, 7, 60, oracles.DIRECTIONS[paths], guide, 8, 0.5)
    for threads in (1, 4):
        options = {"p1": 7, "p2": 60, "edge": 8, "edge_factor": 0.5, "paths": paths, "threads": threads}
        np.testing.assert_array_equal(aggregate(volume, guide, "sgm", cost=cost_of(62), **options), expected)


@pytest.mark.parametrize("paths", [4, 5, 8])
def test_sums_do_not_depend_on_threads(paths):
    volume = volume_of((9, 7), 20, 62, seed=7)
    one = sums(volume, 62, 7, 100, paths, threads=1)
    for threads in (2, 3, 16):
        np.testing.assert_array_equal(one, sums(volume, 62, 7, 100, paths, threads=threads))


def test_strided_volumes_and_guides_and_no_change_to_them():
    base = volume_of((6, 14), 20, 62, seed=8)
    view, guide = base[::-1, ::2, ::-1], guide_of((12, 7))[::2]
    copies = view.copy(), guide.copy()
    total = aggregate(view, guide, "sgm", cost="census", p1=7, p2=100)
    expected = aggregate(*copies, "sgm", cost="census", p1=7, p2=100)
    np.testing.assert_array_equal(total, expected)
    np.testing.assert_array_equal(view, copies[0])
    np.testing.assert_array_equal(guide, copies[1])


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"p1": 9, "p2": 8}, OptionError, ["p1", "at most p2", "9", "8"]),
        ({"p1": -1}, OptionError, ["p1", "-1"]),
        ({"p1": float("nan")}, OptionError, ["p1", "nan"]),
        ({"p2": 194}, OptionError, ["p2", "193", "194"]),
        ({"p2": "much"}, OptionError, ["p2", "much"]),
        ({"paths": 3}, OptionError, ["paths", "4, 5 or 8", "3"]),
        ({"edge": -1}, OptionError, ["edge", "-1"]),
        ({"edge_factor": 1.5}, OptionError, ["edge_factor", "1.5"]),
        ({"edge_factor": None}, OptionError, ["edge_factor", "None"]),
        ({"sigma_s": 3}, OptionError, ["sigma_s"]),
    ],
)
def test_options_outside_their_rule(options, error, words):
    with pytest.raises(error) as caught:
        aggregate(volume_of((2, 3), 4, 62), guide_of((2, 3)), "sgm", cost="census", **options)
    assert all(word in str(caught.value) for word in words)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("volume", "guide", "words"),
    [
        (np.zeros((2, 3), np.uint8), np.zeros((2, 3), np.uint8), ["volume", "(2, 3)"]),
        (np.zeros((2, 3, 0), np.uint8), np.zeros((2, 3), np.uint8), ["volume", "(2, 3, 0)"]),
        (np.zeros((2, 3, 4), np.int32), np.zeros((2, 3), np.uint8), ["volume", "int32"]),
        (np.zeros((2, 3, 4), np.float32), np.zeros((2, 3), np.uint8), ["volume", "float32"]),
        (np.zeros((2, 3, 4), np.uint8), np.zeros((2, 4), np.uint8), ["guide", "(2, 4)"]),
        (np.zeros((2, 3, 4), np.uint8), np.zeros((2, 3), np.float32), ["guide", "float32"]),
        (np.full((2, 3, 4), 99, np.uint8), np.zeros((2, 3), np.uint8), ["62", "99"]),
    ],
)
def test_volumes_that_cannot_be_used(volume, guide, words):
    with pytest.raises((InputError, OptionError)) as caught:
        aggregate(volume, guide, "sgm", cost="census")
    assert all(word in str(caught.value) for word in words)
