"""Tables and charts as files: what is written can be read back, and has the figures of the study."""

from __future__ import annotations

import csv
import io
import json
import re
from xml.etree import ElementTree

import pytest
import typer
from typer.testing import CliRunner

from stereokit.errors import FileError
from stereokit_evaluation.commands.figures import figures
from stereokit_evaluation.report import charts
from stereokit_evaluation.report.exports import write_exports
from stereokit_evaluation.report.static_charts import chart_table, draw
from stereokit_evaluation.report.tables import Column, Table, study_tables

APP = typer.Typer()
APP.command()(figures)
THRESHOLDS = ("0.5", "1", "2", "3", "4")
STAGES = ("total", "prepare", "match", "clean", "refine", "other")


def row(matcher, setting, noc, *, refiner=None, missing=None, name=None):
    """Return a row of a study's JSON."""
    d1 = {
        "noc": {"all": noc, "bg": None, "fg": None},
        "occ": {"all": None if noc is None else noc + 1, "bg": None, "fg": None},
    }
    bad = {region: dict.fromkeys(THRESHOLDS, noc) for region in ("noc", "occ")}
    pairs = (
        [] if missing else [{"name": f"f_{k}", "d1": {"noc": noc + k, "occ": None}, "epe": 0.5 + k} for k in range(2)]
    )
    return {
        "matcher": matcher, "setting": setting, "refiner": refiner, "missing": missing, "d1": d1, "bad": bad,
        "density": 81.25, "epe": noc, "frames": pairs, "ms": {} if missing else dict.fromkeys(STAGES, 12.5),
        "published": {"validation_d1": 9.73, "test_d1_noc": None, "agx_ms": None},
        **({} if name is None else {"name": name}),
    }  # fmt: skip


@pytest.fixture
def document():
    rows = [
        row("S2", "Mini+Linear", 4.123456789, refiner="linear"),
        row("S2", "Original", 3.987654321),
        row("S2", "Mini+CNN", None, refiner="cnn", missing="no weights"),
        row("x", "peer", 5.5, name="my_net & 50% <b>|#"),
    ]
    machine = {"cpu": "a processor"}
    return {"results": rows, "dataset": "kitti2015", "split": None, "frames": ["f_0", "f_1"], "machine": machine}


def read_csv(text):
    head, *rows = csv.reader(io.StringIO(text))
    return [dict(zip(head, cells, strict=True)) for cells in rows]


def test_csv_has_the_plain_numbers(document):
    table = study_tables(document)["accuracy"].csv()
    rows = read_csv(table)
    assert [float(r["D1 noc all"]) for r in rows if r["D1 noc all"]] == [4.123456789, 3.987654321, 5.5]
    assert rows[2]["D1 noc all"] == rows[0]["D1 noc bg"] == "" and rows[3]["matcher"] == "my_net & 50% <b>|#"
    pairs = read_csv(study_tables(document)["pairs"].csv())
    assert pairs[1]["pair"] == "f_1" and float(pairs[1]["S2 Original"]) == 4.987654321
    assert {line["measure"] for line in pairs} == {"D1 noc, %", "EPE, px"}


def cells(line):
    """Return the cells of a line of LaTeX; an escaped & is none of its borders."""
    return re.split(r"(?<!\\)&", line.removesuffix(r" \\"))


def test_latex_is_a_whole_booktabs_table(document):
    for name, table in study_tables(document).items():
        lines = table.latex().splitlines()
        assert lines[0].startswith("% ") and "booktabs" in lines[0], name
        columns = re.fullmatch(r"\\begin\{tabular\}\{([lr]+)\}", lines[1])[1]
        assert (lines[2], lines[4], lines[-2], lines[-1]) == (
            r"\toprule",
            r"\midrule",
            r"\bottomrule",
            r"\end{tabular}",
        )
        body = [lines[3], *lines[5:-2]]
        assert len(body) == 1 + len(table.rows)
        for line in body:
            assert line.endswith(r" \\") and len(cells(line)) == len(columns)
            assert line.count("{") - line.count(r"\{") == line.count("}") - line.count(r"\}")
            assert not re.search(r"(?<!\\)[%#$_]", line)


def test_latex_marks_the_best_and_escapes(document):
    lines = study_tables(document)["accuracy"].latex().splitlines()
    assert "D1 noc bg" not in lines[3]  # nothing stands in it
    assert cells(lines[6])[2].strip() == r"\textbf{3.99}" and cells(lines[5])[2].strip() == "4.12"
    assert cells(lines[7])[2].strip() == "--"
    assert r"my\_net \& 50\% \textless{}b\textgreater{}\textbar{}\#" in lines[8]
    rows = Table("t", (Column("a", None),), (("[x]",), ("*",))).latex().splitlines()
    assert rows[5:7] == [r"{[}x] \\", r"{*} \\"]  # no argument of the \midrule and \\ before them
    odd = Table("t", (Column("a", None),), (("\\~^{}$",),)).latex()
    assert r"\textbackslash{}\textasciitilde{}\textasciicircum{}\{\}\$" in odd


