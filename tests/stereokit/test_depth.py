"""Depth in files, in metres, of what was measured; clouds in a stated frame."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import stereokit
from stereokit.calibration import FRAMES
from stereokit.cli.app import app
from stereokit.errors import FileError, InputError, OptionError, UnknownNameError
from stereokit.io import read_depth, write_depth, write_image, write_ply

CAMERA = stereokit.Calibration(fx=100, fy=100, cx0=1, cy=1, baseline_m=0.5)
NAN = np.nan
DISPARITY = np.array([[50, 25, NAN], [10, 5, 0.5]], np.float32)
VALID = np.array([[True, True, False], [True, False, True]])
RESULT = stereokit.Disparity(DISPARITY, VALID)


def test_depth_is_of_what_was_measured():
    np.testing.assert_allclose(RESULT.depth(CAMERA), [[1, 2, NAN], [5, NAN, 100]])
    np.testing.assert_allclose(RESULT.depth(CAMERA, filled=True), [[1, 2, NAN], [5, 10, 100]])
    np.testing.assert_allclose(RESULT.depth(CAMERA, filled=True, max_depth=10), [[1, 2, NAN], [5, 10, NAN]])
    assert np.isnan(RESULT.points(CAMERA)[1, 1]).all() and np.isfinite(RESULT.points(CAMERA, filled=True)[1, 1]).all()
    assert np.isnan(RESULT.points(CAMERA, max_depth=50)[1, 2]).all()
    for wrong in (0, -1, NAN, "5"):
        with pytest.raises(OptionError, match="max_depth"):
            RESULT.depth(CAMERA, max_depth=wrong)
    with pytest.raises(OptionError, match="filled"):
        RESULT.points(CAMERA, filled=1)


def test_frames_are_turns_of_each_other():
    """A point to the right, below and before the camera, in words."""
    disparity = np.full((3, 4), 50, np.float32)
    optical, up, ros = (CAMERA.points(disparity, frame) for frame in FRAMES)
    x, y, z = optical[2, 3]
    assert (x, y, z) == pytest.approx((0.02, 0.01, 1))
    assert tuple(up[2, 3]) == pytest.approx((x, -y, -z)) and tuple(ros[2, 3]) == pytest.approx((z, -x, -y))
    np.testing.assert_array_equal(CAMERA.points(disparity), optical)
    for wrong in ("yup", None, 3):
        with pytest.raises(UnknownNameError, match="frame"):
            CAMERA.points(disparity, wrong)


def test_depth_files(tmp_path):
    depth = np.array([[0.5, 1.2344, NAN], [65.535, 65.6, 0.0001]], np.float32)
    for suffix in (".tiff", ".tif", ".npy"):
        write_depth(tmp_path / f"d{suffix}", depth)
        np.testing.assert_array_equal(read_depth(tmp_path / f"d{suffix}"), depth)
    write_depth(tmp_path / "d.png", depth)
    stored = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16 and stored.tolist() == [[500, 1234, 0], [65535, 0, 1]]
    np.testing.assert_allclose(read_depth(tmp_path / "d.png"), [[0.5, 1.234, NAN], [65.535, NAN, 0.001]], rtol=1e-6)
    for error, words, call in (
        (InputError, "negative, got -1", lambda: write_depth(tmp_path / "d.png", np.full((2, 2), -1.0))),
        (InputError, "float", lambda: write_depth(tmp_path / "d.png", np.ones((2, 2), int))),
        (InputError, "not empty", lambda: write_depth(tmp_path / "d.png", np.ones((0, 2)))),
        (FileError, "end in", lambda: write_depth(tmp_path / "d.pfm", depth)),
        (FileError, "no such file", lambda: read_depth(tmp_path / "none.png")),
    ):
        with pytest.raises(error, match=words):
            call()
    write_image(tmp_path / "eight.png", np.ones((2, 2), np.uint8))
    with pytest.raises(FileError, match="16-bit grey PNG"):
        read_depth(tmp_path / "eight.png")
    np.save(tmp_path / "whole.npy", np.ones((2, 2), int))
    with pytest.raises(FileError, match="float metres"):
        read_depth(tmp_path / "whole.npy")


def test_save_depth(tmp_path):
    RESULT.save_depth(tmp_path / "d.npy", CAMERA)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npy"), RESULT.depth(CAMERA))
    RESULT.save_depth(tmp_path / "d.png", CAMERA, filled=True, max_depth=20)
    np.testing.assert_allclose(read_depth(tmp_path / "d.png"), [[1, 2, NAN], [5, 10, NAN]])


def test_ply_comment(tmp_path):
    write_ply(tmp_path / "p.ply", np.zeros((1, 3)), comment="frame ros; metres")
    assert b"\ncomment frame ros; metres\nelement vertex 1\n" in (tmp_path / "p.ply").read_bytes()
    for wrong in ("two\nlines", "é"):
        with pytest.raises(InputError, match="comment"):
            write_ply(tmp_path / "p.ply", np.zeros((1, 3)), comment=wrong)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 80, (40, 140)), (0, 0), 0.9).clip(1, 255)
    left, right = (noise[:, start : start + 100].astype(np.uint8) for start in (20, 30))
    write_image(folder / "left.png", left)
    write_image(folder / "right.png", right)
    camera = {"fx": 200, "fy": 200, "cx0": 50, "cy": 20, "baseline_m": 0.1, "width": 100, "height": 40}
    (folder / "camera.json").write_text(json.dumps(camera))
    half = {name: value / (1 if name == "baseline_m" else 2) for name, value in camera.items()}
    half.update(cx0=24.75, cy=9.75)
    (folder / "half.json").write_text(json.dumps(half))
    usable = np.ones((40, 100), np.uint8)
    usable[:, :50] = 0
    write_image(folder / "mask.png", usable)
    return folder


def run(pair, *words):
    files = (pair / "left.png", pair / "right.png", "-o", pair / "d.pfm", "--max-disparity", 16)
    return CliRunner().invoke(app, [str(word) for word in ("match", *files, *words)])


def cloud(path):
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    count = int(head.partition(b"element vertex ")[2].split()[0])
    kind = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in "rgb"]
    points = np.frombuffer(body, kind)
    assert len(points) == count
    return head.decode(), points


def test_depth_and_points_on_the_command_line(pair):
    camera = ("--calibration", pair / "camera.json")
    done = run(pair, *camera, "--depth", pair / "d.png", "--ply", pair / "p.ply")
    assert done.exit_code == 0, done.output
    depth = read_depth(pair / "d.png")  # 200 * 0.1 / 10 px
    assert np.nanmedian(depth) == pytest.approx(2, abs=0.02) and 0 < np.isnan(depth).mean() < 0.4
    head, points = cloud(pair / "p.ply")
    assert "comment frame y-up: x right, y up, z backward; metres" in head
    assert len(points) == np.isfinite(depth).sum() and (points["z"] < 0).all()
    assert (
        run(pair, *camera, "--depth", pair / "f.tiff", "--ply", pair / "f.ply", "--filled", "--frame", "ros").exit_code
        == 0
    )
    everything = read_depth(pair / "f.tiff")  # but what is filled with a disparity of 0, at infinity
    assert np.isfinite(everything).sum() > np.isfinite(depth).sum() and np.isfinite(everything).mean() > 0.9
    _, points = cloud(pair / "f.ply")
    assert len(points) == np.isfinite(everything).sum() and (points["x"] > 0).all()
    assert run(pair, *camera, "--depth", pair / "n.npy", "--max-depth", 1.5).exit_code == 0
    assert np.isnan(read_depth(pair / "n.npy")).mean() > 0.9
    scaled = run(pair, "--calibration", pair / "half.json", "--calibration-scale", 2, "--depth", pair / "s.npy")
    assert scaled.exit_code == 0, scaled.output
    assert run(pair, *camera, "--depth", pair / "o.npy").exit_code == 0
    np.testing.assert_allclose(read_depth(pair / "s.npy"), read_depth(pair / "o.npy"), rtol=1e-5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--depth", "{}/x.png"), "--ply and --depth go together with --calibration"),
        (("--depth", "{}/x.pfm", "--calibration", "{}/camera.json"), "--depth must end in"),
        (("--frame", "yup"), "frame"),
        (("--max-depth", "-1"), "--max-depth must be positive"),
        (("--calibration-scale", "0"), "--calibration-scale must be positive"),
        (("--calibration", "{}/half.json", "--depth", "{}/x.png"), "50x20 pixels"),
        (("--memory", "2GB", "--calibration", "{}/camera.json", "--depth", "{}/x.png"), "--depth is not available"),
        (("--mask", "{}/none.png"), "no such file"),
        (("--mask", "{}/broken.png"), "not an image"),
        (("--mask", "{}/small.png"), "--mask must have the size of the images, 100x40, got 3x2"),
        (("--nodata", "x"), "nodata"),
    ],
)
def test_bad_options_are_one_line(pair, words, message):
    write_image(pair / "small.png", np.ones((2, 3), np.uint8))
    (pair / "broken.png").write_bytes(b"x")
    outcome = run(pair, *(word.format(pair) for word in words))
    assert outcome.exit_code == 2 and message in " ".join(outcome.output.split()).replace("│ ", "")


def test_masks_on_the_command_line(pair):
    assert run(pair, "--mask", pair / "mask.png").exit_code == 0
    disparity = stereokit.read_disparity(pair / "d.pfm")
    assert np.isnan(disparity[:, :50]).all() and np.isfinite(disparity[:, 50:]).all()
    words = (pair / "left.png", pair / "right.png", "-o", pair / "d.npy", "--max-disparity", 16)
    large = CliRunner().invoke(
        app, [str(word) for word in ("match", *words, "--memory", "4GB", "--mask", pair / "mask.png")]
    )
    assert large.exit_code == 0, large.output
    np.testing.assert_array_equal(np.load(pair / "d.npy"), disparity)
    assert run(pair, "--nodata", 3).exit_code == 0
