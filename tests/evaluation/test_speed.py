"""The bench: statistics and ratios by hand numbers, the command at a tiny size. No test asserts a speed."""

from __future__ import annotations

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stereokit import matching
from stereokit.cli.app import app
from stereokit.errors import OptionError, StereokitError, UnknownNameError
from stereokit.kernels.trace import observed, span
from stereokit_evaluation.bench import baselines
from stereokit_evaluation.bench import table as speed_table
from stereokit_evaluation.bench.probes import ProbeError, first_call, image_files, memory_added
from stereokit_evaluation.bench.stages import OTHER, TOTAL, StageTimer, stage_times
from stereokit_evaluation.bench.table import BenchResult, as_json, print_tables
from stereokit_evaluation.bench.timing import ratio, round_robin, spread
from stereokit_evaluation.commands import bench as command
from stereokit_evaluation.common import progress as progress_module
from stereokit_evaluation.common.sizes import SIZES, Size, parse_sizes, parse_threads

TINY = "64x48x16"


def bench(*words):
    return CliRunner().invoke(app, ["bench", *map(str, words)])


@pytest.fixture
def one_peer(monkeypatch):
    monkeypatch.setattr(command, "baselines", lambda: [baselines.THREE_WAY])


# sizes and threads


def test_sizes_are_those_of_the_bars():
    k, m, h = parse_sizes("K,m, H")
    assert (k.width, k.height, k.levels) == (1242, 375, 128)
    assert (m.width, m.height, m.levels) == (1342, 1110, 256)
    assert (h.width, h.height, h.levels) == (621, 188, 64)
    assert h.cells == 621 * 188 * 64


def test_free_sizes_and_repeats():
    assert parse_sizes("4000X3000x256,K,4000x3000x256") == [
        Size("4000x3000x256", 4000, 3000, 256),
        SIZES["K"],
    ]


@pytest.mark.parametrize(
    "text",
    ["", "Q", "K,", "64x48", "64x48x16x2", "-64x48x16", "0x48x16", "64x0x16", "64x48x1", "64x48x64", "9999x9x2049"],
)
def test_bad_sizes_are_refused(text):
    with pytest.raises(OptionError, match="sizes must be"):
        parse_sizes(text)


def test_threads():
    assert parse_threads("2, 1,2") == [2, 1]
    for text in ("", "0", "-1", "1.5", "1,,2", "two", "99999"):
        with pytest.raises(OptionError, match="threads must be whole numbers"):
            parse_threads(text)


# statistics


def test_round_robin_takes_turns_and_times_with_its_clock():
    now = 0.0
    order = []

    def costs(name, seconds):
        def call():
            nonlocal now
            order.append(name)
            now += seconds[len([n for n in order if n == name]) - 1]

        return call

    times, steps = {}, []
    calls = {"a": costs("a", [1, 2, 4]), "b": costs("b", [10, 20, 30]), "c": costs("c", [5])}
    round_robin(calls, 3, times, max_rounds={"c": 1}, clock=lambda: now, step=steps.append)
    assert order == steps == ["a", "b", "c", "a", "b", "a", "b"]
    assert times == {"a": [1, 2, 4], "b": [10, 20, 30], "c": [5]}


def test_round_robin_leaves_what_it_has_when_it_is_stopped():
    times = {}
    runs = iter([None, None, KeyboardInterrupt])

    def call():
        if next(runs) is not None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        round_robin({"a": call, "b": call}, 5, times)
    assert {name: len(seconds) for name, seconds in times.items()} == {"a": 1, "b": 1}


def test_spread_by_hand():
    times = spread([4.0, 1.0, 3.0, 2.0, 10.0])
    assert (times.least, times.q25, times.median, times.q75, times.runs) == (1, 2, 3, 4, 5)
    assert spread([1.0, 2.0]).median == 1.5
    one = spread([7.0])
    assert (one.least, one.q25, one.median, one.q75, one.runs) == (7, 7, 7, 7, 1)
    with pytest.raises(OptionError):
        spread([])


