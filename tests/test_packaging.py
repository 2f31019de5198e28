"""What the metadata promise: bounds where private parts of numba are used, and the licences of all that is shipped."""

from __future__ import annotations

import re
from importlib.metadata import metadata, requires
from pathlib import Path

import numba
import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
PACKAGES = ("stereokit", "refiners/stereokit_refiners", "evaluation/stereokit_evaluation")
PRIVATE = {
    "stereokit/kernels/cache.py": {"numba.core.caching"},
    "stereokit/kernels/jit.py": {"_nrt", "forceinline"},
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
        found = set(re.findall(r"""["']?(_nrt|forceinline)["']?\s*[=:]""", text))
        found |= set(re.findall(r"^from (numba\.cuda|numba\.core\.caching) import", text, flags=re.M))
        if found:
            used[name] = found
    assert used == PRIVATE


def test_numba_takes_the_private_options():
    flags = {"_nrt": False, "forceinline": True}
    assert numba.njit(**flags)(lambda x: x + 1)(1) == 2


def test_the_range_of_numba_is_bounded_and_holds_the_installed_one():
    (numba_requirement,) = (r for r in map(Requirement, requires("stereokit")) if r.name == "numba")
    assert any(part.operator in ("<", "<=") for part in numba_requirement.specifier)
    assert Version(numba.__version__) in numba_requirement.specifier


def test_the_licence_of_the_weights_is_in_the_metadata():
    text = (ROOT / "refiners/stereokit_refiners/weights/LICENSE").read_text(encoding="utf-8")
    expression = metadata("stereokit")["License-Expression"]
    assert expression == "MIT AND CC-BY-NC-SA-3.0"
    assert "CC BY-NC-SA 3.0" in text
    files = metadata("stereokit").get_all("License-File")
    assert set(files) == {"LICENSE", "refiners/stereokit_refiners/weights/LICENSE"}


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
