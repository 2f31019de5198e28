"""The command line, with a stand-in for the matcher: what is checked, written, printed and returned."""

from __future__ import annotations

import json
import subprocess
import sys
import types
from importlib import metadata
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from typer.testing import CliRunner

from stereokit import io
from stereokit.cli import app, output
from stereokit.cli.output import waiting
from stereokit.errors import OptionError
from stereokit.notices import warn
from stereokit.result import Disparity

HEIGHT, WIDTH = 6, 8
CALIBRATION = {"fx": 100, "fy": 100, "cx0": 0, "cy": 0, "baseline_m": 0.1}


class FakeMatcher:
    """Finds disparity 10 everywhere but in the first column, and remembers how it was called."""

    instances: ClassVar[list[dict]] = []
    called = 0
    confident = True
    raises: BaseException | None = None

    def __init__(self, method="census+sgm", **options):
        if options.get("p1") == "bad":
            raise OptionError("p1 must be a number, got 'bad'")
        FakeMatcher.instances.append({"method": method, **options})
        self.method = {"S2": "census+sgm"}.get(method, method)
        self.max_disparity, self.min_disparity = options["max_disparity"], options["min_disparity"]
        self.refiner = options["refiner"]
        self.scale, self.device, self.with_right = options["scale"], "cpu", options.get("right", False)

    def __call__(self, left, right):
        FakeMatcher.called += 1
        if FakeMatcher.raises is not None:
            raise FakeMatcher.raises
        disparity = np.full(left.shape[:2], 10, np.float32)
        disparity[:, 0] = np.nan
        confidence = np.full(left.shape[:2], 0.5, np.float32) if FakeMatcher.confident else None
        return Disparity(disparity, ~np.isnan(disparity), confidence, disparity + 1 if self.with_right else None)


@pytest.fixture(autouse=True)
def matching(monkeypatch):
    module = types.ModuleType("stereokit.matching")
    module.Matcher = FakeMatcher
    module.compile_kernels = lambda matcher, *kind: matcher(*[np.zeros((4, 4), np.uint8)] * 2)
    module.METHODS = {"S1": "census+dt", "S2": "census+sgm", "S3": "zncc+dt", "S4": "zncc+sgm"}
    monkeypatch.setitem(sys.modules, "stereokit.matching", module)
    monkeypatch.setattr(FakeMatcher, "instances", [])
    for name, value in (("called", 0), ("confident", True), ("raises", None)):
        monkeypatch.setattr(FakeMatcher, name, value)


@pytest.fixture
def pair(tmp_path):
    image = np.arange(HEIGHT * WIDTH * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)
    paths = tmp_path / "left.png", tmp_path / "right.png"
    for path in paths:
        io.write_image(path, image)
    (tmp_path / "calibration.json").write_text(json.dumps(CALIBRATION))
    return [str(path) for path in paths]


def run(*arguments):
    try:
        runner = CliRunner(mix_stderr=False)  # typer before 0.15 mixes them by default
    except TypeError:
        runner = CliRunner()
    return runner.invoke(app.app, [str(argument) for argument in arguments])


def error_of(result):
    """Return the one error line of a refused call."""
    assert result.exit_code == 2, result.output
    lines = [line for line in result.stderr.splitlines() if line]
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]


def fake_entries(monkeypatch, **functions):
    module = types.ModuleType("fake_plugin")
    for name, function in functions.items():
        setattr(module, name, function)
    monkeypatch.setitem(sys.modules, "fake_plugin", module)
    entries = [metadata.EntryPoint(name, f"fake_plugin:{name}", "stereokit.commands") for name in functions]
    entries.append(metadata.EntryPoint("broken", "fake_plugin_that_is_missing:run", "stereokit.commands"))
    real = metadata.entry_points

    def entry_points(group, **kwargs):
        if group != "stereokit.commands":
            return real(group=group, **kwargs)
        return [entry for entry in entries if kwargs.get("name", entry.name) == entry.name]

    monkeypatch.setattr(metadata, "entry_points", entry_points)


