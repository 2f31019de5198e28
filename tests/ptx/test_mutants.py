"""Every planted flaw is caught as its kind says by a check that passes on the real module; planting leaves no trace."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from functools import cache

import pytest
from planting import Mutant, StaleMutant

from ptx.checks import sgm as sgm_checks
from ptx.interpreter import harness
from ptx.interpreter.emulated import EmulatedQueue
from ptx.interpreter.errors import UnknownInstruction
from ptx.mutants import __main__ as command
from ptx.mutants import table
from ptx.mutants.planter import Uncompiled, how_caught, planted
from stereokit.cuda.kernel import KERNELS

SURE = Mutant(
    "", "selection.wta_cuda", "confidence[at] = f32(0)", "confidence[at] = f32(1)", "", "sgm.check_zeroed_confidence"
)
NAME = "zero_invalid_confidence"


@cache
def _how_real(module: str, check: str) -> str:
    """Return the failure of a check when the module is imported anew as it is."""
    text = "from __future__ import annotations"
    return how_caught(Mutant("", module, text, text, "", check), **table.SIZES.get(check, {}))


def _state() -> tuple[object, ...]:
    """Return the modules, attributes and kernels that planting touches."""
    names = [name for name in sys.modules if name.startswith(("stereokit", "ptx"))]
    modules = {name: sys.modules[name] for name in names}
    attributes = {name: dict(vars(module)) for name, module in modules.items() if hasattr(module, "__path__")}
    return modules, attributes, list(KERNELS.items())


@pytest.mark.parametrize("mutant", table.MUTANTS, ids=lambda mutant: mutant.name.replace(" ", "-"))
def test_is_caught_as_its_kind_says(mutant):
    assert _how_real(mutant.module, mutant.check) == "", "the check fails on the real module"
    assert how_caught(mutant, **table.SIZES.get(mutant.check, {})) in table.OUTCOMES[mutant.kind]


def test_names_are_distinct():
    assert len({mutant.name for mutant in table.MUTANTS}) == len(table.MUTANTS)


def test_what_changes_nothing_survives():
    assert how_caught(replace(SURE, new="confidence[at] = f32(0.0)")) == ""
    assert how_caught(SURE) == "wrong result"


@pytest.mark.parametrize("old", ["no_such_name", "f32(0)"])
def test_code_that_is_not_there_once_is_refused(old):
    with pytest.raises(StaleMutant, match=r"must match once in selection\.wta_cuda, got \d+ times: '"):
        how_caught(replace(SURE, old=old))


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("confidence[at] = f32(0)", "confidence[at] = nowhere", Uncompiled),
        ("confidence[at] = f32(0)", "confidence[at] = f32(", SyntaxError),
        ("from stereokit.selection.wta import parabola", "pass", StaleMutant),
        (
            "from stereokit.selection.wta import margin_of, parabola",
            "from stereokit.selection.wta import margin_of, parable",
            ImportError,
        ),
        ("kernel(array(f32), array(u8), i32, block=128)", "kernel(array(f32), array(u8), block=128)", Uncompiled),
        ("kernel(array(f32), array(u8), i32, block=128)", "kernel(array(f32), array(u16), i32, block=128)", TypeError),
    ],
)
def test_what_does_not_run_is_no_catch(old, new, error):
    before = _state()
    with pytest.raises(error):
        how_caught(replace(SURE, old=old, new=new))
    assert _state() == before


def test_an_instruction_that_the_interpreter_lacks_is_no_catch(monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise UnknownInstruction("some.new.op")

    monkeypatch.setattr("ptx.interpreter.emulated.run", refuse)
    with pytest.raises(UnknownInstruction):
        how_caught(SURE)


def test_nothing_is_left_behind():
    sgm_checks.check_zeroed_confidence(EmulatedQueue())
    before, translated = _state(), dict(harness._TRANSLATIONS)
    with planted(SURE):
        flawed = KERNELS[NAME]
        users = "stereokit.selection.wta_cuda", "stereokit.aggregation.sgm_cuda", "stereokit.aggregation.dt_sum_cuda"
        for name in users:
            assert importlib.import_module(name) is not before[0][name]
        assert sys.modules["stereokit.selection"].wta_cuda.zero_invalid_confidence is flawed
        assert importlib.import_module("ptx.checks.sgm") is not sgm_checks
        harness.translation_of(flawed)
    assert _state() == before
    assert harness._TRANSLATIONS == translated
    assert KERNELS[NAME] is sgm_checks.wta_cuda.zero_invalid_confidence is not flawed
    sgm_checks.check_zeroed_confidence(EmulatedQueue())


def test_the_table_counts_survivors(monkeypatch, capsys):
    survivor = replace(SURE, name="the same", new="confidence[at] = f32(0.0)")
    monkeypatch.setattr(command, "MUTANTS", [SURE, survivor])
    assert command.main() == 1
    lines = capsys.readouterr().out.splitlines()
    assert "wrong result" in lines[0]
    assert "the same" in lines[1] and "SURVIVES" in lines[1]
    assert lines[2] == "1 of 2 caught"
