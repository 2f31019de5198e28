"""The pages in headless Chromium: they open, draw, sort, slide and tell numbers, without a word on the console.

Screenshots are written to the folder that STEREOKIT_SCREENSHOTS names, when it is set.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from limits import HANG_S

from stereokit.calibration import Calibration
from stereokit_evaluation.report import viewer
from stereokit_evaluation.report.page import render
from stereokit_evaluation.report.tiles import TileFolder

pytestmark = pytest.mark.browser
ARGUMENTS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
).split()
NONE = "\u2013"
SIZES = {"desktop": (1280, 800), "phone": (390, 844)}


@pytest.fixture(scope="module")
def chromium():
    """Return a running headless browser, or skip."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    path = next((program for name in names if (program := shutil.which(name))), None)
    if path is None:
        pytest.skip("no Chromium on the PATH")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def study_file(tmp_path_factory):
    """Return the page of a study of three small scenes."""
    pytest.importorskip("plotly")
    from typer import Typer
    from typer.testing import CliRunner

    from stereokit_evaluation.commands.study import study
    from stereokit_evaluation.data import datasets
    from stereokit_evaluation.report import charts

    out, app = tmp_path_factory.mktemp("study"), Typer()
    app.command()(study)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets, "_SCENE_SIZE", (320, 192))
        patch.setattr(
            charts, "kitti_part", lambda study: {"name": "scenes", **study["data"]["scenes"]}
        )  # as if of KITTI
        datasets._scene.cache_clear()
        words = ["--count", "3", "--max-disparity", "64", "--threads", "1", "--repeats", "1", "--no-peers"]
        words += ["--variant", "linear", "--variant", "original", "-o", str(out)]
        words += ["--disturb", "noise:5,20", "--disturb-frames", "1"]
        done = CliRunner().invoke(app, words)
    datasets._scene.cache_clear()
    assert done.exit_code == 0, (done.output, done.exception)
    return out / "report.html"


def small_pair():
    """Return a pair whose numbers are known: disparity 10 everywhere, in gaps filled; truth 10, and 16 on the right."""
    shape = (40, 120)
    image = np.tile(np.arange(120, dtype=np.uint8), (40, 1))
    valid = np.ones(shape, bool)
    valid[:, :20] = False
    truth = np.full(shape, 10, np.float32)
    truth[:, 100:] = 16
    visible = truth.copy()
    visible[20:] = np.nan
    ten, twelve = (np.full(shape, value, np.float32) for value in (10, 12.5))
    maps = [viewer.MethodMap("ten", ten, valid), viewer.MethodMap("twelve", twelve, np.ones(shape, bool))]
    camera = Calibration(fx=100, fy=100, cx0=60, cy=20, baseline_m=0.5)
    return viewer.pair("known", image, maps, right=image[:, ::-1], noc=visible, occ=truth, calibration=camera), maps


def write_page(path, pairs, methods):
    """Write a page of pairs."""
    figures = [{"name": name, "ms": 5.0, "density": 80.0, "d1_noc": 1.0, "d1_all": 2.0} for name in methods]
    content = {"title": "known", "version": "0", "figures": figures, "warnings": [], "methods": methods}
    path.write_bytes(render("view.html.j2", pairs, **content))
    return path


@pytest.fixture(scope="module")
def view_file(tmp_path_factory):
    """Return the page of one pair."""
    pytest.importorskip("jinja2")
    return write_page(tmp_path_factory.mktemp("view") / "view.html", [small_pair()[0]], ["ten", "twelve"])


@contextmanager
def opened(chromium, path, size="desktop", scheme="light", requests=None):
    """Open a page in a fresh profile without a network; it must say nothing on the console and ask for nothing."""
    width, height = SIZES[size]
    context = chromium.new_context(viewport={"width": width, "height": height}, color_scheme=scheme, offline=True)
    page, messages, requests = context.new_page(), [], [] if requests is None else requests
    page.on("console", lambda message: messages.append(message.text) if message.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    page.evaluate("Viewer.start()")  # by itself it starts when it comes near
    page.wait_for_selector("#viewer[data-ready]", timeout=1000 * HANG_S)
    if page.query_selector("#charts"):
        page.wait_for_selector("body[data-charts]", timeout=1000 * HANG_S)
    yield page
    if folder := os.environ.get("STEREOKIT_SCREENSHOTS"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        page.screenshot(path=f"{folder}/{path.stem}-{size}-{scheme}.png", full_page=True)
    context.close()
    assert messages == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in requests)


def pixels(page, canvas):
    """Return the canvas's pixels as (H, W, 3) uint8, RGB."""
    uri = page.evaluate(
        """id => { const from = document.getElementById(id);
                  const to = document.createElement('canvas');
                  [to.width, to.height] = [from.width, from.height];
                  to.getContext('2d', { willReadFrequently: true }).drawImage(from, 0, 0);
                  return to.toDataURL('image/png'); }""",
        canvas,
    )
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]


