"""Batches on this machine: what is listed, written, resumed after a kill, refused and reported."""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import threading
from collections import Counter

import cv2
import numpy as np
import pytest
from batches import APP, SMALL, images, inodes, refused, run, start, wait_for, write_pairs
from limits import HANG_S
from typer.testing import CliRunner

import stereokit
from stereokit.errors import FileError
from stereokit.io import read_disparity, write_image
from stereokit_evaluation.batch import job as batch_job
from stereokit_evaluation.batch import run as batch_run
from stereokit_evaluation.batch.job import Job, Outcome
from stereokit_evaluation.batch.pairs import PairFiles, folder_pairs, list_pairs
from stereokit_evaluation.batch.run import Summary, on_threads, run_batch
from stereokit_evaluation.batch.store import open_output, publish
from stereokit_evaluation.batch.video import Video
from stereokit_evaluation.commands.batch import find_pairs

# What the inputs are


@pytest.mark.parametrize(
    "folders",
    [("left", "right"), ("image_2", "image_3"), ("training/image_0", "training/image_1"),
     ("image_02/data", "image_03/data")],
)  # fmt: skip
def test_two_folders_in_a_folder(folders, tmp_path):
    write_pairs(tmp_path, ["b", "ä 1"], folders=folders)
    pairs = folder_pairs(tmp_path)
    assert [pair.name for pair in pairs] == ["b", "ä 1"]
    assert pairs[0].left == str(tmp_path / folders[0] / "b.png")
    assert [p.name for p in find_pairs([tmp_path / folders[0], tmp_path / folders[1]])[0]] == ["b", "ä 1"]


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("{}_left", "{}_right"),
        ("{}-L", "{}-R"),
        ("left_{}", "right_{}"),
        ("{}.left", "{}.right"),
        ("Left-{}", "Right-{}"),
    ],
)
def test_two_kinds_of_files_in_a_folder(left, right, tmp_path):
    for name in ("a", "b_2"):
        for pattern in (left, right):
            (tmp_path / f"{pattern.format(name)}.png").touch()
    (tmp_path / "notes_left.txt").touch()
    pairs = folder_pairs(tmp_path)
    assert [(p.name, os.path.basename(p.left)) for p in pairs] == [
        (name, f"{left.format(name)}.png") for name in ("a", "b_2")
    ]


def test_a_pattern_names_files_of_any_kind(tmp_path):
    for name in ("x1_cam0.png", "x1_cam1.png", "x2_cam0.png", "x(2)_cam0.png", "other.png"):
        (tmp_path / name).touch()
    pairs = folder_pairs(tmp_path, ("*_cam0.png", "*_cam1.png"))
    assert [pair.name for pair in pairs] == ["x(2)", "x1", "x2"]
    assert pairs[2].right.endswith("x2_cam1.png")
    assert "one *" in refused(tmp_path, "-o", tmp_path / "o", "--pattern", "a.png", "*.png")
    assert "no files" in refused(tmp_path, "-o", tmp_path / "o", "--pattern", "*.jpg", "*.jpeg")


