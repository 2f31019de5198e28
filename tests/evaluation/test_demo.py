"""The demo command with a stand-in matcher, and its picture by hand-counted pixels."""

from __future__ import annotations

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

pytest.importorskip("skimage")

import stereokit
from stereokit.errors import FileError, InputError, OptionError, StereokitError
from stereokit_evaluation.commands import demo as module
from stereokit_evaluation.commands.demo import Panel, demo, overview

METHODS = {"S1": "census+dt", "S4": "zncc+sgm"}
WHITE = np.full((50, 100, 3), 255, np.uint8)


@pytest.fixture
def stand_in(monkeypatch):
    """Replace the matcher by one that answers at once: 10 px everywhere, its left half not measured."""
    calls = []

    class Matcher:
        def __init__(self, method, *, max_disparity, threads, scale=1.0, refiner=None):
            self.method = METHODS.get(method.upper(), method)
            self.scale, self.refiner = scale, refiner
            if refiner == "absent":
                raise StereokitError("refiner 'absent' is not there")
            self.device, self.max_disparity = "cpu", max_disparity
            if "+" not in self.method:
                raise OptionError(f"no method named {method!r}")

        def __call__(self, left, right):
            assert left.ndim == right.ndim == 2 and left.dtype == np.uint8
            calls.append(self.method)
            valid = np.ones(left.shape, bool)
            valid[:, : left.shape[1] // 2] = False
            return SimpleNamespace(disparity=np.full(left.shape, 10, np.float32), valid=valid)

    monkeypatch.setattr(stereokit, "Matcher", Matcher)
    monkeypatch.setattr(stereokit, "METHODS", METHODS)
    return calls


def test_demo_writes_pictures_table_and_figures(stand_in, tmp_path, capsys):
    folder, figures = tmp_path / "deep" / "out", tmp_path / "figures.json"
    demo(folder, seed=1, size="160x90", max_disparity=48, json_file=figures)
    refined = ["S4-half-stereokit", "S4-half-stereokit_error"]
    names = ["S1", "S1_error", "S4", *refined, "S4_error", "left", "overview", "right", "truth"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(f"{name}.png" for name in names)
    scene = module.generate(1, 160, 90, 48)
    for name, image in (("left", scene.left), ("right", scene.right)):
        np.testing.assert_array_equal(cv2.imread(str(folder / f"{name}.png"))[..., ::-1], image)
    for name in ("S1", "S1_error", "truth"):
        assert cv2.imread(str(folder / f"{name}.png")).shape == (90, 160, 3)
    rows = json.loads(figures.read_text())["results"]
    assert [row["method"] for row in rows] == ["census+dt", "zncc+sgm", "zncc+sgm"]
    assert [(row["scale"], row["refiner"]) for row in rows] == [(1.0, None), (1.0, None), (0.5, "stereokit")]
    truth = scene.disparity[(scene.surface > 0) & ~scene.occluded].astype(float)
    error = np.abs(truth - 10)
    row = rows[0]
    assert row["d1"]["noc"]["all"] == pytest.approx(100 * np.mean((error > 3) & (error > 0.05 * truth)), abs=1e-3)
    assert row["epe"] == pytest.approx(error.mean(), rel=1e-4)
    assert 0 < row["density"] < 100 and row["seconds_per_image"] >= 0
    assert set(row["d1"]["occ"]) == {"all", "bg", "fg"}
    assert (row["scale"], row["refiner"], row["device"], row["images"]) == (1.0, None, "cpu", 1)
    assert stand_in == ["census+dt"] * 4 + ["zncc+sgm"] * 8  # one warm-up and three timed
    printed = capsys.readouterr().out
    assert "S4 zncc+sgm" in printed and "D1 noc" in printed and f"{row['d1']['noc']['all']:.2f}" in printed


def test_demo_takes_methods_once_and_prints_json(stand_in, tmp_path, capsys):
    demo(
        tmp_path,
        size="33x17",
        max_disparity=16,
        method=["s4", "zncc+sgm", "a+b"],
        refiner="none",
        json_file=module.Path("-"),
    )
    rows = json.loads(capsys.readouterr().out)["results"]
    assert [row["method"] for row in rows] == ["zncc+sgm", "a+b"]
    assert (tmp_path / "S4_error.png").exists() and (tmp_path / "a-b.png").exists()


def test_a_refiner_that_cannot_run_is_told_of_and_refused_when_asked_for(stand_in, tmp_path, capsys, monkeypatch):
    with pytest.raises(StereokitError, match="'absent' is not there"):
        demo(tmp_path, size="33x17", max_disparity=16, method=["S4"], refiner="absent")
    monkeypatch.setattr(module, "_REFINER", "absent")
    demo(tmp_path, size="33x17", max_disparity=16, method=["S4"], refiner="absent")
    assert "without a refined map: refiner 'absent' is not there" in capsys.readouterr().err
    assert not list(tmp_path.glob("*half*"))


@pytest.mark.parametrize("size", ["12", "0x5", "5x", "axb", "-3x4", "5x5x5"])
def test_bad_sizes_are_refused(size, tmp_path, stand_in):
    with pytest.raises(OptionError, match="size must be WIDTHxHEIGHT"):
        demo(tmp_path, size=size)
    assert not stand_in


def test_bad_places_and_methods_are_refused_before_any_work(stand_in, tmp_path):
    taken = tmp_path / "file"
    taken.write_text("mine")
    with pytest.raises(FileError, match="output must be a folder"):
        demo(taken)
    with pytest.raises(FileError, match="--json"):
        demo(tmp_path / "out", json_file=tmp_path / "none" / "x.json")
    with pytest.raises(OptionError, match="nonsense"):
        demo(tmp_path, method=["nonsense"])
    assert taken.read_text() == "mine" and not stand_in
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_overview_places_its_tiles():
    red, blue = WHITE * np.uint8([1, 0, 0]), WHITE * np.uint8([0, 0, 1])
    panels = [Panel("S1 census+dt", red, blue, 5.0, 12.3), Panel("other", blue, red)]
    sheet = overview(WHITE, WHITE // 2, panels, tile_width=60)
    # three rows of 26 caption + 30 picture + 6 gap, and one more gap; two columns of 60 and three gaps
    assert sheet.shape == (3 * 62 + 6, 2 * 60 + 18, 3) and sheet.dtype == np.uint8
    tiles = [sheet[32 + 62 * i : 62 + 62 * i, 6 + 66 * j : 66 + 66 * j] for i in range(3) for j in range(2)]
    for tile, colour in zip(
        tiles, [(255,) * 3, (127,) * 3, (255, 0, 0), (0, 0, 255), (0, 0, 255), (255, 0, 0)], strict=True
    ):
        assert (tile == np.uint8(colour)).all()
    assert (sheet[6:32, 6:66] < 100).any()  # a caption is written
    assert (sheet[:6] == 250).all() and (sheet[:, :6] == 250).all()


def test_overview_refuses_what_does_not_fit():
    with pytest.raises(InputError, match="'S1' must be uint8 of shape"):
        overview(WHITE, WHITE, [Panel("S1", WHITE[1:], WHITE)])
    with pytest.raises(InputError, match="float32"):
        overview(WHITE, WHITE.astype(np.float32), [])
    with pytest.raises(OptionError, match="tile_width must be at least 1, got 0"):
        overview(WHITE, WHITE, [], tile_width=0)
    assert overview(WHITE[:1], WHITE[:1], [], tile_width=10).shape == (26 + 1 + 12, 38, 3)
