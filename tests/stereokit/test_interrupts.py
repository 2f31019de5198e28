"""Ctrl-C at any moment: no helper is lost, no call waits for ever, the next call is right, and the process ends."""

from __future__ import annotations

import contextlib
import textwrap
import threading
import time

import numpy as np
import pytest

import stereokit
from stereokit import Matcher
from stereokit.kernels import threads as workers
from stereokit.kernels import workspace

METHODS = list(stereokit.METHODS)


def pair_of(seed, shape=(14, 40)):
    left = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return left, np.roll(left, -3, axis=1)


def interrupted_everywhere(call, monkeypatch, owner, name):
    """Call again and again; the n-th time, the n-th use of a function ends in a KeyboardInterrupt.

    Once before it does anything, and once when it has done it. Yields after each.
    """
    real = getattr(owner, name)
    for late in (False, True):
        for turn in range(1000):
            left = [turn]

            def interrupt(*arguments, late=late, left=left, **options):
                left[0] -= 1
                if left[0] == -1 and not late:
                    raise KeyboardInterrupt
                result = real(*arguments, **options)
                if left[0] == -1 and late:
                    raise KeyboardInterrupt
                return result

            with monkeypatch.context() as patch:
                patch.setattr(owner, name, interrupt)
                with contextlib.suppress(KeyboardInterrupt):
                    call()
            yield
            if left[0] >= 0:  # there is no n-th use
                assert turn > 0, f"{name} was never used"
                break


PLACES = [(workers.Workers, "submit"), (workspace, "aligned"), (np, "empty")]


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place[1])
@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_an_interrupt_at_each_submit_and_each_allocation(method, threads, place, monkeypatch):
    pair = pair_of(0)
    matcher = Matcher(method, max_disparity=8, threads=threads)
    expected = matcher(*pair).disparity

    def call():
        matcher._pipeline._workspaces = workspace.Pool(workspace.Workspace)  # allocates all buffers
        matcher(*pair)

    for _ in interrupted_everywhere(call, monkeypatch, *place):
        np.testing.assert_array_equal(matcher(*pair).disparity, expected)


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place[1])
@pytest.mark.parametrize("threads", [2, 3])
def test_an_interrupt_of_map_at_each_submit_and_each_allocation(threads, place, monkeypatch):
    pairs = [pair_of(seed) for seed in range(4)]
    matcher = Matcher("S1", max_disparity=8, threads=threads)
    expected = [matcher(*pair).disparity for pair in pairs]

    def call():
        matcher._pipeline._workspaces = workspace.Pool(workspace.Workspace)
        list(matcher.map(pairs))

    for _ in interrupted_everywhere(call, monkeypatch, *place):
        for result, right in zip(matcher.map(pairs), expected, strict=True):
            np.testing.assert_array_equal(result.disparity, right)


def test_an_interrupt_of_the_source_of_map_is_raised_at_once():
    def source():
        yield pair_of(0)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        next(Matcher("S1", max_disparity=8, threads=2).map(source()))


STORM = """
    import random
    import signal
    import time
    import numpy as np
    from stereokit import METHODS, Matcher

    def interrupt(*_):
        raise KeyboardInterrupt

    def is_right(call, expected):
        return all(np.array_equal(a.disparity, b.disparity) for a, b in zip(call(), expected, strict=True))

    left = np.random.default_rng(0).integers(0, 256, (14, 40), dtype=np.uint8)
    right = np.roll(left, -3, axis=1)
    matchers = [Matcher(method, max_disparity=8, threads=threads) for method in METHODS for threads in (2, 3)]
    calls = [lambda matcher=matcher: [matcher(left, right)] for matcher in matchers]
    calls += [lambda matcher=matcher: list(matcher.map([(left, right)] * 3)) for matcher in matchers[:2]]
    expected, seconds = [], []
    for call in calls:
        expected.append(call())
        start = time.perf_counter()
        assert is_right(call, expected[-1])
        seconds.append(time.perf_counter() - start)
    random.seed(1)
    signal.signal(signal.SIGALRM, interrupt)
    hits = wrong = tries = 0
    while hits < 2000:
        tries += 1
        k = random.randrange(len(calls))
        try:
            signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-5, 1.1 * seconds[k]))
            calls[k]()
        except KeyboardInterrupt:
            hits += 1
        while True:
            try:
                signal.setitimer(signal.ITIMER_REAL, 0)
                break
            except KeyboardInterrupt:
                hits += 1
        while tries % 10 == 0:
            try:
                wrong += not is_right(calls[k], expected[k])
                break
            except KeyboardInterrupt:  # a signal that the system gave to a thread without a processor comes late
                hits += 1
    time.sleep(0.2)
    for call, results in zip(calls, expected):
        wrong += not is_right(call, results)
    print(hits, "interrupts,", wrong, "wrong")
    """


