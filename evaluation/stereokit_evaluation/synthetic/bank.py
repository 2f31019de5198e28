"""A bank of grey textures and of cut-out masks, each made from its number alone, when first asked for.

Every texture is 512 x 512, repeats, and has a mean of 128. A scene takes a few by number, scales, turns, mixes and
recolours them, so that a few hundred give no two surfaces alike. The photographs come with scikit-image.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.raster import MASK_SIZE

__all__ = ["KINDS", "LEVELS", "PHOTOGRAPHS", "SIZE", "STARTS", "TOTAL", "mask", "pyramid", "texture"]

Float = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Rng = np.random.Generator

SIZE = 512
"""Side of the finest level."""
LEVELS = 9
"""Levels of a pyramid, 512 down to 2."""
STARTS = np.cumsum([0] + [(SIZE >> level) ** 2 for level in range(LEVELS)])[:-1]
"""Where each level starts within a pyramid."""
TOTAL = sum((SIZE >> level) ** 2 for level in range(LEVELS))
"""Samples of a pyramid."""

PHOTOGRAPHS = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel", "hubble_deep_field", "retina", "rocket")
"""Photographs of scikit-image that are in the public domain or CC0."""


def _levelled(field: Float, deviation: float = 45.0) -> Bytes:
    """Return a field as bytes of mean 128 and the given standard deviation."""
    field = field - field.mean()
    return np.clip(np.rint(128 + field * (deviation / max(float(field.std()), 1e-9))), 0, 255).astype(np.uint8)


def _frequencies(stretch: float = 1.0) -> tuple[Float, Float, Float]:
    """Return the frequencies along x and y, and their length with y stretched; cycles per texture, (512, 257)."""
    fy, fx = np.fft.fftfreq(SIZE, 1 / SIZE)[:, None], np.fft.rfftfreq(SIZE, 1 / SIZE)[None]
    return fx, fy, np.sqrt((fx / stretch) ** 2 + (fy * stretch) ** 2)


def _spectral(rng: Rng, gain: Float) -> Float:
    """Return noise with an amplitude spectrum, (512, 512)."""
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE)))
    spectrum[0, 0] = 0
    return np.asarray(np.fft.irfft2(spectrum * gain, (SIZE, SIZE)))


def _fractal(rng: Rng) -> Float:
    """Return noise whose amplitude falls with a power of the frequency; some is stretched, some has no slow part."""
    stretch = float(np.exp(rng.uniform(-1.2, 1.2))) if rng.random() < 0.35 else 1.0
    _, _, f = _frequencies(stretch)
    gain = 1 / np.maximum(f, 1.0) ** rng.uniform(0.7, 2.2)
    if rng.random() < 0.4:
        gain = gain / (1 + (rng.uniform(4, 30) / np.maximum(f, 1.0)) ** 4)
    return _spectral(rng, gain)


def _speckle(rng: Rng) -> Float:
    """Return band-pass noise that is cut at a level: spots, camouflage, paint."""
    _, _, f = _frequencies()
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
        at, angle = rng.uniform(0, SIZE, 2), rng.uniform(0, 2 * np.pi)
        thick = float(rng.uniform(1, 7))
        for _ in range(int(rng.integers(20, 120))):
            angle += rng.normal(0, 0.35)
            to = at + 7 * np.array([np.cos(angle), np.sin(angle)])
            p, q = (tuple(int(v) for v in np.rint(e)) for e in (at, to))
            cv2.line(image, p, q, int(rng.integers(60, 255)), max(int(thick), 1), cv2.LINE_8)
            at, thick = to, thick * 0.985
    soft = cv2.blur(cv2.blur(image, (3, 3)), (3, 3)).astype(np.float64)
    _, _, f = _frequencies()
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
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    planks = int(rng.integers(1, 9))
    plank = np.floor(y * planks).astype(np.int64)
    slow = _unit(_spectral(rng, 1 / np.maximum(_frequencies(2.5)[2], 1.0) ** 2))
    rings = np.sin(2 * np.pi * (y * planks * rng.uniform(2, 9) + 0.7 * slow + rng.uniform(0, 1, planks)[plank]))
    fine = _unit(_spectral(rng, 1 / np.maximum(_frequencies(3.5)[2], 2.0)))
    gap = ((y * planks) % 1 < 0.03) * -2.5 if planks > 1 else 0.0
    shade = rng.normal(0, 0.7, planks)[plank]
    return np.asarray(rng.uniform(0.1, 0.8) * rings + rng.uniform(0.1, 0.6) * fine + shade + gap)


def _photograph(rng: Rng) -> Float:
    """Return a part of a photograph, mirrored or turned."""
    from stereokit_evaluation.synthetic.textures import photograph

    image: Any = photograph(PHOTOGRAPHS[int(rng.integers(len(PHOTOGRAPHS)))])
    if image.ndim == 3:
        weights = rng.uniform(0.2, 1, 3)
        image = image[..., :3] @ (weights / weights.sum())
    h, w = image.shape
    side = int(min(h, w) * rng.uniform(0.5, 1))
    top, left = int(rng.integers(h - side + 1)), int(rng.integers(w - side + 1))
    part = np.rot90(np.asarray(image, np.uint8)[top : top + side, left : left + side], int(rng.integers(4)))
    return cv2.resize(np.ascontiguousarray(part), (SIZE, SIZE), interpolation=cv2.INTER_AREA).astype(np.float64)


KINDS = {
    "fractal": _fractal, "speckle": _speckle, "tiles": _tiles, "stripes": _stripes, "print": _print,
    "cells": _cells, "strokes": _strokes, "collage": _collage, "vessels": _vessels, "facade": _facade,
    "weave": _weave, "wood": _wood, "photograph": _photograph,
}  # fmt: skip
"""Kinds of textures: functions of a generator that return a (512, 512) field."""


@lru_cache(maxsize=4)
def texture(kind: str, number: int) -> Bytes:
    """Return a texture, (512, 512) uint8 with mean 128; read-only."""
    rng = np.random.default_rng([11, list(KINDS).index(kind), number])
    image = _levelled(KINDS[kind](rng))
    image.setflags(write=False)
    return image


@lru_cache(maxsize=400)
def pyramid(kind: str, number: int) -> Bytes:
    """Return a texture and its halvings as one flat array of `TOTAL` uint8; read-only."""
    level: Any = texture(kind, number).astype(np.uint32)
    parts = []
    for _ in range(LEVELS):
        parts.append(level.astype(np.uint8).ravel())
        level = (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2] + 2) // 4
    flat = np.concatenate(parts)
    flat.setflags(write=False)
    return flat


@lru_cache(maxsize=256)
def mask(kind: str, number: int) -> Bytes:
    """Return a cut-out, (256, 256) uint8, 0 in its holes; read-only."""
    rng = np.random.default_rng([12, sum(ord(c) << k for k, c in enumerate(kind)), number])
    y, x = (np.mgrid[:MASK_SIZE, :MASK_SIZE] + 0.5) / MASK_SIZE * 2 - 1
    r, a = np.hypot(x, y), np.arctan2(y, x)
    if kind == "star":
        n = int(rng.integers(3, 10))
        out = r < 0.95 - rng.uniform(0.2, 0.6) * (0.5 - 0.5 * np.cos(n * a))
    elif kind == "disc":
        out = (r < 0.98) & (r > (rng.uniform(0.3, 0.8) if rng.random() < 0.4 else 0.0))
    elif kind == "shape":
        reach = 0.72 + sum(rng.normal(0, 0.12 / k) * np.cos(k * a + rng.uniform(0, 6)) for k in range(1, 7))
        out = r < reach
    elif kind == "holes":
        out = np.ones(x.shape, bool)
        for _ in range(int(rng.integers(2, 12))):
            u, v, s = rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), rng.uniform(0.06, 0.35)
            round_hole = np.hypot(x - u, y - v) < s
            out &= ~(round_hole if rng.random() < 0.6 else (np.abs(x - u) < s) & (np.abs(y - v) < s * 0.7))
    elif kind == "lattice":
        n, m, w = int(rng.integers(2, 14)), int(rng.integers(2, 14)), rng.uniform(0.08, 0.35)
        u, v = (x + y, x - y) if rng.random() < 0.4 else (x, y)
        out = ((u * n / 2) % 1 < w) | ((v * m / 2) % 1 < w)
    elif kind == "fence":
        n, w = int(rng.integers(6, 26)), rng.uniform(0.2, 0.6)
        out = ((x * n / 2) % 1 < w) & (y > -0.95 + 0.12 * np.abs(((x * n / 2) % 1) / w - 0.5))
        for v in (-0.6, 0.55):
            out |= np.abs(y - v) < 0.06
    elif kind == "leaf":
        out = np.abs(y) < rng.uniform(0.35, 0.8) * np.sqrt(np.clip(1 - x * x, 0, 1)) * (1 - 0.35 * x)
    elif kind == "foliage":
        out = np.zeros(x.shape, bool)
        for _ in range(int(rng.integers(14, 60))):
            u, v, t, s = rng.uniform(-0.85, 0.85), rng.uniform(-0.85, 0.85), rng.uniform(0, np.pi), rng.uniform(0.1, 0.28)
            p, q = (x - u) * np.cos(t) + (y - v) * np.sin(t), -(x - u) * np.sin(t) + (y - v) * np.cos(t)
            out |= (p / s) ** 2 + (q / (0.45 * s)) ** 2 < 1
        for _ in range(3):
            t = rng.uniform(0, np.pi)
            out |= (np.abs(-x * np.sin(t) + y * np.cos(t)) < 0.02) & (r < 0.9)
    elif kind == "blades":
        out = np.zeros(x.shape, bool)
        for _ in range(int(rng.integers(6, 22))):
            base, lean, w = rng.uniform(-0.7, 0.7), rng.normal(0, 0.3), rng.uniform(0.02, 0.07)
            top = rng.uniform(-0.95, 0.2)
            h = np.clip((1 - y) / (1 - top), 0, 1)
            out |= (np.abs(x - base - lean * h * h) < w * (1 - h)) & (y > top)
    elif kind == "letters":
        image = np.zeros(x.shape, np.uint8)
        word = "".join(chr(int(c)) for c in rng.integers(65, 91, 2))
        cv2.putText(image, word, (8, 200), cv2.FONT_HERSHEY_SIMPLEX, 5.5, 1, int(rng.integers(14, 34)), cv2.LINE_8)
        out = image > 0
    else:
        raise KeyError(kind)
    image = np.asarray(out, np.uint8)
    image.setflags(write=False)
    return image
