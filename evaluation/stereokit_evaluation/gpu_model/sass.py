"""The assembled code of a CUDA kernel, without a GPU: registers, instructions by execution unit, and loops.

PTX goes through ptxas and nvdisasm, both from PyPI (``stereokit[cuda-test]``). The instructions that a warp executes
follow from the code, from the number of its passes of the kernel's hot loop, and from the memory accesses of a pass in
the source: compilers unroll loops, so that one pass of the assembled loop may be several of the source's, by the ratio
of their accesses. Both sides of a branch inside the loop count, as where lanes of a warp differ.

nvdisasm of CUDA 13 does not read code for Volta (sm_72); the code of its sibling sm_75, which has the same instruction
set, stands in for it. Registers are those of ptxas for sm_72 itself.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stereokit.errors import DeviceError

__all__ = [
    "ARCHITECTURES",
    "DISASSEMBLED",
    "UNITS",
    "Code",
    "Resources",
    "code_of",
    "outer_loops",
    "parse_sass",
    "require_tools",
    "resources",
    "tool",
    "warps_that_fit",
]

ARCHITECTURES = ("sm_72", "sm_75", "sm_87", "sm_90")
"""Target architectures: Xavier, Turing, Orin (and its desktop siblings sm_80 and sm_86), Hopper."""

_REGISTERS = 65536  # of a multiprocessor, on all of these
_WARPS = {"sm_72": 64, "sm_75": 32, "sm_87": 48, "sm_90": 64}
DISASSEMBLED = {"sm_72": "sm_75"}
"""Architectures that nvdisasm does not read, and whose code stands in for theirs."""

UNITS = {
    "memory": "LDG STG ATOMG ATOM RED REDG",
    "shuffle": "SHFL LDS STS",
    "convert": "MUFU I2F F2I F2F POPC FLO BREV",
    "float": "FADD FMUL FFMA",
    "multiply": "IMAD IDP HFMA2",
    "integer": "FMNMX FSEL FSETP FCHK I2FP IABS IADD3 IMNMX ISETP LEA LOP3 MOV P2R PLOP3 PRMT SEL SHF "
    "VIADD VIADDMNMX VIMNMX VIMNMX3 VOTE",
}
"""Opcodes of each execution unit; all others (branches, the uniform data path) only take a slot of the scheduler."""

_UNIT_OF = {opcode: unit for unit, opcodes in UNITS.items() for opcode in opcodes.split()}


def tool(name: str) -> Path | None:
    """Return the path of a tool of the CUDA toolkit, from its wheels or the search path; None where there is none."""
    package = importlib.util.find_spec("nvidia")
    for folder in [] if package is None else package.submodule_search_locations or []:
        # in reverse, cuda_nvcc before cu13, whose ptxas does not know sm_72
        for path in sorted(Path(folder).glob(f"*/bin/{name}"), reverse=True):
            return path
    path_on_system = shutil.which(name)
    return None if path_on_system is None else Path(path_on_system)


def require_tools() -> None:
    """Raise DeviceError, with the packages to install, unless kernels can be compiled and disassembled here."""
    missing = [name for name in ("ptxas", "nvdisasm") if tool(name) is None]
    if importlib.util.find_spec("numba_cuda") is None:
        missing.insert(0, "numba-cuda")
    if missing:
        raise DeviceError(f"the model needs {', '.join(missing)}: pip install 'stereokit[cuda-test]' (on Linux)")


@dataclass(frozen=True)
class Resources:
    """The resources of a kernel on a multiprocessor.

    Attributes
    ----------
    registers : int
        Of a thread.
    stack, spilled : int
        Bytes of a thread; 0 where all is in registers.
    """

    registers: int
    stack: int
    spilled: int


def _run(command: list[Any], text: str | None = None) -> Any:
    process = subprocess.run([str(word) for word in command], input=text, capture_output=True, text=True, check=False)
    if process.returncode:
        lines = (process.stderr or process.stdout).strip().splitlines() or ["no message"]
        raise DeviceError(f"{Path(command[0]).name} must take the kernel, but it says: {lines[0]}")
    return process


def resources(ptx: str, architecture: str, cubin: Path | None = None) -> Resources:
    """Assemble a kernel and return its resources; the code goes to `cubin`, if any."""
    command = [tool("ptxas"), f"-arch={architecture}", "-v", "-o", cubin or "/dev/null", "-"]
    listing = _run(command, ptx).stderr
    registers = int(re.findall(r"Used (\d+) registers", listing)[-1])
    stack, stores, loads = (int(x) for x in re.findall(
        r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", listing)[-1])  # fmt: skip
    return Resources(registers, stack, stores + loads)


def warps_that_fit(registers: int, block: int, architecture: str) -> tuple[int, int]:
    """Return the number of resident warps of a kernel on a multiprocessor, and the bound without registers."""
    in_block = block // 32
    blocks = _REGISTERS // (-(-registers // 8) * 8 * 32 * in_block)
    most = _WARPS[architecture]
    return min(most, blocks * in_block), most


@dataclass(frozen=True)
class Code:
    """Instructions of a kernel, as the unit that executes each, and its loops.

    Attributes
    ----------
    units : tuple of str
        A name of `UNITS` or ``"other"``, instruction by instruction.
    loops : tuple of (int, int)
        First instruction of each loop and the one after its last, loops within others left out.
    """

    units: tuple[str, ...]
    loops: tuple[tuple[int, int], ...]

    def hot(self, accesses: float | None = None) -> tuple[int, int]:
        """Return the loop with most instructions to a pass, or all of the code where there is no loop."""

        def weight(loop: tuple[int, int]) -> float:
            return (loop[1] - loop[0]) / self._unrolled([loop], accesses)

        return max(self.loops, key=weight, default=(0, len(self.units)))

    def _unrolled(self, loops: Sequence[tuple[int, int]], accesses: float | None) -> float:
        """Return the number of the source's passes in one pass of these loops."""
        count = sum(self.units[first:end].count("memory") for first, end in loops)
        return count / accesses if accesses is not None and count else 1.0

    def executed(self, passes: float, accesses: float | None, every: bool) -> Counter[str]:
        """Return the number of instructions of a warp, by unit.

        Parameters
        ----------
        passes : float
            Passes of the source's hot loop.
        accesses : float or None
            Memory accesses of one pass, which determine the unrolling; None takes the code as it is.
        every : bool
            Whether all loops together are the hot loop, one after the other, instead of one alone.
        """
        total: Counter[str] = Counter(self.units)
        if not self.loops:
            return total
        for first, end in self.loops:
            total.subtract(self.units[first:end])
        chosen = self.loops if every else (self.hot(accesses),)
        times = passes / self._unrolled(chosen, accesses)
        for first, end in chosen:
            for unit, count in Counter(self.units[first:end]).items():
                total[unit] += count * times  # type: ignore[assignment]
        return total


