"""The figures of every pair and method, for the table of the page that answers where a method loses to another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stereokit_evaluation.report.charts import row_name

__all__ = ["per_pair"]

_MEASURES = {"D1 noc, %": ("d1", "noc"), "D1 all, %": ("d1", "occ"), "EPE, px": ("epe",)}


def per_pair(
    rows: Sequence[Mapping[str, Any]], viewer_frames: Sequence[str] = (), digits: int | None = None
) -> dict[str, Any]:
    """Return the figures by measure, method and pair.

    Parameters
    ----------
    rows : sequence of dict
        ``results`` of the study's JSON.
    viewer_frames : sequence of str
        The pairs that the page's viewer has, in its order.
    digits : int, optional
        Digits after the point, to keep a page small; None rounds nothing.

    Returns
    -------
    dict
        ``frames`` and ``methods`` (names), ``measures`` (by name a list for each method, with a figure or None for each
        frame; measures that no pair has are left out), ``viewer`` (a place in the viewer by frame).
    """
    scored = [row for row in rows if row["frames"]]
    names = list(dict.fromkeys(frame["name"] for row in scored for frame in row["frames"]))
    measures = {}
    for measure, keys in _MEASURES.items():
        table = []
        for row in scored:
            figures = {frame["name"]: _figure(frame, keys, digits) for frame in row["frames"]}
            table.append([figures.get(name) for name in names])
        if any(value is not None for column in table for value in column):
            measures[measure] = table
    places = {name: place for place, name in enumerate(viewer_frames)}
    return {"frames": names, "methods": [row_name(row) for row in scored], "measures": measures, "viewer": places}


def _figure(frame: Mapping[str, Any], keys: Sequence[str], digits: int | None) -> float | None:
    value: Any = frame
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return None if value is None else float(value) if digits is None else round(float(value), digits)