def test_markdown_has_as_many_cells_in_every_line(document):
    for table in study_tables(document).values():
        title, empty, *lines = table.markdown().splitlines()
        assert title == table.title and empty == ""
        counts = {len(re.findall(r"(?<!\\)\|", line)) for line in lines}
        assert len(counts) == 1 and len(lines) == 2 + len(table.rows)
    text = study_tables(document)["accuracy"].markdown()
    assert "**3.99**" in text and r"my\_net & 50% \<b>\|#" in text


def test_equal_figures_are_both_the_best_and_one_alone_is_none():
    columns = (Column("m", None), Column("e", best=True))
    both = Table("t", columns, (("a", 1.001), ("b", 1.004), ("c", 2.0))).markdown()
    assert both.count("**1.00**") == 2
    assert "**" not in Table("t", columns, (("a", 1.0), ("b", None))).markdown()


def test_the_numbers_of_a_chart(document):
    bars = read_csv(chart_table(charts.bars(document["results"], "e4", "folder")).csv())
    here = {(r["method"], r["pixels"]): float(r["D1 error, %"]) for r in bars if r["series"].startswith("measured")}
    assert here["S2 Original", "noc all"] == 3.987654321 and here["S2 Original", "occ all"] == 4.987654321
    assert ("S2 Mini+CNN", "noc all") not in here and here["my_net & 50% <b>|#", "noc all"] == 5.5
    points = read_csv(chart_table(charts.accuracy_time(document["results"])).csv())
    ours = [r for r in points if r["series"] == "Original, this machine" and r["pixels"] == "noc all"]
    assert [(r["label"], float(r["D1 error, %"]), float(r["time, ms"])) for r in ours] == [("S2", 3.987654321, 12.5)]


def test_svg_has_real_text_and_the_same_bytes(document):
    pytest.importorskip("matplotlib")
    for figure in charts.figures(document).values():
        data = draw(figure, "svg")
        assert data == draw(figure, "svg")
        root = ElementTree.fromstring(data)
        texts = {"".join(e.itertext()).strip() for e in root.iter("{http://www.w3.org/2000/svg}text")}
        assert "D1 error, %" in texts
    assert {"S2", "StereoVAE", "time, ms"} <= texts  # the last is the plot of accuracy and time


def test_pdf_has_the_same_bytes_and_fonts(document):
    pytest.importorskip("matplotlib")
    figure = charts.bars(document["results"], "e4", "folder")
    data = draw(figure, "pdf")
    assert data == draw(figure, "pdf") and data.startswith(b"%PDF") and b"CreationDate" not in data
    assert b"/FontFile2" in data  # text, in an embedded TrueType font


def test_a_chart_of_lines_can_be_drawn_and_tabled():
    pytest.importorskip("matplotlib")
    trace = {"type": "scatter", "mode": "lines+markers+text", "name": "S2", "x": [0, 1, 2], "y": [3, None, 5]}
    trace |= {"text": [None, None, "S2"], "line": {"color": "#009e73", "dash": "dot"}, "marker": {"symbol": "diamond"}}
    axes = {"xaxis": {"title": {"text": "offset, px"}}, "yaxis": {"title": {"text": "D1, %"}}}
    figure = {"data": [trace], "layout": axes, "title": "rows"}
    assert chart_table(figure).rows == (("S2", None, None, 0, 3), ("S2", "S2", None, 2, 5))
    texts = {
        "".join(e.itertext()).strip() for e in ElementTree.fromstring(draw(figure, "svg")).iter() if "text" in e.tag
    }
    assert {"S2", "offset, px", "D1, %"} <= texts


def test_figures_intervals_and_comparisons(document, tmp_path):
    for entry in document["results"][:2]:
        entry["figures"] = {part: {"d1": entry["epe"], "density": 80.0} for part in ("main", "occluded")}
        entry["intervals"] = {"d1": [1.25, 6.5], "density": None}
    comparison = {"first": "a", "second": "b", "figure": "d1", "difference": -0.125, "low": None, "p": 0.5, "scenes": 3}
    document["comparisons"] = [comparison]
    tables = study_tables(document)
    lines = read_csv(tables["measures"].csv())
    assert [lines[0][key] for key in ("d1", "d1 low", "d1 high", "density low")] == ["4.123456789", "1.25", "6.5", ""]
    assert "low" not in tables["measures"].latex() and "80.00" in tables["measures"].markdown()
    long = read_csv(tables["measures_by_pixels"].csv())
    assert len(long) == 8 and long[2] == {
        "matcher": "S2", "setting": "Mini+Linear", "pixels": "occluded", "figure": "d1", "value": "4.123456789"
    }  # fmt: skip
    assert read_csv(tables["comparisons"].csv()) == [{k: "" if v is None else str(v) for k, v in comparison.items()}]
    names = {path.name for path in write_exports(document, tmp_path)}
    assert "comparisons.csv" in names and "comparisons.tex" not in names and "measures.tex" in names


