"""The model of GPUs counts what the interpreter counts: bytes of every launch, and instructions of its PTX."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba_cuda")

from ptx.emulated import EmulatedQueue
from ptx.harness import translation_of
from stereokit import Matcher
from stereokit.inputs import gray_pair
from stereokit.pipeline_cuda import CudaPipeline
from stereokit_evaluation._gpu_code import Code, outer_loops
from stereokit_evaluation.gpu_model import named, work_of


class _Queue(EmulatedQueue):
    """A queue that keeps what was launched."""

    def __init__(self) -> None:
        super().__init__()
        self.given: list[tuple[Any, int, Any]] = []

    def launch(self, what: Any, blocks: int, *arguments: Any) -> None:
        self.given.append((what, blocks, named(what, arguments)))
        super().launch(what, blocks, *arguments)


def code_of(kernel: Any) -> Code:
    """Return the code of a kernel's PTX."""
    program = translation_of(kernel).program
    units = []
    for one in program.code:
        asked = one.op[0] in ("ld", "st", "atom", "red") and "param" not in one.op and "shared" not in one.op
        units.append("memory" if asked else "other")
    branches = [(at, program.labels[one.operands[-1]]) for at, one in enumerate(program.code) if one.op[0] == "bra"]
    return Code(tuple(units), outer_loops(branches))


if __name__ == "__main__":
    import sys, time
    rng = np.random.default_rng(0)
    for method, scale, shape, levels in (("S4", 1, (24, 96), 32), ("S2", 1, (16,128), 128), ("S1",1,(24,96),32), ("S3",.5,(48,192),64)):
        t0=time.time()
        h, w = shape
        left = rng.integers(0, 256, (h, w), dtype=np.uint8)
        right = np.roll(left, -4, axis=1)
        matcher = Matcher(method, max_disparity=levels, scale=scale, device="cpu", speckle=.02)
        q = _Queue()
        px = h*w
        images = q.upload("images", np.stack([left, right]))
        CudaPipeline(matcher._cuda_settings()).run(q, images, np.dtype(np.uint8), images[:px], None, (h, w))
        print(method, shape, levels, time.time()-t0)
        for (k, blocks, a), (_, _, rep) in zip(q.given, q.launches):
            wk = work_of(k, blocks, a)
            c = code_of(k)
            mine = sum(c.executed(wk.passes, wk.accesses, wk.every).values()) * blocks * k.block / 32
            asked = sum(wk.reads.values()) + sum(wk.writes.values())
            real = sum(rep.read) + sum(rep.written)
            print(f"{k.name:22} blocks {blocks:5d} bytes {asked:10.0f}/{real:10d} = {asked/real:5.2f}  r {sum(wk.reads.values())/max(1,sum(rep.read)):5.2f} w {sum(wk.writes.values())/max(1,sum(rep.written)):5.2f} instr {mine:10.0f}/{rep.issued:10d} = {mine/rep.issued:5.2f} loops {c.loops} total {len(c.units)}")
