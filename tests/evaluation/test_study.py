"""The study on small pairs: tables, what is kept, what is recomputed, and what happens when frames or refiners fail."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from limits import HANG_S
from typer.testing import CliRunner

from stereokit.errors import FileError, InputError, OptionError, StereokitError, UnknownNameError
from stereokit.io import write_disparity
from stereokit.registry import REFINERS
from stereokit_evaluation.commands.study import study
from stereokit_evaluation.data import datasets
from stereokit_evaluation.data.datasets import folder
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.kitti import score
from stereokit_evaluation.study import run as study_run
from stereokit_evaluation.study.configurations import Configuration
from stereokit_evaluation.study.data import parse_data
from stereokit_evaluation.study.run import run_study
from stereokit_evaluation.study.store import Record, Store, digest, frame_digest
from stereokit_evaluation.training import per_matcher
from stereokit_refiners import Linear

APP = typer.Typer()
APP.command()(study)
SMALL = ("--max-disparity", "16", "--threads", "1", "--repeats", "1", "--no-peers", "--no-report")


def write_pairs(root, count, shape=(32, 96)):
    """Write shifted noise in the layout of the data set "folder"."""
    for part in ("left", "right", "disparity"):
        (root / part).mkdir(parents=True, exist_ok=True)
    for index in range(count):
        rng = np.random.default_rng(index)
        left = cv2.GaussianBlur(rng.integers(0, 256, shape, dtype=np.uint8), (0, 0), 1)
        noise = rng.integers(0, 60, shape, dtype=np.uint8)
        right = cv2.add(np.roll(left, -(4 + index % 3), axis=1), noise)
        assert cv2.imwrite(str(root / "left" / f"{index:03d}.png"), left)
        assert cv2.imwrite(str(root / "right" / f"{index:03d}.png"), right)
        write_disparity(root / "disparity" / f"{index:03d}.png", np.full(shape, 4.0 + index % 3, np.float32))
    return root


@pytest.fixture
def pairs(tmp_path):
    return write_pairs(tmp_path / "pairs", 3)


def command(root, output, *words):
    arguments = ["--dataset", "folder", "--root", root, "-o", output, *SMALL, *words]
    return CliRunner().invoke(APP, [str(word) for word in arguments])


def figures(document):
    """Return all that must not depend on when it was measured."""
    times = ("seconds_per_image", "ms")
    rows = [{key: value for key, value in row.items() if key not in times} for row in document["results"]]
    for row in rows:
        row["frames"] = [{k: v for k, v in frame.items() if k != "seconds"} for frame in row["frames"]]
    return rows


def run(root, output, *words, status=0):
    done = command(root, output, "--json", "-", *words)
    assert done.exit_code == status, (done.output, done.exception)
    return json.loads(done.stdout)


@pytest.fixture
def kitti(pairs):
    """Return the same pairs in the layout of KITTI 2015, the last without truth of not occluded pixels."""
    root = pairs.parent / "kitti" / "training"
    for old, new in (("left", "image_2"), ("right", "image_3"), ("disparity", "disp_occ_0")):
        (root / new).mkdir(parents=True)
        for file in sorted((pairs / old).iterdir()):
            (root / new / f"000{file.stem}_10.png").write_bytes(file.read_bytes())
    (root / "disp_noc_0").mkdir()
    for name in ("000000_10.png", "000001_10.png"):
        (root / "disp_noc_0" / name).write_bytes((root / "disp_occ_0" / name).read_bytes())
    return root.parent


def test_the_table_has_ours_and_the_published_figures(kitti, tmp_path):
    words = ["--data", f"kitti2015:{kitti}", "-o", str(tmp_path / "out"), *SMALL]
    words += ["--method", "S4", "--method", "S2", "--variant", "linear", "--setting", "original"]
    done = CliRunner().invoke(APP, words)
    assert done.exit_code == 0, done.output
    rows = [line.split() for line in done.stdout.splitlines() if line.startswith(" S4")]
    assert rows[0][1] == "Mini+Linear" and rows[0][-2:] == ["9.56", "7.47"]
    assert "published" in done.stdout and "Not the same frames" in done.stdout
    document = json.loads((tmp_path / "out" / "study.json").read_text())
    linear, original, *_ = document["results"]
    assert linear["published"] == {"validation_d1": 9.56, "test_d1_noc": 7.47, "agx_ms": None}
    assert original["published"]["agx_ms"] == 12.64


def test_other_data_have_no_published_figures_beside_them(pairs, kitti, tmp_path):
    done = command(pairs, tmp_path / "folder", "--method", "S4", "--variant", "linear")
    assert done.exit_code == 0 and "9.56" not in done.stdout and "published e4" not in done.stdout
    assert "No published figures: they are of KITTI 2015" in done.stdout
    words = ["--data", f"folder:{pairs}", "--data", f"K=kitti2015:{kitti}", "-o", str(tmp_path / "both"), *SMALL]
    assert CliRunner().invoke(APP, [*words, "--method", "S4", "--variant", "linear"]).exit_code == 0
    tables = tmp_path / "both" / "tables"
    has = {name: "9.56" in (tables / f"{name}accuracy.csv").read_text() for name in ("", "folder_", "K_")}
    assert has == {"": False, "folder_": False, "K_": True}
    assert (tmp_path / "both" / "charts" / "d1.csv").exists()
    assert "measured here, K" in (tmp_path / "both" / "charts" / "d1_test.csv").read_text()


def test_tables_of_an_earlier_study_do_not_stay_beside_the_new_ones(pairs, kitti, tmp_path):
    words = ["--data", f"kitti2015:{kitti}", "--data", f"folder:{pairs}", "-o", str(tmp_path / "out"), *SMALL]
    assert CliRunner().invoke(APP, [*words, "--method", "S2", "--variant", "original"]).exit_code == 0
    (tmp_path / "out" / "tables" / "own.csv").write_text("mine")
    assert (tmp_path / "out" / "tables" / "kitti2015_accuracy.csv").exists()
    assert command(pairs, tmp_path / "out", "--method", "S2", "--variant", "original").exit_code == 0
    names = {path.name for part in ("tables", "charts") for path in (tmp_path / "out" / part).iterdir()}
    assert not any(name.startswith(("kitti2015_", "folder_", "d1_")) for name in names)
    assert {"own.csv", "accuracy.tex", "pairs.csv", "d1.csv"} <= names
    (tmp_path / "out" / "study.json").write_text('{"results": 1}')
    assert command(pairs, tmp_path / "out", "--method", "S2", "--variant", "original").exit_code == 0


def test_two_rows_have_different_names(pairs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flat_map.py").write_text(
        "def run(left, right):\n    return left[..., 0] if left.ndim == 3 else left\n"
    )
    done = command(
        pairs, tmp_path / "out", "--method", "S2", "--variant", "original", "--method", "S2 Original=flat_map:run"
    )
    assert isinstance(done.exception, OptionError) and "'S2 Original' twice" in str(done.exception)
    done = command(pairs, tmp_path / "out", "--method", "a:boom:=flat_map:run", "--method", "x:boom:[b]=flat_map:run")
    assert done.exit_code == 0 and "a:boom:" in done.stdout and "x:boom:[b]" in done.stdout


def test_tables_say_how_many_frames_have_which_truth(kitti, tmp_path):
    words = ["--data", f"kitti2015:{kitti}", "-o", str(tmp_path / "out"), *SMALL, "--method", "S4"]
    done = CliRunner().invoke(APP, [*words, "--variant", "original"])
    assert "seen by both cameras in 2 of them, all with truth, occluded ones too, in the other" in " ".join(
        done.stdout.split()
    )
    for name in ("accuracy", "measures"):
        assert (
            "3 frames of kitti2015, all (noc: 2 of them, occ: 3)"
            in (tmp_path / "out" / "tables" / f"{name}.md").read_text()
        )


def test_the_json_has_everything(pairs, tmp_path):
    document = run(pairs, tmp_path / "out", "--method", "S4", "--variant", "linear", "--variant", "original")
    linear, original = document["results"]
    assert (linear["matcher"], linear["setting"], linear["refiner"], linear["scale"]) == (
        "S4",
        "Mini+Linear",
        "linear",
        0.5,
    )
    assert (original["setting"], original["refiner"], original["scale"]) == ("Original", None, 1.0)
    assert set(linear["ms"]) == {"total", "prepare", "match", "clean", "refine", "other"}
    assert linear["ms"]["refine"] > 0 and original["ms"]["refine"] == 0
    assert linear["images"] == 3 and document["frames"] == ["000", "001", "002"]
    assert document["frames_with_truth"] == {"noc": 0, "occ": 3, "objects": 0}
    assert linear["d1"]["occ"]["all"] is not None and linear["d1"]["noc"]["all"] is None
    assert document["records"] == {"reused": 0, "computed": 6} and document["interrupted"] is False


def test_a_changed_option_recomputes_only_what_it_touches(pairs, tmp_path):
    out, words = tmp_path / "out", ("--method", "S1", "--method", "S2", "--variant", "original")
    first = run(pairs, out, *words)
    again = run(pairs, out, *words)
    assert again["records"] == {"reused": 6, "computed": 0}
    assert again["results"] == first["results"]  # times too: nothing was measured again
    changed = run(pairs, out, *words, "--set", "p1=3")
    assert changed["records"] == {"reused": 3, "computed": 3}
    assert changed["results"][0] == first["results"][0]
    back = run(pairs, out, *words)
    assert back["records"]["computed"] == 0 and back["results"] == first["results"]


def test_changed_inputs_are_recomputed(pairs, tmp_path):
    out, words = tmp_path / "out", ("--method", "S2", "--variant", "original")
    run(pairs, out, *words)
    image = cv2.imread(str(pairs / "left" / "001.png"), cv2.IMREAD_UNCHANGED)
    image[3, 5] ^= 1
    cv2.imwrite(str(pairs / "left" / "001.png"), image)
    write_disparity(pairs / "disparity" / "002.png", np.full((32, 96), 9.0, np.float32))
    assert run(pairs, out, *words)["records"] == {"reused": 1, "computed": 2}
    assert run(pairs, out, *words, "--repeats", "2")["records"]["reused"] == 0  # other times


def test_a_damaged_record_is_made_anew(pairs, tmp_path):
    out, words = tmp_path / "out", ("--method", "S2", "--variant", "original")
    first = run(pairs, out, *words)
    files = sorted((out / "results").rglob("*.json"))
    assert len(files) == 3 and files[0].parent == out / "results" / "S2" / "Original"
    files[0].write_text("{")
    files[1].write_text(json.dumps({"score": {}, "ms": {}}))
    again = run(pairs, out, *words)
    assert again["records"] == {"reused": 1, "computed": 2} and figures(again) == figures(first)


def test_broken_frames_are_left_out_for_all(pairs, tmp_path):
    write_pairs(pairs, 6)
    (pairs / "left" / "000.png").write_text("no picture")
    (pairs / "right" / "001.png").unlink()
    cv2.imwrite(str(pairs / "right" / "002.png"), np.zeros((5, 6), np.uint8))
    write_disparity(pairs / "disparity" / "003.png", np.full((5, 6), 1.0, np.float32))
    (pairs / "disparity" / "004.png").unlink()
    document = run(pairs, tmp_path / "out", "--method", "S2", "--method", "S4", "--variant", "original", status=1)
    reasons = {skip["frame"]: skip["reason"] for skip in document["skipped"]}
    assert list(reasons) == ["000", "001", "002", "003", "004"]
    assert "not an image that can be read" in reasons["000"] and "no such file" in reasons["001"]
    assert reasons["002"].startswith("left and right must have one size")
    assert reasons["003"].startswith("occ must have the size of the images")
    assert reasons["004"] == "the frame has no ground truth"
    assert [row["images"] for row in document["results"]] == [1, 1]
    assert all("\n" not in reason for reason in reasons.values())


def fake(name, behave, missing=None):
    """Return a configuration whose matcher is a function."""

    def match(left, right):
        behave(left)
        result = type("Found", (), {})()
        result.disparity, result.valid = np.full(left.shape, 4.0, np.float32), np.ones(left.shape, bool)
        return result

    return Configuration(name, name, "original", match if missing is None else None, {"name": name}, missing)


def frames(count=3):
    def frame(index):
        image = np.full((6, 8), index, np.uint8)
        return Frame(f"f{index}", lambda: image, lambda: image, occ=lambda: np.full((6, 8), 4.0, np.float32))

    return [frame(index) for index in range(count)]


def test_a_slip_on_one_frame_leaves_it_out_for_all_and_goes_on():
    def slip(left):
        if left[0, 0] == 1:
            raise IndexError("a bug")

    lines = []
    study = run_study(frames(), [fake("A", slip), fake("B", lambda left: None)], Store(None), report=lines.append)
    assert [[frame.name for frame in row.result.frames] for row in study.rows] == [["f0", "f2"]] * 2
    assert lines == ["skipped f1: A Original: IndexError: a bug"]
    assert [(skip.name, skip.reason) for skip in study.skipped] == [("f1", "A Original: IndexError: a bug")]


def test_a_refiner_that_never_works_is_missing_and_harms_no_frame():
    def never(left):
        raise RuntimeError("weights are broken")

    def no_runtime(left):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    cells = [fake("A", never), fake("B", no_runtime), fake("C", lambda left: None), fake("D", None, "not there")]
    study = run_study(frames(), cells, Store(None))
    assert [row.missing for row in study.rows] == [
        "RuntimeError: weights are broken",
        "needs the package 'torch', which is not installed",
        None,
        "not there",
    ]
    assert len(study.rows[2].result.frames) == 3 and not study.skipped


def test_a_refiner_that_fails_at_first_is_given_up():
    calls = []

    def never(left):
        calls.append(1)
        raise RuntimeError("weights are broken")

    study = run_study(frames(9), [fake("A", never), fake("B", lambda left: None)], Store(None))
    assert len(calls) == 3 and study.rows[0].missing == "RuntimeError: weights are broken"
    assert len(study.rows[1].result.frames) == 9 and not study.skipped


def test_broken_frames_at_the_start_give_nobody_up(pairs):
    write_pairs(pairs, 7)
    for index in range(5):
        (pairs / "left" / f"{index:03d}.png").write_text("no picture")
    study = run_study(folder(pairs), [fake("A", lambda left: None)], Store(None))
    assert study.rows[0].missing is None and len(study.rows[0].result.frames) == 2 and len(study.skipped) == 5


def test_an_interrupt_keeps_whole_frames():
    def stop(left):
        if left[0, 0] == 2:
            raise KeyboardInterrupt

    study = run_study(frames(), [fake("A", lambda left: None), fake("B", stop)], Store(None))
    assert study.interrupted and [len(row.result.frames) for row in study.rows] == [2, 2]


def test_times_are_medians_after_a_call_to_warm_up():
    calls = []
    ticks = iter([0.0, 0.010, 0.0, 0.050, 0.0, 0.020])
    cell = fake("A", lambda left: calls.append(1))
    record = study_run.measure(
        cell, study_run._LoadedFrame(frames(1)[0], True), 3, warm=False, clock=lambda: next(ticks)
    )
    assert len(calls) == 4 and record.ms["total"] == pytest.approx(20.0)


def test_the_interrupted_command_exits_with_130(pairs, tmp_path, monkeypatch):
    real = study_run.measure

    def stop(configuration, loaded, repeats, **options):
        if loaded.frame.name == "001":
            raise KeyboardInterrupt
        return real(configuration, loaded, repeats, **options)

    monkeypatch.setattr(study_run, "measure", stop)
    out, words = tmp_path / "out", ("--method", "S2", "--variant", "original")
    document = run(pairs, out, *words, status=130)
    assert document["interrupted"] is True and document["frames"] == ["000"]
    monkeypatch.setattr(study_run, "measure", real)
    assert run(pairs, out, *words)["records"] == {"reused": 1, "computed": 2}


def test_killed_twice_it_ends_with_the_same_table(tmp_path):
    pairs = write_pairs(tmp_path / "pairs", 12, (120, 400))
    words = ["--dataset", "folder", "--root", str(pairs), *SMALL, "--method", "S2", "--method", "S4"]
    words += ["--variant", "original", "--variant", "linear", "--repeats", "25"]

    def start(output):
        import stereokit
        import stereokit_refiners

        homes = [str(Path(module.__file__).parents[1]) for module in (stereokit, stereokit_refiners, study_run)]
        program = [sys.executable, "-m", "stereokit.cli", "study", *words, "-o", str(output)]
        program += ["--json", str(output.with_suffix(".json"))]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(homes)}
        return subprocess.Popen(program, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def records(output):
        return len(list((output / "results").rglob("*.json")))

    killed, whole = tmp_path / "killed", tmp_path / "whole"
    for enough in (7, 23):
        process = start(killed)
        deadline = time.monotonic() + HANG_S
        while records(killed) < enough and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        assert process.poll() is None, "it ended before it could be killed"
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert enough <= records(killed) < 48
    for output in (killed, whole):
        assert start(output).wait(timeout=HANG_S) == 0
    ends = [json.loads(output.with_suffix(".json").read_text()) for output in (killed, whole)]
    assert figures(ends[0]) == figures(ends[1])
    assert ends[0]["records"]["reused"] >= 23 and ends[1]["records"] == {"reused": 0, "computed": 48}


@pytest.mark.parametrize(
    ("words", "kind", "message"),
    [
        (("--variant", "nonsense"), UnknownNameError, "no variant named 'nonsense'"),
        (("--method", "S9"), UnknownNameError, "no method named 'S9'"),
        (("--set", "p1"), OptionError, "--set must be KEY=VALUE"),
        (("--set", "colour=1"), OptionError, "no option named 'colour'"),
        (("--repeats", "0"), OptionError, "repeats must be at least 1, got 0"),
        (("--show", "-1"), OptionError, "show must be at least 0, got -1"),
        (("--split", "train"), OptionError, "split must go with dataset kitti2015, got 'folder'"),
        (("--frames", "77"), OptionError, "frames must be in the data set"),
        (("--json", "nowhere/x.json"), FileError, "--json 'nowhere/x.json': the folder 'nowhere' does not exist"),
        (("--max-disparity", "0"), OptionError, "max_disparity must be"),
        (("--train-set", "steps=1"), OptionError, "train-set must go with train"),
        (("--train",), OptionError, "train must go with dataset kitti2015 or scenes, got 'folder'"),
    ],
)
def test_bad_input_is_one_line_before_any_work(pairs, tmp_path, words, kind, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = command(pairs, tmp_path / "out", *words)
    assert isinstance(done.exception, kind) and message in str(done.exception)
    assert isinstance(done.exception, StereokitError) and "\n" not in str(done.exception)
    assert not done.stdout and not (tmp_path / "out").exists()


def test_an_output_that_is_no_folder_is_refused(pairs, tmp_path):
    (tmp_path / "file").write_text("mine")
    for place in ("file", "file/below"):
        done = command(pairs, tmp_path / place)
        assert isinstance(done.exception, FileError) and "output must be a folder" in str(done.exception)
    assert (tmp_path / "file").read_text() == "mine"


def test_training_gives_each_matcher_its_own_weights(tmp_path, monkeypatch):
    calls = []

    def train(home, refiner, *, frames, streets, method, settings, **options):
        calls.append((refiner, method[0], frames, streets, settings))
        (home / "weights.safetensors").write_bytes(b"not weights")

    monkeypatch.setattr(per_matcher, "run_training", train)
    monkeypatch.setattr(datasets, "_SCENE_SIZE", (96, 48))
    datasets._scene.cache_clear()
    words = ["--dataset", "scenes", "--count", "1", "--method", "S2", "--method", "S4", "--variant", "cnn"]
    words += ["--variant", "linear", "--train", "--train-set", "steps=5", "-o", str(tmp_path / "out"), *SMALL]
    for _ in range(2):  # the second time they are there
        done = CliRunner().invoke(APP, [*words, "--json", "-"])
        assert done.exit_code == 1, (done.output, done.exception)
        assert calls == [("cnn", name, None, 160, ["steps=5"]) for name in ("census+sgm", "zncc+sgm")]
    datasets._scene.cache_clear()
    rows = json.loads(done.stdout)["results"]
    assert [row["missing"] is None for row in rows] == [False, True, False, True]
    assert "weights" in rows[0]["missing"]


def test_frames_that_are_scored_are_not_trained_on(tmp_path):
    for part in ("image_2", "image_3", "disp_noc_0"):
        (tmp_path / part).mkdir()
        for index in range(4):
            (tmp_path / part / f"{index:06d}_10.png").write_bytes(b"")
    every = datasets.kitti2015(tmp_path)
    assert [f.name[:6] for f in per_matcher.training_frames("kitti2015", tmp_path, every[1:3])] == ["000000", "000003"]
    with pytest.raises(OptionError, match="train must leave frames to train on"):
        per_matcher.training_frames("kitti2015", tmp_path, every)


def test_a_refiner_of_another_package_joins(pairs, tmp_path, monkeypatch):
    monkeypatch.setattr(REFINERS, "_items", {**REFINERS._items, "mine": Linear})
    linear, plugin = run(pairs, tmp_path / "out", "--method", "S2", "--variant", "linear", "--variant", "mine")[
        "results"
    ]
    assert plugin["setting"] == "Mini+mine" and plugin["d1"] == linear["d1"]


def test_a_setting_that_was_asked_for_and_is_missing_fails_the_run(pairs, tmp_path, monkeypatch):
    def no_runtime():
        raise ModuleNotFoundError("No module named 'runtime'", name="runtime")

    monkeypatch.setattr(REFINERS, "_items", {**REFINERS._items, "cnn": no_runtime})
    words = ("--method", "S2", "--variant", "linear", "--variant", "cnn")
    document = run(pairs, tmp_path / "out", *words, status=1)
    assert document["results"][1]["missing"] == "needs the package 'runtime', which is not installed"


def test_records_survive_the_disk_and_nothing_else_is_read(tmp_path):
    record = Record(score(np.full((4, 5), 3.0), occ=np.full((4, 5), 9.0), noc=np.full((4, 5), 3.0)), {"total": 1.5})
    store = Store(tmp_path)
    store.put("S1/original/2003/cones", "ab" * 32, record, {})
    assert store.get("S1/original/2003/cones", "ab" * 32) == record
    assert store.get("S1/original/2003/cones", "cd" * 32) is None
    store.put("../../x/../../../escape", "ab" * 32, record, {})
    assert all(path.resolve().is_relative_to(tmp_path) for path in tmp_path.rglob("*"))
    assert not list(tmp_path.parent.glob("escape*"))
    assert Store(None).get("a/b/c", "d") is None


def test_digests_follow_content(pairs):
    first, second, _ = folder(pairs)
    assert frame_digest(first) == frame_digest(folder(pairs)[0]) != frame_digest(second)
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1}) != digest({"a": 1})
    copies = frames(2)
    assert frame_digest(copies[0]) == frame_digest(frames(1)[0]) != frame_digest(copies[1])
    (pairs / "left" / "000.png").unlink()
    with pytest.raises(FileError, match="no such file"):
        frame_digest(first)


def test_measure_refuses_unequal_sizes(pairs):
    frame = folder(pairs)[0]
    other = Frame("x", frame.left, lambda: np.zeros((3, 3), np.uint8), occ=frame.occ)
    with pytest.raises(InputError, match="one size"):
        study_run.measure(fake("A", lambda left: None), study_run._LoadedFrame(other, True), 1)


def many(tmp_path, *words, status=0):
    """Run the command on two folders; return its JSON."""
    for name, count, shape in (("one", 2, (40, 96)), ("two", 3, (32, 80))):
        if not (tmp_path / name).exists():
            write_pairs(tmp_path / name, count, shape)
    arguments = ["--data", f"folder:{tmp_path / 'one'}", "--data", f"folder:{tmp_path / 'two'}", "--json", "-"]
    arguments += ["-o", tmp_path / "out", *SMALL, "--method", "S2", "--variant", "linear", "--variant", "original"]
    done = CliRunner().invoke(APP, [str(word) for word in (*arguments, *words)])
    assert done.exit_code == status, (done.output, done.exception)
    return json.loads(done.stdout)


def test_all_data_sets_in_one_run(tmp_path):
    document = many(tmp_path)
    one, two = document["data"]["folder"], document["data"]["folder-2"]
    assert (one["frames"], two["frames"]) == (["000", "001"], ["000", "001", "002"])
    assert document["frames"] == [f"folder/{n}" for n in ("000", "001")] + [f"folder-2/00{n}" for n in range(3)]
    for index, row in enumerate(document["results"]):
        parts = [data["results"][index] for data in (one, two)]
        assert row["name"] == parts[0]["name"] and row["images"] == 5
        assert row["figures"]["main"]["d1"] == pytest.approx(
            sum(p["figures"]["main"]["d1"] * p["pixels"]["occ"] for p in parts) / row["pixels"]["occ"]
        )
        assert len(row["frames"]) == 5 and row["ms"]["total"] > 0
    assert document["records"] == {"reused": 0, "computed": 10}
    assert many(tmp_path)["records"] == {"reused": 10, "computed": 0}
    assert "5 pairs" in document["pixels_line"] and "2 pairs" in one["pixels_line"]


def test_the_json_has_all_measures_intervals_and_comparisons(tmp_path):
    document = many(tmp_path)
    row = document["data"]["folder-2"]["results"][1]
    assert (row["name"], row["label"], row["variant"], row["kind"]) == ("S2 Original", "S2", "original", "stereokit")
    assert set(row["figures"]) == {"main", "noc", "all", "occluded", "edges"}
    frames = row["frames"]
    assert sum(f["figures"]["epe"] for f in frames) / 3 == pytest.approx(row["figures"]["main"]["epe"])
    assert sum(f["figures"]["a90"] for f in frames) / 3 == pytest.approx(row["figures"]["main"]["a90"])
    low, high = row["intervals"]["epe"]
    assert min(f["figures"]["epe"] for f in frames) - 1e-9 <= low <= row["figures"]["main"]["epe"] <= high
    (entry,) = [c for c in document["data"]["folder-2"]["comparisons"] if c["figure"] == "epe"]
    other = document["data"]["folder-2"]["results"][0]
    assert (entry["first"], entry["second"], entry["scenes"]) == ("S2 Mini+Linear", "S2 Original", 3)
    assert entry["difference"] == pytest.approx(other["figures"]["main"]["epe"] - row["figures"]["main"]["epe"])
    assert entry["low"] <= entry["difference"] <= entry["high"] and 0.25 <= entry["p"] <= 1


def test_frames_are_chosen_for_each_data_set(tmp_path):
    document = many(tmp_path, "--frames", "folder:1", "--frames", "folder-2:0", "--frames", "folder-2:2")
    assert document["frames"] == ["folder/001", "folder-2/000", "folder-2/002"]
    assert many(tmp_path, "--frames", "0-1")["frames"] == [f"{d}/00{n}" for d in ("folder", "folder-2") for n in (0, 1)]
    assert many(tmp_path, "--max-frames", "2")["frames"][2:] == ["folder-2/000", "folder-2/002"]


def test_data_sets_have_names(tmp_path):
    assert [(name, kind) for name, kind, _ in parse_data(["folder:a", "sat=folder:b", "folder:c", "scenes"])] == [
        ("folder", "folder"), ("sat", "folder"), ("folder-3", "folder"), ("scenes", "scenes"),
    ]  # fmt: skip
    assert parse_data(["eth3d:C:/x y"]) == [("eth3d", "eth3d", Path("C:/x y"))]


def test_others_have_rows_like_ours(pairs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_for_study.py").write_text("def run(left, right):\n    return left * 0.0 + 4\n")
    (tmp_path / "maps").mkdir()
    for index in range(3):
        write_disparity(tmp_path / "maps" / f"{index:03d}.pfm", np.full((32, 96), 4.0 + index % 3, np.float32))
    script = "import sys, shutil; shutil.copy(sys.argv[4], sys.argv[3])"
    line = f"Copy='{sys.executable}' -c '{script}' {{left}} {{right}} {{out}} {tmp_path / 'maps' / '000.pfm'}"
    words = ("--method", "S2", "--variant", "original", "--method", "OpenCV SGBM", "--command", line)
    words += ("--method", "mine_for_study:run", "--predictions", f"Net={tmp_path / 'maps'}")
    document = run(pairs, tmp_path / "out", *words)
    rows = {row["name"]: row for row in document["results"]}
    assert [row["kind"] for row in rows.values()] == ["stereokit", "opencv", "function", "program", "maps"]
    assert rows["Net"]["epe"] == 0 and rows["Net"]["ms"] == {}
    assert rows["Copy"]["epe"] == rows["mine_for_study:run"]["epe"] == pytest.approx(1)
    assert rows["Copy"]["ms"]["total"] > 0 and all(row["setting"] == "peer" for row in list(rows.values())[1:])
    assert document["records"] == {"reused": 0, "computed": 15}
    (tmp_path / "maps" / "other").mkdir()
    write_disparity(tmp_path / "maps" / "001.pfm", np.full((32, 96), 9.0, np.float32))
    again = run(pairs, tmp_path / "out", *words)
    assert again["records"] == {"reused": 14, "computed": 1}  # a map that changed is scored again
    (tmp_path / "maps" / "002.pfm").unlink()
    document = run(pairs, tmp_path / "out", *words, status=1)
    assert document["frames"] == ["000", "001"] and document["results"][-1]["failed"] == 1
    assert "Net: no map 002.png, .pfm" in document["skipped"][0]["reason"]
    table = command(pairs, tmp_path / "out", *words, "--frames", "0-1").stdout
    assert "mine_for_study:run" in table and "Copy" in table and "RMSE" in table and "minus that of the best" in table


def test_benchmarks_have_their_own_figures(tmp_path):
    room = tmp_path / "data" / "room_1l"
    room.mkdir(parents=True)
    left = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (32, 96), dtype=np.uint8), (0, 0), 1)
    for name, image in (("im0", left), ("im1", np.roll(left, -5, axis=1))):
        assert cv2.imwrite(str(room / f"{name}.png"), image)
    write_disparity(room / "disp0GT.pfm", np.full((32, 96), 5, np.float32))
    mask = np.where(np.arange(96) > 8, 255, 128)[None].repeat(32, 0).astype(np.uint8)
    assert cv2.imwrite(str(room / "mask0nocc.png"), mask)
    words = ["--data", f"eth3d:{tmp_path / 'data'}", "-o", tmp_path / "out", *SMALL, "--method", "S2"]
    done = CliRunner().invoke(APP, [str(word) for word in (*words, "--variant", "original", "--json", "-")])
    document = json.loads(done.stdout)
    row = document["data"]["eth3d"]["official"]["eth3d"]["S2 Original"]
    assert row["average"]["dense"]["nonocc"]["coverage"] == 100 and row["average"]["dense"]["nonocc"]["bad-1"] < 1
    assert row["frames"]["room_1l"]["dense"]["all"]["pixels"] == 32 * 96
    assert document["data"]["eth3d"]["scenes"] == ["room"]
    table = CliRunner().invoke(APP, [str(word) for word in (*words, "--variant", "original")]).stdout
    assert "eth3d, its own rules, 1 pair" in table and "lower the coverage" in table


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--data", "folder"), "data must be NAME:DIR, got 'folder' without a folder"),
        (("--data", "nothing:."), "data must be NAME:DIR with a name of kitti2015"),
        (("--data", "x=folder:.", "--data", "x=folder:."), "data must have different names, got 'x' twice"),
        (("--data", "a/b=folder:."), "data must have names of letters, digits"),
        (("--data", "folder:.", "--root", "."), "dataset and root must not be set with data"),
        (("--data", "folder:.", "--frames", "kitti:3"), "frames must be DATA:SELECTION with DATA one of folder"),
        (("--data", "folder:.", "--data", "folder:.", "--train"), "train must go with one data set, got 2"),
        (("--data", "folder:.", "--max-frames", "0"), "max_frames must be at least 1, got 0"),
        (("--data", "folder:.", "--disturb-frames", "1"), "disturb_frames must go with disturb"),
        (("--data", "folder:.", "--disturb", "fog"), "no disturbance named 'fog'"),
        (("--data", "folder:.", "--disturb", "noise:x"), "disturb must be KIND:S1,S2 with numbers"),
        (("--data", "folder:.", "--disturb", "noise:-1"), "noise must have strengths from 0 to 255"),
        (("--data", "folder:.", "--predictions", "X=none"), "predictions must be a folder"),
        (("--data", "folder:.", "--time-limit", "3"), "time_limit must go with command"),
    ],
)
def test_bad_data_is_one_line_before_any_work(pairs, tmp_path, words, message, monkeypatch):
    monkeypatch.chdir(pairs)
    done = CliRunner().invoke(APP, [str(word) for word in (*words, "-o", tmp_path / "out", *SMALL)])
    assert isinstance(done.exception, StereokitError), (done.output, done.exception)
    assert message in str(done.exception) and "\n" not in str(done.exception) and not (tmp_path / "out").exists()
