"""The kernels of selection, executed from their PTX."""

from __future__ import annotations

import pytest

from ptx.checks import sgm as checks
from ptx.interpreter.emulated import EmulatedQueue


@pytest.mark.parametrize("seed", [None, 1, 2, 3])
@pytest.mark.parametrize(
    "check", [checks.check_selection, checks.check_selection_of_floats, checks.check_zeroed_confidence]
)
def test_schedules(check, seed):
    check(EmulatedQueue(seed))


@pytest.mark.parametrize("floats", [False, True])
@pytest.mark.parametrize("count", [1, 2, 3, 32, 33, 100, 130, 257])
def test_levels(count, floats):
    checks.check_selection(EmulatedQueue(), floats, (3, 5), count, bands=(0, 5))


@pytest.mark.parametrize(
    ("subpixel", "uniqueness", "detail"), [(False, 0.0, 0), (True, 0.0, 1), (True, 20.0, 0), (False, 20.0, 2)]
)
def test_rules(subpixel, uniqueness, detail):
    checks.check_selection(EmulatedQueue(), False, (4, 9), 12, subpixel, uniqueness, detail, (0, 1, 9))
