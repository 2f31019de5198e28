"""Calibration boards, and their corners in images.

A chessboard is found by ``cv2.findChessboardCornersSB`` (Duda and Frese, Accurate detection and localization of
checkerboard corners for calibration, 2018) or ``cv2.findChessboardCorners``, a ChArUco board by
``cv2.aruco.CharucoDetector`` (Garrido-Jurado and others 2014), of which any part may be hidden.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError, did_you_mean, shown
from stereokit.images.check import check_integer

__all__ = ["Board", "Corners", "parse_length"]

_LEAST_CORNERS = 8
_METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}


def parse_length(name: str, text: str) -> float:
    """Return a length such as ``25mm``, ``2.5cm`` or ``1in`` in metres.

    Parameters
    ----------
    name : str
        Of the argument, for messages.
    text : str

    Raises
    ------
    OptionError
        If it has no number or no unit.
    """
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*(mm|cm|m|in)\s*", text)
    if match is None or not float(match[1]) > 0:
        raise OptionError(f"{name} must be a length with its unit, such as 25mm, 2.5cm or 1in, got {shown(text)}")
    return float(match[1]) * _METRES[match[2]]


@dataclass(frozen=True)
class Corners:
    """The corners of a board that one image shows.

    Attributes
    ----------
    ids : (n,) int
        Places in `Board.points`.
    pixels : (n, 2) float64
    """

    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]


@dataclass(frozen=True)
class Board:
    """A flat board with squares.

    Parameters
    ----------
    columns, rows : int
        Of a chessboard the inner corners, where four squares meet: 9 x 6 of a board of 10 x 7 squares. Of a ChArUco
        board the squares. Both as OpenCV counts them.
    square_m : float
        Side of a square, metres.
    marker_m : float or None
        Side of a marker of a ChArUco board, metres; None is a chessboard.
    dictionary : str
        Of a ChArUco board, one of OpenCV's names, such as ``"4X4_50"``.

    Raises
    ------
    OptionError
        If a number is outside its rule, or there is no such dictionary.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            check_integer(name, getattr(self, name), 3, 100)
        if not 0 < self.square_m < 100:
            raise OptionError(f"square_m must be a length in metres, got {shown(self.square_m)}")
        if self.marker_m is not None:
            if not 0 < self.marker_m < self.square_m:
                raise OptionError(
                    f"marker_m must be smaller than a square of {self.square_m:g} m, got {shown(self.marker_m)}"
                )
            _dictionary(self.dictionary)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """The corners on the board, (n, 3) float64, metres."""
        columns, rows = (self.columns, self.rows) if self.marker_m is None else (self.columns - 1, self.rows - 1)
        first = 0 if self.marker_m is None else 1
        grid = np.mgrid[first : first + columns, first : first + rows].T.reshape(-1, 2) * self.square_m
        return np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)

    def corners(self, gray: NDArray[np.uint8]) -> Corners | None:
        """Return the corners that an image shows, None where the board is not found.

        Parameters
        ----------
        gray : (H, W) uint8
        """
        return self._of_chessboard(gray) if self.marker_m is None else self._of_charuco(gray)

    def _of_chessboard(self, gray: NDArray[np.uint8]) -> Corners | None:
        size = self.columns, self.rows
        there, pixels = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not there:
            flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
            there, pixels = cv2.findChessboardCorners(gray, size, flags=flags)
        if not there or pixels is None or len(pixels) != self.columns * self.rows:
            return None
        return Corners(np.arange(len(pixels)), _refined(gray, pixels))

    def _of_charuco(self, gray: NDArray[np.uint8]) -> Corners | None:
        for detector in self._detectors:
            pixels, ids, _, _ = detector.detectBoard(gray)
            if ids is not None and len(ids) >= _LEAST_CORNERS:
                order = np.argsort(np.ravel(ids))
                return Corners(
                    np.ravel(ids)[order].astype(np.int64), _refined(gray, np.asarray(pixels).reshape(-1, 2)[order])
                )
        return None

    @cached_property
    def _detectors(self) -> tuple[Any, ...]:
        """Detectors of today's pattern, and of that before OpenCV 4.6, which began with a white square."""
        dictionary = _dictionary(self.dictionary)
        size = self.columns, self.rows
        boards = [cv2.aruco.CharucoBoard(size, self.square_m, float(self.marker_m or 0), dictionary) for _ in range(2)]
        boards[1].setLegacyPattern(True)
        return tuple(cv2.aruco.CharucoDetector(board) for board in boards)

    def orders(self) -> list[NDArray[np.int64]]:
        """Return the orders in which a detector may number the same corners: turned by half, and by a quarter."""
        places = np.arange(len(self.points))
        if self.marker_m is not None:
            return [places]
        grid = places.reshape(self.rows, self.columns)
        turns = [np.rot90(grid, k) for k in range(4)]
        return [turn.ravel() for turn in turns if turn.shape == grid.shape]


def _refined(gray: NDArray[np.uint8], pixels: Any) -> NDArray[np.float64]:
    """Return corners where the gradients around them say; detectors are a fifth of a pixel off in small images.

    The window stays within the squares around a corner.
    """
    places = np.array(pixels, np.float32).reshape(-1, 2)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    apart[apart == 0] = np.inf
    half = int(np.clip(0.3 * np.quantile(apart.min(axis=1), 0.1), 2, 11))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
    refined = cv2.cornerSubPix(gray, places.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), criteria).reshape(-1, 2)
    stray = np.linalg.norm(refined - places, axis=1) > half
    return np.where(stray[:, None], places, refined).astype(np.float64)


def _dictionary(name: str) -> Any:
    known = {key.removeprefix("DICT_"): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    plain = name.upper().removeprefix("DICT_")
    if plain not in known:
        raise OptionError(did_you_mean("dictionary", name, known))
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[plain]))
