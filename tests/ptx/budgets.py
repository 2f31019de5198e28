"""What the kernels take of a multiprocessor: registers, stack and spills, from the assembled code.

``python -m ptx.budgets`` in ``tests/`` prints the table; with ``--write`` it replaces ``budgets.json``, which the tests
hold the kernels to. PTX for sm_72 runs on every later card, so each kernel is compiled once and assembled four times.
"""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

TABLE = Path(__file__).with_name("budgets.json")
ARCHITECTURES = ("sm_72", "sm_75", "sm_87", "sm_90")
_REGISTERS = 65536  # of a multiprocessor, on all of these
_WARPS = {"sm_72": 64, "sm_75": 32, "sm_87": 48, "sm_90": 64}


def assembler() -> Path | None:
    """Return the path of ptxas from the toolkit's wheel, None where it is not installed."""
    found = importlib.util.find_spec("nvidia")
    for folder in [] if found is None else found.submodule_search_locations or []:
        path = Path(folder) / "cuda_nvcc" / "bin" / "ptxas"
        if path.exists():
            return path
    return None


def kernels() -> dict[str, Any]:
    """Return every kernel of the project by name."""
    import stereokit.pipeline_cuda  # noqa: F401 (its imports file the kernels)
    from stereokit.kernels.cuda import KERNELS

    return KERNELS


@cache
def ptx(name: str) -> str:
    """Return the PTX of a kernel for the oldest card that is supported."""
    return str(kernels()[name].ptx((7, 2)))


def resources(name: str, architecture: str) -> dict[str, int]:
    """Return registers, bytes of stack and of spills of a kernel, and the share of warps that fit, percent."""
    command = [str(assembler()), f"-arch={architecture}", "-v", "-o", "/dev/null", "-"]
    done = subprocess.run(command, input=ptx(name), capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{name} for {architecture}: {done.stderr}")
    registers = int(re.findall(r"Used (\d+) registers", done.stderr)[-1])
    stack, stores, loads = (int(x) for x in re.findall(
        r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", done.stderr)[-1])  # fmt: skip
    in_block = kernels()[name].block // 32
    blocks = _REGISTERS // (-(-registers // 8) * 8 * 32 * in_block)
    warps = min(_WARPS[architecture], blocks * in_block)
    return {
        "registers": registers, "stack": stack, "spilled": stores + loads,
        "occupancy": 100 * warps // _WARPS[architecture],
    }  # fmt: skip


def main(write: bool) -> None:
    """Print the table of all kernels; with `write`, keep it."""
    table = {}
    for name in sorted(kernels()):
        table[name] = {arch: resources(name, arch) for arch in ARCHITECTURES}
        shown = "  ".join(
            f"{arch} {found['registers']:3d} registers {found['occupancy']:3d} %" for arch, found in table[name].items()
        )
        print(f"{name:24} {shown}", flush=True)
    if write:
        text = json.dumps({n: {a: r["registers"] for a, r in row.items()} for n, row in table.items()}, indent=1)
        TABLE.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main("--write" in sys.argv[1:])
