"""The study's results as tables on the terminal and as JSON, with the paper's published figures."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console

from stereokit.cli.output import Table
from stereokit_evaluation.bench.stages import GROUPS, OTHER, TOTAL
from stereokit_evaluation.data import published
from stereokit_evaluation.scoring.summary import summary
from stereokit_evaluation.study.configurations import BASELINE, title
from stereokit_evaluation.study.run import Study, StudyRow

__all__ = ["as_json", "missing_lines", "print_tables", "published_values"]

_D1 = [(region, part) for region in ("noc", "occ") for part in ("all", "bg", "fg")]
_WIDTH = 130


def published_values(row: StudyRow) -> dict[str, float | None]:
    """Return the paper's figures for one row: percent by fig. e4 and e5, milliseconds by table II."""
    label, variant = row.configuration.label, row.configuration.variant
    return {
        "validation_d1": published.VALIDATION.get(label, {}).get(variant),
        "test_d1_noc": published.TEST.get(label, {}).get(variant),
        "agx_ms": published.agx_ms(label, variant),
    }


def as_json(study: Study) -> dict[str, Any]:
    """Return all rows with the published values; scores are None where nothing was scored."""
    return {
        "results": [
            {
                "matcher": row.configuration.label,
                "setting": title(row.configuration.variant) if row.configuration.variant != BASELINE else BASELINE,
                "method": row.configuration.method,
                "scale": row.configuration.scale,
                "refiner": None if row.configuration.variant in ("original", BASELINE) else row.configuration.variant,
                "device": str(getattr(row.configuration.matcher, "device", "cpu")),
                "missing": row.missing,
                **summary(row.result),
                "ms": row.ms,
                "published": published_values(row),
            }
            for row in study.rows
        ],
        "skipped": [{"frame": skip.name, "reason": skip.reason} for skip in study.skipped],
        "interrupted": study.interrupted,
        "records": {"reused": study.reused, "computed": study.computed},
    }


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


def print_tables(heading: str, study: Study, note: str) -> None:
    """Print accuracy, then times, then the missing variants."""
    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
    console.print(_accuracy(heading, study.rows))
    console.print(_times(study.rows))
    for line in (*missing_lines(study.rows), note):
        console.print(line, markup=False, highlight=False)


def _accuracy(heading: str, rows: Sequence[StudyRow]) -> Table:
    table = _table(f"{heading}: D1 in percent, EPE in pixels")
    heads = (*(f"{region} {part}" for region, part in _D1), "density", "EPE", "published e4", "published e5, noc")
    for head in heads:
        table.add_column(head, justify="right", style="italic" if head.startswith("published") else None)
    for index, row in enumerate(rows):
        scores = summary(row.result)
        paper = published_values(row)
        cells = [scores["d1"][region][part] for region, part in _D1]
        table.add_row(
            *_names(row),
            *(_figure(cell) for cell in cells),
            _figure(scores["density"], 1),
            _figure(scores["epe"]),
            _figure(paper["validation_d1"]),
            _figure(paper["test_d1_noc"]),
            end_section=_ends(rows, index),
        )
    return table


def _times(rows: Sequence[StudyRow]) -> Table:
    table = _table("milliseconds a frame: medians, after a call to warm up")
    for head in (TOTAL, *GROUPS, OTHER, "published, AGX Xavier"):
        table.add_column(head, justify="right", style="italic" if head.startswith("published") else None)
    for index, row in enumerate(rows):
        cells = (row.ms.get(name) for name in (TOTAL, *GROUPS, OTHER))
        paper_ms = published_values(row)["agx_ms"]
        table.add_row(
            *_names(row), *(_figure(cell, 1) for cell in cells), _figure(paper_ms), end_section=_ends(rows, index)
        )
    return table


def _table(heading: str) -> Table:
    table = Table(title=heading, box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    table.add_column("matcher", no_wrap=True)
    table.add_column("setting", no_wrap=True)
    return table


def _names(row: StudyRow) -> tuple[str, str]:
    variant = "" if row.configuration.variant == BASELINE else title(row.configuration.variant)
    return row.configuration.label, variant if row.missing is None else f"{variant} (missing)".strip()


def _ends(rows: Sequence[StudyRow], index: int) -> bool:
    return index + 1 < len(rows) and rows[index + 1].configuration.label != rows[index].configuration.label


def _figure(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
