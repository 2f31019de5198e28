"""Batches on a real cluster of two worker processes, one of which is killed in the midst of its work."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys

import pytest
from batches import environment, images, inodes, refused, run, start, wait_for, write_pairs
from limits import HANG_S

from stereokit.io import read_disparity
from stereokit_evaluation.batch.dask import connect, on_cluster
from stereokit_evaluation.batch.job import Job
from stereokit_evaluation.batch.pairs import folder_pairs

pytest.importorskip("distributed", reason="Dask's distributed is not installed: pip install 'stereokit[dask]'")

COUNT = 60


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Return the scheduler's file and a function that starts one more worker; all end with the module."""
    with processes(tmp_path_factory.mktemp("cluster")) as (where, _, worker):
        yield where, worker


@contextlib.contextmanager
def processes(folder):
    """Start a scheduler; yield its file, its process, and a function that starts one more worker."""
    where = folder / "scheduler.json"
    processes = []

    def launch(program, *words):
        with (folder / f"{len(processes)}.log").open("w") as log:
            command = [sys.executable, "-m", f"distributed.cli.dask_{program}", "--scheduler-file", str(where), *words]
            processes.append(subprocess.Popen(command, stdout=log, stderr=log, env=environment(), cwd=folder))
        return processes[-1]

    def worker():
        words = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
        return launch("worker", *words, "--local-directory", str(folder))

    scheduler = launch("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard", "--no-show")
    wait_for(where.exists, scheduler)
    try:
        yield where, scheduler, worker
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


@pytest.mark.skipif(sys.platform == "win32", reason="a process cannot be killed the hard way")
def test_nothing_is_lost_or_doubled_when_a_worker_dies(cluster, tmp_path):
    address, worker = cluster
    workers = [worker(), worker()]
    write_pairs(tmp_path, [f"{k:03d}" for k in range(COUNT)], (120, 400))
    (tmp_path / "right" / "040.png").write_bytes(b"nonsense")
    out = tmp_path / "out"
    process = start(tmp_path, "-o", out, "--engine", "dask", "--scheduler", address, folder=tmp_path)
    seen = {}

    def watch():
        """Every output keeps the file that it first was."""
        now = inodes(out)
        assert {name: now.get(name) for name in seen} == seen
        seen.update(now)
        return len(seen)

    wait_for(lambda: watch() >= 8, process)
    workers[0].send_signal(signal.SIGKILL)
    workers[0].wait()
    before = len(seen)
    assert before < COUNT - 1
    wait_for(lambda: watch() and process.poll() is not None)
    assert process.wait() == 1, (tmp_path / "stderr").read_text()
    watch()
    assert sorted(seen) == [f"{k:03d}.png" for k in range(COUNT) if k != 40]
    assert all(read_disparity(out / name).shape == (120, 400) for name in seen)
    again = run(tmp_path, "-o", out, status=1)  # and this machine goes on where the cluster ended
    assert (again["found"], again["written"], again["failed"]) == (COUNT - 1, 0, 1)
    assert again["errors"][0]["name"] == "040"
    assert inodes(out) == seen


def test_results_that_die_with_their_workers_are_made_again(tmp_path):
    job = Job(str(tmp_path / "out"), ".png", False, "S2", (("max_disparity", 16),))
    pairs = folder_pairs(write_pairs(tmp_path, "abcdefgh", (300, 900)))
    (tmp_path / "out").mkdir()
    with processes(tmp_path) as (where, _, worker):
        doomed = [worker(), worker()]
        with connect(str(where)) as client:
            outcomes = on_cluster(job, pairs, client)
            done = [next(outcomes)]  # nobody asks for the others for a while
            wait_for(lambda: all(state.status == "finished" for state in client.futures.values()))
            for process in doomed:
                process.kill()
            wait_for(lambda: all(state.status == "lost" for state in client.futures.values()))
            worker()
            done += outcomes
    assert sorted(outcome.name for outcome in done) == list("abcdefgh")
    assert not any(outcome.reason for outcome in done)


def test_a_scheduler_that_dies_ends_the_batch_with_one_line(tmp_path):
    write_pairs(tmp_path, [f"{k:03d}" for k in range(COUNT)], (120, 400))
    out = tmp_path / "out"
    with processes(tmp_path) as (where, scheduler, worker):
        worker()
        process = start(tmp_path, "-o", out, "--engine", "dask", "--scheduler", where, folder=tmp_path)
        wait_for(lambda: len(inodes(out)) >= 3, process)
        scheduler.kill()
        assert process.wait(HANG_S) == 2
    errors = [line for line in (tmp_path / "stderr").read_text().splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "the Dask scheduler was lost" in errors[0]
    before = inodes(out)
    assert 3 <= len(before) < COUNT
    again = run(tmp_path, "-o", out)
    assert (again["found"], again["written"]) == (len(before), COUNT - len(before))


def test_frames_of_a_video_are_sent(cluster, tmp_path):
    import numpy as np
    from test_batch import write_video

    address, worker = cluster
    worker()
    pairs = [images(k, (64, 128), 4 + k) for k in range(4)]
    write_video(tmp_path / "both.avi", [np.hstack(pair) for pair in pairs])
    summary = run(tmp_path / "both.avi", "-o", tmp_path / "out", "--engine", "dask", "--scheduler", address)
    assert (summary["written"], summary["failed"], summary["engine"]) == (4, 0, "dask")
    for k in range(4):
        assert np.median(read_disparity(tmp_path / "out" / f"{k:06d}.png")) == pytest.approx(4 + k, abs=0.5)


def test_a_scheduler_that_does_not_answer_is_refused(tmp_path, monkeypatch):
    from stereokit_evaluation.batch import dask as batch_dask

    monkeypatch.setattr(batch_dask, "_CONNECT_S", 1)
    write_pairs(tmp_path, ["0"])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        words = ("--engine", "dask", "--scheduler", f"tcp://127.0.0.1:{port}")
        assert "scheduler must be one that answers" in refused(tmp_path, "-o", tmp_path / "out", *words)
    assert not (tmp_path / "out").exists()
    assert "--workers is for" in refused(tmp_path, "-o", tmp_path / "out", *words, "--workers", "2")
