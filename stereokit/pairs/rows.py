"""How the rows of two views lie to each other, from points that both show.

The right view's rows are off by ``offset + roll * x + scale * y``, x and y from the middle of the image: what a camera
that looks up or down, is turned about its axis, or has another focal length does, to first order. The three come from
a consensus of random triples (RANSAC; Fischler and Bolles 1981), and least squares over those who agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereokit.pairs.features import Matches

__all__ = ["FEWEST", "Rows", "fit_rows"]

FEWEST = 12
"""Points that must agree, and be half of all, for rows to be known."""

_TRIES, _ROUNDS = 300, 5
_STEEPEST = 0.12  # pixels a pixel that roll and scale may be


@dataclass(frozen=True, eq=False)
class Rows:
    """How the right view's rows lie to the left view's.

    Attributes
    ----------
    offset : float
        How much lower the right view shows a point of the middle of the image, pixels.
    roll, scale : float
        How much this grows from pixel to pixel to the right, and downwards.
    share : float
        Of the points, those that agree.
    agreeing : (N,) bool
        Which do.
    spread : float
        Standard deviation of those from the fit, pixels.
    errors : (float, float, float)
        Standard errors of `offset`, `roll` and `scale`, which are large where the points lie close together.
    """

    offset: float
    roll: float
    scale: float
    share: float
    agreeing: NDArray[np.bool_]
    spread: float
    errors: tuple[float, float, float]

    @property
    def roll_degrees(self) -> float:
        """The roll as an angle: clockwise, as seen in the image, is positive."""
        return float(np.degrees(np.arctan(self.roll)))

    def worst(self, height: int, width: int) -> float:
        """Return the largest row offset within an image of this size, pixels."""
        return abs(self.offset) + abs(self.roll) * width / 2 + abs(self.scale) * height / 2


def fit_rows(matches: Matches, height: int, width: int, tolerance: float) -> Rows | None:
    """Return how the rows of two images lie to each other, None if too few points agree on it.

    Parameters
    ----------
    matches : Matches
    height, width : int
        Of the images, pixels.
    tolerance : float
        Pixels by which a point that agrees may be off.
    """
    count = len(matches.turns)
    if count < FEWEST:
        return None
    middle = (matches.left + matches.right) / 2 - ((width - 1) / 2, (height - 1) / 2)
    terms = np.column_stack([np.ones(count), middle])
    off = matches.right[:, 1] - matches.left[:, 1]
    triples = np.random.default_rng(0).integers(0, count, (_TRIES, 3))
    systems = terms[triples]
    regular = np.abs(np.linalg.det(systems)) > 1e-6 * height * width
    if not regular.any():
        return None
    models = np.linalg.solve(systems[regular], off[triples[regular]][:, :, None])[:, :, 0]
    models = models[np.abs(models[:, 1:]).max(axis=1) < _STEEPEST]
    if not len(models):
        return None
    votes = (np.abs(models @ terms.T - off) < tolerance).sum(axis=1)
    best = models[votes.argmax()]
    for _ in range(_ROUNDS):
        agreeing = np.abs(terms @ best - off) < tolerance
        if agreeing.sum() < 3:
            return None
        best = np.linalg.lstsq(terms[agreeing], off[agreeing], rcond=None)[0]
    error = off - terms @ best
    agreeing = np.abs(error) < tolerance
    if agreeing.sum() < FEWEST:
        return None
    offset, roll, scale = (float(value) for value in best)
    spread = float(error[agreeing].std())
    normal = terms[agreeing].T @ terms[agreeing]
    if np.linalg.cond(normal) > 1e12:  # all on a line
        return None
    errors = spread * np.sqrt(np.diag(np.linalg.inv(normal)))
    return Rows(offset, roll, scale, float(agreeing.mean()), agreeing, spread, (*map(float, errors),))  # type: ignore[arg-type]
