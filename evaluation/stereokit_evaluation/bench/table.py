"""The result of ``stereokit bench``, as tables and as JSON.

Times are milliseconds, memory is MB of 10**6 bytes. Ratios compare medians of the same size and number of threads.
"""

from __future__ import annotations

import os
import platform
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console

from stereokit.cli.output import Table
from stereokit.kernels.simd import vector_bits
from stereokit.kernels.threads import available_threads
from stereokit_evaluation.bench.baselines import BASELINES, HH, THREE_WAY, label, usable_levels
from stereokit_evaluation.bench.timing import Spread, ratio, spread
from stereokit_evaluation.common import environment
from stereokit_evaluation.common.sizes import Size

__all__ = [
    "BenchResult",
    "as_json",
    "format_ms",
    "machine",
    "new_table",
    "print_tables",
    "system_load",
    "versions",
]


@dataclass
class BenchResult:
    """All measurements; after an interrupt, those so far.

    Attributes
    ----------
    methods : list of str
        Our methods; all other contenders are baselines.
    sizes, threads, rounds
        The options of the run.
    times : dict
        Size's name and number of threads to contender to seconds of each run.
    memory : dict
        Size's name and contender to MB added, None if unknown.
    first : dict
        Method to seconds ``import_s`` and ``call_s``, at `first_size`.
    stages : dict
        Size's name and method to stage to milliseconds, one thread.
    allocated : dict
        Size's name and method to bytes that a call in steady state takes above the maps that it returns, one thread.
    skipped : list of dict
        Contenders that were left out, with the reasons.
    interrupted : bool
        Whether the user interrupted it.
    load : list of float or None
        The system's load (1, 5 and 15 minutes) at the start: times from a busy machine are worth little.
    """

    methods: list[str]
    sizes: list[Size]
    threads: list[int]
    rounds: int
    times: dict[tuple[str, int], dict[str, list[float]]] = field(default_factory=dict)
    memory: dict[tuple[str, str], float | None] = field(default_factory=dict)
    first: dict[str, dict[str, float]] = field(default_factory=dict)
    first_size: str | None = None
    stages: dict[tuple[str, str], dict[str, float]] = field(default_factory=dict)
    allocated: dict[tuple[str, str], int] = field(default_factory=dict)
    skipped: list[dict[str, Any]] = field(default_factory=list)
    interrupted: bool = False
    load: list[float] | None = field(default_factory=lambda: system_load())

    def skip(self, size: Size, contender: str, threads: int, reason: str) -> None:
        """Record that a contender was left out."""
        self.skipped.append({"size": size.name, "contender": contender, "threads": threads, "reason": reason})

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per size, contender and number of threads, as the JSON has it under ``results``."""
        rows: list[dict[str, Any]] = []
        for size in self.sizes:
            for threads in self.threads:
                times = self.times.get((size.name, threads), {})
                spreads = {key: spread([1e3 * t for t in seconds]) for key, seconds in times.items() if seconds}
                for key, own in spreads.items():
                    rows.append(
                        {
                            "size": size.name,
                            "contender": label(key),
                            "key": key,
                            "kind": "method" if key in self.methods else "peer",
                            "threads": threads,
                            "runs": own.runs,
                            "median_ms": own.median,
                            "q25_ms": own.q25,
                            "q75_ms": own.q75,
                            "min_ms": own.least,
                            "x_hh": ratio(spreads.get(HH), own),
                            "x_3way": ratio(spreads.get(THREE_WAY), own),
                            "mde_per_s": _throughput(size, own),
                            "samples_ms": [1e3 * t for t in times[key]],
                        }
                    )
        return rows


def _throughput(size: Size, times: Spread) -> float | None:
    return size.cells / times.median / 1e3 if times.median > 0 else None


def as_json(result: BenchResult, options: dict[str, Any]) -> dict[str, Any]:
    """Return all measurements with their conditions."""
    max_threads = max(result.threads)

    def entry(size: str | None, key: str, threads: int, **values: Any) -> dict[str, Any]:
        return {"size": size, "contender": label(key), "key": key, "threads": threads, **values}

    return {
        "results": result.rows(),
        "memory": [
            entry(size, key, max_threads, mb=amount, of_hh=_share(result, size, key))
            for (size, key), amount in result.memory.items()
        ],
        "first_call": [entry(result.first_size, key, max_threads, **seconds) for key, seconds in result.first.items()],
        "stages": [
            entry(size, key, 1, ms=stages, allocated_bytes=result.allocated.get((size, key)))
            for (size, key), stages in result.stages.items()
        ],
        "skipped": result.skipped,
        "sizes": {
            size.name: {
                "width": size.width,
                "height": size.height,
                "max_disparity": size.levels,
                "opencv_disparities": usable_levels(size.levels),
            }
            for size in result.sizes
        },
        "options": options,
        "interrupted": result.interrupted,
        "versions": versions(),
        "machine": machine(result.load),
    }


def machine(load: list[float] | None) -> dict[str, Any]:
    """Return the conditions of the times: processor, number of processors, vector width, system, and load."""
    return {
        "cpu": _cpu_name(),
        "processors": available_threads(),
        "vector_bits": vector_bits(),
        "system": f"{platform.system()} {platform.machine()}",
        "load": load,
    }


def print_tables(result: BenchResult) -> None:
    """Print one table of times per size, then first calls, stages and the contenders that were left out."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    rows = result.rows()
    for size in result.sizes:
        size_rows = [row for row in rows if row["size"] == size.name]
        if size_rows:
            console.print(_times_table(result, size, size_rows))
        stages = {key: ms for (name, key), ms in result.stages.items() if name == size.name}
        if stages:
            allocated = {key: count for (name, key), count in result.allocated.items() if name == size.name}
            console.print(_stages_table(size, stages, allocated))
    if result.first:
        count = max(result.threads)
        table = new_table(f"first call in a new process, warm disk cache, {result.first_size}, {_threads(count)}")
        for head in ("import s", "first call s"):
            table.add_column(head, justify="right")
        for key, seconds in result.first.items():
            table.add_row(label(key), f"{seconds['import_s']:.2f}", f"{seconds['call_s']:.2f}")
        console.print(table)
    for skip in result.skipped:
        line = f"left out: {skip['contender']}, {skip['size']}, {_threads(skip['threads'])}: {skip['reason']}"
        console.print(line, markup=False, highlight=False)
    numbers = ", ".join(f"{name} {number}" for name, number in versions().items() if number)
    load_text = "" if result.load is None else f", load {result.load[0]:.1f} at the start"
    processor = f"{_cpu_name()}, {available_threads()} processors, {vector_bits()}-bit vectors{load_text}"
    console.print(processor, markup=False, highlight=False)
    console.print(numbers, highlight=False)