def test_a_list_in_its_forms(tmp_path):
    (tmp_path / "list.csv").write_text(
        '\ufeffLeft, Right\n# comment\n\na/1.png, b/1.png\n"a/x, y.png",b/2.png,second\n/abs/3.png,c.png,sub/third\n',
        encoding="utf-8",
    )
    pairs = list_pairs(tmp_path / "list.csv")
    assert [pair.name for pair in pairs] == ["1", "second", "sub/third"]
    assert pairs[0].left == str(tmp_path / "a" / "1.png") and pairs[1].left == str(tmp_path / "a" / "x, y.png")
    assert pairs[2].left == "/abs/3.png"
    (tmp_path / "list.txt").write_text("l1.png r1.png\nl 2.png\tr 2.png\ttwo\n", encoding="utf-8")
    assert [(p.name, os.path.basename(p.right)) for p in list_pairs(tmp_path / "list.txt")] == [
        ("l1", "r1.png"), ("two", "r 2.png"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a.png\n", "line 1 must be left,right"),
        (b"a.png,b.png,c,d\n", "line 1 must be"),
        (b"Right,Left\nb.png,a.png\n", "line 1: the left view must come first"),
        (b"a.png,\n", "line 1 must be"),
        (b"a.png,b.png\nx/a.png,y/b.png\n", "line 2: name 'a' is that of line 1 too"),
        (b"a.png,b.png,../out\n", "name must be a file name"),
        (b"a.png,b.png,/etc/x\n", "name must be a file name"),
        (b"a.png,b.png,.hidden\n", "name must be a file name"),
        (b"\xff\xfe\x00", "not in UTF-8"),
        (b"\n# nothing\n", "no pairs"),
        (b"", "no pairs"),
    ],
)
def test_a_bad_list_is_refused(content, words, tmp_path):
    (tmp_path / "list.csv").write_bytes(content)
    assert words in refused(tmp_path / "list.csv", "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_no_input_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.mp4").write_bytes(b"no video")
    out = ("-o", tmp_path / "out")
    assert "neither folders left and right" in refused(tmp_path / "empty", *out)
    assert "no such file" in refused(tmp_path / "none", *out)
    assert "nor a video" in refused(tmp_path / "a.mp4", *out)
    (tmp_path / "a.png").write_text("no image")
    for images_given in ([tmp_path / "a.png"], [tmp_path / "a.png", tmp_path / "a.png"]):
        assert "folders, lists, videos or bags, got the image" in refused(*images_given, *out)
    assert "two folders or two videos" in refused(tmp_path / "empty", tmp_path / "a.mp4", *out)
    assert "one or two" in refused(tmp_path, tmp_path, tmp_path, *out)
    write_pairs(tmp_path / "twice", ["a"])
    write_image(tmp_path / "twice" / "left" / "a.bmp", images(0)[0])
    assert "two images named 'a'" in refused(tmp_path / "twice", *out)
    assert not (tmp_path / "out").exists()


def test_the_work_of_listing_pairs_grows_with_their_number_and_no_faster(tmp_path):
    """Counted in calls: twice the pairs, twice the calls, and few of them a pair."""

    def calls(count):
        path = tmp_path / f"{count}.csv"
        path.write_text("".join(f"left/{k:06d}.png,right/{k:06d}.png\n" for k in range(count)), encoding="utf-8")
        counts = Counter()
        sys.setprofile(lambda frame, event, argument: counts.update([event]))
        try:
            pairs = list_pairs(path)
        finally:
            sys.setprofile(None)
        assert len(pairs) == count
        return counts.total()

    few, many = calls(1000), calls(2000)
    assert many < 2.05 * few and few < 200 * 1000


# What is written


def test_maps_are_those_of_match(tmp_path):
    write_pairs(tmp_path, ["0", "ünï 1"])
    summary = run(tmp_path, "-o", tmp_path / "out", "--format", "npy", "--color")
    assert (summary["pairs"], summary["written"], summary["found"], summary["failed"]) == (2, 2, 0, 0)
    assert summary["pairs_per_second"] > 0 and summary["options"]["method"] == "census+sgm"
    assert summary["versions"]["stereokit"] == stereokit.__version__
    for seed, name in enumerate(("0", "ünï 1")):
        expected = stereokit.match(*images(seed), "S2", max_disparity=16)
        np.testing.assert_array_equal(np.load(tmp_path / "out" / f"{name}.npy"), expected)
        assert cv2.imread(str(tmp_path / "out" / "color" / f"{name}.png")).shape == (32, 96, 3)
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert left == ["0.npy", "color", "manifest.json", "summary.json", "ünï 1.npy"]
    written = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert written == summary


