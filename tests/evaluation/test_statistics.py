"""Bootstrap intervals and comparisons: by hand, by enumeration, and on data whose answer is known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stereokit.errors import InputError
from stereokit_evaluation.scoring.statistics import Comparison, Sums, compare, interval


def test_a_figure_is_the_quotient_of_sums():
    sums = Sums([1, 3], [10, 10], factor=100)
    assert sums.value() == 20 and sums.value([2, 0]) == 10
    assert Sums([8, 10], [1, 1], root=True).value() == 3
    assert np.isnan(Sums([0.0], [0.0]).value())


def test_equal_scenes_have_an_interval_of_no_width():
    assert interval(Sums([5, 5, 5], [10, 10, 10], factor=100)) == (50, 50)


def test_two_scenes_by_hand():
    # The draws are (0,0), (0,1), (1,0), (1,1): 0, 50 and 100 percent with 1/4, 1/2, 1/4.
    low, high = interval(Sums([0, 10], [10, 10], factor=100), draws=4000)
    assert (low, high) == (0, 100)
    low, high = interval(Sums([0, 10], [10, 10], factor=100), draws=4000, level=0.4)
    assert (low, high) == (50, 50)  # from the 30th to the 70th of 100


def test_the_interval_of_a_mean_is_that_of_the_normal_law():
    rng = np.random.default_rng(1)
    values = rng.normal(7, 2, 400)
    low, high = interval(Sums(values, np.ones(400)), draws=4000)
    spread = 1.96 * values.std() / 20
    assert low == pytest.approx(values.mean() - spread, abs=0.03) and high == pytest.approx(
        values.mean() + spread, abs=0.03
    )


def test_intervals_come_from_the_seed():
    sums = Sums(np.arange(9.0), np.ones(9))
    assert interval(sums) == interval(sums) != interval(sums, seed=1)


def test_one_scene_or_none_has_no_interval():
    assert interval(Sums([3], [10])) is None
    assert interval(Sums([3, 0], [10, 0])) is None  # the second has no pixels
    assert compare(Sums([0], [0]), Sums([0], [0])) is None
    assert compare(Sums([3], [10]), Sums([1], [10])) == Comparison(pytest.approx(0.2), None, None, None, 1)


def p_by_enumeration(first, second, pixels, root=False):
    def value(errors):
        quotient = sum(errors) / sum(pixels)
        return quotient**0.5 if root else quotient

    target = abs(value(first) - value(second))
    hits = 0
    for exchange in itertools.product((False, True), repeat=len(first)):
        one = [b if swap else a for a, b, swap in zip(first, second, exchange, strict=True)]
        other = [a if swap else b for a, b, swap in zip(first, second, exchange, strict=True)]
        hits += abs(value(one) - value(other)) >= target - 1e-12
    return hits / 2 ** len(first)


@pytest.mark.parametrize("root", [False, True])
def test_p_values_are_those_of_all_exchanges(root):
    rng = np.random.default_rng(4)
    for scenes in (2, 3, 7):
        first, second = rng.integers(0, 50, (2, scenes))
        pixels = rng.integers(50, 100, scenes)
        result = compare(Sums(first, pixels, root=root), Sums(second, pixels, root=root))
        assert result.p == pytest.approx(p_by_enumeration(first.tolist(), second.tolist(), pixels.tolist(), root))
        assert result.scenes == scenes


def test_a_difference_in_every_scene_is_as_sure_as_scenes_allow():
    pixels = np.full(5, 100.0)
    result = compare(Sums([5, 6, 7, 8, 9], pixels, 100), Sums([4, 5, 6, 7, 8], pixels, 100))
    assert result.difference == pytest.approx(1) and result.p == 2 / 2**5
    assert (result.low, result.high) == (pytest.approx(1), pytest.approx(1))  # paired: what the scenes share cancels
    assert interval(Sums([5, 6, 7, 8, 9], pixels, 100))[0] < 6  # alone it does not


def test_equal_methods_do_not_differ():
    sums = Sums([1, 2, 3], [9, 9, 9])
    assert compare(sums, sums) == Comparison(0.0, 0.0, 0.0, 1.0, 3)


def test_many_scenes_are_sampled():
    rng = np.random.default_rng(5)
    pixels = np.full(40, 1000.0)
    base = rng.integers(20, 60, 40)
    noise = rng.integers(-9, 10, 40)
    same = compare(Sums(base, pixels), Sums(base + noise - round(noise.mean()), pixels))
    worse = compare(Sums(base + 8, pixels), Sums(base + rng.integers(-3, 4, 40), pixels))
    assert same.p > 0.2 and same.low < 0 < same.high
    assert worse.p == 1 / 10_000 and worse.low > 0


def test_scenes_that_one_method_lacks_do_not_count():
    result = compare(Sums([1, 9], [10, 10]), Sums([0, 0], [10, 0]))
    assert result.scenes == 1 and result.difference == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sums([1, 2], [1]), "denominators must be as many as numerators, 2, got 1"),
        (lambda: Sums([np.nan], [1]), "numerators must be a list of finite numbers"),
        (lambda: Sums([[1]], [[1]]), "numerators must be a list"),
        (lambda: compare(Sums([1], [1]), Sums([1, 1], [1, 1])), "second must have as many scenes as first, 1, got 2"),
    ],
)
def test_wrong_sums_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
