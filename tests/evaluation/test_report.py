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
from stereokit.notices import PairWarning
from stereokit_evaluation.commands.study import study
from stereokit_evaluation.commands.view import view
from stereokit_evaluation.data import datasets
from stereokit_evaluation.report import charts, page, viewer
from stereokit_evaluation.report.measures import by_data_set, measure_rows
from stereokit_evaluation.report.packing import unpack_map, unpack_mask
from stereokit_evaluation.report.page import chosen_frames, render
from stereokit_evaluation.report.per_pair import per_pair
from stereokit_evaluation.report.tiles import TileFolder

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
        patch.setattr(
            charts, "kitti_part", lambda study: {"name": "scenes", **study["data"]["scenes"]}
        )  # as if of KITTI
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
    there, here = bars["published"], bars["measured here, scenes"]
    assert there["y"] == here["y"] and there["orientation"] == "h"  # a row each, its name beside it
    place = there["y"].index("S2 Mini+Linear")
    assert there["x"][place] == 9.73 and "pattern" in there["marker"]
    ours = next(row for row in document["results"] if row["setting"] == "Mini+Linear")
    assert here["x"][place] == ours["d1"]["noc"]["all"]
    assert there["y"][-2:] == ["OpenCV 3WAY", "OpenCV HH"] and there["x"][-2:] == [None, None]
    points = blocks(page)["charts"]["chart-time"]["data"]
    assert "published" in points[-1]["name"] and "StereoVAE" in points[-1]["text"]
    assert any(trace["name"] == "other methods, this machine" for trace in points)
    shapes = [trace["marker"]["symbol"] for trace in points]
    assert len(set(shapes)) == len(shapes)  # settings differ by more than colour


def test_published_figures_stand_beside_kitti_2015_alone(study_page):
    document, _ = study_page
    rows, part = document["results"], document["data"]["scenes"]
    assert not any(value for row in rows for value in row["published"].values())
    names = {key: [t["name"] for t in figure["data"]] for key, figure in charts.figures(document).items()}
    assert list(names) == ["chart-d1", "chart-time"] and names["chart-d1"] == ["measured here, scenes"]
    assert not any("published" in name for name in names["chart-time"])
    kitti = {**part, "dataset": "kitti2015", "results": [{**row, "ms": {"total": 5.0}} for row in rows]}
    both = {**document, "dataset": "scenes, K", "data": {"scenes": part, "K": kitti}}
    figures = charts.figures(both)
    assert list(figures) == ["chart-d1", "chart-e4", "chart-e5", "chart-time"]
    assert [trace["name"] for trace in figures["chart-d1"]["data"]] == ["measured here, scenes, K"]
    assert [trace["name"] for trace in figures["chart-e5"]["data"]] == ["published", "measured here, K"]
    assert figures["chart-time"]["data"][0]["y"] == [5.0]  # those of KITTI, not the pooled ones
    assert all(len(x) == len(f["data"]) for f in figures.values() for x in f["variants"]["x"].values())


def test_the_maps_are_those_of_the_matchers(study_page):
    _, page = study_page
    shown = blocks(page)["pair-0"]
    names = [entry["name"] for entry in shown["maps"]]
    assert names[:2] == ["S2 Mini+Linear", "S2 Original"] and names[-2:] == ["OpenCV 3WAY", "OpenCV HH"]
    assert shown["calibration"]["fx"] > 0 and re.fullmatch(
        r"D1 noc \d+\.\d\d %, density \d+ %", shown["maps"][0]["note"]
    )
    assert shown["right"].startswith("data:image/jpeg") and "both cameras see" in shown["pixels"]
    truth, seen = unpack_map(shown["truth"]), unpack_mask(shown["seen"], (96, 160))
    disparity = unpack_map(shown["maps"][1]["map"])
    known = np.isfinite(truth) & seen
    assert np.median(np.abs(disparity - truth)[known]) < 1
    assert unpack_mask(shown["maps"][1]["measured"], (96, 160)).mean() > 0.5