@pytest.mark.parametrize("suffix", [".png", ".pfm", ".npy", ".tiff", ".tif"])
def test_match_writes_the_map(tmp_path, pair, suffix):
    output = tmp_path / f"d{suffix}"
    result = run("match", *pair, "-o", output)
    assert result.exit_code == 0, result.output
    expected = np.full((HEIGHT, WIDTH), 10, np.float32)
    expected[:, 0] = np.nan
    np.testing.assert_array_equal(io.read_disparity(output), expected)
    assert "census+sgm" in result.stdout
    assert "87.5 %" in result.stdout
    assert FakeMatcher.instances == [
        {
            "method": "census+sgm",
            "max_disparity": 128,
            "min_disparity": 0,
            "scale": 1.0,
            "refiner": None,
            "threads": None,
            "device": "auto",
        }
    ]


def test_match_passes_every_option(tmp_path, pair):
    result = run(
        *("match", *pair, "-o", tmp_path / "d.npy", "-m", "S2", "--max-disparity", 64, "--min-disparity", -4),
        *("--scale", 0.5, "--refiner", "linear", "--fill", "none", "--threads", 1, "--device", "cpu"),
        *(
            "--set",
            "p1=10",
            "--set",
            "sigma-s = 2.5",
            "--set",
            "subpixel=False",
            "--set",
            "mode=rf",
            "--set",
            "outside=None",
        ),
    )
    assert result.exit_code == 0, result.output
    assert FakeMatcher.instances == [
        {
            "method": "S2",
            "max_disparity": 64,
            "min_disparity": -4,
            "scale": 0.5,
            "refiner": "linear",
            "fill": "none",
            "threads": 1,
            "device": "cpu",
            "p1": 10,
            "sigma_s": 2.5,
            "subpixel": False,
            "mode": "rf",
            "outside": None,
        }
    ]


