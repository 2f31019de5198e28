"""Threads: inside one call, and calls from many threads at once."""

from __future__ import annotations

import copy
import pickle
import signal
import textwrap
import threading
import time
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import stereokit
from stereokit import InputError, Matcher, match
from stereokit.kernels import threads as workers

METHODS = list(stereokit.METHODS.values())


def pair_of(seed, shape=(37, 53)):
    rng = np.random.default_rng(seed)
    left = rng.integers(0, 256, shape, dtype=np.uint8)
    noise = rng.integers(0, 20, shape, dtype=np.uint8)
    return left, np.roll(left // 2 + noise, -4, axis=1)


def assert_same(a, b):
    np.testing.assert_array_equal(a.disparity, b.disparity)
    np.testing.assert_array_equal(a.valid, b.valid)
    np.testing.assert_array_equal(a.confidence, b.confidence)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1, 0.5])
def test_the_result_does_not_depend_on_threads(method, scale):
    pair = pair_of(0)
    one = Matcher(method, max_disparity=16, threads=1, confidence=True, scale=scale)(*pair)
    for threads in (2, 3, 8, 100):
        assert_same(one, Matcher(method, max_disparity=16, threads=threads, confidence=True, scale=scale)(*pair))


@pytest.mark.parametrize("options", [{"paths": 4}, {"paths": 5}])
def test_paths_do_not_depend_on_threads(options):
    pair = pair_of(1)
    one = Matcher("census+sgm", max_disparity=16, threads=1, confidence=True, **options)(*pair)
    assert_same(one, Matcher("census+sgm", max_disparity=16, threads=2, confidence=True, **options)(*pair))


@pytest.mark.parametrize("shape", [(1, 20), (2, 20), (3, 1)])
def test_more_threads_than_rows(shape):
    pair = pair_of(2, shape)
    for method in METHODS:
        one = Matcher(method, max_disparity=16, threads=1, confidence=True)(*pair)
        assert_same(one, Matcher(method, max_disparity=16, threads=7, confidence=True)(*pair))


@pytest.mark.parametrize("method", METHODS)
def test_eight_calls_at_once_on_one_matcher(method):
    pairs = [pair_of(seed, (30 + seed % 3, 50)) for seed in range(8)]
    matcher = Matcher(method, max_disparity=16, threads=2, confidence=True)
    serial = [Matcher(method, max_disparity=16, threads=1, confidence=True)(*pair) for pair in pairs]
    with ThreadPoolExecutor(8) as pool:
        for _ in range(4):
            for one, many in zip(serial, pool.map(lambda pair: matcher(*pair), pairs), strict=True):
                assert_same(one, many)


def test_eight_calls_at_once_on_different_matchers():
    jobs = [(Matcher(METHODS[k % 4], max_disparity=16, confidence=True), pair_of(k)) for k in range(8)]
    serial = [matcher(*pair) for matcher, pair in jobs]
    with ThreadPoolExecutor(8) as pool:
        for _ in range(4):
            for one, many in zip(serial, pool.map(lambda job: job[0](*job[1]), jobs), strict=True):
                assert_same(one, many)


