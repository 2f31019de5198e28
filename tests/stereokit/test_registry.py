"""Names: registering, finding, and plug-ins that other packages announce."""

from __future__ import annotations

import pytest

import stereokit
from stereokit import OptionError, UnknownNameError
from stereokit.registry import Registry


@pytest.fixture
def registry():
    return Registry("tool", "stereokit.test_tools")


def test_the_built_in_names():
    assert {"census", "zncc"} <= set(stereokit.COSTS.names())
    assert {"dt", "sgm"} <= set(stereokit.AGGREGATIONS.names())
    assert "linear" in stereokit.REFINERS.names()
    assert stereokit.COSTS.get("Census") is stereokit.Census
    assert stereokit.COSTS.get("ZNCC") is stereokit.Zncc


def test_what_is_registered_is_found_in_any_case(registry):
    @registry.register("Hammer")
    def hammer():
        return 1

    assert hammer() == 1
    assert registry.get("hammer") is registry.get("HAMMER") is hammer
    assert registry.names() == ("hammer",)


@pytest.mark.parametrize("name", ["", "a+b"])
def test_names_that_cannot_be_part_of_a_method(registry, name):
    with pytest.raises(OptionError, match="name must be non-empty and without"):
        registry.register(name)
    assert registry.names() == ()


def test_a_name_is_given_once(registry):
    registry.register("saw")(1)
    with pytest.raises(OptionError, match="'saw' is already registered"):
        registry.register("SAW")
    assert registry.get("saw") == 1


def test_unknown_names_suggest_the_nearest(registry):
    registry.register("hammer")(1)
    registry.register("saw")(2)
    with pytest.raises(UnknownNameError, match=r"no tool named 'hamer'; did you mean 'hammer'.* Known: hammer, saw"):
        registry.get("hamer")
    with pytest.raises(UnknownNameError, match=r"no tool named 'x'\. Known: hammer, saw"):
        registry.get("x")


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Install a distribution that announces two tools, one of which cannot be imported."""
    (tmp_path / "stereokit_test_plugin.py").write_text("tool = 'a plugged-in tool'\n")
    info = tmp_path / "stereokit_test_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stereokit-test-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[stereokit.test_tools]\nDrill = stereokit_test_plugin:tool\nbroken = stereokit_no_such_module:tool\n"
    )
    monkeypatch.syspath_prepend(tmp_path)


def test_plugins_are_found_by_name_and_imported_when_asked_for(registry, plugin):
    import sys

    sys.modules.pop("stereokit_test_plugin", None)
    assert registry.names() == ("broken", "drill")
    assert "stereokit_test_plugin" not in sys.modules
    assert registry.get("drill") == registry.get("DRILL") == "a plugged-in tool"


def test_a_plugin_that_fails_does_not_hide_the_others(registry, plugin):
    with pytest.raises(ImportError):
        registry.get("broken")
    assert registry.get("drill") == "a plugged-in tool"


def test_what_is_registered_comes_before_a_plugin_of_that_name(registry, plugin):
    registry.register("drill")("mine")
    assert registry.get("drill") == "mine"
    assert registry.names() == ("broken", "drill")
