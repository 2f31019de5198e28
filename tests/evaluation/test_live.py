"""Live matching: the newest frame, settings that change, and a page for this machine only."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("aiohttp")

from typer.testing import CliRunner

import stereokit
from stereokit.cli.app import app
from stereokit_evaluation.live import source as sources
from stereokit_evaluation.live.engine import Engine
from stereokit_evaluation.live.source import Frame, open_source

SIZE = (48, 96)
SHIFT = 6


def pair_of(number):
    """Return a pair whose plane is at 6 pixels; the grey level of a corner is the frame's number."""
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (SIZE[0], SIZE[1] + SHIFT), np.uint8), (0, 0), 1)
    image[:8, :16] = number
    return np.ascontiguousarray(image[:, :-SHIFT]), np.ascontiguousarray(image[:, SHIFT:])


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Write twenty frames, both views side by side, 20 frames a second."""
    path = tmp_path_factory.mktemp("video") / "both.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20, (2 * SIZE[1], SIZE[0]))
    for number in range(20):
        writer.write(cv2.cvtColor(np.hstack(pair_of(10 * number)), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_what_is_no_video_is_called_that(tmp_path):
    path = tmp_path / "text.png"
    path.write_text("hello")
    with pytest.raises(stereokit.StereokitError, match=r"text\.png' is .*not?.* video that can be read"):
        open_source([str(path)])


class FakeSource:
    """A source of the frames of a list, without delay."""

    def __init__(self, frames):
        self.frames, self.dropped, self.closed = list(frames), 0, False

    def newest(self):
        return self.frames.pop(0) if self.frames and not self.closed else None

    def close(self):
        self.closed = True


def finished(engine):
    engine.start()
    for _ in range(600):
        if engine.ended:
            return engine
        time.sleep(0.05)
    raise AssertionError("the engine did not end")


def test_a_video_plays_at_its_own_speed_and_late_frames_are_dropped(video):
    source = open_source([str(video)])
    first = source.newest()
    assert first.number == 0
    assert first.left.shape == first.right.shape == (*SIZE, 3)
    assert np.abs(first.left.astype(int).mean(2) - pair_of(0)[0]).mean() < 8  # JPEG
    time.sleep(0.32)  # six frames and a half
    late = source.newest()
    assert late.number >= 6
    assert source.dropped == late.number - 1
    assert abs(int(late.left[2, 2, 0]) - 10 * late.number) <= 4  # it is that frame
    numbers = [late.number]
    while (frame := source.newest()) is not None:
        numbers.append(frame.number)
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 19
    source.close_captures()


def test_a_video_may_begin_again(video):
    source = open_source([str(video)], rate=200, repeat=True)
    numbers = [source.newest().number for _ in range(50)]
    assert numbers == sorted(numbers)
    assert numbers[-1] >= 49
    source.close()
    assert source.newest() is None
    source.close_captures()


def test_two_videos_and_folders(video, tmp_path):
    for side, name in enumerate(("left", "right")):
        (tmp_path / name).mkdir()
        for number in range(3):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), pair_of(50 + number)[side])
    for inputs in ([tmp_path], [tmp_path / "left", tmp_path / "right"]):
        source = open_source([str(path) for path in inputs], rate=200)
        frames = []
        while (frame := source.newest()) is not None:
            frames.append(frame)
        assert frames[-1].number == 2
        assert np.array_equal(frames[-1].right, pair_of(52)[1])
        assert len(frames) + source.dropped == 3


def test_cameras_are_grabbed_together(monkeypatch):
    """No camera is at hand: a stand-in counts what is asked of it."""
    calls = []

    class Camera:
        def __init__(self, number):
            self.number, self.frames = number, 3

        def isOpened(self):
            return self.number < 2

        def set(self, name, value):
            calls.append((self.number, "set"))

        def grab(self):
            calls.append((self.number, "grab"))
            self.frames -= 1
            return self.frames >= 0

        def retrieve(self):
            calls.append((self.number, "retrieve"))
            return True, np.full((4, 6, 3), (0, 0, 200 + self.number), np.uint8)

        def release(self):
            calls.append((self.number, "release"))

    monkeypatch.setattr(sources.cv2, "VideoCapture", Camera)
    source = open_source(["0", "1"])
    calls.clear()
    frame = source.newest()
    assert calls == [(0, "grab"), (1, "grab"), (0, "retrieve"), (1, "retrieve")]
    assert (frame.left[0, 0, 0], frame.right[0, 0, 0]) == (200, 201)  # RGB
    assert open_source(["0"]).newest().left.shape == (4, 3, 3)
    source.newest(), source.newest()
    with pytest.raises(stereokit.InputError, match="no more frames"):
        source.newest()
    calls.clear()
    with pytest.raises(stereokit.InputError, match="camera 2 cannot be opened"):
        open_source(["1", "2"])
    assert (1, "release") in calls


@pytest.mark.parametrize(
    ("inputs", "options", "line"),
    [
        ([], {}, "one or two sources, got 0"),
        (["a", "b", "c"], {}, "got 3"),
        (["/no/such"], {}, "no such camera number, video or folder: '/no/such'"),
        (["0"], {"rate": 0.0}, "--fps must be from 0.1 to 240, got 0"),
        ([str(Path(__file__).parent), __file__], {}, "a folder and a file"),
        ([__file__], {}, "video"),
    ],
)
def test_sources_that_cannot_be(inputs, options, line):
    with pytest.raises(stereokit.StereokitError, match=line):
        open_source(inputs, **options)


def test_the_engine_matches_what_a_matcher_matches():
    camera = stereokit.Calibration(fx=100.0, fy=100.0, cx0=48.0, cy=24.0, baseline_m=0.12)
    engine = finished(Engine(FakeSource([Frame(3, *pair_of(30))]), camera, max_disparity=32, fill=None))
    expected = stereokit.Matcher(max_disparity=32, confidence=True, fill=None)(*pair_of(30))
    assert np.array_equal(engine.view.result.disparity, expected.disparity, equal_nan=True)
    at = engine.at(60, 30)
    assert abs(at["disparity"] - SHIFT) < 0.1
    assert at["depth"] == pytest.approx(100 * 0.12 / at["disparity"], rel=1e-5)
    assert at["measured"] is True
    assert 0 < at["confidence"] <= 1
    with pytest.raises(stereokit.OptionError, match="96x48 pixels, got 96 and 0"):
        engine.at(96, 0)
    picture = cv2.imdecode(np.frombuffer(engine.view.disparity, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (*SIZE, 3)
    assert json.dumps(engine.state(), allow_nan=False)


def test_settings_change_from_the_next_frame_on_and_wrong_ones_change_nothing():
    gate = threading.Event()

    class Waiting(FakeSource):
        def newest(self):
            frame = super().newest()
            if frame is not None and frame.number == 1:
                gate.wait(60)
            return frame

    engine = Engine(Waiting([Frame(0, *pair_of(0)), Frame(1, *pair_of(10))]), max_disparity=32)
    with pytest.raises(stereokit.OptionError, match=r"settings that can change are .* got 'threads'"):
        engine.change(threads=2)
    for wrong in ({"max_disparity": -5}, {"method": "S9"}, {"confidence": 2.0}, {"refiner": "nobody"}):
        with pytest.raises(stereokit.OptionError):
            engine.change(**wrong)
    assert engine.settings["max_disparity"] == 32
    engine.start()
    while engine.view is None:
        time.sleep(0.02)
    engine.change(max_disparity=4, confidence=0.5)
    gate.set()
    while not engine.ended:
        time.sleep(0.02)
    assert engine.view.frame.number == 1
    assert engine.view.result.disparity.max() < 5
    colours = cv2.imdecode(np.frombuffer(engine.view.disparity, np.uint8), cv2.IMREAD_COLOR)
    sure = (engine.view.result.confidence >= 0.5) & engine.view.result.valid
    assert 0.05 < sure.mean() < 0.95
    assert np.mean((colours.max(2) > 40) != sure) < 0.1  # JPEG blurs
    engine.close()


def test_a_frame_that_cannot_be_matched_is_told_and_passed_over():
    left, right = pair_of(0)
    engine = finished(Engine(FakeSource([Frame(0, left, right[:-1]), Frame(1, left, right)]), max_disparity=32))
    assert engine.view.frame.number == 1
    assert engine.message == ""
    engine = finished(Engine(FakeSource([Frame(0, left, right[:-1])]), max_disparity=32))
    assert "same size" in engine.message


class Server:
    """The command as a user starts it, and its page."""

    def __init__(self, *arguments):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "stereokit.cli", "live", *map(str, arguments), "--port", "0"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        line = self.process.stdout.readline()
        self.address = re.match(r"http://127\.0\.0\.1:(\d+)/", line)
        assert self.address, line + self.process.stderr.read()
        self.port = int(self.address[1])

    def ask(self, path, method="GET", body=None, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request(method, path, body, headers={name.replace("_", "-"): text for name, text in headers.items()})
        with connection.getresponse() as response:
            status, content = response.status, response.read()
        connection.close()
        return status, content

    def end(self):
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err


@pytest.fixture(scope="module")
def server(video):
    running = Server(video, "--max-disparity", 32, "--loop")
    for _ in range(1200):
        if json.loads(running.ask("/state")[1])["number"] is not None:
            break
        time.sleep(0.05)
    yield running
    if running.process.poll() is None:
        code, out, err = running.end()
        assert (code, err) == (0, "")
        assert "dropped" in out


def test_the_page_answers_this_machine_only(server):
    assert server.ask("/")[0] == 200
    assert server.ask("/", Host=f"localhost:{server.port}")[0] == 200
    for host in ("evil.example", f"evil.example:{server.port}", "127.0.0.1", f"127.0.0.1:{server.port + 1}"):
        assert server.ask("/state", Host=host)[0] == 403
    good = json.dumps({"confidence": 0.1})
    headers = {"Content_Type": "application/json"}
    assert server.ask("/settings", "POST", good, Origin="http://evil.example", **headers)[0] == 403
    assert server.ask("/settings", "POST", good, Origin=f"http://127.0.0.1:{server.port}", **headers)[0] == 200
    addresses = (
        {line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]} if os.name == "posix" else ()
    )
    assert f"00000000:{server.port:04X}" not in addresses  # on no other address


def test_settings_come_as_json_and_what_is_wrong_is_one_line(server):
    headers = {"Content_Type": "application/json"}
    status, body = server.ask("/settings", "POST", json.dumps({"max_disparity": 40}), **headers)
    assert (status, json.loads(body)["max_disparity"]) == (200, 40)
    for content, kind in (("[]", "application/json"), ("{", "application/json"), ("{}", "text/plain")):
        assert server.ask("/settings", "POST", content, Content_Type=kind)[0] == 400
    status, body = server.ask("/settings", "POST", json.dumps({"max_disparity": "x"}), **headers)
    assert status == 400
    assert "max_disparity" in json.loads(body)["error"]
    assert server.ask("/settings", "POST", "1" * 5000, **headers)[0] == 413
    assert server.ask("/value?x=a&y=1")[0] == 400
    assert json.loads(server.ask("/value?x=1000&y=1")[1])["error"].startswith("x and y must lie")


def test_pictures_come_as_they_are_made(server):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.request("GET", "/left.mjpg")
    response = connection.getresponse()
    assert response.getheader("Content-Type").startswith("multipart/x-mixed-replace")
    levels = []
    assert response.readline() == b"--frame\r\n"
    for _ in range(4):
        assert response.readline() == b"Content-Type: image/jpeg\r\n"
        length = int(response.readline().split()[1])
        response.readline()
        image = cv2.imdecode(np.frombuffer(response.read(length), np.uint8), cv2.IMREAD_COLOR)
        assert (response.readline(), response.readline()) == (b"\r\n", b"--frame\r\n")  # at once, not with the next
        assert image.shape == (*SIZE, 3)
        levels.append(int(image[2, 2, 0]))
    assert len(set(levels)) > 1
    response.close()
    connection.close()


def test_the_page_in_a_browser(server):
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = next((p for p in ("/usr/bin/chromium", "/usr/bin/chromium-browser") if Path(p).exists()), None)
    if chromium is None:
        pytest.skip("Chromium is not installed")
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=chromium,
            args=["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"],
        )
        page = browser.new_page(viewport={"width": 390, "height": 800}, bypass_csp=True)  # waiting evaluates text
        errors = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(f"http://127.0.0.1:{server.port}/", wait_until="domcontentloaded")
        page.wait_for_function("document.getElementById('fps').textContent.includes('frames a second')", polling=100)
        page.wait_for_function("document.getElementById('disparity').naturalWidth === 96", polling=100)
        page.locator("#disparity").hover(position={"x": 200, "y": 100})
        page.wait_for_function("document.getElementById('value').textContent.includes('px')", polling=100)
        text = page.locator("#value").text_content()
        assert abs(float(re.search(r": (-?[\d.]+) px", text)[1]) - SHIFT) < 1
        page.evaluate(
            "() => { const field = document.forms[0].max_disparity; field.value = 64;"
            " for (const name of ['input', 'change']) field.dispatchEvent(new Event(name, {bubbles: true})); }"
        )
        page.wait_for_function(
            "fetch('state').then(r => r.json()).then(s => s.settings.max_disparity === 64)", polling=100
        )
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        assert errors == []
        browser.close()


def test_the_command_ends_with_its_source(video):
    done = Server(video, "--max-disparity", 16, "--until-end")
    out, err = done.process.communicate(timeout=300)
    assert (done.process.returncode, err) == (0, "")
    matched, dropped = map(int, re.search(r"(\d+) frames matched, (\d+) dropped", out).groups())
    assert matched >= 1
    assert matched + dropped == 20


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["/no/such"], "no such camera number, video or folder"),
        (["{video}", "--port", "99999"], "--port must be from 0 to 65535, got 99999"),
        (["{video}", "--method", "S9"], "S9"),
        (["{video}", "--set", "nothing=1"], "nothing"),
    ],
)
def test_wrong_commands_end_with_one_line_and_2(video, arguments, line):
    result = CliRunner().invoke(app, ["live", *(text.format(video=video) for text in arguments)])
    assert result.exit_code == 2
    assert line in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_a_port_that_is_taken_is_one_line(server, video):
    result = CliRunner().invoke(app, ["live", str(video), "--port", str(server.port)])
    assert result.exit_code == 2
    assert f"port {server.port} cannot be had" in result.output
