"""The README and the documentation are true: their code runs, their commands parse, their reference is whole.

Python blocks of a page run in one namespace, in the order in which they stand, in a folder with ``left.png`` and
``right.png``. Commands run if they are cheap and need nothing else (`RUN`); all others are parsed by the real command
line, which refuses options that do not exist. ``<!-- not run: REASON -->`` above a block stops short of running it.
"""

from __future__ import annotations

import argparse
import pkgutil
import re
import runpy
import shlex
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import metadata
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import typer
from packaging.requirements import Requirement
from typer.testing import CliRunner

import stereokit
from stereokit.cli.app import app
from stereokit.methods import parse_method
from stereokit.rig import Camera, StereoRig
from stereokit_evaluation.scoring.outside import is_function
from stereokit_evaluation.study.configurations import baseline_key

ROOT = Path(__file__).parents[1]
CARD = ROOT / "refiners" / "stereokit_refiners" / "weights" / "MODEL_CARD.md"
KITTI = ROOT / "refiners" / "kitti"
CARDS = [CARD, KITTI / "stereokit_kitti_weights" / "MODEL_CARD.md", KITTI / "README.md"]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *CARDS, *sorted((ROOT / "docs").glob("*.md"))]
RUN = ("export", "info", "list", "match", "view")
EXTRAS = {"export": ("onnxruntime",), "--refiner": ("openvino",), "view": ("jinja2",)}
SHELL, OTHER = ("", "shell"), ("text", "toml")
FENCE = re.compile(r"(?:^<!-- not run: (?P<reason>.+) -->\n)?^```(?P<language>.*)\n(?P<code>(?s:.*?))^```$", re.M)


@dataclass(frozen=True)
class Block:
    """A block of code of a page, and why it is not run, if it is not."""

    language: str
    code: str
    reason: str | None


def blocks(page: Path) -> list[Block]:
    code_blocks = [
        Block(*block.group("language", "code", "reason")) for block in FENCE.finditer(page.read_text("utf-8"))
    ]
    return [block for block in code_blocks if not block.language.startswith("{")]  # those are directives of the site


def commands(code: str) -> list[list[str]]:
    """Return the lines of a shell block as words, continued lines joined, comments left out."""
    lines = code.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def pages(*languages: str) -> list[object]:
    chosen = [page for page in PAGES if any(block.language in languages for block in blocks(page))]
    return [pytest.param(page, id=page.stem) for page in chosen]


@pytest.fixture(scope="module")
def street():
    pytest.importorskip("skimage")
    from stereokit_evaluation.synthetic.scenes import generate

    return generate(0, 310, 94, 32)


@pytest.fixture
def folder(street, tmp_path, monkeypatch):
    """Work in a folder that holds what the pages take for granted."""
    monkeypatch.chdir(tmp_path)
    stereokit.io.write_image("left.png", street.left)
    stereokit.io.write_image("right.png", street.right)
    np.save("left.npy", street.left)
    np.save("right.npy", street.right)
    (tmp_path / "camera.json").write_text('{"fx": 180, "fy": 180, "cx0": 155, "cy": 43, "baseline_m": 0.2}')
    lens = Camera([[180, 0, 155], [0, 180, 46], [0, 0, 1]], width=310, height=94)
    StereoRig(lens, lens, np.eye(3), (-0.2, 0, 0)).save(tmp_path / "rig.yml")
    (tmp_path / "mine").mkdir()
    shutil.copy(KITTI / "stereokit_kitti_weights" / "cnn.safetensors", tmp_path / "mine" / "weights.safetensors")
    return tmp_path


def test_every_block_has_a_language_that_is_checked():
    for page in PAGES:
        for block in blocks(page):
            assert block.language in (*SHELL, *OTHER, "python"), (page.name, block)
            assert block.reason is None or block.language in (*SHELL, "python"), (page.name, block)
    assert len(pages("python")) > 5 and len(pages(*SHELL)) > 5


@pytest.mark.parametrize("page", pages("python"))
def test_the_python_of_a_page_runs(page, street, folder, capsys):
    scope: dict[str, object] = {"__name__": page.stem}
    for block in blocks(page):
        if block.language != "python":
            continue
        if "refiner=" in block.code and "refiner=blocks" not in block.code:
            pytest.importorskip("openvino")
        code = compile(block.code, page.name, "exec")
        if block.reason is None:
            exec(code, scope)
    disparity = scope.get("disparity")
    if isinstance(disparity, np.ndarray):
        assert np.nanmedian(np.abs(disparity - street.disparity)) < 1
    if page == ROOT / "README.md":
        assert scope["depth_m"].shape == disparity.shape == street.disparity.shape
        assert (folder / "disparity.pfm").exists()


