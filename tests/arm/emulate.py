"""Run single kernels under qemu-user, compiled for another processor: compare their bits, count what they execute.

Steps, each in a process of its own, since numba decides for a processor when it is imported:

    python emulate.py record FOLDER               match small pairs; keep what the hot kernels were given and made of it
    python emulate.py compile FOLDER PROCESSOR    object files of them, PROCESSOR as in `cross.PROCESSORS`
    python emulate.py run FOLDER PROCESSOR        link, run, compare and count; prints a table
    python emulate.py write FOLDER                put the counts of both processors into executed.json

`run` needs ``qemu-user`` and, for ARM, ``gcc-aarch64-linux-gnu`` (packages of
Debian). An emulated processor has no clock worth reading: instructions are counted, by a plugin of qemu, never times.

What is counted is the second of two calls less the first, which differ in the rows that they take, by the
vectors of 64 cells that lie between: what a call does once drops out. A cost row is called once, for a row that follows
the one before.
"""

from __future__ import annotations

import importlib
import json
import pickle
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import cross

WIDTH, LEVELS = 414, 128
HEIGHTS = (16, 20)
COMPILERS = {"aarch64": "aarch64-linux-gnu-gcc", "x86_64": "gcc"}
EMULATORS = {"aarch64": "qemu-aarch64", "x86_64": "qemu-x86_64"}
C_TYPES = {"i64": "int64_t", "i32": "int32_t", "i16": "int16_t", "i8": "int8_t", "f32": "float"}


def scene(height: int, width: int) -> tuple[Any, Any]:
    """Return a textured pair whose disparity rises slowly across the image."""
    import numpy as np

    rng = np.random.default_rng(0)
    wide = rng.integers(0, 256, (height + 2, width + 2 * LEVELS)).astype(np.float32)
    wide = (wide[:-2, :-2] + wide[1:-1, 1:-1] + wide[2:, 2:]) / 3
    columns = np.arange(width)
    shift = 20 + columns // 40
    right = wide[:height, :width]
    left = right[:, np.clip(columns - shift, 0, width - 1)] + rng.normal(0, 3, (height, width))
    return np.clip(left, 0, 255).astype(np.uint8), right.astype(np.uint8)


class Recorder:
    """Cases to run elsewhere: the kernel, its flat arguments, its memory before and after."""

    def __init__(self) -> None:
        self.cases: dict[str, dict[str, Any]] = {}

    def call(self, name: str, kernel: Any, vectors: int, *arguments: Any) -> None:
        """Call a kernel; keep the first case of a name."""
        kinds = tuple(kernel.typeof_pyval(value) for value in arguments)
        memory: dict[int, Any] = {}
        flat: list[Any] = []
        for value in arguments:
            _flatten(value, flat, memory)
        rows = getattr(arguments[0], "window", arguments[0])
        if hasattr(rows, "columns"):  # the order of its pairs depends on the processor; every row writes them anew
            del memory[rows.columns.pairs.ctypes.data]
        before = {place: bytes(view) for place, view in memory.items()}
        kernel(*arguments)
        if name not in self.cases:
            self.cases[name] = {
                "module": kernel.py_func.__module__, "kernel": kernel.py_func.__name__, "kinds": kinds,
                "vectors": vectors, "flat": flat, "before": before,
                "after": {place: bytes(view) for place, view in memory.items()},
            }  # fmt: skip


def _flatten(value: Any, flat: list[Any], memory: dict[int, Any]) -> None:
    """Append what numba passes of an argument: (C type, value), or ("pointer", place)."""
    import numpy as np

    if isinstance(value, tuple):
        for part in value:
            _flatten(part, flat, memory)
    elif isinstance(value, np.ndarray):
        place = value.ctypes.data
        if value.size:
            view = value.reshape(-1).view(np.uint8).data
            if place not in memory or len(memory[place]) < len(view):
                memory[place] = view
        flat += [("i64", 0), ("i64", 0), ("i64", value.size), ("i64", value.itemsize), ("pointer", place)]
        flat += [("i64", n) for n in (*value.shape, *value.strides)]
    elif isinstance(value, bool | np.bool_):
        flat.append(("i8", int(value)))
    elif isinstance(value, np.float32):
        flat.append(("f32", float(value)))
    elif isinstance(value, np.generic):
        flat.append((f"i{8 * value.itemsize}", int(value)))
    else:
        flat.append(("i64", value))


