"""The tables of a study as files for a paper or a program: CSV, LaTeX (booktabs) and Markdown.

CSV has the plain numbers, unrounded, and nothing where there is none. LaTeX and Markdown are rounded as the report is,
and leave out columns without any figure.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stereokit_evaluation.bench.stages import GROUPS, OTHER, TOTAL
from stereokit_evaluation.report.per_pair import per_pair
from stereokit_evaluation.study.configurations import BASELINE

__all__ = ["Column", "Table", "study_tables"]

_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    **{character: f"{{{character}}}" for character in "[*"},  # else an argument of \\ or \midrule before it
}
_NONE = {"latex": "--", "markdown": "-"}


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes
    ----------
    head : str
    digits : int or None
        Digits after the point in LaTeX and Markdown; None is a column of text.
    best : bool
        Print the smallest figure in bold.
    printed : bool
        Have it in LaTeX and Markdown too, and not in CSV alone.
    """

    head: str
    digits: int | None = 2
    best: bool = False
    printed: bool = True


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes
    ----------
    title : str
        What its figures are, in a line.
    columns : tuple of Column
    rows : tuple of tuples
        A cell is a text, a number or None, for each column one.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Any, ...], ...]

    def csv(self) -> str:
        """Return the table as CSV (RFC 4180, but lines end with a line feed), with a line of heads."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow([column.head for column in self.columns])
        writer.writerows(["" if cell is None else cell for cell in row] for row in self.rows)
        return buffer.getvalue()

    def latex(self) -> str:
        r"""Return the table as a ``tabular`` that needs ``\usepackage{booktabs}``; its title is a comment."""
        columns = self._used()
        letters = "".join("l" if column.digits is None else "r" for column in columns)
        lines = [f"% {' '.join(self.title.split())}; needs \\usepackage{{booktabs}}"]
        lines += [f"\\begin{{tabular}}{{{letters}}}", "\\toprule"]
        lines += [" & ".join(_escaped(column.head) for column in columns) + r" \\", "\\midrule"]
        for row in self._texts("latex"):
            cells = [f"\\textbf{{{_escaped(text)}}}" if bold else _escaped(text) for text, bold in row]
            lines.append(" & ".join(cells) + r" \\")
        return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])

    def markdown(self) -> str:
        """Return the table in Markdown, under its title."""
        columns = self._used()
        lines = [self.title, "", _line([column.head.replace("|", r"\|") for column in columns])]
        lines.append(_line([":--" if column.digits is None else "--:" for column in columns]))
        for row in self._texts("markdown"):
            texts = [(re.sub(r"([|\\`*_<])", r"\\\1", text), bold) for text, bold in row]
            lines.append(_line([f"**{text}**" if bold else text for text, bold in texts]))
        return "\n".join([*lines, ""])

    def _used(self) -> list[Column]:
        """Return the columns to print: those that have anything in them."""
        filled = [not self.rows or any(row[k] is not None for row in self.rows) for k in range(len(self.columns))]
        return [column for column, there in zip(self.columns, filled, strict=True) if there and column.printed]

    def _texts(self, form: str) -> list[list[tuple[str, bool]]]:
        """Return the cells of the used columns as rounded texts, and whether each is the best of its column."""
        columns: list[list[tuple[str, bool]]] = []
        for column in self._used():
            index = self.columns.index(column)
            texts = [_text(row[index], column.digits, form) for row in self.rows]
            numbers = [float(text) for text in texts if column.best and text != _NONE[form]]
            least = min(numbers) if len(numbers) > 1 else None
            columns.append([(t, t != _NONE[form] and least is not None and float(t) == least) for t in texts])
        return [list(row) for row in zip(*columns, strict=True)]


def study_tables(document: Mapping[str, Any]) -> dict[str, Table]:
    """Return the tables of a study's JSON, by the names of their files."""
    rows, name = document["results"], document["dataset"]
    frames = len(document["frames"])
    part = f", {document['split']}" if document["split"] else ""
    count = f"{frames} frame{'' if frames == 1 else 's'} of {name}{part}"
    truth = document.get("frames_with_truth") or {}
    if truth and any(truth[region] != frames for region in ("noc", "occ")):
        count += f" (noc: {truth['noc']} of them, occ: {truth['occ']})"
    names = (Column("matcher", None), Column("setting", None))
    regions = [(region, part) for region in ("noc", "occ") for part in ("all", "bg", "fg")]
    thresholds = list(rows[0]["bad"]["noc"]) if rows else []
    stages = (TOTAL, *GROUPS, OTHER)
    accuracy = Table(
        f"D1 error in percent by pixels (noc: seen by both; occ: all); density in percent and EPE in pixels of noc, "
        f"of occ if no frame has noc; {count}",
        (
            *names,
            *(Column(f"D1 {region} {part}", best=True) for region, part in regions),
            Column("density", 1),
            Column("EPE", best=True),
            Column("published validation D1"),
            Column("published test D1 noc"),
        ),
        tuple(
            (
                *_names(row),
                *(row["d1"][region][part] for region, part in regions),
                row["density"],
                row["epe"],
                row["published"]["validation_d1"],
                row["published"]["test_d1_noc"],
            )
            for row in rows
        ),
    )
    bad = Table(
        f"pixels that are off by more than a threshold, in percent, by pixels (noc: seen by both; occ: all); {count}",
        (*names, *(Column(f"bad-{x} {region}", best=True) for region in ("noc", "occ") for x in thresholds)),
        tuple((*_names(row), *(row["bad"][r][x] for r in ("noc", "occ") for x in thresholds)) for row in rows),
    )
    times = Table(
        f"milliseconds a frame, medians after a call to warm up; {document['machine']['cpu']}; {count}",
        (*names, *(Column(stage, 1) for stage in stages), Column("published AGX Xavier")),
        tuple((*_names(row), *map(row["ms"].get, stages), row["published"]["agx_ms"]) for row in rows),
    )
    tables = {"accuracy": accuracy, "bad_pixels": bad, "times": times, "pairs": _pairs(rows, count)}
    if any(row.get("figures") for row in rows):
        tables |= {"measures": _measures(rows, count), "measures_by_pixels": _by_pixels(rows, count)}
    if entries := document.get("comparisons"):
        tables["comparisons"] = _comparisons(entries, count)
    parts = document.get("data") or {}
    for part, content in parts.items() if len(parts) > 1 else ():
        whole = study_tables({**document, **content, "dataset": part, "data": {}})
        tables |= {f"{re.sub(r'[^A-Za-z0-9_-]', '_', part)}_{key}": table for key, table in whole.items()}
    return tables


