"""Every example runs as it is, in a process of its own and in an empty folder."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from limits import HANG_S

import stereokit

FOLDER = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
PLUGIN = FOLDER / "custom_refiner"
NEEDS = {
    "first_match": "skimage",
    "depth_and_points": "skimage",
    "beside_opencv": "skimage",
    "torch_zero_copy": "torch",
    "dask_cluster": "distributed",
}


@pytest.fixture
def run_example(run_python, tmp_path, monkeypatch):
    """Return a function that runs an example by name in an empty folder and returns what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(name, *arguments):
        if name in NEEDS:
            pytest.importorskip(NEEDS[name])
        return run_python("-W", "error", FOLDER / f"{name}.py", *arguments)

    return run


@pytest.fixture
def pair():
    """Write a random pair that is 5 pixels apart, with its calibration; return their names."""

    def write():
        left = np.random.default_rng(0).integers(0, 256, (40, 120), dtype=np.uint8)
        stereokit.io.write_image("left.png", left)
        stereokit.io.write_image("right.png", np.roll(left, -5, axis=1))
        Path("camera.json").write_text('{"fx": 100, "fy": 100, "cx0": 60, "cy": 20, "baseline_m": 0.2}')
        return "left.png", "right.png", "camera.json"

    return write


def test_there_are_examples():
    assert EXAMPLES and PLUGIN.is_dir()


@pytest.mark.parametrize("path", [*EXAMPLES, *PLUGIN.glob("*.py")], ids=lambda path: path.stem)
def test_an_example_is_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) < 40


@pytest.mark.parametrize("name", [path.stem for path in EXAMPLES])
def test_example(name, run_example):
    assert run_example(name).strip()


def test_custom_cost_finds_the_shift(run_example):
    assert run_example("custom_cost").count("median disparity 7.0 px") == 2


def test_first_match_takes_a_pair(run_example, pair):
    run_example("first_match", *pair()[:2])
    assert np.median(stereokit.read_disparity("disparity.pfm")) == pytest.approx(5, abs=0.3)
    assert stereokit.read_image("disparity.jpg").shape == (40, 120, 3)


def test_depth_and_points_takes_a_calibrated_pair(run_example, pair):
    printed = run_example("depth_and_points", *pair())
    assert "median 4.0 m, where one pixel is 0.80 m" in printed  # 100 px * 0.2 m / 5 px; 4 m ** 2 / (100 px * 0.2 m)
    header = Path("points.ply").read_bytes().split(b"end_header")[0].decode()
    assert f"element vertex {re.search(r'points.ply: ([0-9]+)', printed)[1]}" in header


def test_torch_tensors_share_memory(run_example):
    assert "median 9.0 px, no copy" in run_example("torch_zero_copy")


def test_beside_opencv_agrees_with_it(run_example):
    printed = run_example("beside_opencv")
    assert float(re.search(r"([0-9.]+) % agree within a pixel", printed)[1]) > 90


def test_video_tells_how_near_the_wall_is(run_example):
    lines = run_example("video").splitlines()
    assert [float(line.split()[4]) for line in lines] == pytest.approx(range(4, 12), abs=0.3)
    assert Path("disparity.avi").stat().st_size > 0


def test_the_cluster_makes_every_map(run_example):
    assert run_example("dask_cluster") == "12 maps written, 0 failed\n12 maps found\n"
    assert len(list(Path("maps").glob("*.png"))) == 12


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    """Build the example's package and install it into a folder; return the folder."""
    pytest.importorskip("hatchling")
    source, target = tmp_path_factory.mktemp("source") / "plugin", tmp_path_factory.mktemp("target")
    shutil.copytree(PLUGIN, source)
    flags = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "install", *flags, "--target", target, source]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False)
    assert done.returncode == 0, done.stderr
    return target


def test_an_installed_refiner_is_found_by_name(plugin, run_python, pair, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    left, right, _ = pair()
    here = {"PYTHONPATH": os.pathsep.join(filter(None, [str(plugin), os.environ.get("PYTHONPATH")]))}
    cli = ("-W", "error", "-m", "stereokit.cli")
    assert "guided" in run_python(*cli, "list", **here)
    common = (*cli, "match", left, right, "--scale", "0.5", "--refiner", "guided", "--set", "pull=4")
    run_python(*common, "-o", "disparity.npy", "--max-disparity", "16", "--fill", "none", **here)
    disparity = np.load("disparity.npy")
    assert disparity.shape == (40, 120)
    assert np.nanmedian(disparity) == pytest.approx(5, abs=0.5)
    assert "guided" not in run_python(*cli, "list")


def test_the_refiner_follows_the_image_and_keeps_the_contract(monkeypatch):
    monkeypatch.syspath_prepend(PLUGIN)
    from stereokit_guided import Guided

    left = np.zeros((5, 9), np.uint8)
    left[:, 5:] = 200  # the edge of the image runs through a half-size pixel of the map
    coarse = np.full((3, 5), 2, np.float32)
    coarse[:, 3:] = 7
    coarse[0, 0] = np.nan
    result = Guided(pull=1.0)(stereokit.Disparity(coarse, ~np.isnan(coarse)), left)
    np.testing.assert_array_equal(result.disparity[2:, :5], 4)
    np.testing.assert_array_equal(result.disparity[2:, 5:], 14)
    assert np.isnan(result.disparity[:2, :2]).all() and not result.valid[:2, :2].any() and result.valid[2:].all()
    with pytest.raises(stereokit.OptionError, match="pull must be at least 0 grey levels, got -1"):
        Guided(pull=-1)
