"""Reports as HTML that needs no network: charts, tables that sort, and a viewer of disparity maps.

A report is one file. Where its maps would make that large, they lie in a folder beside it
(`stereokit_evaluation.report.tiles`) and are read when they are looked at.

Charts are drawn by Plotly, whose script comes with its Python package and is embedded compressed; the page undoes
that itself. Template, style and scripts lie in ``assets``.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from stereokit.errors import StereokitError
from stereokit.io import write_bytes
from stereokit.notices import collecting
from stereokit_evaluation.bench.stages import GROUPS, OTHER, TOTAL
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.data import published
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.report import charts as _charts
from stereokit_evaluation.report import viewer
from stereokit_evaluation.report.disturbance_charts import FIGURE_TITLES
from stereokit_evaluation.report.measures import COLUMNS, by_data_set, measure_rows
from stereokit_evaluation.report.per_pair import per_pair
from stereokit_evaluation.report.tiles import TileFolder, json_text
from stereokit_evaluation.scoring.runner import Scored
from stereokit_evaluation.study.run import Study, StudyRow
from stereokit_evaluation.study.table import missing_lines

__all__ = ["chosen_frames", "rate", "render", "require", "write_report"]

_SCRIPTS = ("maps.js", "cloud.js", "viewer.js", "pairs.js", "page.js")
_LARGE = 50e6  # pixels of maps, some 35 MB, beyond which a folder takes them


def write_report(path: Path, document: dict[str, Any], study: Study, frames: Sequence[Frame], show: int) -> int:
    """Write the report of a study and return its size in bytes.

    Parameters
    ----------
    path : Path
        An HTML file; the folder ``NAME_files`` beside it takes the maps where they are many.
    document : dict
        The study's JSON.
    study : Study
        Its rows; their matchers compute the maps of the viewer.
    frames : sequence of Frame
        Those that were scored.
    show : int
        Number of frames in the viewer, spread from the easiest to the hardest.

    Raises
    ------
    FileError
        If the file cannot be written.
    StereokitError
        If jinja2 or plotly is not installed.
    """
    rows, kitti = document["results"], _charts.kitti_part(document)
    title = f"{document['dataset']}{', ' + document['split'] if document['split'] else ''}"
    chosen = chosen_frames(frames, study.rows, show)
    tiles = TileFolder(path) if _pixels(chosen, study.rows) > _LARGE else None
    pairs = []
    with progress(len(chosen)) as (_, step):
        for frame in chosen:
            pair = _viewer_pair(frame, study.rows)
            pairs.append(pair if tiles is None else tiles.add(pair))
            step(f"report: {frame.name}")
    page = render(
        "study.html.j2",
        pairs,
        charts=_charts.figures(document),
        title=f"Robustness study: {title}",
        document=document,
        rows=rows,
        measures=measure_rows(document),
        measure_columns=COLUMNS,
        data_sets=by_data_set(document),
        per_pair=per_pair(rows, [frame.name for frame in chosen], digits=3),
        methods=_first_methods(study.rows),
        regions=_charts.REGIONS,
        region=_charts.first_region(rows),
        disturbances=document.get("disturbances") or {},
        fault_figures=FIGURE_TITLES,
        stages=(TOTAL, *GROUPS, OTHER),
        missing=missing_lines(study.rows),
        published=published,
        kitti=kitti,
        beside=kitti is not None and len(document["data"]) == 1,
    )
    write_bytes(path, page)
    return len(page) + (0 if tiles is None else tiles.bytes)


def render(
    template: str, pairs: Sequence[dict[str, Any]], *, charts: dict[str, Any] | None = None, **content: Any
) -> bytes:
    """Return a page.

    Parameters
    ----------
    template : str
        A file of ``assets``.
    pairs : sequence of dict
        Results of `stereokit_evaluation.report.viewer.pair`, for the viewer, or of `TileFolder.add`.
    charts : dict, optional
        Plotly figures by the id of the element that they go to; without them the page has no Plotly.
    **content
        The variables of the template.

    Raises
    ------
    StereokitError
        If jinja2 or plotly is not installed.
    """
    jinja2 = require("jinja2")
    markup = require("markupsafe").Markup
    folder = files("stereokit_evaluation.report") / "assets"
    names = (*_SCRIPTS, *(("charts.js",) if charts else ()))
    texts = {name: (folder / name).read_text(encoding="utf-8") for name in (*names, "style.css")}
    loader = jinja2.FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8"))
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["json"] = lambda value: markup(json_text(value))
    environment.filters["figure"] = lambda value, digits=2: "\u2013" if value is None else f"{value:.{digits}f}"
    environment.filters["rate"] = rate
    environment.globals["row_name"] = _charts.row_name
    text: str = environment.get_template(template).render(
        pairs=pairs,
        constants=viewer.constants(),
        charts=charts or {},
        plotly=_plotly() if charts else "",
        style=texts.pop("style.css"),
        scripts=[texts[name] for name in names],
        **content,
    )
    return text.encode()


def rate(value: float) -> str:
    """Return frames a second with two significant digits below ten, so that a slow method does not stand as 0."""
    return f"{value:.0f}" if value >= 10 else f"{float(f'{value:.2g}'):g}"


def chosen_frames(frames: Sequence[Frame], rows: Sequence[StudyRow], show: int) -> list[Frame]:
    """Return `show` of the frames, evenly spaced in difficulty from the easiest to the hardest.

    Difficulty is the D1 error pooled over all our rows.
    """
    outliers: dict[str, list[int]] = {}
    for row in rows:
        for scored in row.result.frames:
            counts = scored.score.main.filled
            total = outliers.setdefault(scored.name, [0, 0])
            total[0] += counts.outliers
            total[1] += counts.pixels
    ranked = sorted(frames, key=lambda frame: _share(outliers.get(frame.name, [0, 0])))
    if show >= len(ranked):
        return ranked
    places = np.linspace(0, len(ranked) - 1, show) if show > 1 else [len(ranked) // 2][:show]
    return [ranked[round(float(place))] for place in places]


def _first_methods(rows: Sequence[StudyRow]) -> list[str]:
    """Return the first two methods of the viewer: the best by D1, against one of the same matcher."""
    scored = [row for row in rows if row.missing is None and row.result.frames]
    best = min(scored, key=lambda row: row.result.score.main.filled.d1() or 0.0)
    others = sorted((row for row in scored if row is not best), key=lambda row: _label(row) != _label(best))
    return [row.configuration.name for row in (best, *others, best)[:2]]


def _label(row: StudyRow) -> str:
    return row.configuration.label


def _share(counts: Sequence[int]) -> float:
    return counts[0] / counts[1] if counts[1] else 0.0


def _viewer_pair(frame: Frame, rows: Sequence[StudyRow]) -> dict[str, Any]:
    """Match a frame once more with every configuration, for the viewer."""
    maps = []
    for row in rows:
        scored = next((candidate for candidate in row.result.frames if candidate.name == frame.name), None)
        if row.configuration.can_match and scored is not None:
            with collecting():  # reported when it was scored
                result = row.configuration.match_frame(frame)
            disparity, valid = np.asarray(result.disparity), np.asarray(result.valid)
            maps.append(viewer.MethodMap(row.configuration.name, disparity, valid, _note(scored)))
    return viewer.pair(
        frame.name,
        frame.load_left(),
        maps,
        right=frame.load_right(),
        noc=frame.load_noc(),
        occ=frame.load_occ(),
        calibration=frame.load_calibration(),
    )


def _note(scored: Scored) -> str:
    """Return a map's error, with the pixels that it counts, and its density."""
    noc, occ = scored.score.noc.all, scored.score.occ.all
    name, counts = ("D1 noc", noc) if noc.filled.pixels else ("D1 all", occ)
    d1, density = counts.filled.d1(), counts.density()
    return "" if d1 is None or density is None else f"{name} {d1:.2f} %, density {density:.0f} %"


def _pixels(frames: Sequence[Frame], rows: Sequence[StudyRow]) -> int:
    """Return how many pixels of maps the viewer shows, taking all frames for as large as the first."""
    maps = sum(row.configuration.can_match and row.missing is None for row in rows)
    size = int(np.prod(frames[0].load_left().shape[:2])) if frames else 0
    return len(frames) * maps * size


@lru_cache(maxsize=1)
def _plotly() -> str:
    script: str = require("plotly.offline").get_plotlyjs()
    return base64.b64encode(gzip.compress(script.encode(), 9, mtime=0)).decode()


def require(module: str) -> Any:
    """Import a package of the extra ``report``, or raise StereokitError with the way to get it."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise StereokitError(f'a report needs {module.partition(".")[0]}: pip install "stereokit[report]"') from error
