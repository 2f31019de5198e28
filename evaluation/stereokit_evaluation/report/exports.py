"""The files of a study for a paper: tables as CSV, LaTeX and Markdown, charts as CSV, SVG and PDF."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
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


def write_exports(document: Mapping[str, Any], folder: Path, before: Mapping[str, Any] | None = None) -> list[Path]:
    """Write the tables and charts of a study to the folders ``tables`` and ``charts``.

    Parameters
    ----------
    document : dict
        The study's JSON.
    folder : Path
        Created where it does not exist.
    before : dict, optional
        The JSON of the study that was there: its tables and charts that this one lacks are removed.

    Returns
    -------
    list of Path
        The files. SVG and PDF are left out where matplotlib is not installed.

    Raises
    ------
    FileError
        If a file cannot be written.
    """
    files: dict[str, bytes] = {}
    for name, table in study_tables(document).items():
        files[f"tables/{name}.csv"] = table.csv().encode()
        if not name.endswith(_LONG):
            files[f"tables/{name}.tex"] = table.latex().encode()
            files[f"tables/{name}.md"] = table.markdown().encode()
    for key, figure in figures(document).items():
        name = _chart_name(key)
        files[f"charts/{name}.csv"] = chart_table(figure).csv().encode()
        for form in ("svg", "pdf") if find_spec("matplotlib") is not None else ():
            files[f"charts/{name}.{form}"] = draw(figure, form)
    for place, data in files.items():
        make_folder((folder / place).parent)
        write_bytes(folder / place, data)
    for place in _file_names(before) - files.keys() if before is not None else ():
        with suppress(OSError):
            (folder / place).unlink()
    return [folder / place for place in files]


def _chart_name(key: str) -> str:
    return _NAMES.get(key, key.removeprefix("chart-").replace("-", "_"))


def _file_names(document: Mapping[str, Any]) -> set[str]:
    """Return the names of the files that a study may have written; of what is no study's JSON, none."""
    try:
        tables = {f"tables/{name}.{form}" for name in study_tables(document) for form in ("csv", "tex", "md")}
        names = {_chart_name(key) for key in figures(document)}
    except (KeyError, TypeError, ValueError, AttributeError, IndexError):
        return set()
    return tables | {f"charts/{name}.{form}" for name in names for form in ("csv", "svg", "pdf")}
