"""Masks that cut shapes out of sheets: stars, leaves, fences, lattices, letters, foliage."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.raster import MASK_SIZE

__all__ = ["CUTS", "mask"]

CUTS = ("star", "disc", "shape", "holes", "lattice", "fence", "leaf", "letters")
"""Masks that suit any sheet; ``"foliage"`` and ``"blades"`` are for plants."""


@lru_cache(maxsize=256)
def mask(kind: str, number: int) -> NDArray[np.uint8]:
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
            u, v, t, s = (
                rng.uniform(-0.85, 0.85),
                rng.uniform(-0.85, 0.85),
                rng.uniform(0, np.pi),
                rng.uniform(0.1, 0.28),
            )
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
