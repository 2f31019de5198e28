"""Archives for the benchmarks' servers: the official names, whole or not at all, and refused where a server would."""

from __future__ import annotations

import json
import zipfile

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from stereokit.errors import FileError, InputError, OptionError
from stereokit.io import read_disparity, write_disparity
from stereokit_evaluation.commands.submit import submit
from stereokit_evaluation.scoring import submissions
from stereokit_evaluation.scoring.submissions import expected_frames

APP = typer.Typer()
APP.command()(submit)
SHAPE = (6, 10)
MIDDLEBURY = (
    "Adirondack ArtL Jadeplant Motorcycle MotorcycleE Piano PianoL Pipes Playroom Playtable PlaytableP Recycle".split()
)


def write_images(*paths, shape=SHAPE):
    _, data = cv2.imencode(".png", np.full(shape, 90, np.uint8))
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())


def write_maps(folder, names, value=3.5, ending=".pfm", shape=SHAPE):
    for name in names:
        path = folder / f"{name}{ending}"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_disparity(path, np.full(shape, value, np.float32))
    return folder


def command(*words):
    return CliRunner().invoke(APP, [str(word) for word in words])


def contents(path):
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(params=["kitti2015", "kitti2012"])
def kitti(request, tmp_path):
    """Return the benchmark, its folder and the official names of its maps."""
    count, sides = {"kitti2015": (200, "23"), "kitti2012": (195, "01")}[request.param]
    names = [f"{number:06d}_10" for number in range(count)]
    write_images(*(tmp_path / "data" / "testing" / f"image_{side}" / f"{name}.png" for name in names for side in sides))
    return request.param, tmp_path / "data", names


@pytest.fixture
def middlebury(tmp_path):
    scenes = [*MIDDLEBURY, "Shelves", "Teddy", "Vintage"]
    for name in scenes:
        folder = tmp_path / "MiddEval3" / "trainingQ" / name
        write_images(folder / "im0.png", folder / "im1.png")
        (folder / "calib.txt").write_text("width=10\nndisp=7\n")
    return tmp_path, scenes


@pytest.fixture
def eth3d(tmp_path):
    frames = [*submissions._ETH3D["training"], *submissions._ETH3D["test"]]
    for part, names in submissions._ETH3D.items():
        write_images(*(tmp_path / f"two_view_{part}" / name / f"im{side}.png" for name in names for side in (0, 1)))
    return tmp_path, frames


