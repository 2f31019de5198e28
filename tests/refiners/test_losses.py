"""Losses against their definitions."""

from __future__ import annotations

import itertools
import math

import numpy as np
import oracles
import pytest

from stereokit.errors import OptionError

torch = pytest.importorskip("torch")

from stereokit_refiners.training.losses import LOSSES, distance, divergence  # noqa: E402


def at(kind, error, truth=40.0):
    return float(distance(kind, torch.tensor([float(error)]), torch.tensor([float(truth)])))


def test_the_absolute_error():
    for error in (-7.5, 0.0, 3.25):
        assert at("l1", error) == abs(error)


@pytest.mark.parametrize("kind", LOSSES)
def test_every_distance_is_even_and_grows(kind):
    sizes = [0, 0.1, 0.5, 1, 2, 2.9, 3.1, 5, 10, 19, 40, 200]
    actual = [at(kind, size) for size in sizes]
    assert actual == [at(kind, -size) for size in sizes]
    assert all(later >= earlier for earlier, later in itertools.pairwise(actual))
    assert actual[0] >= 0 and actual[6] > actual[0]


def test_the_bounded_distance_is_steep_near_zero_and_flat_afar():
    assert at("bounded", 0) == 0
    assert at("bounded", 1e-3) / 1e-3 == pytest.approx(4 / 3 + 0.1, rel=1e-3)
    slope_afar = at("bounded", 101) - at("bounded", 100)
    assert 0.1 <= slope_afar < 0.105


@pytest.mark.parametrize(("truth", "limit"), [(10.0, 3.0), (60.0, 3.0), (80.0, 4.0), (200.0, 10.0)])
def test_the_outlier_distance_turns_at_kittis_limit(truth, limit):
    steepest = max(np.arange(0.5, 15, 0.01), key=lambda e: at("d1", e + 0.05, truth) - at("d1", e - 0.05, truth))
    assert steepest == pytest.approx(limit, abs=0.06)
    step = at("d1", limit + 2, truth) - at("d1", limit - 2, truth) - 0.25 * 4
    assert step == pytest.approx(3 * (1 / (1 + math.exp(-4)) - 1 / (1 + math.exp(4))), rel=1e-4)


def test_an_unknown_distance_is_refused():
    with pytest.raises(OptionError, match=r"^loss must be one of l1, bounded, d1, got 'l2'$"):
        distance("l2", torch.zeros(1), torch.zeros(1))


def test_the_divergence_is_zero_at_the_standard_normal_only():
    assert float(divergence(torch.zeros(5), torch.zeros(5))) == 0
    for mean in (-2.0, -0.1, 0.0, 0.1, 3.0):
        for log_sigma in (-1.5, -0.1, 0.0, 0.1, 1.0):
            value = float(divergence(torch.tensor([mean]), torch.tensor([log_sigma])))
            assert (value == 0) if mean == log_sigma == 0 else (value > 0)


@pytest.mark.parametrize(("mean", "deviation"), [(0.0, 1.0), (1.3, 0.4), (-2.0, 1.0), (0.5, 2.5)])
def test_the_divergence_is_its_integral(mean, deviation):
    actual = float(divergence(torch.tensor([mean]), torch.tensor([math.log(deviation)])))
    assert actual == pytest.approx(oracles.divergence(mean, deviation), rel=1e-5, abs=1e-6)


def test_the_divergence_is_a_mean_over_the_latent():
    means, logs = torch.tensor([1.0, -1.0, 0.0]), torch.tensor([0.2, 0.0, -0.7])
    single = [float(divergence(m[None], s[None])) for m, s in zip(means, logs, strict=True)]
    assert float(divergence(means, logs)) == pytest.approx(sum(single) / 3, rel=1e-6)