@pytest.mark.parametrize("suffix", ["png", "pfm", "tiff"])
def test_formats(suffix, tmp_path):
    write_pairs(tmp_path, ["0"])
    run(tmp_path, "-o", tmp_path / "out", "--format", suffix)
    disparity = read_disparity(tmp_path / "out" / f"0.{suffix}")
    np.testing.assert_allclose(disparity, stereokit.match(*images(0), "S2", max_disparity=16), atol=1 / 256)


def test_names_with_folders(tmp_path):
    write_pairs(tmp_path, ["0"])
    (tmp_path / "l.csv").write_text("left/0.png,right/0.png,a/b/0\nleft/0.png,right/0.png,a/0\n", encoding="utf-8")
    run(tmp_path / "l.csv", "-o", tmp_path / "out")
    assert (tmp_path / "out/a/b/0.png").exists() and (tmp_path / "out/a/0.png").exists()
    assert run(tmp_path / "l.csv", "-o", tmp_path / "out")["found"] == 2


def test_bad_pairs_cost_nobody_else_anything(tmp_path):
    write_pairs(tmp_path, ["0", "1", "2", "3", "4"])
    (tmp_path / "right" / "1.png").unlink()
    (tmp_path / "left" / "2.png").write_bytes(b"nonsense")
    write_image(tmp_path / "right" / "3.png", images(0, (30, 96))[0])
    summary = run(tmp_path, "-o", tmp_path / "out", status=1)
    assert (summary["written"], summary["failed"]) == (2, 3)
    reasons = {error["name"]: error["reason"] for error in summary["errors"]}
    assert "no such file" in reasons["1"] and "not an image" in reasons["2"]
    assert reasons["3"] == "left and right must have the same size, got 96x32 and 96x30"
    write_pairs(tmp_path, ["0", "1", "2", "3", "4"])  # mended
    again = run(tmp_path, "-o", tmp_path / "out")
    assert (again["written"], again["found"], again["failed"]) == (3, 2, 0)


# What is refused


def test_a_folder_of_other_options_or_inputs_is_refused(tmp_path):
    write_pairs(tmp_path / "a", ["0"])
    write_pairs(tmp_path / "b", ["0"])
    out = tmp_path / "out"
    run(tmp_path / "a", "-o", out)
    before = inodes(out)
    assert 'aggregation "Sgm(p1=15' in refused(tmp_path / "a", "-o", out, "--set", "p1=10")
    assert "inputs" in refused(tmp_path / "b", "-o", out)
    assert "color false, now it is true" in refused(tmp_path / "a", "-o", out, "--color")
    assert inodes(out) == before
    assert run(tmp_path / "b", "-o", out, "--overwrite")["written"] == 1
    assert inodes(out) != before
    (out / "manifest.json").write_text("[", encoding="utf-8")
    assert "manifest" in refused(tmp_path / "b", "-o", out)
    (out / "manifest.json").unlink()
    assert "'0', which no batch has made" in refused(tmp_path / "b", "-o", out)


def test_bad_options_are_refused_before_anything_is_made(tmp_path):
    write_pairs(tmp_path, ["0"])
    out = ("-o", tmp_path / "out")
    for words, line in (
        (("--format", "gif"), "format must be one of"),
        (("--min-disparity", "-4"), "0 .. 256"),
        (("--set", "right=true"), "right is not written"),
        (("--set", "nothing=1"), "nothing"),
        (("--engine", "spark"), "engine must be local or dask"),
        (("--engine", "dask"), "go together"),
        (("--scheduler", "tcp://x:1"), "go together"),
        (("--workers", "0"), "workers must be"),
        (("--refiner", "pyramid"), "needs weights: 'kitti'"),
    ):
        assert line in refused(tmp_path, *out, *words)
    assert not (tmp_path / "out").exists()