def test_every_data_set_has_tables_of_its_own(document):
    part = {"results": document["results"][:1], "frames": ["f_0"], "split": None}
    document["data"] = {"kitti 15": part, "eth3d": part}
    tables = study_tables(document)
    assert len(tables["accuracy"].rows) == 4 and len(tables["kitti_15_accuracy"].rows) == 1
    assert "1 frame of kitti 15" in tables["kitti_15_accuracy"].title and "eth3d_times" in tables
    document["data"] = {"eth3d": part}
    assert "eth3d_times" not in study_tables(document)


def test_disturbances_have_charts_and_numbers(document, tmp_path):
    figure = {"d1": 5.0, "bad-1": 6.0, "bad-2": 7.0, "epe": 0.5, "density": 80.0}
    result = {
        "name": "S2 Original", "label": "S2", "variant": "original", "undisturbed": figure,
        "figures": {key: [value + 1, None] for key, value in figure.items()},
    }  # fmt: skip
    entry = {"unit": "px", "views": "right", "about": "lower", "neutral": 0, "strengths": [1, 2], "results": [result]}
    document["disturbances"] = {"offset": entry}
    files = {path.name: path for path in write_exports(document, tmp_path)}
    lines = read_csv(files["fault_offset.csv"].read_text())
    head = "offset (right view), px"
    assert [(line["figure"], line[head], line["value"]) for line in lines][:2] == [
        ("d1", "0", "5.0"),
        ("d1", "1", "6.0"),
    ]
    assert len(lines) == 2 * len(figure)  # nothing where there is no figure
    if "fault_offset.svg" in files:
        assert b"offset (right view), px" in files["fault_offset.svg"].read_bytes()


def test_the_files_of_a_study(document, tmp_path):
    names = {str(path.relative_to(tmp_path)) for path in write_exports(document, tmp_path)}
    assert {"tables/accuracy.tex", "tables/times.md", "tables/pairs.csv", "charts/d1_validation.csv"} <= names
    assert all((tmp_path / name).stat().st_size for name in names)
    before = {name: (tmp_path / name).read_bytes() for name in names}
    write_exports(document, tmp_path)
    assert before == {name: (tmp_path / name).read_bytes() for name in names}


def test_without_matplotlib_there_is_no_svg(document, tmp_path, monkeypatch):
    monkeypatch.setattr("stereokit_evaluation.report.exports.find_spec", lambda name: None)
    assert {path.suffix for path in write_exports(document, tmp_path)} == {".csv", ".tex", ".md"}


def test_the_command(document, tmp_path):
    (tmp_path / "study.json").write_text(json.dumps(document))
    done = CliRunner().invoke(APP, [str(tmp_path), "-o", str(tmp_path / "paper"), "--json", "-"])
    assert done.exit_code == 0, (done.output, done.exception)
    files = json.loads(done.stdout)["files"]
    assert str(tmp_path / "paper" / "tables" / "accuracy.tex") in files
    assert CliRunner().invoke(APP, [str(tmp_path / "study.json")]).exit_code == 0
    assert (tmp_path / "tables" / "accuracy.csv").exists()


@pytest.mark.parametrize("content", ["{}", "[]", "{", '{"results": [{}], "dataset": "x", "frames": [], "machine": {}}'])
def test_what_is_no_study_is_refused(tmp_path, content):
    (tmp_path / "study.json").write_text(content)
    done = CliRunner().invoke(APP, [str(tmp_path)])
    assert isinstance(done.exception, FileError) and "\n" not in str(done.exception)
    assert not (tmp_path / "tables").exists()


def test_a_chart_shows_the_pixels_that_there_are_and_times_may_be_missing(document):
    pytest.importorskip("matplotlib")
    document["dataset"] = "folder"
    for entry in document["results"]:
        entry["d1"]["noc"] = dict.fromkeys(("all", "bg", "fg"))
    figures = charts.figures(document)
    assert [x for x in figures["chart-d1"]["data"][-1]["x"] if x is not None] == [5.123456789, 4.987654321, 6.5]
    for entry in document["results"]:  # nothing at all: an axis of times has no point
        entry["d1"]["occ"] = dict.fromkeys(("all", "bg", "fg"))
    for figure in charts.figures(document).values():
        assert draw(figure, "svg").startswith(b"<?xml")
    for entry in document["results"]:
        entry["ms"] = {}
    assert list(charts.figures(document)) == ["chart-d1"]