def record(folder: Path) -> None:
    """Match small pairs of two heights; write the cases."""
    import numpy as np

    import stereokit
    from stereokit.aggregation import dt, sgm
    from stereokit.costs import census, zncc

    recorder = Recorder()
    of_cost = {
        census.CensusRows: census._census_row, census.NarrowCensusRows: census._narrow_census_row,
        zncc.ZnccRows: zncc._zncc_row, zncc.NarrowZnccRows: zncc._narrow_zncc_row,
    }  # fmt: skip
    label = ""

    def cost_rows(rows: Any, blocks: int) -> None:
        kernel = of_cost[type(rows)]
        out = np.zeros(WIDTH * blocks * 64, np.uint8)
        kernel(rows, 1, 0, WIDTH, out)
        recorder.call(
            f"{label.split('.')[0]}.{kernel.py_func.__name__}", kernel, WIDTH * blocks, rows, 2, 0, WIDTH, out
        )
        if hasattr(rows, "columns"):
            rows.columns.row[0] = -1

    def wrap(module: Any, name: str, vectors: Any, blocks: Any, costs: bool) -> None:
        kernel = getattr(module, name)

        def call(*arguments: Any) -> None:
            if ("narrow" in name) != ("+narrow" in label):  # the coarse map, for a search that is narrow behind it
                kernel(*arguments)
                return
            if costs:
                cost_rows(arguments[0], blocks(arguments))
            recorder.call(f"{label}.{name}", kernel, vectors(arguments), *arguments)

        setattr(module, name, call)

    def wide(a: Any) -> int:
        return len(a[1].blocks)

    wrap(sgm, "first_visit", lambda a: abs(a[5] - a[4]) * WIDTH * wide(a), wide, True)
    wrap(sgm, "_last_visit", lambda a: abs(a[5] - a[4]) * WIDTH * wide(a), wide, False)
    wrap(sgm, "first_narrow_visit", lambda a: abs(a[5] - a[4]) * WIDTH, lambda a: 1, True)
    wrap(sgm, "_last_narrow_visit", lambda a: abs(a[5] - a[4]) * WIDTH, lambda a: 1, False)
    wrap(dt, "_produce_rows", lambda a: (a[5] - a[4]) * WIDTH * len(a[1]), lambda a: len(a[1]), False)
    wrap(dt, "_filter_band", lambda a: a[1].shape[0] * (a[4] - a[3]) * len(a[0]), lambda a: len(a[0]), False)
    for method in ("S1", "S2", "S3", "S4"):
        for search in ("full", "coarse-to-fine") if method in ("S2", "S4") else ("full",):
            for height in HEIGHTS:
                label = f"{method}{'+narrow' if search != 'full' else ''}.{height}"
                left, right = scene(height, WIDTH)
                stereokit.Matcher(method, max_disparity=LEVELS, search=search, threads=1)(left, right)
    (folder / "cases").write_bytes(_dumps(recorder.cases))


def _dumps(value: Any) -> bytes:
    from numba.core.serialize import dumps

    return dumps(value)


def compile_(folder: Path, processor: str, only: str = "") -> None:
    """Write the object file and the name of the entry of every case's kernel."""
    cross.pretend(processor)
    import stereokit.matching  # noqa: F401 (its types come before the signatures)

    entries: dict[str, Any] = {}
    done: dict[Any, str] = {}
    for name, case in pickle.loads((folder / "cases").read_bytes()).items():
        if not re.search(only, name):
            continue
        key = case["module"], case["kernel"], case["kinds"]
        if key not in done:
            kernel = getattr(importlib.import_module(case["module"]), case["kernel"])
            kernel.compile(case["kinds"])
            overload = kernel.overloads[case["kinds"]]
            library = overload.library
            done[key] = f"{len(done)}"
            library._ensure_finalized()
            machine = library.codegen._tm
            (folder / f"{done[key]}.{processor}.o").write_bytes(machine.emit_object(library._final_module))
        kernel = getattr(importlib.import_module(case["module"]), case["kernel"])
        overload = kernel.overloads[case["kinds"]]
        loop = cross.largest_loop(overload.library.get_asm_str())
        entries[name] = done[key], overload.fndesc.mangled_name, loop
    (folder / f"{processor}.json").write_text(json.dumps(entries), encoding="utf-8")


