"""``stereokit warmup``: later commands find everything compiled."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stereokit.cli.app import app


def run(cache, *arguments):
    """Run the command line as a new process with a folder of compiled kernels; return its lines, and those beside."""
    done = subprocess.run(
        [sys.executable, "-m", "stereokit.cli", *map(str, arguments)],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache)}, capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), done.stderr.splitlines()


def test_a_later_match_compiles_nothing(tmp_path):
    cache = tmp_path / "cache"
    (line,), (word,) = run(cache, "warmup", "S2", "--max-disparity", 16)
    assert re.fullmatch(r"S2: \d+\.\d s", line)
    assert word.startswith("compiling kernels") and str(cache) in word  # said once, though there is no terminal
    compiled = {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb?")}
    assert len(compiled) > 5
    image = np.random.default_rng(0).integers(0, 256, (123, 177), np.uint8)  # large enough for speckles
    for name in ("left.png", "right.png"):
        cv2.imwrite(str(tmp_path / name), image)
    pair = tmp_path / "left.png", tmp_path / "right.png"
    _, beside = run(cache, "match", *pair, "-o", tmp_path / "m.pfm", "--max-disparity", 16)
    assert not any("compiling" in line for line in beside)
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.nb?")} == compiled


@pytest.mark.parametrize("arguments", [["S9"], ["S2", "S9"], ["--max-disparity", "0"], ["--refiner", "nobody"]])
def test_wrong_arguments_end_with_one_line_and_2_before_anything_is_compiled(arguments):
    result = CliRunner().invoke(app, ["warmup", *arguments])
    assert result.exit_code == 2
    assert len(result.output.strip().splitlines()) == 1
