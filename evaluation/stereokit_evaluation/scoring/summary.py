"""The summary of a scored run, in the JSON of every command: percent and pixels, pooled over images.

Values without ground truth are None (null).
"""

from __future__ import annotations

from typing import Any

from stereokit_evaluation.scoring.kitti import THRESHOLDS, Regions, Tally
from stereokit_evaluation.scoring.runner import Result

__all__ = ["d1", "summary"]


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
        ``skipped``.
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
            }
            for frame in result.frames
        ],
        "skipped": [{"frame": skip.name, "reason": skip.reason} for skip in result.skipped],
    }


def d1(regions: Regions, *, est: bool = False) -> dict[str, float | None]:
    """Return the D1 error of all, background and foreground pixels, percent; `est`: of measured ones only."""
    parts = {"all": regions.all, "bg": regions.bg, "fg": regions.fg}
    return {name: (part.measured if est else part.filled).d1() for name, part in parts.items()}


def _bad(tally: Tally) -> dict[str, float | None]:
    return {f"{x:g}": tally.bad_x(x) for x in THRESHOLDS}
