"""The charts of the report as Plotly figures (plain dictionaries): the paper's bar charts and its accuracy-time plot.

Published figures are hatched bars and hollow markers, ours solid ones, so that they differ by more than colour.
Colours are those of Okabe and Ito (2008), which the colour-blind tell apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stereokit_evaluation.data import published
from stereokit_evaluation.study.configurations import PAPER_SETTINGS, title

__all__ = ["REGIONS", "accuracy_time", "bars", "colour"]

REGIONS = {
    "noc all": "not occluded, all",
    "noc bg": "not occluded, background",
    "noc fg": "not occluded, foreground",
    "occ all": "with occluded, all",
    "occ bg": "with occluded, background",
    "occ fg": "with occluded, foreground",
}
"""The regions that the charts can show, by the keys of the JSON joined with a blank."""

_COLOURS = {"linear": "#56b4e9", "original": "#e69f00", "cnn": "#009e73", "stereovae": "#d55e00"}
_OTHERS = ("#cc79a7", "#0072b2", "#f0e442")
_TICKS = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000]
_PEER_COLOUR = "#8a8a8a"

Row = Mapping[str, Any]


def colour(setting: str, settings: Sequence[str]) -> str:
    """Return the colour of a setting; those that the paper does not have share three."""
    others = [name for name in settings if name not in _COLOURS]
    return _COLOURS.get(setting) or _OTHERS[others.index(setting) % len(_OTHERS)]


def bars(rows: Sequence[Row], figure: str, name: str) -> dict[str, Any]:
    """Return one of the paper's bar charts, with ours beside the published bars.

    Parameters
    ----------
    rows : sequence of dict
        ``results`` of the study's JSON.
    figure : {"e4", "e5"}
        Which of the two.
    name : str
        The data set, for the legend.
    """
    theirs = {"e4": published.VALIDATION, "e5": published.TEST}[figure]
    ours = [row for row in rows if row["setting"] != "peer"]
    matchers = list(dict.fromkeys(row["matcher"] for row in ours))
    settings = [s for s in dict.fromkeys(_setting(row) for row in ours)]
    shown = [s for s in (*PAPER_SETTINGS, *settings) if s in settings or any(s in part for part in theirs.values())]
    traces: list[dict[str, Any]] = []
    variants: dict[str, list[Any]] = {region: [] for region in REGIONS}
    for setting in dict.fromkeys(shown):
        tint = colour(setting, shown)
        printed = [theirs.get(matcher, {}).get(setting) for matcher in matchers]
        if any(value is not None for value in printed):
            hatched = {"color": tint, "pattern": {"shape": "/", "fgcolor": tint, "bgcolor": "rgba(0,0,0,0)", "size": 6}}
            line = {"color": tint, "width": 1.5}
            traces.append(_bar(f"{title(setting)}, published", matchers, printed, {**hatched, "line": line}))
            for values in variants.values():
                values.append(printed)
        cells = {row["matcher"]: row for row in ours if _setting(row) == setting and row["missing"] is None}
        measured = {region: [_d1(cells[m], region) if m in cells else None for m in matchers] for region in REGIONS}
        if cells:
            traces.append(_bar(f"{title(setting)}, {name}", matchers, measured["noc all"], {"color": tint}))
            for region, values in variants.items():
                values.append(measured[region])
    heights = [y for values in variants.values() for bars in values for y in bars if y is not None]
    room = 1.18 * max(heights, default=1.0)  # for the figures above the bars
    layout = {
        "barmode": "group",
        "bargap": 0.18,
        "yaxis": {"title": {"text": "D1 error, %"}, "range": [0, room]},
        "legend": {"orientation": "h", "y": -0.16},
    }
    return {"data": traces, "layout": layout, "variants": {"y": variants}}


def accuracy_time(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the paper's figure 1: error against time, with ours and OpenCV's on this machine."""
    traces: list[dict[str, Any]] = []
    variants: dict[str, list[Any]] = {region: [] for region in REGIONS}
    settings = list(dict.fromkeys(_setting(row) for row in rows if row["setting"] != "peer"))
    groups = [(title(s), [r for r in rows if _setting(r) == s], colour(s, settings), "circle") for s in settings]
    groups.append(("OpenCV", [row for row in rows if row["setting"] == "peer"], _PEER_COLOUR, "square"))
    for name, members, tint, symbol in groups:
        scored = [row for row in members if row["missing"] is None and row["ms"]]
        if not scored:
            continue
        marker = {"color": tint, "size": 12, "symbol": symbol}
        labels = [row["matcher"].removeprefix("OpenCV ") for row in scored]
        x = [_d1(row, "noc all") for row in scored]
        traces.append(_points(f"{name}, this machine", x, [row["ms"]["total"] for row in scored], labels, marker))
        for region, values in variants.items():
            values.append([_d1(row, region) for row in scored])
    points = published.FIGURE_1
    marker = {"color": "#d55e00", "size": 12, "symbol": "diamond-open", "line": {"width": 2}}
    sources = [f"{p.source}{', pixels: ' + p.pixels if p.pixels else ''}" for p in points]
    x, y = [p.d1 for p in points], [p.ms for p in points]
    traces.append(_points("published, Jetson AGX Xavier", x, y, [p.name for p in points], marker, sources))
    for values in variants.values():
        values.append(x)
    layout = {
        "xaxis": {"title": {"text": "D1 error, %"}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "time, ms"}, "type": "log", "tickvals": _TICKS, "ticktext": _TICKS},
        "legend": {"orientation": "h", "y": -0.2},
    }
    return {"data": traces, "layout": layout, "variants": {"x": variants}}


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


def _setting(row: Row) -> str:
    return "original" if row["refiner"] is None else str(row["refiner"])


def _d1(row: Row, region: str) -> float | None:
    pixels, part = region.split()
    value: float | None = row["d1"][pixels][part]
    return value
