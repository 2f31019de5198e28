"""The result of a matcher: the disparity map with its valid pixels and confidence, and its depth, points and colours.

The colours are Google's Turbo map (Mikhailov 2019, as in OpenCV): it runs from dark blue (far) to dark red
(near) without the false edges of a rainbow. Pixels without a value are black.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereokit import io
from stereokit.calibration import Calibration
from stereokit.errors import InputError, OptionError
from stereokit.images.check import check_flag, check_number

__all__ = ["Disparity", "color_range", "colorize"]


@dataclass(frozen=True, eq=False)
class Disparity:
    """A disparity map of the left view.

    Parameters
    ----------
    disparity : (H, W) float32
        Pixels, NaN where invalid. **Filled** unless the matcher has ``fill=None``: then what was not measured holds
        what its surroundings make likely. `measured` has NaN there.
    valid : (H, W) bool
        True where the disparity was measured, False where it was filled or is invalid.
    confidence : (H, W) float32, optional
        From 0, no better than another disparity, to 1.
    right : (H, W) float32, optional
        The map of the right view, pixels, NaN where invalid.
    candidates : (2, H, W) float32, optional
        The two disparities of lowest aggregated cost, pixels, before any check, filter or fill: the best, and the best
        of those that are not next to it, or the best again where there is none. Only for refiners that need them.

    Raises
    ------
    InputError
        If an array has another type or shape.
    """

    disparity: NDArray[np.float32]
    valid: NDArray[np.bool_]
    confidence: NDArray[np.float32] | None = None
    right: NDArray[np.float32] | None = None
    candidates: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        _check("disparity", self.disparity, np.float32, None)
        shape = self.disparity.shape
        _check("valid", self.valid, np.bool_, shape)
        if self.confidence is not None:
            _check("confidence", self.confidence, np.float32, shape)
        if self.right is not None:
            _check("right", self.right, np.float32, shape)
        if self.candidates is not None:
            _check("candidates", self.candidates, np.float32, (2, *shape))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return `disparity` where numpy asks for an array: ``np.asarray(result)`` is the map, without a copy."""
        if copy is None:
            return np.asarray(self.disparity, dtype)
        if copy:
            return np.array(self.disparity, dtype)
        if dtype is not None and np.dtype(dtype) != self.disparity.dtype:
            raise ValueError(
                f"a disparity map of {self.disparity.dtype} cannot become {np.dtype(dtype)} without a copy"
            )
        return self.disparity

    def __repr__(self) -> str:
        height, width = self.disparity.shape
        known = self.disparity[np.isfinite(self.disparity)]
        span = f"{known.min():.1f} .. {known.max():.1f} px" if known.size else "no disparity"
        more = [name for name in ("confidence", "right", "candidates") if getattr(self, name) is not None]
        return (
            f"Disparity({height}x{width}, {span}, {100 * self.density:.1f} % measured{''.join(f', {m}' for m in more)})"
        )

    def _repr_png_(self) -> bytes:
        """Return the map in colours, as notebooks show it."""
        good, data = cv2.imencode(".png", self.color()[:, :, ::-1])
        assert good
        return data.tobytes()

    @property
    def measured(self) -> NDArray[np.float32]:
        """The map of what was measured alone, (H, W) float32 in pixels: NaN where a value was filled in, or is missing.

        `disparity` is filled by default; this is not.
        """
        return np.where(self.valid, self.disparity, np.float32(np.nan))

    @property
    def density(self) -> float:
        """The share of pixels that were measured, from 0 to 1."""
        return float(np.count_nonzero(self.valid) / self.valid.size)

    def depth(
        self, calibration: Calibration, *, filled: bool = False, max_depth: float | None = None
    ) -> NDArray[np.float32]:
        """Return the depth, (H, W) float32 in metres, NaN where there is none.

        Parameters
        ----------
        calibration : Calibration
        filled : bool
            Also of pixels that were not measured but filled.
        max_depth : float or None
            Metres beyond which there is none.

        Raises
        ------
        InputError
            If the calibration is for maps of another size.
        OptionError
            If `max_depth` is not positive.
        """
        return calibration.disparity_to_depth(self._depth_disparity(calibration, filled, max_depth))

    def points(
        self, calibration: Calibration, *, filled: bool = False, max_depth: float | None = None, frame: str = "optical"
    ) -> NDArray[np.float32]:
        """Return the points in a frame of the left camera, (H, W, 3) float32 metres, NaN where there is none.

        Parameters
        ----------
        calibration : Calibration
        filled, max_depth
            As of `depth`.
        frame : {"optical", "y-up", "ros"}
            See `stereokit.calibration.FRAMES`.

        Raises
        ------
        InputError
            If the calibration is for maps of another size.
        OptionError
            If `max_depth` is not positive, or there is no such frame.
        """
        return calibration.points(self._depth_disparity(calibration, filled, max_depth), frame)

    def _depth_disparity(self, calibration: Calibration, filled: bool, max_depth: float | None) -> NDArray[np.float32]:
        """Return the map of the pixels that have a depth for the user."""
        disparity = self.disparity if check_flag("filled", filled) else self.measured
        if max_depth is None:
            return disparity
        farthest = check_number("max_depth", max_depth, 0, np.inf)
        if farthest == 0:
            raise OptionError("max_depth must be positive, got 0")
        depth = calibration.disparity_to_depth(disparity)
        return np.where(depth <= farthest, disparity, np.float32(np.nan))

    def save_depth(
        self, path: str | os.PathLike[str], calibration: Calibration, *, filled: bool = False,
        max_depth: float | None = None,
    ) -> None:  # fmt: skip
        """Write the depth as ``.png`` (16-bit millimetres, 0 for none), ``.tiff`` or ``.npy`` (float32 metres, NaN).

        See `stereokit.io.write_depth`. Only what was measured is written, unless `filled` is True.

        Parameters
        ----------
        path : path
        calibration : Calibration
        filled, max_depth
            As of `depth`.

        Raises
        ------
        InputError
            If the calibration is for maps of another size.
        OptionError
            If `max_depth` is not positive.
        FileError
            If the suffix is unknown or the file cannot be written.
        """
        io.write_depth(path, self.depth(calibration, filled=filled, max_depth=max_depth))

    def color(self, min: float | None = None, max: float | None = None) -> NDArray[np.uint8]:
        """Return the map as a picture, (H, W, 3) uint8 RGB; see `colorize`.

        Parameters
        ----------
        min, max : float, optional
            Disparities of the first and the last colour, pixels; by default those of `color_range`. Fix them for
            video, so that colours keep their meaning.
        """
        return colorize(self.disparity, min, max)

    def save(self, path: str | os.PathLike[str], *, clip: bool = False) -> None:
        """Write `disparity` as ``.png`` (KITTI), ``.pfm``, ``.npy`` or ``.tiff``.

        See `stereokit.io.write_disparity`. Filled values are written like measured ones; ``write_disparity(path,
        result.measured)`` leaves them out.

        Parameters
        ----------
        path : path
        clip : bool
            Clip disparities to the range of a ``.png``, 0 to 65535/256 pixels.

        Raises
        ------
        InputError
            If there are such values, and `clip` is False.
        FileError
            If the suffix is unknown or the file cannot be written.
        """
        io.write_disparity(path, self.disparity, clip=clip)


