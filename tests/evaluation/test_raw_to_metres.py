"""The example ``raw_to_metres.sh`` from end to end, on files drawn here: boards and a scene seen by known raw cameras.

Pictures go to the folder that STEREOKIT_SCREENSHOTS names, when it is set.
"""

from __future__ import annotations

import http.client
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

sys.path.insert(0, str(Path(__file__).parents[1] / "stereokit"))
import rigs

from stereokit import io
from stereokit.cli.app import app
from stereokit.rig import read_rig

SCRIPT = Path(__file__).parents[2] / "examples" / "raw_to_metres.sh"
SIZE = (480, 360)


def commands():
    """Return the commands of the script by the name of the first word, without comments and alternatives."""
    lines = [line for line in SCRIPT.read_text().splitlines() if line.startswith("stereokit ")]
    return [shlex.split(line.partition(" || ")[0])[1:] for line in lines]


def run(words, status=0):
    done = CliRunner().invoke(app, words)
    assert done.exit_code == status, f"{words}: {done.output}\n{done.exception!r}"
    return done.output


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Draw what the script begins with, and run its commands up to the live page; return the folder."""
    folder = tmp_path_factory.mktemp("metres")
    truth = rigs.rig_of("pinhole 5")
    truth.k = tuple(np.diag([1.5, 1.5, 1]) @ k for k in truth.k)
    draw, center = rigs.chessboard(9, 6, 0.025)
    for name in ("board", "raw"):
        (folder / name).mkdir()
    for number in range(14):
        pose = rigs.board_pose(number, 14, center, 0.55)
        for side, name in enumerate(("left", "right")):
            io.write_image(
                folder / "board" / f"{name}{number:02d}.png", rigs.board_image(truth, side, pose, draw, SIZE)
            )
    for name, image in zip(("left", "right"), rigs.raw_pair(truth, SIZE), strict=True):
        io.write_image(folder / "raw" / f"{name}01.png", image)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        calibrate, check_raw, rectify, check, match, _ = commands()
        outputs = {"calibrate": run(calibrate), "raw": run(check_raw, 1), "rectify": run(rectify), "check": run(check)}
        outputs["match"] = run(match)
    if shots := os.environ.get("STEREOKIT_SCREENSHOTS"):
        for name in ("rig-rows.png", "rectified/rows.png", "disparity.png"):
            shutil.copy(folder / name, Path(shots) / f"raw-to-metres-{Path(name).parent.name}{Path(name).name}")
    return folder, truth, outputs


def test_the_cameras_are_found(folder):
    folder, truth, outputs = folder
    rig = read_rig(folder / "rig.yml")
    assert rig.baseline_m == pytest.approx(np.linalg.norm(truth.t), rel=0.005)
    assert int(re.search(r"(\d+) of 14 pairs used", outputs["calibrate"])[1]) >= 10
    assert "fault: rows do not meet" in outputs["raw"] and "fault" not in outputs["check"]
    assert "warning" not in outputs["match"]


def test_depth_is_right_to_one_percent(folder):
    folder, _, _ = folder
    rectification = read_rig(folder / "rig.yml").rectification()
    camera = rectification.calibration
    expected = rigs.true_depth(
        rectification.turns[0], (camera.fx, camera.fy, camera.cx0, camera.cy), rectification.size
    )
    depth = io.read_image(folder / "depth.png")
    assert depth.dtype == np.uint16
    known = (depth > 0) & np.isfinite(expected)
    assert known.mean() > 0.5
    assert np.median(np.abs(depth[known] / 1000 / expected[known] - 1)) < 0.01


def test_points_lie_upright_before_the_camera(folder):
    folder, _, _ = folder
    data = (folder / "points.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    count = int(re.search(rb"element vertex (\d+)", head)[1])
    assert count > 0.5 * SIZE[0] * SIZE[1] and b"y up" in head
    points = np.frombuffer(body, np.dtype([("place", "<f4", 3), ("color", "u1", 3)]), count)["place"]
    assert np.isfinite(points).all() and -1.3 < np.median(points[:, 2]) < -0.6  # metres; z is backward
    above, below = (np.median(points[side * points[:, 1] > 0.1, 2]) for side in (1, -1))
    assert above > below + 0.05  # the plane leans towards the cameras


def test_points_open_in_open3d(folder):
    open3d = pytest.importorskip("open3d", reason="Open3D is not installed")
    cloud = open3d.io.read_point_cloud(str(folder[0] / "points.ply"))
    places, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    assert len(places) > 0.5 * SIZE[0] * SIZE[1] and -1.3 < np.median(places[:, 2]) < -0.6
    assert colors.shape == places.shape and 0.2 < colors.mean() < 0.8


def test_the_live_page_has_depth(folder):
    pytest.importorskip("aiohttp")
    words = commands()[-1]
    process = subprocess.Popen(
        [sys.executable, "-m", "stereokit.cli", *words, "--port", "0", "--loop"],
        cwd=folder[0], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        address = re.match(r"http://127\.0\.0\.1:(\d+)/", process.stdout.readline())
        assert address, process.stderr.read()

        def ask(path):
            with closing(http.client.HTTPConnection("127.0.0.1", int(address[1]), timeout=60)) as connection:
                connection.request("GET", path)
                response = connection.getresponse()
                return response.status, response.read()

        assert ask("/")[0] == 200
        depths = []
        for _ in range(600):  # it compiles, or loads, first
            time.sleep(0.1)
            status, content = ask("/value?x=240&y=180")
            if status == 200 and json.loads(content).get("depth"):
                depths.append(json.loads(content)["depth"])
                break
        assert depths and 0.5 < depths[0] < 1.1
    finally:
        process.terminate()
        process.communicate(timeout=60)
