"""One match on many threads: the same bits, however many there are and in whatever order they come."""

import threading
import time
from typing import NamedTuple

import numpy as np
import pytest

from stereokit import Matcher
from stereokit.aggregation.sgm import Sgm
from stereokit.costs.rows import CostInput, Levels, implements
from stereokit.errors import OptionError
from stereokit.images.blur import smooth
from stereokit.images.gray import gray_pair
from stereokit.images.resize import half_size
from stereokit.kernels import threads as workers
from stereokit.kernels.jit import kernel
from stereokit.kernels.spin import WORDS_APART, claim, publish, wait_until
from stereokit.kernels.workspace import Workspace
from stereokit.search import restore_thin
from stereokit.selection.wta import selection_output


@pytest.fixture
def many_workers(monkeypatch):
    """Let 16 threads run at a time, however many processors there are."""
    monkeypatch.setattr(workers, "_workers", workers.Workers(16))


def pair_of(shape, seed=0):
    """Return a textured pair with flat parts, whose disparity changes from place to place."""
    rng = np.random.default_rng(seed)
    height, width = shape
    texture = rng.integers(0, 256, (height, width + 200)).astype(np.uint8)
    texture[height // 3 : height // 2] //= 32
    left, right = texture[:, 100 : 100 + width].copy(), texture[:, 107 : 107 + width].copy()
    right[height // 2 :] = texture[height // 2 :, 140 : 140 + width]
    left[-20:, -40:] = right[-20:, -40:] = 0
    return left, right


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("S1", {}),
        ("S2", {"search": "full"}),
        ("S2", {"search": "coarse-to-fine"}),
        ("S2", {"paths": 8}),
        ("S2", {"paths": 5}),
        ("S3", {}),
        ("S4", {"search": "full"}),
        ("S4", {"search": "coarse-to-fine"}),
        ("S4", {"paths": 8, "search": "full"}),
        ("S2", {"scale": 0.5, "refiner": "stereokit", "backend": "opencv"}),
        ("S4", {"scale": 0.25}),
    ],
    ids=str,
)
def test_any_number_of_threads_gives_the_same_map(many_workers, method, options):
    left, right = pair_of((75, 331))
    expected = Matcher(method, max_disparity=100, threads=1, confidence=True, **options)(left, right)
    for threads in (2, 3, 4, 5, 8, 16):
        result = Matcher(method, max_disparity=100, threads=threads, confidence=True, **options)(left, right)
        for name in ("disparity", "valid", "confidence"):
            np.testing.assert_array_equal(getattr(result, name), getattr(expected, name), f"{name}, {threads} threads")


@pytest.mark.parametrize("shape", [(1, 1), (1, 200), (2, 65), (3, 64), (200, 1), (5, 130)])
@pytest.mark.parametrize("method", ["S2", "S4"])
def test_images_with_fewer_rows_or_columns_than_threads_take(many_workers, method, shape):
    left, right = pair_of((max(shape[0], 3), shape[1]))
    left, right = left[: shape[0]], right[: shape[0]]
    expected = Matcher(method, max_disparity=70, threads=1)(left, right)
    for threads in (3, 16):
        result = Matcher(method, max_disparity=70, threads=threads)(left, right)
        np.testing.assert_array_equal(result.disparity, expected.disparity)


def test_one_matcher_takes_images_of_changing_size_on_many_threads(many_workers):
    one, many = (Matcher("S4", max_disparity=70, threads=threads) for threads in (1, 7))
    for shape in ((40, 300), (40, 200), (13, 300), (40, 300)):
        left, right = pair_of(shape)
        np.testing.assert_array_equal(many(left, right).disparity, one(left, right).disparity)


@pytest.mark.parametrize("shape", [(7, 9), (8, 8), (1, 5), (5, 1), (64, 40)])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("sigma", [0.4, 1.7])
def test_preparation_does_not_depend_on_threads(shape, kind, sigma):
    rng = np.random.default_rng(1)
    left, right = rng.integers(0, np.iinfo(kind).max + 1, (2, *shape)).astype(kind)
    pair = gray_pair(left, right, mask=rng.random(shape) < 0.8)
    for prepare in (half_size, lambda pair, threads: smooth(pair, sigma, threads=threads)):
        one = prepare(pair, threads=1)
        for threads in (2, 5, 16):
            many = prepare(pair, threads=threads)
            for name in ("left", "right", "guide", "left_bad", "right_bad"):
                np.testing.assert_array_equal(getattr(many, name), getattr(one, name))


