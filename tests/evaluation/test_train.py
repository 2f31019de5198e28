"""``stereokit train`` on a tiny folder: files, report, folds, kills, bad input; and the pairs that it trains on."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from limits import HANG_S
from typer.testing import CliRunner

import stereokit
from stereokit.cli.app import app
from stereokit.errors import InputError
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.training import pairs as training_pairs
from stereokit_evaluation.training.pairs import FIRST_SEED, pair_of, scene_pair

FRAMES = 5
SHIFT = [6, 8, 10, 12, 14]
"""Disparity of each frame, pixels: by its truth a sample says which frame it is of."""

FAST = ["--method", "S2", "--variants", "1", "--max-disparity", "32"]

TINY = ["batch=1", "rows=8", "columns=16", "evaluate_every=2", "half=false"]
SETTINGS = ["--set", "steps=4", *(part for setting in TINY for part in ("--set", setting))]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Write a plain data set of textured pairs, each of one disparity."""
    base = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(0)
    for name in ("left", "right", "disp_noc", "disp_occ"):
        (base / name).mkdir()
    for k in range(FRAMES):
        right = cv2.GaussianBlur(rng.integers(0, 256, (48, 80)).astype(np.uint8), (0, 0), 1.0)
        truth = np.full((48, 80), SHIFT[k], np.float32)
        noc = truth.copy()
        noc[:, :16] = np.nan
        cv2.imwrite(str(base / "left" / f"{k:06d}.png"), np.roll(right, SHIFT[k], axis=1))
        cv2.imwrite(str(base / "right" / f"{k:06d}.png"), right)
        np.save(base / "disp_occ" / f"{k:06d}.npy", truth)
        np.save(base / "disp_noc" / f"{k:06d}.npy", noc)
    return base


@pytest.fixture
def trainable():
    for package in ("torch", "safetensors", "matplotlib"):
        pytest.importorskip(package)


def run(*arguments):
    return CliRunner().invoke(app, ["train", *map(str, arguments)])


def trained(root, out, *arguments, refiner="cnn", settings=SETTINGS):
    data = ["--dataset", "folder", "--root", root]
    named = [] if "--refiner" in arguments else ["--refiner", refiner]
    result = run("-o", out, *named, *data, *FAST, *settings, *arguments)
    assert result.exit_code == 0, (result.output, result.exception)
    return result


def failed(result, *parts):
    assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
    lines = [line for line in result.output.splitlines() if line.strip()]
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    for part in parts:
        assert part in lines[0], lines[0]


def weights_of(folder):
    from stereokit_refiners.weights import read

    return read(folder / "weights.safetensors")


def assert_same_weights(one, other):
    a, b = weights_of(one), weights_of(other)
    for name, array in a.arrays.items():
        np.testing.assert_array_equal(b.arrays[name], array, err_msg=name)
    assert a.ranges == b.ranges
    assert a.fingerprint == b.fingerprint


# --- what it writes ------------------------------------------------------------------------------------------------


def test_the_folder_and_the_report(root, tmp_path, trainable):
    out, report = tmp_path / "new" / "folder", tmp_path / "report.json"
    result = trained(root, out, "--frames", "0-2", "--validation", "3-4", "--json", report)
    names = {p.name for p in out.iterdir()}
    assert names == {"weights.safetensors", "curves.csv", "curves.png", "checkpoint.pt", "cache"}
    content = weights_of(out)
    assert (content.network, content.output_mode) == ("cnn", "residual")
    assert content.notes["settings"]["steps"] == 4
    assert content.disparities == (0, content.notes["disparities"][1]) and content.notes["disparities"][1] > 0
    assert "Y" not in content.ranges and len(content.ranges["FE_1"]) == 32
    assert (out / "weights.safetensors").stat().st_size < 1_000_000
    rows = list(csv.reader((out / "curves.csv").read_text().splitlines()))
    assert rows[0] == ["step", "loss", "d1_noc_percent"]
    assert [row[0] for row in rows[1:]] == ["2", "4"]
    assert all(0 <= float(row[2]) <= 100 for row in rows[1:])
    picture = cv2.imread(str(out / "curves.png"))
    assert picture.shape[0] > 100 and np.ptp(picture) > 100
    document = json.loads(report.read_text())
    assert document["refiner"] == "cnn"
    assert document["methods"] == ["S2"]
    assert document["frames"] == ["000000", "000001", "000002"]
    assert document["settings"]["rows"] == 8
    (only,) = document["results"]
    assert only["held_out"] == ["000003", "000004"]
    assert only["steps"] == 4
    bad, known = only["bad_and_known"]["S2"]
    assert known == 2 * 48 * 64  # the pixels of two frames that both cameras see
    assert document["pooled"] == {"S2": pytest.approx(100 * bad / known)}
    assert "S2" in result.output and f"{100 * bad / known:.2f}" in result.output


