"""The work of each CUDA kernel of a match: its reads, writes and loops, from the arguments of its launch.

Bytes are those that threads request, array by array. A pass is one of the hot loop in the kernel's source; `accesses`
are the loads and stores of one pass. Loops whose length depends on the images (of speckles, of gaps) count one pass.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from stereokit.errors import DeviceError

__all__ = ["Work", "work_of"]

Sizes = Mapping[str, float]


@dataclass(frozen=True)
class Work:
    """The work of a launch.

    Attributes
    ----------
    reads, writes : mapping of str to float
        Bytes that all threads request, by the name of the array.
    passes : float
        Passes of the hot loop, of a mean warp; without effect where there is no loop.
    accesses : float or None
        Loads and stores of a pass; None where they are unknown.
    every : bool
        All loops of the code together are one pass.
    ahead : bool
        A pass requests the data of the next one.
    sweeps : mapping of str to int
        Number of passes of the kernel over an array that is larger than any cache; 1 for arrays that are not here.
    """

    reads: Sizes
    writes: Sizes
    passes: float = 1
    accesses: float | None = None
    every: bool = False
    ahead: bool = False
    sweeps: Mapping[str, int] = field(default_factory=dict)


Rule = Callable[[SimpleNamespace, int, "tuple[int, ...]"], Work]


def _halve(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    pixels = a.count * -(-a.height // 2) * -(-a.width // 2) * a.images.dtype.itemsize
    return Work({"images": 4 * pixels}, {"out": pixels})


def _blur_rows(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    taps, pixels = 2 * a.half + 1, a.rows * a.width
    reads = {"images": taps * pixels * a.images.dtype.itemsize, "weights": 4 * taps * pixels}
    return Work(reads, {"out": 4 * pixels}, taps, 2)


def _blur_columns(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    taps, pixels = 2 * a.half + 1, a.count * a.height * a.width
    return Work({"rows": 4 * taps * pixels, "weights": 4 * taps * pixels}, {"out": 2 * pixels}, taps, 2)


def _ranges(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    threads = blocks // 2 * 256  # of an image
    return Work({"images": 2 * a.pixels * a.images.dtype.itemsize}, {"out": 8 * blocks}, a.pixels / threads, 1)


def _join_ranges(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    return Work({"parts": 512}, {"out": 16})


def _zncc_centre(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    elements = (a.height + 2 * a.half) * (a.columns + 2 * a.half)
    return Work({"images": elements * a.images.dtype.itemsize, "extremes": 8 * elements}, {"out": 2 * elements})


def _zncc_statistics(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    parts = -(-a.columns // 16)  # of a row, one to a thread
    new = a.columns + parts * (a.window - 1)
    old = a.columns - parts
    pixels = a.height * a.columns
    reads = {"image": 2 * a.window * a.height * (new + old)}
    return Work(reads, {"sums": 4 * pixels, "scales": 4 * pixels}, new / parts, 2 * a.window + 2)


def _zncc_costs(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    window = numbers[0]
    strips = -(-a.width // 64)  # of a row, one to a thread
    threads = a.height * strips * a.span
    columns = a.height * a.span * (a.width + strips * (window - 1))
    words = a.height * a.width * a.span
    reads = {
        "left": 2 * window * columns,
        "right": 2 * window * (columns + 3 * threads),
        "left_sum": 4 * words,
        "left_scale": 4 * words,
        "right_sum": 4 * (words + 3 * threads),
        "right_scale": 4 * (words + 3 * threads),
    }
    return Work(reads, {"volume": 4 * words}, columns / threads, 2 * window + 5)


def _census_bits(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    area = numbers[0] * numbers[1]
    pixels = a.height * a.columns
    words = -(-(area - 1) // 32)
    return Work({"images": area * pixels * a.images.dtype.itemsize}, {"out": 4 * words * pixels})


def _census_costs(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    strips = -(-a.width // 32)  # of a row, one to a thread
    threads = a.height * strips * a.span
    words = a.height * a.width * a.span
    reads = {"left": 4 * numbers[0] * words, "right": 4 * numbers[0] * (words + 3 * threads)}
    return Work(reads, {"volume": 4 * words}, words / threads, 2 * numbers[0] + 1)


def _loads(padded: int) -> tuple[int, float]:
    """Return the lanes of a pixel, and in how many loads each takes its levels."""
    lanes = min(32, padded // 4)
    words = padded // lanes // 4
    return lanes, words / 4 if words % 4 == 0 else words / 2 if words % 2 == 0 else words


def _sgm_paths(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    padded = numbers[0]
    lanes, loads = _loads(padded)
    in_block = 128 // lanes
    rows = 2 * in_block * -(-a.height // in_block)  # lines, and those past the last that only keep warps whole
    columns = in_block * blocks - rows
    steps = rows * a.width + columns * a.height
    requested = steps + rows + columns  # one pixel more than a line has
    reads = {"costs": padded * requested, "guide": lanes * requested, "table": 4 * 128 * blocks * (3 + a.count)}
    writes = {"out": padded * a.count * a.height * a.width}
    passes = steps / (rows + columns)
    sweeps = {"costs": a.count, "guide": a.count}
    return Work(reads, writes, passes, 2 * loads + 1, ahead=True, sweeps=sweeps)


def _sgm_final(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    padded, others = numbers[0], numbers[1] - 1
    lanes, loads = _loads(padded)
    requested = blocks * (128 // lanes) * (a.height + 1)
    reads = {"costs": padded * requested, "guide": lanes * requested, "path_costs": others * padded * requested}
    writes = {"disparity": 4 * a.height * a.width, "cost": 2 * a.height * a.width}
    return Work(reads, writes, a.height, loads * (1 + others) + 4, ahead=True)


def _dt_edges(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    reads = {"guide": 3 * a.pixels, "row_table": 2 * a.pixels, "column_table": 2 * a.pixels}
    return Work(reads, {"row": 2 * a.pixels, "column": 2 * a.pixels})


def _dt_walk(volume: Any, threads: int, count: int, writes: Sizes, stores: int) -> Work:
    """Return the work of threads that walk `count` pixels there, in segments of 8, and back."""
    segments = -(-count // 8)
    visits = 2 * segments - 1  # segments walked there: all but the last for its mark, and all again
    marks = 8 * threads * (segments - 1)
    reads = {"volume": 4 * threads * 8 * visits, "weights": 2 * threads * (8 * visits + count), "marks": marks}
    accesses = (8 + 8 + 1) + (8 + 8 + 2 + 8) + 8 * stores
    return Work(reads, {"marks": marks, **writes}, segments, accesses, every=True, sweeps={"volume": 2})


def _dt_walk_bytes(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    threads = a.lines * a.quads
    return _dt_walk(a.volume, threads, a.count, {"volume": 4 * threads * a.count}, 1)


def _dt_walk_select(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    pixels = a.height * a.width
    return _dt_walk(a.volume, 128 * blocks, a.height, {"disparity": 4 * pixels, "cost": 2 * pixels}, 3)


def _dt_walk_totals(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    threads = a.band * a.quads
    return _dt_walk(a.volume, threads, a.height, {"totals": 8 * threads * a.height}, 1)


def _select(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    pixels = a.height * a.band
    return Work({"volume": 2 * numbers[0] * pixels}, {"disparity": 4 * pixels, "cost": 2 * pixels})


def _smp(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    pixels = blocks * a.width
    reads = {"disparity": 8 * pixels, "costs": 4 * pixels, "bids": 16 * pixels}
    return Work(reads, {"bids": 16 * pixels}, a.width / 256, 8, every=True)


def _speckle_runs(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    return Work({"disparity": 4 * 128 * blocks}, {"parent": 4 * a.parent.size, "count": 4 * a.count.size})


def _speckle_join(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    return Work({"disparity": 4 * 4 * a.parent.size, "parent": 4 * a.parent.size}, {}, every=True)


def _speckle_count(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    reads = {"disparity": 4 * 128 * blocks, "parent": 4 * a.parent.size}
    return Work(reads, {"root": 4 * a.root.size}, every=True)


def _speckle_erase(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    return Work({"root": 4 * a.pixels, "count": 4 * a.pixels}, {})


def _fill_rows(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    pixels = a.height * a.width
    return Work({"disparity": 4 * pixels}, {"valid": pixels, "some": a.height}, -(-a.width // 32))


def _fill_empty(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    return Work({"some": 128 * a.height}, {}, 0)


def _median(a: SimpleNamespace, blocks: int, numbers: tuple[int, ...]) -> Work:
    pixels = a.height * a.width
    return Work({"source": 4 * pixels * (numbers[0] ** 2 + 1)}, {"out": 4 * pixels})


_RULES: dict[str, Rule] = {
    "halve": _halve, "blur_rows": _blur_rows, "blur_columns": _blur_columns,
    "ranges": _ranges, "join_ranges": _join_ranges,
    "zncc_centre": _zncc_centre, "zncc_statistics": _zncc_statistics, "zncc_costs": _zncc_costs,
    "census_bits": _census_bits, "census_costs": _census_costs,
    "sgm_paths": _sgm_paths, "sgm_final": _sgm_final,
    "dt_edges_rf": _dt_edges, "dt_walk_bytes": _dt_walk_bytes, "dt_walk_select": _dt_walk_select,
    "dt_walk_totals": _dt_walk_totals, "select_short": _select,
    "smp_short": _smp, "speckle_runs": _speckle_runs, "speckle_join": _speckle_join, "speckle_count": _speckle_count,
    "speckle_erase": _speckle_erase, "fill_rows": _fill_rows, "fill_empty": _fill_empty, "median": _median,
}  # fmt: skip


def work_of(kernel: Any, blocks: int, arguments: SimpleNamespace) -> Work:
    """Return the work of a launch of `blocks` blocks, with the arguments by name.

    Raises
    ------
    DeviceError
        If this kernel is unknown: options other than the defaults may need others.
    """
    stem = re.sub(r"(_u?int\d+|_\d+x\d+|_\d+)*$", "", kernel.name)
    if stem not in _RULES:
        raise DeviceError(f"kernel must be one of a default match to be modelled, got {kernel.name!r}")
    numbers = tuple(int(part) for part in re.findall(r"(?<=[_x])\d+", kernel.name.removeprefix(stem)))
    return _RULES[stem](arguments, blocks, numbers)