def read(page):
    """Return the rows under the cursor."""
    cells = "r => [...r.children].map(c => c.textContent)"
    return page.evaluate(f"[...document.querySelectorAll('#values tr')].map({cells})")


def slide(page, value):
    page.evaluate("v => { slider.value = v; slider.dispatchEvent(new Event('input')); }", value)


def test_the_report_opens_with_its_charts(chromium, study_file):
    with opened(chromium, study_file) as page:
        assert page.locator(".js-plotly-plot").count() == 4
        assert page.locator("#chart-e4 .bars path").count() >= 20
        assert page.locator("#chart-time .points path").count() >= 12
        names = page.locator("#chart-e4 .legendtext").all_text_contents()
        assert names == ["published", "measured here, scenes"]
        before = page.evaluate("document.getElementById('chart-e4').data[1].x")
        page.select_option("#region", "occ fg")
        page.wait_for_selector("body[data-charts='2']")
        assert page.evaluate("document.getElementById('chart-e4').data[1].x") != before
        there = page.evaluate("document.getElementById('chart-e4').data[0]")
        printed = dict(zip(there["y"], there["x"], strict=True))
        assert [printed[f"{method} Mini+Linear"] for method in ("S1", "S2", "S3", "S4")] == [17.6, 9.73, 10.95, 9.56]


def test_the_lines_of_a_disturbance_show_the_chosen_figure(chromium, study_file):
    with opened(chromium, study_file) as page:
        document = json.loads((study_file.parent / "study.json").read_text())
        rows = document["disturbances"]["noise"]["results"]
        chart = "document.getElementById('chart-fault-noise')"
        for count, (figure, title) in enumerate([("epe", "mean error, px"), ("d1", "D1 error, %")], start=2):
            page.select_option("#fault-figure", figure)
            page.wait_for_selector(f"body[data-charts='{count}']")
            drawn = page.evaluate(f"{chart}.data.map(trace => trace.y)")
            assert drawn == [[row["undisturbed"][figure], *row["figures"][figure]] for row in rows]
            assert page.evaluate(f"{chart}.layout.yaxis.title.text") == title
        page.select_option("#region", "occ all")  # which is not theirs
        page.wait_for_selector("body[data-charts='4']")
        assert page.evaluate(f"{chart}.data.map(trace => trace.y)") == drawn


@pytest.mark.parametrize("size", list(SIZES))
def test_labels_of_the_charts_do_not_collide(chromium, study_file, size):
    with opened(chromium, study_file, size) as page:
        boxes = page.evaluate(
            """() => [
                ...document.querySelectorAll('#chart-time .annotation-text-g text, #chart-e4 .ytick text')].map(e => {
                const b = e.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })"""
        )
        assert len(boxes) >= 20
        for p, q in itertools.combinations(boxes, 2):
            across, down = (min(p[k + 2], q[k + 2]) - max(p[k], q[k]) for k in (0, 1))
            assert across <= 1 or down <= 1, (p, q)


def test_labels_find_the_nearest_free_place(chromium, study_file):
    with opened(chromium, study_file) as page:
        place = "([points, size]) => Labels.place(points, size).map(p => p && [p.dx, p.dy, p.far])"
        label = {"width": 20, "height": 10}
        one = page.evaluate(place, [[{"x": 50, "y": 50, **label}], [100, 100]])
        assert one == [[0, -14, False]]  # above it
        top = page.evaluate(place, [[{"x": 50, "y": 9, **label}], [100, 100]])
        assert top == [[20, 0, False]]  # no room above: to the right
        heap = page.evaluate(place, [[{"x": 50, "y": 50, **label}] * 40, [100, 100]])
        boxes = [(dx - 10, dy - 5, dx + 10, dy + 5) for dx, dy, _ in filter(None, heap)]
        assert 8 <= len(boxes) < 40 and heap[-1] is None  # what has no place is left out
        for p, q in itertools.combinations(boxes, 2):
            assert p[0] >= q[2] or q[0] >= p[2] or p[1] >= q[3] or q[1] >= p[3]


