"""The count of detected faults: each disturbance of a scene is made, and seen."""

from __future__ import annotations

import csv
import sys

import cv2
import numpy as np
import pytest

from stereokit.io import write_image
from stereokit_evaluation.commands import faults


def test_disturbances_are_counted(tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(0)
    for side in ("left", "right"):
        (tmp_path / "rendered" / side).mkdir(parents=True)
    for name in ("a", "b"):
        noise = cv2.GaussianBlur(rng.normal(0, 1, (200, 420)), (0, 0), 1.3)
        noise = ((noise - noise.min()) / np.ptp(noise) * 250).astype(np.uint8)
        y, x = np.mgrid[:200, :320].astype(np.float32)
        right = cv2.remap(noise, x + 50 + 6 + y / 8, y, cv2.INTER_CUBIC)
        write_image(tmp_path / "rendered" / "left" / f"{name}.png", noise[:, 50:370])
        write_image(tmp_path / "rendered" / "right" / f"{name}.png", right)
    words = ["faults", "--data", str(tmp_path), "--output", str(tmp_path / "f.csv"), "--every", "2"]
    monkeypatch.setattr(sys, "argv", words)
    faults.main()
    text = capsys.readouterr().out
    assert "2 good pairs" in text and not any(f"'{kind}': 1" in text or f"'{kind}': 2" in text for kind in faults.KINDS)
    with (tmp_path / "f.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    disturbed = [row for row in rows if row["disturbance"]]
    assert len(rows) - len(disturbed) == 2 and len({row["disturbance"] for row in disturbed}) >= 20
    missed = [row["disturbance"] for row in disturbed if not set(row["said"].split()) & set(row["expected"].split())]
    assert missed == []
    assert f"{len(disturbed)} disturbed pairs:" in text


def test_a_matcher_is_counted_and_its_cost_told(tmp_path, monkeypatch, capsys):
    noise = cv2.GaussianBlur(np.random.default_rng(1).normal(128, 90, (60, 320)), (0, 0), 0.8).clip(0, 255)
    for side, start in (("left", 0), ("right", 12)):
        (tmp_path / "rendered" / side).mkdir(parents=True)
        write_image(tmp_path / "rendered" / side / "a.png", noise[:, start : start + 300].astype(np.uint8))
    pairs = list(faults.good_pairs(tmp_path))
    alike = list(faults.altered_alike(*pairs[0][1:]))
    assert [name for name, *_ in alike] == ["half size", "both top to bottom", "both darkened, with noise"]
    assert alike[0][1].shape == (30, 150) and np.array_equal(alike[1][2], pairs[0][2][::-1])
    assert alike[2][1].mean() < 0.4 * pairs[0][1].mean()
    good = faults.Case("", frozenset(), *pairs[0][1:])
    assert faults.matcher_kinds("S2", good) == set()
    assert faults.matcher_kinds("S2", faults.Case("", frozenset(), good.right, good.left)) == {"exchanged"}
    match, look, share = faults.look_cost(pairs, "S2", 155, 1, 2)
    assert match > 0 and look > 0 and 0 < share
    monkeypatch.setattr(faults, "_WIDTHS", (60,))
    monkeypatch.setattr(sys, "argv", ["faults", "--data", str(tmp_path), "--cost", "S2"])
    faults.main()
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_a_warped_image_is_where_it_should_be():
    image = np.zeros((61, 81), np.uint8)
    image[30, 60] = 255
    assert np.unravel_index(faults.warped(image, 3).argmax(), image.shape) == (33, 60)
    down, right = np.unravel_index(faults.warped(image, 0, 90).argmax(), image.shape)
    assert (down, right) == (50, 40)  # clockwise: what was to the right is below
    np.testing.assert_array_equal(faults.warped(image), image)
    assert pytest.approx(255, abs=1) == faults.warped(image, 0, 360).max()
