"""Every kernel compiles and assembles for each supported card, without doubles, spills or a stack, in its budget."""

from __future__ import annotations

import json

import pytest

from ptx import budgets

NAMES = sorted(budgets.kernels())
BUDGET = json.loads(budgets.TABLE.read_text(encoding="utf-8"))
SLACK = 8  # registers that another version of the compiler may take


def test_every_kernel_has_a_budget_and_no_other():
    assert sorted(BUDGET) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_no_doubles(name):
    assert ".f64" not in budgets.ptx(name)


@pytest.mark.skipif(budgets.assembler() is None, reason="ptxas is not installed: pip install 'stereokit[cuda-test]'")
@pytest.mark.parametrize("name", NAMES)
def test_budget(name):
    for architecture in budgets.ARCHITECTURES:
        found = budgets.resources(name, architecture)
        assert found["stack"] == found["spilled"] == 0, (architecture, found)
        assert found["registers"] <= BUDGET[name][architecture] + SLACK, (architecture, found)
