"""Options by their types: what a type checker accepts is what the stages have."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import fields

import pytest

import stereokit
from stereokit.methods import option_names
from stereokit.options import OPENCV_NAMES, MatchOptions, StageOptions
from stereokit.registry import AGGREGATIONS, COSTS, REFINERS
from stereokit.settings import MatchSettings


def test_the_typed_options_are_those_that_exist():
    stages = {
        name for registry in (COSTS, AGGREGATIONS, REFINERS) for stage in registry.names()
        for name in option_names(registry.get(stage))
    }  # fmt: skip
    own = {"method", "levels", "scale", "cost", "aggregation", "refiner", "refiner_name"}
    pipeline = {field.name for field in fields(MatchSettings)} - own
    assert set(StageOptions.__annotations__) == stages | pipeline | {"outside"}
    matcher = {"max_disparity", "min_disparity", "scale", "refiner", "device", "threads"}
    assert set(MatchOptions.__annotations__) == set(StageOptions.__annotations__) | matcher


LINES = {
    'stereokit.Matcher("S2", uniquenessRatio=3)': "Unexpected keyword argument",
    'stereokit.Matcher("S2", paths=3)': "incompatible type",
    "stereokit.match(left, left, fill='neares')": "incompatible type",
    "stereokit.match(left, left, numDisparities=64)": "Unexpected keyword argument",
    'stereokit.Matcher("S2", uniqueness=3, paths=8, fill=None, scale=0.5, refiner="linear")': "",
    "stereokit.match(left, left, method='S4', steps=15, device='cpu', threads=2)": "",
    'stereokit.Matcher("mine+sgm", **own)': "",
}


def test_a_type_checker_sees_wrong_options(tmp_path):
    pytest.importorskip("mypy")
    head = [
        "from typing import Any", "import numpy as np", "import stereokit", "left = np.zeros((4, 8), np.uint8)",
        'own: dict[str, Any] = {"mine": 1}',
    ]  # fmt: skip
    script = tmp_path / "script.py"
    script.write_text("\n".join([*head, *LINES]) + "\n")
    options = ["--follow-imports=silent", "--ignore-missing-imports", "--cache-dir", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, str(script)], capture_output=True, text=True, check=False
    )
    errors = {int(number): text for number, text in re.findall(r"script.py:(\d+): error: (.*)", done.stdout)}
    wrong = {number: error for number, error in enumerate(LINES.values(), len(head) + 1) if error}
    assert errors.keys() == wrong.keys(), done.stdout + done.stderr
    assert all(error in errors[number] for number, error in wrong.items())


@pytest.mark.parametrize("name", OPENCV_NAMES)
def test_opencvs_names_are_recognised(name):
    with pytest.raises(
        stereokit.OptionError, match=f"option '{name}' is OpenCV's: it (is|has no counterpart)"
    ) as caught:
        stereokit.Matcher(**{name: 5})
    own = OPENCV_NAMES[name].split(" ")[0]
    assert own in str(caught.value)
    assert "\n" not in str(caught.value)
    if own:
        assert own in MatchOptions.__annotations__
