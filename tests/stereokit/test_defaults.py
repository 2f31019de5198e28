"""Defaults by method and by size: each is an option of its method, and a matcher takes those of its size."""

from __future__ import annotations

import numpy as np
import pytest

import stereokit
from stereokit import Matcher
from stereokit.defaults import DEFAULTS, HALF, METHODS, defaults_of
from stereokit.images.gray import gray_pair
from stereokit.images.resize import half_size
from stereokit.methods import option_names
from stereokit.registry import AGGREGATIONS, COSTS

NAMES = list(METHODS.values())
CASES = [(method, option) for method, options in HALF.items() for option in options]


def stages_of(method):
    cost, aggregation = method.split("+")
    return COSTS.get(cost), AGGREGATIONS.get(aggregation)


def used(matcher, option):
    """Return the value of an option that a matcher computes with."""
    for part in (matcher.cost, matcher.aggregation, matcher.settings):
        if hasattr(part, option):
            return getattr(part, option)
    raise AssertionError(f"{option} is nowhere in {matcher!r}")


def at_full_size(method, option):
    """Return a method's default, which may be that of its stage."""
    return defaults_of(method).get(option, used(Matcher(method), option))


class Keeping:
    def __call__(self, coarse, left, *, threads=1):
        self.coarse = coarse
        return stereokit.Disparity(np.zeros(left.shape, np.float32), np.ones(left.shape, bool))


@pytest.mark.parametrize("table", [DEFAULTS, HALF], ids=["full", "half"])
def test_every_default_is_an_option_of_its_method(table):
    assert set(table) - {""} == set(NAMES)
    for method in NAMES:
        pipeline = DEFAULTS[""].keys()
        stages = {name for stage in stages_of(method) for name in option_names(stage)}
        assert table[method].keys() <= pipeline | stages
        for value in table[method].values():
            assert isinstance(value, (int, float, str))


def test_defaults_of_a_method_are_the_common_ones_its_own_and_those_of_the_size():
    for method in NAMES:
        full, half = defaults_of(method), defaults_of(method, half=True)
        for name in DEFAULTS[""].keys() | DEFAULTS[method].keys():
            assert full[name] == DEFAULTS[method].get(name, DEFAULTS[""].get(name))
        assert full.keys() == DEFAULTS[""].keys() | DEFAULTS[method].keys()
        assert half.keys() == full.keys() | HALF[method].keys()
        for name in half:
            assert half[name] == (HALF[method][name] if name in HALF[method] else full[name])
    assert defaults_of("other+sgm") == defaults_of("other+sgm", half=True) == DEFAULTS[""]


def test_defaults_that_are_given_out_are_copies():
    for method, half in (("census+sgm", True), ("census+sgm", False), ("other+sgm", True)):
        defaults = defaults_of(method, half=half)
        defaults["smooth"] = 99
        assert defaults_of(method, half=half)["smooth"] != 99


@pytest.mark.parametrize(("method", "option"), CASES)
def test_a_matcher_takes_the_defaults_of_its_size(method, option):
    full, half = at_full_size(method, option), HALF[method][option]
    assert half != full  # otherwise it need not be said
    assert used(Matcher(method), option) == full
    assert used(Matcher(method, scale=1), option) == full
    assert used(Matcher(method, scale=0.5), option) == half
    short = next(short for short, name in METHODS.items() if name == method)
    assert used(Matcher(short, scale=0.5), option) == half


@pytest.mark.parametrize(("method", "option"), CASES)
def test_what_is_said_wins_over_the_default_of_half_size(method, option):
    full = at_full_size(method, option)
    matcher = Matcher(method, scale=0.5, **{option: full})
    assert used(matcher, option) == full
    for other in HALF[method].keys() - {option}:
        assert used(matcher, other) == HALF[method][other]


@pytest.mark.parametrize("method", NAMES)
def test_half_size_is_the_half_size_pair_with_these_options(random_pair, method):
    left, right = random_pair(40, 64, seed=8)
    keeping = Keeping()
    Matcher(method, max_disparity=24, scale=0.5, refiner=keeping)(left, right)
    pair = half_size(gray_pair(left, right))
    full_options = {name: at_full_size(method, name) for name in HALF[method]}
    maps = {}
    for name, options in (("half", HALF[method]), ("full", full_options)):
        maps[name] = Matcher(method, max_disparity=12, **options)(pair.left, pair.right).disparity
    np.testing.assert_array_equal(keeping.coarse.disparity, maps["half"])
    assert (maps["half"] != maps["full"]).any()
    plain = Matcher(method, max_disparity=12)(pair.left, pair.right)  # scale 1 knows nothing of half size
    np.testing.assert_array_equal(plain.disparity, maps["full"])