@pytest.mark.parametrize("refiner", ["cnn", "pyramid"])
def test_the_score_is_that_of_the_written_weights_in_a_matcher(root, tmp_path, trainable, refiner):
    """What is reported is what `stereokit.Matcher` with the written file does on the held-out frames."""
    out, report = tmp_path / "out", tmp_path / "report.json"
    trained(root, out, "--frames", "0-2", "--validation", "3-4", "--json", report, refiner=refiner)
    matcher = stereokit.Matcher("S2", max_disparity=32, scale=0.5, refiner=str(out / "weights.safetensors"),
                                precision="fp32")  # fmt: skip
    bad = 0
    for k in (3, 4):
        views = [cv2.imread(str(root / side / f"{k:06d}.png"), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")]
        error = np.abs(matcher(*views).disparity[:, 16:] - SHIFT[k])
        bad += int(((error > 3) & (error / SHIFT[k] > 0.05)).sum())
    assert abs(json.loads(report.read_text())["results"][0]["bad_and_known"]["S2"][0] - bad) <= 5


def test_json_on_standard_output_is_all_that_is_printed(root, tmp_path, trainable):
    result = trained(root, tmp_path / "out", "--frames", "0", "--json", "-")
    document = json.loads(result.stdout)
    assert document["pooled"] == {"S2": None}
    assert document["results"][0]["held_out"] == []


def test_a_second_run_with_the_same_options_changes_nothing(root, tmp_path, trainable):
    out = tmp_path / "out"
    trained(root, out, "--frames", "0-1")
    weights = weights_of(out)
    trained(root, out, "--frames", "0-1")
    assert weights_of(out).fingerprint == weights.fingerprint


def test_the_cache_can_lie_elsewhere_and_changes_nothing(root, tmp_path, trainable):
    cache = tmp_path / "maps"
    trained(root, tmp_path / "one", "--frames", "0-1", "--cache", cache)
    assert len(list(cache.iterdir())) == 2
    trained(root, tmp_path / "two", "--frames", "0-1", "--cache", cache)
    assert_same_weights(tmp_path / "one", tmp_path / "two")
    assert not (tmp_path / "one" / "cache").exists()


def test_a_cache_that_was_removed_is_made_again(root, tmp_path, trainable):
    out = tmp_path / "out"
    trained(root, out, "--frames", "0-1")
    weights, names = weights_of(out), sorted(p.name for p in (out / "cache").iterdir())
    shutil.rmtree(out / "cache")
    trained(root, out, "--frames", "0-1")
    assert weights_of(out).fingerprint == weights.fingerprint
    assert sorted(p.name for p in (out / "cache").iterdir()) == names


def test_a_broken_sample_in_the_cache_ends_with_one_line(root, tmp_path, trainable):
    cache, out = tmp_path / "maps", tmp_path / "two"
    trained(root, tmp_path / "one", "--frames", "0-1", "--cache", cache)
    broken = sorted(cache.iterdir())[0]
    broken.write_text("no sample")
    data = ["--dataset", "folder", "--root", root, "--frames", "0-1", "--cache", cache]
    failed(run("-o", out, "--refiner", "cnn", *data, *FAST, *SETTINGS), "cache must hold samples", broken.name)
    assert not (out / "weights.safetensors").exists()
    assert broken.read_text() == "no sample"


def test_start_weights_are_noted_and_used(root, tmp_path, trainable):
    trained(root, tmp_path / "one", "--frames", "0")
    start = tmp_path / "one" / "weights.safetensors"
    trained(root, tmp_path / "two", "--frames", "0", "--start", start, "--set", "learning_rate=0")
    first, second = weights_of(tmp_path / "one"), weights_of(tmp_path / "two")
    assert second.notes["start"] == first.fingerprint
    assert first.notes["start"] is None
    for name, array in first.arrays.items():
        np.testing.assert_allclose(second.arrays[name], array, rtol=1e-6, atol=1e-9)


def test_the_papers_preset_and_settings_over_it(root, tmp_path, trainable):
    out, report = tmp_path / "out", tmp_path / "r.json"
    trained(root, out, "--frames", "0", "--preset", "paper", "--json", report, refiner="stereovae")
    chosen = json.loads(report.read_text())["settings"]
    assert (chosen["output_mode"], chosen["divergence"], chosen["learning_rate"]) == ("direct", 256, 5e-4)
    assert chosen["betas"] == [0.99, 0.999]
    assert chosen["steps"] == 4
    assert weights_of(out).output_mode == "direct"


# --- who is trained on what ----------------------------------------------------------------------------------------


@pytest.fixture
def recorded(monkeypatch, trainable):
    """Replace the training by one that keeps the frames it is given, which their disparity tells."""
    from stereokit_refiners.networks.layers import shapes
    from stereokit_refiners.training import loop

    calls = []

    def frames(samples):
        return [SHIFT.index(round(int(s.truth.max()) / 256)) if s.truth.max() / 256 in SHIFT else None for s in samples]

    def fit(network, sources, validation, settings, *, checkpoint, **rest):
        calls.append(
            SimpleNamespace(
                trained=[frames(source.samples) for source in sources],
                weights=[source.weight for source in sources],
                held_out=frames(validation),
                folder=checkpoint.parent,
                sources=sources,
                looked_at=validation,
            )
        )
        checkpoint.parent.mkdir(exist_ok=True)
        arrays = {name: np.zeros(shape, np.float32) for name, shape in shapes(network).items()}
        return arrays, loop.History([(settings.steps, 1.0, None)])

    monkeypatch.setattr(loop, "fit", fit)
    return calls


def test_folds_hold_each_group_out_once_and_never_train_on_it(root, tmp_path, recorded):
    out, report = tmp_path / "out", tmp_path / "r.json"
    trained(root, out, "--folds", "0-1/2/4", "--json", report)
    assert [call.held_out for call in recorded] == [[0, 1], [2], [4]]
    for call in recorded:
        (frames,) = call.trained
        assert not set(frames) & set(call.held_out)
        assert set(frames) | set(call.held_out) == {0, 1, 2, 4}
    assert [call.folder.name for call in recorded] == ["fold-0", "fold-1", "fold-2"]
    document = json.loads(report.read_text())
    assert [r["held_out"] for r in document["results"]] == [["000000", "000001"], ["000002"], ["000004"]]
    bad, known = np.sum([r["bad_and_known"]["S2"] for r in document["results"]], axis=0)
    assert known == 4 * 48 * 64
    assert document["pooled"]["S2"] == pytest.approx(100 * bad / known)
    for k in range(3):
        assert (out / f"fold-{k}" / "weights.safetensors").exists()
    assert not (out / "weights.safetensors").exists()


def test_frames_beside_folds_are_trained_on_in_every_fold(root, tmp_path, recorded):
    trained(root, tmp_path / "out", "--folds", "0/1", "--frames", "0,3-4")
    assert [(sorted(call.trained[0]), call.held_out) for call in recorded] == [([1, 3, 4], [0]), ([0, 3, 4], [1])]


def test_validation_frames_are_never_trained_on(root, tmp_path, recorded):
    trained(root, tmp_path / "out", "--validation", "1,3")
    assert recorded[0].trained == [[0, 2, 4]]
    assert recorded[0].held_out == [1, 3]


def test_samples_stay_on_the_disk_until_they_are_drawn(root, tmp_path, recorded, monkeypatch):
    from stereokit_refiners.training.samples import SampleFiles

    monkeypatch.setattr(training_pairs, "generate", small_scene)
    trained(root, tmp_path / "out", "--frames", "0-1", "--validation", "2", "--streets", "1")
    (call,) = recorded
    assert all(isinstance(source.samples, SampleFiles) for source in call.sources) and isinstance(
        call.looked_at, SampleFiles
    )


def test_every_matcher_and_variant_is_there(root, tmp_path, recorded):
    report = tmp_path / "r.json"
    trained(root, tmp_path / "out", "--frames", "0-1", "--validation", "2", "--variants", "3", "--method", "census+dt",
            "--json", report)  # fmt: skip
    assert len(recorded[0].sources[0].samples) == 2 * 2 * 3
    assert recorded[0].held_out == [2, 2]  # the pair as it is, once a matcher
    assert list(json.loads(report.read_text())["pooled"]) == ["S2", "census+dt"]


def small_scene(seed, width, height, **options):
    """Stand in for a street: a textured pair of disparity 20."""
    rng = np.random.default_rng(seed)
    right = np.repeat(cv2.GaussianBlur(rng.integers(0, 256, (48, 80)).astype(np.uint8), (0, 0), 1.0)[..., None], 3, 2)
    truth = np.full((48, 80), 20, np.float32)
    noc = truth.copy()
    noc[:, :20] = np.nan
    return SimpleNamespace(left=np.roll(right, 20, axis=1), right=right, noc=noc, occ=truth)


def test_streets_join_with_their_share(root, tmp_path, recorded, monkeypatch):
    monkeypatch.setattr(training_pairs, "generate", small_scene)
    out = tmp_path / "out"
    trained(root, out, "--frames", "0-1", "--streets", "2", "--street-share", "0.25", "--method", "S1")
    (call,) = recorded
    assert call.weights == [0.25, 0.75]
    assert call.trained[1] == [0, 0, 1, 1]
    assert len(call.sources[0].samples) == 4
    assert len(list((out / "cache").glob("street-*.npz"))) == 2


def test_streets_alone(tmp_path, recorded, monkeypatch):
    monkeypatch.setattr(training_pairs, "generate", small_scene)
    result = run("-o", tmp_path / "out", "--refiner", "cnn", "--streets", "3", *FAST, *SETTINGS)
    assert result.exit_code == 0, (result.output, result.exception)
    assert recorded[0].weights == [1.0]
    assert len(recorded[0].sources[0].samples) == 6
    assert (tmp_path / "out" / "weights.safetensors").exists()


def test_extra_frames_are_trained_on_in_every_fold_and_never_held_out(root, tmp_path, recorded):
    report = tmp_path / "r.json"
    other = tmp_path / "other"
    for part in ("left", "right", "disp_occ"):
        (other / part).mkdir(parents=True)
        (file,) = (root / part).glob("000004.*")
        (other / part / file.name).write_bytes(file.read_bytes())
    trained(root, tmp_path / "out", "--folds", "0/1", "--extra", f"folder:{other}", "--json", report)
    assert [(call.trained[0], call.trained[1], call.held_out) for call in recorded] == [
        ([1], [4], [0]),
        ([0], [4], [1]),
    ]
    assert all(call.weights == [0.8, 0.2] for call in recorded)
    assert len(json.loads(report.read_text())["frames"]) == 3


def test_streets_keep_their_share_beside_extra_frames_alone(root, tmp_path, recorded, monkeypatch):
    monkeypatch.setattr(training_pairs, "generate", small_scene)
    result = run("-o", tmp_path / "out", "--refiner", "cnn", "--extra", f"folder:{root}", "--streets", "1",
                 "--street-share", "0.25", *FAST, *SETTINGS)  # fmt: skip
    assert result.exit_code == 0, (result.output, result.exception)
    (call,) = recorded
    assert call.weights[0] / sum(call.weights) == pytest.approx(0.25)


def test_a_training_that_stops_early_writes_its_folder(root, tmp_path, trainable, monkeypatch):
    """Before the first checkpoint by time, and not at the last step."""
    from stereokit_refiners.training import loop

    scores = iter([1.0, 2.0] * 4)
    monkeypatch.setattr(loop, "_score", lambda *arguments: next(scores))
    report = tmp_path / "r.json"
    trained(root, tmp_path / "out", "--folds", "0/1", "--set", "patience=1", "--set", "steps=50", "--json", report,
            settings=SETTINGS[2:])  # fmt: skip
    assert [r["steps"] for r in json.loads(report.read_text())["results"]] == [4, 4]
    for k in (0, 1):
        assert (tmp_path / "out" / f"fold-{k}" / "weights.safetensors").exists()


@pytest.mark.parametrize("changed", [["--frames", "2-3"]], ids=str)
def test_a_folder_of_other_data_is_refused(root, tmp_path, trainable, changed):
    """Otherwise frames 2-3 are said to be trained on, and 0-1 not, by weights for which the contrary holds."""
    out = tmp_path / "out"
    trained(root, out, "--frames", "0-1")
    data = ["--dataset", "folder", "--root", root]
    failed(run("-o", out, "--refiner", "cnn", *data, *FAST, *SETTINGS, *changed), "checkpoint")


def test_a_folder_of_other_settings_is_refused(root, tmp_path, trainable):
    out = tmp_path / "out"
    trained(root, out, "--frames", "0")
    contents = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    data = ["--dataset", "folder", "--root", root, "--frames", "0"]
    failed(
        run("-o", out, "--refiner", "cnn", *data, *FAST, *SETTINGS, "--set", "seed=5"), "checkpoint", "other settings"
    )
    failed(run("-o", out, "--refiner", "stereovae", *data, *FAST, *SETTINGS), "checkpoint", "other settings")
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == contents


# --- kills ---------------------------------------------------------------------------------------------------------

KILLED = """
import functools, os, signal, sys
from stereokit_refiners.training import loop

loop.fit = functools.partial(loop.fit, save_every_s=-1)  # a checkpoint after each step
kill, count, real = os.environ["KILL"], 0, loop.write_bytes

def write(path, data):
    global count
    count += 1
    if kill == f"during {count}":  # half of a checkpoint is on the disk
        with open(os.path.join(os.path.dirname(path), ".half.tmp"), "wb") as half:
            half.write(data[: len(data) // 2])
        os.kill(os.getpid(), signal.SIGKILL)
    real(path, data)
    if kill == f"after {count}":
        os.kill(os.getpid(), signal.SIGKILL)

loop.write_bytes = write
sys.argv[0] = "stereokit"
from stereokit.cli.app import main
main()
"""


def test_a_run_that_was_killed_twice_ends_with_the_weights_of_one_that_was_not(root, tmp_path, trainable, monkeypatch):
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    import stereokit_evaluation
    import stereokit_refiners

    packages = {str(Path(m.__file__).parents[1]) for m in (stereokit, stereokit_refiners, stereokit_evaluation)}
    cache = tmp_path / "cache"
    options = ["--refiner", "stereovae", "--frames", "0-1", "--validation", "2", "--cache", str(cache)]
    trained(root, tmp_path / "whole", *options)
    out = tmp_path / "killed"
    arguments = ["train", "-o", str(out), "--dataset", "folder", "--root", str(root), *FAST, *SETTINGS, *options]

    def go(kill):
        import os

        path = os.pathsep.join([*sorted(packages), *filter(None, [os.environ.get("PYTHONPATH")])])
        done = subprocess.run(
            [sys.executable, str(script), *arguments], env={**os.environ, "PYTHONPATH": path, "KILL": kill},
            capture_output=True, text=True, timeout=HANG_S, check=False,
        )  # fmt: skip
        return done.returncode, done.stderr

    assert go("after 1")[0] == -signal.SIGKILL
    assert (out / "checkpoint.pt").exists() and not (out / "weights.safetensors").exists()
    assert go("during 2")[0] == -signal.SIGKILL
    code, errors = go("never")
    assert code == 0, errors
    assert_same_weights(out, tmp_path / "whole")


# --- bad input -----------------------------------------------------------------------------------------------------


BAD = [
    ([], ["dataset, extra, streets or generated must be set"]),
    (["--dataset", "folder"], ["root must name the folder", "'folder'"]),
    (["--dataset", "kitty2015", "--root", "."], ["no data set named 'kitty2015'", "kitti2015"]),
    (["--dataset", "folder", "--root", "nowhere"], ["root must be a folder", "nowhere"]),
    (["DATA", "--frames", "77"], ["frames must be in the data set", "'77'"]),
    (["DATA", "--validation", "9-12"], ["frames must be in the data set"]),
    (["DATA", "--folds", "0-1"], ["folds must be two groups or more that share no frame"]),
    (["DATA", "--folds", "0-2/2-4"], ["folds must be two groups or more that share no frame"]),
    (["DATA", "--folds", "0/1", "--validation", "2"], ["folds must come with a dataset and without validation"]),
    (["--streets", "2", "--folds", "0/1"], ["folds must come with a dataset"]),
    (["DATA", "--folds", "0/9"], ["frames must be in the data set"]),
    (["DATA", "--frames", "0", "--validation", "0"], []),
    (["DATA", "--refiner", "linear"], ["refiner to train must be one of", "'linear'"]),
    (["DATA", "--preset", "papr"], ["preset must be one of default, paper", "'papr'"]),
    (["DATA", "--method", "S9"], ["S9"]),
    (["DATA", "--max-disparity", "0"], ["max_disparity"]),
    (["DATA", "--variants", "0"], ["variants at least 1"]),
    (["DATA", "--streets", "-1"], ["streets at least 0"]),
    (["DATA", "--street-share", "1.5"], ["street_share and extra_share must be at least 0 and together at most 1"]),
    (["DATA", "--start", "none.safetensors"], ["weights must name a file"]),
    (["DATA", "--start", "text.safetensors"], ["weights must be a safetensors file"]),
    (["DATA", "--set", "stepz=3"], ["stepz", "steps"]),
    (["DATA", "--set", "steps"], ["--set must be KEY=VALUE"]),
    (["DATA", "--set", "steps=0"], ["steps must be at least 1"]),
    (["DATA", "--set", "steps=many"], ["steps"]),
    (["DATA", "--set", "steps=2.5"], ["steps"]),
    (["DATA", "--set", "learning_rate=-1"], ["learning_rate"]),
    (["DATA", "--set", "learning_rate=fast"], ["learning_rate"]),
    (["DATA", "--set", "betas=0.9"], ["betas"]),
    (["DATA", "--set", "ema=2"], ["ema"]),
    (["DATA", "--set", "seed=-1"], ["seed"]),
    (["DATA", "--set", "output_mode=printed"], ["output_mode must be one of"]),
    (["DATA", "--set", "rows=12"], ["multiples of 8"]),
    (["DATA", "--refiner", "pyramid", "--set", "output_mode=direct"], ["direct"]),
    (["DATA", "--json", "nowhere/r.json"], ["--json"]),
    (["DATA", "--cache", "text.safetensors"], ["text.safetensors"]),
    (["BARE"], ["000000", "no ground truth"]),
]


@pytest.mark.parametrize(("arguments", "parts"), BAD, ids=[" ".join(arguments) or "nothing" for arguments, _ in BAD])
def test_bad_input_ends_with_one_line_and_writes_nothing(arguments, parts, root, tmp_path, monkeypatch, trainable):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.safetensors").write_text("no weights")
    for side in ("left", "right"):
        (tmp_path / "bare" / side).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "bare" / side / "000000.png"), np.zeros((48, 80), np.uint8))
    before = sorted(tmp_path.rglob("*"))
    words = {"DATA": ["--dataset", "folder", "--root", str(root)], "BARE": ["--dataset", "folder", "--root", "bare"]}
    arguments = [part for word in arguments for part in words.get(word, [word])]
    extra = [] if "--refiner" in arguments else ["--refiner", "cnn"]
    fast = [*(["--method", "S2"] if "--method" not in arguments else []),
            *(["--variants", "1"] if "--variants" not in arguments else []),
            *(["--max-disparity", "32"] if "--max-disparity" not in arguments else [])]  # fmt: skip
    keys = {arguments[k + 1].partition("=")[0] for k, word in enumerate(arguments) if word == "--set"}
    settings = [part for s in ["steps=4", *TINY] if s.partition("=")[0] not in keys for part in ("--set", s)]
    failed(run("-o", "out", *extra, *fast, *settings, *arguments), *parts)
    assert sorted(tmp_path.rglob("*")) == before


