"""``--weights``: which refiners get it, in every command that has it."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stereokit.cli.app import app
from stereokit.errors import OptionError
from stereokit_evaluation.common.weights import check_weights, weights_option
from stereokit_evaluation.study.configurations import build

pytest.importorskip("stereokit_kitti_weights")


def run(*words):
    return CliRunner().invoke(app, list(map(str, words)))


def failed(result, *parts):
    assert result.exit_code == 2, result.output
    lines = result.output.strip().splitlines()
    assert len(lines) == 1 and all(part in lines[0] for part in parts), result.output


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    left = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 96), dtype=np.uint8), (0, 0), 1)
    for name, image in (("left", left), ("right", np.roll(left, -5, axis=1))):
        for place in (".", "image_2" if name == "left" else "image_3"):
            (tmp_path / place).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / place / f"{name}.png" if place == "." else tmp_path / place / "0.png"), image)
    return tmp_path


def test_refiners_of_half_size_maps_get_them_and_else_the_general_one():
    assert weights_option("cnn", "kitti") == weights_option("pyramid", "kitti") == {"weights": "kitti"}
    assert weights_option("stereokit", "kitti") == weights_option("general", "kitti") == {"weights": "kitti"}
    assert weights_option("stereokit", "kitti", ["stereokit", "linear"]) == {"weights": "kitti"}
    assert weights_option("stereokit", "kitti", ["stereokit", "cnn"]) == {}
    assert weights_option("cnn", "kitti", ["stereokit", "cnn"]) == {"weights": "kitti"}
    for refiner in (None, "linear", "auto", "mine.safetensors"):
        assert weights_option(refiner, "kitti") == {}
    assert weights_option("cnn", None) == {}
    check_weights(["linear", "cnn"], "kitti")
    check_weights(["linear", "stereokit"], "kitti")
    check_weights([], None)
    with pytest.raises(
        OptionError, match=r"^weights must come with a refiner that takes some, got 'kitti' with .* none$"
    ):
        check_weights([], "kitti")
    with pytest.raises(OptionError, match=r"with refiner linear, auto$"):
        check_weights(["linear", "auto"], "kitti")


def test_match_takes_them_and_says_what_is_missing_without(folder):
    words = ["match", "left.png", "right.png", "-o", "map.npy", "--max-disparity", 16, "--scale", 0.5]
    failed(run(*words, "--refiner", "pyramid"), "refiner 'pyramid' needs weights", "pip install ./refiners/kitti")
    failed(run(*words, "--refiner", "cnn", "--weights", "kity"), "no weights named 'kity'", "kitti")
    failed(run(*words, "--refiner", "cnn", "--set", "weights=kitti"), "use --weights")
    failed(run(*words, "--refiner", "linear", "--weights", "kitti"), "weights")
    assert not (folder / "map.npy").exists()
    done = run(*words, "--refiner", "cnn", "--weights", "kitti")
    assert done.exit_code == 0, done.output
    assert np.load(folder / "map.npy").shape == (48, 96)


def test_a_batch_takes_them_and_tells_them_apart(folder):
    words = ["batch", ".", "-o", "maps", "--format", "npy", "--max-disparity", 16, "--scale", 0.5, "--refiner", "cnn"]
    done = run(*words, "--weights", "kitti")
    assert done.exit_code == 0, done.output
    assert np.load(folder / "maps" / "0.npy").shape == (48, 96)


def test_evaluate_gives_them_to_the_rows_that_need_them():
    pytest.importorskip("skimage")
    words = ["evaluate", "--dataset", "scenes", "--count", 1, "--max-disparity", 16, "--scale", 0.5, "--json", "-"]
    failed(run(*words, "--refiner", "linear", "--weights", "kitti"), "weights must come with a refiner")
    done = run(*words, "--refiner", "linear", "--refiner", "cnn", "--weights", "kitti")
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert [row["refiner"] for row in document["results"]] == ["linear", "cnn"]
    assert document["options"]["weights"] == "kitti"


def test_the_study_gives_them_to_the_settings_of_half_size_maps():
    settings = ["linear", "original", "pyramid", "stereokit"]
    bare = {cell.variant: cell for cell in build(["S2"], settings, {})}
    assert "needs weights" in bare["pyramid"].missing
    cells = {cell.variant: cell for cell in build(["S2"], settings, {"weights": "kitti"})}
    assert [cell.missing for cell in cells.values()] == [None] * 4
    assert cells["stereokit"].identity == bare["stereokit"].identity
    assert cells["pyramid"].identity["refiner"]["weights"]
