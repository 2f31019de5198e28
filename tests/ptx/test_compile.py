"""Every kernel compiles and assembles for each supported card, without doubles, spills or a stack, in its budget."""

from __future__ import annotations

import json

import pytest

from ptx import budgets

NAMES = sorted(budgets.kernels())
BUDGET = json.loads(budgets.TABLE.read_text(encoding="utf-8"))
# What another version of the compiler may take: registers, share of the occupancy, and share of the hot loop with a few
# instructions of any loop.
REGISTERS, OCCUPANCY, LOOP, FEW = 8, 0.7, 1.15, 8


def test_every_kernel_has_a_budget_and_no_other():
    assert sorted(BUDGET) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_no_doubles(name):
    assert ".f64" not in budgets.ptx(name)


@pytest.mark.skipif(not budgets.has_tools(), reason="no ptxas and nvdisasm: pip install 'stereokit[cuda-test]'")
@pytest.mark.parametrize("name", NAMES)
def test_budget(name):
    for architecture in budgets.ARCHITECTURES:
        needs, budget = budgets.resources(name, architecture), BUDGET[name][architecture]
        assert needs["stack"] == needs["spilled"] == 0, (architecture, needs)
        assert needs["registers"] <= budget["registers"] + REGISTERS, (architecture, needs)
        assert needs["occupancy"] >= OCCUPANCY * budget["occupancy"], (architecture, needs)
        assert needs["hot_loop"] <= LOOP * budget["hot_loop"] + FEW, (architecture, needs)
