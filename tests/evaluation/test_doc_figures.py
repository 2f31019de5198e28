"""The README and the documentation print the figures of ``docs/figures.json``, and those are what the code gives."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from stereokit.errors import FileError
from stereokit.matching import METHODS
from stereokit_evaluation.commands import doc_figures
from stereokit_evaluation.commands.doc_figures import Measurement, measure, measurements, region_names
from stereokit_evaluation.data import published
from stereokit_evaluation.study.configurations import PAPER_VARIANTS

ROOT = Path(__file__).parents[2]
README, BENCHMARKS, INDEX = ROOT / "README.md", ROOT / "docs" / "benchmarks.md", ROOT / "docs" / "index.md"
PAPER = ROOT / "docs" / "paper.md"
FIGURES = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))["figures"]
BASELINES = {
    "OpenCV 5 SGBM, 3WAY": "OpenCV 3WAY",
    "OpenCV 5 SGBM, 5 directions": "OpenCV SGBM",
    "OpenCV 5 SGBM, HH (8 directions)": "OpenCV HH",
}
REFINED = {
    "full size": "",
    "half size, linear": " half",
    "half size, cnn": " half cnn",
    "half size, stereovae (the paper's)": " half stereovae",
    "half size, pyramid": " half pyramid",
}
SETTINGS = {
    "Mini+Linear": " half",
    "Original": "",
    "Mini+CNN": " half cnn",
    "Mini+StereoVAE": " half stereovae",
    "Mini+pyramid": " half pyramid",
    "Mini+stereokit": " half stereokit",
}
BAD_2 = ("cones", "teddy", "Motorcycle")
SENTENCES = [
    (
        page,
        r"with ([\d.]+) % bad pixels on KITTI 2015 where that has ([\d.]+) %",
        ["kitti2015, D1, S2", "kitti2015, D1, OpenCV 3WAY"],
    )
    for page in (README, INDEX)
] + [
    (README, r"reach ([\d.]+) %\s+there", ["kitti2015 validation, D1, S4 half cnn"]),
    (
        BENCHMARKS,
        r"bad-2\.0 of ([\d.]+), ([\d.]+), ([\d.]+) % \(S2\) and ([\d.]+), ([\d.]+), ([\d.]+) % \(S4\),\s+where HH has "
        r"([\d.]+), ([\d.]+),\s+([\d.]+) %",
        [f"middlebury {scene}, bad-2, {method}" for method in ("S2", "S4", "OpenCV HH") for scene in BAD_2],
    ),
    (
        BENCHMARKS,
        r"where linear upscaling has ([\d.]+) % and full size ([\d.]+) %",
        ["kitti2015, D1, S4 half", "kitti2015, D1, S4"],
    ),
]  # fmt: skip


@pytest.fixture(scope="module")
def find():
    """Return the function that finds a table of a page."""
    pytest.importorskip("matplotlib")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "docs")
        from page_tables import find

        yield find


def first_number(cell):
    return re.findall(r"\d+(?:\.\d+)?", cell)[0]


def agree(text, key):
    """Compare a printed figure with the file, to as many digits as are printed."""
    digits = len(text.partition(".")[2])
    assert abs(float(text) - FIGURES[key]) <= 0.5 * 10**-digits + 1e-9, f"{key} is {FIGURES[key]}, the page has {text}"


def test_the_file_has_every_figure_and_no_other():
    names = [figure.name for figure in measurements()]
    names += [name for dataset in ("scenes", "kitti2015") for name in region_names(dataset)]
    assert list(FIGURES) == names and len(set(names)) == len(names)
    assert all(0 < value < 100 for value in FIGURES.values())


@pytest.mark.parametrize("page", [README, BENCHMARKS], ids=["README", "benchmarks"])
def test_the_tables_of_methods(find, page):
    rows = find(page, "MB added").rows
    names = {name: name.split()[0] for name in rows if name.split()[0] in METHODS}
    assert len(names) == 4
    error = "D1 noc, validation" if page == README else "validation"
    columns = {"D1 noc": ("kitti2015", ""), error: ("kitti2015 validation", "")}
    columns |= {} if page == README else {"half size: D1 noc, ms of matching": ("kitti2015", " half")}
    for name, method in names.items():
        for column, (part, suffix) in columns.items():
            agree(first_number(rows[name][column]), f"{part}, D1, {method}{suffix}")
    baselines = {name: BASELINES[name] for name in rows if name not in names}
    assert len(baselines) == (1 if page == README else 3)
    for name, method in baselines.items():
        agree(first_number(rows[name]["D1 noc"]), f"kitti2015, D1, {method}")


def test_the_table_of_refiners(find):
    rows = find(BENCHMARKS, "ms of S4, 1 / 2 threads").rows
    assert set(rows) == {*REFINED, "OpenCV 5 SGBM, 3WAY, full size"}
    for name, suffix in REFINED.items():
        for method in METHODS:
            agree(first_number(rows[name][method]), f"kitti2015 validation, D1, {method}{suffix}")


def key_of(row):
    """Return a row's part of a key: ``"S4 Mini+CNN"`` is ``"S4 half cnn"``."""
    method, _, setting = row.partition(" ")
    return f"{method}{SETTINGS[setting]}" if setting in SETTINGS else row


