"""The commands around raw cameras, run whole: calibrate, rig, rectify, and --rig of match, batch and view."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

sys.path.insert(0, str(Path(__file__).parents[1] / "stereokit"))
import rigs

from stereokit import io
from stereokit.calibration import read_calibration
from stereokit.cli.app import app
from stereokit.rig import Camera, StereoRig, read_rig

WIDTH, HEIGHT = rigs.SIZE


def run(*words, status=0):
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == status, f"{done.output}\n{done.exception!r}"
    return done.output


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a folder with raw pairs of the known scene, the rig that took them, and the truth about it."""
    folder = tmp_path_factory.mktemp("scene")
    truth = rigs.rig_of("pinhole 5")
    rig = StereoRig(
        *(Camera(k, d, "pinhole", WIDTH, HEIGHT) for k, d in zip(truth.k, truth.d, strict=True)), truth.r, truth.t
    )
    rig.save(folder / "rig.yml")
    images = rigs.raw_pair(truth)
    (folder / "raw").mkdir()
    for number in (1, 2):
        for side, image in zip(("left", "right"), images, strict=True):
            io.write_image(folder / "raw" / f"{side}{number:02d}.png", image)
    return folder, rig, images


def depth_error(path, rig, **options):
    rectification = rig.rectification(**options)
    camera = rectification.calibration
    depth = camera.disparity_to_depth(io.read_disparity(path))
    expected = rigs.true_depth(
        rectification.turns[0], (camera.fx, camera.fy, camera.cx0, camera.cy), rectification.size
    )
    known = rectification.mask & np.isfinite(depth) & np.isfinite(expected)
    assert known.mean() > 0.5
    return float(np.median(np.abs(depth[known] / expected[known] - 1)))


def test_match_rectifies_first(scene, tmp_path):
    folder, rig, _ = scene
    raw = folder / "raw/left01.png", folder / "raw/right01.png"
    words = ("match", *raw, "--method", "S2", "--max-disparity", 64, "--fill", "none", "--threads", 1)
    run(
        *words,
        "-o",
        tmp_path / "d.pfm",
        "--rig",
        folder / "rig.yml",
        "--ply",
        tmp_path / "p.ply",
        "--json",
        tmp_path / "j.json",
    )
    assert depth_error(tmp_path / "d.pfm", rig) < 0.01
    report = json.loads((tmp_path / "j.json").read_text())
    assert report["rig"].endswith("rig.yml") and (report["width"], report["height"]) == rigs.SIZE
    assert b"element vertex" in (tmp_path / "p.ply").read_bytes()[:200]
    run(*words, "-o", tmp_path / "a.pfm", "--rig", folder / "rig.yml", "--alpha", 1)
    assert depth_error(tmp_path / "a.pfm", rig, alpha=1.0) < 0.012
    outside = ~rig.rectification(alpha=1.0).mask
    assert outside.mean() > 0.1 and np.isnan(io.read_disparity(tmp_path / "a.pfm")[outside]).mean() > 0.99


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--rig", "{}/rig.yml", "--calibration", "{}/rig.yml"), "--calibration must not come with --rig"),
        (("--alpha", "1"), "--alpha must come with --rig"),
        (("--rig", "{}/none.yml"), "no such file"),
        (("--rig", "a,b,c"), "--rig must be a file, a folder or LEFT,RIGHT, got 'a,b,c'"),
        (("--rig", "{}/rig.yml", "--memory", "1GB"), "--rig is not available with --memory"),
        (("--rig", "{}/large.yml"), "the rig is for raw images of 640x480 pixels, got 320x240"),
        (("--rig", "{}/rig.yml", "--alpha", "7"), "alpha must be a number from 0 to 1, got 7"),
    ],
)
def test_what_match_refuses(scene, tmp_path, words, line):
    folder, rig, _ = scene
    rig.scaled(2).save(folder / "large.yml")
    filled = [word.format(folder) for word in words]
    output = run(
        "match", folder / "raw/left01.png", folder / "raw/right01.png", "-o", tmp_path / "d.npy", *filled, status=2
    )
    assert line in output and not (tmp_path / "d.npy").exists()