def test_an_output_that_cannot_be_is_refused(tmp_path):
    write_pairs(tmp_path, ["0"])
    (tmp_path / "file").touch()
    assert "must be a folder" in refused(tmp_path, "-o", tmp_path / "file")
    assert "must be a folder" in refused(tmp_path, "-o", tmp_path / "file" / "below")
    if sys.platform == "linux":
        assert "/proc/none" in refused(tmp_path, "-o", "/proc/none")


@pytest.mark.skipif(sys.platform == "win32", reason="folders are not locked on Windows")
def test_two_runs_do_not_share_a_folder(tmp_path):
    write_pairs(tmp_path, ["0"])
    with open_output(tmp_path / "out", {}, ".png", str.isdigit, False):
        assert "another run" in refused(tmp_path, "-o", tmp_path / "out")


def test_a_full_disk_ends_the_run_and_keeps_what_is_there(tmp_path, monkeypatch):
    write_pairs(tmp_path, [f"{k:02d}" for k in range(20)])
    real, calls = batch_job.write_disparity, []

    def write(path, disparity, **options):
        calls.append(path)
        if len(calls) > 3:
            raise FileError("cannot write: No space left on device") from OSError(errno.ENOSPC, "full")
        real(path, disparity, **options)

    monkeypatch.setattr(batch_job, "write_disparity", write)
    line = refused(tmp_path, "-o", tmp_path / "out", "--workers", "1")
    assert "No space left" in line and "3 maps were written" in line
    assert len(calls) < 10 and len(inodes(tmp_path / "out")) == 3
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["stopped"] is not None
    monkeypatch.setattr(batch_job, "write_disparity", real)
    assert run(tmp_path, "-o", tmp_path / "out")["written"] == 17


# What is held, and what happens at the same time


