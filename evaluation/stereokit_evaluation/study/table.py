"""The tables of the study: D1, EPE and times beside the published figures; all measures with intervals; JSON."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console

from stereokit.cli.output import Table
from stereokit_evaluation.bench.stages import GROUPS, OTHER, TOTAL
from stereokit_evaluation.data import published
from stereokit_evaluation.scoring import middlebury
from stereokit_evaluation.scoring.assessment import average_official
from stereokit_evaluation.scoring.measures import FIGURES
from stereokit_evaluation.scoring.statistics import DRAWS
from stereokit_evaluation.scoring.summary import pixels_line, summary
from stereokit_evaluation.study.comparison import best_row, compare_rows, comparisons, intervals, scene_names
from stereokit_evaluation.study.configurations import BASELINE, title
from stereokit_evaluation.study.run import Study, StudyRow

__all__ = [
    "as_json",
    "missing_lines",
    "official_json",
    "print_disturbances",
    "print_measures",
    "print_overview",
    "print_tables",
    "published_values",
]

_D1 = [(region, part) for region in ("noc", "occ") for part in ("all", "bg", "fg")]
_WIDTH = 130
_WIDEST = 400
_FEW_SCENES = 6
_SHOWN = ("bad-0.5", "bad-1", "bad-2", "bad-4", "epe", "rmse", "a90", "a95", "density")


def published_values(row: StudyRow, dataset: str | None) -> dict[str, float | None]:
    """Return the paper's figures for one row: percent by fig. e4 and e5, milliseconds by table II.

    They are of KITTI 2015: beside another `dataset` all are None.
    """
    label, variant = row.configuration.label, row.configuration.variant
    if dataset != "kitti2015":
        return {"validation_d1": None, "test_d1_noc": None, "agx_ms": None}
    return {
        "validation_d1": published.VALIDATION.get(label, {}).get(variant),
        "test_d1_noc": published.TEST.get(label, {}).get(variant),
        "agx_ms": published.agx_ms(label, variant),
    }


def as_json(study: Study, dataset: str | None) -> dict[str, Any]:
    """Return all rows, with published values for KITTI 2015; scores are None where nothing was scored.

    Parameters
    ----------
    study : Study
    dataset : str or None
        Name of its data set; None for several.
    """
    return {
        "results": [
            {
                "name": row.configuration.name,
                "label": row.configuration.label,
                "variant": row.configuration.variant,
                "kind": row.configuration.kind,
                "matcher": row.configuration.label,
                "setting": title(row.configuration.variant) if row.configuration.variant != BASELINE else BASELINE,
                "method": row.configuration.method,
                "scale": row.configuration.scale,
                "refiner": None if row.configuration.variant in ("original", BASELINE) else row.configuration.variant,
                "device": str(getattr(row.configuration.matcher, "device", "cpu")),
                "missing": row.missing,
                "failed": row.failed,
                **summary(row.result),
                "intervals": intervals(row),
                "ms": row.ms,
                "published": published_values(row, dataset),
            }
            for row in study.rows
        ],
        "pixels_line": _pixels_line(study),
        "scenes": scene_names(_frames(study)),
        "comparisons": comparisons(study.rows),
        "skipped": [{"frame": skip.name, "reason": skip.reason} for skip in study.skipped],
        "interrupted": study.interrupted,
        "records": {"reused": study.reused, "computed": study.computed},
    }


def official_json(study: Study, benchmarks: Mapping[str, str]) -> dict[str, Any] | None:
    """Return the figures of the rows by the rules of the frames' benchmarks, None where they have none.

    Parameters
    ----------
    study : Study
    benchmarks : mapping
        The benchmark of each frame that has one, by its name.

    Returns
    -------
    dict or None
        By benchmark: ``pairs``, the frames that its average counts, and ``results``, by the name of the row, the
        ``average`` and ``frames``: figures by ``dense`` and ``sparse``, ``nonocc`` and ``all``. Infinite ones are None.
    """
    table: dict[str, Any] = {}
    for benchmark in dict.fromkeys(benchmarks.values()):
        rows: dict[str, Any] = {}
        for row in study.rows:
            entries = {f.name: f.official for f in row.result.frames if benchmarks.get(f.name) == benchmark}
            average = average_official(benchmark, entries)
            if average is not None or entries:
                rows[row.configuration.name] = {"average": _finite(average), "frames": _finite(entries)}
        if rows:
            table[benchmark] = rows
    return table or None


def missing_lines(rows: Sequence[StudyRow]) -> list[str]:
    """Return one line for each missing variant, with the reason."""
    labels_by_reason: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row.missing is not None:
            variant = row.configuration.variant
            labels_by_reason.setdefault((variant, row.missing), []).append(row.configuration.label)
    return [
        f"missing: {', '.join(labels)}{'' if variant == BASELINE else ' ' + title(variant)}: {reason}"
        for (variant, reason), labels in labels_by_reason.items()
    ]


def print_tables(heading: str, study: Study, note: str, dataset: str) -> None:
    """Print accuracy, then times, then the missing variants."""
    console = _console()
    _print_whole(console, _accuracy(heading, study.rows, dataset))
    _print_whole(console, _times(study.rows, dataset))
    for line in (*missing_lines(study.rows), note):
        console.print(line, markup=False, highlight=False)


def print_measures(heading: str, study: Study, official: Mapping[str, Any] | None = None) -> None:
    """Print all measures of one data set, by the benchmark's rules too if it has any, and the lead of the best row."""
    if not _frames(study):
        return
    console = _console()
    _print_whole(console, _measures(heading, study))
    console.print(_pixels_line(study), markup=False, highlight=False)
    for benchmark, rows in (official or {}).items():
        if any(entry["average"] is not None for entry in rows.values()):
            _print_whole(console, _official_table(benchmark, rows))
            console.print(_OFFICIAL_LINES[benchmark], markup=False, highlight=False)
    if (table := _leads(study)) is not None:
        _print_whole(console, table)
        console.print(_scenes_line(study), markup=False, highlight=False)