def test_match_writes_everything_else(tmp_path, pair):
    names = {"color": "c.png", "right": "r.pfm", "confidence": "k.npy", "ply": "p.ply", "json": "j.json"}
    options = [word for name, file in names.items() for word in (f"--{name}", tmp_path / file)]
    result = run("match", *pair, "-o", tmp_path / "d.png", *options, "--calibration", tmp_path / "calibration.json")
    assert result.exit_code == 0, result.output
    assert FakeMatcher.instances[0]["right"] is True
    assert FakeMatcher.instances[0]["confidence"] is True
    color = io.read_image(tmp_path / "c.png")
    assert color.shape == (HEIGHT, WIDTH, 3)
    assert (color[:, 0] == 0).all()
    assert color[:, 1:].any(axis=2).all()
    assert (io.read_disparity(tmp_path / "r.pfm")[:, 1:] == 11).all()
    assert (np.load(tmp_path / "k.npy") == 0.5).all()
    cloud = (tmp_path / "p.ply").read_bytes()
    assert b"element vertex 42\n" in cloud  # 6 * 7 pixels of finite depth
    vertices = np.frombuffer(cloud.split(b"end_header\n", 1)[1], np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    np.testing.assert_allclose(vertices["xyz"][0], [0.01, 0, -1])  # y up; pixel (1, 0) at 100 * 0.1 / 10 metres
    assert vertices["rgb"][0].tolist() == [3, 4, 5]
    report = json.loads((tmp_path / "j.json").read_text())
    assert (report["width"], report["height"], report["density"]) == (WIDTH, HEIGHT, 0.875)
    assert report["method"] == "census+sgm"
    assert report["seconds"] >= 0
    assert report["outputs"]["ply"] == str(tmp_path / "p.ply")


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_clouds_of_deep_grey_images(tmp_path, dtype):
    image = np.full((HEIGHT, WIDTH), 65535 if dtype == np.uint16 else 2.5, dtype)
    io.write_image(tmp_path / "a.tiff", image)
    files = (
        "-o",
        tmp_path / "d.npy",
        "--ply",
        tmp_path / "p.ply",
        "--calibration",
        tmp_path / "calibration.json",
    )
    (tmp_path / "calibration.json").write_text(json.dumps(CALIBRATION))
    io.write_image(tmp_path / "b.tiff", image)
    assert run("match", tmp_path / "a.tiff", tmp_path / "b.tiff", *files).exit_code == 0
    assert (tmp_path / "p.ply").read_bytes().endswith(b"\xff\xff\xff")


def test_confidence_as_a_picture(tmp_path, pair):
    assert run("match", *pair, "-o", tmp_path / "d.npy", "--confidence", tmp_path / "k.png").exit_code == 0
    assert (io.read_image(tmp_path / "k.png") == 32768).all()  # 0.5 * 65535, rounded to even
    FakeMatcher.confident = False
    assert "--confidence" in error_of(run("match", *pair, "-o", tmp_path / "d.npy", "--confidence", tmp_path / "k.png"))


def test_json_to_the_terminal(tmp_path, pair):
    result = run("match", *pair, "-o", tmp_path / "d.npy", "--json", "-")
    assert json.loads(result.stdout)["density"] == 0.875


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "{}/d.jpg"], "--output must end in one of .png, .pfm, .npy, .tiff"),
        (["-o", "{}/nowhere/d.png"], "does not exist"),
        (["-o", "{}/left.png"], "--output and LEFT must be different files"),
        (["-o", "{}/d.png", "--color", "{}/c.gif"], "--color must end in one of"),
        (["-o", "{}/d.png", "--color", "{}/./d.png"], "--color and --output must be different"),
        (["-o", "{}/d.png", "--right", "{}/nowhere/r.png"], "--right"),
        (["-o", "{}/d.png", "--confidence", "{}/k.pfm"], "--confidence must end in"),
        (["-o", "{}/d.png", "--ply", "{}/p.obj"], "--ply must end in"),
        (["-o", "{}/d.png", "--ply", "{}/p.ply"], "--ply and --depth go together with --calibration"),
        (["-o", "{}/d.png", "--calibration", "{}/calibration.json"], "go together"),
        (["-o", "{}/d.png", "--ply", "{}/p.ply", "--calibration", "{}/left.png"], "not a text file"),
        (["-o", "{}/d.png", "--ply", "{}/p.ply", "--calibration", "{}/large.json"], "9x6 pixels"),
        (["-o", "{}/d.png", "--json", "{}/nowhere/j.json"], "--json"),
        (["-o", "{}/d.png", "--json", "{}"], "is a folder"),
        (["-o", "{}/d.png", "--min-disparity", "-1"], "--output: a KITTI .png holds disparities in 0 .. 256"),
        (["-o", "{}/d.pfm", "--right", "{}/r.png", "--max-disparity", "300"], "--right: a KITTI .png"),
        (["-o", "{}/d.png", "--set", "p1"], "--set must be KEY=VALUE, got 'p1'"),
        (["-o", "{}/d.png", "--set", "scale=2"], "use --scale"),
        (["-o", "{}/d.png", "--set", "p1=1", "--set", "p1=2"], "twice"),
        (["-o", "{}/d.png", "--set", "p1=bad"], "p1 must be a number"),
    ],
)
def test_bad_calls_are_refused_before_matching(tmp_path, pair, options, message):
    (tmp_path / "large.json").write_text(json.dumps({**CALIBRATION, "width": 9, "height": 6}))
    before = sorted(tmp_path.iterdir())
    line = error_of(run("match", *pair, *(option.format(tmp_path) for option in options)))
    assert message in line
    assert FakeMatcher.called == 0
    assert sorted(tmp_path.iterdir()) == before


def test_bad_images_are_refused(tmp_path, pair):
    assert "no such file" in error_of(run("match", pair[0], tmp_path / "none.png", "-o", tmp_path / "d.png"))
    (tmp_path / "text.png").write_text("hello")
    assert "not an image" in error_of(run("match", pair[0], tmp_path / "text.png", "-o", tmp_path / "d.png"))
    io.write_image(tmp_path / "small.png", np.zeros((5, 7), np.uint8))
    line = error_of(run("match", pair[0], tmp_path / "small.png", "-o", tmp_path / "d.png"))
    assert "LEFT and RIGHT must have the same size, got 8x6 and 7x5" in line


def test_usage_errors_end_with_2(pair):
    assert run("match", *pair).exit_code == 2
    assert run("match", "--nonsense").exit_code == 2
    assert run("mtach").exit_code == 2


