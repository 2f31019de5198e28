"""The hot kernels as machine code of 64-bit ARM, compiled here: vectors stay vectors and stay in registers.

The budgets in ``budgets.json`` are counts of instructions; other versions of LLVM get some room. `executed.json` has
what kernels execute per 64 cells on ARM and on x86 with AVX2, counted by ``emulate.py``, which also holds their bits to
those of this processor. That takes minutes and an emulator, so its counts are kept, beside the size of each kernel's
largest loop at that time: here the loops are held to that size.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

HERE = Path(__file__).parent
BUDGET = json.loads((HERE / "budgets.json").read_text(encoding="utf-8"))
EXECUTED = json.loads((HERE / "executed.json").read_text(encoding="utf-8"))
ROOM, FEW = 1.3, 24
"""Share and number by which another version of the compiler may exceed a budget."""

ZNCC_ROW = 250
"""Instructions that a row of ZNCC may execute per 64 cells."""

ABOVE_AVX2 = 1.3
"""How many times those of AVX2 the kernels of the narrow search may execute."""

LOOP_ROOM = 1.05
"""Share by which a loop may exceed the one whose instructions were counted."""

USED = {
    "first_visit": ("cnt", "uqadd", "umin", "ext"),
    "_last_visit": ("uqadd", "umin", "ext"),
    "_census_row": ("cnt",),
    "select_row": ("umin",),
}
"""Instructions that stand for a whole operation: without them LLVM wrote it out in several."""

LOOPS = ("_census_row", "_zncc_row", "_narrow_census_row", "_narrow_zncc_row")
"""Kernels whose largest loop takes most of their time."""


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


def test_a_row_of_zncc_executes_few_instructions(counts):
    rest = EXECUTED["S4._zncc_row"]["neon"] - EXECUTED["S4._zncc_row"]["loop"]  # pairs, the first columns, the mask
    assert 0 < rest < 20
    assert counts["_zncc_row"]["loop"] + rest <= ZNCC_ROW


def test_narrow_kernels_execute_little_more_than_with_avx2():
    ratios = {name: table["neon"] / table["avx2"] for name, table in EXECUTED.items() if "narrow" in name}
    assert len(ratios) == 6
    assert not {name: ratio for name, ratio in ratios.items() if ratio > ABOVE_AVX2}


def test_loops_are_those_whose_instructions_were_counted(counts):
    now = {name: counts[name.split(".")[-1]]["loop"] for name in EXECUTED if name.split(".")[-1] in LOOPS}
    over = {name: (now[name], EXECUTED[name]["loop"]) for name in now if now[name] > LOOP_ROOM * EXECUTED[name]["loop"]}
    assert len(now) == len(LOOPS) and not over


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
    assert table["loop"] == 0
    expected = {"lane_moves": 3, "stack": 2, "cnt": 1, "uqadd": 1, "umin": 0, "ext": 1, "all": 11}
    assert {kind: table[kind] for kind in expected} == expected


def test_the_largest_loop_without_a_loop_in_it():
    import importlib.util

    spec = importlib.util.spec_from_file_location("cross", HERE / "cross.py")
    cross = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(cross)
    inner = [".LBB0_2:  // a comment", "\tsub\tx1, x1, #1", "\tcbz\tx1, .LBB0_4", "\tnop", "\ttbnz\tw2, #3, .LBB0_2"]
    outer = [".LBB0_1:", *["\tadd\tx0, x0, #1"] * 9, *inner, "\tb.ne\t.LBB0_1", ".LBB0_4:", "\tret"]
    assert cross.largest_loop("\n".join(["f:", "\tmov\tx0, x1", *outer])) == 4
    assert cross.largest_loop("f:\n\tmov\tx0, x1\n\tret\n") == 0
    between = [".LBB1_2:", *["\tnop"] * 50, "\tret"]
    parts = ["g:", ".LBB1_1:", "\tb\t.LBB1_3", *between, ".LBB1_3:", "\tb.eq\t.LBB1_1", "\tret"]
    assert cross.largest_loop("\n".join(parts)) == 2  # what lies between does not count