def test_many_maps_lie_in_a_folder_beside_the_page(tmp_path):
    disparity = np.arange(24, dtype=np.float32).reshape(4, 6)
    maps = [viewer.MethodMap(name, disparity + k, np.ones((4, 6), bool), name) for k, name in enumerate(("a", "</b>"))]
    pair = viewer.pair("p", np.zeros((4, 6), np.uint8), maps, occ=disparity)
    tiles = TileFolder(tmp_path / "my report.html")
    first, second = tiles.add(pair), tiles.add(pair)
    names = sorted(path.name for path in (tmp_path / "my report_files").iterdir())
    assert names == sorted(f"pair-{number}{part}.js" for number in (0, 1) for part in ("", "-map-0", "-map-1"))
    assert first["tile"] == "my%20report_files/pair-0.js" and second["maps"][1]["tile"].endswith("pair-1-map-1.js")
    assert "left" not in first and "map" not in first["maps"][0]  # the page holds no pixels
    assert tiles.bytes == sum(path.stat().st_size for path in (tmp_path / "my report_files").iterdir())

    def content(tile):
        text = (tmp_path / tile.replace("%20", " ")).read_text()
        assert "</b>" not in text
        path, value = json.loads("[" + re.fullmatch(r"Tiles\.put\((.*)\);\n", text)[1] + "]")
        assert path == tile
        return value

    assert content(first["tile"])["truth"] == pair["truth"]
    assert content(first["maps"][1]["tile"]) == {key: pair["maps"][1][key] for key in ("map", "measured")}


def test_a_study_of_many_maps_takes_the_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "_LARGE", 160 * 96)
    monkeypatch.setattr(datasets, "_SCENE_SIZE", (160, 96))
    datasets._scene.cache_clear()
    words = ["--count", 2, "--method", "S2", "--variant", "linear", "--variant", "original", "--max-disparity", 32]
    done = command("study", *words, "--threads", 1, "--repeats", 1, "--no-peers", "--show", 2, "-o", tmp_path)
    datasets._scene.cache_clear()
    assert done.exit_code == 0, (done.output, done.exception)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "pair-0" not in blocks(text) and 'data-tile="report_files/pair-0.js"' in text
    assert len(list((tmp_path / "report_files").iterdir())) == 2 * (1 + 2)
    assert blocks(text)["per-pair"]["viewer"].keys() == {"scene_000", "scene_001"}


def measured(name, d1, interval=None):
    figures = {part: {"d1": d1, "bad-1": d1 and 2 * d1} for part in ("main", "occluded", "edges")}
    return {"name": name, "missing": None, "figures": figures, "intervals": {"d1": interval}}


def test_all_measures_beside_the_best():
    rows = [measured("a", 3.0, [2.0, 4.0]), measured("b", 1.5), measured("c", None), {"missing": "x", "figures": {}}]
    comparison = {"first": "a", "second": "b", "figure": "d1", "difference": 1.5, "low": 0.5, "high": 2.0, "p": 0.03}
    other = {**comparison, "figure": "epe", "difference": 9.0}
    first, best = measure_rows({"results": rows, "comparisons": [other, comparison]})
    assert first["interval"] == [2.0, 4.0] and first["figures"]["bad-1"] == 6.0 and first["figures"]["a90"] is None
    assert first["beside"] == {"difference": 1.5, "low": 0.5, "high": 2.0, "p": 0.03}
    assert best["best"] and best["beside"] is None and best["interval"] is None
    turned = {"first": "b", "second": "a", "figure": "d1", "difference": -1.5, "low": -2.0, "high": -0.5, "p": 0.03}
    assert measure_rows({"results": rows, "comparisons": [turned]})[0]["beside"] == first["beside"]
    assert measure_rows({"results": [{"missing": None}]}) == []  # a study of before these figures


def test_figures_by_data_set():
    parts = {"kitti": {"results": [measured("a", 3.0), measured("b", 1.0)]}, "eth": {"results": [measured("b", 2.0)]}}
    assert by_data_set({"data": parts}) == (["kitti", "eth"], [("a", [3.0, None]), ("b", [1.0, 2.0])])
    assert by_data_set({"data": {"kitti": parts["kitti"]}}) == by_data_set({}) == ([], [])


