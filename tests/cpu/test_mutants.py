"""Every planted flaw is caught by its check as its kind says; the check passes on the real modules; nothing stays."""

from __future__ import annotations

import sys
from dataclasses import replace

import pytest
from planting import Mutant, StaleMutant

from cpu import mutants
from cpu.checks import CHECKS
from cpu.interpreter import interpreted
from cpu.mutants import MUTANTS, OUTCOMES, how_caught

CUT = next(mutant for mutant in MUTANTS if mutant.module == "postprocess.fill")


@pytest.mark.parametrize("check", CHECKS)
def test_the_real_modules_pass(check):
    with interpreted():
        CHECKS[check]()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name.replace(" ", "-"))
def test_is_caught_as_its_kind_says(mutant):
    assert how_caught(mutant) == OUTCOMES[mutant.kind]


def test_every_kernel_has_mutants_of_distinct_names():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 20
    rooms = {mutant.module.rpartition(".")[0] + "." + mutant.module.rpartition(".")[2] for mutant in MUTANTS}
    for module in ("costs.census", "costs.zncc", "costs.rows", "aggregation.sgm", "aggregation.dt", "selection.wta"):
        assert module in rooms
    for module in ("penalties", "steps", "visits"):
        assert f"aggregation.paths.{module}" in rooms
    for module in ("smp", "fill", "median", "speckle"):
        assert f"postprocess.{module}" in rooms
    assert {mutant.check for mutant in MUTANTS} <= set(CHECKS)


def test_a_mutant_that_changes_nothing_survives():
    assert how_caught(replace(CUT, new=CUT.old)) == ""


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("no_such_name + 1", "0", StaleMutant),
        (CUT.old, "row[:x] = nowhere", NameError),
        (CUT.old, "row[:x] = (", SyntaxError),
    ],
)
def test_what_does_not_run_is_no_catch(old, new, error):
    modules = dict(sys.modules)
    with pytest.raises(error):
        how_caught(replace(CUT, old=old, new=new))
    assert {name: sys.modules[name] for name in modules} == modules


def test_nothing_is_left_behind():
    import stereokit
    from stereokit.postprocess import fill

    modules, finders = dict(sys.modules), list(sys.meta_path)
    with interpreted(CUT):
        import stereokit as copy
        from stereokit.postprocess import fill as flawed_fill

        assert copy is not stereokit and flawed_fill is not fill
        assert not hasattr(sys.modules["stereokit.postprocess.fill"].fill_rows, "py_func")
    assert {name: sys.modules[name] for name in modules} == modules and sys.meta_path == finders
    assert {name for name in set(sys.modules) - set(modules) if name.startswith("stereokit")} == set()


def test_the_table_counts_survivors(monkeypatch, capsys):
    survivor = replace(CUT, name="the same", new=CUT.old)
    monkeypatch.setattr(mutants, "MUTANTS", [CUT, survivor])
    assert mutants.main() == 1
    lines = capsys.readouterr().out.splitlines()
    assert "wrong result" in lines[0]
    assert "the same" in lines[1] and "SURVIVES" in lines[1]
    assert lines[2] == "1 of 2 caught"


def test_kinds_that_a_check_does_not_have_are_refused():
    assert set(OUTCOMES) >= {mutant.kind for mutant in MUTANTS}
    assert how_caught(Mutant("", "costs.census", "min(8 * plane + 8, dy.size)", "8 * plane + 8", "", "census")) != ""