def test_where_a_loses_to_b(chromium, study_file):
    with opened(chromium, study_file) as page:
        table = json.loads(page.locator("#per-pair").text_content())
        a, b = table["methods"][0], table["methods"][3]
        page.select_option("#pairs-a", a)
        page.select_option("#pairs-b", b)
        first, second = (table["measures"]["D1 noc, %"][k] for k in (0, 3))
        expected = sorted(zip(table["frames"], first, second, strict=True), key=lambda row: row[2] - row[1])
        rows = page.evaluate(
            "[...document.querySelectorAll('#pairs-rows tr')].map(r => [...r.children].map(c => c.textContent))"
        )
        assert [row[0] for row in rows] == [name for name, *_ in expected]
        assert [float(row[3]) for row in rows] == [pytest.approx(p - q, abs=0.006) for _, p, q in expected]
        worse = sum(p > q for _, p, q in expected)
        assert f"{a} is worse than {b} on {worse}," in page.locator("#pairs-sum").text_content()
        page.locator("#table-pairs thead th button").first.click()
        assert page.locator("#pairs-rows td:first-child").all_text_contents() == sorted(table["frames"])
        page.locator("#pairs-rows button").nth(2).click()
        page.wait_for_function("document.getElementById('viewer').dataset.ready !== '1'")
        chosen = [page.locator(f"#{name}").input_value() for name in ("method-a", "method-b")]
        assert chosen == [a, b]
        assert page.locator("#frame option:checked").text_content().strip() == sorted(table["frames"])[2]


def test_tables_sort_both_ways_by_mouse_and_keyboard(chromium, study_file):
    with opened(chromium, study_file) as page:
        head = page.locator("#table-accuracy thead th").nth(2)

        def column():
            cells = page.locator("#table-accuracy tbody tr td:nth-child(3)").all_text_contents()
            return [float(text) for text in cells]

        head.locator("button").click()
        assert column() == sorted(column()) and head.get_attribute("aria-sort") == "ascending"
        head.locator("button").press("Enter")
        assert column() == sorted(column(), reverse=True) and head.get_attribute("aria-sort") == "descending"
        page.locator("#table-systems thead th").nth(2).locator("button").click()
        texts = page.locator("#table-systems tbody tr td:nth-child(3)").all_text_contents()
        known = [text for text in texts if text != NONE]
        assert 0 < len(known) < len(texts)
        assert texts == sorted(known, key=float) + [NONE] * (len(texts) - len(known))  # what has no figure stays last


def test_the_slider_moves_between_methods(chromium, study_file):
    with opened(chromium, study_file) as page:
        pictures = []
        for value in (0, 50, 100):
            slide(page, value)
            pictures.append(pixels(page, "view-disparity"))
        b, both, a = pictures
        assert (a != b).any()
        half = a.shape[1] // 2
        assert (both[:60, : half - 8] == a[:60, : half - 8]).all()
        assert (both[:60, half + 8 :] == b[:60, half + 8 :]).all()
        page.locator("#slider").focus()
        page.keyboard.press("ArrowLeft")
        assert page.locator("#slider").input_value() == "99"
        page.locator("#flip").click()
        assert page.locator("#slider").input_value() == "0"


def test_frames_and_methods_change_the_picture(chromium, study_file):
    with opened(chromium, study_file) as page:
        first = pixels(page, "view-left")
        page.locator("#next").click()
        page.wait_for_selector("#viewer[data-ready='2']")
        assert (pixels(page, "view-left") != first).any() and page.locator("#previous").is_enabled()
        slide(page, 100)
        before = pixels(page, "view-error")
        page.select_option("#method-a", index=0)
        page.wait_for_selector("#viewer[data-ready='3']")
        assert (pixels(page, "view-error") != before).any()


def test_hovering_tells_disparity_error_and_depth(chromium, view_file):
    with opened(chromium, view_file) as page:
        page.evaluate("document.getElementById('view-disparity').scrollIntoView({behavior: 'instant'})")
        box = page.locator("#view-disparity").bounding_box()

        def point(x, y):
            page.mouse.move(box["x"] + (x + 0.5) / 120 * box["width"], box["y"] + (y + 0.5) / 40 * box["height"])
            assert page.locator("#position").text_content() == f"x {x}, y {y}"
            return {row[0]: row[1:] for row in read(page)}

        rows = point(50, 5)
        assert rows["ten"] == ["10.00 px", "5.00 m", "0.00 px", ""]
        assert rows["twelve"] == ["12.50 px", "4.00 m", "2.50 px", ""]
        assert rows["true"] == ["10.00 px", "5.00 m", "", ""]
        rows = point(110, 30)
        assert rows["ten"] == ["10.00 px", "5.00 m", "6.00 px ✗", ""]
        assert rows["true"][3] == "occluded"
        assert point(5, 5)["ten"][3] == "filled"


