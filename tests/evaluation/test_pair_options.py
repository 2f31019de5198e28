"""``--mask``, ``--align``, ``--strict`` and ``--layout`` of `view`, `check`, `batch` and `match --memory`."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stereokit.cli.app import app
from stereokit.io import read_disparity, write_image

HEIGHT, WIDTH, SHIFT = 200, 320, 9
OPTIONS = ("--max-disparity", 32)


def run(*words):
    result = CliRunner().invoke(app, [str(word) for word in words])
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Hold a plane of noise, seen well, one pixel too low, exchanged, in one file, with masks, and as folders."""
    folder = tmp_path_factory.mktemp("pair")
    rng = np.random.default_rng(0)
    layers = [cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH + SHIFT)), (0, 0), sigma) * sigma for sigma in (1.2, 4)]
    image = cv2.normalize(np.add.reduce(layers), None, 2, 250, cv2.NORM_MINMAX).astype(np.uint8)
    left, right = image[:, :WIDTH], image[:, SHIFT:]
    low = cv2.warpAffine(right, np.array([[1.0, 0, 0], [0, 1, 1]]), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
    usable = np.full((HEIGHT, WIDTH), 255, np.uint8)
    usable[:, :100] = 0
    for name, picture in {"left": left, "right": right, "low": low, "mask": usable}.items():
        write_image(folder / f"{name}.png", picture)
    write_image(folder / "both.png", np.vstack([left, low]))
    for side, picture in (("left", left), ("right", low)):
        (folder / "batch" / side).mkdir(parents=True)
        write_image(folder / "batch" / side / "a.png", picture)
    return folder


def test_view_masks_aligns_and_is_strict(folder, tmp_path):
    page, report = tmp_path / "v.html", tmp_path / "v.json"
    pair = folder / "left.png", folder / "low.png"
    code, text = run("view", *pair, "-o", page, *OPTIONS, "--strict")
    assert code == 2 and "error: rows do not meet" in text and not page.exists()
    code, text = run("view", *pair, "-o", page, *OPTIONS, "--strict", "--align", "--json", report)
    assert code == 0 and "aligned: the right view lay +" in text and page.exists()
    whole = json.loads(report.read_text())["density"]["S2"]
    code, text = run("view", *pair, "-o", page, *OPTIONS, "--align", "--mask", folder / "mask.png", "--json", report)
    masked = json.loads(report.read_text())["density"]["S2"]
    assert code == 0 and masked == pytest.approx((WIDTH - 100) / WIDTH, abs=0.03) and whole > 0.9
    code, text = run("view", *pair, "-o", tmp_path / "w.html", "--mask", folder / "both.png")
    assert code == 2 and "--mask must have the size of the images" in text and not (tmp_path / "w.html").exists()
    code, text = run("view", *pair, "-o", page, *OPTIONS)
    assert code == 0 and text.count("warning: ") == 1  # though kernels are warmed up first


def test_one_file_with_both_views(folder, tmp_path):
    both = folder / "both.png"
    code, text = run("check", both, "--layout", "top-bottom", *OPTIONS, "--json", tmp_path / "c.json")
    report = json.loads((tmp_path / "c.json").read_text())
    assert code == 1 and "fault: rows do not meet" in text and report["right"] is None
    assert report["row_offset"] == pytest.approx(1, abs=0.15)
    page, report = tmp_path / "v.html", tmp_path / "v.json"
    code, text = run("view", both, "--layout", "top-bottom", "-o", page, *OPTIONS, "--align", "--json", report)
    assert code == 0 and page.exists() and json.loads(report.read_text())["right"] is None
    for command in (("check",), ("view", "-o", tmp_path / "w.html")):
        for words, line in (
            ((both,), "does not tell where its two views are"),
            ((both, both, "--layout", "pages"), "--layout is for one file"),
            ((both, "--layout", "sbs"), "layout must be one of"),
            ((both, folder / "left.png"), "must have the same size, got 320x400 and 320x200"),
        ):
            code, text = run(command[0], *words, *command[1:])
            assert code == 2 and line in text and len(text.strip().splitlines()) == 1


def test_batch_masks_aligns_and_is_strict(folder, tmp_path):
    command = ("batch", folder / "batch", "--format", "pfm", *OPTIONS, "-o")
    code, text = run(*command, tmp_path / "plain")
    assert code == 0 and "rows do not meet" in text
    code, text = run(*command, tmp_path / "strict", "--strict")
    assert code == 1 and "(--strict)" in text and not (tmp_path / "strict" / "a.pfm").exists()
    code, text = run(*command, tmp_path / "aligned", "--strict", "--align", "--mask", folder / "mask.png")
    assert code == 0, text
    disparity = read_disparity(tmp_path / "aligned" / "a.pfm")
    assert np.isnan(disparity[:, :100]).all() and np.isfinite(disparity[:, 100:]).all()
    assert np.nanmedian(disparity) == pytest.approx(SHIFT, abs=0.2)
    code, text = run(*command, tmp_path / "wrong", "--mask", folder / "both.png")
    assert code == 1 and "--mask must have the size of the images" in text
    assert run(*command, tmp_path / "wrong", "--mask", folder / "none.png")[0] == 2


@pytest.mark.parametrize("option", ["--align", "--strict", "--rig=rig.yml"])
def test_what_match_memory_refuses(folder, tmp_path, option):
    words = "match", folder / "left.png", folder / "low.png", "-o", tmp_path / "m.npy", "--memory", "4GB", option
    code, text = run(*words)
    assert code == 2 and f"{option.partition('=')[0]} is not available with --memory" in text
    assert len(text.strip().splitlines()) == 1 and not (tmp_path / "m.npy").exists()