def test_the_figures_pair_by_pair():
    def frame(name, noc, occ, epe):
        return {"name": name, "d1": {"noc": noc, "occ": occ}, "epe": epe}

    rows = [
        {"matcher": "S2", "setting": "Original", "frames": [frame("p", None, 4.0004, 1), frame("q", None, 6, 2)]},
        {"matcher": "mine", "setting": "peer", "name": "my own", "frames": [frame("q", None, 5, None)]},
        {"matcher": "S2", "setting": "Mini+CNN", "frames": []},
    ]
    table = per_pair(rows, ["q"], digits=3)
    assert table["frames"] == ["p", "q"] and table["methods"] == ["S2 Original", "my own"]
    assert table["measures"] == {"D1 all, %": [[4.0, 6.0], [None, 5.0]], "EPE, px": [[1.0, 2.0], [None, None]]}
    assert table["viewer"] == {"q": 0}


@pytest.mark.parametrize(
    ("value", "text"), [(0.0044, "0.0044"), (0.25, "0.25"), (2.48, "2.5"), (9.96, "10"), (26.3, "26"), (1.0, "1")]
)
def test_a_rate_is_never_rounded_to_nothing(value, text):
    assert page.rate(value) == text


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
    figures = [{"name": hostile, "ms": 1.0, "density": 50.0, "d1_noc": None, "d1_all": None}]
    content = {"figures": figures, "warnings": [hostile], "methods": [hostile, hostile]}
    page = render("view.html.j2", [pair], title=hostile, version="0", **content).decode()
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
    with pytest.raises(InputError, match="right must have the size of the left image"):
        viewer.pair("x", np.zeros((5, 7), np.uint8), [shown], right=np.zeros((6, 7), np.uint8))
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


def test_view_says_which_pixels_count(files):
    mask = np.full((40, 100), 255, np.uint8)
    mask[:, :30] = 128
    assert cv2.imwrite(str(files / "mask.png"), mask)
    truth = np.full((40, 100), 5, np.float32)
    truth[:10] = np.nan
    write_disparity(files / "truth.png", truth)
    write_disparity(files / "noc.pfm", np.where(mask == 255, truth, np.nan).astype(np.float32))
    outcomes = []
    for noc in ("mask.png", "noc.pfm"):
        words = ("view", files / "l.png", files / "r.png", "--max-disparity", 16, "--threads", 1)
        done = command(
            *words, "--truth", files / "truth.png", "--noc", files / noc, "-o", files / "o.html", "--json", "-"
        )
        (row,) = json.loads(done.stdout)["figures"]
        pair = blocks((files / "o.html").read_text())["pair-0"]
        outcomes.append((row["d1_noc"], row["d1_all"], pair["pixels"]))
        assert pair["right"] and "density" in pair["maps"][0]["note"]
    assert outcomes[0] == outcomes[1]
    assert "3,000 pixels have a true disparity" in outcomes[0][2] and "see 2,100 of them" in outcomes[0][2]


def test_view_warns_of_nonsense_on_the_page(tmp_path):
    from stereokit_evaluation.synthetic.scenes import generate

    pytest.importorskip("skimage")
    scene = generate(0, 480, 160, 32)
    for name, image in (("l.png", scene.right), ("r.png", scene.left)):  # exchanged
        assert cv2.imwrite(str(tmp_path / name), image)
    words = ("view", tmp_path / "l.png", tmp_path / "r.png", "--max-disparity", 32, "--threads", 1)
    with pytest.warns(PairWarning, match="exchanged"):
        done = command(*words, "-o", tmp_path / "o.html", "--json", "-")
    warnings = json.loads(done.stdout)["warnings"]
    assert sum("exchanged" in line for line in warnings) == 1
    assert 'role="alert">Warning: the views look exchanged' in (tmp_path / "o.html").read_text()


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
        (("l.png", "r.png", "--noc", "l.png"), OptionError, "noc must go with --truth where it is a mask"),
        (("l.png", "r.png", "--truth", "truth.png", "--noc", "small.png"), InputError, "noc must have the size"),
    ],
)
def test_view_refuses_bad_input_in_one_line(files, words, kind, message, monkeypatch):
    monkeypatch.chdir(files)
    arguments = ("view", "--max-disparity", 16, *(() if "-o" in words else ("-o", "out.html")), *words)
    done = command(*arguments)
    assert isinstance(done.exception, kind) and message in str(done.exception)
    assert "\n" not in str(done.exception) and not (files / "out.html").exists()
