"""Other pairs made of a pair with ground truth: mirrored, with its objects moved, at another size and exposure.

Everything happens before matching, so that the matcher's mistakes on the new pair are its real ones. What a refiner has
to learn is where objects end; ground truth of a few dozen frames shows few objects, so they are shown in new places.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Views", "copy_paste", "mirrored", "photographed", "rescaled"]

_DENSE = 0.85  # share of known pixels around a pixel of an object: KITTI's cars are dense, all else is scanned lines
_SMALLEST, _LARGEST = 1500, 60000  # pixels of an object


@dataclass(frozen=True, eq=False)
class Views:
    """A pair on its way: images (H, W) uint8 and truths (H, W) float32 in pixels, NaN unknown."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    noc: NDArray[np.float32]
    occ: NDArray[np.float32]


def mirrored(views: Views) -> Views:
    """Return the pair as a camera behind a mirror sees it: the right view becomes the left one.

    Its truth is what both cameras see, carried over to the right view; where two pixels meet, the nearer one counts.
    """
    height, width = views.noc.shape
    truth = np.full((height, width), -np.inf, np.float32)
    y, x = np.nonzero(np.isfinite(views.noc))
    d = views.noc[y, x]
    there = np.rint(x - d).astype(np.int64)
    inside = (there >= 0) & (there < width)
    np.maximum.at(truth, (y[inside], there[inside]), d[inside])
    before, crack, after = truth[:, :-2], truth[:, 1:-1], truth[:, 2:]  # where a surface is seen wider from the right
    with np.errstate(invalid="ignore"):
        crack[np.isinf(crack) & (np.abs(before - after) < 1.5)] = np.nan
    opened = np.isnan(truth)
    truth[opened] = (0.5 * (np.roll(truth, 1, axis=1) + np.roll(truth, -1, axis=1)))[opened]
    flipped = np.ascontiguousarray(np.where(np.isfinite(truth), truth, np.float32(np.nan))[:, ::-1])
    left, right = (np.ascontiguousarray(image[:, ::-1]) for image in (views.right, views.left))
    return Views(left, right, flipped, flipped)


def copy_paste(rng: np.random.Generator, views: Views, most: int = 3) -> Views:
    """Return the pair with up to `most` copies of its own objects, moved along their rows.

    Objects are what has dense ground truth in a map that is sparse elsewhere, as the cars of KITTI 2015. On the same
    rows a copy stands on the same ground. It is left out where it would hide something nearer.
    """
    if np.mean(np.isfinite(views.noc)) > 0.6:  # dense all over: objects do not stand out
        return views
    objects = _objects(views)
    for _ in range(int(rng.integers(0, most + 1)) if objects else 0):
        views = _pasted(rng, views, *objects[int(rng.integers(len(objects)))])
    return views


def _objects(views: Views) -> list[tuple[Views, NDArray[np.bool_], NDArray[np.float32]]]:
    """Return every object, seen both ways: the pair it is of, its pixels in the left view, its disparity there."""
    objects = []
    for origin in (views, mirrored(views)):
        known = np.isfinite(origin.noc)
        around = cv2.boxFilter(known.astype(np.float32), -1, (7, 7), borderType=cv2.BORDER_REPLICATE)
        core = cv2.morphologyEx((around > _DENSE).astype(np.uint8), cv2.MORPH_OPEN, np.ones((7, 7), np.uint8))
        count, label, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=4)
        for k in range(1, count):
            if not _SMALLEST <= stats[k, cv2.CC_STAT_AREA] <= _LARGEST:
                continue
            near = cv2.dilate((label == k).astype(np.uint8), np.ones((9, 9), np.uint8))
            disparity = np.where(known & (near > 0), origin.noc, np.float32(np.nan))
            middle = float(np.nanmedian(disparity))
            with np.errstate(invalid="ignore"):
                own = np.abs(disparity - middle) < 0.35 * middle
            mask = cv2.morphologyEx(own.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)) > 0
            objects.append((origin, mask, np.where(own, disparity, np.float32(np.nan)).astype(np.float32)))
    return objects


