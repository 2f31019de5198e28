"""What the metadata promise: bounds where private parts of numba are used, and the licences of all that is shipped."""

from __future__ import annotations

import re
from importlib.metadata import metadata, requires
from pathlib import Path

import numba
import pytest
from packaging.requirements import Requirement
from packaging.version import Version
from safetensors import safe_open

ROOT = Path(__file__).parents[1]
PACKAGES = ("stereokit", "refiners/stereokit_refiners", "evaluation/stereokit_evaluation")
PRIVATE = {
    "stereokit/kernels/cache.py": {"numba.core.caching"},
    "stereokit/kernels/jit.py": {
        "_nrt",
        "forceinline",
        "no_cfunc_wrapper",
        "no_cpython_wrapper",
        "numba.core.registry",
    },
    "stereokit/cuda/kernel.py": {"numba.cuda", "forceinline"},
}
"""What is used of numba that its documentation does not promise, by file."""


def sources():
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")


def test_private_parts_of_numba_are_used_where_it_is_said():
    used: dict[str, set[str]] = {}
    for name, text in sources():
        parts = set(re.findall(r"""["']?(_nrt|forceinline|no_cfunc_wrapper|no_cpython_wrapper)["']?\s*[=:]""", text))
        parts |= set(
            re.findall(r"^from (numba\.cuda|numba\.core\.caching|numba\.core\.registry) import", text, flags=re.M)
        )
        if parts:
            used[name] = parts
    assert used == PRIVATE


def test_numba_takes_the_private_options():
    flags = {"_nrt": False, "forceinline": True, "no_cfunc_wrapper": True}
    assert numba.njit(**flags)(lambda x: x + 1)(1) == 2


def test_the_range_of_numba_is_bounded_and_holds_the_installed_one():
    (numba_requirement,) = (r for r in map(Requirement, requires("stereokit")) if r.name == "numba")
    assert any(part.operator in ("<", "<=") for part in numba_requirement.specifier)
    assert Version(numba.__version__) in numba_requirement.specifier


def test_the_licence_is_in_the_metadata():
    assert metadata("stereokit")["License-Expression"] == "MIT"
    assert metadata("stereokit").get_all("License-File") == ["LICENSE"]


def test_weights_that_are_not_for_commercial_use_are_a_distribution_of_their_own():
    folder = pytest.importorskip("stereokit_kitti_weights").__path__[0]
    description = metadata("stereokit-kitti-weights")
    assert description["License-Expression"] == "CC-BY-NC-SA-3.0"
    assert "CC BY-NC-SA 3.0" in (ROOT / "refiners/kitti/LICENSE").read_text(encoding="utf-8")
    assert {path.stem for path in Path(folder).glob("*.safetensors")} == {"cnn", "evidence", "pyramid", "stereovae"}


SHIPPED = ["cnn.safetensors", "evidence.safetensors", "stereovae.safetensors"]


def test_the_main_distribution_holds_no_weights_trained_on_kitti():
    weights = [path for package in PACKAGES for path in (ROOT / package).rglob("*.safetensors")]
    assert sorted(path.name for path in weights) == SHIPPED
    for path in weights:
        with safe_open(path, framework="np") as file:
            assert "kitti" not in file.metadata()["notes"].lower()


@pytest.mark.parametrize("kind", ["WheelBuilder", "SdistBuilder"])
def test_what_is_built_holds_none_either(kind):
    module = "hatchling.builders." + kind.removesuffix("Builder").lower()
    builder = getattr(pytest.importorskip(module), kind)(str(ROOT))
    names = [file.distribution_path for file in builder.recurse_included_files()]
    assert sorted(name.rpartition("/")[2] for name in names if name.endswith(".safetensors")) == SHIPPED
    assert not any("kitti_weights" in name for name in names)


@pytest.mark.parametrize(("old", "new"), [("evaluation", "scenes"), ("fast", "refiners"), ("large", "tiff")])
def test_extras_have_their_old_names_too(old, new):
    required = {name: set() for name in metadata("stereokit").get_all("Provides-Extra")}
    for requirement in map(Requirement, requires("stereokit")):
        for extra in (old, new):
            if requirement.marker is not None and requirement.marker.evaluate({"extra": extra}):
                required[extra].add(requirement.name)
    assert required[old] == required[new] != set()


@pytest.mark.parametrize("name", ["stereokit", "stereokit_refiners", "stereokit_evaluation"])
def test_packages_are_typed(name):
    folder = next(ROOT / package for package in PACKAGES if package.endswith(name))
    assert (folder / "py.typed").is_file()