@pytest.mark.parametrize("page", pages(*SHELL))
def test_the_commands_of_a_page_run_or_parse(page, folder, run_python):
    for block in blocks(page):
        if block.language in SHELL:
            for words in commands(block.code):
                check(words, run_python if block.reason is None else None)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_commands_within_the_text_of_a_page_parse(page):
    text = re.sub(r"^ *```.*?^ *```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for command in re.findall(r"`(stereokit [^`]+)`", text):
        words = command.split()
        if len(words) > 2:
            check(words, None)
        else:
            assert words[1] in typer.main.get_command(app).list_commands(None), command


def check(words: list[str], run_python: Callable[..., str] | None) -> None:
    """Run one command line, or parse it; one that bounds the memory of its process runs in a process of its own."""
    line = shlex.join(words)
    if words[0] == "stereokit":
        needed = [module for word in words for module in EXTRAS.get(word, ())]
        may_run = run_python is not None and words[1] in RUN and all(find_spec(module) for module in needed)
        if may_run and "--memory" in words:
            run_python("-m", "stereokit.cli", *words[1:])
        elif may_run:
            done = CliRunner().invoke(app, words[1:])
            assert done.exit_code == 0, f"{line}\n{done.output}"
        else:
            parse(words[1:], line)
    elif words[:2] == ["python", "-m"]:
        parse_module(words[2], words[3:], line)
    elif words[:2] == ["pip", "install"]:
        for target in words[2:]:
            known = set(metadata("stereokit").get_all("Provides-Extra"))
            folder, extras = re.fullmatch(r"([^\[]*)(\[.*\])?", target).groups()
            if not (ROOT / folder / "pyproject.toml").is_file():
                assert Requirement(target).extras <= known, line
            elif (ROOT / folder).resolve() == ROOT and extras:  # `.[refiners]`: this checkout
                assert Requirement(f"stereokit{extras}").extras <= known, line
    elif words[0] == "make":
        assert f"\n{words[1]}:" in (ROOT / "Makefile").read_text(), line
    else:
        pytest.fail(f"no rule for {line!r}")


def parse(words: list[str], line: str) -> None:
    group = typer.main.get_command(app)
    try:
        with group.make_context("stereokit", words) as context:
            name, command, rest = group.resolve_command(context, words)
            parsed = command.make_context(name, rest, parent=context).params
    except Exception as error:  # typer brings a click of its own, whose errors have other types
        pytest.fail(f"{line}: {getattr(error, 'message', error)}")
    methods = parsed.get("method") or ()
    for method in (methods,) if isinstance(methods, str) else methods:
        is_readers = method.startswith("my_")  # a cost that the page tells how to write
        if not is_readers and not is_function(method) and baseline_key(method) is None:
            parse_method(method)


def test_the_figures_of_the_charts_are_those_of_the_benchmarks(monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(ROOT / "docs")
    from page_tables import find, tradeoff

    measured = find(ROOT / "docs" / "benchmarks.md", "MB added")
    assert measured.number("OpenCV 5 SGBM, 3WAY", "validation") is None
    assert b"<svg" in tradeoff(measured)
    assert find(ROOT / "docs" / "benchmarks.md", "ms of S4, 1 / 2 threads").text.startswith("| KITTI 2015")
    page = tmp_path / "page.md"
    page.write_text("| a | b |\n|---|---|\n| x | **1.5 %**, 7 |\n| y | |\n\nHow it was\nmeasured.\n\nMore.\n")
    table = find(page, "b")
    assert (table.number("x", "b", 0), table.number("x", "b"), table.number("y", "b")) == (1.5, 7, None)
    assert table.text.endswith("| y | |\n\nHow it was\nmeasured.")
    with pytest.raises(LookupError, match=r"page.md must have one table with a column 'c', got 0"):
        find(page, "c")


class Parsed(Exception):
    """A module's arguments were parsed."""


def parse_module(module: str, words: list[str], line: str) -> None:
    real = argparse.ArgumentParser.parse_args

    def parse_only(parser, arguments=None, namespace=None):
        real(parser, arguments, namespace)
        raise Parsed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
        patch.setattr(sys, "argv", [module, *words])
        patch.delitem(sys.modules, module, raising=False)
        try:
            runpy.run_module(module, run_name="__main__")
        except Parsed:
            return
        except SystemExit:
            pass
    pytest.fail(f"{line}: refused")


@pytest.mark.parametrize(
    "line",
    ["stereokit match a b --fast", "stereokit evaluate", "stereokit bench --method S9", "pip install stereokit[x]",
     "make tea", "python -m stereokit_evaluation.commands.search --dat x", "curl x"],
)  # fmt: skip
def test_a_wrong_command_is_found(line):
    with pytest.raises((pytest.fail.Exception, AssertionError, stereokit.StereokitError)):
        check(shlex.split(line), True)


def public_modules() -> set[str]:
    """Return the modules of all packages whose names do not begin with an underscore, and that bring something."""
    names = set()
    for name in ("stereokit", "stereokit_refiners", "stereokit_evaluation"):
        package = import_module(name)
        names |= {name, *(module.name for module in pkgutil.walk_packages(package.__path__, f"{name}."))}
    names = {name for name in names if not any(part.startswith("_") for part in name.split("."))}
    return {name for name in names if hasattr(import_module(name), "__all__")}  # a room that holds only others has none


INTERNAL = re.compile(
    r"stereokit\.(kernels|cuda|images|methods|io\.|cli\.(?!app))"
    r"|stereokit_refiners\.runtimes\.(?!tensors|encode)"
    r"|stereokit\.aggregation\.paths"
    r"|stereokit_evaluation\.(commands\.(?!search)|common|bench\.|gpu_model\.(sass|work|table)|synthetic\.(?!scenes|generated|assets))"
    r"|.*_cuda$"
)
"""Modules that only this project uses, and commands, whose help is on the page of the command line."""


def test_the_reference_has_every_public_module():
    text = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "api").glob("*.rst"))
    there = set(re.findall(r"^\.\. automodule:: (\S+)", text, flags=re.M))
    expected = {name for name in public_modules() if not INTERNAL.match(name)}
    assert {name for name in there if not INTERNAL.match(name)} == expected


def test_the_reference_has_every_public_name_of_stereokit():
    text = (ROOT / "docs" / "api" / "stereokit.rst").read_text(encoding="utf-8")
    there = set(re.findall(r"^\.\. auto(?:class|function|exception|data):: stereokit\.(\w+)$", text, flags=re.M))
    assert there == set(stereokit.__all__) - {"__version__"}
