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
        found, kept = budgets.resources(name, architecture), BUDGET[name][architecture]
        assert found["stack"] == found["spilled"] == 0, (architecture, found)
        assert found["registers"] <= kept["registers"] + REGISTERS, (architecture, found)
        assert found["occupancy"] >= OCCUPANCY * kept["occupancy"], (architecture, found)
        assert found["hot_loop"] <= LOOP * kept["hot_loop"] + FEW, (architecture, found)