def test_an_output_is_published_once(tmp_path):
    target, wins = tmp_path / "x.npy", []
    gate = threading.Barrier(8)

    def write(path):
        path.write_bytes(b"1234")
        gate.wait()

    threads = [threading.Thread(target=lambda: wins.append(publish(tmp_path, target, write))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(wins) == [False] * 7 + [True]
    assert target.read_bytes() == b"1234" and not list((tmp_path / ".partial").iterdir())


def test_a_file_system_without_links_is_good_enough(tmp_path, monkeypatch):
    def no_link(source, target):
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", no_link)
    assert publish(tmp_path, tmp_path / "x", lambda path: path.write_bytes(b"1"))
    assert not publish(tmp_path, tmp_path / "x", lambda path: path.write_bytes(b"2"))
    assert (tmp_path / "x").read_bytes() == b"1"


def test_few_pairs_are_held_at_a_time(tmp_path, monkeypatch):
    taken = finished = most = 0

    def source():
        nonlocal taken
        for k in range(200):
            taken += 1
            yield PairFiles(str(k), "", "")

    monkeypatch.setattr(batch_run, "work", lambda job, name, left, right: Outcome(name, True))
    job = Job(str(tmp_path), ".png", False, "S2", (("max_disparity", 16),))
    for _ in on_threads(job, source(), workers=3):
        finished += 1
        most = max(most, taken - finished)
    assert finished == 200 and most <= 2 * 3


def test_a_killed_run_goes_on_where_it_ended(tmp_path):
    names = [f"{k:03d}" for k in range(120)]
    write_pairs(tmp_path, names, (120, 400))
    out = tmp_path / "out"
    process = start(tmp_path, "-o", out, "--workers", "2", folder=tmp_path)
    try:
        wait_for(lambda: len(inodes(out)) >= 5, process)
    finally:
        process.kill()
        process.wait()
    before = inodes(out)
    assert 5 <= len(before) < 120
    for name in before:
        assert read_disparity(out / name).shape == (120, 400)  # whole, each of them
    (out / ".partial").mkdir(exist_ok=True)
    (out / ".partial" / "rest.png").touch()
    summary = run(tmp_path, "-o", out)
    assert (summary["found"], summary["written"]) == (len(before), 120 - len(before))
    after = inodes(out)
    assert {name: after[name] for name in before} == before and len(after) == 120
    assert not (out / ".partial").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for another process")
def test_an_interrupted_run_says_so_and_goes_on(tmp_path):
    write_pairs(tmp_path, [f"{k:03d}" for k in range(120)], (120, 400))
    out = tmp_path / "out"
    process = start(tmp_path, "-o", out, folder=tmp_path)
    wait_for(lambda: len(inodes(out)) >= 3, process)
    process.send_signal(signal.SIGINT)
    assert process.wait(HANG_S) == 130
    assert "the same command goes on" in (tmp_path / "stderr").read_text()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["interrupted"] and summary["written"] == len(inodes(out)) < 120
    assert run(tmp_path, "-o", out)["written"] == 120 - summary["written"]


# Videos


def write_video(path, frames):
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (width, height))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()


def test_a_video_side_by_side_and_in_two_files(tmp_path):
    pairs = [images(k, (64, 128), 4 + k) for k in range(5)]
    write_video(tmp_path / "both.avi", [np.hstack(pair) for pair in pairs])
    for k, side in enumerate(("l", "r")):
        write_video(tmp_path / f"{side}.avi", [pair[k] for pair in pairs])
    for inputs in ([tmp_path / "both.avi"], [tmp_path / "l.avi", tmp_path / "r.avi"]):
        out = tmp_path / f"out{len(inputs)}"
        summary = run(*inputs, "-o", out)
        assert (summary["written"], summary["failed"]) == (5, 0)
        for k in range(5):
            disparity = read_disparity(out / f"{k:06d}.png")
            assert np.median(disparity) == pytest.approx(4 + k, abs=0.5)
        (out / "000002.png").unlink()
        before = inodes(out)
        assert run(*inputs, "-o", out)["written"] == 1
        assert {name: state for name, state in inodes(out).items() if name in before} == before


def test_videos_that_do_not_go_together(tmp_path):
    frames = [images(k, (64, 128))[0] for k in range(4)]
    write_video(tmp_path / "four.avi", frames)
    write_video(tmp_path / "three.avi", frames[:3])
    write_video(tmp_path / "small.avi", [frame[:48] for frame in frames])
    write_video(tmp_path / "odd.avi", [frame[:, :63] for frame in frames])
    summary = run(tmp_path / "four.avi", tmp_path / "three.avi", "-o", tmp_path / "out", status=1)
    assert summary["written"] == 3 and "the right video ends" in summary["errors"][0]["reason"]
    assert "same size" in refused(tmp_path / "four.avi", tmp_path / "small.avi", "-o", tmp_path / "o")
    width = Video(tmp_path / "four.avi").expected
    assert width == 4
    if int(cv2.VideoCapture(str(tmp_path / "odd.avi")).get(cv2.CAP_PROP_FRAME_WIDTH)) % 2:
        assert "even width" in refused(tmp_path / "odd.avi", "-o", tmp_path / "o")


def test_the_function_takes_any_engine(tmp_path):
    """A pair of the engine's own making counts like any other."""
    job = Job(str(tmp_path / "out"), ".png", False, "S2", (("max_disparity", 16),))

    def engine(job, pairs):
        for pair in pairs:
            yield Outcome(pair.name, written=pair.name != "b", reason="broken" if pair.name == "b" else "")

    seen = []
    summary = run_batch(
        job, [PairFiles(name, "", "") for name in "abc"], engine, inputs="x", progress=lambda s: seen.append(s.pairs)
    )
    assert isinstance(summary, Summary) and seen == [1, 2, 3]
    assert (summary.written, summary.failed, summary.errors) == (2, 1, [("b", "broken")])


# Names


def listed(folder, *files):
    """Make empty files and return the pairs of the folder, by name."""
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    pairs = folder_pairs(folder)
    return {p.name: tuple(os.path.relpath(side, folder) for side in (p.left, p.right)) for p in pairs}


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (("left01.png", "right01.png", "left02.png", "right02.png"), ["01", "02"]),
        (("01L.png", "01R.png", "12l.jpg", "12r.jpg"), ["01", "12"]),
        (("a_left_01.png", "a_right_01.png"), ["a_01"]),
        (("frameLeft7.png", "frameRight7.png"), ["frame_7"]),
        (("imgL.png", "imgR.png"), ["img"]),
        (("x_cam0.png", "x_cam1.png", "y_cam0.png", "y_cam1.png"), ["x", "y"]),
        (("a_left.webp", "a_right.webp", "b_left.npy", "b_right.npy"), ["a", "b"]),
        (("Left/1.png", "Right/1.png"), ["1"]),
        (("LEFT/a_left.png", "RIGHT/a_right.png"), ["a"]),
        (("left/01L.png", "right/01R.png"), ["01"]),
        (("cam0/1.png", "cam1/1.png"), ["1"]),
        (("mav0/cam0/data/1.png", "mav0/cam1/data/1.png", "mav0/cam0/sensor.yaml"), ["1"]),
        (("image_00/data/1.png", "image_01/data/1.png"), ["1"]),
        (("Motorcycle/im0.png", "Motorcycle/im1.png", "2006/Aloe/view1.png", "2006/Aloe/view5.png", "x/notes.txt"),
         ["2006/Aloe", "Motorcycle"]),
        (("venus/im0.ppm", "venus/im1.ppm", "venus/im2.ppm", "venus/im6.ppm"), ["venus"]),
        (("one/left.png", "one/right.png"), ["one"]),
        (("12:30:05_left.png", "12:30:05_right.png"), ["12:30:05"]),
        (("left/0.png", "right/0.png", "left/0.npy", "right/0.npy"), ["0"]),
    ],
)  # fmt: skip
def test_names_of_pairs(files, names, tmp_path):
    pairs = listed(tmp_path, *files)
    assert sorted(pairs) == names
    assert sorted(side for pair in pairs.values() for side in pair) == sorted(f for f in files if "." in f and
           not f.endswith((".txt", ".yaml")) and not (f.endswith(".npy") and "/" in f)
           and not ("venus" in f and f[-5] in "01"))  # fmt: skip
    if "venus/im2.ppm" in files:
        assert pairs["venus"] == ("venus/im2.ppm", "venus/im6.ppm")


