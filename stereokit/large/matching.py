"""Match images that do not fit in memory: overlapping windows, one at a time, as large as a bound of memory allows.

Semi-global costs reach across the whole image in theory, and the domain transform's filter fades but does not end;
in practice the influence of a pixel ends within some tens of pixels. So a window is matched with a margin, `overlap`,
that is then dropped. The inner part differs from the map of the whole image in few pixels, the fewer the larger the
margin is (`OVERLAP` has the figures). Decisions from whole images (the range of 16-bit and floating-point values, the
largest region that counts as a speckle) are made from whole images here too, and gaps are filled along whole rows. At
half size, where a refiner needs a filled map, filling stays within the window.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereokit.errors import InputError, OptionError
from stereokit.images.check import check_integer
from stereokit.images.evidence import checked_mask
from stereokit.images.gray import check_same
from stereokit.images.intensity import IntensityMapping
from stereokit.io.images import check_orientations
from stereokit.large.bands import BandAssembler
from stereokit.large.border import find_border
from stereokit.large.intensity import BLOCK_NBYTES, MaskedSource, Ranges, find_ranges, intensity_mapping
from stereokit.large.memory import free_nbytes, parse_memory, resident_nbytes
from stereokit.large.output import check_large_output, write_bands
from stereokit.large.plan import Plan, plan
from stereokit.large.sources import Source, open_source
from stereokit.matching import Matcher
from stereokit.notices import PairWarning, warn

__all__ = ["OVERLAP", "LargeResult", "match_large"]

OVERLAP = 96
"""Default margin of the windows, pixels.

One cut through 1242x1000 synthetic streets (three) and KITTI 2015 pairs (eight), 128 disparities, default options:
pixels that differ from the map of the whole image at all, and by more than a pixel, for each pixel of the cut's
length, the larger of the two data sets; by the overlap::

                     32            64            96            128           192
    rows     S1   0.1  0.03     0.0  0.00     0.0  0.00     0.0  0.00     0.0  0.00
             S2    11  0.45     3.6  0.13     1.4  0.11     0.6  0.07     0.1  0.00
       full, S2   7.5  0.25     2.0  0.08     0.6  0.01     0.2  0.00     0.0  0.00
             S3   0.0  0.01     0.0  0.00     0.0  0.00     0.0  0.00     0.0  0.00
             S4   3.4  0.10     0.2  0.00     0.1  0.00     0.0  0.00     0.0  0.00
       half, S4    19  0.69     3.4  0.07     1.6  0.18     0.6  0.17     0.0  0.00
    columns  S1   0.1  0.00     0.0  0.00     0.0  0.00     0.0  0.00     0.0  0.00
             S2    51  9.9       44   11       36  7.8       25  5.6       11  3.6
       full, S2    26  4.5       17  3.1       12  3.3      6.0  0.35     2.5  0.10
             S3   1.3  0.10     0.7  0.05     0.6  0.02     0.5  0.01     0.4  0.01
             S4   7.1  1.5      5.0  0.89     2.8  0.51     1.7  0.45     1.0  0.19
       half, S4    21  3.7       15  2.6       11  1.7      9.2  1.4      3.1  0.20

