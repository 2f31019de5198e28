"""Functions, programs and finished maps beside our methods: what they are given, and what goes wrong in one line."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from limits import HANG_S
from typer.testing import CliRunner

from stereokit.errors import FileError, InputError, OptionError, StereokitError
from stereokit.io import write_disparity
from stereokit.result import Disparity
from stereokit_evaluation.commands.evaluate import evaluate
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.outside import (
    checked_map,
    is_function,
    map_folder,
    outside_function,
    outside_methods,
    program,
)

APP = typer.Typer()
APP.command()(evaluate)
SHAPE = (6, 9)


def image(value, channels=3):
    return np.full((*SHAPE, channels)[: 2 + (channels > 1)], value, np.uint8)


@pytest.fixture
def frame(tmp_path):
    for name, value in (("left", 30), ("right", 40)):
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), image(value))
    return Frame("a", tmp_path / "left.png", tmp_path / "right.png")


@pytest.fixture
def script(tmp_path):
    """Return a function that writes a program and returns its command line."""

    def write(body, places="{left} {right} {out}"):
        file = tmp_path / "my program.py"
        head = "import shutil, sys, time, numpy as np, cv2\nleft, right, out, *rest = sys.argv[1:]\n"
        file.write_text(head + textwrap.dedent(body))
        return f"Mine={sys.executable} '{file}' {places}"

    return write


SAVE = "np.save(out, np.full(cv2.imread(left).shape[:2], float(cv2.imread(right)[0, 0, 0]), np.float32))"


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Return a function that writes a module of the working folder and returns its name."""
    monkeypatch.chdir(tmp_path)
    names = []

    def write(body, name="own_stereo_module"):
        (tmp_path / f"{name}.py").write_text("import numpy as np\n" + textwrap.dedent(body))
        names.append(name)
        return name

    yield write
    for name in names:
        sys.modules.pop(name, None)


def test_a_function_cannot_change_the_images_of_others(frame, module):
    name = module("def run(left, right):\n    left[:] = 0\n    return np.full(left.shape[:2], 5.0)")
    left, right = image(30), image(40)
    assert (outside_function(f"{name}:run", 16)(frame, left, right).disparity == 5).all()
    assert (left == 30).all() and (right == 40).all()


def test_a_function_that_ends_python_costs_its_frame_alone(frame, module):
    name = module("import sys\ndef run(left, right):\n    sys.exit(3)")
    with pytest.raises(InputError, match=f"{name}:run ended Python: SystemExit: 3"):
        outside_function(f"{name}:run", 16)(frame, image(30), image(40))
    with pytest.raises(OptionError, match="can be imported"):
        outside_function(module("import sys\nsys.exit(2)", "module_that_ends") + ":run", 16)


def test_a_result_depends_on_the_modules_that_a_function_uses(module, tmp_path):
    def identity(helper):
        for name in ("own_helper", "own_stereo_module"):
            sys.modules.pop(name, None)
        module(helper, "own_helper")
        name = module("from own_helper import shift\ndef run(left, right):\n    return shift")
        return outside_function(f"{name}:run", 16).identity()

    first = identity("shift = 1")
    assert list(first["modules"]) == ["own_helper.py"]
    assert first == identity("shift = 1") != identity("shift = 22")
    module("value = 1", "another_module")  # beside it, and not used
    assert identity("shift = 1") == first


def test_a_package_has_its_own_modules_alone(tmp_path, monkeypatch):
    package = tmp_path / "site-packages" / "own_stereo_package"
    (package / "net").mkdir(parents=True)
    texts = {"__init__": "", "api": "def run(left, right):\n    from .net import layers\n    import other_package\n"}
    for name, text in {**texts, "net/__init__": "", "net/layers": "from .. import weights", "weights": "w = 1"}.items():
        (package / f"{name}.py").write_text(text)
    (package.parent / "other_package.py").write_text("value = 1")
    monkeypatch.syspath_prepend(str(package.parent))
    modules = outside_function("own_stereo_package.api:run", 16).identity()["modules"]
    assert sorted(modules) == [
        f"own_stereo_package/{name}.py" for name in ("__init__", "net/__init__", "net/layers", "weights")
    ]
    for name in [name for name in sys.modules if name.startswith("own_stereo_package")]:
        del sys.modules[name]