def test_eight_calls_of_match_at_once():
    # More settings than `match` keeps matchers for, so that they are made and dropped meanwhile.
    jobs = [(METHODS[k % 4], 12 + k // 4, pair_of(k)) for k in range(16)]

    def run(job):
        return match(*job[2], job[0], max_disparity=job[1])

    serial = [run(job) for job in jobs]
    with ThreadPoolExecutor(8) as pool:
        for one, many in zip(serial * 3, pool.map(run, jobs * 3), strict=True):
            np.testing.assert_array_equal(one, many)


def test_an_error_leaves_the_matcher_usable():
    matcher, pair = Matcher("census+sgm", max_disparity=16), pair_of(3)
    expected = matcher(*pair).disparity
    with pytest.raises(stereokit.InputError):
        matcher(pair[0], pair[1][:5])
    np.testing.assert_array_equal(matcher(*pair).disparity, expected)


def test_map_shares_threads_out_by_what_is_waiting(monkeypatch):
    seen, call = [], Matcher._call

    def noted(self, left, right, mask, right_mask, threads):
        seen.append(threads)
        return call(self, left, right, mask, right_mask, threads)

    monkeypatch.setattr(Matcher, "_call", noted)
    matcher = Matcher("census+sgm", max_disparity=16, threads=4)
    (result,) = matcher.map([pair_of(0)])  # as from a camera: one at a time
    assert seen == [4]
    np.testing.assert_array_equal(result.disparity, matcher(*pair_of(0)).disparity)
    seen.clear()
    assert len(list(matcher.map([pair_of(0)] * 30))) == 30
    assert sorted(set(seen) - {1, 2, 4}) == [] and seen.count(1) > 10


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_map_gives_the_results_of_single_calls_in_order(threads):
    pairs = [pair_of(seed, (20 + seed % 3, 40)) for seed in range(11)]
    matcher = Matcher("census+sgm", max_disparity=16, threads=threads, confidence=True)
    counts = []
    results = list(matcher.map(iter(pairs), progress=counts.append))
    assert counts == list(range(1, 12))
    for result, pair in zip(results, pairs, strict=True):
        assert_same(result, matcher(*pair))
    assert list(matcher.map([])) == []


def test_map_takes_pairs_as_results_are_taken():
    taken = []

    def endless():
        while True:
            taken.append(1)
            yield pair_of(4, (12, 30))

    matcher = Matcher("census+sgm", max_disparity=16, threads=2)
    results = matcher.map(endless())
    for done in range(1, 6):
        next(results)
        assert len(taken) <= done + 2 * matcher.threads
    results.close()
    assert matcher(*pair_of(4)).disparity.shape == (37, 53)


def test_map_raises_when_the_turn_of_a_bad_pair_comes():
    good = pair_of(5, (12, 30))
    results = Matcher("census+sgm", max_disparity=16, threads=2).map([good, (good[0], good[1][:5]), good])
    assert next(results).disparity.shape == (12, 30)
    with pytest.raises(stereokit.InputError, match="same size"):
        next(results)


def test_a_forked_child_can_match(run_python, tmp_path):
    script = tmp_path / "fork.py"
    script.write_text(
        "import multiprocessing, numpy, stereokit\n"
        "left = numpy.arange(600, dtype=numpy.uint8).reshape(20, 30)\n"
        "def work(_):\n"
        "    return stereokit.match(left, left, 'census+sgm', max_disparity=16, threads=2).sum()\n"
        "if __name__ == '__main__' and 'fork' in multiprocessing.get_all_start_methods():\n"
        "    first = work(0)\n"
        "    with multiprocessing.get_context('fork').Pool(2) as pool:\n"
        "        assert pool.map_async(work, range(4)).get() == [first] * 4\n"
    )
    run_python(script)


def test_a_fork_while_a_lock_is_held_leaves_a_child_that_can_match(run_python):
    """A child has none of its parent's threads, so a lock that one of them holds must not be inherited."""
    code = """
        import os
        import numpy as np
        from stereokit import match, matching
        image = np.arange(400, dtype=np.uint8).reshape(10, 40)
        expected = match(image, image, "S2", max_disparity=4, threads=2)
        with matching._matchers_lock:
            child = os.fork()
            if child == 0:
                same = np.array_equal(match(image, image, "S2", max_disparity=4, threads=2), expected)
                os._exit(0 if same else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        print("matched")
        """
    assert "matched" in run_python("-c", textwrap.dedent(code))


def test_a_matcher_can_be_pickled_and_copied(random_pair):
    left, right = random_pair(9, 40, seed=5)
    matcher = Matcher("census+sgm", max_disparity=16)
    expected = matcher(left, right).disparity
    for other in (pickle.loads(pickle.dumps(matcher)), copy.deepcopy(matcher)):
        np.testing.assert_array_equal(other(left, right).disparity, expected)


def test_workers_are_waited_for_after_an_interrupt():
    """Until all tasks have ended their buffers are in use: an interrupt must not hand them to the next call."""
    begun, ended = threading.Event(), []

    def slow():
        begun.set()
        time.sleep(0.5)
        ended.append(True)

    def interrupted():  # the caller's, while a helper is at the other
        assert begun.wait(60)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        workers.run([interrupted, slow], 2)
    assert ended == [True]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("method", METHODS)
def test_a_steady_stream_of_frames_allocates_a_few_maps_and_no_costs(method, threads):
    pair = pair_of(9, (90, 200))
    matcher = Matcher(method, max_disparity=32, threads=threads)
    for _ in range(2):
        matcher(*pair)
    results = [matcher(*pair) for _ in range(2)]
    tracemalloc.start()
    try:
        for _ in range(4):
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            result = matcher(*pair)
            _, peak = tracemalloc.get_traced_memory()
            returned = result.disparity.nbytes + result.valid.nbytes
            # masks and maps of the looks at the pair, a few at a time, and nothing that grows with the levels
            assert peak - before - returned < 30 * pair[0].size
            results.append(result)
    finally:
        tracemalloc.stop()
    for result in results[1:]:
        np.testing.assert_array_equal(results[0].disparity, result.disparity)


def test_maps_that_were_returned_are_not_buffers():
    matcher = Matcher("census+sgm", max_disparity=16, threads=2)
    first = matcher(*pair_of(10))
    copies = first.disparity.copy(), first.valid.copy()
    matcher(*pair_of(11))
    np.testing.assert_array_equal(first.disparity, copies[0])
    np.testing.assert_array_equal(first.valid, copies[1])


def test_stages_run_one_after_another_and_fail_together():
    done = []
    lock = threading.Lock()

    def note(stage):
        with lock:
            done.append(stage)

    for threads in (1, 2, 3):
        done.clear()
        workers.run_stages([[lambda n=n: note(n)] * 4 for n in range(5)], threads)
        assert done == sorted(done) and len(done) == 20

    def fail():
        raise ValueError("broken")

    for broken in ([fail, lambda: None], [lambda: None, fail]):
        done.clear()
        with pytest.raises(ValueError, match="broken"):
            workers.run_stages([broken, [lambda: note(1)] * 2], 2)
        assert not done
    workers.run([lambda: note(0)] * 2, 2)
    assert done == [0, 0]


def test_a_team_outlives_its_runs_and_a_failure_in_one():
    done = []
    with workers.team(2):
        for n in range(50):
            workers.run([lambda n=n: done.append(n), lambda n=n: done.append(n)], 2)
    assert sorted(done) == sorted([*range(50)] * 2)
    with pytest.raises(ZeroDivisionError), workers.team(2):
        workers.run([lambda: None, lambda: 1 / 0], 2)
    workers.run([lambda: done.append(-1)] * 2, 2)
    assert done[-2:] == [-1, -1]


def test_map_gives_what_it_has_before_a_broken_source(random_pair):
    pair = random_pair(9, 40, seed=6)
    matcher = Matcher("census+sgm", max_disparity=16, threads=2)
    for broken in [(pair[0],), (*pair, pair[0]), None]:
        results = []
        with pytest.raises(InputError, match="pairs must give"):
            for result in matcher.map([pair, pair, pair, broken, pair]):
                results.append(result)
        assert len(results) == 3
