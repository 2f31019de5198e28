"""The charts of the report as Plotly figures (plain dictionaries): the paper's bar charts and its accuracy-time plot.

Bars lie, a row each, with their names beside them, so that no label can meet another. Published figures are hatched
bars and hollow markers, ours solid ones; a setting has a colour and a marker of its own. Colours are those of Okabe and
Ito (2008), which the colour-blind can distinguish.

Beside ``data`` and ``layout`` a figure may have ``variants`` (a trace's coordinates by region), ``height`` (pixels) and
``title``. `stereokit_evaluation.report.static_charts` draws the same figures as SVG and PDF.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stereokit_evaluation.data import published
from stereokit_evaluation.report.disturbance_charts import disturbance_charts
from stereokit_evaluation.study.configurations import BASELINE, PAPER_VARIANTS, title

__all__ = ["REGIONS", "accuracy_time", "bars", "colour", "figures", "first_region", "kitti_part", "row_name", "symbol"]

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
_OTHERS = ("#cc79a7", "#0072b2", "#b8a800", "#7a5195", "#4d8c3f", "#a05a2c")
_SYMBOLS = {"linear": "triangle-up", "original": "circle", "cnn": "pentagon", "stereovae": "star"}
_OTHER_SYMBOLS = ("triangle-down", "hexagon", "cross", "x", "hourglass", "bowtie")
_TICKS = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000]
_BASELINE_COLOUR = "#8a8a8a"
_ROW_PX, _FRAME_PX = 30, 110  # height of a row of bars, and of axis and legend

JsonRow = Mapping[str, Any]


def figures(document: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return all charts of a study's JSON, by the id of the element of the page that they go to."""
    rows, name, kitti = document["results"], document["dataset"], kitti_part(document)
    region = first_region(rows)
    charts = {} if kitti is not None and kitti["name"] == name else {"chart-d1": bars(rows, None, name, region)}
    if kitti is not None:
        charts |= {f"chart-{figure}": bars(kitti["results"], figure, kitti["name"], region) for figure in ("e4", "e5")}
    times = accuracy_time(rows if kitti is None else kitti["results"], region, beside_paper=kitti is not None)
    charts |= {"chart-time": times} if times["data"] else {}  # finished maps have no times
    faults = disturbance_charts(document.get("disturbances") or {})
    return charts | {f"chart-fault-{kind}": _titled(kind, chart) for kind, chart in faults.items()}


def kitti_part(document: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the part of a study that stands beside published figures, which are of KITTI 2015; None without it.

    Returns
    -------
    dict or None
        ``name`` of the data set, its ``results``, and ``frames_with_truth`` (by kind of truth, or None).
    """
    parts = document.get("data") or {document["dataset"]: document}
    for name, part in parts.items():
        if part["dataset"] == "kitti2015":
            return {"name": name, "results": part["results"], "frames_with_truth": part.get("frames_with_truth")}
    return None


def first_region(rows: Sequence[JsonRow]) -> str:
    """Return the first of `REGIONS` that any row has a figure of."""
    scored = (region for region in REGIONS if any(_d1(row, region) is not None for row in rows))
    return next(scored, "noc all")


def _titled(kind: str, chart: dict[str, Any]) -> dict[str, Any]:
    """Return a chart of lines with a title, and its legend on top, clear of the axis."""
    layout = {**chart["layout"], "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom"}}
    return {**chart, "layout": layout, "title": f"Error against {kind}"}


def row_name(row: JsonRow) -> str:
    """Return the name of a row of the study's JSON: ``"S4 Mini+Linear"``, ``"OpenCV HH"``, or its own ``name``."""
    name: str | None = row.get("name")
    return name or (row["matcher"] if row["setting"] == BASELINE else f"{row['matcher']} {row['setting']}")


def colour(variant: str, variants: Sequence[str]) -> str:
    """Return the colour of a variant; variants beyond the paper's take turns with six."""
    others = [name for name in variants if name not in _COLOURS]
    return _COLOURS.get(variant) or _OTHERS[others.index(variant) % len(_OTHERS)]


def symbol(variant: str, variants: Sequence[str]) -> str:
    """Return the marker of a variant, as `colour` does."""
    others = [name for name in variants if name not in _SYMBOLS]
    return _SYMBOLS.get(variant) or _OTHER_SYMBOLS[others.index(variant) % len(_OTHER_SYMBOLS)]


def bars(rows: Sequence[JsonRow], figure: str | None, name: str, region: str = "noc all") -> dict[str, Any]:
    """Return D1 errors as bars, a row each, matcher by matcher; beside the published ones of one of the paper's charts.

    Parameters
    ----------
    rows : sequence of dict
        ``results`` of the study's JSON.
    figure : {"e4", "e5"} or None
        Which of the two; None for data that the paper has no figures of.
    name : str
        The data set, for the legend.
    region : str
        Of `REGIONS`: the one that is drawn at first.
    """
    paper = {} if figure is None else {"e4": published.VALIDATION, "e5": published.TEST}[figure]
    ours = [row for row in rows if row["setting"] != BASELINE]
    matchers = list(dict.fromkeys(row["matcher"] for row in ours))
    variants = list(dict.fromkeys(_variant(row) for row in ours))
    published_names = {variant for part in paper.values() for variant in part}
    variants = list(dict.fromkeys(s for s in (*PAPER_VARIANTS, *variants) if s in variants or s in published_names))
    measured = {(row["matcher"], _variant(row)): row for row in ours if row["missing"] is None}
    cells = [(m, s) for m in matchers for s in variants if (m, s) in measured or s in paper.get(m, {})]
    labels = [f"{matcher} {title(variant)}" for matcher, variant in cells]
    colours = [colour(variant, variants) for _, variant in cells]
    scored: list[JsonRow | None] = [measured.get(cell) for cell in cells]
    for row in rows:
        if row["setting"] == BASELINE and row["missing"] is None:
            labels.append(row_name(row))
            colours.append(_BASELINE_COLOUR)
            scored.append(row)
    printed = [paper.get(m, {}).get(s) for m, s in cells] + [None] * (len(labels) - len(cells))
    values = {key: [None if row is None else _d1(row, key) for row in scored] for key in REGIONS}
    hatched = {
        "color": colours,
        "pattern": {"shape": "/", "fgcolor": colours, "bgcolor": "rgba(0,0,0,0)", "size": 6},
        "line": {"color": colours, "width": 1.5},
    }
    traces = [] if figure is None else [_bar("published", labels, printed, hatched)]
    traces.append(_bar(f"measured here, {name}", labels, values[region], {"color": colours}))
    widths = [x for column in (printed, *values.values()) for x in column if x is not None]
    layout = {
        "barmode": "group",
        "bargap": 0.2,
        "xaxis": {"title": {"text": "D1 error, %"}, "range": [0, 1.15 * max(widths, default=1.0)]},
        "yaxis": {"autorange": "reversed", "ticks": ""},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "traceorder": "normal"},
    }
    by_region = {key: [column] if figure is None else [printed, column] for key, column in values.items()}
    height = _FRAME_PX + _ROW_PX * len(labels)
    words = {"e4": "validation figures (fig. e4)", "e5": "test figures (fig. e5)"}
    heading = "D1 error" if figure is None else f"D1 error beside the paper's {words[figure]}"
    return {"data": traces, "layout": layout, "variants": {"x": by_region}, "height": height, "title": heading}