def test_interrupt_ends_with_130(tmp_path, pair, monkeypatch):
    monkeypatch.setattr(FakeMatcher, "raises", KeyboardInterrupt())
    assert run("match", *pair, "-o", tmp_path / "d.png").exit_code == 130
    monkeypatch.setattr(sys, "argv", ["stereokit", "match", *pair, "-o", str(tmp_path / "d.png")])
    with pytest.raises(SystemExit) as caught:
        app.main()
    assert caught.value.code == 130
    assert not (tmp_path / "d.png").exists()


def test_main_prints_one_line_and_ends_with_2(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["stereokit", "match", "a.png", "b.png", "-o", str(tmp_path / "d.jpg")])
    with pytest.raises(SystemExit) as caught:
        app.main()
    assert caught.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: --output must end in")
    assert captured.err.count("\n") == 1


def test_spinner_waits_a_second(monkeypatch):
    shown = []
    monkeypatch.setattr("rich.status.Status.start", lambda self: shown.append("start"))
    with waiting("text"):
        pass
    assert shown == []


def test_list(tmp_path):
    result = run("list", "--json", tmp_path / "list.json")
    assert result.exit_code == 0, result.output
    for word in ("S1", "S4", "census+dt", "zncc+sgm"):
        assert word in result.stdout
    content = json.loads((tmp_path / "list.json").read_text())
    assert content["methods"]["S2"] == {
        "method": "census+sgm",
        "description": "Census cost + semi-global matching",
    }
    assert {"costs", "aggregations", "refiners"} <= content.keys()


def test_info(tmp_path):
    result = run("info", "--json", tmp_path / "info.json")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "info.json").read_text())
    assert content["numpy"] == np.__version__
    assert content["threads"] >= 1
    assert isinstance(content["cuda"], bool)
    assert content["processor"] in result.stdout
    assert "does not exist" in error_of(run("info", "--json", tmp_path / "nowhere" / "info.json"))


def test_version(monkeypatch):
    monkeypatch.setattr("stereokit.__version__", "1.2.3")
    result = run("--version")
    assert result.exit_code == 0
    assert result.stdout == "stereokit 1.2.3\n"


def test_commands_of_other_packages_join(monkeypatch):
    def greet(name: str, loud: bool = False) -> None:
        """Greet someone.

        Parameters
        ----------
        name : str
            Whom.
        """
        print(name.upper() if loud else name)

    def refuse() -> None:
        raise OptionError("frames must be\nnumbers")

    def need() -> None:
        raise ModuleNotFoundError("No module named 'absent'", name="absent")

    fake_entries(monkeypatch, greet=greet, refuse=refuse, need=need)
    assert run("greet", "you", "--loud").stdout == "YOU\n"
    assert error_of(run("refuse")) == "error: frames must be numbers"
    assert error_of(run("need")) == "error: this needs the package 'absent', which is not installed"
    shown = run("--help").stdout
    assert "Greet someone." in shown
    for name in ("match", "list", "info", "refuse", "broken"):
        assert name in shown
    assert "Parameters" not in run("greet", "--help").stdout


def test_a_broken_plugin_says_why_and_harms_no_other(monkeypatch):
    fake_entries(monkeypatch)
    for arguments in ([], ["--help"], ["--dataset", "x", "y"]):
        line = error_of(run("broken", *arguments))
        assert "'broken' cannot be loaded: ModuleNotFoundError" in line
        assert "fake_plugin_that_is_missing" in line
    assert run("list").exit_code == 0


def test_own_commands_cannot_be_replaced(monkeypatch):
    fake_entries(monkeypatch, match=lambda: None)
    assert "RIGHT" in run("match", "--help").stdout