def test_a_view_that_is_missing_is_told_where_the_name_is_sure(tmp_path):
    pairs = listed(tmp_path, "a_left.png", "a_right.png", "b_left.png", "r2.png")
    assert sorted(pairs) == ["a", "b"] and os.path.basename(pairs["b"][1]) == "b_right.png"


def test_a_folder_without_pairs_says_what_is_known_and_how_to_tell_more(tmp_path):
    (tmp_path / "x1.png").touch()
    line = refused(tmp_path, "-o", tmp_path / "out")
    assert "--pattern" in line and "NAME_left and NAME_right" in line and "im0 and im1" in line
    assert list(listed(tmp_path / "scene", "im0.png", "im1.png")) == ["scene"]


def test_a_list_may_have_further_columns_that_are_files(tmp_path):
    for text, names in (
        ("i2/0.png i3/0.png disp/0.png\n", ["0"]),
        ("a.png,b.png,name,disp.pfm\nc.png,d.png,disp_occ/1.png,disp_noc/1.png\n", ["name", "c"]),
        ("\ufeffa.png\tb.png\tdisp.tiff\r\nc.png\td.png\r\n", ["a", "c"]),
    ):
        (tmp_path / "list.txt").write_bytes(text.encode())
        assert [pair.name for pair in list_pairs(tmp_path / "list.txt")] == names
    (tmp_path / "list.txt").write_text("left,right,disparity\nl.png,r.png,d.png\n")
    assert [(pair.name, os.path.basename(pair.left)) for pair in list_pairs(tmp_path / "list.txt")] == [("l", "l.png")]
    (tmp_path / "list.txt").write_text('"' + "l" * 200_000 + '",r.png\n')
    with pytest.raises(FileError, match=r"list\.txt"):
        list_pairs(tmp_path / "list.txt")