def test_rectify_a_folder_and_match_what_comes_of_it(scene, tmp_path):
    folder, rig, images = scene
    output_folder = tmp_path / "rectified"
    output = run(
        "rectify", folder / "raw", "-o", output_folder, "--rig", folder / "rig.yml", "--json", tmp_path / "j.json"
    )
    assert "2 pairs in " in output and json.loads((tmp_path / "j.json").read_text())["written"] == 2
    left, right = rig.rectify(*images)
    np.testing.assert_array_equal(io.read_image(output_folder / "left/01.png"), left)
    np.testing.assert_array_equal(io.read_image(output_folder / "right/02.png"), right)
    assert read_calibration(output_folder / "calibration.json", size=rigs.SIZE) == rig.rectified()
    np.testing.assert_array_equal(io.read_image(output_folder / "mask.png") > 0, rig.rectification().mask)
    assert io.read_image(output_folder / "rows.png").shape == (HEIGHT, 2 * WIDTH, 3)
    run(
        "match",
        output_folder / "left/01.png",
        output_folder / "right/01.png",
        "-o",
        tmp_path / "d.pfm",
        "--max-disparity",
        64,
        "--fill",
        "none",
    )
    assert depth_error(tmp_path / "d.pfm", rig) < 0.01


def test_rectify_two_images_with_options(scene, tmp_path):
    folder, rig, _ = scene
    raw = folder / "raw/left01.png", folder / "raw/right01.png"
    words = ("--rig", folder / "rig.yml", "--alpha", 1, "--size", "400x300", "--crop", "--format", "tiff")
    assert "1 pairs in" in run("rectify", *raw, "-o", tmp_path / "out", *words)
    rectification = rig.rectification(alpha=1.0, size=(400, 300), crop=True)
    image = io.read_image(tmp_path / "out/left/left01.tiff")
    assert image.shape[1::-1] == rectification.size
    assert read_calibration(tmp_path / "out/calibration.json") == rectification.calibration
    for wrong, line in (("400", "--size must be WIDTHxHEIGHT, such as 1280x720, got '400'"), ("0x3", "--size must be")):
        assert line in run(
            "rectify", *raw, "-o", tmp_path / "no", "--rig", folder / "rig.yml", "--size", wrong, status=2
        )
    assert not (tmp_path / "no").exists()


def test_a_rig_in_two_files_or_in_a_folder(scene, tmp_path):
    folder, rig, images = scene
    place = tmp_path / "rig"
    place.mkdir()
    for name, entries in (
        (
            "intrinsics.yml",
            {"M1": rig.left.matrix, "D1": rig.left.distortion, "M2": rig.right.matrix, "D2": rig.right.distortion},
        ),
        ("extrinsics.yml", {"R": rig.rotation, "T": rig.translation_m}),
    ):
        file = cv2.FileStorage(str(place / name), cv2.FILE_STORAGE_WRITE)
        for key, value in entries.items():
            file.write(key, np.atleast_2d(value))
        file.release()
    raw = folder / "raw/left01.png", folder / "raw/right01.png"
    for words in (place, f"{place / 'intrinsics.yml'},{place / 'extrinsics.yml'}"):
        run("rectify", *raw, "-o", tmp_path / "out", "--rig", words)
        np.testing.assert_array_equal(io.read_image(tmp_path / "out/left/left01.png"), rig.rectify(*images)[0])


def test_rectify_names_pairs_that_fail(scene, tmp_path):
    folder, _, images = scene
    place = tmp_path / "raw"
    place.mkdir()
    for name, image in (("a_left", images[0]), ("a_right", images[1]), ("b_left", images[0]), ("c_left", images[0])):
        io.write_image(place / f"{name}.png", image)
    io.write_image(place / "b_right.png", images[1][::2, ::2])
    output = run("rectify", place, "-o", tmp_path / "out", "--rig", folder / "rig.yml", status=1)
    assert "failed b: the rig is for raw images of 320x240 pixels, got right of 160x120" in output
    assert "failed c:" in output and "1 pairs in" in output
    assert [path.name for path in (tmp_path / "out/left").iterdir()] == ["a.png"]