MAIN = """
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
int32_t kernel(void *, void *, {types}) __asm__("{entry}");
int main(int count, char **names) {{
    FILE *in = fopen(names[1], "rb"), *out;
    static char *memory[{buffers}];
    static long sizes[{buffers}] = {{{sizes}}};
    char *result = 0, *error = 0;
    for (int n = 0; n < {buffers}; n++) {{
        memory[n] = (char *)aligned_alloc(64, (sizes[n] + 4096) / 64 * 64) + {margin};
        if (fread(memory[n], 1, sizes[n], in) != (size_t)sizes[n]) return 2;
    }}
    if (kernel(&result, &error, {values})) return 3;
    out = fopen(names[2], "wb");
    for (int n = 0; n < {buffers}; n++) fwrite(memory[n], 1, sizes[n], out);
    return fclose(out);
}}
"""


def build(folder: Path, processor: str, name: str, case: dict[str, Any], number: str, entry: str) -> Path:
    """Link a program that runs one case: it reads the memory before, and writes the memory after."""
    places = sorted(case["before"])
    whole: list[int] = []  # arrays that are parts of others share their memory
    for place in places:
        if not whole or place + len(case["before"][place]) > whole[-1] + len(case["before"][whole[-1]]):
            whole.append(place)
    types, values = [], []
    for n, (kind, value) in enumerate(case["flat"]):
        if kind != "pointer":
            types.append(C_TYPES[kind])
            values.append(f"({C_TYPES[kind]}){value!r}" + ("LL" if kind == "i64" else ""))
            continue
        types.append("void *")
        home = max((place for place in whole if place <= value), default=None)
        inside = home is not None and value < home + len(case["before"][home])
        size = case["flat"][n - 2][1] * case["flat"][n - 1][1]
        values.append(f"memory[{whole.index(home)}] + {value - home}" if inside else f"calloc(1, {size})")
    sizes = ", ".join(str(len(case["before"][place])) for place in whole)
    text = MAIN.format(
        types=", ".join(types), entry=entry, buffers=len(whole), sizes=sizes, values=", ".join(values), margin=1024
    )
    stem = folder / f"{processor}.{name}"
    Path(f"{stem}.c").write_text(text, encoding="utf-8")
    Path(f"{stem}.in").write_bytes(b"".join(case["before"][place] for place in whole))
    Path(f"{stem}.expected").write_bytes(b"".join(case["after"][place] for place in whole))
    compiler = COMPILERS[cross.PROCESSORS[processor].triple.split("-")[0]]
    command = [compiler, "-O1", "-static", "-Wl,--unresolved-symbols=ignore-all", f"{stem}.c"]
    subprocess.run([*command, str(folder / f"{number}.{processor}.o"), "-lm", "-o", str(stem)], check=True)
    return stem


PLUGIN = """
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
int qemu_plugin_version = 1;  /* what follows is declared here: Debian has no package of the header */
void qemu_plugin_register_vcpu_tb_trans_cb(uint64_t, void (*)(uint64_t, void *));
void qemu_plugin_register_atexit_cb(uint64_t, void (*)(uint64_t, void *), void *);
size_t qemu_plugin_tb_n_insns(void *);
void *qemu_plugin_tb_get_insn(void *, size_t);
uint64_t qemu_plugin_insn_vaddr(void *);
void qemu_plugin_register_vcpu_insn_exec_inline(void *, int, void *, uint64_t);
static uint64_t start, end, *counts;
static char out[4096];
static void translated(uint64_t id, void *block) {
    for (size_t k = 0; k < qemu_plugin_tb_n_insns(block); k++) {
        void *instruction = qemu_plugin_tb_get_insn(block, k);
        uint64_t place = qemu_plugin_insn_vaddr(instruction);
        if (place >= start && place < end)
            qemu_plugin_register_vcpu_insn_exec_inline(instruction, 0, &counts[place - start], 1);
    }
}
static void leave(uint64_t id, void *unused) {
    FILE *file = fopen(out, "w");
    for (uint64_t k = 0; k < end - start; k++)
        if (counts[k]) fprintf(file, "%lx %lu\\n", start + k, counts[k]);
    fclose(file);
}
int qemu_plugin_install(uint64_t id, const void *info, int count, char **words) {
    start = strtoull(strchr(words[0], '=') + 1, 0, 16);
    end = strtoull(strchr(words[1], '=') + 1, 0, 16);
    strcpy(out, strchr(words[2], '=') + 1);
    counts = calloc(end - start, sizeof *counts);
    qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
    qemu_plugin_register_atexit_cb(id, leave, 0);
    return 0;
}
"""


