"""Points that both views show: SIFT features (Lowe 2004) that choose each other.

The images are stretched to 8 bits first, so that those of a dark scene have features too, and made smaller where that
saves time; positions are those of the images as they were given.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Matches", "Points", "match_points", "points_of", "stretched"]

_COUNT = 1000  # of the strongest features of an image
_CONTRAST = 0.02
_RATIO = 0.8  # of the distances to the nearest feature and to the next
_LEAST_SPAN = 8.0  # grey levels that are stretched to 256 at most


class Points(NamedTuple):
    """Features of one image.

    Attributes
    ----------
    places : (N, 2) float64
        x and y, pixels.
    angles : (N,) float64
        Degrees.
    words : (N, 128) float32
        What tells them apart.
    """

    places: NDArray[np.float64]
    angles: NDArray[np.float64]
    words: NDArray[np.float32]


class Matches(NamedTuple):
    """Features that two images have in common.

    Attributes
    ----------
    left, right : (N, 2) float64
        x and y in either image, pixels.
    turns : (N,) float64
        By how many degrees the right feature is turned, -180 to 180.
    """

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    turns: NDArray[np.float64]


def stretched(image: NDArray[Any], side: int) -> tuple[NDArray[np.uint8], float]:
    """Return a grey image in 8 bits from its first to its 99th percentile, and the factor by which it was shrunk.

    Parameters
    ----------
    image : (H, W) uint8 or uint16
    side : int
        The longest that a side may be, pixels.
    """
    height, width = image.shape
    factor = min(1.0, side / max(height, width))
    if factor < 1:
        size = max(1, round(width * factor)), max(1, round(height * factor))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)).reshape(size[1], size[0])
    low, high = np.percentile(image, (1, 99))
    levels = (image.astype(np.float32) - np.float32(low)) * np.float32(255 / max(high - low, _LEAST_SPAN))
    return np.clip(levels, 0, 255).astype(np.uint8), factor


def _sift(count: int, contrast: float) -> Any:
    return cv2.SIFT_create(count, contrastThreshold=contrast)  # type: ignore[attr-defined]


def points_of(image: NDArray[np.uint8], factor: float, usable: NDArray[np.bool_] | None = None) -> Points:
    """Return the features of an image that was shrunk by `factor`; none of pixels that are not `usable`."""
    mask = None if usable is None else usable.astype(np.uint8)
    keypoints, words = _sift(_COUNT, _CONTRAST).detectAndCompute(image, mask)
    if words is None:
        return Points(np.empty((0, 2)), np.empty(0), np.empty((0, 128), np.float32))
    places = (np.array([point.pt for point in keypoints]) + 0.5) / factor - 0.5
    return Points(places, np.array([point.angle for point in keypoints]), words)


def match_points(left: Points, right: Points) -> Matches:
    """Return the features that choose each other, and none other nearly as well."""
    if min(len(left.words), len(right.words)) < 2:
        none = np.empty((0, 2))
        return Matches(none, none, np.empty(0))
    squares = [(points.words * points.words).sum(axis=1) for points in (left, right)]
    distance = squares[0][:, None] + squares[1][None, :] - 2 * (left.words @ right.words.T)
    mine = np.arange(len(distance))
    theirs = distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[theirs] == mine
    best = distance[mine, theirs]
    distance[mine, theirs] = np.inf
    mutual &= best < _RATIO**2 * distance.min(axis=1)
    mine, theirs = mine[mutual], theirs[mutual]
    turns = (right.angles[theirs] - left.angles[mine] + 180) % 360 - 180
    return Matches(left.places[mine], right.places[theirs], turns)