def test_ratio_says_how_many_times_faster():
    assert ratio(spread([30.0]), spread([10.0])) == 3
    assert ratio(spread([5.0]), spread([10.0])) == 0.5
    assert ratio(None, spread([10.0])) is None
    assert ratio(spread([10.0]), None) is None
    assert ratio(spread([10.0]), spread([0.0])) is None


# report


@pytest.fixture
def bench_result():
    """Two threads only; HH 300 ms, 3WAY 20 ms, ours 30 ms: ten times faster than one and slower than the other."""
    size = Size("100x10x50", 100, 10, 50)
    result = BenchResult(methods=["census+sgm"], sizes=[size], threads=[2], rounds=3)
    result.times[size.name, 2] = {
        "census+sgm": [0.03, 0.02, 0.05],
        baselines.HH: [0.3, 0.3, 0.3],
        baselines.THREE_WAY: [0.02, 0.01, 0.03],
    }
    result.memory = {
        (size.name, "census+sgm"): 50.0,
        (size.name, baselines.HH): 200.0,
        (size.name, baselines.THREE_WAY): None,
    }
    result.first, result.first_size = {"census+sgm": {"import_s": 0.5, "call_s": 0.25}}, size.name
    return result


def test_rows_hold_medians_and_ratios(bench_result):
    ours, hh, three_way = bench_result.rows()
    assert ours["contender"] == "S2 census+sgm" and ours["kind"] == "method" and hh["kind"] == "peer"
    assert ours["median_ms"] == pytest.approx(30) and ours["min_ms"] == pytest.approx(20)
    assert (ours["q25_ms"], ours["q75_ms"]) == pytest.approx((25, 40))
    assert ours["x_hh"] == pytest.approx(10) and ours["x_3way"] == pytest.approx(2 / 3)
    assert hh["x_hh"] == three_way["x_3way"] == 1
    assert ours["mde_per_s"] == pytest.approx(50_000 / 0.03 / 1e6)


def test_memory_is_compared_with_hh(bench_result):
    memory = {entry["key"]: entry for entry in as_json(bench_result, {})["memory"]}
    assert memory["census+sgm"]["of_hh"] == 0.25
    assert memory[baselines.THREE_WAY]["mb"] is None and memory[baselines.THREE_WAY]["of_hh"] is None


def test_ratios_need_their_peer(bench_result):
    del bench_result.times["100x10x50", 2][baselines.HH]
    assert bench_result.rows()[0]["x_hh"] is None


def test_tables_publish_losses(bench_result, capsys):
    bench_result.stages["100x10x50", "census+sgm"] = {"smooth": 1.0, OTHER: 0.5, TOTAL: 1.5}
    bench_result.skip(bench_result.sizes[0], "OpenCV HH4", 2, "needs [1] GB")
    bench_result.load = [3.25, 2.0, 1.0]
    print_tables(bench_result)
    text = capsys.readouterr().out
    ours = next(line for line in text.splitlines() if line.startswith(" S2 census+sgm") or "S2 census+sgm  " in line)
    assert "10.00" in ours and "0.67" in ours and "0.25" in ours
    assert "left out: OpenCV HH4, 100x10x50, 2 threads: needs [1] GB" in text
    assert "smooth" in text and "total" in text and "load 3.2 at the start" in text


def test_a_ratio_below_one_stands_out_for_methods_only():
    assert speed_table._times_faster(0.5, "method") == "[bold red]0.50[/]"
    assert speed_table._times_faster(0.5, "peer") == "0.50"
    assert speed_table._times_faster(1.5, "method") == "1.50"
    assert speed_table._times_faster(None, "method") == "-"


# contenders


def test_labels_and_makers():
    assert baselines.label("zncc+sgm") == "S4 zncc+sgm"
    assert baselines.label(baselines.HH) == baselines.HH
    with pytest.raises(UnknownNameError):
        baselines.make("S9", 16, 1)


def test_opencv_takes_the_next_multiple_of_16():
    assert [baselines.usable_levels(levels) for levels in (1, 16, 17, 256)] == [16, 16, 32, 256]


