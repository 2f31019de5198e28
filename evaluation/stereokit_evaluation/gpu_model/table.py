"""``stereokit bench --model``: the modelled time of a match on a GPU, launch by launch, as tables and as JSON.

No GPU is needed and none is used; "modelled" stands in the title and over every time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from stereokit.cli.options import write_json
from stereokit.cli.output import Table
from stereokit.matching import Matcher
from stereokit_evaluation.bench.baselines import label
from stereokit_evaluation.bench.table import new_table, versions
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.common.sizes import Size
from stereokit_evaluation.gpu_model.machines import ASSUMED, LIBSGM_SIZE, MACHINES, PUBLISHED, Machine, libsgm_bytes
from stereokit_evaluation.gpu_model.model import Launch, Time, executed, modelled, record
from stereokit_evaluation.gpu_model.sass import Code, Resources, code_of, require_tools

__all__ = ["Match", "as_json", "assemble", "launches_of", "model", "model_match", "print_models"]

_VOLUMES = ("census_costs", "zncc_costs", "sgm_")
"""Kernels with a counterpart in libSGM: costs, paths and selection."""
_LISTED = MACHINES[1].architecture  # whose instructions stand in the table


@dataclass(frozen=True)
class Match:
    """The modelled match of a method at a size.

    Attributes
    ----------
    method : str
    size : Size
        Of the images, before they are halved.
    scale : float
    levels : int
        Disparities at the size of the matching.
    paths : int or None
        Of semi-global matching.
    launches : list of Launch
    instructions : list of float
        Of each launch, of all warps, for the architecture that is listed.
    times : dict of str to list of Time
        Of each launch, by the machine's name.
    """

    method: str
    size: Size
    scale: float
    levels: int
    paths: int | None
    launches: list[Launch]
    instructions: list[float]
    times: dict[str, list[Time]]

    @property
    def moved(self) -> int:
        """Bytes of all launches."""
        return sum(launch.moved for launch in self.launches)

    @property
    def of_libsgm(self) -> float | None:
        """Bytes of costs, paths and selection, as a multiple of those of libSGM's path volumes; None without SGM."""
        if self.paths is None:
            return None
        nbytes = sum(launch.moved for launch in self.launches if launch.kernel.name.startswith(_VOLUMES))
        return nbytes / libsgm_bytes(self.pixels, self.levels, self.paths)

    @property
    def pixels(self) -> int:
        """Pixels at the size of the matching."""
        parts = round(1 / self.scale)
        return -(-self.size.width // parts) * -(-self.size.height // parts)

    def ms(self, machine: str) -> float:
        """Return the modelled milliseconds of all launches on a machine."""
        return sum(time.ms for time in self.times[machine])


Assembled = dict[tuple[str, str], tuple[Code, Resources]]


def model(sizes: Sequence[Size], methods: Sequence[str], scale: float, json_file: Path | None) -> None:
    """Model the matches, print them and write them.

    Raises
    ------
    DeviceError
        If a tool is missing or does not take a kernel.
    """
    require_tools()
    jobs = [(size, method, *job) for size in sizes for method, job in launches_of(methods, size, scale).items()]
    code: Assembled = {}
    matches = []
    with progress(sum(len({launch.kernel.name for launch in job[3]}) for job in jobs)) as (_, step):
        for size, method, matcher, launches in jobs:
            assemble(launches, code, step)
            matches.append(model_match(method, size, scale, matcher, launches, code))
    if not write_json(json_file, {**as_json(matches), "versions": versions()}):
        print_models(matches)


def launches_of(methods: Sequence[str], size: Size, scale: float) -> dict[str, tuple[Matcher, list[Launch]]]:
    """Return the matcher and the launches of each method."""
    launches = {}
    for method in methods:
        matcher = Matcher(method, max_disparity=size.levels, scale=scale, device="cpu")
        launches[method] = matcher, record(matcher, size.width, size.height)
    return launches


def assemble(launches: Sequence[Launch], code: Assembled, step: Callable[..., None]) -> None:
    """Add the code of all kernels, for all machines, to `code`."""
    for kernel in {launch.kernel.name: launch.kernel for launch in launches}.values():
        needed = [one for one in {m.architecture for m in MACHINES} if (kernel.name, one) not in code]
        ptx = kernel.ptx((7, 2)) if needed else ""
        for architecture in needed:
            code[kernel.name, architecture] = code_of(ptx, architecture)
        step(f"assemble {kernel.name}")


def model_match(
    method: str, size: Size, scale: float, matcher: Matcher, launches: list[Launch], code: Assembled
) -> Match:
    """Return the modelled match; `code` has all kernels of its launches."""
    times = {
        machine.name: [_time(launch, code[launch.kernel.name, machine.architecture], machine) for launch in launches]
        for machine in MACHINES
    }
    counts = [executed(launch, code[launch.kernel.name, _LISTED][0]) for launch in launches]
    instructions: list[float] = [
        sum(count.values()) * launch.warps for count, launch in zip(counts, launches, strict=True)
    ]
    levels = matcher.settings.matched_levels.count
    paths = getattr(matcher.aggregation, "paths", None)
    return Match(method, size, scale, levels, paths, launches, instructions, times)


def _time(launch: Launch, assembled: tuple[Code, Resources], machine: Machine) -> Time:
    code, resources = assembled
    return modelled(launch, code, resources.registers, machine)


def print_models(matches: Sequence[Match]) -> None:
    """Print a table for each match, then the machines, and the published times."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    for match in matches:
        console.print(_table(match))
        if match.of_libsgm is not None:
            libsgm_nbytes = libsgm_bytes(match.pixels, match.levels, match.paths or 0)
            line = (
                f"bytes of costs, paths and selection, modelled: {match.of_libsgm:.2f} times those of libSGM's path "
                f"volumes at this size ({libsgm_nbytes / 1e6:.1f} MB: each path's volume written once and read once)"
            )
            console.print(line, markup=False, highlight=False)
    console.print(_machines())
    console.print(_published())
    for line in (*_NOTES, _distance()):
        console.print(line, markup=False, highlight=False)


def _distance() -> str:
    """Return the ratio of libSGM's published times to their modelled memory bound, as a scale for these tables."""
    width, height, levels, paths = LIBSGM_SIZE
    machines = {machine.name: machine for machine in MACHINES}
    factors = []
    for time in PUBLISHED:
        if time.name.startswith("libSGM"):
            speed = ASSUMED["of_bandwidth"] * machines[time.machine].gb_per_s * 1e6  # bytes a millisecond
            bound = libsgm_bytes(width * height, levels, paths) / speed
            factors.append(f"{time.ms / bound:.1f} times on {time.machine}")
    return (
        "Bounds are not times: the published libSGM takes " + ", ".join(factors) + " what this model's memory bound is "
        "for its path volumes. Therefore the line with twice the bounds."
    )


_NOTES = (
    "modelled: no GPU has run this. The time of a launch is the longest of m (memory: bytes by "
    f"{ASSUMED['of_bandwidth']:.0%} of the bandwidth), u (units: instructions by the rate of the busiest unit) and w "
    "(waiting: one warp alone), and the launch itself. Bytes are between memory and chip; instructions are those of "
    f"warps, from the assembled code for {_LISTED}; that for sm_75 stands in for Xavier's sm_72.",
    "Launches and latencies, and the share of the bandwidth, are assumptions; images lie on the device.",
)


def _table(match: Match) -> Table:
    half = "" if match.scale == 1 else ", matched at half size"
    table = new_table(
        f"modelled: {label(match.method)}, {match.size.width}x{match.size.height}{half}, {match.levels} levels",
        "kernel",
    )
    for head in ("launches", "MB read", "written", "10^6 instr", *(f"{m.name}\nmodelled ms" for m in MACHINES)):
        table.add_column(head, justify="right")
    names = list(dict.fromkeys(launch.kernel.name for launch in match.launches))
    for name in names:
        indices = [k for k, launch in enumerate(match.launches) if launch.kernel.name == name]
        table.add_row(name, *_figures(match, indices), *(_cell(match, machine, indices) for machine in MACHINES))
    table.add_section()
    everything = range(len(match.launches))
    totals = (f"{match.ms(machine.name):.2f}  " for machine in MACHINES)
    table.add_row("all, modelled", *_figures(match, everything), *totals)
    double = (f"{sum(2 * time.ms - time.launch for time in match.times[machine.name]):.2f}  " for machine in MACHINES)
    table.add_row("at twice the bounds", "", "", "", "", *double)
    only = (f"{sum(time.launch for time in match.times[machine.name]):.2f}  " for machine in MACHINES)
    table.add_row("launches alone", "", "", "", "", *only)
    return table


def _figures(match: Match, indices: Sequence[int]) -> tuple[str, ...]:
    launches = [match.launches[k] for k in indices]
    read, written = (sum(getattr(one, side) for one in launches) / 1e6 for side in ("read", "written"))
    return (
        str(len(launches)),
        f"{read:.2f}",
        f"{written:.2f}",
        f"{sum(match.instructions[k] for k in indices) / 1e6:.2f}",
    )


def _cell(match: Match, machine: Machine, indices: Sequence[int]) -> str:
    times = [match.times[machine.name][k] for k in indices]
    longest = max(times, key=lambda time: time.ms)
    return f"{sum(time.ms for time in times):.3f} {longest.bound[0]}"


def _machines() -> Table:
    table = new_table("what is modelled", "GPU")
    for head in ("code", "SMs", "GHz", "GB/s", "clocks to memory, assumed", "us of a launch, assumed"):
        table.add_column(head, justify="right")
    table.add_column("source")
    for one in MACHINES:
        figures = one.multiprocessors, one.ghz, one.gb_per_s, one.latency, one.launch_us
        table.add_row(one.name, one.architecture, *(f"{figure:g}" for figure in figures), one.source)
    return table


def _published() -> Table:
    table = new_table("published by others, measured; all other tables are modelled", "")
    for head in ("GPU", "size", "ms", "source"):
        table.add_column(head, justify="right" if head == "ms" else "left")
    for one in PUBLISHED:
        table.add_row(one.name, one.machine, one.size, f"{one.ms:.2f}", one.source)
    return table


def as_json(matches: Sequence[Match]) -> dict[str, Any]:
    """Return the matches, the machines and the published times."""
    return {
        "modelled": [
            {
                "method": match.method,
                "size": match.size.name,
                "scale": match.scale,
                "levels": match.levels,
                "bytes": match.moved,
                "bytes_of_libsgm": match.of_libsgm,
                "modelled_ms": {machine.name: match.ms(machine.name) for machine in MACHINES},
                "launches": [
                    {
                        "kernel": launch.kernel.name,
                        "blocks": launch.blocks,
                        "read": launch.read,
                        "written": launch.written,
                        f"instructions_{_LISTED}": match.instructions[k],
                        "modelled_ms": {
                            name: {
                                "memory": times[k].memory, "units": times[k].units, "waiting": times[k].waiting,
                                "launch": times[k].launch, "all": times[k].ms,
                            }
                            for name, times in match.times.items()
                        },
                    }
                    for k, launch in enumerate(match.launches)
                ],
            }
            for match in matches
        ],
        "machines": [dict(vars(machine)) for machine in MACHINES],
        "assumed": dict(ASSUMED),
        "published": [dict(vars(one)) for one in PUBLISHED],
    }  # fmt: skip