def test_a_program_reads_the_files_and_its_map_is_read(frame, script):
    method = program(script(SAVE, "{left} {right} {out.npy} {max_disparity}"), 64)
    result, seconds = method.timed(frame, image(30), image(40))
    assert (result.disparity == 40).all() and result.valid.all() and seconds > 0
    assert method.name == "Mine" and method.kind == "program"


def test_a_program_is_given_paths_and_the_range_whole(frame, script, tmp_path):
    body = f"""
        open({str(tmp_path / "words")!r}, "w").write("\\n".join([left, right, *rest]))
        {SAVE}
    """
    method = program(script(body, "{left} {right} {out.npy} --range={max_disparity} 'a b' '$HOME; *'"), 64)
    method(frame, image(30), image(40))
    left, right, *rest = (tmp_path / "words").read_text().splitlines()
    assert (left, right) == (str(tmp_path / "left.png"), str(tmp_path / "right.png"))  # the files, not copies
    assert rest == ["--range=64", "a b", "$HOME; *"]  # no shell saw them


def test_images_that_are_no_files_are_written(script):
    drawn = Frame("a", lambda: image(3), lambda: image(7))
    method = program(script(SAVE, "{left} {right} {out.npy}"), 64)
    assert (method(drawn, image(3), image(7)).disparity == 7).all()


@pytest.mark.parametrize("suffix", [".pfm", ".tiff", ".png"])
def test_a_program_may_write_other_formats(frame, script, tmp_path, suffix):
    write_disparity(tmp_path / f"ready{suffix}", np.full(SHAPE, 5, np.float32))
    place = "{out}" if suffix == ".pfm" else f"{{out{suffix}}}"
    body = f"shutil.copy({str(tmp_path / f'ready{suffix}')!r}, out)"
    method = program(script(body, f"{{left}} {{right}} {place}"), 64)
    assert (method(frame, image(3), image(7)).disparity == 5).all()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("sys.exit(3)", "Mine ended with status 3"),
        ("sys.exit('first\\n  out of memory \\n')", "Mine ended with status 1: out of memory"),
        ("import os; os.kill(os.getpid(), 9)", "Mine ended by signal 9"),
        ("pass", "Mine wrote no map to {out}"),
        ("open(out, 'w').write('no map')", "Mine: "),
        ("open(out, 'wb').write(b'Pf\\n2 1\\n-1\\n' + bytes(8))", "Mine must give a map of numbers of the size of"),
        ("time.sleep(99)", "Mine did not end within 1 s"),
    ],
)
def test_what_a_program_does_wrong_is_one_line(frame, script, body, message):
    method = program(script(body), 64, time_limit=1.0 if "sleep" in body else HANG_S)
    with pytest.raises(StereokitError) as caught:
        method(frame, image(3), image(7))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_program_that_is_too_slow_ends_with_its_children(frame, script, tmp_path):
    signs = tmp_path / "signs of life"
    body = f"""
        import subprocess
        child = "import time\\nwhile True: open({str(signs)!r}, 'a').write('.'); time.sleep(0.02)"
        subprocess.Popen([sys.executable, "-c", child])
        time.sleep(99)
    """
    with pytest.raises(FileError, match=r"did not end within 3 s"):
        program(script(body), 64, time_limit=3.0)(frame, image(3), image(7))
    before = signs.read_text() if signs.exists() else ""
    time.sleep(0.3)
    assert (signs.read_text() if signs.exists() else "") == before