def print_overview(studies: Mapping[str, Study], figures: Sequence[str] = ("d1", "bad-1", "epe")) -> None:
    """Print one table for each figure: rows by data sets, and the mean over data sets."""
    console = _console()
    for figure in figures:
        table = _table(f"{_head(figure)} by data set, {FIGURES[figure].unit}")
        for head in (*studies, "mean"):
            table.add_column(head, justify="right")
        first = next(iter(studies.values()))
        for index, row in enumerate(first.rows):
            cells = [study.rows[index].result.measures.main.figure(figure) for study in studies.values()]
            known = [cell for cell in cells if cell is not None]
            mean = fmean(known) if known and len(known) == len(cells) else None
            names = row.configuration.label, _setting(row)
            table.add_row(*names, *(_figure(cell) for cell in (*cells, mean)), end_section=_ends(first.rows, index))
        _print_whole(console, table)


def print_disturbances(document: Mapping[str, Any], figure: str = "d1") -> None:
    """Print one table for each fault: a figure of each row against the strength.

    Parameters
    ----------
    document : mapping
        As `stereokit_evaluation.study.disturbances.disturbances_json` returns it.
    figure : str
        One of its figures.
    """
    console = _console()
    for kind, entry in document.items():
        where = "both views" if entry["views"] == "both" else "right view"
        heading = f"{kind} ({entry['about']}; {where}): {_head(figure)} in {FIGURES[figure].unit} by {entry['unit']}"
        console.print(heading, markup=False, highlight=False, style="italic")
        table = _table(None, ("method",))
        for head in ("none", *(f"{strength:g}" for strength in entry["strengths"])):
            table.add_column(head, justify="right")
        for row in entry["results"]:
            table.add_row(row["name"], *map(_figure, (row["undisturbed"][figure], *row["figures"][figure])))
        _print_whole(console, table)


