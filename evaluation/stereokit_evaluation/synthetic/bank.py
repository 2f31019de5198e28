"""A bank of grey textures, each computed from its kind and number alone at its first use.

A scene takes a few, scales, turns, mixes and recolours them, so that a few hundred give no two surfaces alike.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.patterns import PATTERNS, SIZE
from stereokit_evaluation.synthetic.textures import photograph

__all__ = ["KINDS", "LEVELS", "PHOTOGRAPHS", "SIZE", "STARTS", "TOTAL", "cropped", "halvings", "pyramid", "texture"]

Float = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Rng = np.random.Generator

LEVELS = 9
"""Levels of a pyramid, 512 down to 2."""
STARTS = np.cumsum([0] + [(SIZE >> level) ** 2 for level in range(LEVELS)])[:-1]
"""Where each level starts within a pyramid."""
TOTAL = sum((SIZE >> level) ** 2 for level in range(LEVELS))
"""Samples of a pyramid."""

PHOTOGRAPHS = {
    "astronaut": "public domain (NASA)",
    "brick": "CC0 (CC0Textures)",
    "camera": "CC0 (Lav Varshney)",
    "chelsea": "CC0 (Stefan van der Walt)",
    "coffee": "CC0 (Rachel Michetti)",
    "grass": "CC0 (linolafett)",
    "gravel": "CC0 (CC0Textures)",
    "hubble_deep_field": "public domain (NASA)",
    "retina": "CC0 (Mikael Häggström)",
    "rocket": "public domain (SpaceX)",
}
"""Photographs that come with scikit-image and are free to use in any way, with their terms by its documentation.

Left out, because scikit-image names no clear terms: coins, moon, page, immunohistochemistry, and the Middlebury pair
``stereo_motorcycle``.
"""


def _levelled(field: Float, deviation: float = 45.0) -> Bytes:
    """Return a field as bytes of mean 128 and standard deviation `deviation`."""
    field = field - field.mean()
    return np.clip(np.rint(128 + field * (deviation / max(float(field.std()), 1e-9))), 0, 255).astype(np.uint8)


def _photograph(rng: Rng) -> Float:
    """Return a part of a photograph, mirrored or turned."""
    return _part(photograph(list(PHOTOGRAPHS)[int(rng.integers(len(PHOTOGRAPHS)))]), rng)


def cropped(image: Bytes, rng: Rng) -> Bytes:
    """Return a part of a picture, (H, W) or (H, W, 3), as a texture."""
    return _levelled(_part(image, rng))


def _part(image: Any, rng: Rng) -> Float:
    if image.ndim == 3:
        weights = rng.uniform(0.2, 1, 3)
        image = image[..., :3] @ (weights / weights.sum())
    h, w = image.shape
    side = int(min(h, w) * rng.uniform(0.5, 1))
    top, left = int(rng.integers(h - side + 1)), int(rng.integers(w - side + 1))
    part = np.rot90(np.asarray(image, np.uint8)[top : top + side, left : left + side], int(rng.integers(4)))
    return cv2.resize(np.ascontiguousarray(part), (SIZE, SIZE), interpolation=cv2.INTER_AREA).astype(np.float64)


KINDS = (*PATTERNS, "photograph")
"""Kinds of textures."""


@lru_cache(maxsize=4)
def texture(kind: str, number: int) -> Bytes:
    """Return a texture, (512, 512) uint8 with mean 128; read-only."""
    rng = np.random.default_rng([11, KINDS.index(kind), number])
    image = _levelled(PATTERNS[kind](rng) if kind in PATTERNS else _photograph(rng))
    image.setflags(write=False)
    return image


@lru_cache(maxsize=400)
def pyramid(kind: str, number: int) -> Bytes:
    """Return a texture and its halvings as one flat array of `TOTAL` uint8; read-only."""
    return halvings(texture(kind, number))


def halvings(image: Bytes) -> Bytes:
    """Return the pyramid of a texture (512, 512) as `pyramid` does."""
    level: Any = image.astype(np.uint32)
    parts = []
    for _ in range(LEVELS):
        parts.append(level.astype(np.uint8).ravel())
        level = (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2] + 2) // 4
    flat = np.concatenate(parts)
    flat.setflags(write=False)
    return flat