@pytest.mark.parametrize("name", baselines.baselines())
def test_every_peer_finds_a_shift(name):
    rng = np.random.default_rng(0)
    left = cv2.resize(rng.integers(0, 256, (20, 40), np.uint8), (160, 60), interpolation=cv2.INTER_CUBIC)
    disparity = baselines.make(name, 16, 1)(left, np.roll(left, -6, axis=1)).astype(np.float64)
    unit = 16 if name.startswith("OpenCV") else 1
    assert disparity.shape == (60, 160)
    assert np.nanmedian(disparity[:, 40:] / unit) == pytest.approx(6, abs=0.2)


def test_a_peer_that_the_machine_cannot_hold_is_left_out(monkeypatch):
    monkeypatch.setattr(command, "free_nbytes", lambda: 10**9)
    big = Size("big", 4000, 3000, 256)
    assert command._too_large(baselines.HH, big) == "needs 12.3 GB of memory, 1.0 GB are free"
    assert command._too_large(baselines.HH, SIZES["K"]) is None
    assert command._too_large("census+sgm", big) is None
    monkeypatch.setattr(command, "free_nbytes", lambda: 16 * 10**9)
    assert command._too_large(baselines.HH, big) is None


# stages and probes


def test_nested_stages_do_not_count_twice():
    ticks = iter([0.0, 1.0, 4.0, 10.0])  # outer begins, inner begins, inner ends, outer ends
    timer = StageTimer(lambda: next(ticks))
    with observed(timer), span("match", "outer"), span("match", "inner"):
        pass
    assert timer.seconds == {"outer": 7.0, "inner": 3.0}


def test_groups_add_their_stages_up():
    ticks = iter([0.0, 1.0, 4.0, 10.0])
    timer = StageTimer(lambda: next(ticks), groups=True)
    with observed(timer), span("match", "outer"), span("match", "inner"):
        pass
    assert timer.seconds == {"match": 10.0}


def test_spans_outside_of_an_observer_are_seen_by_nobody():
    timer = StageTimer()
    with observed(timer):
        pass
    with span("match", "late"):
        pass
    assert timer.seconds == {}


def test_stages_add_up(random_pair):
    left, right = random_pair(24, 64)
    times = stage_times("census+sgm", 16, left, right, 1)
    assert list(times)[-2:] == [OTHER, TOTAL]
    assert sum(times.values()) == pytest.approx(2 * times[TOTAL])
    assert {"prepare cost", "sweep: first visit", "sweep: last visit", "post-processing"} <= set(times)


def test_stages_of_an_unknown_core_are_other(monkeypatch):
    def plain(method, **options):
        return lambda left, right: None

    monkeypatch.setattr(matching, "Matcher", plain)
    ticks = iter([0.0, 2.0])
    times = stage_times("any", 16, np.zeros(1, np.uint8), np.zeros(1, np.uint8), 1, clock=lambda: next(ticks))
    assert times == {OTHER: 2000.0, TOTAL: 2000.0}


def test_probes_measure_in_new_processes(random_pair):
    with image_files(*random_pair(48, 64)) as files:
        memory = memory_added(baselines.THREE_WAY, 16, 1, files)
        assert memory is None or 0 <= memory < 1000
        first = first_call("census+sgm", 16, 1, files)
        assert set(first) == {"import_s", "call_s"} and min(first.values()) > 0
        with pytest.raises(ProbeError, match=r"first probe: .*no cost named 'nonsense'"):
            first_call("nonsense+sgm", 16, 1, files)


# command


