"""Patterns that are drawn by rule: noise of many spectra, tiles, stripes, print, stones, strokes, cloth, wood, windows.

Each is a function of a generator that returns a (SIZE, SIZE) float64 field of any range, which repeats.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["PATTERNS", "SIZE"]

Float = NDArray[np.float64]
Rng = np.random.Generator

SIZE = 512
"""Side of a pattern."""


def _frequencies(stretch: float = 1.0) -> Float:
    """Return the length of each frequency, `stretch` times longer down than across; cycles per texture, (512, 257)."""
    fy, fx = np.fft.fftfreq(SIZE, 1 / SIZE)[:, None], np.fft.rfftfreq(SIZE, 1 / SIZE)[None]
    return np.asarray(np.sqrt((fx / stretch) ** 2 + (fy * stretch) ** 2))


def _spectral(rng: Rng, gain: Float) -> Float:
    """Return noise with an amplitude spectrum, (512, 512)."""
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE)))
    spectrum[0, 0] = 0
    return np.asarray(np.fft.irfft2(spectrum * gain, (SIZE, SIZE)))


def _fractal(rng: Rng) -> Float:
    """Return noise whose amplitude falls with a power of the frequency; some is stretched, some has no slow part."""
    stretch = float(np.exp(rng.uniform(-1.2, 1.2))) if rng.random() < 0.35 else 1.0
    f = _frequencies(stretch)
    gain = 1 / np.maximum(f, 1.0) ** rng.uniform(0.7, 2.2)
    if rng.random() < 0.4:
        gain = gain / (1 + (rng.uniform(4, 30) / np.maximum(f, 1.0)) ** 4)
    return _spectral(rng, gain)


def _speckle(rng: Rng) -> Float:
    """Return band-pass noise that is cut at a level: spots, camouflage, paint."""
    f = _frequencies()
    centre = np.exp(rng.uniform(np.log(5), np.log(90)))
    field = _spectral(rng, np.exp(-(((np.maximum(f, 0.1) - centre) / (0.4 * centre)) ** 2)))
    field /= field.std()
    sharp = rng.uniform(1, 8)
    out = np.tanh((field - rng.uniform(-0.8, 1.2)) * sharp)
    return np.asarray(out + 0.3 * _fractal(rng) / 30)


def _tiles(rng: Rng) -> Float:
    """Return bricks or tiles with joints; each has its own brightness."""
    rows, columns = int(rng.integers(4, 33)), int(rng.integers(3, 25))
    shift = float(rng.choice([0.0, 0.5, 0.33]))
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    row = np.floor(y * rows).astype(np.int64)
    along = (x * columns + shift * (row % 2)) % columns
    column = np.floor(along).astype(np.int64)
    body = rng.normal(0, rng.uniform(0, 1), (rows, columns))[row, column % columns]
    joint = rng.uniform(0.02, 0.15)
    edge = ((y * rows) % 1 < joint) | (along % 1 < joint * rows / columns * 0.8)
    out = np.where(edge, rng.choice([-1, 1]) * rng.uniform(0.8, 3.0), body)
    return np.asarray(out + rng.uniform(0.05, 0.5) * _unit(_fractal(rng)))


def _unit(field: Float) -> Float:
    return np.asarray((field - field.mean()) / max(float(field.std()), 1e-9))


def _stripes(rng: Rng) -> Float:
    """Return stripes, checks or a plaid."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    kind = int(rng.integers(4))
    n, m = int(rng.integers(4, 48)), int(rng.integers(4, 48))
    if kind == 0:
        out = ((x * n) % 1 < rng.uniform(0.2, 0.8)).astype(np.float64)
    elif kind == 1:
        out = (np.floor(x * 2 * (n // 2)) + np.floor(y * 2 * (m // 2))) % 2
    elif kind == 2:
        profile = np.repeat(rng.normal(size=64), 8)
        out = profile[None] + profile[::-1, None]
    else:
        out = np.sin(2 * np.pi * n * x) + rng.uniform(0, 1) * np.sin(2 * np.pi * m * y)
    return np.asarray(_unit(out) + rng.uniform(0.0, 0.4) * _unit(_fractal(rng)))


def _print(rng: Rng) -> Float:
    """Return lines of marks as on a printed page: words, gaps, headings, pictures."""
    out = np.zeros((SIZE, SIZE), np.float64)
    y = 8
    while y < SIZE - 16:
        size = int(rng.integers(4, 10)) if rng.random() < 0.85 else int(rng.integers(12, 40))
        x = int(rng.integers(6, 40))
        while x < SIZE - 12:
            word = int(rng.integers(2, 9))
            for _ in range(word):
                if x > SIZE - size:
                    break
                glyph = rng.random((max(size // 2, 3), 3)) < 0.62
                patch = cv2.resize(glyph.astype(np.uint8), (max(size - 2, 2), size), interpolation=cv2.INTER_NEAREST)
                part = out[y : y + size, x : x + patch.shape[1]]
                part -= 2.0 * patch[: part.shape[0], : part.shape[1]]
                x += size
            x += size
        y += int(size * rng.uniform(1.5, 2.2))
    if rng.random() < 0.5:
        h, w = rng.integers(60, 240, 2)
        top, left = rng.integers(0, SIZE - 240, 2)
        out[top : top + h, left : left + w] = _unit(_fractal(rng))[:h, :w]
    return out + 0.05 * _unit(_fractal(rng))


def _cells(rng: Rng) -> Float:
    """Return the cells of scattered points: stones, cracked ground, scales."""
    count = int(np.exp(rng.uniform(np.log(30), np.log(1500))))
    seeds = rng.integers(0, SIZE, (count, 2))
    image = np.full((SIZE, SIZE), 255, np.uint8)
    image[seeds[:, 0], seeds[:, 1]] = 0
    wide = cv2.copyMakeBorder(image, 128, 128, 128, 128, cv2.BORDER_WRAP)
    far, labels = cv2.distanceTransformWithLabels(wide, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    far, labels = far[128:-128, 128:-128].astype(np.float64), labels[128:-128, 128:-128]
    shade = rng.normal(0, 1, int(labels.max()) + 1)[labels]
    depth = -far / np.sqrt(SIZE * SIZE / count)
    mix = rng.uniform(0, 1)
    return np.asarray(mix * shade + (1 - mix) * 3 * depth + 0.15 * _unit(_fractal(rng)))


def _strokes(rng: Rng) -> Float:
    """Return many short strokes: grass, straw, fur, scratches, hair."""
    image = np.full((SIZE, SIZE), 128, np.uint8)
    count, length = int(rng.integers(400, 4000)), np.exp(rng.uniform(np.log(8), np.log(120)))
    main, spread = rng.uniform(0, np.pi), rng.uniform(0.05, 1.6)
    start = rng.integers(0, SIZE, (count, 2))
    angle = main + spread * rng.standard_normal(count)
    reach = length * rng.uniform(0.4, 1.6, count)
    end = start + np.stack([np.rint(np.cos(angle) * reach), np.rint(np.sin(angle) * reach)], axis=1).astype(np.int64)
    bright = rng.integers(20, 236, count)
    thick = rng.integers(1, 4, count)
    for k in range(count):
        p, q = tuple(int(v) for v in start[k]), tuple(int(v) for v in end[k])
        cv2.line(image, p, q, int(bright[k]), int(thick[k]), cv2.LINE_8)
    return image.astype(np.float64)


def _collage(rng: Rng) -> Float:
    """Return overlapping flat shapes: posters, toys, packaging."""
    image = np.full((SIZE, SIZE), int(rng.integers(40, 220)), np.uint8)
    for _ in range(int(rng.integers(8, 90))):
        centre = tuple(int(v) for v in rng.integers(0, SIZE, 2))
        reach = int(np.exp(rng.uniform(np.log(6), np.log(140))))
        bright, kind = int(rng.integers(0, 256)), int(rng.integers(4))
        if kind == 0:
            cv2.circle(image, centre, reach, bright, -1 if rng.random() < 0.7 else int(rng.integers(1, 8)), cv2.LINE_8)
        elif kind == 1:
            other = (centre[0] + reach, centre[1] + int(reach * rng.uniform(0.2, 2)))
            cv2.rectangle(image, centre, other, bright, -1 if rng.random() < 0.7 else int(rng.integers(1, 8)))
        elif kind == 2:
            corners = np.array(centre) + rng.integers(-reach, reach + 1, (int(rng.integers(3, 7)), 2))
            cv2.fillPoly(image, [corners.astype(np.int32)], bright, cv2.LINE_8)
        else:
            other = (centre[0] + int(rng.integers(-200, 200)), centre[1] + int(rng.integers(-200, 200)))
            cv2.line(image, centre, other, bright, int(rng.integers(1, 10)), cv2.LINE_8)
    return image.astype(np.float64) + rng.uniform(0, 12) * _unit(_fractal(rng))


def _vessels(rng: Rng) -> Float:
    """Return dark branching lines on a cloudy ground: living tissue, marble, cracks."""
    image = np.zeros((SIZE, SIZE), np.uint8)
    for _ in range(int(rng.integers(6, 40))):
        position, angle = rng.uniform(0, SIZE, 2), rng.uniform(0, 2 * np.pi)
        thick = float(rng.uniform(1, 7))
        for _ in range(int(rng.integers(20, 120))):
            angle += rng.normal(0, 0.35)
            to = position + 7 * np.array([np.cos(angle), np.sin(angle)])
            p, q = (tuple(int(v) for v in np.rint(e)) for e in (position, to))
            cv2.line(image, p, q, int(rng.integers(60, 255)), max(int(thick), 1), cv2.LINE_8)
            position, thick = to, thick * 0.985
    soft = cv2.blur(cv2.blur(image, (3, 3)), (3, 3)).astype(np.float64)
    f = _frequencies()
    return -soft / 60 * rng.uniform(0.3, 1.5) + _unit(_spectral(rng, 1 / np.maximum(f, 1.0) ** rng.uniform(1.4, 2.4)))


def _facade(rng: Rng) -> Float:
    """Return a front of repeated windows."""
    rows, columns = int(rng.integers(3, 12)), int(rng.integers(3, 14))
    out = np.zeros((SIZE, SIZE), np.float64)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    cell_y, cell_x = (y * rows) % 1, (x * columns) % 1
    low, high = np.sort(rng.uniform(0.1, 0.9, 2))
    w = rng.uniform(0.25, 0.85)
    pane = (cell_y > low) & (cell_y < max(high, low + 0.25)) & (np.abs(cell_x - 0.5) < w / 2)
    frame = (cell_y > low - 0.05) & (cell_y < max(high, low + 0.25) + 0.05) & (np.abs(cell_x - 0.5) < w / 2 + 0.05)
    row, column = np.floor(y * rows).astype(np.int64), np.floor(x * columns).astype(np.int64)
    glass = rng.normal(-2.0, rng.uniform(0.05, 0.9), (rows, columns))[row, column]
    out[frame] = rng.uniform(-0.5, 2)
    out[pane] = glass[pane]
    if rng.random() < 0.6:
        out[pane & (np.abs(cell_x - 0.5) < 0.02)] = 1.0
    return np.asarray(out + rng.uniform(0.05, 0.3) * _unit(_fractal(rng)))


def _weave(rng: Rng) -> Float:
    """Return a woven pattern: cloth, baskets, chairs of cane."""
    n = int(rng.integers(8, 64))
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    over = (np.floor(x * n) + np.floor(y * n)) % 2
    bow = np.where(over > 0, np.abs(((x * n) % 1) - 0.5), np.abs(((y * n) % 1) - 0.5))
    shade = rng.normal(0, 0.4, (n, n))[np.floor(y * n).astype(np.int64), np.floor(x * n).astype(np.int64)]
    return np.asarray(-3 * bow + shade + rng.uniform(0, 0.6) * _unit(_fractal(rng)))


def _wood(rng: Rng) -> Float:
    """Return planks with grain."""
    y = np.mgrid[:SIZE, :SIZE][0] / SIZE
    planks = int(rng.integers(1, 9))
    plank = np.floor(y * planks).astype(np.int64)
    slow = _unit(_spectral(rng, 1 / np.maximum(_frequencies(2.5), 1.0) ** 2))
    rings = np.sin(2 * np.pi * (y * planks * rng.uniform(2, 9) + 0.7 * slow + rng.uniform(0, 1, planks)[plank]))
    fine = _unit(_spectral(rng, 1 / np.maximum(_frequencies(3.5), 2.0)))
    gap = ((y * planks) % 1 < 0.03) * -2.5 if planks > 1 else 0.0
    shade = rng.normal(0, 0.7, planks)[plank]
    return np.asarray(rng.uniform(0.1, 0.8) * rings + rng.uniform(0.1, 0.6) * fine + shade + gap)


PATTERNS: dict[str, Callable[[Rng], Float]] = {
    "fractal": _fractal, "speckle": _speckle, "tiles": _tiles, "stripes": _stripes, "print": _print,
    "cells": _cells, "strokes": _strokes, "collage": _collage, "vessels": _vessels, "facade": _facade,
    "weave": _weave, "wood": _wood,
}  # fmt: skip
"""All patterns by name."""
