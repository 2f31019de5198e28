"""Every example runs as it is, in a process of its own and in an empty folder."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(ROOT.glob("*.py"))


def test_there_are_examples():
    assert EXAMPLES


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.stem)
def test_example(script, run_python, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "from distributed import" in script.read_text(encoding="utf-8"):
        pytest.importorskip("distributed", reason="Dask's distributed is not installed: pip install 'stereokit[dask]'")
    run_python("-W", "error", script)


def test_custom_cost_finds_the_shift(run_python):
    script = next(path for path in EXAMPLES if path.stem == "custom_cost")
    assert run_python(script).count("median disparity 7.0 px") == 2


def test_video_tells_how_near_the_wall_is(run_python, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = run_python(ROOT / "video.py").splitlines()
    assert [float(line.split()[4]) for line in lines] == pytest.approx(range(4, 12), abs=0.3)
    assert (tmp_path / "disparity.avi").stat().st_size > 0


def test_the_cluster_makes_every_map(run_python, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="Dask's distributed is not installed: pip install 'stereokit[dask]'")
    monkeypatch.chdir(tmp_path)
    assert run_python(ROOT / "dask_cluster.py") == "12 maps written, 0 failed\n12 maps found\n"
    assert len(list((tmp_path / "maps").glob("*.png"))) == 12
