"""The paper's figures agree with each other where they stand twice; nothing here comes from our own runs."""

from __future__ import annotations

import pytest

from stereokit_evaluation.data import published

TABLE = {system.name: system for system in published.TABLE_3}


def test_the_test_figure_is_the_noc_column_of_the_table():
    assert published.TEST["S4"]["stereovae"] == TABLE["StereoVAE"].all[1] == 4.73


def test_figure_1_mixes_the_columns_of_the_table_as_its_points_say():
    column = {"occ": 0, "noc": 1}
    points = [point for point in published.FIGURE_1 if point.pixels]
    assert {point.name for point in points} == {"RTSMNet", "GPUBNN", "ReS2tAC", "StereoVAE"}
    for point in points:
        assert TABLE[point.name].all[column[point.pixels]] == point.d1


def test_the_largest_reduction_is_the_one_of_the_text():
    drops = [row["original"] - row["stereovae"] for row in published.TEST.values()]
    assert max(drops) == pytest.approx(5.82)  # section "Robustness"


def test_both_bar_charts_have_twelve_bars():
    for chart in (published.VALIDATION, published.TEST):
        assert list(chart) == ["S1", "S2", "S3", "S4"]
        assert all(list(row) == ["linear", "original", "stereovae"] for row in chart.values())


def test_table_2_stands_beside_s4_only():
    assert published.agx_ms("S4", "cnn") == 27.9 and published.agx_ms("S4", "stereovae") == 29.88
    assert published.agx_ms("S4", "original") == 12.64
    assert published.agx_ms("S1", "cnn") is None and published.agx_ms("S4", "linear") is None