def test_a_storm_of_interrupts(run_python):
    """Signals at random moments: none of the calls hangs, each later one is right, and the process ends."""
    assert run_python("-c", textwrap.dedent(STORM), timeout=1200).split(",")[1].strip() == "0 wrong"


def test_a_helper_whose_caller_is_gone_leaves():
    team = workers.Team(2)
    begun = threading.Event()
    team.run([[lambda: begun.wait(60), begun.set]])  # the helper is there
    assert team._words[1] != workers._ABSENT
    until = time.monotonic() + 60
    while team._words[1] != workers._ABSENT and time.monotonic() < until:  # nobody closes the team
        time.sleep(0.01)
    assert team._words[1] == workers._ABSENT
    again = threading.Event()
    team.run([[lambda: again.wait(60), again.set]])  # it comes back when it is called
    team.close()


def awaited(condition):
    until = time.monotonic() + 60
    while not condition() and time.monotonic() < until:
        time.sleep(0.001)
    return condition()


def test_helpers_that_are_called_early_are_there_and_go_with_the_team():
    begun = threading.Event()
    with workers.team(2) as members:
        members.summon()
        assert members._words[1] == workers._CALLED
        members.run([[lambda: begun.wait(60), begun.set]])  # takes two
    assert begun.is_set() and awaited(lambda: (members._words[1:] == workers._ABSENT).all())
    with pytest.raises(stereokit.InputError), workers.team(2) as members:
        Matcher("S2", max_disparity=8, threads=2)(np.zeros((4, 5), np.uint8), np.zeros((4, 6), np.uint8))
    assert awaited(lambda: (members._words[1:] == workers._ABSENT).all())


def test_a_match_calls_its_helpers_before_it_looks_at_the_images(monkeypatch):
    calls = []
    monkeypatch.setattr(workers.Team, "summon", lambda self, members=None: calls.append(members))
    Matcher("S2", max_disparity=8, threads=2)(*pair_of(0))
    assert calls[0] is None


def test_calls_end_where_all_workers_are_busy_or_none_can_be_had(monkeypatch):
    pairs = [pair_of(seed) for seed in range(3)]
    matcher = Matcher("S4", max_disparity=8, threads=3)
    expected = [matcher(*pair).disparity for pair in pairs]

    def none_left(*_):
        raise RuntimeError("can't start new thread")

    release = threading.Event()
    busy = workers.Workers(1)
    busy.submit(lambda: release.wait(60) and None)
    monkeypatch.setattr(workers, "_workers", busy)
    np.testing.assert_array_equal(matcher(*pairs[0]).disparity, expected[0])
    release.set()
    monkeypatch.setattr(workers, "_workers", workers.Workers(2))
    monkeypatch.setattr(workers, "start_new_thread", none_left)
    for got, right in zip(matcher.map(pairs), expected, strict=True):
        np.testing.assert_array_equal(got.disparity, right)
    np.testing.assert_array_equal(matcher(*pairs[0]).disparity, expected[0])


def test_workers_end_when_they_have_had_nothing_to_do_for_a_while(monkeypatch):
    monkeypatch.setattr(workers, "_IDLE_SECONDS", 0.01)
    pool = workers.Workers(2)
    done = threading.Event()
    pool.submit(done.set)
    assert done.wait(60)
    until = time.monotonic() + 60
    while pool._present and time.monotonic() < until:
        time.sleep(0.01)
    assert not pool._present


def nbytes(matcher):
    return sum(free.nbytes for free in matcher._pipeline._workspaces.free)


def test_the_buffers_of_a_burst_are_given_back():
    large, small = pair_of(0, (60, 200)), pair_of(1)
    matcher = Matcher("S1", max_disparity=64, threads=1)
    matcher(*large)
    one = nbytes(matcher)
    together = threading.Barrier(12)

    def call():
        with matcher._pipeline._workspaces.take() as buffers:
            together.wait(60)  # all at the same time
            matcher._pipeline._coarse(stereokit.images.gray.gray_pair(*large), buffers, 1)

    burst = [threading.Thread(target=call) for _ in range(12)]
    for thread in burst:
        thread.start()
    for thread in burst:
        thread.join()
    assert one <= nbytes(matcher) <= 4 * one
    for _ in range(10):
        matcher(*small)
    assert nbytes(matcher) < one / 4


def test_buffers_do_not_grow_with_the_number_of_sizes():
    matcher = Matcher("S2", max_disparity=8, threads=2)
    for height in range(30, 40):
        matcher(*pair_of(0, (height, 40)))
    fresh = Matcher("S2", max_disparity=8, threads=2)
    fresh(*pair_of(0, (39, 40)))
    assert nbytes(matcher) == nbytes(fresh)


def test_buffers_of_a_call_that_failed_are_not_lent_again():
    pool = workspace.Pool(workspace.Workspace)
    with pytest.raises(ZeroDivisionError), pool.take() as lost:
        raise ZeroDivisionError
    with pool.take() as first:
        assert first is not lost
    with pool.take() as second:
        assert second is first