def test_importing_the_command_line_is_light():
    code = (
        "import sys; sys.modules['stereokit'] = m = type(sys)('stereokit'); "
        "m.__path__ = [sys.argv[1]]; import stereokit.cli.app; "
        "print(sorted({'numpy', 'numba', 'cv2', 'torch'} & set(sys.modules)))"
    )
    package = str(Path(app.__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", code, package], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_paths_are_told_as_they_are(tmp_path, pair):
    for name in ("map[left].pfm", "a[/red].pfm", "[bold]x.pfm"):
        (tmp_path / "a[" / name).parent.mkdir(parents=True, exist_ok=True)
        result = run("match", *pair, "-o", tmp_path / "a[" / name)
        assert result.exit_code == 0, result.output
        assert name in "".join(result.stdout.replace("│", "").split())  # the table may break it
        assert (tmp_path / "a[" / name).exists()
    result = run("match", tmp_path / "no[/red].png", pair[1], "-o", tmp_path / "d.pfm")
    assert "no[/red].png" in error_of(result)


def test_tables_hold_words_as_they_are(capsys):
    table = output.Table("a [b]", "c", title="[/t]")
    table.add_row("[/x]\n\udce9", "[red]y")
    output.report({}, [table], None)
    shown = capsys.readouterr().out
    for words in ("a [b]", "[/t]", "[/x] \\udce9", "[red]y"):
        assert words in shown


def test_a_warning_is_one_line_and_the_work_goes_on(tmp_path, pair, monkeypatch):
    real = FakeMatcher.__call__

    def doubtful(self, left, right):
        warn("only 3 % of\nit")
        return real(self, left, right)

    monkeypatch.setattr(FakeMatcher, "__call__", doubtful)
    result = run("match", *pair, "-o", tmp_path / "d.pfm")
    assert result.exit_code == 0
    assert result.stderr == "warning: only 3 % of it\n"  # the call that compiles says nothing


def test_a_map_whose_range_was_checked_is_written(tmp_path, pair, monkeypatch):
    def beyond(self, left, right):  # as a refiner may
        disparity = np.full((HEIGHT, WIDTH), 256.3, np.float32)
        disparity[0] = -0.2
        return Disparity(disparity, disparity > 0)

    monkeypatch.setattr(FakeMatcher, "__call__", beyond)
    assert run("match", *pair, "-o", tmp_path / "d.png", "--max-disparity", "256").exit_code == 0
    assert io.read_disparity(tmp_path / "d.png").tolist()[0][0] == 1 / 256


@pytest.mark.parametrize("factor", [1, 16, 4])
def test_clouds_of_any_bit_depth_have_like_colours(tmp_path, factor):
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT * 5, WIDTH * 5, 3))
    for side in ("left", "right"):
        io.write_image(tmp_path / f"{side}.png", (image * factor).astype(np.uint8 if factor == 1 else np.uint16))
    (tmp_path / "camera.json").write_text(json.dumps({**CALIBRATION, "cx0": 20, "cy": 15}))
    words = ("--calibration", tmp_path / "camera.json", "--ply", tmp_path / "p.ply")
    result = run("match", tmp_path / "left.png", tmp_path / "right.png", "-o", tmp_path / "d.pfm", *words)
    assert result.exit_code == 0 and result.stderr == "", result.output
    data = (tmp_path / "p.ply").read_bytes()
    start = data.index(b"end_header\n") + 11
    colors = np.frombuffer(data, [("x", "<f4", 3), ("c", "u1", 3)], offset=start)["c"]
    assert np.abs(colors.astype(int) - image[:, 1:].reshape(-1, 3)).max() <= 4


def test_a_picture_of_negative_disparities_has_colours(tmp_path, pair, monkeypatch):
    def negative(self, left, right):
        disparity = np.linspace(-60, -1, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
        return Disparity(disparity, np.ones(disparity.shape, bool))

    monkeypatch.setattr(FakeMatcher, "__call__", negative)
    words = ("--min-disparity", "-64", "--max-disparity", "0", "--color", tmp_path / "c.png")
    assert run("match", *pair, "-o", tmp_path / "d.pfm", *words).exit_code == 0
    assert len(np.unique(io.read_image(tmp_path / "c.png").reshape(-1, 3), axis=0)) > 40


def test_a_calibration_with_odd_figures_is_warned_of(tmp_path, pair):
    (tmp_path / "camera.json").write_text(json.dumps({**CALIBRATION, "cx0": 50, "baseline_m": 120}))
    words = ("--calibration", tmp_path / "camera.json", "--ply", tmp_path / "p.ply")
    result = run("match", *pair, "-o", tmp_path / "d.pfm", *words)
    assert result.exit_code == 0
    lines = result.stderr.splitlines()
    assert len(lines) == 2 and "120 m" in lines[0] and "cx0 is 50 of 8 pixels" in lines[1]