def _times_table(result: BenchResult, size: Size, rows: list[dict[str, Any]]) -> Table:
    table = new_table(
        f"{size.name}: {size.width}x{size.height}, {size.levels} levels, median of {result.rounds} rounds"
    )
    has_memory = any(name == size.name for name, _ in result.memory)
    heads = ["threads", "ms", "q25-q75", "min", "x HH", "x 3WAY", "MDE/s", *(("MB", "of HH's") if has_memory else ())]
    for head in heads:
        table.add_column(head, justify="right")
    for index, row in enumerate(rows):
        key, is_max = row["key"], row["threads"] == max(result.threads)
        memory: tuple[str, ...] = ()
        if has_memory:
            amount = result.memory.get((size.name, key)) if is_max else None
            share = _share(result, size.name, key) if is_max else None
            memory = (_figure(amount, 0 if amount and amount >= 10 else 1), _figure(share, 2))
        runs = "" if row["runs"] == result.rounds else f" ({row['runs']} runs)"
        table.add_row(
            row["contender"] + runs,
            str(row["threads"]),
            format_ms(row["median_ms"]),
            f"{format_ms(row['q25_ms'])}-{format_ms(row['q75_ms'])}",
            format_ms(row["min_ms"]),
            _times_faster(row["x_hh"], row["kind"]),
            _times_faster(row["x_3way"], row["kind"]),
            _figure(row["mde_per_s"], 0),
            *memory,
            end_section=index + 1 < len(rows) and rows[index + 1]["threads"] != row["threads"],
        )
    return table


def _stages_table(size: Size, stages: dict[str, dict[str, float]], allocated: dict[str, int]) -> Table:
    table = new_table(f"{size.name}: stages, 1 thread, ms", "stage")
    for key in stages:
        table.add_column(label(key), justify="right")
    names: list[str] = []  # of all methods, each stage after the one that it follows in its method
    for ms in stages.values():
        for before, name in zip([None, *ms], ms, strict=False):
            if name not in names:
                names.insert(names.index(before) + 1 if before is not None else 0, name)
    for name in names:
        table.add_row(name, *("" if name not in ms else f"{ms[name]:.2f}" for ms in stages.values()))
    table.add_section()
    kilobytes = (f"{allocated[key] / 1e3:.1f}" if key in allocated else "-" for key in stages)
    table.add_row("kB allocated above the maps returned", *kilobytes)
    return table


def new_table(title: str, first: str = "contender") -> Table:
    """Return an empty table in the style of this command, with its first column."""
    table = Table(title=title, box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    table.add_column(first, no_wrap=True)
    return table


def _threads(count: int) -> str:
    return f"{count} thread" if count == 1 else f"{count} threads"


def format_ms(value: float) -> str:
    """Return milliseconds with about three digits."""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 1000 else f"{value:.0f}"


def _figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _times_faster(value: float | None, kind: str) -> str:
    """Return a ratio; those of our methods are red below 1, so that losses are seen first."""
    text = _figure(value, 2)
    return f"[bold red]{text}[/]" if value is not None and value < 1 and kind == "method" else text


def _share(result: BenchResult, size: str, key: str) -> float | None:
    own_mb, hh_mb = result.memory.get((size, key)), result.memory.get((size, HH))
    return own_mb / hh_mb if own_mb is not None and hh_mb else None


def versions() -> dict[str, str | None]:
    """Return the versions of this package and of those that the times depend on."""
    return environment.versions({baseline.module for baseline in BASELINES.values()} - {"cv2"})


def system_load() -> list[float] | None:
    """Return the system's load over 1, 5 and 15 minutes, None where the system has none."""
    try:
        return list(os.getloadavg())
    except (AttributeError, OSError):  # not on Windows
        return None


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
