"""Batches of files with both views, of videos with other layouts and of ROS bags, from the command line."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stereokit.cli.app import app
from stereokit.io import read_disparity

SHIFT = 5


def pair_of(number):
    rng = np.random.default_rng(number)
    image = cv2.GaussianBlur(rng.integers(0, 256, (40, 60 + SHIFT), np.uint8), (0, 0), 1)
    return np.ascontiguousarray(image[:, :-SHIFT]), np.ascontiguousarray(image[:, SHIFT:])


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, result.output


def check_maps(folder, names):
    assert sorted(path.stem for path in folder.glob("*.pfm")) == sorted(names)
    for name in names:
        disparity = read_disparity(folder / f"{name}.pfm")
        assert disparity.shape == (40, 60)
        assert abs(np.nanmedian(disparity) - SHIFT) < 0.2


def test_a_folder_of_files_with_both_views(tmp_path):
    folder, output = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"shot{number}.png"), np.vstack(pair_of(number)))
    (folder / "broken.png").write_bytes(b"no image")
    command = ["batch", folder, "-o", output, "--layout", "top-bottom", "--format", "pfm", "--max-disparity", 16]
    code, text = run(*command)
    assert code == 1
    assert "failed broken" in text
    check_maps(output, ["shot0", "shot1", "shot2"])
    (folder / "broken.png").unlink()
    code, text = run(*command, "--json", "-")
    assert (code, json.loads(text)["found"] if "found" in text else 3) == (0, 3)


def test_a_video_with_one_view_above_the_other(tmp_path):
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (60, 80))
    for number in range(2):
        writer.write(cv2.cvtColor(np.vstack(pair_of(number)), cv2.COLOR_GRAY2BGR))
    writer.release()
    code, text = run(
        "batch", path, "-o", tmp_path / "out", "--layout", "top-bottom", "--format", "pfm", "--max-disparity", 16
    )
    assert code == 0, text
    check_maps(tmp_path / "out", ["000000", "000001"])


def test_match_takes_one_file(tmp_path):
    left, right = pair_of(0)
    cv2.imwrite(str(tmp_path / "both.png"), np.hstack([right, left]))
    cv2.imwrite(str(tmp_path / "left.png"), left)
    options = ["--max-disparity", 16]
    code, text = run("match", tmp_path / "both.png", "-o", tmp_path / "a.pfm", "--layout", "right-left", *options)
    assert code == 0, text
    assert abs(np.median(read_disparity(tmp_path / "a.pfm")) - SHIFT) < 0.2
    for arguments, line in (
        ([tmp_path / "left.png"], "does not tell where its two views are"),
        ([tmp_path / "left.png", tmp_path / "left.png", "--layout", "pages"], "--layout is for one file"),
        ([tmp_path / "both.png", "--layout", "sbs"], "layout must be one of"),
        ([tmp_path / "both.png", "--memory", "1GB"], "RIGHT must be given with --memory"),
    ):
        code, text = run("match", *arguments, "-o", tmp_path / "b.npy", *options)
        assert code == 2
        assert line in text
        assert not (tmp_path / "b.npy").exists()


def test_a_bag_becomes_maps_and_a_bag(tmp_path):
    rosbags = pytest.importorskip("rosbags")
    assert rosbags
    from rosbags.highlevel import AnyReader
    from test_bags import LEFT, MS, RIGHT, START, Messages, P, Q, written

    messages = Messages(2)
    size = (60, 40)
    content = []
    for number in range(3):
        stamp = START + 100 * MS * number
        for topic, image in zip((LEFT, RIGHT), pair_of(number), strict=True):
            content.append((topic, stamp, messages.gray(stamp, image)))
        content.append(("/stereo/left/camera_info", stamp, messages.info(stamp, P, size)))
        content.append(("/stereo/right/camera_info", stamp, messages.info(stamp, Q, size)))
    bag = written(tmp_path / "run", messages, content)
    output, depth_bag = tmp_path / "out", tmp_path / "depth"
    common = ["batch", bag, "-o", output, "--format", "pfm", "--max-disparity", 16]
    code, text = run(*common, "--topics", f"{LEFT},{RIGHT}", "--bag", depth_bag)
    assert code == 0, text
    names = [str(START + 100 * MS * number) for number in range(3)]
    check_maps(output, names)
    with AnyReader([depth_bag]) as reader:
        depths = [
            (time, reader.deserialize(data, connection.msgtype).data.view("<f4"))
            for connection, time, data in reader.messages()
            if connection.topic == "/stereokit/depth"
        ]
    assert [str(time) for time, _ in depths] == names
    assert abs(np.nanmedian(depths[0][1]) - 100 * 0.12 / (SHIFT + 2)) < 0.05
    for more, line in (
        (["--topics", "/a,/b"], "no image topic '/a'"),
        (["--bag", depth_bag], "--bag must not exist"),
        (["--layout", "pages"], "not for ROS bags"),
    ):
        code, text = run(*common, *more)
        assert code == 2
        assert line in text
    code, text = run("batch", tmp_path, "-o", output, "--topics", "/a,/b")
    assert code == 2
    assert "topics needs one ROS bag" in text
