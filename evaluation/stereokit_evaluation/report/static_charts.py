"""The charts of a report as SVG and PDF, drawn by matplotlib, and their numbers as CSV.

A chart is a Plotly figure as `stereokit_evaluation.report.charts` makes it; what those use is understood here: lying
bars, points, lines and the texts beside them, logarithmic axes, hatched bars and hollow markers. Text stays text, which
can be searched and edited, and the same chart gives the same bytes.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np

from stereokit.errors import StereokitError
from stereokit_evaluation.report.tables import Column, Table

__all__ = ["chart_table", "draw"]

_WIDTH, _HEIGHT = 7.2, 4.8  # inches
_PX = 96  # of the page's pixels in an inch
_FONT = 8
_MARKERS = {
    "circle": "o", "square": "s", "diamond": "D", "triangle-up": "^", "triangle-down": "v", "pentagon": "p",
    "star": "*", "hexagon": "h", "cross": "P", "x": "X", "hourglass": "d", "bowtie": "8",
}  # fmt: skip
_DASHES = {
    "solid": "-", "dash": "--", "dot": ":", "dashdot": "-.", "longdash": (0, (8, 3)), "longdashdot": (0, (8, 3, 1, 3)),
}  # fmt: skip
_SETTINGS = {
    "svg.fonttype": "none",
    "svg.hashsalt": "stereokit",
    "pdf.fonttype": 42,
    "font.size": _FONT,
    "font.family": "DejaVu Sans",
    "hatch.linewidth": 0.6,
}
_METADATA = {
    "svg": {"Date": None, "Creator": "stereokit"},
    "pdf": {"CreationDate": None, "ModDate": None, "Creator": "stereokit", "Producer": None},
}
_DIRECTIONS = ((0, 1), (1, 0), (-1, 0), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
_DISTANCES = (0, 8, 18, 30, 44, 60, 80, 104)

Figure = Mapping[str, Any]


def chart_table(figure: Figure) -> Table:
    """Return the numbers of a chart: a row for each of its points, and for each region or figure that it can show."""
    by_region = figure.get("variants") or {}
    ((key, regions),) = by_region.items() if by_region else (("", {"": ()}),)
    rows = []
    for region in regions:
        for index, trace in enumerate(figure["data"]):
            values = {name: trace[name] for name in ("x", "y")}
            if key:
                values[key] = regions[region][index]
            texts = trace.get("text") or [None] * len(values["x"])
            for text, x, y in zip(texts, values["x"], values["y"], strict=True):
                if x is not None and y is not None:
                    rows.append((trace.get("name", ""), text, region or None, x, y))
    axes = [(name, figure["layout"].get(f"{name}axis", {}).get("title", {}).get("text")) for name in ("x", "y")]
    heads = [text or ("method" if figure["data"][0]["type"] == "bar" else name) for name, text in axes]
    shows_figures = key != "" and not any(" " in region for region in regions)  # regions have two words
    if shows_figures:
        heads[1] = "value"
    shown = Column("figure" if shows_figures else "pixels", None)
    columns = (Column("series", None), Column("label", None), shown, *(Column(head, None) for head in heads))
    return Table(figure.get("title", ""), columns, tuple(rows))


def draw(figure: Figure, form: str) -> bytes:
    """Return a chart as a file.

    Parameters
    ----------
    figure : dict
        A Plotly figure of `stereokit_evaluation.report.charts`.
    form : {"svg", "pdf"}

    Raises
    ------
    StereokitError
        If matplotlib is not installed.
    """
    try:
        matplotlib = import_module("matplotlib")
        make, agg = import_module("matplotlib.figure").Figure, import_module("matplotlib.backends.backend_agg")
    except ModuleNotFoundError as error:
        raise StereokitError('charts as files need matplotlib: pip install "stereokit[figures]"') from error
    with matplotlib.rc_context(_SETTINGS):
        height = figure["height"] / _PX if "height" in figure else _HEIGHT
        sheet = make(figsize=(_WIDTH, height), layout="constrained")
        agg.FigureCanvasAgg(sheet)
        axes = sheet.add_subplot()
        bars = [trace for trace in figure["data"] if trace["type"] == "bar"]
        labels: list[tuple[float, float, str]] = []
        if bars:
            _draw_bars(axes, bars)
        for trace in figure["data"]:
            if trace["type"] == "scatter":
                labels += _draw_points(axes, trace)
        _lay_out(axes, figure["layout"], bool(bars))
        handles, names = axes.get_legend_handles_labels()
        if names:
            sheet.legend(handles, names, loc="outside upper center", ncols=3, frameon=False)
        _place(sheet, axes, labels)
        buffer = io.BytesIO()
        sheet.savefig(buffer, format=form, metadata=_METADATA[form])
        return buffer.getvalue()


def _draw_bars(axes: Any, traces: Sequence[Figure]) -> None:
    """Draw groups of lying bars, a group for each name on the vertical axis."""
    groups = list(dict.fromkeys(name for trace in traces for name in trace["y"]))
    thickness = 0.8 / len(traces)
    for index, trace in enumerate(traces):
        marker = trace["marker"]
        colours = marker["color"] if isinstance(marker["color"], list) else [marker["color"]] * len(trace["y"])
        hollow = "pattern" in marker
        for name, value, color in zip(trace["y"], trace["x"], colours, strict=True):
            if value is None:
                continue
            place = groups.index(name) - 0.4 + (index + 0.5) * thickness
            style = {"facecolor": "none", "edgecolor": color, "hatch": "/////"} if hollow else {"color": color}
            axes.barh(place, value, thickness, **style)
            axes.annotate(
                f"{value:.2f}",
                (value, place),
                xytext=(2, 0),
                textcoords="offset points",
                va="center",
                fontsize=_FONT - 1,
            )
        style = {"facecolor": "none", "edgecolor": "0.3", "hatch": "/////"} if hollow else {"color": "0.3"}
        axes.barh(0, 0, 0, label=trace.get("name", ""), **style)
    axes.set_yticks(range(len(groups)), labels=groups)
    axes.set_ylim(len(groups) - 0.4, -0.6)


def _draw_points(axes: Any, trace: Figure) -> list[tuple[float, float, str]]:
    """Draw points and lines, and return where which text belongs."""
    marker, mode, line = trace.get("marker", {}), trace.get("mode", "markers"), trace.get("line", {})
    points = [
        (x, y, text)
        for x, y, text in zip(trace["x"], trace["y"], trace.get("text") or [None] * len(trace["x"]), strict=True)
        if x is not None and y is not None
    ]
    symbol = str(marker.get("symbol", "circle"))
    color = marker.get("color") or line.get("color")
    size = float(marker.get("size", 8)) * 0.55
    axes.plot(
        [x for x, _, _ in points],
        [y for _, y, _ in points],
        linestyle=_DASHES.get(str(line.get("dash", "solid")), "-") if "lines" in mode else "none",
        marker=_MARKERS.get(symbol.removesuffix("-open"), "o") if "markers" in mode else None,
        markerfacecolor="none" if symbol.endswith("-open") else color,
        color=color,
        markersize=size,
        label=trace.get("name", ""),
        linewidth=1.2,
    )
    return [(x, y, text) for x, y, text in points if text and "text" in mode]


def _lay_out(axes: Any, layout: Figure, bars: bool) -> None:
    for name in ("x", "y"):
        axis = layout.get(f"{name}axis", {})
        values = [value for line in axes.lines for value in getattr(line, f"get_{name}data")()]
        if axis.get("type") == "log" and any(value > 0 for value in values):  # an axis without any cannot be
            getattr(axes, f"set_{name}scale")("log")
        if title := axis.get("title", {}).get("text"):
            getattr(axes, f"set_{name}label")(title)
        limits = getattr(axes, f"get_{name}lim")
        if axis.get("autorange") == "reversed" and not bars:
            getattr(axes, f"invert_{name}axis")()
        if bars and name == "x":  # the page's range has room for all regions
            axes.set_xlim(0, 1.05 * limits()[1])
        elif "range" in axis and axis.get("type") != "log":
            getattr(axes, f"set_{name}lim")(*axis["range"])
        elif axis.get("rangemode") == "tozero":
            getattr(axes, f"set_{name}lim")(0, limits()[1])
        if "tickvals" in axis:
            low, high = sorted(limits())
            ticks = [(value, str(text)) for value, text in zip(axis["tickvals"], axis["ticktext"], strict=True)]
            ticks = [(value, text) for value, text in ticks if low <= value <= high]
            getattr(axes, f"set_{name}ticks")([value for value, _ in ticks], labels=[text for _, text in ticks])
            getattr(axes, f"{name}axis").set_minor_formatter("")
    axes.grid(axis="x" if bars else "both", color="0.88", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _place(sheet: Any, axes: Any, labels: Sequence[tuple[float, float, str]]) -> None:
    """Write texts beside their points, each at the nearest free place; a line leads to those that are far away."""
    if not labels:
        return
    sheet.canvas.draw()  # the layout settles
    renderer, scale = sheet.canvas.get_renderer(), 72 / sheet.dpi
    centres = [axes.transData.transform((x, y)) * scale for x, y, _ in labels]
    bounds = axes.get_window_extent(renderer)
    radius = 5.0
    boxes = [(x - radius, y - radius, x + radius, y + radius) for x, y in centres]
    for (x, y), (at_x, at_y, text) in zip(centres, labels, strict=True):
        sample = axes.text(0, 0, text, fontsize=_FONT - 1)
        extent = sample.get_window_extent(renderer)
        sample.remove()
        width, height = extent.width * scale + 2, extent.height * scale + 1
        for distance, (right, up) in product(_DISTANCES, _DIRECTIONS):
            dx, dy = right * (radius + 1 + distance + width / 2), up * (radius + 1 + distance + height / 2)
            box = (x + dx - width / 2, y + dy - height / 2, x + dx + width / 2, y + dy + height / 2)
            inside = bounds.x0 * scale <= box[0] and box[2] <= bounds.x1 * scale
            inside = inside and bounds.y0 * scale <= box[1] and box[3] <= bounds.y1 * scale
            if inside and not any(_meet(box, other) for other in boxes):
                boxes.append(box)
                arrow = {"arrowstyle": "-", "color": "0.5", "linewidth": 0.5, "shrinkB": 3, "shrinkA": 0}
                axes.annotate(
                    text,
                    (at_x, at_y),
                    xytext=(float(np.round(dx, 2)), float(np.round(dy, 2))),
                    textcoords="offset points",
                    ha="center",
                    va="center",
                    fontsize=_FONT - 1,
                    arrowprops=arrow if distance > 0 else None,
                )
                break


def _meet(p: tuple[float, ...], q: tuple[float, ...]) -> bool:
    return p[0] < q[2] and q[0] < p[2] and p[1] < q[3] and q[1] < p[3]
