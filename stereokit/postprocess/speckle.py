"""Removal of speckles: small islands of disparity that agree with nothing around them (Hirschmueller 2008, III-B).

A region is a set of 4-connected pixels whose disparities differ by at most `difference` from one to the next;
regions of few pixels become invalid. Regions are found by union-find over the runs of each row (He, Chao, Suzuki
2008): one pass in bands that are joined at their seams, one pass that erases. The rule is that of OpenCV's
``filterSpeckles``, but on disparities as they are, not in sixteenths, and several times faster.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereokit.images.check import check_integer, check_number
from stereokit.images.maps import check_threads, checked_map
from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.simd import LANES, first_bit, load, mask_equal, splat
from stereokit.kernels.threads import run, spans
from stereokit.kernels.workspace import Workspace

__all__ = ["Regions", "alike", "erase", "find_regions", "join_rows", "region_buffers", "remove_speckles"]


def remove_speckles(
    disparity: NDArray[np.float32], size: int, difference: float = 1.0, *, threads: int = 1,
    workspace: Workspace | None = None,
) -> NDArray[np.float32]:  # fmt: skip
    """Return a copy of the map without regions of `size` pixels or fewer.

    Parameters
    ----------
    disparity : (H, W) float32, pixels, NaN where invalid
    size : int
        Largest region that is removed, pixels.
    difference : float
        Largest difference of neighbours in one region, pixels.
    threads : int
        Threads to use; the result does not depend on it.
    workspace : Workspace or None
        Home of the buffers between calls.

    Returns
    -------
    (H, W) float32, pixels, NaN where invalid

    Raises
    ------
    InputError, OptionError
        If the map is not (H, W) numbers, or an option breaks its rule.
    """
    threads = check_threads(threads)
    size = check_integer("size", size, 0)
    limit = np.float32(check_number("difference", difference, 0, 1e6))
    out = checked_map(disparity)
    size = min(size, out.size)
    height, width = out.shape
    flat = out.reshape(-1)
    parts = spans(height, threads)
    regions = region_buffers((height, width), len(parts), workspace or Workspace())
    run([partial(find_regions, flat, width, k, y0, y1, limit, regions) for k, (y0, y1) in enumerate(parts)], threads)
    for y0, _ in parts[1:]:
        join_rows(flat, width, y0, limit, regions)
    run([partial(erase, flat, y0 * width, y1 * width, size, regions) for y0, y1 in parts], threads)
    return out


class Regions(NamedTuple):
    """Runs of a map, pixels of a row of which each is like the one before, and the regions that they form.

    Runs are numbered from left to right and from top to bottom in each band of rows, from the number of the band's
    first pixel on. A run ends where the next one begins.
    """

    begin: NDArray[np.int32]  # (H * W + 1): first pixel of each run
    parent: NDArray[np.int32]  # an older run of the same region, or the run itself
    pixels: NDArray[np.int32]  # of the region of a run that is its own parent
    rows: NDArray[np.int32]  # (H): first run of each row
    marks: NDArray[np.uint8]  # (bands, 4 * stride): scratch, see `find_regions`


def region_buffers(shape: tuple[int, int], bands: int, workspace: Workspace) -> Regions:
    """Return the buffers for a map that is worked on in so many bands at a time."""
    height, width = shape
    stride = -(-width // LANES) * LANES
    return Regions(
        begin=workspace.array("speckle.begin", height * width + 1, np.int32),
        parent=workspace.array("speckle.parent", height * width, np.int32),
        pixels=workspace.array("speckle.pixels", height * width, np.int32),
        rows=workspace.array("speckle.rows", height, np.int32),
        marks=workspace.array("speckle.marks", (bands, 4 * stride), np.uint8),
    )


@inline
def alike(a: np.float32, b: np.float32, limit: np.float32) -> bool:
    """Whether neighbours with these disparities belong to one region; a NaN belongs to none."""
    near: bool = abs(a - b) <= limit
    return near


@inline
def _unite(parent: NDArray[np.int32], pixels: NDArray[np.int32], a: int, b: int) -> None:
    """Join two regions under the older one, which then holds the pixels of both."""
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = np.int64(parent[a])
    while parent[b] != b:
        parent[b] = parent[parent[b]]
        b = np.int64(parent[b])
    if a != b:
        first = min(a, b)
        second = max(a, b)
        parent[second] = first
        pixels[first] += pixels[second]


@inline
def _mark(
    disparity: NDArray[np.float32], at: int, above: int, width: int, limit: np.float32, breaks: NDArray[np.uint8],
    breaks_above: NDArray[np.uint8], likes: NDArray[np.uint8], joins: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Mark where runs begin in the row of pixel `at`, and where they first touch a run of the row of pixel `above`.

    A pixel that is like the one above it says nothing new where the pixels before are alike too, and both runs go on.
    """
    row = disparity[at : at + width]
    upper = disparity[above : above + width]
    breaks[0] = 1
    for x in range(1, width):
        invalid = row[x] != row[x] and row[x - 1] != row[x - 1]
        breaks[x] = 0 if alike(row[x], row[x - 1], limit) or invalid else 1
    for x in range(width):
        likes[x] = 1 if alike(row[x], upper[x], limit) else 0
    joins[0] = likes[0]
    for x in range(1, width):
        joins[x] = likes[x] & (breaks[x] | breaks_above[x] | (likes[x - 1] ^ np.uint8(1)))


