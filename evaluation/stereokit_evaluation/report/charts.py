"""The charts of the report as Plotly figures (plain dictionaries): the paper's bar charts and its accuracy-time plot.

Published figures are hatched bars and hollow markers, ours solid ones, so that they differ by more than colour.
Colours are those of Okabe and Ito (2008), which the colour-blind can distinguish.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stereokit_evaluation.data import published
from stereokit_evaluation.study.configurations import PAPER_VARIANTS, title

__all__ = ["REGIONS", "accuracy_time", "bars", "colour"]

REGIONS = {
    "noc all": "not occluded, all",
    "noc bg": "not occluded, background",
    "noc fg": "not occluded, foreground",
    "occ all": "with occluded, all",
    "occ bg": "with occluded, background",
    "occ fg": "with occluded, foreground",
}
"""The regions of the charts, by the keys of the JSON joined with a blank."""

_COLOURS = {"linear": "#56b4e9", "original": "#e69f00", "cnn": "#009e73", "stereovae": "#d55e00"}
_OTHERS = ("#cc79a7", "#0072b2", "#f0e442")
_TICKS = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000]
_BASELINE_COLOUR = "#8a8a8a"

JsonRow = Mapping[str, Any]


def colour(variant: str, variants: Sequence[str]) -> str:
    """Return the colour of a variant; variants beyond the paper's share three."""
    others = [name for name in variants if name not in _COLOURS]
    return _COLOURS.get(variant) or _OTHERS[others.index(variant) % len(_OTHERS)]


def bars(rows: Sequence[JsonRow], figure: str, name: str) -> dict[str, Any]:
    """Return one of the paper's bar charts, with our bars and the published ones.

    Parameters
    ----------
    rows : sequence of dict
        ``results`` of the study's JSON.
    figure : {"e4", "e5"}
        Which of the two.
    name : str
        The data set, for the legend.
    """
    paper = {"e4": published.VALIDATION, "e5": published.TEST}[figure]
    ours = [row for row in rows if row["setting"] != "peer"]
    matchers = list(dict.fromkeys(row["matcher"] for row in ours))
    ours_by_name = list(dict.fromkeys(_variant(row) for row in ours))
    published_names = {name for part in paper.values() for name in part}
    chart_variants = [s for s in (*PAPER_VARIANTS, *ours_by_name) if s in ours_by_name or s in published_names]
    traces: list[dict[str, Any]] = []
    heights_by_region: dict[str, list[Any]] = {region: [] for region in REGIONS}
    for variant in dict.fromkeys(chart_variants):
        color = colour(variant, chart_variants)
        paper_values = [paper.get(matcher, {}).get(variant) for matcher in matchers]
        if any(value is not None for value in paper_values):
            pattern = {"shape": "/", "fgcolor": color, "bgcolor": "rgba(0,0,0,0)", "size": 6}
            hatched = {"color": color, "pattern": pattern}
            line = {"color": color, "width": 1.5}
            traces.append(_bar(f"{title(variant)}, published", matchers, paper_values, {**hatched, "line": line}))
            for values in heights_by_region.values():
                values.append(paper_values)
        cells = {row["matcher"]: row for row in ours if _variant(row) == variant and row["missing"] is None}
        measured = {region: [_d1(cells[m], region) if m in cells else None for m in matchers] for region in REGIONS}
        if cells:
            traces.append(_bar(f"{title(variant)}, {name}", matchers, measured["noc all"], {"color": color}))
            for region, values in heights_by_region.items():
                values.append(measured[region])
    heights = [y for values in heights_by_region.values() for bars in values for y in bars if y is not None]
    room = 1.18 * max(heights, default=1.0)  # for the figures above the bars
    layout = {
        "barmode": "group",
        "bargap": 0.18,
        "yaxis": {"title": {"text": "D1 error, %"}, "range": [0, room]},
        "legend": {"orientation": "h", "y": -0.16},
    }
    return {"data": traces, "layout": layout, "variants": {"y": heights_by_region}}


def accuracy_time(rows: Sequence[JsonRow]) -> dict[str, Any]:
    """Return the paper's figure 1: error against time, with ours and OpenCV's on this machine."""
    traces: list[dict[str, Any]] = []
    errors_by_region: dict[str, list[Any]] = {region: [] for region in REGIONS}
    variants = list(dict.fromkeys(_variant(row) for row in rows if row["setting"] != "peer"))
    groups = [(title(s), [r for r in rows if _variant(r) == s], colour(s, variants), "circle") for s in variants]
    groups.append(("OpenCV", [row for row in rows if row["setting"] == "peer"], _BASELINE_COLOUR, "square"))
    for name, members, color, symbol in groups:
        scored = [row for row in members if row["missing"] is None and row["ms"]]
        if not scored:
            continue
        marker = {"color": color, "size": 12, "symbol": symbol}
        labels = [row["matcher"].removeprefix("OpenCV ") for row in scored]
        x = [_d1(row, "noc all") for row in scored]
        traces.append(_points(f"{name}, this machine", x, [row["ms"]["total"] for row in scored], labels, marker))
        for region, values in errors_by_region.items():
            values.append([_d1(row, region) for row in scored])
    points = published.FIGURE_1
    marker = {"color": "#d55e00", "size": 12, "symbol": "diamond-open", "line": {"width": 2}}
    sources = [f"{p.source}{', pixels: ' + p.pixels if p.pixels else ''}" for p in points]
    x, y = [p.d1 for p in points], [p.ms for p in points]
    traces.append(_points("published, Jetson AGX Xavier", x, y, [p.name for p in points], marker, sources))
    for values in errors_by_region.values():
        values.append(x)
    layout = {
        "xaxis": {"title": {"text": "D1 error, %"}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "time, ms"}, "type": "log", "tickvals": _TICKS, "ticktext": _TICKS},
        "legend": {"orientation": "h", "y": -0.2},
    }
    return {"data": traces, "layout": layout, "variants": {"x": errors_by_region}}


def _bar(name: str, x: Sequence[str], y: Sequence[float | None], marker: dict[str, Any]) -> dict[str, Any]:
    hover = "%{x}: %{y:.2f} %<extra>" + name + "</extra>"
    labels = {"texttemplate": "%{y:.2f}", "textposition": "outside", "textangle": -90, "cliponaxis": False}
    labels |= {"textfont": {"size": 11}, "constraintext": "none"}
    return {"type": "bar", "name": name, "x": list(x), "y": list(y), "marker": marker, "hovertemplate": hover, **labels}


def _points(
    name: str,
    x: Sequence[float | None],
    y: Sequence[float],
    text: Sequence[str],
    marker: dict[str, Any],
    notes: Sequence[str] | None = None,
) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "markers+text",
        "name": name,
        "x": list(x),
        "y": list(y),
        "text": list(text),
        "customdata": list(notes or [name] * len(x)),
        "textposition": "top center",
        "marker": marker,
        "cliponaxis": False,
        "hovertemplate": "%{text}: %{x:.2f} %, %{y:.1f} ms<br>%{customdata}<extra></extra>",
    }


def _variant(row: JsonRow) -> str:
    return "original" if row["refiner"] is None else str(row["refiner"])


def _d1(row: JsonRow, region: str) -> float | None:
    pixels, part = region.split()
    value: float | None = row["d1"][pixels][part]
    return value
