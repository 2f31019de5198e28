"""The report and the page of one pair: whole, without a network, and true to the figures."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from stereokit.calibration import Calibration
from stereokit.errors import FileError, InputError, OptionError, StereokitError
from stereokit.io import write_disparity
from stereokit_evaluation.commands.study import study
from stereokit_evaluation.commands.view import view
from stereokit_evaluation.data import datasets
from stereokit_evaluation.report import charts, page, viewer
from stereokit_evaluation.report.packing import unpack_map, unpack_mask
from stereokit_evaluation.report.page import chosen_frames, render

pytest.importorskip("jinja2")
plotly = pytest.importorskip("plotly.graph_objects")

APPS = {}
for _function in (study, view):
    APPS[_function.__name__] = typer.Typer()
    APPS[_function.__name__].command()(_function)


def command(name, *words):
    return CliRunner().invoke(APPS[name], [str(word) for word in words])


def blocks(page):
    matches = re.findall(r'<script type="application/json" id="([^"]+)">(.*?)</script>', page, flags=re.DOTALL)
    return {name: json.loads(text) for name, text in matches}


@pytest.fixture(scope="module")
def study_page(tmp_path_factory):
    """Return the JSON and the page of a study of three small scenes."""
    out = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets, "_SCENE_SIZE", (160, 96))
        datasets._scene.cache_clear()
        words = ["--count", 3, "--method", "S2", "--variant", "linear", "--variant", "original", "--variant", "cnn"]
        words += ["--max-disparity", 32, "--threads", 1, "--repeats", 1, "--show", 2, "-o", out]
        done = command("study", *words, "--json", out / "study.json")
    datasets._scene.cache_clear()
    assert done.exit_code in (0, 1), (done.output, done.exception)
    assert "report.html" in done.stdout
    return json.loads((out / "study.json").read_text()), (out / "report.html").read_text(encoding="utf-8")


def test_the_page_needs_no_network(study_page):
    _, page = study_page
    shell = re.sub(r'<script type="text/plain" id="plotly">.*?</script>', "", page, flags=re.DOTALL)
    assert not re.findall(r"""<[^>]*\b(?:src|href)=["']?(?!data:|#)[^"'\s>]+""", shell)
    assert "https:" not in shell and "@import" not in shell and "url(" not in shell
    assert len(page) < 6e6


def test_the_tables_hold_the_figures(study_page):
    document, page = study_page
    text = re.sub(r"<[^>]+>", " ", page)
    for row in document["results"]:
        if row["missing"] is None:
            assert f"{row['d1']['noc']['all']:.2f}" in text
    assert "9.73" in text and "8.52" in text and "StereoVAE, published" in text
    assert document["comparison"] in text.replace("&#39;", "'")


def test_the_charts_are_valid_plotly(study_page):
    _, page = study_page
    content = blocks(page)["charts"]
    assert list(content) == ["chart-e4", "chart-e5", "chart-time"]
    for figure in content.values():
        drawn = plotly.Figure(data=figure["data"], layout=figure["layout"])  # refuses what Plotly does not know
        ((_, variants),) = figure["variants"].items()
        assert list(variants) == list(charts.REGIONS)
        assert all(len(values) == len(drawn.data) for values in variants.values())


def test_published_bars_stand_beside_ours(study_page):
    document, page = study_page
    bars = {trace["name"]: trace for trace in blocks(page)["charts"]["chart-e4"]["data"]}
    assert bars["Mini+Linear, published"]["y"] == [9.73] and "pattern" in bars["Mini+Linear, published"]["marker"]
    ours = next(row for row in document["results"] if row["setting"] == "Mini+Linear")
    assert bars["Mini+Linear, scenes"]["y"] == [ours["d1"]["noc"]["all"]]
    points = blocks(page)["charts"]["chart-time"]["data"]
    assert "published" in points[-1]["name"] and "StereoVAE" in points[-1]["text"]
    assert any(trace["name"] == "OpenCV, this machine" for trace in points)


def test_the_maps_are_those_of_the_matchers(study_page):
    _, page = study_page
    shown = blocks(page)["pair-0"]
    names = [entry["name"] for entry in shown["maps"]]
    assert names[:2] == ["S2 Mini+Linear", "S2 Original"] and names[-2:] == ["OpenCV 3WAY", "OpenCV HH"]
    assert shown["calibration"]["fx"] > 0 and re.fullmatch(r"D1 \d+\.\d\d %", shown["maps"][0]["note"])
    truth, seen = unpack_map(shown["truth"]), unpack_mask(shown["seen"], (96, 160))
    disparity = unpack_map(shown["maps"][1]["map"])
    known = np.isfinite(truth) & seen
    assert np.median(np.abs(disparity - truth)[known]) < 1
    assert unpack_mask(shown["maps"][1]["measured"], (96, 160)).mean() > 0.5


def test_frames_to_look_at_run_from_easy_to_hard():
    class Named:
        def __init__(self, name):
            self.name = name

    frames = [Named(str(i)) for i in range(9)]
    assert [f.name for f in chosen_frames(frames, [], 3)] == ["0", "4", "8"]
    assert [f.name for f in chosen_frames(frames, [], 1)] == ["4"] and chosen_frames(frames, [], 0) == []
    assert len(chosen_frames(frames, [], 20)) == 9


def test_what_stands_in_a_page_cannot_break_out_of_it():
    hostile = "</script><script>alert(1)</script>"
    shown = viewer.MethodMap(hostile, np.ones((4, 6), np.float32), np.ones((4, 6), bool), hostile)
    pair = viewer.pair(hostile, np.zeros((4, 6), np.uint8), [shown])
    page = render("view.html.j2", [pair], title=hostile, version="0", maps=[shown], methods=[hostile, hostile]).decode()
    assert "<script>alert" not in page
    assert blocks(page)["pair-0"]["name"] == hostile


def test_gaps_are_filled_and_marked(random_pair):
    disparity = np.full((4, 6), 5, np.float32)
    disparity[:, 2] = np.nan
    pair = viewer.pair("x", random_pair(4, 6)[0], [viewer.MethodMap("m", disparity, np.ones((4, 6), bool))])
    assert (unpack_map(pair["maps"][0]["map"]) == 5).all()
    assert (unpack_mask(pair["maps"][0]["measured"], (4, 6)) == np.isfinite(disparity)).all()
    assert pair["truth"] is None and pair["calibration"] is None


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_any_image_can_be_shown(dtype):
    for shape in ((5, 7), (5, 7, 3)):
        image = np.full(shape, 0.5 if dtype == np.float32 else np.iinfo(dtype).max // 2, dtype)
        shown = viewer.MethodMap("m", np.ones((5, 7), np.float32), np.ones((5, 7), bool))
        assert viewer.pair("x", image, [shown])["left"].startswith("data:image/jpeg;base64,")


def test_maps_of_another_size_are_refused():
    shown = viewer.MethodMap("m", np.ones((5, 7), np.float32), np.ones((5, 7), bool))
    with pytest.raises(InputError, match="m must have the size of the left image"):
        viewer.pair("x", np.zeros((5, 8), np.uint8), [shown])
    with pytest.raises(InputError, match="at least one map"):
        viewer.pair("x", np.zeros((5, 8), np.uint8), [])
    with pytest.raises(InputError, match="calibration is for 9x9"):
        camera = Calibration(1, 1, 0, 0, 1, width=9, height=9)
        viewer.pair("x", np.zeros((5, 7), np.uint8), [shown], calibration=camera)


def test_a_missing_package_is_one_line(monkeypatch):
    def gone(name):
        raise ModuleNotFoundError(name=name)

    monkeypatch.setattr(page, "import_module", gone)
    with pytest.raises(StereokitError, match=r'a report needs jinja2: pip install "stereokit\[report\]"'):
        render("view.html.j2", [])


@pytest.fixture
def files(tmp_path, random_pair):
    left, _ = random_pair(40, 100)
    for name, image in (("l.png", left), ("r.png", np.roll(left, -5, axis=1)), ("small.png", left[:9])):
        assert cv2.imwrite(str(tmp_path / name), image)
    (tmp_path / "text.png").write_text("no picture")
    write_disparity(tmp_path / "truth.png", np.full((40, 100), 5, np.float32))
    fields = {"fx": 100, "fy": 100, "cx0": 50, "cy": 20, "baseline_m": 0.5}
    (tmp_path / "camera.json").write_text(json.dumps(fields))
    return tmp_path


def test_view_writes_one_page(files, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    words = ("view", files / "l.png", files / "r.png", "-m", "S2", "-m", "S4", "--max-disparity", 16, "--threads", 1)
    done = command(*words, "-o", files / "out.html")
    assert done.exit_code == 0, (done.output, done.exception)
    assert "no calibration: no depth, and the point cloud is in pixels" in done.stdout and not opened
    content = blocks((files / "out.html").read_text())
    assert [entry["name"] for entry in content["pair-0"]["maps"]] == ["S2", "S4"] and content["pair-0"]["truth"] is None
    known = ("--calibration", files / "camera.json", "--truth", files / "truth.png", "--json", "-", "--open")
    done = command(*words, *known, "-o", files / "known.html")
    assert json.loads(done.stdout)["methods"] == ["S2", "S4"] and opened[0].startswith("file://")
    pair = blocks((files / "known.html").read_text())["pair-0"]
    assert pair["calibration"]["baseline_m"] == 0.5 and "D1" in pair["maps"][0]["note"]


def test_view_takes_refiners(files):
    words = ("view", files / "l.png", files / "r.png", "--max-disparity", 16, "--scale", 0.5, "--refiner", "linear")
    done = command(*words, "-o", files / "out.html", "--json", "-")
    assert json.loads(done.stdout)["methods"] == ["S2 Mini+Linear"]


@pytest.mark.parametrize(
    ("words", "kind", "message"),
    [
        (("l.png", "none.png"), FileError, "no such file"),
        (("text.png", "r.png"), FileError, "is not an image"),
        (("l.png", "small.png"), InputError, "must have the same size, got 100x40 and 100x9"),
        (("l.png", "r.png", "-o", "out.png"), FileError, "output must end in one of .html, .htm"),
        (("l.png", "r.png", "-o", "none/out.html"), FileError, "does not exist"),
        (("l.png", "r.png", "--refiner", "linear"), OptionError, "refiner needs --scale 0.5"),
        (("l.png", "r.png", "--method", "S7"), OptionError, "no method named 'S7'"),
        (("l.png", "r.png", "--calibration", "none.txt"), FileError, "no such file"),
        (("l.png", "r.png", "--truth", "l.png"), FileError, "must be a 16-bit grey PNG"),
    ],
)
def test_view_refuses_bad_input_in_one_line(files, words, kind, message, monkeypatch):
    monkeypatch.chdir(files)
    arguments = ("view", "--max-disparity", 16, *(() if "-o" in words else ("-o", "out.html")), *words)
    done = command(*arguments)
    assert isinstance(done.exception, kind) and message in str(done.exception)
    assert "\n" not in str(done.exception) and not (files / "out.html").exists()