def test_kitti_has_all_maps_in_its_format(kitti, tmp_path):
    benchmark, root, names = kitti
    maps = write_maps(tmp_path / "maps", names)
    write_disparity(maps / f"{names[-1]}.pfm", np.zeros(SHAPE, np.float32))
    done = command(benchmark, "--root", root, "--predictions", maps, "-o", tmp_path / "a.zip", "--json", "-")
    assert done.exit_code == 0, (done.output, done.exception)
    prefix = "disp_0/" if benchmark == "kitti2015" else ""
    files = contents(tmp_path / "a.zip")
    assert list(files) == [f"{prefix}{name}.png" for name in names] == json.loads(done.stdout)["files"]
    stored = cv2.imdecode(np.frombuffer(files[f"{prefix}{names[0]}.png"], np.uint8), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16 and stored.shape == SHAPE and (stored == 3.5 * 256).all()
    last = cv2.imdecode(np.frombuffer(files[f"{prefix}{names[-1]}.png"], np.uint8), cv2.IMREAD_UNCHANGED)
    assert (last == 1).all()  # 0 is the mark of unknown pixels
    first = (tmp_path / "a.zip").read_bytes()
    assert command(benchmark, "--root", root, "--predictions", maps, "-o", tmp_path / "a.zip").exit_code == 0
    assert (tmp_path / "a.zip").read_bytes() == first


def test_middlebury_has_maps_and_times(middlebury, tmp_path):
    root, scenes = middlebury
    maps = write_maps(tmp_path / "maps", scenes)
    (maps / "Teddy.txt").write_text("0.25")
    words = ("middlebury", "--root", root, "--predictions", maps, "--name", "Mine", "-o", tmp_path / "a.zip")
    done = command(*words, "--seconds", 1.5)
    assert done.exit_code == 0, (done.output, done.exception)
    files = contents(tmp_path / "a.zip")
    assert set(files) == {f"trainingQ/{s}/{f}" for s in scenes for f in ("disp0Mine.pfm", "timeMine.txt")}
    assert files["trainingQ/Teddy/timeMine.txt"] == b"0.25\n" and files["trainingQ/Pipes/timeMine.txt"] == b"1.5\n"
    (tmp_path / "back.pfm").write_bytes(files["trainingQ/Pipes/disp0Mine.pfm"])
    assert (read_disparity(tmp_path / "back.pfm") == 3.5).all()


def test_maps_with_gaps_are_called_sparse(middlebury, tmp_path):
    root, scenes = middlebury
    maps = write_maps(tmp_path / "maps", scenes)
    gaps = np.full(SHAPE, 3.5, np.float32)
    gaps[0, :3] = np.nan
    write_disparity(maps / "Piano.pfm", gaps)
    words = ("middlebury", "--root", root, "--predictions", maps, "--seconds", 1, "-o", tmp_path / "a.zip")
    done = command(*words)
    assert isinstance(done.exception, InputError) and not (tmp_path / "a.zip").exists()
    assert str(done.exception) == "trainingQ/Piano must be dense, got 3 unknown pixels; --sparse allows them"
    assert command(*words, "--sparse").exit_code == 0
    files = contents(tmp_path / "a.zip")
    assert {name.rpartition("/")[2] for name in files} == {"disp0stereokit_s.pfm", "timestereokit.txt"}
    assert np.frombuffer(files["trainingQ/Piano/disp0stereokit_s.pfm"][-4 * 10 :], "<f4")[:3].tolist() == [np.inf] * 3


@pytest.mark.parametrize("part", ["training", "all"])
def test_eth3d_has_maps_and_runtimes(eth3d, tmp_path, part):
    root, frames = eth3d
    frames = frames[:27] if part == "training" else frames
    assert len(frames) == {"training": 27, "all": 47}[part] == len(set(frames))
    maps = write_maps(tmp_path / "maps", frames, ending=".npy")
    words = (
        "eth3d",
        "--root",
        root,
        "--part",
        part,
        "--predictions",
        maps,
        "--seconds",
        0.125,
        "-o",
        tmp_path / "a.zip",
    )
    assert command(*words).exit_code == 0
    files = contents(tmp_path / "a.zip")
    assert set(files) == {f"low_res_two_view/{name}.{end}" for name in frames for end in ("pfm", "txt")}
    assert files["low_res_two_view/electro_3l.txt"] == b"runtime 0.125\n"


def test_a_matcher_makes_the_maps_and_its_times(tmp_path, random_pair, monkeypatch):
    monkeypatch.setitem(submissions._ETH3D, "training", ["delivery_area_1l", "terrains_2s"])
    left, _ = random_pair(40, 100)
    for name in submissions._ETH3D["training"]:
        folder = tmp_path / "data" / name
        folder.mkdir(parents=True)
        assert cv2.imwrite(str(folder / "im0.png"), left) and cv2.imwrite(
            str(folder / "im1.png"), np.roll(left, -5, axis=1)
        )
        (folder / "calib.txt").write_text("ndisp=16\n")
    words = ("eth3d", "--root", tmp_path / "data", "-o", tmp_path / "a.zip", "--threads", 1)
    done = command(*words)
    assert done.exit_code == 0, (done.output, done.exception)
    assert "2 maps of eth3d" in done.stdout
    files = contents(tmp_path / "a.zip")
    name, value = files["low_res_two_view/terrains_2s.txt"].split()
    assert name == b"runtime" and float(value) > 0
    (tmp_path / "m.pfm").write_bytes(files["low_res_two_view/terrains_2s.pfm"])
    disparity = read_disparity(tmp_path / "m.pfm")
    assert np.isfinite(disparity).all() and abs(np.median(disparity) - 5) < 0.1
    assert command(*words, "--sparse").exit_code == 0
    (tmp_path / "m.pfm").write_bytes(contents(tmp_path / "a.zip")["low_res_two_view/terrains_2s.pfm"])
    assert np.isnan(read_disparity(tmp_path / "m.pfm")).any()


def test_missing_images_are_named(kitti, tmp_path):
    benchmark, root, names = kitti
    for number in (3, 5, 7, 100):
        next((root / "testing").glob(f"image_*/{names[number]}.png")).unlink()
    maps = write_maps(tmp_path / "maps", names)
    done = command(benchmark, "--root", root, "--predictions", maps, "-o", tmp_path / "a.zip")
    assert isinstance(done.exception, FileError) and f"pairs; missing {root}" in str(done.exception)
    assert "000003_10.png" in str(done.exception) and str(done.exception).endswith("and 1 more")
    assert "\n" not in str(done.exception) and not (tmp_path / "a.zip").exists()


def test_missing_maps_are_named(kitti, tmp_path):
    benchmark, root, names = kitti
    maps = write_maps(tmp_path / "maps", names[2:])
    done = command(benchmark, "--root", root, "--predictions", maps, "-o", tmp_path / "a.zip")
    assert f"must have {len(names)} maps, got {len(names) - 2}; missing" in str(done.exception)
    assert "000000_10" in str(done.exception) and not (tmp_path / "a.zip").exists()


@pytest.mark.parametrize(
    ("value", "shape", "message"),
    [
        (np.nan, SHAPE, "must have disparities, got none that is known"),
        (-0.5, SHAPE, "must have disparities from 0 to 10 px, got -0.5 to -0.5"),
        (10.5, SHAPE, "must have disparities from 0 to 10 px, got 10.5"),
        (3.0, (6, 9), r"must have the size of its image, (6, 10), got (6, 9)"),
    ],
)
def test_bad_maps_leave_no_archive(middlebury, tmp_path, value, shape, message):
    root, scenes = middlebury
    maps = write_maps(tmp_path / "maps", scenes)
    write_maps(maps, ["Vintage"], value, shape=shape)  # the last
    (tmp_path / "a.zip").write_text("from before")
    done = command("middlebury", "--root", root, "--predictions", maps, "--seconds", 1, "-o", tmp_path / "a.zip")
    assert isinstance(done.exception, InputError) and f"trainingQ/Vintage {message}" in str(done.exception)
    assert (tmp_path / "a.zip").read_text() == "from before" and len(list(tmp_path.glob(".*"))) == 0


def test_kitti_refuses_what_sixteen_bits_cannot_hold(tmp_path):
    submission = submissions.Submission("kitti2015", [])
    frame = submissions.Frame("disp_0/x", lambda: np.zeros((2, 400), np.uint8), lambda: np.zeros((2, 400), np.uint8))
    with pytest.raises(InputError, match=r"from 0 to 255.996 px, got 256 to 256"):
        submissions._check_map(submission.benchmark, frame, np.full((2, 400), 256, np.float32), False)


def test_two_resolutions_need_a_choice(middlebury):
    root, scenes = middlebury
    for name in scenes:
        folder = root / "MiddEval3" / "trainingH" / name
        write_images(folder / "im0.png", folder / "im1.png")
    with pytest.raises(OptionError, match="got trainingH, trainingQ"):
        expected_frames("middlebury", root)
    frames = expected_frames("middlebury", root, resolution="Q").frames
    assert [frame.name for frame in frames][:2] == ["trainingQ/Adirondack", "trainingQ/ArtL"]
    assert frames[0].max_disparity == 7
    with pytest.raises(FileError, match="needs both images of 30 pairs; missing"):
        expected_frames("middlebury", root, "all", "H")


@pytest.mark.parametrize(
    ("words", "kind", "message"),
    [
        (("kitti", "-o", "a.zip"), OptionError, "benchmark must be one of kitti2015, kitti2012, middlebury, eth3d"),
        (("kitti2015", "-o", "a.tar"), FileError, "output must end in one of .zip"),
        (("kitti2015", "--part", "training", "-o", "a.zip"), OptionError, "part of kitti2015 must be test"),
        (("eth3d", "--part", "test", "-o", "a.zip"), OptionError, "part of eth3d must be training or all"),
        (("eth3d", "--resolution", "H", "-o", "a.zip"), OptionError, "resolution must go with middlebury"),
        (("middlebury", "--resolution", "X", "-o", "a.zip"), OptionError, "resolution must be F, H or Q"),
        (("middlebury", "-o", "a.zip"), OptionError, "got none"),
        (("eth3d", "-o", "a.zip"), FileError, "eth3d needs both images of 27 pairs; missing"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, words, kind, message):
    monkeypatch.chdir(tmp_path)
    done = command(words[0], "--root", tmp_path, *words[1:])
    assert isinstance(done.exception, kind) and message in str(done.exception) and "\n" not in str(done.exception)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--predictions", "maps"), "middlebury asks for the seconds of every map, got None"),
        (("--predictions", "maps", "--seconds", -1), "got -1.0 for trainingQ/Adirondack"),
        (("--predictions", "maps", "--seconds", 1, "--name", "a/b"), "name must have letters, digits"),
        (("--predictions", "maps", "--method", "S2"), "method must not be set with predictions"),
        (("--seconds", 1), "seconds must go with predictions"),
        (("--predictions", "none"), "predictions must be a folder"),
    ],
)
def test_bad_options_of_maps_are_one_line(middlebury, tmp_path, monkeypatch, words, message):
    root, scenes = middlebury
    monkeypatch.chdir(tmp_path)
    write_maps(tmp_path / "maps", scenes)
    done = command("middlebury", "--root", root, "-o", "a.zip", *words)
    assert message in str(done.exception) and not (tmp_path / "a.zip").exists()
