"""Error of the general refiner over pairs of many kinds, from half-size maps that are matched once.

Figures are those of its model card: D1, bad-1, bad-2 and EPE, pooled over the pairs of a set, of the pixels that both
cameras see where that is known. The geometric mean of all of them against those of S2 at full size is one number for
weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stereokit
from stereokit.errors import InputError
from stereokit.kernels.workspace import Workspace
from stereokit.notices import collecting
from stereokit.result import Disparity
from stereokit_evaluation.data.datasets import load_frames
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.kitti import fill_background, outliers
from stereokit_refiners.networks.evidence import Evidence
from stereokit_refiners.runtimes.evidence import hypotheses
from stereokit_refiners.runtimes.features import network_input
from stereokit_refiners.runtimes.mixture import mixture
from stereokit_refiners.runtimes.torch import runner
from stereokit_refiners.weights import WeightFile

__all__ = ["FIGURES", "SETS", "RealPair", "geometric_mean", "matched_pairs", "pooled", "refined", "scores"]

SETS = {
    "kitti2015": "kitti2015", "kitti2012": "kitti2012", "middlebury": "middlebury", "eth3d": "eth3d",
    "satellite": "folder", "rendered": "folder",
}  # fmt: skip
"""Folders of the data, and the layouts of these."""
FIGURES = ("d1", "bad-1", "bad-2", "epe")
"""Percent, and the last one pixels."""

_METHOD = "S2"

Figures = dict[str, dict[str, float]]
"""By set and figure."""


@dataclass(frozen=True, eq=False)
class RealPair:
    """A pair, its truth and its half-size map.

    Attributes
    ----------
    name : str
        Of the set.
    left, right : (H, W) uint8
    truth : (H, W) float32
        Pixels; NaN unknown.
    coarse : Disparity
        With candidates and confidence.
    bounds : (float, float)
        What the refined map is held to.
    full, linear : (4,) float64
        Errors of S2 at full size and at half size, upscaled linearly: outliers, those by over 1 and by over 2 pixels,
        sum of errors.
    """

    name: str
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    truth: NDArray[np.float32]
    coarse: Disparity
    bounds: tuple[float, float]
    full: NDArray[np.float64]
    linear: NDArray[np.float64]


class _Keeper:
    """A refiner that keeps what it is told of a pair."""

    needs_candidates = needs_confidence = needs_right = any_scale = True

    def __call__(self, coarse: Disparity, left: NDArray[Any], **options: Any) -> Disparity:
        self.coarse = coarse
        return Disparity(np.zeros(left.shape, np.float32), np.ones(left.shape, np.bool_))


def matched_pairs(data: Path) -> Iterator[RealPair]:
    """Match all pairs of `SETS` below a folder, at half size and at full size.

    Of KITTI 2015 those count that have truth of what both cameras see, and those of Middlebury 2003 are left out, as in
    the model card.

    Raises
    ------
    FileError
        If a set is not there, or a file of it cannot be read.
    """
    for name, layout in SETS.items():
        for frame in load_frames(layout, data / name):
            if frame.name.startswith("2003/") or (layout == "kitti2015" and frame.noc is None):
                continue
            with collecting():
                yield _matched(name, frame)


def _matched(name: str, frame: Frame) -> RealPair:
    truth = frame.load_noc()
    truth = frame.load_occ() if truth is None else truth
    if truth is None:
        raise InputError(f"frame {frame.name} has no ground truth")
    left, right = frame.load_pair(gray=True)
    farthest = frame.max_disparity or float(np.nanmax(np.where(np.isfinite(truth), truth, np.nan))) + 8
    levels = int(np.ceil(farthest / 32) * 32)
    keeper = _Keeper()
    matcher = stereokit.Matcher(_METHOD, max_disparity=levels, scale=0.5, refiner=keeper, threads=1, device="cpu")
    matcher(left, right)
    assert matcher.settings.bounds is not None
    maps = [
        stereokit.Matcher(_METHOD, max_disparity=levels, scale=scale, threads=1, device="cpu")(left, right).disparity
        for scale in (1.0, 0.5)
    ]
    full, linear = (_errors(estimate, truth) for estimate in maps)
    return RealPair(name, left, right, truth, keeper.coarse, matcher.settings.bounds, full, linear)


def _errors(estimate: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the sums that the figures are of."""
    known = np.isfinite(truth)
    error = np.abs(fill_background(estimate) - truth)[known]
    counts = (np.count_nonzero(bad) for bad in (outliers(error, truth[known]), error > 1, error > 2))
    return np.array([*counts, error.sum(dtype=np.float64)], np.float64)


def pooled(pairs: Sequence[RealPair], errors: Sequence[NDArray[np.float64]]) -> Figures:
    """Return the figures of maps by set, of their errors."""
    figures: Figures = {}
    for name in dict.fromkeys(pair.name for pair in pairs):
        total = sum(sums for pair, sums in zip(pairs, errors, strict=True) if pair.name == name)
        pixels = sum(np.count_nonzero(np.isfinite(pair.truth)) for pair in pairs if pair.name == name)
        values = np.asarray(total) * (100, 100, 100, 1) / pixels
        figures[name] = {figure: round(float(value), 5) for figure, value in zip(FIGURES, values, strict=True)}
    return figures


def refined(
    content: WeightFile, pair: RealPair, encoder: Callable[..., NDArray[np.int8]] = network_input,
) -> NDArray[np.float32]:  # fmt: skip
    """Return the map of a pair that weights make of the half-size map, in fp32: (H, W) float32, pixels.

    Parameters
    ----------
    content : WeightFile
    pair : RealPair
    encoder : callable
        Makes the network's input, as `stereokit_refiners.runtimes.features.network_input` does.
    """
    run = runner(Evidence(), content.arrays)
    return _refined(run, pair, encoder, Workspace())


def _refined(
    run: Callable[..., Any], pair: RealPair, encoder: Callable[..., NDArray[np.int8]], workspace: Workspace
) -> NDArray[np.float32]:
    candidates, confidence = pair.coarse.candidates, pair.coarse.confidence
    assert candidates is not None
    assert confidence is not None
    rows, columns = pair.left.shape
    values = hypotheses(pair.coarse.disparity, candidates, pair.left, pair.right, 2, 1, workspace)
    inputs = {"evidence": encoder(values, confidence, pair.left, columns, 1, workspace)}
    full: NDArray[np.float32] = run(inputs, lambda head: mixture(head, values, rows, columns))[0]
    return np.asarray(np.clip(full, *(np.float32(bound) for bound in pair.bounds)))


def scores(
    content: WeightFile, pairs: Sequence[RealPair], encoder: Callable[..., NDArray[np.int8]] = network_input
) -> Figures:
    """Return the figures of weights by set; arguments are as for `refined`."""
    run, workspace = runner(Evidence(), content.arrays), Workspace()
    return pooled(pairs, [_errors(_refined(run, pair, encoder, workspace), pair.truth) for pair in pairs])


def geometric_mean(figures: Figures, reference: Figures) -> float:
    """Return the geometric mean of figures against others."""
    quotients = [value / reference[name][figure] for name, row in figures.items() for figure, value in row.items()]
    return math.prod(quotients) ** (1 / len(quotients))
