"""Every example runs as it is, in a process of its own and in an empty folder."""

from __future__ import annotations

from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))


def test_there_are_examples():
    assert EXAMPLES


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.stem)
def test_example(script, run_python, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_python("-W", "error", script)


def test_custom_cost_finds_the_shift(run_python):
    script = next(path for path in EXAMPLES if path.stem == "custom_cost")
    assert run_python(script).count("median disparity 7.0 px") == 2
