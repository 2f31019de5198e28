"""The hot kernels as machine code of 64-bit ARM, compiled here: vectors stay vectors and stay in registers.

The budgets in ``budgets.json`` are counts of instructions; other versions of LLVM get some room. That the maps are
those of x86 was shown under emulation once (``docs/platforms.md``); this is about what makes it fast.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

HERE = Path(__file__).parent
BUDGET = json.loads((HERE / "budgets.json").read_text(encoding="utf-8"))
ROOM, FEW = 1.3, 24
"""Share and number by which another version of the compiler may exceed a budget."""

USED = {
    "first_visit": ("cnt", "uqadd", "umin", "ext"),
    "_last_visit": ("uqadd", "umin", "ext"),
    "_census_row": ("cnt",),
    "select_row": ("umin",),
}
"""Instructions that stand for a whole operation: without them LLVM wrote it out in several."""


@pytest.fixture(scope="module")
def counts(run_python, tmp_path_factory):
    """Return the number of instructions of each kind, by the kernel's name."""
    folder = tmp_path_factory.mktemp("arm")
    # Caches of their own: what comes out of a cache has no assembly, and its inner kernels no signatures.
    cache = {"NUMBA_CACHE_DIR": str(folder / "cache")}
    run_python(HERE / "cross.py", "record", folder / "signatures", NUMBA_OPT="0", **cache)  # types are all we want
    cache = {"NUMBA_CACHE_DIR": str(folder / "cross-cache")}
    run_python(HERE / "cross.py", "count", folder / "signatures", folder / "counts.json", **cache)
    table = json.loads((folder / "counts.json").read_text(encoding="utf-8"))
    if "missing" in table:
        pytest.skip(f"llvmlite cannot compile for 64-bit ARM here: {table['missing']}")
    return table


def test_every_hot_kernel_is_compiled_and_has_a_budget(counts):
    assert set(counts) == set(BUDGET)
    assert all(table["vector"] > 50 for table in counts.values())


@pytest.mark.parametrize("kind", ["lane_moves", "stack", "all"])
def test_kernels_stay_in_their_budgets(counts, kind):
    over = {
        name: (table[kind], BUDGET[name][kind])
        for name, table in counts.items()
        if table[kind] > ROOM * BUDGET[name][kind] + FEW
    }
    assert not over, f"{kind} of (now, budget): {over}"


def test_one_instruction_does_what_one_instruction_can(counts):
    assert all(counts[name][kind] > 0 for name, kinds in USED.items() for kind in kinds)


def test_what_is_counted():
    import importlib.util

    spec = importlib.util.spec_from_file_location("cross", HERE / "cross.py")
    cross = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(cross)
    text = "\n".join(
        f"\t{line}"
        for line in (
            ".p2align\t2",
            "umov\tw8, v0.b[3]",
            "mov\tv1.s[1], w9",
            "fmov\tw0, s1",
            "mov\tv0.16b, v1.16b",
            "ldp\tq0, q1, [sp, #32]",
            "str\tq0, [x29, #-16]",
            "ldr\tq0, [x1]",
            "cnt\tv0.16b, v0.16b",
            "uqadd\tv0.16b, v0.16b, v1.16b",
            "ext\tv0.16b, v0.16b, v1.16b, #15",
            "mov\tx0, x1",
        )
    )
    table = cross.counted(f"kernel:\n{text}\n")
    expected = {"lane_moves": 3, "stack": 2, "cnt": 1, "uqadd": 1, "umin": 0, "ext": 1, "all": 11}
    assert {kind: table[kind] for kind in expected} == expected