def test_json_has_everything(tmp_path, one_peer):
    target = tmp_path / "command.json"
    threads = cv2.getNumThreads()
    done = bench(
        "--sizes", TINY, "--threads", "1,2", "--method", "S2", "--rounds", 1, "--stages", "--no-first-call",
        "--json", target,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert cv2.getNumThreads() == threads
    assert "S2 census+sgm" in done.stdout and baselines.THREE_WAY in done.stdout and "stages" in done.stdout
    document = json.loads(target.read_text())
    assert list(document) == [
        "results", "memory", "first_call", "stages", "skipped", "sizes", "options", "interrupted",
        "versions", "machine",
    ]  # fmt: skip
    assert [(row["key"], row["threads"], row["runs"]) for row in document["results"]] == [
        ("census+sgm", 1, 1), (baselines.THREE_WAY, 1, 1), ("census+sgm", 2, 1), (baselines.THREE_WAY, 2, 1),
    ]  # fmt: skip
    row = document["results"][0]
    assert row["min_ms"] == row["median_ms"] == row["samples_ms"][0] > 0
    assert row["x_3way"] > 0 and row["x_hh"] is None
    assert document["memory"] == document["first_call"] == document["skipped"] == []
    assert document["stages"][0]["ms"]["total"] > 0
    assert document["stages"][0]["allocated_bytes"] >= 0
    assert document["sizes"][TINY] == {"width": 64, "height": 48, "max_disparity": 16, "opencv_disparities": 16}
    assert document["options"]["threads"] == [1, 2] and document["options"]["images"] == "synthetic"
    assert set(document["versions"]) >= {"stereokit", "numba", "numpy", "opencv", "python"}
    assert document["machine"]["vector_bits"] in (128, 256, 512) and document["machine"]["cpu"]
    assert document["interrupted"] is False


def test_real_images_without_peers_to_standard_output(tmp_path, random_pair):
    for name, image in zip(("l.png", "r.png"), random_pair(96, 128), strict=True):
        assert cv2.imwrite(str(tmp_path / name), image)
    images = "--left", tmp_path / "l.png", "--right", tmp_path / "r.png"
    done = bench(
        "--sizes", TINY, "--threads", 1, "--method", "census+sgm", "--rounds", 2, "--no-peers", "--no-first-call",
        *images, "--json", "-",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert [row["runs"] for row in document["results"]] == [2]
    assert document["options"]["images"] == [str(tmp_path / "l.png"), str(tmp_path / "r.png")]


def test_memory_and_first_call_are_asked_for_where_they_should(monkeypatch, one_peer):
    monkeypatch.setitem(SIZES, "K", Size("K", 80, 24, 16))
    monkeypatch.setitem(SIZES, "H", Size("H", 60, 24, 16))
    monkeypatch.setattr(command, "memory_added", lambda key, levels, threads, files: 2.0 if "+" in key else 4.0)
    firsts = iter([9.0, 1.0, 2.0])
    monkeypatch.setattr(command, "first_call", lambda *arguments: {"import_s": 1.0, "call_s": next(firsts)})
    words = "--sizes", "H,K", "--threads", "2", "--method", "S2", "--rounds", "2", "--json", "-"
    document = json.loads(bench(*words).stdout)
    assert [(entry["size"], entry["mb"]) for entry in document["memory"]] == [("K", 2.0), ("K", 4.0)]
    assert [(entry["size"], entry["call_s"]) for entry in document["first_call"]] == [("K", 1.5)]  # not the first, 9
    document = json.loads(bench(*words, "--memory", "--no-first-call").stdout)
    assert [entry["size"] for entry in document["memory"]] == ["H", "H", "K", "K"]
    assert json.loads(bench(*words, "--no-memory", "--no-first-call").stdout)["memory"] == []


def test_a_probe_that_fails_says_why(monkeypatch, one_peer):
    def fails(*arguments):
        raise ProbeError("out of luck")

    monkeypatch.setattr(command, "memory_added", fails)
    monkeypatch.setattr(command, "first_call", fails)
    words = "--sizes", TINY, "--threads", "1", "--method", "S2", "--rounds", "1", "--memory", "--json", "-"
    document = json.loads(bench(*words).stdout)
    assert document["memory"] == document["first_call"] == []
    assert [skip["reason"] for skip in document["skipped"]] == ["out of luck"] * 3


def stub(monkeypatch, calls):
    """Make the contenders do what the test says."""
    monkeypatch.setattr(command, "make", lambda key, levels, threads: calls[key])


def test_an_interrupt_prints_what_there_is(monkeypatch, one_peer):
    runs = iter([None, None, None, KeyboardInterrupt])

    def peer(left, right):
        if next(runs) is not None:
            raise KeyboardInterrupt

    stub(monkeypatch, {"census+sgm": lambda left, right: None, baselines.THREE_WAY: peer})
    done = bench("--sizes", f"{TINY},K", "--threads", 1, "--method", "S2", "--rounds", 5, "--json", "-")
    assert done.exit_code == 130
    document = json.loads(done.stdout)
    assert document["interrupted"] and [row["runs"] for row in document["results"]] == [3, 2]
    assert "interrupted" in done.stderr


def test_a_peer_that_fails_is_left_out_but_a_method_is_not(monkeypatch, one_peer):
    def fails(left, right):
        raise RuntimeError("two\nlines")

    words = "--sizes", TINY, "--threads", 1, "--method", "S2", "--rounds", 1, "--no-first-call", "--json", "-"
    stub(monkeypatch, {"census+sgm": lambda left, right: None, baselines.THREE_WAY: fails})
    document = json.loads(bench(*words).stdout)
    assert [row["key"] for row in document["results"]] == ["census+sgm"]
    assert document["skipped"] == [
        {"size": TINY, "contender": baselines.THREE_WAY, "threads": 1, "reason": "two lines"}
    ]
    stub(monkeypatch, {"census+sgm": fails, baselines.THREE_WAY: fails})
    assert isinstance(bench(*words).exception, RuntimeError)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--sizes", "Q"), "sizes must be K, M, H or WxHxD such as 640x480x64, with commas, got 'Q'"),
        (("--threads", "0"), "threads must be whole numbers"),
        (("--method", "S9"), "no method named 'S9'"),
        (("--rounds", "0"), "rounds must be at least 1, got 0"),
        (("--left", "l.png"), "left and right go together"),
        (("--left", "none.png", "--right", "none.png"), "none.png"),
        (("--json", "no/such/folder.json"), "json 'no/such/folder.json'"),
        (("--runtimes", "cnn"), "runtimes must come with pipeline, got 'cnn' alone"),
        (
            ("--pipeline", "--runtimes", "linear"),
            "runtimes must be one of cnn, general, pyramid, stereokit, stereovae, got 'linear'",
        ),
    ],
)
def test_bad_input_exits_with_2_and_one_line(words, message, monkeypatch):
    monkeypatch.setattr(command, "_time", lambda *arguments: pytest.fail("it began to work"))
    done = bench(*words)
    assert done.exit_code == 2
    assert done.stderr.startswith("error: ") and message in done.stderr and done.stderr.count("\n") == 1
    assert not done.stdout


