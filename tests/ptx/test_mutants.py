"""Every planted flaw is found by its check, which passes on the real module; and planting leaves no trace."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from functools import cache

import pytest

from ptx import bodies_sgm, harness, mutants
from ptx.emulated import EmulatedQueue
from ptx.errors import UnknownInstruction
from ptx.mutation import Mutant, StaleMutant, Uncompiled, how_caught, planted
from stereokit.cuda.kernel import KERNELS

DOUBT = Mutant("", "selection.wta_cuda", "confidence[at] = f32(0)", "confidence[at] = f32(1)", "", "sgm.check_doubt")


@cache
def _how_real(module: str, check: str) -> str:
    """Return how a check fails when the module is imported anew as it is."""
    text = importlib.import_module(f"stereokit.{module}").__doc__
    return how_caught(Mutant("", module, text, text, "", check), **mutants.SIZES.get(check, {}))


def _state() -> tuple[object, ...]:
    """Return what planting touches."""
    names = [name for name in sys.modules if name.startswith(("stereokit", "ptx"))]
    modules = {name: sys.modules[name] for name in names}
    attributes = {name: dict(vars(module)) for name, module in modules.items() if hasattr(module, "__path__")}
    return modules, attributes, list(KERNELS.items())


@pytest.mark.parametrize("mutant", mutants.MUTANTS, ids=lambda mutant: mutant.name.replace(" ", "-"))
def test_is_caught(mutant):
    assert _how_real(mutant.module, mutant.check) == "", "the check fails on the real module"
    assert how_caught(mutant, **mutants.SIZES.get(mutant.check, {})), "the mutant survives"


def test_names_are_distinct():
    assert len({mutant.name for mutant in mutants.MUTANTS}) == len(mutants.MUTANTS)


def test_what_changes_nothing_survives():
    assert how_caught(replace(DOUBT, new="confidence[at] = f32(0.0)")) == ""
    assert how_caught(DOUBT) == "wrong result"


@pytest.mark.parametrize("old", ["no such text", "confident"])
def test_a_text_that_is_not_there_once_is_refused(old):
    with pytest.raises(StaleMutant, match=r"must occur once in stereokit\.selection\.wta_cuda, got \d+ times: '"):
        how_caught(replace(DOUBT, old=old))


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("confidence[at] = f32(0)", "confidence[at] = nowhere", Uncompiled),
        ("confidence[at] = f32(0)", "confidence[at] = f32(", SyntaxError),
        ("import parabola", "import parable", StaleMutant),
        ("import margin_of, parabola", "import margin_of, parable", ImportError),
        ("@kernel(array(f32), array(u8), i32, block=128)", "@kernel(array(f32), array(u8), block=128)", Uncompiled),
        ("array(f32), array(u8), i32, block=128)\ndef d", "array(f32), array(u16), i32, block=128)\ndef d", TypeError),
    ],
)
def test_what_does_not_run_is_no_catch(old, new, error):
    before = _state()
    with pytest.raises(error):
        how_caught(replace(DOUBT, old=old, new=new))
    assert _state() == before


def test_an_instruction_that_the_interpreter_lacks_is_no_catch(monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise UnknownInstruction("some.new.op")

    monkeypatch.setattr("ptx.emulated.run", refuse)
    with pytest.raises(UnknownInstruction):
        how_caught(DOUBT)


def test_nothing_is_left_behind():
    bodies_sgm.check_doubt(EmulatedQueue())
    before, translated = _state(), dict(harness._TRANSLATIONS)
    with planted("stereokit.selection.wta_cuda", DOUBT.old, DOUBT.new):
        flawed = KERNELS["doubt"]
        users = "stereokit.selection.wta_cuda", "stereokit.aggregation.sgm_cuda", "stereokit.aggregation.dt_sum_cuda"
        for name in users:
            assert importlib.import_module(name) is not before[0][name]
        assert sys.modules["stereokit.selection"].wta_cuda.doubt is flawed
        assert importlib.import_module("ptx.bodies_sgm") is not bodies_sgm
        harness.translation_of(flawed)
    assert _state() == before
    assert harness._TRANSLATIONS == translated
    assert KERNELS["doubt"] is bodies_sgm.wta_cuda.doubt is not flawed
    bodies_sgm.check_doubt(EmulatedQueue())


def test_the_table_counts_survivors(monkeypatch, capsys):
    survivor = replace(DOUBT, name="the same", new="confidence[at] = f32(0.0)")
    monkeypatch.setattr(mutants, "MUTANTS", [DOUBT, survivor])
    assert mutants.main() == 1
    lines = capsys.readouterr().out.splitlines()
    assert "wrong result" in lines[0]
    assert "the same" in lines[1] and "SURVIVES" in lines[1]
    assert lines[2] == "1 of 2 caught"