def outer_loops(branches: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Return the loops, of (branch, target) places, that lie in no other one; a branch to itself is none."""
    loops: list[tuple[int, int]] = []
    for first, end in sorted((target, place + 1) for place, target in branches if target < place):
        if loops and first < loops[-1][1]:
            loops[-1] = loops[-1][0], max(loops[-1][1], end)
        else:
            loops.append((first, end))
    return tuple(loops)


def parse_sass(text: str) -> Code:
    """Return the code from the output of nvdisasm."""
    labels: dict[str, int] = {}
    lines: list[str] = []
    for line in text.splitlines():
        if label := re.match(r"\s*(\.L_\w+):", line):
            labels[label[1]] = len(lines)
        elif one := re.search(r"/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+\s+)?([A-Z].*?)\s*;", line):
            lines.append(one[1])
    while lines and lines[-1].startswith("NOP"):
        lines.pop()
    branches = [
        (place, labels[target[1]])
        for place, line in enumerate(lines)
        if (target := re.match(r"BRA\b.*?(\.L_\w+)", line)) and target[1] in labels
    ]
    units = (_UNIT_OF.get(re.split(r"[.\s]", line)[0], "other") for line in lines)
    return Code(tuple(units), outer_loops(branches))


def code_of(ptx: str, architecture: str) -> tuple[Code, Resources]:
    """Assemble and disassemble a kernel; for sm_72 the code is that for sm_75, the registers are its own."""
    with tempfile.TemporaryDirectory() as folder:
        cubin = Path(folder) / "kernel.cubin"
        kernel_resources = resources(ptx, DISASSEMBLED.get(architecture, architecture), cubin)
        code = parse_sass(_run([tool("nvdisasm"), "-c", cubin]).stdout)
    return code, kernel_resources if architecture not in DISASSEMBLED else resources(ptx, architecture)