def accuracy_time(rows: Sequence[JsonRow], region: str = "noc all", *, beside_paper: bool = True) -> dict[str, Any]:
    """Return error against time on this machine, on KITTI 2015 beside the points of the paper's figure 1."""
    traces: list[dict[str, Any]] = []
    errors_by_region: dict[str, list[Any]] = {region: [] for region in REGIONS}
    variants = list(dict.fromkeys(_variant(row) for row in rows if row["setting"] != BASELINE))
    groups = [
        (title(s), [r for r in rows if r["setting"] != BASELINE and _variant(r) == s], colour(s, variants), s)
        for s in variants
    ]
    groups.append(("other methods", [row for row in rows if row["setting"] == BASELINE], _BASELINE_COLOUR, ""))
    for name, members, color, variant in groups:
        scored = [row for row in members if row["missing"] is None and row["ms"]]
        if not scored:
            continue
        marker = {"color": color, "size": 12, "symbol": symbol(variant, variants) if variant else "square"}
        labels = [row_name(row).removeprefix("OpenCV ") if not variant else row["matcher"] for row in scored]
        x = [_d1(row, region) for row in scored]
        traces.append(_points(f"{name}, this machine", x, [row["ms"]["total"] for row in scored], labels, marker))
        for key, values in errors_by_region.items():
            values.append([_d1(row, key) for row in scored])
    points = published.FIGURE_1 if beside_paper else ()
    marker = {"color": "#d55e00", "size": 12, "symbol": "diamond-open", "line": {"width": 2}}
    sources = [f"{p.source}{', pixels: ' + p.pixels if p.pixels else ''}" for p in points]
    x, y = [p.d1 for p in points], [p.ms for p in points]
    if points:
        traces.append(_points("published, Jetson AGX Xavier", x, y, [p.name for p in points], marker, sources))
        for values in errors_by_region.values():
            values.append(x)
    layout = {
        "xaxis": {"title": {"text": "D1 error, %"}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "time, ms"}, "type": "log", "tickvals": _TICKS, "ticktext": _TICKS},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom"},
    }
    return {"data": traces, "layout": layout, "variants": {"x": errors_by_region}, "title": "Accuracy against time"}


def _bar(name: str, y: Sequence[str], x: Sequence[float | None], marker: dict[str, Any]) -> dict[str, Any]:
    hover = "%{y}: %{x:.2f} %<extra>" + name + "</extra>"
    labels = {"texttemplate": "%{x:.2f}", "textposition": "outside", "cliponaxis": False}
    labels |= {"textfont": {"size": 11}, "constraintext": "none"}
    trace = {"type": "bar", "orientation": "h", "name": name, "x": list(x), "y": list(y), "marker": marker}
    return {**trace, "hovertemplate": hover, **labels}


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