def test_the_table_of_the_paper(find):
    rows = find(PAPER, "published, validation").rows
    assert len(rows) == 4 * len(SETTINGS) + 2
    names = {title: variant for variant, title in PAPER_VARIANTS.items()}
    for name, cells in rows.items():
        method, _, setting = name.partition(" ")
        for column, part in (("validation, 11 frames", "kitti2015 validation"), ("all 34 frames", "kitti2015")):
            key = f"{part}, D1, {key_of(name)}"
            assert bool(cells[column]) == (key in FIGURES)
            if cells[column]:
                agree(cells[column], key)
        for column, paper in (("published, validation", published.VALIDATION), ("published, test", published.TEST)):
            value = paper.get(method, {}).get(names.get(setting, ""))
            assert cells[column] == ("" if value is None else f"{value:.2f}")


@pytest.mark.parametrize(("head", "dataset"), [("textureless", "scenes"), ("16 to 32 px", "kitti2015")])
def test_the_tables_by_kind_of_pixel(find, head, dataset):
    keys = region_names(dataset)
    rows = find(PAPER, head).rows
    for name, cells in rows.items():
        for region, text in list(cells.items())[1:]:
            key = f"{dataset} {region}, D1, {key_of(name)}"
            assert key in keys
            agree(text, key)
    assert len(rows) * len(list(cells.items())[1:]) == len(keys)


@pytest.mark.parametrize(("page", "pattern", "keys"), SENTENCES)
def test_the_sentences(page, pattern, keys):
    match = re.search(pattern, page.read_text(encoding="utf-8"))
    assert match is not None
    for text, key in zip(match.groups(), keys, strict=True):
        agree(text, key)


def test_the_general_refiner_in_the_readme_is_that_of_its_card():
    card = ROOT / "refiners" / "stereokit_refiners" / "weights" / "MODEL_CARD.md"
    rows = re.findall(r"^\| (?:\w+, \d+) \|(.*)\|$", card.read_text(encoding="utf-8"), flags=re.M)
    cells = [[[float(x) for x in cell.split("/")] for cell in row.split("|")] for row in rows[:6]]  # its own table
    number = r"(\d\.\d+)"
    half = rf"has {number} of full size's errors in the mean\s+and {number} in the worst case"
    text = re.search(rf"{half}, full size with it {number} and {number}", README.read_text("utf-8"))
    printed = [float(x) for x in text.groups()]
    for column, (mean, worst) in zip((2, 3), (printed[:2], printed[2:]), strict=True):
        ratios = [refined / plain for row in cells for plain, refined in zip(row[0], row[column], strict=True)]
        assert len(ratios) == 24
        assert mean == pytest.approx(math.exp(sum(map(math.log, ratios)) / len(ratios)), abs=0.006)
        assert worst == pytest.approx(max(ratios), abs=0.006)


def test_a_figure_is_measured_on_the_frames_that_have_its_truth(tmp_path, monkeypatch):
    """Frames without truth of what both cameras see do not count, and bad-2 is not D1."""
    import numpy as np

    from stereokit_evaluation.data.frame import Frame

    image = np.zeros((4, 50), np.uint8)
    truth = np.full((4, 50), 60.0, np.float32)
    frames = [
        Frame("000000_10", lambda: image, lambda: image, noc=lambda: truth),
        Frame("000001_10", lambda: image, lambda: image, occ=lambda: truth),
    ]
    monkeypatch.setattr(doc_figures, "load_frames", lambda name, root: frames)
    calls = []

    def matcher(figure, selected):
        def match(left, right):
            calls.append(left)
            disparity = np.where(np.arange(50) < 10, np.float32(62.5), np.float32(60)) + np.zeros((4, 1), np.float32)
            return type("R", (), {"disparity": disparity.astype(np.float32), "valid": np.ones((4, 50), bool)})()

        assert [frame.name for frame in selected] == ["000000_10"]
        return match

    monkeypatch.setattr(doc_figures, "_matcher", matcher)
    assert measure(Measurement("a", "kitti2015", None, "bad-2", "S2"), tmp_path) == 20.0
    assert measure(Measurement("a", "kitti2015", "0-1", "D1", "S2"), tmp_path) == 0.0


def test_the_command_writes_what_it_measures(tmp_path, monkeypatch, capsys):
    few = [Measurement("one", "kitti2015", None, "D1", "S2"), Measurement("two", "kitti2015", None, "D1", "S4")]
    monkeypatch.setattr(doc_figures, "measurements", lambda: iter(few))
    monkeypatch.setattr(doc_figures, "measure", lambda figure, data: {"one": 1.23456, "two": 2.0}[figure.name])
    monkeypatch.setattr(doc_figures, "measure_by_region", lambda dataset, data: {f"{dataset} part": 3.00004})
    doc_figures.main(["--data", str(tmp_path), "-o", str(tmp_path / "figures.json")])
    document = json.loads((tmp_path / "figures.json").read_text())
    assert document["figures"] == {"one": 1.2346, "two": 2.0, "scenes part": 3.0, "kitti2015 part": 3.0}
    assert "doc_figures" in document["command"]
    with pytest.raises(FileError, match=r"output must end in one of \.json"):
        doc_figures.main(["--data", str(tmp_path), "-o", str(tmp_path / "figures.txt")])