def test_rectify_a_video(scene, tmp_path):
    folder, rig, images = scene
    path = tmp_path / "both.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (2 * WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    for _ in range(3):
        writer.write(np.repeat(np.hstack(images)[:, :, None], 3, axis=2))
    writer.release()
    run("rectify", path, "-o", tmp_path / "out", "--rig", folder / "rig.yml")
    image = io.read_image(tmp_path / "out/left/000002.png", gray=True)
    assert np.median(np.abs(image.astype(int) - rig.rectify(*images)[0])) < 6  # JPEG's loss


def test_batch_rectifies_first_and_knows_its_rig(scene, tmp_path):
    folder, rig, _ = scene
    words = ("batch", folder / "raw", "-o", tmp_path / "maps", "--max-disparity", 64, "--fill", "none",
             "--format", "pfm", "--workers", 1)  # fmt: skip
    run(*words, "--rig", folder / "rig.yml")
    assert depth_error(tmp_path / "maps/02.pfm", rig) < 0.01
    run(*words, "--rig", folder / "rig.yml")  # goes on
    other = tmp_path / "other.yml"
    StereoRig(rig.left, rig.right, rig.rotation, rig.translation_m * 2).save(other)
    assert "was made with rig" in run(*words, "--rig", other, status=2)
    assert "was made with rig" in run(*words, status=2)
    assert "was made with alpha" in run(*words, "--rig", folder / "rig.yml", "--alpha", 0.5, status=2)
    assert "no such file" in run(*words, "--rig", tmp_path / "none.yml", status=2)


def test_a_bad_rig_ends_a_batch_before_it_begins(scene, tmp_path):
    (tmp_path / "bad.yml").write_text("K1: [1, 2")
    output = run("batch", scene[0] / "raw", "-o", tmp_path / "maps", "--rig", tmp_path / "bad.yml", status=2)
    assert "not valid YAML" in output and len(output.splitlines()) == 1 and not (tmp_path / "maps").exists()


def test_view_rectifies_first(scene, tmp_path):
    pytest.importorskip("jinja2")
    folder, _, _ = scene
    raw = folder / "raw/left01.png", folder / "raw/right01.png"
    output = run(
        "view", *raw, "-o", tmp_path / "v.html", "--rig", folder / "rig.yml", "--max-disparity", 64, "--threads", 1
    )
    assert "no calibration" not in output and (tmp_path / "v.html").stat().st_size > 10_000
    line = run("view", *raw, "-o", tmp_path / "v.html", "--alpha", 1, status=2)
    assert "--alpha must come with --rig" in line


