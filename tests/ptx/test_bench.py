"""``stereokit bench --device cuda`` up to the launch: the interpreter stands for the GPU."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from ptx.interpreter.emulated import EmulatedQueue
from stereokit import matching
from stereokit.cli.app import app
from stereokit.cuda import pipeline as cuda_pipeline
from stereokit_evaluation.bench import baselines
from stereokit_evaluation.bench import gpu as gpu_times
from stereokit_evaluation.commands import bench as command

SIZE = "40x10x16"


@pytest.fixture
def waits(monkeypatch) -> list[int]:
    """Let the interpreter be the GPU; return the launches that there had been whenever the stream was waited for."""
    queues: list[EmulatedQueue] = []
    launches: list[int] = []

    def new_queue(stream: Any) -> EmulatedQueue:
        queues.append(EmulatedQueue())
        return queues[-1]

    def from_device(name: str, image: Any) -> Any:
        return cuda_pipeline._Image(image.ravel(), image.dtype, 1, image.shape)

    monkeypatch.setattr(cuda_pipeline, "new_queue", new_queue)
    monkeypatch.setattr(cuda_pipeline, "_from_device", from_device)
    monkeypatch.setattr(cuda_pipeline, "_reshaped", lambda array, shape: array.values.reshape(shape))
    monkeypatch.setattr(cuda_pipeline.cuda, "default_stream", lambda: 0)
    monkeypatch.setattr(cuda_pipeline, "stream_of", lambda stream: stream)
    monkeypatch.setattr(matching, "require_device", lambda: None)
    monkeypatch.setattr(gpu_times, "require_device", lambda: None)
    monkeypatch.setattr(gpu_times, "_resident", lambda image: image.copy())
    monkeypatch.setattr(gpu_times, "_wait", lambda: launches.append(sum(len(queue.launches) for queue in queues)))
    monkeypatch.setattr(command, "baselines", lambda: [baselines.THREE_WAY])
    monkeypatch.setattr(command, "describe", lambda: "an interpreter")
    return launches


def bench(*words):
    return CliRunner().invoke(app, ["bench", "--device", "cuda", "--sizes", SIZE, "--threads", "1", *map(str, words)])


def test_host_and_device_images_and_a_peer(waits):
    done = bench("--method", "S2", "--rounds", 2, "--json", "-")
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    rows = {row["contender"]: row for row in report["results"]}
    assert list(rows) == ["S2 census+sgm, GPU, host images", "S2 census+sgm, GPU, device images", baselines.THREE_WAY]
    assert [row["kind"] for row in rows.values()] == ["method", "method", "peer"]
    assert all(row["runs"] == 2 and row["median_ms"] > 0 and row["x_3way"] > 0 for row in rows.values())
    assert report["options"]["device"] == "an interpreter" and report["memory"] == report["first_call"] == []
    assert len(waits) == 3 and waits == sorted(
        set(waits)
    )  # the first call is not timed; each call launches, then waits


def test_the_table_names_the_gpu(waits):
    done = bench("--method", "S2", "--rounds", 1, "--scale", 0.5)
    assert done.exit_code == 0, done.output
    assert "S2 census+sgm, half size, GPU, host images" in done.stdout and "GPU: an interpreter" in done.stdout
    assert "device images" not in done.stdout and not waits


def test_calls_give_the_map_of_the_cpu(waits):
    left = np.random.default_rng(0).integers(0, 256, (8, 40), dtype=np.uint8)
    right = np.roll(left, -3, axis=1)
    want = matching.Matcher("S2", max_disparity=16, device="cpu")(left, right).disparity
    ours = gpu_times.contenders(["census+sgm"], 1)
    build = gpu_times.maker(ours)
    for name in ours:
        call = build(name, 16, 1)
        for _ in range(2):
            np.testing.assert_array_equal(np.asarray(call(left, right)), want)
    peer = build(baselines.THREE_WAY, 16, 1)
    assert peer(left, right).shape == left.shape
