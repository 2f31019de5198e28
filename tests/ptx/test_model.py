"""The model of GPUs counts what the interpreter counts: bytes of every launch, and instructions of its PTX by warps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ptx.interpreter.emulated import EmulatedQueue
from ptx.interpreter.harness import Report, translation_of
from stereokit import Matcher
from stereokit.cuda.pipeline import CudaPipeline
from stereokit.defaults import METHODS
from stereokit_evaluation.gpu_model.model import named, record, work_of
from stereokit_evaluation.gpu_model.sass import Code, outer_loops

MATCHES = {  # method, scale, height, width, levels; two sizes of what takes the time
    "S4": (1, 24, 96, 32),
    "S2": (1, 16, 128, 128),
    "S1": (1, 24, 96, 32),
    "S3": (0.5, 48, 256, 64),
}
BYTES = {"speckle_join": 0.3, "speckle_count": 0.2, "fill_rows": 0.15, "sgm_paths": 0.03}
"""How far the formula may be off: loops of the first three depend on the images, the third looks its direction up."""

TIGHT = ("sgm_", "zncc_costs", "census_", "median", "blur", "halve", "zncc_centre")
"""Kernels whose instructions are known to 25 %; of the others no more than twice as many may be claimed: of branches
both sides are counted, of short lines and images each first and last pass. Trees of speckles are climbed once."""


class _Queue(EmulatedQueue):
    """A queue that keeps what was launched."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[tuple[Any, int, Any]] = []

    def launch(self, what: Any, blocks: int, *arguments: Any) -> None:
        self.records.append((what, blocks, named(what, arguments)))
        super().launch(what, blocks, *arguments)


def code_of(kernel: Any) -> Code:
    """Return the code of a kernel's PTX."""
    program = translation_of(kernel).program
    units = [
        "memory" if one.op[0] in ("ld", "st", "atom", "red") and not {"param", "shared"} & set(one.op) else "other"
        for one in program.code
    ]
    branches = [(at, program.labels[one.operands[-1]]) for at, one in enumerate(program.code) if one.op[0] == "bra"]
    return Code(tuple(units), outer_loops(branches))


@pytest.fixture(scope="module", params=list(MATCHES))
def launches(request) -> tuple[Matcher, list[tuple[Any, int, Any, Report]]]:
    """Return a matcher and the launches of a match: kernel, blocks, arguments and what the interpreter counted."""
    scale, height, width, levels = MATCHES[request.param]
    matcher = Matcher(request.param, max_disparity=levels, scale=scale, speckle=0.02, device="cpu")
    left = np.random.default_rng(0).integers(0, 256, (height, width), dtype=np.uint8)
    queue = _Queue()
    images = queue.upload("images", np.stack([left, np.roll(left, -4, axis=1)]))
    pipeline = CudaPipeline(matcher.settings)
    pipeline.run(queue, images, left.dtype, images[: left.size], None, left.shape)
    return matcher, [(*record, ran[2]) for record, ran in zip(queue.records, queue.launches, strict=True)]


def test_bytes_are_those_that_threads_ask_for(launches):
    for kernel, blocks, arguments, report in launches[1]:
        work = work_of(kernel, blocks, arguments)
        asked = sum(work.reads.values()) + sum(work.writes.values())
        off = next((share for name, share in BYTES.items() if kernel.name.startswith(name)), 0.025)
        assert asked == pytest.approx(sum(report.read) + sum(report.written), rel=off), kernel


def test_instructions_are_those_of_the_warps(launches):
    for kernel, blocks, arguments, report in launches[1]:
        work = work_of(kernel, blocks, arguments)
        of_warp = code_of(kernel).executed(work.passes, work.accesses, work.every)
        share = sum(of_warp.values()) * blocks * kernel.block / 32 / report.issued
        most = 1.25 if kernel.name.startswith(TIGHT) else 2.0
        least = 0.75 if kernel.name.startswith("speckle") else 0.85
        assert least <= share <= most, (kernel, share)


def test_the_recorder_sees_the_same_launches(launches):
    matcher, ran = launches
    _, height, width, _ = MATCHES[next(short for short, name in METHODS.items() if name == matcher.method)]
    work = record(matcher, width, height)
    assert [(one.kernel, one.blocks) for one in work] == [(kernel, blocks) for kernel, blocks, _, _ in ran]
    for one, (kernel, blocks, arguments, _) in zip(work, ran, strict=True):
        asked = work_of(kernel, blocks, arguments)
        assert one.work == asked
        assert 0 < one.read <= sum(asked.reads.values()) and one.written <= sum(asked.writes.values())
