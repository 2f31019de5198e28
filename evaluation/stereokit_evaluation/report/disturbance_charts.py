"""Line charts of a study's errors against the strength of a fault of the cameras, as Plotly figures (dictionaries).

One chart for each kind, each method a line. Lines differ by colour (those of Okabe and Ito, 2008), by dashes and by the
shape of their marks, so that no two are told apart by colour alone; the first point is that of the undisturbed pairs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["FIGURE_TITLES", "disturbance_chart", "disturbance_charts"]

FIGURE_TITLES = {
    "d1": "D1 error, %", "bad-1": "bad-1, %", "bad-2": "bad-2, %", "epe": "mean error, px", "density": "density, %",
}  # fmt: skip
"""The figures that a chart can show, with the titles of their axes."""

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a8a8a", "#b8a100")
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
_MARKS = ("circle", "square", "diamond", "triangle-up", "cross", "x", "star", "triangle-down")


def disturbance_charts(disturbances: Mapping[str, Any], figure: str = "d1") -> dict[str, dict[str, Any]]:
    """Return one chart for each kind of fault, by its name.

    Parameters
    ----------
    disturbances : mapping
        ``disturbances`` of the study's JSON (`stereokit_evaluation.study.disturbances.disturbances_json`).
    figure : str
        The figure that is shown first, a key of `FIGURE_TITLES`.
    """
    return {kind: disturbance_chart(kind, entry, figure) for kind, entry in disturbances.items()}


def disturbance_chart(kind: str, entry: Mapping[str, Any], figure: str = "d1") -> dict[str, Any]:
    """Return the chart of one kind.

    Parameters
    ----------
    kind : str
    entry : mapping
        Its entry of the JSON.
    figure : str
        The figure that is shown first.

    Returns
    -------
    dict
        ``data`` and ``layout`` of Plotly, and ``variants``: the lines' values for each key of `FIGURE_TITLES`.
    """
    order = _order(entry)
    x = [([entry["neutral"], *entry["strengths"]])[place] for place in order]
    values = {
        name: [
            [([row["undisturbed"][name], *row["figures"][name]])[place] for place in order] for row in entry["results"]
        ]
        for name in FIGURE_TITLES
    }
    styles = _styles(entry["results"])
    traces = [
        _line(row["name"], x, values[figure][index], style, entry["unit"])
        for index, (row, style) in enumerate(zip(entry["results"], styles, strict=True))
    ]
    where = "both views" if entry["views"] == "both" else "right view"
    texts = ["none" if place == 0 else f"{value:g}" for place, value in zip(order, x, strict=True)]
    axis: dict[str, Any] = {"title": {"text": f"{kind} ({where}), {entry['unit']}"}, "tickvals": x, "ticktext": texts}
    if entry["strengths"] and max(entry["strengths"]) < entry["neutral"]:
        axis["autorange"] = "reversed"  # JPEG's quality: worse to the right
    layout = {
        "xaxis": axis,
        "yaxis": {"title": {"text": FIGURE_TITLES[figure]}, "rangemode": "tozero"},
        "legend": {"orientation": "h", "y": -0.25},
    }
    return {"data": traces, "layout": layout, "variants": {"y": values}}


def _order(entry: Mapping[str, Any]) -> list[int]:
    """Return the places of the undisturbed point, 0, and of the strengths, by the strength."""
    strengths = [entry["neutral"], *entry["strengths"]]
    places = [place for place in range(len(strengths)) if place == 0 or strengths[place] != entry["neutral"]]
    return sorted(places, key=lambda place: strengths[place])


def _styles(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return colour by matcher, dashes by variant and marks by both."""
    labels = list(dict.fromkeys(row["label"] for row in rows))
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    return [
        {
            "line": {
                "color": _COLOURS[labels.index(row["label"]) % len(_COLOURS)],
                "dash": _DASHES[variants.index(row["variant"]) % len(_DASHES)],
            },
            "marker": {"symbol": _MARKS[index % len(_MARKS)], "size": 7},
        }
        for index, row in enumerate(rows)
    ]


def _line(
    name: str, x: Sequence[float], y: Sequence[float | None], style: Mapping[str, Any], unit: str
) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        "x": list(x),
        "y": list(y),
        "connectgaps": False,
        "hovertemplate": "%{y:.2f} at %{x} " + unit + "<extra>" + name + "</extra>",
        **style,
    }
