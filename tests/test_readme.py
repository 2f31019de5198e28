"""The README's Python runs as it is written, in the order in which it is written."""

import re
from pathlib import Path

import numpy as np
import pytest

import stereokit

README = Path(__file__).parents[1] / "README.md"


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    left = rng.integers(0, 256, (24, 240), dtype=np.uint8)
    for name, image in (("left.png", left), ("right.png", np.roll(left, -5, axis=1))):
        stereokit.io.write_image(name, image)
    scope: dict[str, object] = {}
    assert len(blocks()) == 3
    for code in blocks():
        if "stereokit[fast]" in code:
            pytest.importorskip("openvino")
        exec(code, scope)
    refined = scope["refined"]
    assert isinstance(refined, np.ndarray) and refined.shape == left.shape
    disparity = scope["disparity"]
    assert isinstance(disparity, np.ndarray) and disparity.shape == left.shape
    assert np.median(disparity) == pytest.approx(5, abs=0.5)
    assert (tmp_path / "disparity.pfm").exists()