_OFFICIAL_LINES = {
    "middlebury": (
        "Middlebury v3: pixels and thresholds at full size; dense: the map as returned, invalid pixels are bad; "
        "sparse: measured pixels, invalid ones apart; average over its training pairs, five hard ones by half."
    ),
    "eth3d": (
        "ETH3D: dense: the map as returned; sparse: measured pixels; pixels without estimate lower the coverage and "
        "count for nothing else; average over pairs."
    ),
}
_OFFICIAL_COLUMNS = {
    "middlebury": (
        ("dense", "nonocc", "total_bad-2", "dense bad-2 nonocc"),
        ("dense", "all", "total_bad-2", "dense bad-2 all"),
        ("dense", "nonocc", "avgerr", "avgerr"),
        ("dense", "nonocc", "rms", "rms"),
        ("dense", "nonocc", "a90", "A90"),
        ("sparse", "nonocc", "bad-2", "sparse bad-2"),
        ("sparse", "nonocc", "invalid", "invalid"),
    ),
    "eth3d": (
        ("dense", "nonocc", "bad-1", "dense bad-1 nonocc"),
        ("dense", "all", "bad-1", "dense bad-1 all"),
        ("dense", "nonocc", "avgerr", "avgerr"),
        ("dense", "nonocc", "rms", "rms"),
        ("dense", "nonocc", "a90", "A90"),
        ("sparse", "nonocc", "bad-1", "sparse bad-1"),
        ("sparse", "nonocc", "coverage", "coverage"),
    ),
}


