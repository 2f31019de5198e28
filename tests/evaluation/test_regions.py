"""D1 by kind of pixel: masks by hand, counts by loops, and the command on small scenes."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from stereokit.errors import OptionError
from stereokit_evaluation.commands.regions import regions
from stereokit_evaluation.data import datasets
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.study.configurations import Configuration
from stereokit_evaluation.study.regions import masks, measure_regions

APP = typer.Typer()
APP.command()(regions)
NAN = np.nan


def test_every_pixel_with_truth_is_in_its_regions():
    occ = np.array([[NAN, 4, 8, 8.5], [16, 17, 32, 33]], np.float32)
    noc = np.where(np.arange(4) == 3, NAN, occ).astype(np.float32)
    objects = np.array([[1, 1, 0, 0], [0, 0, 2, 0]], np.uint8)
    hard = {name: np.zeros((2, 4), bool) for name in ("textureless", "specular", "brightness")}
    hard["specular"][:, 2:] = True
    regions_ = masks(np.zeros((2, 4), np.uint8), noc=noc, occ=occ, objects=objects, hard=hard)
    known = np.isfinite(occ)
    for names in (
        ("seen", "occluded"),
        ("background", "object"),
        ("above 32 px", "16 to 32 px", "8 to 16 px", "below 8 px"),
        ("flat", "weak", "textured"),
    ):
        assert (np.sum([regions_[name] for name in names], axis=0) == known).all(), names
    assert regions_["occluded"].tolist() == [[False, False, False, True], [False, False, False, True]]
    assert np.flatnonzero(regions_["below 8 px"]).tolist() == [1, 2] and regions_["above 32 px"].sum() == 1
    assert np.flatnonzero(regions_["8 to 16 px"]).tolist() == [3, 4]
    assert np.flatnonzero(regions_["object"]).tolist() == [1, 6]
    assert np.flatnonzero(regions_["specular"]).tolist() == [2, 6]  # of the pixels that both cameras see
    assert np.flatnonzero(regions_["ordinary"]).tolist() == [1, 4, 5] and not regions_["textureless"].any()


def test_without_masks_there_are_no_such_regions():
    truth = np.full((3, 3), 5, np.float32)
    regions_ = masks(np.zeros((3, 3), np.uint8), noc=truth, occ=None)
    assert {"seen", "occluded", "object", "specular"}.isdisjoint(regions_) and regions_["below 8 px"].all()


def test_texture_is_the_deviation_of_grey_levels():
    left = np.full((30, 60), 100, np.uint8)
    left[:, 20:40] += (4 * (np.indices((30, 20)).sum(axis=0) % 2)).astype(np.uint8)  # deviation 2
    left[:, 40:] += (60 * (np.indices((30, 20)).sum(axis=0) % 2)).astype(np.uint8)  # deviation 30
    regions_ = masks(left, noc=np.full((30, 60), 5, np.float32), occ=None)
    assert regions_["flat"][15, 10] and regions_["textured"][15, 50]
    window = left[11:20, 26:35].astype(float)
    assert regions_["weak"][15, 30] == (2 <= window.std() < 8)
    colour = np.repeat(left[..., None], 3, axis=2)
    again = masks(colour, noc=np.full((30, 60), 5, np.float32), occ=None)
    assert (again["flat"] == regions_["flat"]).all()


def matcher(disparity):
    def match(left, right):
        return type("R", (), {"disparity": disparity, "valid": np.isfinite(disparity)})()

    return match


def test_counts_are_pooled_and_those_of_loops():
    rng = np.random.default_rng(0)
    frames, truths = [], []
    for index in range(3):
        occ = rng.uniform(1, 60, (6, 20)).astype(np.float32)
        noc = np.where(rng.random((6, 20)) < 0.3, np.float32(NAN), occ)
        image = np.zeros((6, 20), np.uint8)
        frames.append(
            Frame(f"f{index}", lambda i=image: i, lambda i=image: i, noc=lambda n=noc: n, occ=lambda o=occ: o)
        )
        truths.append((noc, occ))
    frames.append(Frame("without truth", lambda: image, lambda: image))
    estimate = rng.uniform(1, 60, (6, 20)).astype(np.float32)
    configurations = [
        Configuration("a", "a", "original", matcher(estimate)),
        Configuration("b", "b", "cnn", missing="no"),
    ]
    full, missing = measure_regions(frames, configurations)
    counts = {"seen": [0, 0], "occluded": [0, 0]}
    for noc, occ in truths:
        for y, x in np.ndindex(6, 20):
            region = counts["occluded" if np.isnan(noc[y, x]) else "seen"]
            error = abs(float(estimate[y, x]) - float(occ[y, x]))
            region[0] += 1
            region[1] += error > 3 and error / float(occ[y, x]) > 0.05
    for name, (pixels, wrong) in counts.items():
        assert full.tallies[name].pixels == pixels and full.d1(name) == pytest.approx(100 * wrong / pixels)
    assert full.d1("specular") is None and missing.missing == "no" and not missing.tallies


def test_gaps_are_filled_as_for_scoring():
    truth = np.full((2, 10), 20, np.float32)
    holed = np.full((2, 10), 20, np.float32)
    holed[:, 3:6] = NAN
    image = np.zeros((2, 10), np.uint8)
    frame = Frame("f", lambda: image, lambda: image, noc=lambda: truth)
    (row,) = measure_regions([frame], [Configuration("a", "a", "original", matcher(holed))])
    assert row.d1("16 to 32 px") == 0.0


def test_the_command_on_scenes(tmp_path, monkeypatch):
    pytest.importorskip("skimage")
    monkeypatch.setattr(datasets, "_SCENE_SIZE", (320, 192))
    datasets._scene.cache_clear()
    words = ["--count", "1", "--method", "S2", "--variant", "original", "--max-disparity", "64", "--threads", "1"]
    done = CliRunner().invoke(APP, [*words, "-o", str(tmp_path / "out"), "--json", "-"])
    datasets._scene.cache_clear()
    assert done.exit_code == 0, (done.output, done.exception)
    document = json.loads(done.stdout)
    names = [row["name"] for row in document["results"]]
    assert names == ["S2 Original", "OpenCV 3WAY", "OpenCV HH"]
    errors = document["results"][0]["d1"]
    assert errors["occluded"] > errors["seen"] and {"textureless", "specular", "ordinary"} <= errors.keys()
    scene = datasets.import_module("stereokit_evaluation.synthetic.scenes").generate(0, 320, 192)
    seen = np.isfinite(scene.noc)
    assert document["pixels"]["textureless"] == np.count_nonzero(scene.textureless & seen)
    table = list(csv.DictReader((tmp_path / "out" / "regions.csv").read_text().splitlines()))
    assert float(table[0]["occluded"]) == errors["occluded"]
    assert (tmp_path / "out" / "regions.tex").exists() and (tmp_path / "out" / "regions.md").exists()


def test_bad_input_is_one_line(tmp_path):
    done = CliRunner().invoke(APP, ["--count", "0"])
    assert isinstance(done.exception, OptionError) and "count must be at least 1" in str(done.exception)
