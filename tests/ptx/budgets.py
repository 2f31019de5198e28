"""Needs of the kernels: registers, occupancy and instructions of the hot loop, per architecture.

``python -m ptx.budgets`` in ``tests/`` prints the table; with ``--write`` it replaces ``budgets.json``, which the tests
hold the kernels to. PTX for sm_72 runs on every later card, so each kernel is compiled once and assembled four times.
The hot loop is the longest one, as it was unrolled, or all of a kernel without loops; that of sm_72 is the code for
sm_75, as `stereokit_evaluation.gpu_model.sass` tells.
"""

from __future__ import annotations

import json
import sys
from functools import cache
from pathlib import Path
from typing import Any

from stereokit_evaluation.gpu_model.sass import (
    ARCHITECTURES,
    DISASSEMBLED,
    Code,
    Resources,
    code_of,
    tool,
    warps_that_fit,
)
from stereokit_evaluation.gpu_model.sass import resources as taken_by

__all__ = ["ARCHITECTURES", "TABLE", "assembled", "has_tools", "kernels", "ptx", "resources"]

TABLE = Path(__file__).with_name("budgets.json")


def has_tools() -> bool:
    """Return whether kernels can be assembled and disassembled."""
    return tool("ptxas") is not None and tool("nvdisasm") is not None


def kernels() -> dict[str, Any]:
    """Return every kernel of the project by name."""
    from stereokit.cuda.pipeline import all_kernels

    return all_kernels()


@cache
def ptx(name: str) -> str:
    """Return the PTX of a kernel for the oldest card that is supported."""
    return str(kernels()[name].ptx((7, 2)))


@cache
def assembled(name: str, architecture: str) -> tuple[Code, Resources]:
    """Return the code of a kernel and what it takes."""
    if architecture in DISASSEMBLED:
        return assembled(name, DISASSEMBLED[architecture])[0], taken_by(ptx(name), architecture)
    return code_of(ptx(name), architecture)


def resources(name: str, architecture: str) -> dict[str, int]:
    """Return the needs of a kernel.

    Registers, bytes of stack and of spills of a thread, the share of warps that fit in percent, and the instructions of
    the hot loop.
    """
    code, taken = assembled(name, architecture)
    fit, most = warps_that_fit(taken.registers, kernels()[name].block, architecture)
    first, end = code.hot()
    return {
        "registers": taken.registers, "stack": taken.stack, "spilled": taken.spilled,
        "occupancy": 100 * fit // most, "hot_loop": end - first,
    }  # fmt: skip


def main(write: bool) -> None:
    """Print the table of all kernels; with `write`, keep it."""
    columns = ("registers", "occupancy", "hot_loop")
    table = {}
    print(f"{'':24} registers, occupancy in percent, instructions of the hot loop")
    print(f"{'kernel':24} " + "  ".join(f"{architecture:>14}" for architecture in ARCHITECTURES))
    for name in sorted(kernels()):
        needs = {architecture: resources(name, architecture) for architecture in ARCHITECTURES}
        table[name] = {architecture: {key: one[key] for key in columns} for architecture, one in needs.items()}
        shown = "  ".join(f"{r['registers']:3d} {r['occupancy']:4d} {r['hot_loop']:5d}" for r in needs.values())
        print(f"{name:24} {shown}", flush=True)
    if write:
        rows = (
            f" {json.dumps(name)}: {{\n"
            + ",\n".join(f"  {json.dumps(arch)}: {json.dumps(one)}" for arch, one in row.items())
            + "\n }"
            for name, row in table.items()
        )
        TABLE.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:] not in ([], ["--write"]):
        sys.exit("usage: python -m ptx.budgets [--write]")
    main("--write" in sys.argv[1:])
