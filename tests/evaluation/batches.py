"""What the tests of batches share: small pairs on disk, the command in this process and in one of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import typer
from limits import HANG_S
from typer.testing import CliRunner

from stereokit.errors import StereokitError
from stereokit.io import write_image
from stereokit_evaluation.commands.batch import batch

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("--method", "S2", "--max-disparity", "16")
APP = typer.Typer()
APP.command()(batch)


def images(seed, shape=(32, 96), shift=4):
    left = cv2.GaussianBlur(np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8), (0, 0), 1)
    return left, np.roll(left, -shift, axis=1)


def write_pairs(root, names, shape=(32, 96), folders=("left", "right")):
    """Write shifted noise into two folders."""
    for folder in folders:
        (root / folder).mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(names):
        for folder, image in zip(folders, images(seed, shape), strict=True):
            write_image(root / folder / f"{name}.png", image)
    return root


def run(*words, status=0):
    """Run the command in this process; return its summary."""
    done = CliRunner().invoke(APP, [*map(str, words), *SMALL, "--json", "-"])
    assert done.exit_code == status, (done.output, done.exception)
    return json.loads(done.stdout[done.stdout.index("{") :])


def refused(*words):
    """Run the command in this process; return the one line that refuses it."""
    done = CliRunner().invoke(APP, [*map(str, words), *SMALL])
    assert isinstance(done.exception, StereokitError), (done.output, done.exception)
    assert len(str(done.exception).splitlines()) == 1
    return str(done.exception)


def start(*words, folder):
    """Start the command in a process of its own, its output in files of `folder`."""
    code = "from stereokit.cli.app import main; main()"
    with (folder / "stdout").open("w") as out, (folder / "stderr").open("w") as err:
        return subprocess.Popen(
            [sys.executable, "-c", code, "batch", *map(str, words), *SMALL], stdout=out, stderr=err, env=environment()
        )


def environment():
    paths = [str(ROOT), str(ROOT / "refiners"), str(ROOT / "evaluation")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def wait_for(condition, process=None, seconds=HANG_S):
    """Wait until `condition` holds; fail if the process ends before, or it takes too long."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        assert process is None or process.poll() is None, "the process has ended"
        time.sleep(0.01)


def inodes(folder, suffix=".png"):
    """Return what tells one written file from another."""
    numbers = {}
    for path in folder.glob(f"*{suffix}"):
        state = path.stat()
        numbers[path.name] = state.st_ino, state.st_mtime_ns
    return numbers
