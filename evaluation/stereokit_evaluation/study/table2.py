"""Table II of the StereoVAE paper on this machine: the matcher alone, and half-size matching with each refiner.

All take turns, round by round, on one pair, together with OpenCV's modes; the published times are those of the paper's
Jetson boards. A missing refiner is listed with the reason.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

from rich.console import Console

from stereokit import Matcher
from stereokit.kernels.trace import observed
from stereokit_evaluation.bench.baselines import BASELINES, HH, THREE_WAY, Call, opencv_threads
from stereokit_evaluation.bench.stages import GROUPS, StageTimer
from stereokit_evaluation.bench.table import format_ms, new_table
from stereokit_evaluation.bench.timing import Spread, round_robin, spread
from stereokit_evaluation.common.sizes import Size
from stereokit_evaluation.common.weights import is_of_half_size
from stereokit_evaluation.data import published
from stereokit_evaluation.scoring.runner import Matching
from stereokit_evaluation.study.configurations import Configuration, available_variants, build, describe_error
from stereokit_refiners.runtimes.choice import BACKENDS, PRECISIONS

__all__ = ["PipelineRow", "as_json", "print_pipeline", "rows_of_a_method", "time_pipeline"]

_RUNTIMES = [(name, one) for name in BACKENDS for one in (PRECISIONS if name == "openvino" else ("fp32",))]
_OTHER_SIZES: dict[str, dict[str, Any]] = {
    ", full size": {"scale": 1},
    ", full size, refinements=1": {"scale": 1, "refinements": 1},
    ", a quarter of the size": {"scale": 0.25},
    ", a quarter, evidence_scale=0.5": {"scale": 0.25, "evidence_scale": 0.5},
}
_PRINTED = {"original": "ZNCC+SGM", "cnn": "Non-VAE NN", "stereovae": "StereoVAE"}


@dataclass
class PipelineRow:
    """One row of the table.

    Attributes
    ----------
    name : str
        The configuration.
    size : str
        Name of the size.
    threads : int
    seconds : list of float
        Of each run.
    parts : dict of lists of float
        Seconds of each group of stages in each run (`stereokit_evaluation.bench.stages.GROUPS`).
    missing : str or None
        The reason why it was not timed.
    printed : str or None
        The comparable row of the paper's table II.
    """

    name: str
    size: str
    threads: int
    seconds: list[float] = field(default_factory=list)
    parts: dict[str, list[float]] = field(default_factory=dict)
    missing: str | None = None
    printed: str | None = None

    @property
    def spread(self) -> Spread | None:
        """Median and quartiles in milliseconds, None if it was not timed."""
        return spread([1e3 * s for s in self.seconds]) if self.seconds else None

    def part_ms(self, group: str) -> float | None:
        """Return the median milliseconds of a group of stages, None where there is none."""
        times = self.parts.get(group, [])
        return 1e3 * median(times) if any(times) else None


def time_pipeline(
    size: Size,
    threads: int,
    methods: Sequence[str],
    images: tuple[Any, Any],
    rounds: int,
    rows: list[PipelineRow],
    *,
    with_baselines: bool = True,
    runtimes: str | None = None,
    weights: str | None = None,
    step: Callable[[str], None] = lambda text: None,
) -> None:
    """Time the rows of one size and number of threads; they are appended to `rows` before the first run.

    Parameters
    ----------
    size : Size
    threads : int
        Of our methods and of OpenCV.
    methods : sequence of str
        Methods; table II has ``"zncc+sgm"`` only.
    images : pair of (H, W) uint8
    rounds : int
        Timed calls of each, after one that is not.
    rows : list of PipelineRow
    with_baselines : bool
        OpenCV's 3WAY and HH too.
    runtimes : str or None
        A refiner that is timed in each runtime and precision too; the general one at other sizes as well.
    weights : str or None
        Of the refiners of half-size maps.
    step : callable
        Called with a few words after each call.
    """
    options: dict[str, Any] = {"max_disparity": size.levels, "threads": threads}
    options |= {} if weights is None else {"weights": weights}
    calls: dict[str, Callable[[], object]] = {}
    times: dict[str, list[float]] = {}
    with opencv_threads(threads):
        for suffix, configuration in _configurations(methods, options, runtimes):
            label, printed = configuration.name + suffix, None
            if configuration.label == "S4" and not suffix:
                printed = _PRINTED.get(configuration.variant)
            row = PipelineRow(label, size.name, threads, times.setdefault(label, []), printed=printed)
            rows.append(row)
            call, row.missing = _warmed(configuration, images)
            if call is not None:
                calls[label] = _watching(configuration.matcher, call, images, row)
            step(f"{size.name}: {label}, first call")
        for key in (THREE_WAY, HH) if with_baselines else ():
            rows.append(PipelineRow(key, size.name, threads, times.setdefault(key, [])))
            baseline: Call = BASELINES[key].make(size.levels)
            baseline(*images)
            calls[key] = lambda baseline=baseline: baseline(*images)  # type: ignore[misc]
            step(f"{size.name}: {key}, first call")
        round_robin(calls, rounds, times, step=lambda name: step(f"{size.name}, {threads} threads: {name}"))


def rows_of_a_method(runtimes: str | None) -> int:
    """Return how many rows the table has for each method, OpenCV's left out."""
    if runtimes is None:
        return len(available_variants())
    others = 0 if is_of_half_size(runtimes) else len(_OTHER_SIZES)
    return len(available_variants()) + len(_RUNTIMES) + others


