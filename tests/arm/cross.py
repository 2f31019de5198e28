"""Compile the kernels of some methods for 64-bit ARM, on any machine, and count what their machine code does.

Two steps, each in a process of its own, since numba decides for a processor when it is imported:

    python cross.py record SIGNATURES           match a small pair, and keep what types the kernels were called with
    python cross.py count SIGNATURES COUNTS     compile for these types, without running anything

The methods have every hot kernel between them: both costs, both aggregations, the selection, both searches.
"""

from __future__ import annotations

import importlib
import json
import os
import pickle
import re
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple


class Processor(NamedTuple):
    """What to compile for, and which processor of qemu runs it."""

    triple: str
    name: str  # LLVM's
    bits: int  # of the widest vectors
    emulated: str


PROCESSORS = {
    "neon": Processor("aarch64-unknown-linux-gnu", "generic", 128, "cortex-a72"),
    "avx2": Processor("x86_64-unknown-linux-gnu", "haswell", 256, "Haswell"),
}
METHODS = (("S2", "full"), ("S3", "full"), ("S2", "coarse-to-fine"), ("S4", "coarse-to-fine"))
HOT = (
    "first_visit", "_last_visit", "_produce_rows", "_filter_band", "_census_row", "_zncc_row", "select_row",
    "first_narrow_visit", "_last_narrow_visit", "_narrow_census_row", "_narrow_zncc_row",
)  # fmt: skip
"""Kernels that a frame's time goes to, by the name of their function."""

KINDS = {
    # a lane of a vector to a general register or back, one at a time: the mark of scalarised code
    "lane_moves": r"(?:umov|smov)\b"
    r"|mov\t[wx]\d+, v\d+\.[bhsd]\["
    r"|(?:mov|ins)\tv\d+\.[bhsd]\[\d+\], [wx]"
    r"|fmov\t(?:[wx]\d+, [sd]\d+|[sd]\d+, [wx]\d+)",
    # vectors that did not fit in registers
    "stack": r"(?:ldr|str|ldur|stur|ldp|stp)\tq\d+, (?:q\d+, )?\[(?:sp|x29)",
    "cnt": r"cnt\tv|cnt\.",
    "uqadd": r"uqadd\b",
    "umin": r"umin\b",
    "ext": r"ext\b",
    "vector": r"\w+\tv\d+\.|\w+\.(?:16b|8b|8h|4h|4s|2s|2d)\t",
    "all": r"[a-z]",
}


def record(path: str) -> None:
    """Match a pair with each method; write the signatures of the hot kernels."""
    import numpy as np
    from numba.core.dispatcher import Dispatcher
    from numba.core.serialize import dumps

    import stereokit

    image = np.random.default_rng(0).integers(0, 256, (24, 80), dtype=np.uint8)
    for method, search in METHODS:
        stereokit.Matcher(method, max_disparity=128, search=search, threads=1)(image, image)
    signatures = {}
    for name, module in sorted(sys.modules.items()):
        for key in HOT:
            kernel = vars(module).get(key) if name.startswith("stereokit.") else None
            if isinstance(kernel, Dispatcher) and kernel.py_func.__module__ == name and kernel.signatures:
                signatures[name, key] = [tuple(signature) for signature in kernel.signatures]
    Path(path).write_bytes(dumps(signatures))


def pretend(processor: str) -> None:
    """Let numba compile for a processor, and the package take it for this one; before either is imported.

    Raises RuntimeError where LLVM cannot.
    """
    triple, name, bits, _ = PROCESSORS[processor]
    os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = name, ""
    import llvmlite.binding as binding
    from llvmlite.binding import targets

    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    binding.get_process_triple = targets.get_process_triple = lambda: triple
    binding.Target.from_triple(triple)
    binding.Target.from_default_triple = classmethod(lambda cls: cls.from_triple(triple))
    from stereokit.kernels.simd import arithmetic

    arithmetic.vector_bits = lambda: bits
    arithmetic.config = SimpleNamespace(CPU_NAME=None)  # named, it would count as one that has 128 bits


def count(signatures: str, out: str) -> None:
    """Compile for ARM and write how often each kind of instruction stands in a kernel's code."""
    try:
        pretend("neon")
    except RuntimeError as error:
        Path(out).write_text(json.dumps({"missing": str(error)}), encoding="utf-8")
        return
    import stereokit.matching  # noqa: F401 (its types come before the signatures)

    table = {}
    for (name, key), overloads in pickle.loads(Path(signatures).read_bytes()).items():
        kernel = getattr(importlib.import_module(name), key)
        for number, signature in enumerate(overloads):
            kernel.compile(signature)
            text = kernel.inspect_asm(signature)
            table[f"{key}.{number}" if number else key] = counted(text)
    Path(out).write_text(json.dumps(table), encoding="utf-8")


def counted(text: str) -> dict[str, int]:
    """Return the number of instructions of each kind in a text of assembly."""
    lines = [line.strip() for line in text.splitlines() if line.startswith("\t") and not line.startswith("\t.")]
    counts = Counter({kind: 0 for kind in KINDS})
    for line in lines:
        counts.update(kind for kind, pattern in KINDS.items() if re.match(pattern, line))
    return {**counts, "loop": largest_loop(text)}


def largest_loop(text: str) -> int:
    """Return the number of instructions of the largest loop that has no loop in it, each counted once."""
    sizes, after, places = [0], [[]], {}
    falls = [True]
    for line in text.splitlines():
        if label := re.match(r"(\.?\w+):", line):
            places[label[1]] = len(sizes)
        elif not line.startswith("\t") or line.startswith("\t."):
            continue
        else:
            sizes[-1] += 1
            branch = re.match(r"\t(b|b\.\w+|cbn?z|tbn?z|ret|br)\b(?:.*\s(\.LBB\w+))?", line)
            if branch is None:
                continue
            after[-1] += [branch[2]] if branch[2] else []
            falls[-1] = branch[1] not in ("b", "br", "ret")
        sizes.append(0)
        after.append([])
        falls.append(True)
    follow = [
        {places[label] for label in after[n] if label in places}
        | ({n + 1} if falls[n] and n + 1 < len(sizes) else set())
        for n in range(len(sizes))
    ]
    before: list[set[int]] = [set() for _ in sizes]
    for n, targets in enumerate(follow):
        for target in targets:
            before[target].add(n)
    loops: dict[int, set[int]] = {}
    for last, heads in enumerate(follow):
        for head in (head for head in heads if head <= last):
            body = loops.setdefault(head, {head})
            waiting = {last} - body
            while waiting:
                body |= waiting
                waiting = set().union(*(before[n] for n in waiting)) - body
    inner = [body for head, body in loops.items() if not any(other in body for other in loops if other != head)]
    return max((sum(sizes[n] for n in body) for body in inner), default=0)


if __name__ == "__main__":
    {"record": record, "count": count}[sys.argv[1]](*sys.argv[2:])