def test_an_interrupt_ends_the_program(frame, script, monkeypatch):
    ended = []
    real = subprocess.Popen.wait

    def wait(process, timeout=None):
        if not ended:
            ended.append(process)
            raise KeyboardInterrupt
        return real(process, timeout)

    monkeypatch.setattr(subprocess.Popen, "wait", wait)
    with pytest.raises(KeyboardInterrupt):
        program(script("time.sleep(99)"), 64)(frame, image(3), image(7))
    assert ended[0].returncode is not None and ended[0].returncode < 0


def test_the_identity_follows_the_script(script):
    first = program(script(SAVE), 64).identity()
    assert program(script(SAVE), 64).identity() == first
    assert program(script(SAVE + "\n"), 64).identity() != first != program(script(SAVE), 32).identity()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("python {left} {right} {out}", "command must be NAME=VALUE"),
        ("X=python {right} {out}", "got 'python {right} {out}' without {left}"),
        ("X=python {left} {right}", "and one {out}"),
        ("X=python {left} {right} {out} {out.png}", "and one {out}"),
        ("X=python {left} {right} {out.jpg}", "command must write one of .png, .pfm"),
        ("X=python {left} '{right} {out}", "a line that a shell could split"),
        ("X=no-such-program {left} {right} {out}", "command must begin with a program that can be run"),
    ],
)
def test_a_bad_command_is_refused_before_work(text, message):
    with pytest.raises(OptionError) as caught:
        program(text, 64)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_time_limits_are_above_zero():
    with pytest.raises(OptionError, match="time_limit must be a number of seconds above 0"):
        program(f"X={sys.executable} {{left}} {{right}} {{out}}", 64, time_limit=0)
    with pytest.raises(OptionError, match="time_limit must go with command, got 3 alone"):
        outside_methods([], [], [], max_disparity=64, time_limit=3)


def test_a_function_gets_images_and_the_range_if_it_wants(frame, module):
    name = module(
        """
        def plain(left, right):
            assert left.shape == right.shape == (6, 9, 3)
            return left[..., 0] / 10

        def ranged(left, right, max_disparity=0):
            return np.full(left.shape[:2], max_disparity)

        class Holder:
            @staticmethod
            def inner(left, right, **options):
                return np.full(left.shape[:2], options["max_disparity"] / 2)
        """
    )
    left, right = image(30), image(40)
    assert (outside_function(f"{name}:plain", 64)(frame, left, right).disparity == 3).all()
    assert (outside_function(f"{name}:ranged", 64)(frame, left, right).disparity == 64).all()
    method = outside_function(f"Net={name}:Holder.inner", 64)
    assert method.name == "Net" and (method(frame, left, right).disparity == 32).all()
    assert method.identity() != outside_function(f"{name}:ranged", 64).identity()
    assert sys.path.count(str(Path.cwd())) <= 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no_such_module_here:run", "ModuleNotFoundError"),
        ("own_stereo_module:nothing", "AttributeError"),
        ("own_stereo_module:number", "which is int"),
        ("own_stereo_module2:run", "RuntimeError: not today"),
    ],
)
def test_a_function_that_cannot_be_had_is_one_line(module, text, message):
    module("number = 3")
    module("raise RuntimeError('not\\n today')", "own_stereo_module2")
    with pytest.raises(OptionError) as caught:
        outside_function(text, 64)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_names_of_functions():
    assert all(is_function(text) for text in ("a.b:c", "a:b.c", "N 1=a:b"))
    assert not any(is_function(text) for text in ("S2", "census+sgm", "OpenCV HH", "a:", ":b", "a/b:c"))


def test_maps_are_checked_and_what_is_no_disparity_is_unknown():
    result = checked_map("M", np.float64([[1, -1, np.inf, np.nan]]), (1, 4))
    np.testing.assert_array_equal(result.disparity, np.float32([[1, np.nan, np.nan, np.nan]]))
    np.testing.assert_array_equal(result.valid, [[True, False, False, False]])
    whole = Disparity(np.ones((1, 2), np.float32), np.array([[True, False]]))
    assert checked_map("M", whole, (1, 2)).valid.tolist() == [[True, False]]
    for wrong in (np.ones((1, 4, 1)), np.ones((4, 1)), None, np.ones((1, 4), bool), "map"):
        with pytest.raises(InputError, match=r"M must give a map of numbers of the size of the left image, \(1, 4\)"):
            checked_map("M", wrong, (1, 4))