def _configurations(
    methods: Sequence[str], options: Mapping[str, Any], runtimes: str | None
) -> list[tuple[str, Configuration]]:
    """Return the configurations to time, each with the suffix of its name."""
    configurations = [("", configuration) for configuration in build(methods, available_variants(), options)]
    for backend, precision in _RUNTIMES if runtimes is not None else ():
        runtime_options = {**options, "backend": backend, "precision": precision}
        configurations += [(f", {backend} {precision}", c) for c in build(methods, [str(runtimes)], runtime_options)]
    if runtimes is not None and not is_of_half_size(runtimes):
        configurations += _of_other_sizes(build(methods, [runtimes], options), options)
    return configurations


def _of_other_sizes(
    configurations: Sequence[Configuration], options: Mapping[str, Any]
) -> list[tuple[str, Configuration]]:
    """Return what the general refiner does at other sizes than half, with what the names of these end in.

    As at half size it has its own weights: an option for some is that of the refiners of half-size maps.
    """
    options = {name: value for name, value in options.items() if name != "weights"}
    return [
        (ending, replace(c, matcher=Matcher(c.method, refiner=c.variant, **options, **its_options)))
        for ending, its_options in _OTHER_SIZES.items()
        for c in configurations
        if c.missing is None
    ]


def as_json(rows: Sequence[PipelineRow]) -> list[dict[str, Any]]:
    """Return the rows as ``pipeline`` of the JSON."""
    entries = []
    for row in rows:
        times = row.spread
        entries.append(
            {
                "name": row.name,
                "size": row.size,
                "threads": row.threads,
                "runs": len(row.seconds),
                "median_ms": None if times is None else times.median,
                "q25_ms": None if times is None else times.q25,
                "q75_ms": None if times is None else times.q75,
                "parts_ms": {group: row.part_ms(group) for group in GROUPS},
                "missing": row.missing,
                "published_ms": None if row.printed is None else _jetson(row.printed),
                "published_row": row.printed,
            }
        )
    return entries


def print_pipeline(sizes: Sequence[Size], rows: Sequence[PipelineRow]) -> None:
    """Print one table for each size, then the missing rows and a note on the published times."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    for size in sizes:
        size_rows = [row for row in rows if row.size == size.name]
        if not size_rows:
            continue
        table = new_table(f"table II of the paper, {size.name}: {size.width}x{size.height}, {size.levels} levels")
        for head in ("threads", "ms", "q25-q75", *GROUPS, "published, TX2", "published, AGX"):
            table.add_column(head, justify="right", style="italic" if head.startswith("published") else None)
        for row in size_rows:
            times, jetson_ms = row.spread, _jetson(row.printed or "")
            table.add_row(
                f"{row.name} (missing)" if row.missing else row.name,
                str(row.threads),
                "-" if times is None else format_ms(times.median),
                "-" if times is None else f"{format_ms(times.q25)}-{format_ms(times.q75)}",
                *("-" if (ms := row.part_ms(group)) is None else format_ms(ms) for group in GROUPS),
                *(f"{jetson_ms[board]:.2f}" if board in jetson_ms else "-" for board in ("TX2", "AGX")),
            )
        console.print(table)
    for line in dict.fromkeys(f"missing: {row.name}: {row.missing}" for row in rows if row.missing):
        console.print(line, markup=False, highlight=False)
    note = (
        f"published: {published.PAPER}, table II, on Jetson boards; it does not say at which size ZNCC+SGM ran, nor "
        "whether the networks' times contain the matcher's (ours do)"
    )
    console.print(note, markup=False, highlight=False)


def _jetson(row: str) -> Mapping[str, float]:
    return published.TABLE_2.get(row, {})


def _warmed(configuration: Configuration, images: tuple[Any, Any]) -> tuple[Matching | None, str | None]:
    """Call a configuration once; return its matcher, or the reason why it cannot be called."""
    if configuration.matcher is None:
        return None, configuration.missing
    try:
        configuration.matcher(*images)
    except Exception as error:  # a plug-in's own trouble
        if configuration.variant in ("original", "linear"):
            raise
        return None, describe_error(error)
    return configuration.matcher, None


def _watching(matcher: Any, call: Matching, images: tuple[Any, Any], row: PipelineRow) -> Callable[[], object]:
    """Return the call to time; it records the seconds of each group of stages."""

    def run() -> object:
        timer = StageTimer(groups=True)
        with observed(timer):
            result = call(*images)
        for group in GROUPS:
            row.parts.setdefault(group, []).append(timer.seconds.get(group, 0.0))
        return result

    return run
