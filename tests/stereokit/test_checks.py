"""Pairs that are not what they should be: one warning, in Python and to who collects it; good pairs have none."""

from __future__ import annotations

import threading
import warnings

import cv2
import numpy as np
import pytest

import stereokit
from stereokit.checks import PairWatch, density_fault, min_density, same_pixels
from stereokit.checks import check_gray as check
from stereokit.errors import StereokitWarning
from stereokit.images.gray import gray_pair
from stereokit.notices import PairWarning, collecting, say, warn
from stereokit.pairs.signs import MapSigns
from stereokit.result import Disparity

NOISE = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 90, (60, 700)), (0, 0), 0.8)
TEXTURE = NOISE.clip(0, 255).astype(np.uint8)
LEFT, RIGHT = TEXTURE[:, 100:400], TEXTURE[:, 112:412]  # disparity 12
OPTIONS = {"max_disparity": 128}


@pytest.fixture
def matcher():
    return stereokit.Matcher("S2", **OPTIONS)


def test_a_good_pair_has_no_warning(matcher):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert matcher(LEFT, RIGHT).density > 0.6
        assert len(list(matcher.map([(LEFT, RIGHT)] * 3))) == 3
        stereokit.warmup("S2", max_disparity=128)


@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        (RIGHT, LEFT, "the views look exchanged"),
        (LEFT, np.roll(RIGHT, 9, axis=0), r"right view lies 9\.\d px lower|right view lies 8\.\d px lower"),
        (LEFT, TEXTURE[:, 250:550], r"outside of 0 \.\. 127, 100 % above"),
        (LEFT, LEFT, "same pixels"),
        (LEFT.astype(np.float32), LEFT.astype(np.float32).copy(), "same pixels"),
    ],
)
def test_a_bad_pair_has_one_warning(matcher, left, right, words):
    with pytest.warns(PairWarning, match=words) as caught:
        matcher(left, right)
    assert len(caught) == 1 and len(str(caught[0].message).splitlines()) == 1
    assert caught[0].filename == __file__  # where the package was called
    with pytest.warns(PairWarning, match=f"{words}|only"):  # its matcher lives on, and looks closely ever more rarely
        stereokit.match(left, right, "S2", **OPTIONS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with collecting() as lines:
            matcher(left, right)
    assert len(lines) == 1


def test_a_matcher_looks_closely_ever_more_rarely(matcher, monkeypatch):
    looked = []
    monkeypatch.setattr("stereokit.checks.check_gray", lambda *_, **__: looked.append(calls) or check(*_, **__))
    for calls in range(1, 10):  # noqa: B007, which `look` reads
        with collecting() as lines:
            matcher(RIGHT, LEFT)
            matcher(LEFT, RIGHT)  # a good one is not looked at
        assert len(lines) == 1
    assert looked == [1, 2, 4, 8]


def test_a_sequence_is_warned_of_once(matcher):
    with pytest.warns(PairWarning, match="pair 1: the views look exchanged") as caught:
        list(matcher.map([(LEFT, RIGHT), (RIGHT, LEFT), (RIGHT, LEFT)]))
    assert len(caught) == 1


@pytest.mark.parametrize(("left", "right", "words"), [(RIGHT, LEFT, "exchanged"), (LEFT, LEFT, "same pixels")])
def test_large_pairs_are_warned_of(left, right, words, tmp_path):
    with pytest.warns(PairWarning, match=words) as caught:
        stereokit.match_large(left, right, tmp_path / "map.npy", "S2", **OPTIONS)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stereokit.match_large(LEFT, RIGHT, tmp_path / "map.npy", "S2", **OPTIONS)


def test_a_large_pair_without_a_usable_pixel_is_called_that(tmp_path):
    nothing = np.full((30, 40), np.nan, np.float32)
    with pytest.warns(PairWarning, match="no pixel is usable") as caught:
        stereokit.match_large(nothing, nothing.copy(), tmp_path / "map.npy", "S2", max_disparity=16)
    assert len(caught) == 1


def test_density_decides():
    assert [min_density(levels) for levels in (2048, 128, 64, 32, 16, 8, 1)] == [0.3, 0.3, 0.35, 0.4, 0.45, 0.45, 0.45]
    for measured, number in ((0, "0.0 %"), (9, "9.0 %"), (34, "34 %"), (35, None), (100, None)):
        valid = (np.arange(100) < measured).reshape(10, 10)
        result = Disparity(np.zeros((10, 10), np.float32), valid)
        fault = density_fault(result.density, -4, 60)
        if number is None:
            assert fault is None
        else:
            assert fault.kind == "density" and f"only {number}" in fault.message and "-4 .. 59" in fault.message


@pytest.mark.parametrize(
    ("shape", "levels", "scale", "due"),
    [
        ((100, 500), 128, 1.0, [1, 1, 1, 1]),
        ((100, 500), 40, 1.0, [1, 0, 0, 1]),
        ((100, 500), 128, 0.5, [1, 0, 0, 0]),
    ],
)
def test_rows_of_small_pairs_are_looked_at_now_and_then(shape, levels, scale, due, monkeypatch):
    """A look costs a quarter of a millisecond: it is due after 6 million cells of matching, and at the first pair."""
    looks = []
    signs = MapSigns(None, 0.0, 0.0, 0.0, 0.0, 0.0)
    monkeypatch.setattr("stereokit.checks.map_signs", lambda *_: looks.append(1) or signs)
    rng = np.random.default_rng(0)
    pair = gray_pair(*(rng.integers(0, 256, shape, np.uint8) for _ in range(2)))
    watch, counts = PairWatch(scale), []
    for _ in due:
        looks.clear()
        assert watch.faults(pair, Disparity(np.zeros(shape, np.float32), np.ones(shape, bool)), 0, levels) == []
        counts.append(len(looks))
    assert counts == due
    bad = Disparity(np.zeros(shape, np.float32), np.zeros(shape, bool))
    assert [fault.kind for fault in watch.faults(pair, bad, 0, levels)] != []  # density is seen at every pair


def test_same_pixels():
    other = LEFT.copy()
    other[-1, -1] ^= 1
    assert same_pixels(LEFT, LEFT.copy()) and not same_pixels(LEFT, other)
    assert not same_pixels(LEFT, LEFT[:, :-1])


def test_warnings_go_to_who_collects_in_this_thread():
    with collecting() as outer:
        warn("one")
        with collecting() as inner:
            warn("two")
            warn("two")
        warn("three")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            thread = threading.Thread(target=warn, args=("of another thread",))
            thread.start()
            thread.join()
    assert (outer, inner) == (["one", "three"], ["two"])
    assert [(str(w.message), w.category) for w in caught] == [("of another thread", StereokitWarning)]
    assert stereokit.PairWarning is PairWarning and issubclass(PairWarning, stereokit.StereokitWarning)


def test_what_takes_long_is_told_to_a_logger_or_a_prompt(monkeypatch, caplog, capsys):
    say("one")
    with caplog.at_level("INFO", "stereokit"):
        say("two")
    monkeypatch.setattr("sys.ps1", ">>> ", raising=False)
    say("three")
    with caplog.at_level("INFO", "stereokit"):
        say("four")
    assert [record.getMessage() for record in caplog.records] == ["two", "four"]
    assert capsys.readouterr().err == "stereokit: three\n"
