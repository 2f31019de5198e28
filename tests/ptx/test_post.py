"""The kernels of post-processing, executed from their PTX."""

from __future__ import annotations

import pytest

from ptx.checks import post as checks
from ptx.interpreter.emulated import EmulatedQueue

CHECKS = [getattr(checks, name) for name in sorted(vars(checks)) if name.startswith("check_")]
SMALL = [(5, 33), (2, 40)]


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_in_lockstep(check):
    check(EmulatedQueue())


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", ["check_smp", "check_speckle", "check_fill", "check_median"])
def test_in_any_order(name, seed):
    getattr(checks, name)(EmulatedQueue(seed), SMALL)
