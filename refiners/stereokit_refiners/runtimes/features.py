"""The network's input, made of values and their evidence: compiled loops over rows.

As in `stereokit_refiners.runtimes.evidence`, rows do not depend on one another, and all operations are on integers or
single IEEE ones in a fixed order.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.threads import run, spans
from stereokit.kernels.workspace import Workspace
from stereokit_refiners.networks.evidence import CHANNELS, STEPS
from stereokit_refiners.runtimes.evidence import Hypotheses
from stereokit_refiners.runtimes.evidence_rows import spread_row

__all__ = ["network_input"]


def network_input(
    found: Hypotheses, confidence: NDArray[np.float32], left: NDArray[np.uint8], columns: int, threads: int = 1,
    workspace: Workspace | None = None,
) -> NDArray[np.int8]:  # fmt: skip
    """Return the network's input.

    Parameters
    ----------
    found : Hypotheses
    confidence : (h, w) float32
        The matcher's, 0 to 1.
    left : (rows, columns) uint8
        Full-size image.
    columns : int
        Of the right image.
    threads : int
    workspace : Workspace, optional
        Has the array of the result, which its next use writes over; None takes a new one.

    Returns
    -------
    (C, H/4, W/4) int8, channels innermost in memory
        In steps of 1 / `stereokit_refiners.networks.evidence.STEPS`.
    """
    workspace = Workspace() if workspace is None else workspace
    height, width = found.coarse.shape
    quarter = (height // 4, width // 4)
    out = workspace.array("input", (*quarter, sum(CHANNELS.values())), np.int8)
    means = workspace.array("means", (3, *quarter), np.float32)
    images = np.ascontiguousarray(left), np.ascontiguousarray(confidence)
    evidence = found.half, found.others, means, found.cost, found.gains, found.base, found.sums
    reach = (columns + 1) // 2
    tasks = []
    for k, (y0, y1) in enumerate(spans(quarter[0], threads)):
        part = workspace.part(f"features {k}")
        floats = part.array("floats", (5, width + 2), np.float32)
        place = part.array("place", width // 2, np.int32)
        planes = part.array("planes", (24, 2, width), np.int8)
        lines = floats, place, planes, planes.view(np.uint16), out.view(np.uint16)
        arguments: tuple[Any, ...] = (*images, *evidence, reach, found.step, y0, y1, *lines)
        tasks.append(partial(_features, *arguments))
    run(tasks, threads)
    return np.moveaxis(out, 2, 0)


@inline
def _averages(sums: Any, y0: Any, y1: Any, line: Any, out: Any) -> None:
    """Average over windows of 9x9, and the coarse map over 17x17; the second is one over the spread of grey levels."""
    height, width = sums.shape[1:]
    for y in range(y0, y1):
        for k in range(3):
            reach = 8 if k == 2 else 4
            share = np.float32(1 / 289) if k == 2 else np.float32(1 / 81)
            inner = line[reach : reach + width]
            for x in range(width):
                inner[x] = np.float32(0)
            for dy in range(-reach, reach + 1):
                other = sums[k, min(max(y + dy, 0), height - 1)]
                for x in range(width):
                    inner[x] += other[x]
            for x in range(reach):
                line[x] = inner[0]
                line[reach + width + x] = inner[width - 1]
            row = out[k, y]
            for x in range(width):
                row[x] = np.float32(0)
            for dx in range(2 * reach + 1):
                other = line[dx:]
                for x in range(width):
                    row[x] += other[x]
            for x in range(width):
                row[x] *= share
        for x in range(width):
            mean = out[0, y, x]
            spread = np.sqrt(max(out[1, y, x] - mean * mean, np.float32(0)))
            out[1, y, x] = np.float32(STEPS) / (spread + np.float32(3))


@inline
def _whole(x: Any) -> Any:
    return np.int8(np.int32(np.floor(x + np.float32(0.5))))


@inline
def _squashed(x: Any, unit: Any) -> Any:
    """Return x between -2 and 2, in steps; differences of about a unit are what it resolves best."""
    return _whole(np.float32(2 * STEPS) * (x / (abs(x) + unit)))


@inline
def _surface(nearest: Any, row: Any, base: Any, reach: Any, place: Any, there: Any, out: Any) -> None:
    """Write the nearest surface of the right view where each value points to, less the value; 0 where there is none."""
    half = np.float32(0.5)
    most = np.int32(reach)
    for x in range(row.size):
        at = np.int32(np.floor((np.float32(2 * x - base) - row[x]) * half + half))
        place[x] = min(max(at + np.int32(1), np.int32(0)), most + np.int32(1))
    for x in range(row.size):
        there[x] = nearest[np.uint32(place[x])]
    for x in range(row.size):
        value = row[x]
        beyond = there[x] - value
        out[x] = _squashed(np.float32(0) if there[x] < np.float32(-5e8) else beyond, np.float32(2))


@kernel
def _features(
    image: NDArray[np.uint8], confidence: NDArray[np.float32], half: NDArray[np.float32], others: NDArray[np.float32],
    means: NDArray[np.float32], cost: NDArray[np.uint8], gains: NDArray[np.int8], base: int, sums: NDArray[np.float32],
    reach: int, step: int, y0: int, y1: int, lines: NDArray[np.float32], place: NDArray[np.int32],
    planes: NDArray[np.int8], twos: NDArray[np.uint16], out: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Write rows of 4x4 pixels; `twos` are the bytes of `planes` by two."""
    rows, columns = image.shape
    stride = np.float32(2) / np.float32(step)
    scale = -STEPS if step == 1 else (0 if step == 2 else STEPS)
    quarter = out.shape[1]
    width = half.shape[1]
    two = np.float32(2)
    steps = np.float32(STEPS)
    none = np.float32(-1e9)
    bound = np.float32(3 * STEPS)
    mean = lines[0]
    inverse = lines[1]
    there = lines[2]
    nearest = lines[3]
    certain = lines[4, :width]
    _averages(sums, y0, y1, lines[4, : quarter + 16], means)
    for y in range(y0, y1):
        for x in range(quarter):
            for j in range(4):
                mean[4 * x + j] = means[0, y, x]
                inverse[4 * x + j] = means[1, y, x]
        for i in range(4):
            grey = image[min(4 * y + i, rows - 1)]
            row = planes[20 + i, 0]
            for x in range(columns):
                level = (np.float32(grey[x]) - mean[x]) * inverse[x]
                row[x] = _whole(min(max(level, -bound), bound))
            for x in range(columns, 2 * width):  # pixels beyond the image's end repeat its last
                level = (np.float32(grey[columns - 1]) - mean[x]) * inverse[x]
                row[x] = _whole(min(max(level, -bound), bound))
        for x in range(quarter):
            for j in range(2):
                mean[2 * x + j] = means[2, y, x]
        outside = planes[18, 0]
        for x in range(2 * width):
            outside[x] = np.int8(0)
        for i in range(2):
            h = 2 * y + i
            here = half[h]
            spread_row(confidence[min(np.int64(np.float32(h) * stride), confidence.shape[0] - 1)], stride, certain)
            row = planes[0, i]
            for x in range(width):
                row[x] = _whole(certain[x] * (np.float32(4) * steps) - two * steps)
            row = planes[1, i]
            for x in range(width):
                row[x] = _squashed(here[x] - mean[x], np.float32(8))
            for k in range(4):
                other = others[k, h]
                row = planes[2 + k, i]
                for x in range(width):
                    row[x] = _squashed(other[x] - here[x], two)
            row = planes[6, i]
            costs = cost[h]
            for x in range(width):
                row[x] = np.int8(((np.int32(costs[x]) * np.int32(5)) >> np.int32(2)) - np.int32(STEPS))
            for k in range(6):
                row = planes[7 + k, i]
                gain = gains[k, h]
                for x in range(width):
                    row[x] = gain[x]
            # The right view's map is the left one's, each pixel moved to where it is seen.
            for x in range(reach + 2):
                nearest[x] = none
            for x in range(width):
                at = np.int32(np.floor((np.float32(2 * x - base) - here[x]) * np.float32(0.5)))
                place[x] = min(max(at + np.int32(1), np.int32(-1)), np.int32(reach + 1))
            for x in range(reach):
                at = place[x]
                value = here[x]
                if at >= 1 and at <= reach:
                    nearest[at] = max(nearest[at], value)
                if at >= 0 and at < reach:
                    nearest[at + 1] = max(nearest[at + 1], value)
            for x in range(width):
                away = np.int8(place[x] < np.int32(1)) + np.int8(place[x] > np.int32(reach))
                outside[x] = np.int8(outside[x] + np.int8(away))
            _surface(nearest, here, base, reach, place, there[:width], planes[13, i])
            for k in range(4):
                _surface(nearest, others[k, h], base, reach, place, there[:width], planes[14 + k, i])
        for x in range(quarter):
            share = np.int32(outside[2 * x]) + np.int32(outside[2 * x + 1])
            planes[19, 0, 2 * x] = np.int8(share * np.int32(STEPS // 4))
            planes[19, 0, 2 * x + 1] = np.int8(scale)
        for x in range(quarter):
            pixel = out[y, x]
            for i in range(4):
                pixel[2 * i] = twos[20 + i, 0, 2 * x]
                pixel[2 * i + 1] = twos[20 + i, 0, 2 * x + 1]
            for k in range(18):
                pixel[8 + 2 * k] = twos[k, 0, x]
                pixel[9 + 2 * k] = twos[k, 1, x]
            pixel[44] = twos[19, 0, x]