def test_the_keyboard_moves_the_cursor_and_turns_the_cloud(chromium, view_file):
    with opened(chromium, view_file) as page:
        page.locator("#view-left").focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Shift+ArrowUp")
        assert page.locator("#position").text_content() == "x 61, y 10"
        page.select_option("#zoom", "4")
        page.keyboard.press("ArrowLeft")
        cloud = page.locator("#view-cloud")
        assert int(cloud.get_attribute("data-points")) == 40 * 100  # measured points only
        before = pixels(page, "view-cloud")
        cloud.focus()
        page.keyboard.press("ArrowRight")
        assert (pixels(page, "view-cloud") != before).any()
        assert "metres" in page.locator("#cloud-unit").text_content()
        page.locator("#cloud-toggle").click()
        assert cloud.is_hidden()


def test_errors_have_the_colours_of_the_benchmark(chromium, view_file):
    from stereokit_evaluation.scoring.error_map import error_map

    with opened(chromium, view_file) as page:
        slide(page, 100)
        pair, maps = small_pair()
        truth = np.full((40, 120), 10, np.float32)
        truth[:, 100:] = 16
        visible = truth.copy()
        visible[20:] = np.nan
        expected = error_map(maps[0].disparity, truth, visible, dilate=False)
        drawn = pixels(page, "view-error")
        away = np.ones((40, 120), bool)
        away[6:34, 45:75] = False  # the cross of the cursor
        assert (drawn == expected)[away].all()
        assert pair["top"] == 16


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", list(SIZES))
def test_every_size_and_theme(chromium, study_file, size, scheme):
    with opened(chromium, study_file, size, scheme) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
        paper = "getComputedStyle(document.body).backgroundColor"
        before = page.evaluate(paper)
        assert (before == "rgb(255, 255, 255)") == (scheme == "light")
        page.locator("#theme").click()
        assert page.evaluate(paper) != before
        page.locator("#theme").click()
        assert page.evaluate(paper) == before


def test_everything_has_a_name(chromium, study_file):
    """Every control has a label, every table a caption, every picture a description, and headings do not jump."""
    with opened(chromium, study_file) as page:
        lacking = page.evaluate(
            """() => [...document.querySelectorAll('button, select, input, canvas, table, [role=img]')].filter(e =>
                !(e.getAttribute('aria-label') || e.labels?.length || e.querySelector('caption') ||
                  e.textContent.trim() && e.tagName === 'BUTTON' || e.closest('.readout'))).map(e => e.outerHTML)"""
        )
        assert lacking == []
        levels = page.evaluate("[...document.querySelectorAll('h1, h2, h3')].map(e => Number(e.tagName[1]))")
        assert levels[0] == 1 and all(b - a <= 1 for a, b in itertools.pairwise(levels))
        assert page.evaluate("document.documentElement.lang") == "en"
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.className") == "skip"


def test_a_pair_without_truth_and_calibration(chromium, tmp_path):
    shown = viewer.MethodMap("only", np.full((40, 120), 8, np.float32), np.ones((40, 120), bool))
    pair = viewer.pair("bare", np.zeros((40, 120), np.uint8), [shown])
    path = write_page(tmp_path / "bare.html", [pair], ["only", "only"])
    with opened(chromium, path, "phone") as page:
        for name in ("view-error", "view-right", "view-difference", "view-disparity-b", "slider"):
            assert page.locator(f"#{name}").is_hidden(), name
        assert read(page) == [["only", "8.00 px", NONE, ""]]
        assert "in pixels" in page.locator("#cloud-unit").text_content()
        assert json.loads(page.locator("#pair-0").text_content())["calibration"] is None


