"""CONTRIBUTING's steps work: they add a cost, a data set and a command to a copy of the checkout, which runs them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import numpy as np
import pytest
from limits import HANG_S
from test_docs import INTERNAL

ROOT = Path(__file__).parents[1]
FENCE = re.compile(r"^ *```(?:python|rst|toml)\n(?P<body>.*?)^ *```$", re.M | re.S)
LIMITS = {"cost": 4, "data set": 2, "command": 2}
"""Files that an addition may touch."""
WORDS = {2: "two", 4: "four"}


def sections() -> dict[str, str]:
    """Return the text of each section on how to add something."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    parts = re.findall(r"^## Add an? ([\w ]+) in (\w+) files\n(.*?)(?=^## )", text, re.M | re.S)
    return {name: (count, body) for name, count, body in parts}


def additions(body: str) -> list[tuple[str, str, str]]:
    """Return file, place in it and text of each block."""
    blocks = []
    for block in FENCE.finditer(body):
        first, _, text = textwrap.dedent(block["body"]).partition("\n")
        path, place = re.fullmatch(r"(?:#|\.\.) (\S+) ?(.*)", first).groups()
        blocks.append((path, place, text))
    return blocks


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """Return a copy of the checkout to which everything has been added."""
    root = tmp_path_factory.mktemp("checkout")
    skipped = shutil.ignore_patterns("__pycache__", "*.safetensors", "_build", "_generated", "_static")
    for name in ("stereokit", "refiners", "evaluation", "tests", "docs"):
        shutil.copytree(ROOT / name, root / name, ignore=skipped)
    for name in ("pyproject.toml", "README.md", "CONTRIBUTING.md"):
        shutil.copy(ROOT / name, root / name)
    for _, body in sections().values():
        for path, place, text in additions(body):
            target = root / path
            before = target.read_text(encoding="utf-8") if target.exists() else ""
            if place:
                assert before.count(f"{place}\n") == 1
                after = before.replace(f"{place}\n", f"{place}\n{text}")
            else:
                after = f"{before}\n\n{text}" if before else text
            target.write_text(after, encoding="utf-8")
    install(root)
    return root


def install(root: Path) -> None:
    """Write what an installation of the copy would register."""
    project = (root / "pyproject.toml").read_text(encoding="utf-8")
    groups = re.findall(r'^\[project\.entry-points\."(.+)"\]\n((?:.+\n)+)', project, re.M)
    metadata = root / "stereokit-0.1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: stereokit\nVersion: 0.1.0\n")
    lines = [f"[{group}]\n{body.replace(chr(34), '')}\n" for group, body in groups]
    (metadata / "entry_points.txt").write_text("".join(lines))


@pytest.fixture(scope="module")
def run(checkout, tmp_path_factory):
    """Return a function that runs a module in the copy and returns its output."""
    packages = os.pathsep.join(str(checkout / part) for part in ("", "refiners", "evaluation"))
    environment = {**os.environ, "PYTHONPATH": packages, "NUMBA_CACHE_DIR": str(tmp_path_factory.mktemp("cache"))}

    def run(*arguments):
        command = [sys.executable, "-m", *map(str, arguments)]
        done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, timeout=HANG_S)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


def test_the_steps_touch_no_more_files_than_they_say():
    assert set(sections()) == set(LIMITS)
    for name, (count, body) in sections().items():
        files = {path for path, _, _ in additions(body)}
        assert len(files) == LIMITS[name] and count == WORDS[LIMITS[name]], (name, files)


def test_the_added_modules_are_in_the_reference_or_need_not_be(checkout):
    reference = "".join(path.read_text(encoding="utf-8") for path in (checkout / "docs" / "api").glob("*.rst"))
    modules = []
    for _, body in sections().values():
        for path, _, text in additions(body):
            if "__all__" in text:
                modules.append(re.sub(r"^(evaluation|refiners)/", "", path).removesuffix(".py").replace("/", "."))
    assert len(modules) == 2
    for module in modules:
        assert INTERNAL.match(module) or f"automodule:: {module}\n" in reference


def test_the_tests_of_the_steps_pass(run):
    done = run(
        "pytest", "-q", "-p", "no:cacheprovider", "tests/stereokit/test_absolute.py",
        "tests/evaluation/test_datasets.py", "-k", "absolute or strips or without_frames or unknown",
    )  # fmt: skip
    passed = int(re.search(r"(\d+) passed", done)[1])
    assert passed >= 6 and "failed" not in done and "skipped" not in done, done


def test_the_added_command_runs_and_the_help_names_the_added_data_set(run, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((3, 5), np.uint8))
    assert run("stereokit.cli", "sizes", tmp_path / "a.png") == "a.png: 5x3\n"
    words = " ".join(run("stereokit.cli", "evaluate", "--help").split())
    assert "strips" in words
