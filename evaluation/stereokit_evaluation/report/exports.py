"""The files of a study for a paper: tables as CSV, LaTeX and Markdown, charts as CSV, SVG and PDF."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from stereokit.io import write_bytes
from stereokit_evaluation.common.folders import make_folder
from stereokit_evaluation.report.charts import figures
from stereokit_evaluation.report.static_charts import chart_table, draw
from stereokit_evaluation.report.tables import study_tables

__all__ = ["write_exports"]

_LONG = ("pairs", "measures_by_pixels", "comparisons")  # tables for programs, as CSV alone
_NAMES = {"chart-d1": "d1", "chart-e4": "d1_validation", "chart-e5": "d1_test", "chart-time": "accuracy_time"}


def write_exports(document: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write the tables and charts of a study to the folders ``tables`` and ``charts``.

    Parameters
    ----------
    document : dict
        The study's JSON.
    folder : Path
        Created where it does not exist.

    Returns
    -------
    list of Path
        The files. SVG and PDF are left out where matplotlib is not installed.

    Raises
    ------
    FileError
        If a file cannot be written.
    """
    files: dict[Path, bytes] = {}
    for name, table in study_tables(document).items():
        files[folder / "tables" / f"{name}.csv"] = table.csv().encode()
        if not name.endswith(_LONG):
            files[folder / "tables" / f"{name}.tex"] = table.latex().encode()
            files[folder / "tables" / f"{name}.md"] = table.markdown().encode()
    for key, figure in figures(document).items():
        name = _NAMES.get(key, key.removeprefix("chart-").replace("-", "_"))
        files[folder / "charts" / f"{name}.csv"] = chart_table(figure).csv().encode()
        for form in ("svg", "pdf") if find_spec("matplotlib") is not None else ():
            files[folder / "charts" / f"{name}.{form}"] = draw(figure, form)
    for path, data in files.items():
        make_folder(path.parent)
        write_bytes(path, data)
    return list(files)