def test_rig_shows_and_rewrites(scene, tmp_path):
    folder, rig, _ = scene
    k = np.array([[700.0, 0, 200], [0, 700, 80], [0, 0, 1]])
    file = cv2.FileStorage(str(tmp_path / "mm.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("M1", k), ("D1", np.zeros((1, 4))), ("M2", k), ("D2", np.zeros((1, 4))), ("R", np.eye(3)),
                        ("T", np.array([[-6.0], [0], [0]]))):  # fmt: skip
        file.write(name, value)
    file.release()
    words = ("--unit", "cm", "--model", "fisheye", "--size", "400x160", "-o", tmp_path / "rig.json")
    output = run("rig", tmp_path / "mm.yml", *words)
    assert "fisheye, 4" in output and "0.06 m" in output and "400x160" in output
    again = read_rig(tmp_path / "rig.json")
    assert (again.size, again.baseline_m, again.left.model) == ((400, 160), pytest.approx(0.06), "fisheye")
    content = json.loads(run("rig", folder / "rig.yml", "--json", "-"))
    assert content["baseline_m"] == pytest.approx(rig.baseline_m) and content["size"] == list(rigs.SIZE)
    assert "got 3" in run("rig", "a", "b", "c", status=2)
    assert "--output must end in one of .yml" in run("rig", tmp_path / "mm.yml", "-o", tmp_path / "x.txt", status=2)


def test_calibrate_a_folder(tmp_path):
    truth = rigs.rig_of("pinhole 5")
    truth.k = tuple(np.diag([1.5, 1.5, 1]) @ k for k in truth.k)
    draw, center = rigs.charuco(7, 5, 0.036, 0.027)
    raw = tmp_path / "raw"
    raw.mkdir()
    for number in range(10):
        pose = rigs.board_pose(number, 10, center)
        for side, name in enumerate(("left", "right")):
            image = rigs.board_image(truth, side, pose, draw, (480, 360))
            io.write_image(raw / f"{name}{number:02d}.png", image if (number, side) != (3, 0) else image * 0 + 90)
    (raw / "left99.png").write_bytes(b"no image")
    io.write_image(raw / "right99.png", np.zeros((360, 480), np.uint8))
    words = ("--board", "7x5", "--square", "36mm", "--marker", "2.7cm", "-o", tmp_path / "rig.yml")
    output = run("calibrate", raw, *words)
    rig = read_rig(tmp_path / "rig.yml")
    assert rig.baseline_m == pytest.approx(np.linalg.norm(truth.t), rel=0.01)
    assert rig.size == (480, 360)
    assert any("03" in line and "board not found in left" in line for line in output.splitlines())
    for words_ in (
        "9 of 11 pairs used",
        "reprojection error 0.",
        "row error 0.",
        "coverage ",
        "baseline 120",
        "rig-rows.png",
    ):
        assert words_ in output, words_
    assert io.read_image(tmp_path / "rig-rows.png").shape == (360, 960, 3)
    content = json.loads(run("calibrate", raw, *words, "--json", "-"))
    assert content["epipolar_px"] < 0.2 and len(content["pairs"]) == 11
    assert "left99.png' is not an image" in content["pairs"][-1]["reason"] and content["pairs"][-1]["name"] == "99"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--board", "9", "--square", "25mm"), "board must be COLUMNSxROWS, such as 9x6, got '9'"),
        (("--board", "9x6", "--square", "25"), "square must be a length with its unit, such as 25mm"),
        (("--board", "9x6", "--square", "25mm", "--marker", "30mm"), "smaller than a square"),
        (
            ("--board", "9x6", "--square", "25mm", "--coefficients", "6"),
            "coefficients must be one of 4, 5, 8, 12, 14, got 6",
        ),
        (("--board", "9x6", "--square", "25mm", "--model", "omni"), "model must be 'pinhole' or 'fisheye', got 'omni'"),
        (("--board", "9x6", "--square", "25mm", "--every", "0"), "every must be at least 1"),
        (("--board", "9x6", "--square", "25mm"), "at least 4 pairs must show the board well in both views, got 0 of 2"),
    ],
)
def test_what_calibrate_refuses(scene, tmp_path, words, line):
    output = run("calibrate", scene[0] / "raw", "-o", tmp_path / "rig.yml", *words, status=2)
    assert line in output and not (tmp_path / "rig.yml").exists()


def test_live_rectifies_raw_frames_first(scene):
    """The engine matches what the rig rectifies, leaves out what no sensor saw, and has the rectified depth."""
    pytest.importorskip("aiohttp")
    from stereokit import Matcher
    from stereokit_evaluation.live.engine import Engine
    from stereokit_evaluation.live.source import Folder

    folder, _, images = scene
    sizes = []

    def rectify(size):
        sizes.append(size)
        return read_rig(folder / "rig.yml", size=size).rectification()

    engine = Engine(Folder(folder / "raw", rate=200), rectify=rectify, max_disparity=64)
    engine.start()
    engine.thread.join()
    rectification = read_rig(folder / "rig.yml").rectification()
    expected = Matcher(max_disparity=64, confidence=True)(*rectification(*images), **rectification.masks)
    assert sizes == [(WIDTH, HEIGHT)]  # one rectification for all frames
    assert np.array_equal(engine.view.result.disparity, expected.disparity, equal_nan=True)
    assert np.array_equal(engine.view.result.valid, expected.valid)
    assert engine.calibration == rectification.calibration
    x, y = WIDTH // 2, HEIGHT // 2
    assert engine.at(x, y)["depth"] == pytest.approx(expected.depth(rectification.calibration)[y, x], rel=1e-5)