Rows are the better place to cut; columns are cut where that saves work. Strips of 500 rows with a margin of 96 have,
at full size, less than a pixel in ten thousand that is off by more than a pixel, and S2 four, whose half-size map, from
coarse to fine, sees twice as far. Each further halving, of larger ranges, doubles that again. Large surfaces without
texture, where only what comes from afar decides, have more.
"""

_RESERVE_NBYTES = 6 * BLOCK_NBYTES + 2**24
"""Memory for blocks before their conversion to grey, and for the interpreter and the system meanwhile."""


@dataclass(frozen=True)
class LargeResult:
    """The map file of `match_large`, and how it was matched.

    Attributes
    ----------
    output : Path
        The map: float32, pixels, NaN where invalid.
    height, width : int
        Of the map.
    window : tuple of int
        Height and width of the windows that were matched.
    windows : int
        Their number.
    overlap : int
        The margin that was dropped at each cut side, pixels.
    density : float
        The share of pixels that were measured, from 0 to 1.
    matcher : Matcher
        The matcher with all its options.
    """

    output: Path
    height: int
    width: int
    window: tuple[int, int]
    windows: int
    overlap: int
    density: float
    matcher: Matcher


def match_large(
    left: Any,
    right: Any,
    output: str | os.PathLike[str],
    method: str = "census+sgm",
    *,
    memory: int | float | str | None = None,
    overlap: int = OVERLAP,
    progress: Callable[[int, int], object] | None = None,
    mask: Any = None,
    right_mask: Any = None,
    **options: Any,
) -> LargeResult:
    """Match a rectified pair window by window and write the left view's disparity map as it grows.

    Parameters
    ----------
    left, right : path or array
        Images of one size and type, as `stereokit.match` takes them. ``.npy`` files are mapped and TIFF files decoded
        tile by tile (``stereokit[tiff]``); other files are read whole, and count in `memory`.
    output : path
        ``.npy``, or ``.tiff`` in tiles of 256 (``stereokit[tiff]``). It appears when it is complete.
    method : str
        ``"cost+aggregation"`` or S1 to S4.
    memory : int, str or None
        Upper bound of the memory of the whole process, bytes or text such as ``"2GB"``; None is its present memory
        and half of the free one.
    overlap : int
        Margin around the inner part of a window, pixels; in the direction of disparity, as many more as there are
        disparities.
    progress : callable or None
        Called with the number of matched windows and of all windows.
    mask, right_mask : path or (H, W) bool, optional
        Usable pixels of the left, and of the right image: True, or not 0 in a file, which is read as the images are.
    **options
        Those of `Matcher`, but ``right`` and ``confidence``.

    Returns
    -------
    LargeResult

    Warns
    -----
    PairWarning
        If both images are the same, their orientation tags differ, or hardly anything could be measured.

    Raises
    ------
    InputError, OptionError, FileError
        If an image, an option or the output cannot be used, or `memory` does not suffice for the smallest window.
    StereokitError
        If TIFF is read or written without tifffile.
    """
    target = check_large_output(output)
    overlap = check_integer("overlap", overlap, 0, 2**20)
    if options.get("confidence"):
        raise OptionError("confidence is not available when an image is matched in windows")
    matcher = Matcher(method, **options)
    limit = None if memory is None else parse_memory(memory)
    sources = open_source("left", left), open_source("right", right)
    check_same(*sources)
    check_orientations(sources[0].orientation, sources[1].orientation)
    height, width = sources[0].shape[:2]
    masks = _mask_source("mask", mask, (height, width)), _mask_source("right_mask", right_mask, (height, width))
    borders = [find_border(source, BLOCK_NBYTES) for source in sources]
    views = MaskedSource(sources[0], masks[0], borders[0]), MaskedSource(sources[1], masks[1], borders[1])
    mapping = intensity_mapping(*views, matcher.settings.nodata)
    windows = _plan(matcher, views, mapping, overlap, limit, target)
    ranges: Ranges | None = None
    if getattr(matcher.cost, "needs_ranges", False):
        ranges = find_ranges(*views, mapping, matcher.settings.step, matcher.settings.smooth, matcher.threads)
    assembler = BandAssembler(matcher, views, mapping, ranges, windows, progress)
    write_bands(target, height, width, assembler)
    count = len(windows.rows) * len(windows.columns)
    density = assembler.measured / (height * width)
    for line in assembler.warnings():
        warn(line, PairWarning)
    return LargeResult(target, height, width, windows.window, count, overlap, density, matcher)


def _mask_source(name: str, mask: Any, shape: tuple[int, int]) -> Source | None:
    """Return a mask as the source of its windows, None if there is none."""
    if mask is None:
        return None
    if not isinstance(mask, (str, os.PathLike)):
        mask = checked_mask(name, mask, shape)
    source = open_source(name, mask)
    if source.shape != shape:
        raise InputError(f"{name} must have the size of the images, {shape}, got {source.shape}")
    return source


def _plan(
    matcher: Matcher,
    views: tuple[MaskedSource, MaskedSource],
    mapping: IntensityMapping,
    overlap: int,
    limit: int | None,
    target: Path,
) -> Plan:
    height, width = views[0].shape[:2]
    sources = [view.image for view in views]
    masks = [view.mask for view in views if view.mask is not None]
    size = mapping.kind.itemsize
    has_masks = (
        bool(masks)
        or any(view.border is not None for view in views)
        or mapping.nodata is not None
        or sources[0].dtype != np.uint8
        or any(source.shape[2:] == (4,) for source in sources)
    )
    pixel_nbytes = 2 * size + (size > 1) + 2 * has_masks + 5  # both images, guide, masks, the map
    pixel_nbytes += getattr(matcher.cost, "bytes_per_pixel", 0)
    pixel_nbytes += _refiner_nbytes(matcher)
    row_nbytes = 4 * width * (2 if target.suffix.lower() == ".npy" else 4)  # before and after the median, and as tiles

    def needed(rows: int, columns: int) -> float:
        return matcher.nbytes(rows, columns, mapping.kind) + pixel_nbytes * rows * columns + row_nbytes * rows

    occupied = resident_nbytes()
    limit = occupied + free_nbytes() // 2 if limit is None else limit
    window_memory = limit - occupied - _RESERVE_NBYTES - max(source.piece_nbytes for source in [*sources, *masks])
    reach_x = overlap + max(abs(matcher.min_disparity), abs(matcher.max_disparity))
    return plan(height, width, overlap, reach_x, window_memory, needed)


def _refiner_nbytes(matcher: Matcher) -> int:
    """Return the bytes per pixel of a refiner, without the matcher's buffers."""
    return 0 if matcher.refine is None else int(getattr(matcher.refine, "bytes_per_pixel", 240))
