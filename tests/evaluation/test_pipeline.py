"""Table II of the paper on this machine: the rows, what is missing, and the published times beside them."""

from __future__ import annotations

import json

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from stereokit.errors import OptionError
from stereokit.registry import REFINERS
from stereokit_evaluation.commands import bench
from stereokit_evaluation.common.sizes import Size
from stereokit_evaluation.study import table2 as pipeline
from stereokit_refiners import Linear

APP = typer.Typer()
APP.command()(bench.bench)
TINY = "96x32x16"


@pytest.fixture
def refiners(monkeypatch):
    """Let there be linear, cnn (which works) and stereovae (whose runtime fails at the first call)."""

    class Broken:
        def __call__(self, coarse, left, *, threads=1):
            raise ModuleNotFoundError("No module named 'runtime'", name="runtime")

    monkeypatch.setattr(REFINERS, "_entries", lambda: ())
    monkeypatch.setattr(REFINERS, "_items", {"linear": Linear, "cnn": Linear, "stereovae": Broken})


def bench(*words):
    return CliRunner().invoke(APP, ["--pipeline", "--sizes", TINY, "--threads", "1", "--rounds", "2", *words])


def test_rows_stand_beside_the_published_times(refiners):
    done = bench()
    assert done.exit_code == 0, (done.output, done.exception)
    rows = {line[:24].strip(): line.split() for line in done.stdout.splitlines() if line.startswith(" ")}
    assert rows["S4 Original"][-2:] == ["35.71", "12.64"] and rows["S4 Mini+CNN"][-2:] == ["72.10", "27.90"]
    assert any(line.startswith(" S4 Mini+StereoVAE (missing)") for line in done.stdout.splitlines())
    assert "missing: S4 Mini+StereoVAE: needs the package 'runtime'" in done.stdout
    assert "OpenCV HH" in rows and "does not say at which size" in done.stdout.replace("\n", " ")


def test_the_json_has_every_row(refiners):
    done = bench("--json", "-", "--no-peers", "--method", "S2", "--method", "S4")
    rows = {row["name"]: row for row in json.loads(done.stdout)["pipeline"]}
    assert len(rows) == 8 and not any(name.startswith("OpenCV") for name in rows)
    assert rows["S2 Mini+CNN"]["published_ms"] is None
    assert rows["S4 Mini+CNN"]["published_ms"] == {"TX2": 72.1, "AGX": 27.9}
    assert rows["S4 Mini+CNN"]["runs"] == 2 and rows["S4 Mini+CNN"]["parts_ms"]["refine"] > 0
    assert rows["S4 Original"]["parts_ms"]["refine"] is None and rows["S4 Mini+StereoVAE"]["median_ms"] is None


def test_the_refiner_is_part_of_the_time(refiners):
    rows = []
    images = tuple(np.random.default_rng(0).integers(0, 256, (2, 32, 96), np.uint8))
    pipeline.time_pipeline(Size("x", 96, 32, 16), 1, ["S4"], images, 3, rows, with_baselines=False)
    linear = next(row for row in rows if row.name == "S4 Mini+Linear")
    assert len(linear.seconds) == len(linear.parts["refine"]) == 3
    assert 0 < linear.part_ms("refine") < linear.spread.median


def test_a_stage_table_is_another_table(refiners):
    done = bench("--stages")
    assert isinstance(done.exception, OptionError) and "choose one" in str(done.exception)
