"""All measures of a study for its page: figures with intervals, each method beside the best one, and by data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stereokit_evaluation.report.charts import row_name

__all__ = ["COLUMNS", "by_data_set", "measure_rows"]

COLUMNS = {
    "bad-0.5": "bad-0.5", "bad-1": "bad-1", "bad-2": "bad-2", "bad-4": "bad-4", "epe": "EPE", "rmse": "RMSE",
    "a90": "A90", "a95": "A95", "density": "density",
}  # fmt: skip
"""The figures of the table beside D1, with their heads."""


def measure_rows(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the table of all measures, a dictionary for each method; empty if the study's JSON has no such figures.

    Each has ``name``, ``d1`` and its ``interval`` (or None), ``figures`` (by the keys of `COLUMNS`), ``occluded`` and
    ``edges`` (D1 there), and ``beside`` the best method by D1: None for itself, else ``difference``, ``low``, ``high``
    and ``p`` of the comparison (or None).
    """
    rows = [row for row in document["results"] if row.get("figures") and row["missing"] is None]
    scored = [row for row in rows if row["figures"]["main"].get("d1") is not None]
    if not scored:
        return []
    best = min(scored, key=lambda row: float(row["figures"]["main"]["d1"]))
    return [
        {
            "name": row_name(row),
            "d1": row["figures"]["main"]["d1"],
            "interval": (row.get("intervals") or {}).get("d1"),
            "figures": {name: row["figures"]["main"].get(name) for name in COLUMNS},
            "occluded": row["figures"]["occluded"].get("d1"),
            "edges": row["figures"]["edges"].get("d1"),
            "best": row is best,
            "beside": _comparison(document.get("comparisons") or (), row_name(row), row_name(best)),
        }
        for row in scored
    ]


def by_data_set(document: Mapping[str, Any]) -> tuple[list[str], list[tuple[str, list[float | None]]]]:
    """Return the names of the data sets, and for each method its D1 on each; both empty for a single data set."""
    parts = document.get("data") or {}
    if len(parts) < 2:
        return [], []
    table: dict[str, list[float | None]] = {}
    for place, content in enumerate(parts.values()):
        for row in content["results"]:
            figures = table.setdefault(row_name(row), [None] * len(parts))
            figures[place] = row["figures"]["main"].get("d1")
    return list(parts), list(table.items())


def _comparison(entries: Sequence[Mapping[str, Any]], name: str, best: str) -> dict[str, float | None] | None:
    """Return the comparison of D1 of a method with the best one, the method first."""
    for entry in entries:
        if entry["figure"] != "d1" or {entry["first"], entry["second"]} != {name, best} or name == best:
            continue
        keys = ("difference", "low", "high", "p")
        if entry["first"] == name:
            return {key: entry[key] for key in keys}
        low, high = entry["low"], entry["high"]
        turned = {"low": None if high is None else -high, "high": None if low is None else -low}
        return {"difference": -entry["difference"], **turned, "p": entry["p"]}
    return None
