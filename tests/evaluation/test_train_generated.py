"""``stereokit train --generated N``: rendered, matched, trained on, and taken up where it was stopped."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")

import numpy as np  # noqa: E402

from stereokit.cli.app import app  # noqa: E402
from stereokit.io import write_image  # noqa: E402
from stereokit_evaluation.synthetic import generated as synthetic  # noqa: E402
from stereokit_evaluation.training import general  # noqa: E402
from stereokit_evaluation.training import generated as training  # noqa: E402
from stereokit_evaluation.training.pairs import FIRST_SEED  # noqa: E402
from stereokit_refiners.training import evidence  # noqa: E402
from stereokit_refiners.weights import read  # noqa: E402

SMALL = ("--set", "steps=2", "--set", "batch=1", "--set", "rows=32", "--set", "columns=64")


def run(*words):
    return CliRunner().invoke(app, ["train", *map(str, words)])


def failed(result, *parts):
    assert result.exit_code == 2, result.output
    lines = result.output.strip().splitlines()
    assert len(lines) == 1 and all(part in lines[0] for part in parts), result.output


@pytest.fixture
def rendered(monkeypatch):
    """Make pairs small; return the seeds that were rendered."""
    real, seeds = synthetic.generate_pair, []

    def generate_pair(seed, kind=None, assets=None):
        seeds.append(seed)
        return real(seed, "flying", size=(192, 96), assets=assets)

    monkeypatch.setattr(synthetic, "generate_pair", generate_pair)
    return seeds


def test_half_size_refiners_train_on_all_matchers_maps(tmp_path, rendered):
    report = tmp_path / "report.json"
    words = ["-o", tmp_path / "out", "--refiner", "cnn", "--generated", 2, *SMALL, "--json", report]
    done = run(*words)
    assert done.exit_code == 0, done.output
    assert rendered == [FIRST_SEED, FIRST_SEED + 1]
    assert json.loads(report.read_text())["generated"] == 2
    content = read(tmp_path / "out" / "weights.safetensors")
    assert content.network == "cnn" and content.notes["frames"] == []
    maps = [path.name for path in (tmp_path / "out" / "cache").glob("*.npz")]
    assert len(maps) == 2 * 2 * 4  # pairs, variants, matchers
    for method in ("s1", "s2", "s3", "s4"):
        assert sum(f"-{method}-" in name for name in maps) == 4
    assert run(*words).exit_code == 0
    assert rendered == [FIRST_SEED, FIRST_SEED + 1]  # nothing anew
    again = read(tmp_path / "out" / "weights.safetensors")
    assert (again.fingerprint, again.notes) == (content.fingerprint, content.notes)


def test_the_general_refiner_is_trained_and_goes_on_where_it_was_stopped(tmp_path, rendered, monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function: function)
    monkeypatch.setattr(general, "_SAMPLES", 1)
    out = tmp_path / "out"
    words = ["-o", out, "--refiner", "stereokit", "--generated", 2, *SMALL, "--json", "-"]
    real, calls = evidence.make_sample, []

    def stopped(*arguments, **options):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*arguments, **options)

    monkeypatch.setattr(evidence, "make_sample", stopped)
    assert run(*words).exit_code != 0
    assert len(list((out / "cache").glob("samples-*/*.npy"))) == 1 and not (out / "weights.safetensors").exists()
    done = run(*words)
    assert done.exit_code == 0, done.output
    assert rendered == [FIRST_SEED, FIRST_SEED + 1] and len(calls) == 3  # only what was missing
    assert json.loads(done.stdout)["refiner"] == "stereokit"
    content = read(out / "weights.safetensors")
    assert content.network == "evidence" and content.ranges
    assert (content.notes["generated"], content.notes["steps"]) == (2, 2)


def test_other_pairs_of_the_cache_are_left_out(tmp_path, rendered):
    folder = tmp_path / "pairs"
    list(training.generated_pairs(3, folder))
    exact, samples = general._exactly(folder, 2, tmp_path)
    assert sorted(path.name.split("-")[1] for path in exact.iterdir()) == [str(FIRST_SEED), str(FIRST_SEED + 1)]
    assert general._exactly(folder, 2, tmp_path) == (exact, samples)
    assert general._exactly(folder, 3, tmp_path)[0] != exact


@pytest.fixture
def assets(tmp_path):
    """Return a folder with a photograph and its licence."""
    folder = tmp_path / "assets"
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (150, 150), dtype=np.uint8)
    write_image(folder / "wall.png", noise)
    (folder / "manifest.json").write_text('{"files": [{"file": "wall.png", "licence": "CC0"}]}')
    return folder


@pytest.mark.parametrize("refiner", ["cnn", "stereokit"])
def test_assets_are_shown_and_noted(tmp_path, assets, rendered, monkeypatch, refiner):
    monkeypatch.setattr(torch, "compile", lambda function: function)
    monkeypatch.setattr(general, "_SAMPLES", 1)
    out, cache = tmp_path / "out", tmp_path / "cache"
    words = ["--refiner", refiner, "--generated", 2, "--cache", cache, *SMALL, "--json"]
    assert run("-o", tmp_path / "plain", *words, "-").exit_code == 0
    (assets / "broken.jpg").write_text("text")
    done = run("-o", out, *words, tmp_path / "report.json", "--assets", assets)
    assert done.exit_code == 0, done.output
    assert done.stderr.count("warning: assets: left out:") == 1 and "broken.jpg" in done.stderr
    assert rendered == [FIRST_SEED, FIRST_SEED + 1] * 2  # those without assets are other pairs
    notes = read(out / "weights.safetensors").notes["assets"]
    assert (notes["photographs"], notes["models"], notes["licences"]) == (1, 0, {"CC0": 1})
    assert json.loads((tmp_path / "report.json").read_text())["assets"] == notes
    assert "assets" not in read(tmp_path / "plain" / "weights.safetensors").notes
    assert len(list((cache / "pairs").glob(f"*-{notes['digest']}.npz"))) == 2
    if refiner == "stereokit":
        exact = [{path.name for path in folder.iterdir()} for folder in cache.glob("pairs-*")]
        assert len(exact) == 2 and not exact[0] & exact[1]


@pytest.mark.parametrize(("farthest", "levels"), [(0, 32), (24, 32), (24.5, 64), (120, 128), (121, 160)])
def test_levels_hold_the_largest_disparity(farthest, levels):
    truth = np.full((4, 6), np.nan, np.float32)
    truth[1, 1] = farthest or np.nan
    image = np.zeros((4, 6), np.uint8)
    assert training.levels_for(training.Pair("a", image, image, truth, truth)) == levels


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--refiner", "stereokit"], ["dataset, extra, streets or generated"]),
        (["--refiner", "general", "--generated", 2, "--streets", 3], ["streets must be 0", "'general'", "got 3"]),
        (["--refiner", "stereokit", "--generated", 2, "--set", "decay=0"], ["no setting named 'decay'", "steps"]),
        (["--refiner", "stereokit", "--generated", 2, "--set", "loss=l1"], ["one of general, d1", "got 'l1'"]),
        (["--refiner", "stereokit", "--generated", 2, "--set", "rows=40"], ["rows must be a multiple of 32", "40"]),
        (["--refiner", "stereokit", "--generated", 2, "--set", "steps=0"], ["steps must be at least 1", "0"]),
        (["--refiner", "cnn", "--streets", 2, "--assets", "."], ["assets must come with generated pairs", "'.'"]),
        (["--refiner", "cnn", "--generated", 2, "--assets", "none"], ["assets must be a folder", "none"]),
        (["--refiner", "stereokit", "--generated", 2, "--assets", "none"], ["assets must be a folder", "none"]),
        (["--refiner", "stereokit", "--generated", 2, "--preset", "paper"], ["preset must be default", "'paper'"]),
        (["--refiner", "cnn", "--generated", -1], ["generated must be at least 0", "-1"]),
        (["--refiner", "cnn"], ["dataset, extra, streets or generated"]),
    ],
)
def test_bad_options_end_with_one_line(words, parts, tmp_path):
    failed(run("-o", tmp_path / "out", *words), *parts)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("refiner", ["cnn", "stereokit"])
def test_assets_without_a_picture_leave_nothing_behind(refiner, tmp_path):
    assets = tmp_path / "assets"
    assets.mkdir()
    (assets / "readme.txt").write_text("none")
    failed(run("-o", tmp_path / "out", "--refiner", refiner, "--generated", 2, "--assets", assets), "assets must hold")
    assert not (tmp_path / "out").exists()
