"""Measured figures for the pages, taken from where they stand: the page of benchmarks.

A table is found by a cell of its head; the paragraph under it, which says how it was measured, comes along.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

__all__ = ["Table", "find", "tradeoff"]


class Table:
    """One table of a page.

    Attributes
    ----------
    text : str
        The table and the paragraph under it, as Markdown.
    rows : dict of str to dict
        The cells by the row's name, then by the column's.
    """

    def __init__(self, lines: Sequence[str], below: str) -> None:
        cells = [[_plain(cell) for cell in line.strip().strip("|").split("|")] for line in lines]
        self.text = "\n".join([*lines, "", below])
        self.rows = {row[0]: dict(zip(cells[0], row, strict=True)) for row in cells[2:]}

    def number(self, row: str, column: str, place: int = -1) -> float | None:
        """Return one of the numbers of a cell, the last by default, or None if it has none."""
        numbers = re.findall(r"\d+(?:\.\d+)?", self.rows[row][column])
        return float(numbers[place]) if numbers else None


def find(page: Path, head: str) -> Table:
    """Return the table that has the cell `head` in its first line.

    Raises
    ------
    LookupError
        If there is no such table, or more than one.
    """
    tables = []
    for block in re.findall(r"(?:^\|.*\n)+", page.read_text(encoding="utf-8") + "\n", flags=re.MULTILINE):
        lines = block.splitlines()
        if head in [_plain(cell) for cell in lines[0].strip().strip("|").split("|")]:
            below = page.read_text(encoding="utf-8").split(block)[1].strip().split("\n\n")[0]
            tables.append(Table(lines, below))
    if len(tables) != 1:
        raise LookupError(f"{page.name} must have one table with a column {head!r}, got {len(tables)}")
    return tables[0]


def tradeoff(measured: Table) -> bytes:
    """Return a chart of D1 by the time of a call on two threads, as SVG."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for name in measured.rows:
        time, error = measured.number(name, "2 threads"), measured.number(name, "D1 noc")
        if time is None or error is None:
            continue
        is_baseline, census = name.startswith("OpenCV"), "census" in name
        axes.plot(time, error, "o", color="0.5" if is_baseline else "tab:blue")
        axes.annotate(
            name, (time, error), xytext=(-7 if census else 7, 0), textcoords="offset points", fontsize=9,
            ha="right" if census else "left", va="center", color="0.3",
        )  # fmt: skip
    axes.set(xscale="log", xlim=(8, 1200), ylim=(0, None))
    axes.set(xlabel="ms a pair of 1242x375, two threads", ylabel="D1 on KITTI 2015, %")
    axes.set_xticks([10, 30, 100, 300, 1000], labels=["10", "30", "100", "300", "1000"])
    axes.xaxis.set_minor_formatter("")
    axes.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _plain(cell: str) -> str:
    return re.sub(r"[*`]", "", cell).strip()