def executed(stem: Path, processor: str, entry: str) -> tuple[bool, Counter[int]]:
    """Run a program; tell whether its memory is as expected, and how often each of its instructions ran."""
    kind = cross.PROCESSORS[processor]
    plugin = stem.parent / "plugin.so"
    if not plugin.exists():
        source = plugin.with_suffix(".c")
        source.write_text(PLUGIN, encoding="utf-8")
        subprocess.run(["gcc", "-O1", "-shared", "-fPIC", str(source), "-o", str(plugin)], check=True)
    # From the first to the last function of the object file.
    start, end = extent(stem, entry)
    counted = f"{stem}.counts"
    emulator = [EMULATORS[kind.triple.split("-")[0]], "-cpu", kind.emulated]
    emulator += ["-plugin", f"{plugin},start={start:x},end={end:x},out={counted}"]
    subprocess.run([*emulator, str(stem), f"{stem}.in", f"{stem}.out"], check=True)
    same = Path(f"{stem}.out").read_bytes() == Path(f"{stem}.expected").read_bytes()
    lines = Path(counted).read_text(encoding="utf-8").splitlines()
    return same, Counter({int(place, 16): int(count) for place, count in map(str.split, lines)})


def extent(stem: Path, entry: str) -> tuple[int, int]:
    """Return the addresses of the code that came with a kernel: functions whose names numba mangled."""
    text = subprocess.run(["nm", "-n", "--defined-only", str(stem)], capture_output=True, text=True, check=True).stdout
    symbols = [(int(line.split()[0], 16), line.split()[2]) for line in text.splitlines()]
    mine = [k for k, (_, name) in enumerate(symbols) if name.startswith(("_ZN9stereokit", "_ZN7cpython", "_ZN5numba"))]
    assert symbols[mine[0]][0] <= dict((name, place) for place, name in symbols)[entry]
    return symbols[mine[0]][0], symbols[mine[-1] + 1][0]


def run(folder: Path, processor: str, only: str = "") -> None:
    """Link, run, compare and count the cases; print a table."""
    cases = pickle.loads((folder / "cases").read_bytes())
    entries = json.loads((folder / f"{processor}.json").read_text(encoding="utf-8"))
    totals: dict[str, tuple[bool, int, int]] = {}
    for name, (number, entry, _) in entries.items():
        if not re.search(only, name):
            continue
        stem = build(folder, processor, name, cases[name], number, entry)
        same, counts = executed(stem, processor, entry)
        totals[name] = same, counts.total(), cases[name]["vectors"]
    table: dict[str, Any] = {}
    for name, (same, total, vectors) in totals.items():
        method, *height, kernel = name.split(".")
        if not height:
            table[name] = same, total / vectors
        elif int(height[0]) == HEIGHTS[1]:
            less = totals[f"{method}.{HEIGHTS[0]}.{kernel}"]
            table[f"{method}.{kernel}"] = same and less[0], (total - less[1]) / (vectors - less[2])
    for name, (same, per_vector) in table.items():
        print(f"{processor:8} {name:28} {'same bits' if same else 'OTHER BITS':10} {per_vector:8.1f}", flush=True)
    (folder / f"{processor}.result.json").write_text(json.dumps(table), encoding="utf-8")
    if not all(same for same, _ in table.values()):
        raise SystemExit("kernels gave other bits")


def write(folder: Path) -> None:
    """Write what kernels execute, and the sizes of their largest loops on ARM, beside this file."""
    neon, avx2 = (json.loads((folder / f"{name}.result.json").read_text(encoding="utf-8")) for name in ("neon", "avx2"))
    entries = json.loads((folder / "neon.json").read_text(encoding="utf-8"))
    lines = []
    for name, (_, count) in neon.items():
        case = name if name in entries else f"{HEIGHTS[1]}.".join((name.split(".")[0] + ".", name.split(".")[1]))
        table = {"neon": round(count, 1), "avx2": round(avx2[name][1], 1), "loop": entries[case][2]}
        lines.append(f" {json.dumps(name)}: {json.dumps(table)}")
    text = "{\n" + ",\n".join(lines) + "\n}\n"
    Path(__file__).with_name("executed.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    step, place, *rest = sys.argv[1:]
    Path(place).mkdir(exist_ok=True)
    {"record": record, "compile": compile_, "run": run, "write": write}[step](Path(place), *rest)
