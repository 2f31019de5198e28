"""The summary of a scored run, in the JSON of every command: percent and pixels, pooled over images.

Values without ground truth are None (null).
"""

from __future__ import annotations

from typing import Any

from stereokit_evaluation.scoring.kitti import THRESHOLDS, Regions, Tally
from stereokit_evaluation.scoring.measures import NEAR, SETS, Errors
from stereokit_evaluation.scoring.runner import Result, Scored

__all__ = ["d1", "pixels_line", "summary"]


def summary(result: Result) -> dict[str, Any]:
    """Return the scores of a run.

    Parameters
    ----------
    result : Result

    Returns
    -------
    dict
        ``images``, ``d1`` (percent, by region), ``epe`` (pixels), ``density`` (percent), ``seconds_per_image``,
        ``bad`` (percent, by threshold), ``est`` (the same over measured pixels only), ``pixels``, ``frames`` and
        ``skipped``; ``figures``, all of `stereokit_evaluation.scoring.measures.FIGURES` by set of pixels; and
        ``errors_in``, the percentage of all D1 errors that lie in occlusions and near edges.
    """
    pooled = result.score
    return {
        "images": len(result.frames),
        "d1": {"noc": d1(pooled.noc), "occ": d1(pooled.occ)},
        "epe": pooled.main.filled.epe(),
        "density": pooled.main.density(),
        "seconds_per_image": result.seconds_per_image,
        "bad": {"noc": _bad(pooled.noc.all.filled), "occ": _bad(pooled.occ.all.filled)},
        "est": {
            "d1": {"noc": d1(pooled.noc, est=True), "occ": d1(pooled.occ, est=True)},
            "bad": {"noc": _bad(pooled.noc.all.measured), "occ": _bad(pooled.occ.all.measured)},
            "epe": pooled.main.measured.epe(),
        },
        "pixels": {"noc": pooled.noc.all.filled.pixels, "occ": pooled.occ.all.filled.pixels},
        "frames": [
            {
                "name": frame.name,
                "d1": {"noc": frame.score.noc.all.filled.d1(), "occ": frame.score.occ.all.filled.d1()},
                "epe": frame.score.main.filled.epe(),
                "seconds": frame.seconds,
                "scene": _scene(frame),
                "pixels": frame.measures.main.pixels,
                "figures": frame.measures.main.figures(),
                "d1_occluded": frame.measures.occluded.figure("d1"),
                "d1_edges": frame.measures.edges.figure("d1"),
            }
            for frame in result.frames
        ],
        "skipped": [{"frame": skip.name, "reason": skip.reason} for skip in result.skipped],
        "figures": {name: getattr(result.measures, name).figures() for name in SETS},
        "errors_in": _errors_in(result),
    }


def pixels_line(result: Result) -> str:
    """Return a line that says which pixels the figures count."""
    measures = result.measures
    pairs, seen = measures.main.pairs, measures.noc.pairs
    rest = pairs - seen
    where = "seen by both cameras" if not rest else "all with truth, as no mask says which both cameras see"
    if rest and seen:
        where = f"seen by both cameras in {seen} of them, all with truth, occluded ones too, in the other"
        where += "" if rest == 1 else f" {rest}"
    return (
        f"Figures count {measures.main.pixels:,} pixels of {pairs} pair{'' if pairs == 1 else 's'} ({where}) on maps "
        f"filled as by KITTI; A90, A95: means of the pairs' quantiles; occluded: {measures.occluded.pixels:,} pixels; "
        f"edges: {measures.edges.pixels:,} pixels up to {NEAR} px from a jump of the truth."
    )


def _errors_in(result: Result) -> dict[str, float | None]:
    """Return the shares of errors that lie in occlusions, of those of all pixels, and near edges, of the main ones."""

    def share(part: Errors, whole: int) -> float | None:
        return 100.0 * part.outliers / whole if part.pixels and whole else None

    both = [frame.measures for frame in result.frames if frame.measures.occluded.pixels]
    return {
        "occluded": share(result.measures.occluded, sum(measures.all.outliers for measures in both)),
        "edges": share(result.measures.edges, result.measures.main.outliers),
    }


def _scene(frame: Scored) -> str:
    return frame.name if frame.scene is None else frame.scene


def d1(regions: Regions, *, est: bool = False) -> dict[str, float | None]:
    """Return the D1 error of all, background and foreground pixels, percent; `est`: of measured ones only."""
    parts = {"all": regions.all, "bg": regions.bg, "fg": regions.fg}
    return {name: (part.measured if est else part.filled).d1() for name, part in parts.items()}


def _bad(tally: Tally) -> dict[str, float | None]:
    return {f"{x:g}": tally.bad_x(x) for x in THRESHOLDS}
