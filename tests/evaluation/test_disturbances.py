"""Controlled faults of a camera pair: by hand, the same each time, and their table in the study."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from stereokit.errors import InputError, OptionError, UnknownNameError
from stereokit.io import write_disparity
from stereokit_evaluation.commands.study import study
from stereokit_evaluation.data.disturbed import disturbed
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.study.store import frame_digest
from stereokit_evaluation.synthetic.disturbances import DISTURBANCES, disturb, parse_disturbances

APP = typer.Typer()
APP.command()(study)


def pattern(shape=(40, 60), dtype=np.uint8):
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(120, 150, shape), (0, 0), 2)
    return np.clip(noise, 10, 240).astype(np.uint8).astype(dtype) * (1 if dtype == np.uint8 else 257)


@pytest.mark.parametrize("kind", sorted(DISTURBANCES))
@pytest.mark.parametrize("shape", [(120, 160), (120, 160, 3)])
def test_each_is_the_same_each_time_and_changes_more_with_its_strength(kind, shape):
    image, fault = pattern(shape), DISTURBANCES[kind]
    before = image.copy()
    strengths = sorted(fault.strengths, key=lambda strength: abs(strength - fault.neutral))
    views = [disturb(image, kind, strength, "right", "a") for strength in strengths]
    np.testing.assert_array_equal(image, before)
    for strength, view in zip(strengths, views, strict=True):
        assert view.dtype == np.uint8 and view.shape == shape
        np.testing.assert_array_equal(view, disturb(image, kind, strength, "right", "a"))
    changes = [np.abs(view.astype(float) - image).mean() for view in views]
    assert 0 < changes[0] and (kind in ("gain", "gamma") or changes == sorted(changes))


@pytest.mark.parametrize("kind", sorted(set(DISTURBANCES) - {"jpeg"}))
def test_the_neutral_strength_changes_next_to_nothing(kind):
    image = pattern()
    view = disturb(image, kind, DISTURBANCES[kind].neutral, "right", "a").astype(float)
    if kind == "darkness":  # the sensor's own noise is there in daylight too
        assert np.abs(view - image).mean() < 2
    else:
        np.testing.assert_array_equal(view, image)


def test_the_left_view_keeps_what_only_the_right_suffers():
    image = pattern()
    for kind, fault in DISTURBANCES.items():
        same = np.array_equal(disturb(image, kind, fault.strengths[-1], "left", "a"), image)
        assert same == (fault.views == "right")


def test_noise_and_rain_differ_between_views_and_pairs():
    image = pattern()
    for kind in ("noise", "rain", "darkness"):
        views = [disturb(image, kind, 5, *names) for names in (("left", "a"), ("right", "a"), ("right", "b"))]
        assert not np.array_equal(views[0], views[1]) and not np.array_equal(views[1], views[2])
    for kind in ("blur", "jpeg", "exposure"):
        np.testing.assert_array_equal(disturb(image, kind, 2, "left", "a"), disturb(image, kind, 2, "right", "b"))


def test_strengths_by_hand():
    image = np.full((50, 50), 100, np.uint8)
    assert (disturb(image, "gain", 0.5, "right", "a") == 50).all()
    assert (disturb(image, "gain", 3, "right", "a") == 255).all()  # clipped
    assert (disturb(image, "gamma", 2, "right", "a") == round(255 * (100 / 255) ** 2)).all()
    assert (disturb(image, "exposure", 1, "right", "a") == round(100 * 2 ** (1 / 2.2))).all()
    noisy = disturb(image, "noise", 8, "right", "a").astype(float) - 100
    assert noisy.std() == pytest.approx(8, rel=0.05) and abs(noisy.mean()) < 0.5
    dark = disturb(image, "darkness", 2, "right", "a").astype(float)
    assert dark.mean() == pytest.approx(100 * 2 ** (-2 / 2.2), abs=1)


def test_noise_is_grey_and_as_strong_in_16_bits():
    colour = disturb(np.full((50, 50, 3), 100, np.uint8), "noise", 8, "right", "a")
    grey = disturb(np.full((50, 50), 100, np.uint8), "noise", 8, "right", "a")
    deep = disturb(np.full((50, 50), 100 * 257, np.uint16), "noise", 8, "right", "a")
    assert all(np.array_equal(colour[..., k], grey) for k in range(3))
    assert np.abs(deep / 257 - grey).max() <= 0.51


def test_rows_are_moved_by_the_offset():
    rows = np.repeat(np.arange(50, dtype=np.uint8)[:, None] * 4, 30, axis=1)
    moved = disturb(rows, "offset", 0.5, "right", "a")
    np.testing.assert_array_equal(moved[5:45], rows[5:45] - 2)  # what was at row y is half a row lower
    np.testing.assert_array_equal(disturb(rows, "offset", 2, "right", "a")[5:], rows[3:-2])


def test_rain_covers_about_its_share():
    dark = np.zeros((200, 300), np.uint8)
    for share in (1, 5):
        wet = (disturb(dark, "rain", share, "right", "a") > 60).mean()
        assert 0.4 * share / 100 < wet < 2.5 * share / 100


def test_a_blur_keeps_the_mean_and_loses_contrast():
    image = pattern()
    blurred = disturb(image, "blur", 3, "right", "a").astype(float)
    assert blurred.mean() == pytest.approx(image.mean(), abs=3) and blurred.std() < 0.8 * image.std()


def test_wrong_use_is_one_line():
    with pytest.raises(UnknownNameError, match=r"no disturbance named .nose.*did you mean .noise."):
        disturb(pattern(), "nose", 1, "right", "a")
    with pytest.raises(OptionError, match="jpeg must have strengths from 1 to 100 quality, got 0"):
        disturb(pattern(), "jpeg", 0, "right", "a")
    with pytest.raises(InputError, match="image must be uint8 or uint16 to be disturbed, got float64"):
        disturb(np.zeros((3, 3)), "noise", 1, "right", "a")


def test_strengths_are_read():
    assert parse_disturbances(["offset:0.25, 2,0.25", "jpeg"]) == {"offset": (0.25, 2.0), "jpeg": (80, 50, 20, 10)}
    every = parse_disturbances(["noise:3", "all"])
    assert list(every) == ["noise", *(kind for kind in DISTURBANCES if kind != "noise")] and every["noise"] == (3,)
    with pytest.raises(OptionError, match="disturb must name each kind once, got 'noise' twice"):
        parse_disturbances(["noise", "noise:2"])
    with pytest.raises(OptionError, match="disturb must name a kind with its strengths, got 'all:3'"):
        parse_disturbances(["all:3"])


def test_a_disturbed_frame_has_the_old_truth_and_a_digest_of_its_own(tmp_path):
    for side in ("left", "right"):
        assert cv2.imwrite(str(tmp_path / f"{side}.png"), pattern())
    frame = Frame("a", tmp_path / "left.png", tmp_path / "right.png", occ=lambda: np.ones((40, 60), np.float32))
    wet, wetter, low = (disturbed(frame, *fault) for fault in (("rain", 1), ("rain", 2), ("offset", 1)))
    assert (wet.name, low.name) == ("a rain 1", "a offset 1") and wet.occ is frame.occ
    assert low.left == frame.left and not np.array_equal(low.load_right(), frame.load_right())
    assert not np.array_equal(wet.load_left(gray=True), frame.load_left(gray=True))
    assert len({frame_digest(one) for one in (frame, wet, wetter, low)}) == 4
    assert frame_digest(wet) == frame_digest(disturbed(frame, "rain", 1))


@pytest.fixture
def pairs(tmp_path):
    for part in ("left", "right", "disparity", "maps"):
        (tmp_path / "pairs" / part).mkdir(parents=True)
    for index in range(3):
        left = cv2.GaussianBlur(np.random.default_rng(index).integers(0, 256, (40, 96), dtype=np.uint8), (0, 0), 1)
        for side, image in (("left", left), ("right", np.roll(left, -5, axis=1))):
            assert cv2.imwrite(str(tmp_path / "pairs" / side / f"{index}.png"), image)
        for part in ("disparity", "maps"):
            write_disparity(tmp_path / "pairs" / part / f"{index}.pfm", np.full((40, 96), 5, np.float32))
    return tmp_path / "pairs"


def run(pairs, output, *words):
    fixed = ["--data", f"folder:{pairs}", "-o", output, "--max-disparity", 16, "--threads", 1, "--repeats", 1]
    fixed += ["--no-peers", "--no-report", "--method", "S2", "--variant", "original", "--method", "OpenCV 3WAY"]
    return CliRunner().invoke(APP, [str(word) for word in (*fixed, *words)])


def test_errors_against_strength(pairs, tmp_path):
    words = ("--disturb", "noise:1,90", "--disturb", "offset:3", "--predictions", f"Net={pairs / 'maps'}")
    document = json.loads(run(pairs, tmp_path / "out", *words, "--json", "-").stdout)
    noise, offset = document["disturbances"]["noise"], document["disturbances"]["offset"]
    assert (noise["strengths"], noise["unit"], noise["views"], offset["views"]) == (
        [1, 90], "grey levels", "both", "right",
    )  # fmt: skip
    assert [row["name"] for row in noise["results"]] == ["S2 Original", "OpenCV 3WAY"]  # no maps of disturbed pairs
    for row in (*noise["results"], *offset["results"]):
        clean = next(other for other in document["results"] if other["name"] == row["name"])
        assert row["undisturbed"]["epe"] == clean["figures"]["main"]["epe"]
        assert row["images"] == [3] * len(row["figures"]["d1"])
    mine = noise["results"][0]
    assert mine["figures"]["epe"][0] < mine["figures"]["epe"][1] and mine["figures"]["epe"][1] > 2 * mine[
        "undisturbed"]["epe"]  # fmt: skip
    assert document["data"]["folder"]["disturbances"] == document["disturbances"]
    files = {path.name.split("-")[0] for path in (tmp_path / "out" / "results" / "S2" / "Original").iterdir()}
    assert "0_noise_90" in files
    again = run(pairs, tmp_path / "out", *words)
    assert "noise (white noise; both views): D1 in % by grey levels" in again.stdout
    stored = len(list((tmp_path / "out" / "results").rglob("*.json")))
    assert stored == 3 * 3 + 3 * 3 * 2


def test_a_few_frames_may_be_disturbed(pairs, tmp_path):
    words = ("--disturb", "gain:0.5", "--disturb-frames", 2, "--json", "-")
    document = json.loads(run(pairs, tmp_path / "out", *words).stdout)
    row = document["disturbances"]["gain"]["results"][0]
    assert row["images"] == [2] and document["results"][0]["images"] == 3
    two = [frame for frame in document["results"][0]["frames"] if frame["name"] in ("0", "2")]
    assert row["undisturbed"]["epe"] == pytest.approx(sum(frame["figures"]["epe"] for frame in two) / 2)
