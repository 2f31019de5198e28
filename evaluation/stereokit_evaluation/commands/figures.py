"""The command ``stereokit figures``: tables and charts of a study, as files for a paper."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from stereokit.cli.options import JsonOption, check_json, write_json
from stereokit.errors import FileError
from stereokit.io import parsing, read_json
from stereokit_evaluation.common.folders import check_folder
from stereokit_evaluation.report.exports import write_exports

__all__ = ["figures"]


def figures(
    study: Annotated[Path, typer.Argument(metavar="STUDY", help="Folder of a study, or its JSON.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder to write to; default: the study's.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Write the tables of a study (CSV, LaTeX, Markdown) and its charts (CSV, SVG, PDF).

    A study writes them itself; this makes them again, from its JSON alone.
    """
    check_json(json_file)
    path = study / "study.json" if study.is_dir() else study
    folder = path.parent if output is None else output
    check_folder(folder)
    document = read_json(path, "study")
    if not isinstance(document, dict) or not {"results", "dataset", "frames", "machine"} <= document.keys():
        raise FileError(f"{str(path)!r} is not the JSON of a study")
    with parsing(path, "study"):
        written = write_exports(document, folder)
    report = {"study": str(path), "files": [str(file) for file in written]}
    if not write_json(json_file, report):
        hint = "" if find_spec("matplotlib") else '; no SVG and PDF: pip install "stereokit[figures]"'
        typer.echo(f"{len(written)} files in {folder / 'tables'} and {folder / 'charts'}{hint}")