def _pasted(
    rng: np.random.Generator, views: Views, origin: Views, mask: NDArray[np.bool_], disparity: NDArray[np.float32]
) -> Views:
    height, width = mask.shape
    y, x = np.nonzero(mask)
    shift = int(rng.integers(-int(x.min()) - (int(np.ptp(x)) // 2), width - int(x.max()) + int(np.ptp(x)) // 2))
    inside = (x + shift >= 0) & (x + shift < width)
    y, x = y[inside], x[inside]
    d = disparity[y, x]
    nearest = float(np.nanmedian(disparity))
    with np.errstate(invalid="ignore"):
        hidden = views.noc[y, x + shift] > np.where(np.isnan(d), nearest, d) + 1
    if not len(y) or np.mean(hidden) > 0.02:
        return views
    there: NDArray[Any] = np.zeros((height, width), np.uint8)  # the object in the right view, where it comes from
    own = ~np.isnan(d)
    columns = np.rint(x[own] - d[own]).astype(np.int64)
    seen = (columns >= 0) & (columns < width)
    there[y[own][seen], columns[seen]] = 1
    there = cv2.morphologyEx(there, cv2.MORPH_CLOSE, np.ones((3, 5), np.uint8))
    yr, xr = np.nonzero(there)
    fits = (xr + shift >= 0) & (xr + shift < width)
    yr, xr = yr[fits], xr[fits]
    left, right, noc, occ = (a.copy() for a in (views.left, views.right, views.noc, views.occ))
    covers = np.zeros((height, width), np.bool_)
    covers[yr, xr + shift] = True
    ys, xs = np.nonzero(np.isfinite(noc))
    behind = np.rint(xs - noc[ys, xs]).astype(np.int64)
    lost = (behind >= 0) & covers[ys, np.clip(behind, 0, width - 1)]
    if np.count_nonzero(noc[ys[lost], xs[lost]] > nearest + 1) > 0.02 * len(y):  # beside it here, behind it there
        return views
    noc[ys[lost], xs[lost]] = np.nan
    left[y, x + shift] = origin.left[y, x]
    right[yr, xr + shift] = origin.right[yr, xr]
    noc[y, x + shift] = np.where(x + shift - d >= 0, d, np.float32(np.nan))
    occ[y, x + shift] = d
    return Views(left, right, noc, occ)


def rescaled(rng: np.random.Generator, views: Views) -> Views:
    """Return the pair at a random size; the truth's disparities follow the width."""
    across = float(np.exp(rng.normal(0, 0.18)))
    down = float(np.clip(across * np.exp(rng.normal(0, 0.1)), 0.6, 1.6))
    across = float(np.clip(across, 0.6, 1.6))
    rows, columns = views.left.shape
    size = (max(64, round(columns * across)), max(64, round(rows * down)))
    how = cv2.INTER_AREA if across < 1 and down < 1 else cv2.INTER_LINEAR
    factor = np.float32(size[0] / columns)

    def image(view: NDArray[np.uint8]) -> NDArray[Any]:
        return np.asarray(cv2.resize(view, size, interpolation=how))

    def truth(known: NDArray[np.float32]) -> NDArray[Any]:
        return np.asarray(cv2.resize(known, size, interpolation=cv2.INTER_NEAREST_EXACT) * factor)

    return Views(image(views.left), image(views.right), truth(views.noc), truth(views.occ))


def photographed(rng: np.random.Generator, views: Views) -> Views:
    """Return both views under another exposure, slightly different between them, with noise."""
    gamma, gain = float(np.exp(rng.normal(0, 0.15))), float(np.exp(rng.normal(0, 0.12)))
    noise = float(rng.exponential(1.0))
    shot = []
    for view in (views.left, views.right):
        own_gain, offset = float(np.exp(rng.normal(0, 0.02))), float(rng.normal(0, 1.5))
        curve = 255 * (np.arange(256) / 255) ** gamma * gain * own_gain + offset
        values = curve.astype(np.float32)[view] + np.float32(noise) * rng.standard_normal(view.shape, np.float32)
        shot.append(np.clip(np.rint(values), 0, 255).astype(np.uint8))
    return Views(shot[0], shot[1], views.noc, views.occ)