def test_thin_things_come_back_on_any_number_of_threads():
    rng = np.random.default_rng(2)
    selected = np.where(rng.random((37, 50)) < 0.3, 60, 10).astype(np.float32)
    cleaned = np.full(selected.shape, 10, np.float32)
    one = cleaned.copy()
    restore_thin(selected, one)
    assert 0 < np.count_nonzero(one == 60) < one.size
    for threads in (2, 5, 16):
        many = cleaned.copy()
        restore_thin(selected, many, threads)
        np.testing.assert_array_equal(many, one)


@kernel
def _follow(words, rows, columns, out):
    """Add up along columns, rows being claimed; each block of a row waits for that of the row above."""
    while True:
        row = claim(words, 0)
        if row >= rows:
            break
        for column in range(columns):
            if row > 0:
                wait_until(words, row * WORDS_APART, column + 1)
                out[row, column] = out[row - 1, column] + row
            publish(words, (row + 1) * WORDS_APART, column + 1)


def test_rows_follow_one_another_in_any_thread(many_workers):
    rows, columns = 400, 30
    for threads in (1, 2, 5, 16):
        words, out = np.zeros((rows + 1) * WORDS_APART, np.int64), np.zeros((rows, columns), np.int64)
        workers.run([lambda words=words, out=out: _follow(words, rows, columns, out)] * threads, threads)
        np.testing.assert_array_equal(out, np.repeat(np.arange(rows).cumsum()[:, None], columns, axis=1))
        assert words[0] == rows + threads


def test_who_waits_long_leaves_the_processor_to_others():
    words = np.zeros(1, np.int64)
    wait_until(words, 0, 0)  # compiled
    used = []

    def wait():
        before = time.thread_time()
        wait_until(words, 0, 1)
        used.append(time.thread_time() - before)

    thread = threading.Thread(target=wait)
    began = time.perf_counter()
    thread.start()
    time.sleep(0.5)
    words[0] = 1
    thread.join()
    assert used[0] < 0.5 * (time.perf_counter() - began)


class FailingRows(NamedTuple):
    """Rows of costs of which some cannot be had."""

    left: np.ndarray
    padded: int


@implements(FailingRows)
@kernel
def _failing_row(rows, y, x0, x1, out):
    """Write zeros; fail in rows that begin with 255, of whole rows alone, which the last visits ask for."""
    for at in range(x0 * rows.padded, x1 * rows.padded):
        out[at] = 0
    if rows.left[y, 0] == 255 and x1 - x0 == rows.left.shape[1]:
        raise ValueError("no such row")


class Failing:
    """A cost that fails in some rows."""

    name, cost_max, unit, costly_to_recompute = "failing", 60, 1, False

    def prepare(self, pair, workspace, workers):
        return [FailingRows(pair.left, pair.levels.padded)] * workers


@pytest.mark.parametrize("threads", [1, 3, 8])
def test_a_cost_that_fails_in_one_row_leaves_nobody_waiting(many_workers, threads):
    left = np.zeros((64, 200), np.uint8)
    left[40, 0] = 255
    levels, workspace = Levels(0, 64), Workspace()
    out = selection_output(np.empty(left.shape, np.float32), np.empty(left.shape, np.uint16), None, 64, 0, True)
    rows = Failing().prepare(CostInput(left, left, None, None, levels, 0.5), workspace, threads)
    for _ in range(5):
        with pytest.raises(ValueError, match="no such row"):
            Sgm(p1=3, p2=17).sweep(rows, levels, Failing(), left, workspace, threads, out)


def test_a_cost_row_of_another_form_is_refused_in_one_line():
    with pytest.raises(OptionError, match=r"must take \(rows, y, x0, x1, out\), got \(rows, y, out\)"):
        implements(FailingRows)(lambda rows, y, out: None)


@pytest.mark.parametrize("method", ["S1", "S2", "S4"])
@pytest.mark.parametrize("threads", [1, 2, 5, 90])
def test_the_bytes_of_the_buffers_are_known_for_any_number_of_threads(method, threads):
    matcher = Matcher(method, max_disparity=64, threads=threads)
    actual = matcher._pipeline._buffer_nbytes(600, 500, np.uint8, threads)
    most = 2 if method == "S1" else 1.15  # the columns of DT are shared out by fewer than 90
    assert 0.95 * actual < matcher.nbytes(600, 500) < most * actual
