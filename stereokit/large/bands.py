"""Assembly of windows to bands of full width, and the steps that need a whole band: filling and the median.

Filling takes the nearest value of a row, however far it lies. A window alone would fill with other values than the
whole image, so filling waits until the row is complete, and the median comes after it. At half size both come before
the refiner, and stay within the window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.checks import PairWatch, density_fault, same_fault, same_pixels
from stereokit.images.evidence import joined
from stereokit.images.intensity import IntensityMapping
from stereokit.large.intensity import MaskedSource, Ranges, read_pair
from stereokit.large.plan import Plan, Span
from stereokit.matching import Matcher
from stereokit.pairs.check import Fault, unusable_fault
from stereokit.pipeline import with_blank
from stereokit.postprocess.fill import fill_empty_rows, fill_rows
from stereokit.postprocess.median import median_rows

__all__ = ["BandAssembler"]

_OF_WINDOWS = frozenset(("density", "sparse", "unusable", "same"))
"""Kinds of fault that a window alone, of nothing but water, may have."""


class BandAssembler:
    """An iterator over the map in bands, top to bottom.

    Parameters
    ----------
    matcher : Matcher
    sources : (MaskedSource, MaskedSource)
    mapping : IntensityMapping
    ranges : ((int, int), (int, int)) or None
        See `stereokit.large.intensity.find_ranges`.
    windows : Plan
    progress : callable or None
        Called with the number of matched windows and of all windows.

    Attributes
    ----------
    measured : int
        Pixels so far that were measured.
    views_equal : bool
        Whether both views have equal pixels so far.
    """

    def __init__(
        self,
        matcher: Matcher,
        sources: tuple[MaskedSource, MaskedSource],
        mapping: IntensityMapping,
        ranges: Ranges | None,
        windows: Plan,
        progress: Callable[[int, int], object] | None,
    ) -> None:
        self.measured, self.views_equal = 0, True
        self._usable, self._watch, self._faults = 0, PairWatch(matcher.scale, matcher.settings.searched), list[Fault]()
        self._image_matcher, self._sources, self._mapping, self._ranges = matcher, sources, mapping, ranges
        self._windows, self._progress = windows, progress
        self._height, self._width = sources[0].shape[:2]
        self._window_matcher = _window_matcher(matcher, (self._height, self._width), windows.window)
        self._range = matcher.min_disparity, matcher.max_disparity
        self._halo = matcher.settings.median // 2 if matcher.refiner is None else 0
        self._last_row: NDArray[np.float32] | None = None  # row that a band without any valid pixel is filled from

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        """Yield (rows, W) float32, pixels, NaN where invalid."""
        total = len(self._windows.rows) * len(self._windows.columns)
        done = 0
        for row in self._windows.rows:
            top = max(row.first - self._halo, row.start)
            bottom = min(row.last + self._halo, row.stop)
            band = np.empty((bottom - top, self._width), np.float32)
            empty = np.zeros(band.shape, np.bool_)
            for column in self._windows.columns:
                self._match(row, column, top, band, empty)
                done += 1
                if self._progress is not None:
                    self._progress(done, total)
            band = self._finished(band)
            band[empty] = np.nan
            yield band[row.first - top : row.last - top]
            del band, empty

    def _match(
        self, row: Span, column: Span, top: int, band: NDArray[np.float32], empty: NDArray[np.bool_]
    ) -> None:  # fmt: skip
        """Match one window and copy its inner part into a band that begins at row `top`, and where that stays empty."""
        window = row.start, row.stop, column.start, column.stop
        pair = read_pair(*self._sources, self._mapping, window, self._ranges)
        self.views_equal = self.views_equal and same_pixels(pair.left, pair.right)
        pair = with_blank(pair, self._window_matcher.settings, self._window_matcher.threads)
        result = self._window_matcher.match_gray(pair, self._window_matcher.threads, keeps_blank=True)
        columns = slice(column.first - column.start, column.last - column.start)
        rows = slice(top - row.start, top - row.start + len(band))
        band[:, column.first : column.last] = result.disparity[rows, columns]
        filled = self._image_matcher.settings.fill is not None
        without = joined(pair.left_bad, None if filled else pair.left_blank)
        if without is not None:
            empty[:, column.first : column.last] = without[rows, columns]
        inner = np.s_[row.first - row.start : row.last - row.start, columns]
        self._usable += pair.left[inner].size
        if pair.left_bad is not None:
            self._usable -= int(np.count_nonzero(pair.left_bad[inner]))
        if not self._faults:
            self._faults = self._watch.faults(pair, result, *self._range)
        self.measured += int(np.count_nonzero(result.valid[inner]))

    def warnings(self) -> list[str]:
        """Return the warnings about the pair and its map, a line each, when all windows are matched."""
        return [fault.message for fault in self._final_faults()]

    def _final_faults(self) -> list[Fault]:
        if not self._usable:
            return [unusable_fault()]
        if self.views_equal:
            return [same_fault()]
        low = density_fault(self.measured / self._usable, *self._range, self._image_matcher.settings.searched)
        closer = [fault for fault in self._faults if fault.kind not in _OF_WINDOWS]
        if low is not None:
            return closer or [low]
        return closer if any(fault.kind == "rows" for fault in closer) else []

    def _finished(self, band: NDArray[np.float32]) -> NDArray[np.float32]:
        settings = self._image_matcher.settings
        if settings.refiner is not None:
            return band
        fills = settings.fill is not None
        if fills:
            if fill_rows(band, 0, len(band), settings.fill == "nearest") and not fill_empty_rows(band):
                band[:] = settings.levels.minimum if self._last_row is None else self._last_row
            self._last_row = band[-1].copy()
        if settings.median == 0:
            return band
        out = np.empty_like(band)
        median_rows(band, settings.median, 0, len(band), out, dense=fills)
        return out


def _window_matcher(matcher: Matcher, image: tuple[int, int], window: tuple[int, int]) -> Matcher:
    """Return the matcher of the windows: its largest speckle has as many pixels as that of the image, and no fill."""
    step = matcher.settings.step
    image_pixels, window_pixels = (-(-height // step) * -(-width // step) for height, width in (image, window))
    speckle = matcher.settings.speckle
    changes: dict[str, Any] = (
        {"speckle": min(1.0, (int(speckle * image_pixels) + 0.5) / window_pixels)} if speckle else {}
    )
    if matcher.refiner is None:
        changes.update(fill=None, median=0)
    return matcher.replaced(**changes)
