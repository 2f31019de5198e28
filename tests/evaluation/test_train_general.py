"""``stereokit train --refiner stereokit`` on frames with ground truth, in the layout of KITTI 2015."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

import stereokit  # noqa: E402
from stereokit.cli.app import app  # noqa: E402
from stereokit_evaluation.training.general import RealFrames, _score  # noqa: E402
from stereokit_refiners.learned import LearnedRefiner  # noqa: E402
from stereokit_refiners.networks.layers import shapes  # noqa: E402
from stereokit_refiners.training import evidence  # noqa: E402
from stereokit_refiners.weights import NETWORKS, WeightFile, read, shipped, write  # noqa: E402

SHIFTS = {0: 5, 1: 9, 2: 7, 3: 11}
"""Disparity of each frame; 2 has truth of all pixels alone."""

SMALL = ["steps=2", "batch=1", "rows=32", "columns=64"]
FAST = ["--method", "S2", "--variants", "2", "--max-disparity", "32", *(w for part in SMALL for w in ("--set", part))]


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    """Write a small KITTI 2015: textured pairs whose truth is known on every fourth row."""
    base = tmp_path_factory.mktemp("kitti") / "training"
    rng = np.random.default_rng(0)
    for name in ("image_2", "image_3", "disp_noc_0", "disp_occ_0"):
        (base / name).mkdir(parents=True)
    for k, shift in SHIFTS.items():
        right = cv2.GaussianBlur(rng.integers(0, 256, (112, 224)).astype(np.uint8), (0, 0), 1.0)
        truth = np.zeros((112, 224), np.uint16)
        truth[::4] = 256 * shift
        name = f"{k:06d}_10.png"
        cv2.imwrite(str(base / "image_2" / name), np.roll(right, shift, axis=1))
        cv2.imwrite(str(base / "image_3" / name), right)
        if k != 2:
            truth[:, :shift] = 0
        cv2.imwrite(str(base / ("disp_occ_0" if k == 2 else "disp_noc_0") / name), truth)
    return base.parent


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function: function)


def run(*words):
    return CliRunner().invoke(app, ["train", "--refiner", "stereokit", *map(str, words)])


def on_kitti(kitti, out, *words):
    report = out.parent / "report.json"
    result = run("-o", out, "--dataset", "kitti2015", "--root", kitti, *FAST, "--json", report, *words)
    assert result.exit_code == 0, (result.output, result.exception)
    return json.loads(report.read_text())


def test_frames_are_trained_on_and_held_out_ones_are_scored(kitti, tmp_path, monkeypatch):
    start = tmp_path / "start.safetensors"
    write(start, shipped("evidence"))
    calls, real = [], evidence.make_sample

    def counted(*arguments, **options):
        calls.append(arguments)
        return real(*arguments, **options)

    monkeypatch.setattr(evidence, "make_sample", counted)
    words = ["--frames", "0-2", "--validation", "3", "--start", start]
    report = on_kitti(kitti, tmp_path / "out", *words)
    assert len(calls) == 6  # frames, variants
    content = read(tmp_path / "out" / "weights.safetensors")
    assert content.network == "evidence" and content.ranges
    assert content.notes["frames"] == [f"kitti2015/{k:06d}_10" for k in range(3)]
    assert content.notes["start"] == shipped("evidence").fingerprint
    (result,) = report["results"]
    assert result["held_out"] == ["000003_10"]
    bad, known = result["bad_and_known"]["S2"]
    assert known == 28 * (224 - SHIFTS[3]) and bad < 0.05 * known
    assert report["pooled"] == {"S2": pytest.approx(100 * bad / known)}
    again = on_kitti(kitti, tmp_path / "out", *words)
    assert again == report and len(calls) == 6
    image = np.random.default_rng(1).integers(0, 256, (64, 96), dtype=np.uint8)
    refined = stereokit.match(image, image, scale=0.5, refiner=str(tmp_path / "out" / "weights.safetensors"))
    assert refined.shape == image.shape


def test_each_fold_is_held_out_once_and_never_trained_on(kitti, tmp_path):
    report = on_kitti(kitti, tmp_path / "out", "--folds", "0/1,3", "--frames", "0-3")
    assert [result["held_out"] for result in report["results"]] == [["000000_10"], ["000001_10", "000003_10"]]
    trained = [read(tmp_path / "out" / f"fold-{k}" / "weights.safetensors").notes["frames"] for k in (0, 1)]
    assert trained == [[f"kitti2015/{k:06d}_10" for k in part] for part in ((1, 2, 3), (0, 2))]
    counts = [result["bad_and_known"]["S2"] for result in report["results"]]
    bad, known = (sum(column) for column in zip(*counts, strict=True))
    assert report["pooled"]["S2"] == pytest.approx(100 * bad / known)


def test_sources_share_the_steps(kitti, tmp_path, monkeypatch):
    taken = []

    def fit(sources, output, **options):
        taken.extend(sources)
        return shipped("evidence")

    monkeypatch.setattr(evidence, "fit", fit)
    extra = ["--extra", f"kitti2015:{kitti}", "--extra-share", 0.3]
    on_kitti(kitti, tmp_path / "out", "--frames", "0", *extra)
    assert [(len(source.samples), round(source.share, 6)) for source in taken] == [(2, 0.7), (8, 0.3)]


def test_scores_are_those_of_the_refiner(kitti):
    from stereokit_evaluation.data.datasets import load_frames

    content = shipped("evidence")
    chosen = load_frames("kitti2015", kitti)[2:]
    counts = _score(content, chosen, RealFrames(methods=["S2"], max_disparity=32))
    refiner = LearnedRefiner.of(content, backend="torch", precision="fp32")
    bad = known = 0
    for frame in chosen[1:]:  # of the first no one knows what both cameras see
        truth = frame.load_noc()
        map = stereokit.match(
            frame.load_left(gray=True), frame.load_right(gray=True), max_disparity=32, scale=0.5, refiner=refiner
        )
        for wrong, right in zip(np.asarray(map)[np.isfinite(truth)], truth[np.isfinite(truth)], strict=True):
            known += 1
            bad += abs(wrong - right) > 3 and abs(wrong - right) > 0.05 * right
    assert counts == {"S2": [bad, known]}


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--dataset", "kitti2015", "--folds", "0-1"], ["folds must be two groups"]),
        (["--dataset", "kitti2015", "--frames", "0-3", "--validation", "0-3"], ["frames must leave some to train on"]),
        (["--dataset", "kitti2015", "--variants", 0], ["variants", "0"]),
        (["--dataset", "kitti2015", "--set", "columns=40"], ["columns must be a multiple of 32", "40"]),
        (["--dataset", "kitti2015", "--start", "other"], ["start must hold weights of 'stereokit'", "'cnn'"]),
        (["--dataset", "kitti2015", "--variants", 1, "--max-disparity", 32, "--method", "S2", "--set", "columns=512"],
         ["crops must fit into the samples", "256x512"]),
    ],
)  # fmt: skip
def test_bad_options_end_with_one_line(words, parts, kitti, tmp_path):
    if "other" in words:
        arrays = {name: np.zeros(shape, np.float32) for name, shape in shapes(NETWORKS["cnn"]).items()}
        write(tmp_path / "other", WeightFile("cnn", "residual", arrays))
    words = [tmp_path / "other" if word == "other" else word for word in words]
    result = run("-o", tmp_path / "out", "--root", kitti, *words)
    lines = result.output.strip().splitlines()
    assert result.exit_code == 2 and all(part in lines[-1] for part in parts), result.output
    assert lines[-1].startswith("error: ")


def test_a_frame_without_truth_is_named(kitti, tmp_path):
    for folder in ("image_2", "image_3"):
        for path in (kitti / "training" / folder).glob("*.png"):
            (tmp_path / "kitti" / folder).mkdir(parents=True, exist_ok=True)
            (tmp_path / "kitti" / folder / path.name).write_bytes(path.read_bytes())
    result = run("-o", tmp_path / "out", "--dataset", "kitti2015", "--root", tmp_path / "kitti")
    assert result.exit_code == 2 and "frame 000000_10 has no ground truth to train on" in result.output
