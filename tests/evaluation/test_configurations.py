"""The grid: what is in it, what is missing and why, and what a configuration's results depend on."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

import numpy as np
import pytest

from stereokit.errors import FileError, OptionError, UnknownNameError
from stereokit.registry import REFINERS
from stereokit_evaluation.study import configurations
from stereokit_evaluation.study.configurations import (
    available_variants,
    baseline,
    build,
    describe_error,
    parse_variant,
    title,
)
from stereokit_refiners import Linear


@pytest.fixture
def refiner(monkeypatch):
    """Let there be one refiner, linear; return a function that registers another for the test."""
    monkeypatch.setattr(REFINERS, "_entries", lambda: ())
    monkeypatch.setattr(REFINERS, "_items", {"linear": Linear})

    def register(name, factory):
        REFINERS._items[name] = factory

    return register


class Weighted(Linear):
    fingerprint = "first"


def identities(cells):
    return {cell.name: cell.identity for cell in cells}


def test_settings_have_the_papers_names(refiner):
    refiner("mine", Linear)
    assert [title(name) for name in ("linear", "original", "cnn", "mine")] == [
        "Mini+Linear",
        "Original",
        "Mini+CNN",
        "Mini+mine",
    ]
    assert {"linear", "original", "cnn", "stereovae", "mine"} <= set(available_variants())
    assert parse_variant(" Mini+Linear ") == "linear" and parse_variant("MINE") == "mine"
    with pytest.raises(UnknownNameError, match="no variant named 'orignal'; did you mean 'original'"):
        parse_variant("orignal")


def test_the_grid_is_methods_times_settings():
    cells = build(["S1", "zncc+sgm", "S4"], ["linear", "original"], {"max_disparity": 32})
    assert [cell.name for cell in cells] == ["S1 Mini+Linear", "S1 Original", "S4 Mini+Linear", "S4 Original"]
    assert [cell.scale for cell in cells] == [0.5, 1.0, 0.5, 1.0]
    assert all(cell.matcher is not None and cell.missing is None for cell in cells)


def test_a_refiner_that_is_not_there_is_missing_with_the_reason(refiner):
    def no_runtime():
        raise ModuleNotFoundError("No module named 'openvino'", name="openvino")

    refiner("cnn", no_runtime)
    cells = {cell.variant: cell for cell in build(["S2"], ["linear", "cnn", "stereovae"], {})}
    assert cells["linear"].missing is None
    assert cells["cnn"].missing == "needs the package 'openvino', which is not installed"
    assert cells["stereovae"].missing == "no refiner named 'stereovae' is installed"
    assert cells["cnn"].matcher is None and cells["stereovae"].matcher is None


def test_an_option_goes_to_the_methods_that_have_its_stage():
    plain = identities(build(["S1", "S2", "S4"], ["original", "linear"], {}))
    changed = identities(build(["S1", "S2", "S4"], ["original", "linear"], {"p1": 3}))
    assert [name for name in plain if plain[name] != changed[name]] == [
        "S2 Original",
        "S2 Mini+Linear",
        "S4 Original",
        "S4 Mini+Linear",
    ]
    with pytest.raises(OptionError, match="option 'p1' must belong to a chosen method, got census\\+dt"):
        build(["S1"], ["original"], {"p1": 3})


@pytest.mark.parametrize("options", [{"nonsense": 1}, {"median": 4}, {"window": "3x3"}])
def test_bad_options_are_the_users_and_make_nothing_missing(options):
    for settings in (["original"], ["linear"], ["cnn"]):
        with pytest.raises(OptionError):
            build(["S2"], settings, options)


def test_threads_do_not_change_what_a_map_depends_on():
    first, second = (identities(build(["S4"], ["original", "linear"], {"threads": n})) for n in (1, 2))
    assert first == second


def test_weights_belong_to_the_identity(refiner, monkeypatch):
    refiner("linear", Weighted)
    first = identities(build(["S2"], ["linear", "original"], {}))
    monkeypatch.setattr(Weighted, "fingerprint", lambda self: "second")
    second = identities(build(["S2"], ["linear", "original"], {}))
    assert first["S2 Mini+Linear"]["refiner"]["weights"] == "first"
    assert second["S2 Mini+Linear"]["refiner"]["weights"] == "second"
    assert first["S2 Original"] == second["S2 Original"]


def test_identities_hold_no_addresses():
    class Plain:
        pass

    assert " at 0x" not in configurations._stable(Plain())
    again = [identities(build(["S1", "S4"], ["linear", "original"], {})) for _ in range(2)]
    assert again[0] == again[1]


def test_a_refiner_trained_for_one_method_serves_only_that(refiner):
    cells = build(["S2", "S4"], ["cnn"], {}, {("zncc+sgm", "cnn"): Weighted()})
    assert cells[0].missing == "no refiner named 'cnn' is installed"
    assert cells[1].missing is None and cells[1].name == "S4 Mini+CNN"
    assert cells[1].identity["refiner"]["weights"] == "first"


def test_options_of_a_refiner_go_to_it_alone(refiner):
    @dataclass(frozen=True)
    class Tuned(Linear):
        strength: int = 1

    refiner("tuned", Tuned)
    plain = identities(build(["S2"], ["linear", "original", "tuned"], {}))
    changed = identities(build(["S2"], ["linear", "original", "tuned"], {"strength": 3}))
    assert [name for name in plain if plain[name] != changed[name]] == ["S2 Mini+tuned"]
    with pytest.raises(OptionError, match="no option named 'strength'"):
        build(["S2"], ["linear", "original"], {"strength": 3})


def test_a_weight_file_is_a_setting(tmp_path):
    with pytest.raises(FileError, match="variant must name a weight file that exists"):
        parse_variant(str(tmp_path / "none.safetensors"))
    (tmp_path / "mine.safetensors").write_bytes(b"not weights")
    setting = parse_variant(str(tmp_path / "mine.safetensors"))
    (cell,) = build(["S2"], [setting], {})
    assert cell.name == "S2 Mini+mine" and cell.matcher is None and cell.missing
    assert "file" not in available_variants()


def test_fingerprints_follow_content(tmp_path):
    (tmp_path / "a.py").write_text("1")
    (tmp_path / "w.bin").write_text("1")
    source, everything = configurations.fingerprint(tmp_path), configurations.fingerprint(tmp_path, everything=True)
    configurations.fingerprint.cache_clear()
    (tmp_path / "w.bin").write_text("2")
    assert configurations.fingerprint(tmp_path) == source
    assert configurations.fingerprint(tmp_path, everything=True) != everything


def test_a_module_of_its_own_is_its_file_and_not_the_folder_around_it(tmp_path, monkeypatch):
    (tmp_path / "lone_refiner.py").write_text("class Lone:\n    pass\n")
    (tmp_path / "neighbour.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    refiner = importlib.import_module("lone_refiner").Lone()
    before = configurations._weights(refiner)
    configurations.fingerprint.cache_clear()
    (tmp_path / "neighbour.py").write_text("changed = True")
    assert configurations._weights(refiner) == before
    configurations.fingerprint.cache_clear()
    (tmp_path / "lone_refiner.py").write_text("class Lone:\n    changed = True\n")
    assert configurations._weights(refiner) != before


def test_errors_are_one_line():
    assert describe_error(RuntimeError("a\n b")) == "RuntimeError: a b"
    assert describe_error(OptionError("p1 must be 3")) == "p1 must be 3"
    assert describe_error(MemoryError()) == "MemoryError"


def test_opencv_gets_its_leftmost_columns_too(random_pair):
    left, _ = random_pair(40, 120)
    right = np.roll(left, -6, axis=1)
    result = baseline("OpenCV HH", 20).matcher(left, right)
    assert result.disparity.shape == left.shape
    assert abs(np.nanmedian(result.disparity[:, 40:]) - 6) < 0.5
    assert np.isfinite(result.disparity[:, 6:12]).mean() > 0.5  # unpadded, the first 32 columns have none
