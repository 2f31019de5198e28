"""The charts of disturbances: valid Plotly, true to the figures, readable without colour."""

from __future__ import annotations

import pytest

from stereokit_evaluation.report.disturbance_charts import FIGURE_TITLES, disturbance_chart, disturbance_charts


def entry(strengths, neutral, rows=("S2 original", "S2 linear", "Net peer")):
    results = []
    for shift, text in enumerate(rows):
        label, variant = text.split()
        figures = {name: [10.0 * (k + 1) + shift for k in range(len(strengths))] for name in FIGURE_TITLES}
        results.append(
            {
                "name": text, "label": label, "variant": variant, "figures": figures,
                "undisturbed": dict.fromkeys(FIGURE_TITLES, float(shift)),
            }
        )  # fmt: skip
    return {"unit": "px", "views": "right", "about": "", "neutral": neutral, "strengths": strengths, "results": results}


def test_points_stand_in_the_order_of_strengths_with_the_undisturbed_one():
    chart = disturbance_chart("gain", entry([2.0, 0.5], 1.0))
    assert chart["data"][0]["x"] == [0.5, 1.0, 2.0] and chart["data"][0]["y"] == [20.0, 0.0, 10.0]
    assert chart["layout"]["xaxis"]["ticktext"] == ["0.5", "none", "2"]
    assert chart["layout"]["xaxis"]["title"]["text"] == "gain (right view), px"
    assert "autorange" not in chart["layout"]["xaxis"]


def test_quality_falls_to_the_right():
    chart = disturbance_chart("jpeg", entry([80.0, 10.0], 100.0))
    assert chart["data"][0]["x"] == [10.0, 80.0, 100.0] and chart["layout"]["xaxis"]["autorange"] == "reversed"


def test_a_strength_that_is_neutral_is_not_there_twice():
    assert disturbance_chart("noise", entry([0.0, 5.0], 0.0))["data"][0]["x"] == [0.0, 5.0]


def test_lines_differ_without_colour_and_every_figure_can_be_shown():
    chart = disturbance_chart("offset", entry([1.0], 0.0), "epe")
    looks = {(line["line"]["dash"], line["marker"]["symbol"]) for line in chart["data"]}
    assert len(looks) == 3 and chart["layout"]["yaxis"]["title"]["text"] == "mean error, px"
    assert set(chart["variants"]["y"]) == set(FIGURE_TITLES)
    assert [line["y"] for line in chart["data"]] == chart["variants"]["y"]["epe"]


def test_the_charts_are_valid_plotly():
    plotly = pytest.importorskip("plotly.graph_objects")
    charts = disturbance_charts({"offset": entry([1.0], 0.0), "jpeg": entry([20.0], 100.0)})
    assert list(charts) == ["offset", "jpeg"]
    for chart in charts.values():
        assert len(plotly.Figure(data=chart["data"], layout=chart["layout"]).data) == 3