def _measures(rows: Sequence[Mapping[str, Any]], count: str) -> Table:
    """Return the figures of the main pixels; CSV has their bootstrap intervals too."""
    names = list(next(row["figures"]["main"] for row in rows if row.get("figures")))
    ends = [(name, end) for name in names for end in (0, 1)]
    columns = (
        Column("matcher", None),
        Column("setting", None),
        *(Column(name, best=name != "density") for name in names),
        *(Column(f"{name} {('low', 'high')[end]}", printed=False) for name, end in ends),
    )
    cells = []
    for row in rows:
        figures, intervals = row.get("figures", {}).get("main", {}), row.get("intervals") or {}
        limits = [None if intervals.get(name) is None else intervals[name][end] for name, end in ends]
        cells.append((*_names(row), *map(figures.get, names), *limits))
    title = f"figures of the pixels that both cameras see, where that is known, else of all; {count}"
    return Table(title, columns, tuple(cells))


def _by_pixels(rows: Sequence[Mapping[str, Any]], count: str) -> Table:
    """Return every figure of every set of pixels, a line each."""
    cells = [
        (*_names(row), pixels, figure, value)
        for row in rows
        for pixels, figures in row.get("figures", {}).items()
        for figure, value in figures.items()
        if value is not None
    ]
    heads = ("matcher", "setting", "pixels", "figure", "value")
    return Table(f"figures by pixels; {count}", tuple(Column(head, None) for head in heads), tuple(cells))


def _comparisons(entries: Sequence[Mapping[str, Any]], count: str) -> Table:
    """Return the differences of every two rows, a line each."""
    heads = list(entries[0])
    cells = tuple(tuple(entry.get(head) for head in heads) for entry in entries)
    return Table(f"differences, first minus second; {count}", tuple(Column(head, None) for head in heads), cells)


def _pairs(rows: Sequence[Mapping[str, Any]], count: str) -> Table:
    """Return the figures of every pair, a line for each pair and measure."""
    figures = per_pair(rows)
    cells = [
        (frame, measure, *(column[place] for column in table))
        for measure, table in figures["measures"].items()
        for place, frame in enumerate(figures["frames"])
    ]
    columns = (Column("pair", None), Column("measure", None), *(Column(method) for method in figures["methods"]))
    return Table(f"figures pair by pair; {count}", columns, tuple(cells))


def _names(row: Mapping[str, Any]) -> tuple[str, str]:
    is_baseline = row["setting"] == BASELINE
    name = str(row.get("name", row["matcher"])) if is_baseline else str(row["matcher"])
    return name, "" if is_baseline else str(row["setting"])


def _text(cell: Any, digits: int | None, form: str) -> str:
    if cell is None:
        return _NONE[form]
    return str(cell) if digits is None else f"{cell:.{digits}f}"


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