@pytest.mark.skipif(sys.platform != "linux", reason="file systems elsewhere do not have these names")
def test_any_name_of_the_file_system_will_do(tmp_path):
    names = ["12:30:05", 'a"b', "what?", "back\\slash", "two\nlines", os.fsdecode(b"caf\xe9"), "[x]", " ", "<|>"]
    folder = tmp_path / os.fsdecode(b"\xe9t\xe9")
    write_pairs(folder, names)
    (folder / "left" / "what?.png").write_bytes(b"broken")
    out = tmp_path / os.fsdecode(b"caf\xe9 [red]")
    summary = run(folder, "-o", out, "--color", status=1)
    assert (summary["written"], summary["failed"]) == (len(names) - 1, 1)
    assert summary["errors"][0]["name"] == "what?"
    for name in names:
        assert (out / f"{name}.png").exists() == (out / "color" / f"{name}.png").exists() == (name != "what?")
    assert json.loads((out / "summary.json").read_bytes()) == summary
    assert run(folder, "-o", out, "--color", status=1)["found"] == len(names) - 1


def test_a_name_that_cannot_be_costs_its_own_pair(tmp_path):
    for name in ("a_l.png", "a_r.png", ".._l.png", "_l.png", "_r.png"):
        write_image(tmp_path / f"x{name}", images(0)[0 if "l" in name else 1])
    summary = run(tmp_path, "-o", tmp_path / "out", "--pattern", "x*_l.png", "x*_r.png", status=1)
    assert (summary["written"], summary["failed"]) == (1, 2)
    assert all("cannot be that of a file" in error["reason"] for error in summary["errors"])


def test_what_looks_wrong_about_pairs_is_told(tmp_path, capfd):
    write_pairs(tmp_path, ["good", "same"], (48, 160))
    left, right = images(0, (48, 160))
    write_image(tmp_path / "right" / "same.png", images(1, (48, 160))[0])
    summary = run(tmp_path, "-o", tmp_path / "out")
    assert [(entry["name"], entry["reason"][:30]) for entry in summary["warnings"]] == [
        ("same", "left and right hold the same p")
    ]
    by_name = {entry["name"]: entry["density"] for entry in summary["density"]["lowest"]}
    assert by_name["good"] == stereokit.Matcher("S2", max_disparity=16)(left, right).density
    assert list(by_name) == sorted(by_name, key=by_name.get)
    assert summary["density"]["mean"] == pytest.approx(sum(by_name.values()) / 2)


@pytest.mark.skipif(sys.platform == "win32", reason="a folder that is in use cannot be removed on Windows")
@pytest.mark.parametrize("again", [False, True])
def test_a_folder_that_vanishes_is_noticed_and_not_made_anew(again, tmp_path, monkeypatch):
    write_pairs(tmp_path, [f"{k:02d}" for k in range(12)])
    out = tmp_path / "out"
    real, calls = batch_job.write_disparity, []

    def write(path, disparity, **options):
        real(path, disparity, **options)
        calls.append(path)
        if len(calls) == 3:
            os.rename(out, tmp_path / "elsewhere")
            if again:
                out.mkdir()

    monkeypatch.setattr(batch_job, "write_disparity", write)
    done = CliRunner().invoke(APP, [str(tmp_path), "-o", str(out), *SMALL, "--color", "--workers", "1"])
    assert done.exit_code == 1
    assert "was removed or replaced while the batch ran" in done.output
    assert len(calls) < 8  # it ends there
    assert out.exists() == again
    assert not (out / "summary.json").exists() and not (out / "manifest.json").exists()
