"""From windows to bands of full width, and what is done to a band as a whole: filling and the median.

Filling looks along a row for whatever is there, however far, so that a window alone would fill with other values
than the whole image; it waits until the row is complete, and the median after it. At half size both come before the
refiner, and stay within the window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.checks import same_pixels
from stereokit.images.intensity import Tone
from stereokit.large.plan import Cut, Plan
from stereokit.large.sources import Source
from stereokit.large.tones import Ranges, read_pair
from stereokit.matching import Matcher
from stereokit.postprocess.fill import fill_empty_rows, fill_rows
from stereokit.postprocess.median import median_rows

__all__ = ["Bands"]


class Bands:
    """The map in bands, top to bottom.

    Parameters
    ----------
    matcher : Matcher
    sources : (Source, Source)
    tone : Tone
    ranges : ((int, int), (int, int)) or None
        See `stereokit.large.tones.find_ranges`.
    windows : Plan
    progress : callable or None
        Called with the number of windows done and of all.

    Attributes
    ----------
    measured : int
        Pixels so far that were measured.
    same : bool
        Whether both views were the same so far.
    """

    def __init__(
        self, matcher: Matcher, sources: tuple[Source, Source], tone: Tone, ranges: Ranges | None, windows: Plan,
        progress: Callable[[int, int], object] | None,
    ) -> None:  # fmt: skip
        self.measured, self.same = 0, True
        self._wanted, self._sources, self._tone, self._ranges = matcher, sources, tone, ranges
        self._windows, self._progress = windows, progress
        self._height, self._width = sources[0].shape[:2]
        self._matcher = _for_windows(matcher, (self._height, self._width), windows.window)
        self._halo = matcher.settings.median // 2 if matcher.refiner is None else 0
        self._last: NDArray[np.float32] | None = None  # row that a band without any valid pixel is filled from

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        """Yield (rows, W) float32, pixels, NaN where invalid."""
        total = len(self._windows.rows) * len(self._windows.columns)
        done = 0
        for row in self._windows.rows:
            top = max(row.first - self._halo, row.start)
            bottom = min(row.last + self._halo, row.stop)
            band = np.empty((bottom - top, self._width), np.float32)
            for column in self._windows.columns:
                self._match(row, column, top, band)
                done += 1
                if self._progress is not None:
                    self._progress(done, total)
            band = self._finished(band)
            yield band[row.first - top : row.last - top]
            del band

    def _match(self, row: Cut, column: Cut, top: int, band: NDArray[np.float32]) -> None:
        """Match one window and put what is kept of it into a band that begins at row `top`."""
        window = row.start, row.stop, column.start, column.stop
        pair = read_pair(*self._sources, self._tone, window, self._ranges)
        self.same = self.same and same_pixels(pair.left, pair.right)
        found = self._matcher.match_gray(pair, self._matcher.threads)
        kept = slice(column.first - column.start, column.last - column.start)
        rows = slice(top - row.start, top - row.start + len(band))
        band[:, column.first : column.last] = found.disparity[rows, kept]
        self.measured += int(np.count_nonzero(found.valid[row.first - row.start : row.last - row.start, kept]))

    def _finished(self, band: NDArray[np.float32]) -> NDArray[np.float32]:
        settings = self._wanted.settings
        if settings.refiner is not None:
            return band
        filled = settings.fill is not None
        if filled:
            if fill_rows(band, 0, len(band), settings.fill == "nearest") and not fill_empty_rows(band):
                band[:] = settings.levels.minimum if self._last is None else self._last
            self._last = band[-1].copy()
        if settings.median == 0:
            return band
        out = np.empty_like(band)
        median_rows(band, settings.median, 0, len(band), out, dense=filled)
        return out


def _for_windows(matcher: Matcher, image: tuple[int, int], window: tuple[int, int]) -> Matcher:
    """Return a matcher whose largest speckle has as many pixels as in the whole image, and that leaves filling."""
    step = matcher.settings.step
    whole, part = (-(-height // step) * -(-width // step) for height, width in (image, window))
    speckle = matcher.settings.speckle
    changes: dict[str, Any] = {"speckle": min(1.0, (int(speckle * whole) + 0.5) / part)} if speckle else {}
    if matcher.refiner is None:
        changes.update(fill=None, median=0)
    return matcher.replaced(**changes)