def test_two_methods_side_by_side_with_their_difference(chromium, view_file):
    with opened(chromium, view_file) as page:
        assert page.locator("#view-difference").is_visible() and page.locator("#view-disparity-b").is_hidden()
        page.select_option("#layout", "side")
        page.wait_for_selector("#viewer[data-ready='2']")
        assert page.locator("#slider").is_hidden()
        a, b = pixels(page, "view-disparity"), pixels(page, "view-disparity-b")
        assert (a[2, 2] != b[2, 2]).any() and (a[2, 2] == a[2, 117]).all()  # each whole, 10 and 12.5 pixels
        scale = json.loads(page.locator("#constants").text_content())["difference"]
        shade = np.array(scale["colours"])
        middle = (len(shade) - 1) / 2

        def colour(change):
            return shade[int(np.floor(middle * (1 + np.clip(change / scale["pixels"], -1, 1)) + 0.5))]

        assert (pixels(page, "view-difference")[2, 2] == colour(10 - 12.5)).all()
        page.select_option("#difference", "error")
        page.wait_for_selector("#viewer[data-ready='3']")
        drawn = pixels(page, "view-difference")
        assert (drawn[2, 2] == colour(0 - 2.5)).all()  # truth is 10: A is right
        assert (drawn[2, 110] == colour(6 - 3.5)).all()  # truth is 16: B is nearer
        assert "A nearer" in page.locator("#difference-low").text_content()


def test_the_right_image_has_the_same_point(chromium, view_file):
    with opened(chromium, view_file) as page:
        image = np.tile(np.arange(120)[::-1], (40, 1))
        drawn = pixels(page, "view-right")[..., 0].astype(int)
        marked = np.abs(drawn - image) > 12
        columns = np.flatnonzero(marked.any(axis=0))
        assert abs((columns.min() + columns.max()) / 2 - 50) < 2  # the cursor is at 60, and A says 10 pixels


def test_the_read_out_covers_nothing_on_a_phone(chromium, view_file):
    with opened(chromium, view_file, "phone") as page:
        for name in ("view-left", "view-error"):
            page.locator(f"#{name}").click()
            below = page.evaluate(
                "document.getElementById('readout').previousElementSibling.querySelector('canvas').id"
            )
            assert below == name
            boxes = page.evaluate(
                """() => [...document.querySelectorAll('.views figure:not([hidden]), #readout')].map(e => {
                    const b = e.getBoundingClientRect(); return [b.top, b.bottom]; })"""
            )
            for p, q in itertools.combinations(boxes, 2):
                assert p[1] <= q[0] + 1 or q[1] <= p[0] + 1
        assert page.evaluate("getComputedStyle(document.getElementById('readout')).position") == "static"


def test_tiles_are_read_when_they_are_looked_at(chromium, tmp_path):
    path = tmp_path / "many pairs.html"
    tiles = TileFolder(path)
    pairs = []
    for index in range(12):
        image = np.full((40, 120), 10 * index, np.uint8)
        maps = [
            viewer.MethodMap(f"m{k}", np.full((40, 120), 5 + k, np.float32), np.ones((40, 120), bool)) for k in range(4)
        ]
        pairs.append(tiles.add(viewer.pair(f"pair {index}", image, maps)))
    write_page(path, pairs, ["m0", "m1"])
    requests = []

    def read_files():
        return sorted(url.rpartition("/")[2] for url in requests if url.endswith(".js"))

    with opened(chromium, path, requests=requests) as page:
        assert read_files() == ["pair-0-map-0.js", "pair-0-map-1.js", "pair-0.js"]
        page.select_option("#frame", index=7)
        page.wait_for_selector("#viewer[data-ready='2']")
        page.select_option("#method-a", "m3")
        page.wait_for_selector("#viewer[data-ready='3']")
        new = ["pair-7-map-0.js", "pair-7-map-1.js", "pair-7-map-3.js", "pair-7.js"]
        assert read_files()[3:] == new
        assert read(page)[0][:2] == ["m3", "8.00 px"]
        for index in range(12):  # what was looked at is not kept for ever
            page.evaluate("i => Viewer.show(i, 'm0', 'm1')", index)
        assert page.evaluate("Viewer.kept()") <= 6


def test_a_page_without_its_folder_says_so(chromium, tmp_path):
    path = tmp_path / "alone.html"
    shown = viewer.MethodMap("m", np.full((40, 120), 5, np.float32), np.ones((40, 120), bool))
    pair = TileFolder(path).add(viewer.pair("p", np.zeros((40, 120), np.uint8), [shown]))
    shutil.rmtree(tmp_path / "alone_files")
    write_page(path, [pair], ["m", "m"])
    context = chromium.new_context(offline=True)
    page = context.new_page()
    page.goto(path.as_uri())
    page.wait_for_selector("#trouble:not([hidden])", timeout=1000 * HANG_S)
    assert "needs the folder beside it" in page.locator("#trouble").text_content()
    context.close()
