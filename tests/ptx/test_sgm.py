"""The kernels of semi-global matching, executed from their PTX."""

from __future__ import annotations

import pytest

from ptx.checks import sgm as checks
from ptx.interpreter.emulated import EmulatedQueue
from stereokit.aggregation.sgm import Sgm
from stereokit.aggregation.sgm_cuda import directions


@pytest.mark.parametrize("seed", [None, 1, 2, 3])
@pytest.mark.parametrize("check", [checks.check_four_paths, checks.check_five_paths, checks.check_eight_paths])
def test_schedules(check, seed):
    check(EmulatedQueue(seed))


@pytest.mark.parametrize("paths", [4, 5, 8])
def test_paths(paths):
    checks.check_paths(EmulatedQueue(), Sgm(15, 85, paths=paths), (9, 33), 8)


@pytest.mark.parametrize(
    ("shape", "count"),
    [((1, 1), 1), ((1, 7), 2), ((7, 1), 33), ((3, 5), 64), ((4, 3), 65), ((3, 3), 129), ((2, 3), 385)],
)
def test_sizes_and_levels(shape, count):
    checks.check_paths(EmulatedQueue(), Sgm(15, 85, paths=8), shape, count, detail=2)


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0])
def test_penalties_follow_the_edges(factor):
    checks.check_edges(EmulatedQueue(), factor)


def test_largest_path_costs():
    checks.check_largest_path_costs(EmulatedQueue())


def test_the_last_direction_runs_along_a_column_and_none_comes_twice():
    for paths in (4, 5, 8):
        steps = directions(paths)
        assert len(set(steps)) == len(steps) == paths
        assert steps[-1][0] == 0
    assert all(dy >= 0 for _, dy in directions(5))
