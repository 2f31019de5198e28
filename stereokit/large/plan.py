"""The division of a large image into windows of one size that overlap, as large as a bound of memory allows.

Windows are full-width strips where that is the least work, else tiles in rows and columns. Each pixel of the map is
taken from one window, in which it lies at least `reach` pixels from every side that is not a side of the image.
All windows are of one size, so that buffers are allocated once. They start at multiples of `STEP`, so that half-size
pixels and the strides of a refiner lie as they lie in the whole image.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

from stereokit.errors import OptionError

__all__ = ["STEP", "Plan", "Span", "plan"]

STEP = 32
"""Windows start at multiples of this, pixels."""


@dataclass(frozen=True)
class Span:
    """One window along one axis: its extent is `start` .. `stop`, its part of the map is `first` .. `last`."""

    start: int
    stop: int
    first: int
    last: int


@dataclass(frozen=True)
class Plan:
    """All windows: each of `rows` with each of `columns`."""

    rows: tuple[Span, ...]
    columns: tuple[Span, ...]

    @property
    def window(self) -> tuple[int, int]:
        """Height and width of every window."""
        return self.rows[0].stop - self.rows[0].start, self.columns[0].stop - self.columns[0].start

    @property
    def pixels(self) -> int:
        """Pixels that are matched, in all windows together."""
        height, width = self.window
        return len(self.rows) * len(self.columns) * height * width


def plan(
    height: int, width: int, reach_y: int, reach_x: int, memory: int, needed: Callable[[int, int], float]
) -> Plan:  # fmt: skip
    """Return the windows with the least work that `memory` allows.

    Parameters
    ----------
    height, width : int
        Of the image.
    reach_y, reach_x : int
        Least distance of a pixel from a cut side of its window, pixels.
    memory : int
        Bytes for one window at a time.
    needed : callable
        ``needed(height, width)`` bytes of a window; grows with both.

    Raises
    ------
    OptionError
        If not even the smallest window fits.
    """
    best: Plan | None = None
    for window_width in _sizes(width, reach_x):
        if best is not None and _smallest_work(width, window_width, reach_x) * height >= best.pixels:
            continue
        heights = [
            window_height for window_height in _sizes(height, reach_y) if needed(window_height, window_width) <= memory
        ]
        if heights:
            candidate = Plan(_spans(height, heights[0], reach_y), _spans(width, window_width, reach_x))
            best = candidate if best is None or candidate.pixels < best.pixels else best
    if best is None:
        smallest = needed(_sizes(height, reach_y)[-1], _sizes(width, reach_x)[-1])
        raise OptionError(
            f"memory leaves {max(memory, 0) / 1e6:.0f} MB for a window of these images, "
            f"the smallest needs {smallest / 1e6:.0f} MB; give more, or a smaller overlap or max_disparity"
        )
    return best


def _sizes(length: int, reach: int) -> list[int]:
    """Return the sizes that a window may have, the largest first: the rest of the image is a multiple of `STEP`."""
    return [length - rest for rest in range(0, max(length - 2 * reach - STEP, 0) + 1, STEP)]


def _count(length: int, size: int, reach: int) -> int:
    steps = (length - size) // STEP
    return 1 + -(-steps // max((size - 2 * reach) // STEP, 1))


def _smallest_work(length: int, size: int, reach: int) -> int:
    return _count(length, size, reach) * size


def _spans(length: int, size: int, reach: int) -> tuple[Span, ...]:
    count = _count(length, size, reach)
    steps = (length - size) // STEP
    starts = [STEP * (k * steps // max(count - 1, 1)) for k in range(count)]
    borders = [(a + size + b) // 2 for a, b in itertools.pairwise(starts)]  # the middle of the overlap
    firsts, lasts = [0, *borders], [*borders, length]
    return tuple(Span(s, s + size, f, e) for s, f, e in zip(starts, firsts, lasts, strict=True))