def test_an_output_that_is_a_file_is_refused(root, tmp_path, trainable):
    out = tmp_path / "out"
    out.write_text("mine")
    failed(run("-o", out, "--dataset", "folder", "--root", root, *FAST, *SETTINGS), "output must be a folder")
    assert out.read_text() == "mine"


def test_a_start_of_another_network_is_refused(root, tmp_path, trainable):
    trained(root, tmp_path / "one", "--frames", "0")
    start = tmp_path / "one" / "weights.safetensors"
    data = ["--dataset", "folder", "--root", root, "--start", start]
    failed(run("-o", tmp_path / "two", "--refiner", "stereovae", *data, *FAST, *SETTINGS),
           "start must hold weights of 'stereovae', got those of 'cnn'")  # fmt: skip
    assert not (tmp_path / "two").exists()


def test_without_torch_the_extra_is_named(root, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    failed(run("-o", tmp_path / "out", "--dataset", "folder", "--root", root), "needs torch", "stereokit[train]")
    assert not (tmp_path / "out").exists()


# --- pairs ---------------------------------------------------------------------------------------------------------


def frame(noc, occ):
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    return Frame("f", lambda: image, lambda: image, noc=noc and (lambda: noc[0]), occ=occ and (lambda: occ[0]))


def test_frames_become_pairs():
    one, both = np.full((6, 8), 4, np.float32), np.full((6, 8), 5, np.float32)
    pair = pair_of(frame([one], [both]))
    assert pair.left.shape == (6, 8) and pair.left.dtype == np.uint8
    assert (pair.noc == 4).all() and (pair.occ == 5).all()
    pair = pair_of(frame([one], None))
    assert (pair.noc == 4).all() and (pair.occ == 4).all()
    pair = pair_of(frame(None, [both]))
    assert np.isnan(pair.noc).all() and (pair.occ == 5).all()
    with pytest.raises(InputError, match=r"^frame f has no ground truth to train on$"):
        pair_of(frame(None, None))


def test_a_street_from_the_cache_is_the_street(tmp_path, monkeypatch):
    monkeypatch.setattr(training_pairs, "generate", small_scene)
    first = scene_pair(FIRST_SEED, tmp_path / "not" / "there")
    fresh = scene_pair(FIRST_SEED)
    monkeypatch.setattr(training_pairs, "generate", None)
    second = scene_pair(FIRST_SEED, tmp_path / "not" / "there")
    for other in (fresh, second):
        assert other.digest == first.digest
        assert other.name == f"street-{FIRST_SEED}"
    assert np.isnan(first.noc[:, :20]).all() and (first.noc[:, 20:] == 20).all()
    assert (first.occ == 20).all()
    assert first.left.ndim == 2 and first.left.dtype == np.uint8


def test_streets_differ_by_seed_in_size_and_camera(monkeypatch):
    seen = []

    def generate(seed, width, height, **options):
        seen.append((width, height, *options.values()))
        return small_scene(seed, width, height)

    monkeypatch.setattr(training_pairs, "generate", generate)
    for seed in (1, 2, 1):
        scene_pair(seed)
    assert seen[0] == seen[2] != seen[1]
    for width, height, *_ in seen:
        assert 900 <= width < 1300 and 320 <= height < 400
