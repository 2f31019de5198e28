"""The kernels of the domain transform, executed from their PTX."""

from __future__ import annotations

import pytest

from ptx.checks import dt as checks
from ptx.interpreter.emulated import EmulatedQueue

CHECKS = [getattr(checks, name) for name in sorted(vars(checks)) if name.startswith("check_")]
SMALL = [(3, 17, 130)]


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_in_lockstep(check):
    check(EmulatedQueue())


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_in_any_order(check, seed):
    check(EmulatedQueue(seed), SMALL)