def test_folders_of_maps(tmp_path):
    (tmp_path / "eth3d").mkdir()
    assert map_folder(f"RAFT={tmp_path}").name == "RAFT" and map_folder(str(tmp_path)).name == "predictions"
    assert map_folder(f"RAFT={tmp_path}", "eth3d").folder == tmp_path / "eth3d"
    assert map_folder(f"RAFT={tmp_path}", "kitti2015").folder == tmp_path
    with pytest.raises(FileError, match="predictions must be a folder"):
        map_folder(f"RAFT={tmp_path / 'none'}")
    with pytest.raises(OptionError, match="methods must have different names, got 'predictions' twice; use NAME="):
        outside_methods([], [], [str(tmp_path), str(tmp_path)], max_disparity=64)


def test_evaluate_takes_all_kinds_side_by_side(tmp_path, module, script):
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for name in ("a", "b"):
            rng = np.random.default_rng(1)
            assert cv2.imwrite(str(tmp_path / side / f"{name}.png"), rng.integers(0, 255, (24, 48), np.uint8))
    for folder in ("disparity", "maps"):
        (tmp_path / folder).mkdir()
        for name in ("a", "b"):
            write_disparity(tmp_path / folder / f"{name}.pfm", np.full((24, 48), 5, np.float32))
    name = module("def five(left, right):\n    return np.full(left.shape[:2], 5.5)")
    fails_on_b = "sys.exit('no') if left.endswith('b.png') else np.save(out, np.full((24, 48), 9, np.float32))"
    words = ["--dataset", "folder", "--root", tmp_path, "--max-disparity", 16, "--json", tmp_path / "out.json"]
    words += ["--method", "S2", "--method", "OpenCV 3WAY", "--method", f"Five={name}:five"]
    words += ["--predictions", f"Net={tmp_path / 'maps'}", "--command", script(fails_on_b, "{left} {right} {out.npy}")]
    done = CliRunner().invoke(APP, [str(word) for word in words])
    assert done.exit_code == 1, (done.output, done.exception)
    assert "skipped b: Mine ended with status 1: no" in done.stderr
    rows = {row["method"]: row for row in json.loads((tmp_path / "out.json").read_text())["results"]}
    assert [(name, row["kind"], row["images"]) for name, row in rows.items()] == [
        ("census+sgm", "stereokit", 2), ("OpenCV 3WAY", "opencv", 2), ("Five", "function", 2), ("Mine", "program", 1),
        ("Net", "maps", 2),
    ]  # fmt: skip
    assert rows["Five"]["figures"]["main"]["epe"] == 0.5 and rows["Net"]["epe"] == 0 and rows["Mine"]["epe"] == 4
    assert rows["Net"]["seconds_per_image"] is None and rows["Mine"]["seconds_per_image"] > 0
    assert "Figures count 2,304 pixels of 2 pairs (all with truth" in done.stdout


def test_a_slip_in_a_function_costs_the_frame(tmp_path, module):
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        assert cv2.imwrite(str(tmp_path / side / "a.png"), image(3))
    (tmp_path / "disparity").mkdir()
    write_disparity(tmp_path / "disparity" / "a.pfm", np.full(SHAPE, 5, np.float32))
    name = module("def run(left, right):\n    return 1 / 0")
    words = ["--dataset", "folder", "--root", str(tmp_path), "--method", f"{name}:run"]
    done = CliRunner().invoke(APP, words)
    assert done.exit_code == 1 and f"skipped a: {name}:run: ZeroDivisionError: division by zero" in done.stderr