def _official_table(benchmark: str, rows: Mapping[str, Any]) -> Table:
    names = [name for name, entry in next(iter(rows.values()))["frames"].items() if entry is not None]
    if benchmark == "middlebury":
        names = [name for name in names if name.rpartition("/")[2] in middlebury.WEIGHTS]
    heading = f"{benchmark}, its own rules, {len(names)} pair{'' if len(names) == 1 else 's'}"
    if benchmark == "middlebury":
        heading += f" of the {len(middlebury.WEIGHTS)} of its table"
    table = Table(title=heading, box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("method", no_wrap=True)
    for *_, head in _OFFICIAL_COLUMNS[benchmark]:
        table.add_column(head, justify="right")
    for name, row in rows.items():
        average = row["average"] or {}
        cells = [
            ((average.get(kind) or {}).get(pixels) or {}).get(key)
            for kind, pixels, key, _ in _OFFICIAL_COLUMNS[benchmark]
        ]
        table.add_row(name, *map(_figure, cells))
    return table


def _measures(heading: str, study: Study) -> Table:
    table = _table(f"{heading}: percent and pixels, D1 with its 95 % interval over scenes")
    for head in ("D1", "", *map(_head, _SHOWN), "D1 occl.", "D1 edges", "ms"):
        table.add_column(head, justify="right", no_wrap=True)
    for index, row in enumerate(study.rows):
        measures, ends = row.result.measures, intervals(row)["d1"]
        table.add_row(
            row.configuration.label,
            _setting(row),
            _figure(measures.main.figure("d1")),
            "" if ends is None else f"{ends[0]:.1f}-{ends[1]:.1f}",
            *(_figure(measures.main.figure(name), 1 if name == "density" else 2) for name in _SHOWN),
            _figure(measures.occluded.figure("d1"), 1),
            _figure(measures.edges.figure("d1"), 1),
            _figure(row.ms.get(TOTAL), 0),
            end_section=_ends(study.rows, index),
        )
    return table


def _leads(study: Study) -> Table | None:
    """Return a table of how far each row is behind the best by D1, and how sure that is."""
    best = best_row(study.rows)
    others = [row for row in study.rows if row is not best and row.result.frames]
    if best is None or not others:
        return None
    table = _table(f"D1 minus that of the best, {best.configuration.name}, in percent")
    for head in ("difference", "95 % interval", "p"):
        table.add_column(head, justify="right", no_wrap=True)
    for row in others:
        result = compare_rows(row, best, "d1")
        if result is None:
            continue
        between = "-" if result.low is None or result.high is None else f"{result.low:+.2f} to {result.high:+.2f}"
        table.add_row(
            row.configuration.label,
            _setting(row),
            f"{result.difference:+.2f}",
            between,
            "-" if result.p is None else f"{result.p:.3f}" if result.p >= 0.001 else "< 0.001",
        )
    return table


def _scenes_line(study: Study) -> str:
    frames = _frames(study)
    scenes, pairs = len(scene_names(frames)), f"{len(frames)} pair{'' if len(frames) == 1 else 's'}"
    if scenes == 1:
        return f"Intervals and p: none, as there is one scene ({pairs})."
    line = f"Intervals: {DRAWS} bootstrap draws of {scenes} scenes ({pairs}); p: exchanges of the two methods by scene."
    if scenes < _FEW_SCENES:
        line += f" So few scenes say little: intervals are too narrow, and p cannot be below {2 / 2**scenes:.2g}."
    return line


def _frames(study: Study) -> Sequence[Any]:
    return next((row.result.frames for row in study.rows if row.result.frames), ())


def _pixels_line(study: Study) -> str | None:
    row = next((row for row in study.rows if row.result.frames), None)
    return None if row is None else pixels_line(row.result)


def _finite(value: Any) -> Any:
    """Return a JSON value with None in place of infinite numbers."""
    if isinstance(value, Mapping):
        return {key: _finite(part) for key, part in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _head(figure: str) -> str:
    return figure.upper() if figure[0] in "adre" and figure != "density" else figure


def _accuracy(heading: str, rows: Sequence[StudyRow], dataset: str) -> Table:
    table = _table(f"{heading}: D1 in percent, EPE in pixels; density, EPE: noc if any")
    paper_heads = ("published e4", "published e5, noc") if dataset == "kitti2015" else ()
    heads = (*(f"{region} {part}" for region, part in _D1), "density", "EPE", *paper_heads)
    for head in heads:
        table.add_column(head, justify="right", style="italic" if head.startswith("published") else None)
    for index, row in enumerate(rows):
        scores = summary(row.result)
        paper = published_values(row, dataset)
        cells = [scores["d1"][region][part] for region, part in _D1]
        table.add_row(
            *_names(row),
            *(_figure(cell) for cell in cells),
            _figure(scores["density"], 1),
            _figure(scores["epe"]),
            *(_figure(paper[name]) for name in ("validation_d1", "test_d1_noc")[: len(paper_heads)]),
            end_section=_ends(rows, index),
        )
    return table


def _times(rows: Sequence[StudyRow], dataset: str) -> Table:
    table = _table("milliseconds a frame: medians, after a call to warm up")
    paper_heads = ("published, AGX Xavier",) if dataset == "kitti2015" else ()
    for head in (TOTAL, *GROUPS, OTHER, *paper_heads):
        table.add_column(head, justify="right", style="italic" if head.startswith("published") else None)
    for index, row in enumerate(rows):
        cells = (row.ms.get(name) for name in (TOTAL, *GROUPS, OTHER))
        paper = [_figure(published_values(row, dataset)["agx_ms"])] if paper_heads else []
        table.add_row(*_names(row), *(_figure(cell, 1) for cell in cells), *paper, end_section=_ends(rows, index))
    return table


def _console() -> Console:
    return Console(width=None if sys.stdout.isatty() else _WIDTH, emoji=False)


def _print_whole(console: Console, table: Table) -> None:
    """Print a table without cutting its figures, though it be wider than the terminal."""
    width = console.measure(table, options=console.options.update(width=_WIDEST)).maximum
    Console(width=max(width, console.width)).print(table)


def _table(heading: str | None, columns: Iterable[str] = ("matcher", "setting")) -> Table:
    table = Table(title=heading, box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    for column in columns:
        table.add_column(column, no_wrap=True)
    return table


def _names(row: StudyRow) -> tuple[str, str]:
    return row.configuration.label, _setting(row)


def _setting(row: StudyRow) -> str:
    variant = "" if row.configuration.variant == BASELINE else title(row.configuration.variant)
    return variant if row.missing is None else f"{variant} (missing)".strip()


def _ends(rows: Sequence[StudyRow], index: int) -> bool:
    return index + 1 < len(rows) and rows[index + 1].configuration.label != rows[index].configuration.label


def _figure(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