def color_range(disparity: NDArray[Any]) -> tuple[float, float]:
    """Return the default disparities of the first and the last colour, pixels.

    Parameters
    ----------
    disparity : array of float
        Pixels, not finite where invalid.

    Returns
    -------
    low, high : float
        `high` is the 99th percentile of the valid values. `low` is 0 where that leaves these values at least half of
        the colours, or they are all one; else, for negative and for far ranges, it is the first percentile.
    """
    known = disparity[np.isfinite(disparity)]
    if known.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(known, (1, 99)))
    if low >= 0 and (2 * low <= high or low == high):
        low = 0.0
    return (low, high) if high > low else (low, low + 1)


def colorize(disparity: ArrayLike, low: float | None = None, high: float | None = None) -> NDArray[np.uint8]:
    """Return a disparity map in Turbo colours.

    Parameters
    ----------
    disparity : (H, W) float
        Pixels, not finite where invalid.
    low, high : float, optional
        Disparities of the first and the last colour, pixels; values outside take the end's colour. The defaults
        are those of `color_range`.

    Returns
    -------
    (H, W, 3) uint8
        RGB, black where invalid.

    Raises
    ------
    InputError
        If `disparity` is not a 2-d array of floats.
    OptionError
        If `high` is not above `low` or one is not finite.
    """
    values = np.asarray(disparity)
    if values.ndim != 2 or values.dtype.kind != "f":
        raise InputError(f"disparity must be (H, W) float, got {values.dtype} of shape {values.shape}")
    known = np.isfinite(values)
    bottom, top = color_range(values) if low is None or high is None else (low, high)
    if low is None:
        low = bottom if high is None or bottom < high else min(0.0, high - 1)
    if high is None:
        high = top if top > low else low + 1
    if not (np.isfinite(low) and np.isfinite(high) and high > low):
        raise OptionError(f"high must be finite and above low, got low={low}, high={high}")
    span = (np.where(known, values, low).astype(np.float32) - np.float32(low)) / np.float32(high - low)
    colors: NDArray[np.uint8] = _turbo_map()[np.rint(np.clip(span, 0, 1) * 255).astype(np.uint8)]
    colors[~known] = 0
    return colors


@lru_cache(maxsize=1)
def _turbo_map() -> NDArray[np.uint8]:
    steps = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[:, 0, ::-1], dtype=np.uint8)


def _check(name: str, array: Any, dtype: type[np.generic], shape: tuple[int, ...] | None) -> None:
    if not isinstance(array, np.ndarray):
        raise InputError(f"{name} must be a numpy array, got {type(array).__name__}")
    if array.dtype != dtype:
        raise InputError(f"{name} must be {np.dtype(dtype)}, got {array.dtype}")
    if shape is None and (array.ndim != 2 or array.size == 0):
        raise InputError(f"{name} must be (H, W) and not empty, got shape {array.shape}")
    if shape is not None and array.shape != shape:
        raise InputError(f"{name} must have the shape of disparity, {shape}, got {array.shape}")
