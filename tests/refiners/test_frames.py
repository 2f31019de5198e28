"""Samples of real frames for the evidence refiner: what is known of them, and that they are the same each time."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from stereokit_refiners.training import evidence, frames  # noqa: E402
from stereokit_refiners.training.samples import Pair  # noqa: E402


def _frame(*, noc=True, shift=8, rows=96, columns=192):
    """Return a textured pair of one disparity whose truth is known on every fourth row."""
    rng = np.random.default_rng(0)
    right = cv2.GaussianBlur(rng.integers(0, 256, (rows, columns)).astype(np.uint8), (0, 0), 1.0)
    truth = np.full((rows, columns), np.nan, np.float32)
    truth[::4] = shift
    seen = truth.copy()
    seen[:, :shift] = np.nan
    return Pair("a", np.roll(right, shift, 1), right, seen if noc else np.full_like(truth, np.nan), truth)


def _plane(fields, name):
    """Return a stored field as pixels."""
    blocks = fields[name]
    height, width, _ = blocks.shape
    return blocks.reshape(height, width, 4, 4).transpose(0, 2, 1, 3).reshape(4 * height, 4 * width)


@pytest.mark.parametrize("noc", [True, False])
def test_number_0_is_the_frame_as_it_is(noc):
    fields = evidence.unpacked(frames.frame_sample(_frame(noc=noc), "S2", 0, 0, 32))
    kind, miss = _plane(fields, "kind"), _plane(fields, "miss").astype(float)
    expected = np.zeros((96, 192), np.uint8)
    expected[::4] = 2
    if noc:
        expected[::4, 8:] = 1
    np.testing.assert_array_equal(kind, expected)
    assert (miss[kind == 0] == 0).all()
    assert np.median(np.abs(miss[::4, 40:])) < 0.3


def test_other_numbers_are_other_pairs_and_the_same_each_time():
    frame = _frame()
    first = frames.frame_sample(frame, "S2", 0, 1, 32)
    np.testing.assert_array_equal(first, frames.frame_sample(frame, "S2", 0, 1, 32))
    for others in (("S1", 0, 1), ("S2", 1, 1), ("S2", 0, 2)):
        other = frames.frame_sample(frame, *others, 32)
        assert other.shape != first.shape or (other != first).any()


def test_scales_are_half_mostly(monkeypatch):
    asked = []

    def make_sample(left, right, truth, seen, method, scale, **options):
        asked.append((scale, left.shape, options))
        return np.zeros((1, 1, 1), np.uint8), 0.0

    monkeypatch.setattr(evidence, "make_sample", make_sample)
    frame = _frame()
    for number in range(120):
        frames.frame_sample(frame, "S4", 0, number, 64)
    scales = [scale for scale, *_ in asked]
    assert asked[0][:2] == (0.5, (96, 192)) and set(scales) == {1.0, 0.5, 0.25}
    assert 60 < scales.count(0.5) < 108
    assert len({size for _, size, _ in asked}) > 60
    assert all(options["max_disparity"] == 64 for *_, options in asked)
    assert all((len(options) > 1) == (scale == 0.5 and k > 0) for k, (scale, _, options) in enumerate(asked))


def test_a_sample_is_stored_once_under_all_that_it_depends_on(tmp_path, monkeypatch):
    frame = _frame()
    path = frames.store_frame(frame, "S2", 0, 0, 32, tmp_path)
    np.testing.assert_array_equal(np.load(path), frames.frame_sample(frame, "S2", 0, 0, 32))
    monkeypatch.setattr(frames, "frame_sample", lambda *arguments: np.zeros(arguments[3], np.uint8))
    assert frames.store_frame(frame, "S2", 0, 0, 32, tmp_path) == path
    others = [("S1", 0, 0, 32), ("S2", 1, 0, 32), ("S2", 0, 1, 32), ("S2", 0, 0, 64)]
    paths = {frames.store_frame(frame, *other, tmp_path) for other in others}
    paths.add(frames.store_frame(_frame(shift=9), "S2", 0, 0, 32, tmp_path))
    assert len(paths) == 5 and path not in paths
    assert {file for file in tmp_path.iterdir()} == {path, *paths}


def test_a_frame_without_any_truth_has_no_known_pixel():
    frame = _frame()
    nothing = np.full_like(frame.occ, np.nan)
    record = frames.frame_sample(Pair("a", frame.left, frame.right, nothing, nothing), "S2", 0, 0, 32)
    assert (evidence.unpacked(record)["kind"] == 0).all()
