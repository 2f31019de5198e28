"""All of post-processing in place, for `stereokit.Matcher`: the public functions in bands, without copies.

Single matching phase, then speckles, then filling, then the median. Work within a row or a band is done for a
band by one thread while the band is in its cache; threads wait for each other only where regions cross from band to
band and before the median, which looks over a band's edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.threads import run_stages, spans
from stereokit.kernels.workspace import Workspace
from stereokit.postprocess.fill import fill_empty_rows, fill_rows
from stereokit.postprocess.median import median_rows
from stereokit.postprocess.smp import resolve_rows
from stereokit.postprocess.speckle import erase, find_regions, join_rows, region_buffers

__all__ = ["PostProcessing", "post_process"]


@dataclass(frozen=True)
class PostProcessing:
    """Options of the post-processing, checked by `stereokit.settings.MatchSettings`.

    Attributes
    ----------
    smp : bool
        Single matching phase.
    speckle : int
        Largest region that is removed, pixels.
    fill : {"background", "nearest"} or None
        Rule of filling.
    median : {0, 3, 5}
        Side of the window.
    empty_value : float
        Disparity of a filled map in which no pixel was valid.
    """

    smp: bool
    speckle: int
    fill: str | None
    median: int
    empty_value: float


def post_process(
    disparity: NDArray[np.float32], cost: NDArray[Any], bad: NDArray[np.bool_] | None, steps: PostProcessing,
    workspace: Workspace, threads: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:  # fmt: skip
    """Return the finished map and the mask of its measured pixels, both new.

    Parameters
    ----------
    disparity : (H, W) float32, pixels, NaN where invalid
        As selected; overwritten.
    cost : (H, W)
        Aggregated cost of each pixel's match.
    bad : (H, W) bool or None
        Pixels without evidence.
    steps : PostProcessing
        Options.
    workspace : Workspace
        Buffers.
    threads : int
        Threads to use; the result does not depend on it.
    """
    height, width = disparity.shape
    parts = spans(height, threads)
    flat = disparity.reshape(-1)
    valid = np.empty(disparity.shape, np.bool_)
    scratch = workspace.array("smp.scratch", (len(parts), 2 * width + 2), np.int32)
    lowest = workspace.array("smp.lowest", (len(parts), width + 1), cost.dtype)
    is_loser = workspace.array("smp.is_loser", (len(parts), width + 1), np.uint8)
    regions = region_buffers((height, width) if steps.speckle else (0, 0), len(parts), workspace)
    limit = np.float32(1)
    out = np.empty_like(disparity)
    incomplete: list[int] = []  # bands with rows that have no pixel to be filled from

    def match(k: int, y0: int, y1: int) -> None:
        if bad is not None:
            disparity[y0:y1][bad[y0:y1]] = np.nan
        if steps.smp:
            resolve_rows(disparity, cost, y0, y1, scratch[k], lowest[k], is_loser[k])
        if steps.speckle:
            find_regions(flat, width, k, y0, y1, limit, regions)

    def join() -> None:
        for y0, _ in parts[1:]:
            join_rows(flat, width, y0, limit, regions)

    def clean(y0: int, y1: int) -> None:
        if steps.speckle:
            erase(flat, y0 * width, y1 * width, steps.speckle, regions)
        np.equal(disparity[y0:y1], disparity[y0:y1], out=valid[y0:y1])  # NaN is not
        if steps.fill is not None and fill_rows(disparity, y0, y1, steps.fill == "nearest"):
            incomplete.append(y0)

    def smooth_rows(k: int, y0: int, y1: int) -> None:
        if incomplete:
            return
        if steps.median:
            median_rows(disparity, steps.median, y0, y1, out, workspace, steps.fill is not None, k)
        else:
            out[y0:y1] = disparity[y0:y1]

    stages: list[list[Any]] = [[partial(match, k, y0, y1) for k, (y0, y1) in enumerate(parts)]]
    if steps.speckle and len(parts) > 1:
        stages.append([join])
    stages.append([partial(clean, y0, y1) for y0, y1 in parts])
    stages.append([partial(smooth_rows, k, y0, y1) for k, (y0, y1) in enumerate(parts)])
    run_stages(stages, threads)
    if incomplete:  # rare: rows without any valid pixel take those of others
        incomplete.clear()
        if not fill_empty_rows(disparity):
            disparity[:] = steps.empty_value
        run_stages(stages[-1:], threads)
    return out, valid