def test_pictures_must_match(tmp_path, random_pair):
    for name, shape in (("l.png", (40, 80)), ("r.png", (40, 90))):
        assert cv2.imwrite(str(tmp_path / name), random_pair(*shape)[0])
    done = bench("--left", tmp_path / "l.png", "--right", tmp_path / "r.png")
    assert done.exit_code == 2 and "same size" in done.stderr


def test_progress_is_drawn_between_calls_only(monkeypatch):
    bars = []

    class Bar:
        def __init__(self, *columns, **options):
            bars.append(options)
            self.live = SimpleNamespace(is_started=False)
            self.refreshed = 0

        def add_task(self, *arguments, **options):
            return 0

        update = start = stop = add_task

        def refresh(self):
            self.refreshed += 1
            bars.append(self.refreshed)

    monkeypatch.setattr(progress_module, "Progress", Bar)
    now = iter([0.0, 0.5, 1.5, 1.6])
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: next(now))
    with progress_module.progress(3) as (_, step):
        for _ in range(3):
            step("one")
    assert bars[0]["auto_refresh"] is False
    assert bars[1:] == [1]


def test_scenes_without_scikit_image_say_so(monkeypatch):
    def missing(*arguments):
        raise StereokitError("scikit-image is not installed")

    monkeypatch.setattr(command, "generate", missing)
    done = bench("--sizes", TINY, "--method", "S2")
    assert done.exit_code == 2 and "scikit-image" in done.stderr