@inline
def _run_with(begin: NDArray[np.int32], first: int, pixel: int) -> int:
    """Return the run that has a pixel: `first`, or one behind it."""
    while begin[first + 1] <= pixel:
        first += 1
    return first


@kernel
def find_regions(
    disparity: NDArray[np.float32], width: int, band: int, y0: int, y1: int, limit: np.float32, regions: Regions
) -> None:
    """Find the runs of rows y0..y1 of the flat map and join those that touch.

    Neighbours that are NaN are a run too, which touches no other.
    """
    marks = regions.marks[band]
    stride = marks.size // 4
    marks[:] = 0
    likes = marks[2 * stride : 3 * stride]
    joins = marks[3 * stride :]
    one = splat(np.uint8(1))
    begin = regions.begin
    fresh = np.int64(y0) * width
    above = fresh
    for y in range(y0, y1):
        at = np.int64(y) * width
        place = (y & 1) * stride
        breaks = marks[place : place + stride]
        breaks_above = marks[stride - place : 2 * stride - place]
        first = fresh
        _mark(disparity, at, max(at - width, y0 * width), width, limit, breaks, breaks_above, likes, joins)
        for block in range(0, stride, LANES):
            mask = mask_equal(load(breaks, block), one)
            while mask != 0:
                begin[fresh] = at + block + first_bit(mask)
                fresh += 1
                mask &= mask - np.uint64(1)
        begin[fresh] = at + width
        regions.rows[y] = first
        for k in range(first, fresh):
            regions.parent[k] = k
            regions.pixels[k] = begin[k + 1] - begin[k]
        if y > y0:
            here = first
            for block in range(0, stride, LANES):
                mask = mask_equal(load(joins, block), one)
                while mask != 0:
                    pixel = at + block + first_bit(mask)
                    here = _run_with(begin, here, pixel)
                    above = _run_with(begin, above, pixel - width)
                    _unite(regions.parent, regions.pixels, above, here)
                    mask &= mask - np.uint64(1)
        above = first


@kernel
def join_rows(disparity: NDArray[np.float32], width: int, y: int, limit: np.float32, regions: Regions) -> None:
    """Join the regions of row `y` of the flat map with those of the row above."""
    here = np.int64(regions.rows[y])
    above = np.int64(regions.rows[y - 1])
    for at in range(y * width, (y + 1) * width):
        if alike(disparity[at], disparity[at - width], limit):
            here = _run_with(regions.begin, here, at)
            above = _run_with(regions.begin, above, at - width)
            _unite(regions.parent, regions.pixels, above, here)


@kernel
def erase(disparity: NDArray[np.float32], start: int, stop: int, size: int, regions: Regions) -> None:
    """Invalidate the pixels of small regions in a band; flat range start..stop."""
    begin = regions.begin
    k = np.int64(start)
    while begin[k] < stop:
        root = np.int64(regions.parent[k])
        while regions.parent[root] != root:
            root = np.int64(regions.parent[root])
        regions.parent[k] = root  # later runs of the region need one step; other bands read an ancestor either way
        if regions.pixels[root] <= size:
            for at in range(begin[k], begin[k + 1]):
                disparity[at] = np.nan
        k += 1
