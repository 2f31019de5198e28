"""The runner and the command on a small KITTI folder, with a matcher that returns what the test says."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from stereokit.errors import FileError, InputError, OptionError, StereokitError, UnknownNameError
from stereokit.io import write_disparity
from stereokit_evaluation.commands.evaluate import evaluate, run
from stereokit_evaluation.data import datasets
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.runner import Skipped, score_frames, with_matcher

SHAPE = (8, 12)
WORKERS = typer.Typer()
WORKERS.command()(evaluate)


def constant(value, missing=()):
    """Return a matcher that says `value` everywhere, and that it measured all but some columns."""

    def match(left, right):
        assert left.shape == right.shape == SHAPE
        valid = np.ones(SHAPE, bool)
        valid[:, list(missing)] = False
        return SimpleNamespace(disparity=np.full(SHAPE, value, np.float32), valid=valid)

    return match


class FakeMatcher:
    """Stands in for `stereokit.Matcher`: disparity 10 by semi-global methods, 20 by anything else."""

    instances: list[dict] = []  # noqa: RUF012

    def __init__(self, method="census+sgm", *, max_disparity=128, scale=1.0, refiner=None, device="auto", **rest):
        if method == "nonsense":
            raise UnknownNameError("no cost named 'nonsense'")
        self.method, self.device = {"S4": "zncc+sgm"}.get(method, method), "cpu"
        FakeMatcher.instances.append({"max_disparity": max_disparity, "scale": scale, "refiner": refiner, **rest})

    def __call__(self, left, right):
        if left.mean() == 66:
            raise KeyboardInterrupt
        return constant(10.0 if self.method.endswith("sgm") else 20.0, missing=[0])(left, right)


@pytest.fixture
def fake(monkeypatch):
    monkeypatch.setattr("stereokit.Matcher", FakeMatcher, raising=False)
    FakeMatcher.instances = []
    return FakeMatcher


def png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def add(root, index, *, noc=None, occ=None, objects=None, grey=50):
    for part in ("image_2", "image_3"):
        png(root / "training" / part / f"{index:06d}_10.png", np.full((*SHAPE, 3), grey, np.uint8))
    for part, value in (("disp_noc_0", noc), ("disp_occ_0", occ)):
        if value is not None:
            stored = np.full(SHAPE, value * 256, np.uint16)
            png(root / "training" / part / f"{index:06d}_10.png", stored)
    if objects is not None:
        png(root / "training" / "obj_map" / f"{index:06d}_10.png", objects)


@pytest.fixture
def kitti(tmp_path):
    """Frames 0 (noc and occ, objects), 1 (noc only) and 2 (occ only)."""
    objects = np.zeros(SHAPE, np.uint8)
    objects[:, :3] = 1
    add(tmp_path, 0, noc=10, occ=20, objects=objects)
    add(tmp_path, 1, noc=11)
    add(tmp_path, 2, occ=10)
    return tmp_path


def command(*words):
    """Run the command; an error of the family stays in `.exception`, as the command line prints it."""
    return CliRunner().invoke(WORKERS, [str(word) for word in words])


def read(path):
    return json.loads(path.read_text())


def test_run_pools_and_times_the_matcher_only(kitti):
    seen, calls = [], []

    def match(left, right):
        calls.append(left.ndim)
        return constant(10.0, missing=[0, 1, 2])(left, right)

    result = run(datasets.kitti2015(kitti), match, lambda *step: seen.append(step))
    assert seen == [(1, 3, "000000_10"), (2, 3, "000001_10"), (3, 3, "000002_10")]
    assert calls == [2] * 4  # grey; three frames and one call to warm up
    assert not result.skipped and len(result.frames) == 3
    pixels = SHAPE[0] * SHAPE[1]
    noc, occ = result.score.noc.all, result.score.occ.all
    assert (noc.filled.pixels, occ.filled.pixels) == (2 * pixels, 2 * pixels)
    assert (noc.filled.d1(), occ.filled.d1()) == (0.0, 50.0)
    assert noc.filled.epe() == 0.5 and noc.density() == 75.0
    assert result.score.noc.fg.filled.pixels == SHAPE[0] * 3  # of frame 0, the only one with objects
    assert result.seconds_per_image > 0
    assert run([], match).seconds_per_image is None


def test_run_gives_colour_when_asked(kitti):
    shapes = []

    def match(left, right):
        shapes.append(left.shape)
        return SimpleNamespace(disparity=np.full(SHAPE, 10, np.float32), valid=np.ones(SHAPE, bool))

    run(datasets.kitti2015(kitti)[:1], match, gray=False)
    assert set(shapes) == {(*SHAPE, 3)}


def test_unfilled_maps_are_filled_by_the_evaluator(kitti):
    def match(left, right):
        disparity = np.full(SHAPE, 10, np.float32)
        disparity[:, 4] = np.nan
        return SimpleNamespace(disparity=disparity, valid=~np.isnan(disparity))

    counts = run(datasets.kitti2015(kitti)[:1], match).score.noc.all
    assert counts.filled.d1() == 0.0 and counts.density() == pytest.approx(100 * 11 / 12)


def break_frames(kitti):
    training = kitti / "training"
    (training / "image_2" / "000000_10.png").write_bytes(b"no picture")
    (training / "image_3" / "000001_10.png").unlink()
    for index, part in ((3, "image_3"), (4, "disp_noc_0")):
        add(kitti, index, noc=10)
        png(training / part / f"{index:06d}_10.png", np.zeros((5, 6), np.uint16 if index == 4 else np.uint8))
    add(kitti, 5)


def test_broken_frames_are_skipped_with_a_reason(kitti):
    break_frames(kitti)
    result = run(datasets.kitti2015(kitti), constant(10.0))
    assert [frame.name for frame in result.frames] == ["000002_10"]
    reasons = {skip.name[:6]: skip.reason for skip in result.skipped}
    assert list(reasons) == ["000000", "000001", "000003", "000004", "000005"]
    assert "000000_10.png" in reasons["000000"] and "000001_10.png" in reasons["000001"]
    assert reasons["000003"].startswith("left and right must have one size")
    assert reasons["000004"].startswith("noc must have the size of the estimate")
    assert reasons["000005"] == "the frame has no ground truth"
    assert all("\n" not in reason for reason in reasons.values())


def test_a_slip_in_the_matcher_is_not_hidden(kitti):
    def match(left, right):
        raise TypeError("a bug")

    with pytest.raises(TypeError, match="a bug"):
        run(datasets.kitti2015(kitti), match)


def test_a_refusal_by_the_matcher_skips_the_frame(kitti):
    def match(left, right):
        raise InputError("left must be\nwider")

    (outcome,) = score_frames(datasets.kitti2015(kitti)[:1], with_matcher(match))
    assert outcome == Skipped("000000_10", "left must be wider")


def test_the_command_writes_table_and_json(kitti, tmp_path, fake):
    out = tmp_path / "out.json"
    words = (
        "--dataset",
        "kitti2015",
        "--root",
        kitti,
        "--method",
        "S4",
        "--method",
        "census+dt",
        "--json",
        out,
    )
    done = command(*words, "--set", "p1=10", "--set", "mode=rf", "--set", "sub-pixel=false", "--threads", 1)
    assert done.exit_code == 0, done.output
    assert "zncc+sgm" in done.stdout and "census+dt" in done.stdout and "D1 noc" in done.stdout
    assert fake.instances[0] == {
        "max_disparity": 128,
        "scale": 1.0,
        "refiner": None,
        "threads": 1,
        "p1": 10,
        "mode": "rf",
        "sub_pixel": False,
    }
    document = read(out)
    first, second = document["results"]
    assert (first["method"], first["scale"], first["refiner"], first["device"]) == (
        "zncc+sgm",
        1.0,
        None,
        "cpu",
    )
    assert first["images"] == 3
    assert first["d1"] == {
        "noc": {"all": 0.0, "bg": 0.0, "fg": 0.0},
        "occ": {"all": 50.0, "bg": 100.0, "fg": 100.0},
    }
    assert second["d1"]["noc"]["all"] == 100.0
    assert (first["epe"], first["density"]) == (0.5, pytest.approx(100 * 11 / 12))
    assert first["bad"]["noc"] == {"0.5": 50.0, "1": 0.0, "2": 0.0, "3": 0.0, "4": 0.0}
    assert first["est"]["d1"]["noc"]["fg"] == 0.0
    assert [frame["d1"] for frame in first["frames"]][1] == {"noc": 0.0, "occ": None}
    assert first["seconds_per_image"] > 0 and document["skipped"] == []
    assert document["options"]["p1"] == 10 and document["options"]["max_disparity"] == 128
    assert [path.name for path in tmp_path.iterdir()] and not list(tmp_path.glob(".*"))


def test_missing_truth_is_null(kitti, tmp_path, fake):
    out = tmp_path / "out.json"
    assert command("--dataset", "kitti2015", "--root", kitti, "--frames", "2", "--json", out).exit_code == 0
    (result,) = read(out)["results"]
    assert result["d1"] == {
        "noc": {"all": None, "bg": None, "fg": None},
        "occ": {"all": 0.0, "bg": None, "fg": None},
    }
    assert result["epe"] == 0.0  # of all pixels, where no others are known


def test_json_to_standard_output(kitti, fake):
    done = command("--dataset", "kitti2015", "--root", kitti, "--json", "-")
    assert json.loads(done.stdout)["dataset"] == "kitti2015"


def test_skipped_frames_are_reported_once_and_fail_the_run(kitti, tmp_path, fake):
    break_frames(kitti)
    out = tmp_path / "out.json"
    words = ("--dataset", "kitti2015", "--root", kitti, "--json", out, "--method", "S4", "--method", "S1")
    done = command(*words)
    assert done.exit_code == 1
    lines = [line for line in done.stderr.splitlines() if line.startswith("skipped ")]
    assert len(lines) == 5 and lines[4] == "skipped 000005_10: the frame has no ground truth"
    document = read(out)
    assert [skip["frame"][:6] for skip in document["skipped"]] == [
        "000000",
        "000001",
        "000003",
        "000004",
        "000005",
    ]
    assert [result["images"] for result in document["results"]] == [1, 1]
    assert "zncc+sgm" in done.stdout


def test_an_interrupt_keeps_the_figures_so_far(kitti, tmp_path, fake):
    add(kitti, 1, noc=11, grey=66)
    out = tmp_path / "out.json"
    done = command("--dataset", "kitti2015", "--root", kitti, "--method", "S4", "--method", "S1", "--json", out)
    assert done.exit_code == 130
    document = read(out)
    assert document["interrupted"] is True
    assert [(r["method"], r["images"]) for r in document["results"]] == [("zncc+sgm", 1)]
    assert "interrupted" in done.stderr and "zncc+sgm" in done.stdout


@pytest.mark.parametrize("ending", [".png", ".npy"])
def test_predictions(kitti, tmp_path, ending):
    folder, out = tmp_path / "maps", tmp_path / "out.json"
    folder.mkdir()
    for index in (0, 1):
        disparity = np.full(SHAPE, 10, np.float32)
        disparity[:, 5] = np.nan
        path = folder / f"{index:06d}_10{ending}"
        if ending == ".png":
            png(path, np.nan_to_num(disparity * 256).astype(np.uint16))
        else:
            np.save(path, disparity)
    (kitti / "training" / "image_2" / "000000_10.png").unlink()  # the images are not needed
    words = ("--dataset", "kitti2015", "--root", kitti, "--predictions", folder, "--json", out)
    done = command(*words)
    assert done.exit_code == 1 and "skipped 000002_10: no map 000002_10.png" in done.stderr
    (result,) = read(out)["results"]
    assert (result["method"], result["images"], result["seconds_per_image"]) == ("predictions", 2, None)
    assert result["d1"]["noc"]["all"] == 0.0 and result["density"] == pytest.approx(100 * 11 / 12)
    assert command(*words, "--frames", "0,1").exit_code == 0


def test_error_maps(kitti, tmp_path, fake):
    maps = tmp_path / "deep" / "maps"
    done = command("--dataset", "kitti2015", "--root", kitti, "--error-maps", maps, "--method", "S4")
    assert done.exit_code == 0
    names = sorted(path.name for path in (maps / "zncc+sgm").iterdir())
    assert names == ["000000_10.png", "000001_10.png", "000002_10.png"]
    picture = cv2.imread(str(maps / "zncc+sgm" / names[2]))
    # Frame 2 has no noc, so nothing is known to be hidden, and no error: the first blue.
    assert (picture == (149, 54, 49)).all()


def test_disparities_follow_the_data_set(tmp_path, fake):
    scene = tmp_path / "room"
    for name in ("im0", "im1"):
        png(scene / f"{name}.png", np.zeros(SHAPE, np.uint8))
    (scene / "calib.txt").write_text("ndisp=40\n")
    np.save(tmp_path / "x.npy", 0)
    words = ("--dataset", "eth3d", "--root", tmp_path)
    assert command(*words).exit_code == 1  # the pair has no ground truth
    assert command(*words, "--max-disparity", 64).exit_code == 1
    assert [instance["max_disparity"] for instance in fake.instances] == [40, 64]


@pytest.mark.parametrize(
    ("words", "kind", "message"),
    [
        (("--frames", "77"), OptionError, "frames must be"),
        (("--set", "p1"), OptionError, "--set must be KEY=VALUE, got 'p1'"),
        (("--set", "scale=1"), OptionError, "--set scale: use --scale instead"),
        (("--method", "nonsense"), UnknownNameError, "no cost named"),
        (("--predictions", "nowhere"), FileError, "predictions must be a folder"),
        (("--predictions", ".", "--scale", "0.5"), OptionError, "scale must go with a method of ours, got 0.5 without"),
        (("--predictions", ".", "--predictions", "."), OptionError, "methods must have different names"),
        (("--method", "no_such_module:run"), OptionError, "method must name a function that can be imported"),
        (("--command", "X=none {left} {right} {out}"), OptionError, "command must begin with a program"),
        (("--time-limit", "3"), OptionError, "time_limit must go with command"),
        (("--json", "nowhere/out.json"), FileError, "--json 'nowhere/out.json': the folder"),
        (("--json", "."), FileError, "is a folder, expected a file"),
    ],
)
def test_bad_input_is_refused_before_work(kitti, fake, words, kind, message, monkeypatch):
    monkeypatch.chdir(kitti)
    done = command("--dataset", "kitti2015", "--root", kitti, *words)
    assert isinstance(done.exception, kind) and message in str(done.exception)
    assert isinstance(done.exception, StereokitError) and "\n" not in str(done.exception)
    assert not done.stdout


def test_error_maps_must_be_a_folder(kitti, tmp_path, fake):
    (tmp_path / "file").write_text("")
    done = command("--dataset", "kitti2015", "--root", kitti, "--error-maps", tmp_path / "file")
    assert isinstance(done.exception, FileError) and "error_maps must be a folder" in str(done.exception)


def test_help_names_the_options():
    done = CliRunner(env={"COLUMNS": "200", "TERM": "dumb"}).invoke(WORKERS, ["--help"])
    for option in ("--dataset", "--root", "--frames", "--method", "--predictions", "--json", "--set"):
        assert option in done.output


def test_frames_that_a_refiner_was_trained_on_are_told_of():
    from stereokit_evaluation.scoring.runner import seen_in_training

    frames = [Frame(name, Path("l"), Path("r")) for name in ("a", "b", "c")]
    refiner = SimpleNamespace(trained_on=frozenset({"set/a", "set/c", "other/b"}))
    matcher = SimpleNamespace(refiner="mine", refine=refiner)
    line = seen_in_training(matcher, "set", frames)
    assert line is not None and "'mine' was trained on 2 of these 3 frames" in line
    assert seen_in_training(matcher, "elsewhere", frames) is None
    assert seen_in_training(SimpleNamespace(refine=None), "set", frames) is None
    assert seen_in_training(object(), "set", frames) is None


def test_refiners_have_a_row_each(kitti, tmp_path, fake):
    words = (
        "--dataset",
        "kitti2015",
        "--root",
        kitti,
        "--scale",
        "0.5",
        "--refiner",
        "linear",
        "--refiner",
        "stereokit",
    )
    out, maps = tmp_path / "out.json", tmp_path / "maps"
    done = command(*words, "--method", "S4", "--method", "other", "--json", out, "--error-maps", maps)
    assert done.exit_code == 0, done.output
    rows = [(row["method"], row["refiner"]) for row in read(out)["results"]]
    assert rows == [(method, refiner) for method in ("zncc+sgm", "other") for refiner in ("linear", "stereokit")]
    assert [instance["refiner"] for instance in fake.instances] == ["linear", "stereokit"] * 2
    assert sorted(path.name for path in maps.iterdir()) == sorted(f"{m}-{r}" for m, r in rows)
    table = command(*words, "--method", "S4").stdout
    assert "zncc+sgm linear x0.5" in table and "zncc+sgm stereokit x0.5" in table


@pytest.mark.parametrize("suffix", [".png", ".pfm", ".npy", ".tiff", ".tif"])
def test_every_format_that_is_written_is_found(suffix, tmp_path, fake):
    for side in ("left", "right"):
        png(tmp_path / side / "a.png", np.full((*SHAPE, 3), 50, np.uint8))
    for folder in ("disparity", "mine"):
        (tmp_path / folder).mkdir()
        write_disparity(tmp_path / folder / f"a{suffix}", np.full(SHAPE, 10, np.float32))
    words = ("--dataset", "folder", "--root", tmp_path, "--json", tmp_path / "out.json")
    for more in ((), ("--predictions", tmp_path / "mine")):
        done = command(*words, *more)
        assert done.exit_code == 0, done.output
        assert read(tmp_path / "out.json")["results"][0]["d1"]["occ"]["all"] == 0


def test_a_hostile_frame_costs_itself_and_any_name_can_be_shown(tmp_path, fake):
    names = ["good", "image[red]", "[bold]map", "npy", "header", "size"]
    for name in names:
        for side in ("left", "right"):
            png(tmp_path / side / f"{name}.png", np.full((*SHAPE, 3), 50, np.uint8))
        (tmp_path / "disparity").mkdir(exist_ok=True)
        write_disparity(tmp_path / "disparity" / f"{name}.pfm", np.full(SHAPE, 10, np.float32))
    (tmp_path / "left" / "image[red].png").write_bytes(b"nothing")
    (tmp_path / "disparity" / "[bold]map.pfm").write_bytes(b"Pf\n" + b"1" * 5000 + b" 1\n-1\n")
    (tmp_path / "disparity" / "npy.pfm").unlink()
    (tmp_path / "disparity" / "npy.npy").write_bytes(b"\x93NUMPY\x01\x00\x04\x00{}\n ")
    (tmp_path / "disparity" / "header.pfm").unlink()
    (tmp_path / "disparity" / "header.tif").write_bytes(b"II*\0\x08\0\0\0")
    write_disparity(tmp_path / "disparity" / "size.pfm", np.full((3, 3), 10, np.float32))
    done = command("--dataset", "folder", "--root", tmp_path, "--json", tmp_path / "out.json")
    assert done.exit_code == 1 and isinstance(done.exception, SystemExit), f"{done.output}{done.exception!r}"
    document = read(tmp_path / "out.json")
    assert document["results"][0]["images"] == 1
    assert sorted(skip["frame"] for skip in document["skipped"]) == sorted(set(names) - {"good"})
    assert all(f"skipped {name}: " in done.output for name in set(names) - {"good"})
    for frames in ("9" * 5000, f"0-{'9' * 5000}"):
        wrong = command("--dataset", "folder", "--root", tmp_path, "--frames", frames)
        assert isinstance(wrong.exception, OptionError) and "frames must be" in str(wrong.exception)


def test_what_looks_wrong_about_a_frame_is_told(tmp_path):
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 90, (60, 420)), (0, 0), 0.8)
    left, right = (np.clip(noise[:, start : start + 400], 0, 255).astype(np.uint8) for start in (0, 12))
    (tmp_path / "disparity").mkdir()
    for name, other in (("good", right), ("rows", np.roll(right, 9, axis=0)), ("same", left)):
        png(tmp_path / "left" / f"{name}.png", left)
        png(tmp_path / "right" / f"{name}.png", other)
        write_disparity(tmp_path / "disparity" / f"{name}.pfm", np.full(left.shape, 12, np.float32))
    done = command("--dataset", "folder", "--root", tmp_path, "--method", "S2", "--max-disparity", "128")
    assert done.exit_code == 0, done.output
    lines = [line for line in done.output.splitlines() if line.startswith("warning: ")]
    assert (
        len(lines) == 2
        and "rows: rows do not meet: the right view lies 9.0 px lower" in lines[0]
        and "same: left and right hold the same pixels" in lines[1]
    )
