"""Painted cut-outs for the synthetic street: cars, trees, people, signs, hedges; and the brush they share.

They are plain drawings; the photographs' grain on top gives a matcher what a street gives it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.textures import photograph

__all__ = [
    "Colour",
    "any_colour",
    "blank",
    "blotches",
    "car_end",
    "car_side",
    "hedge",
    "person",
    "polygon",
    "rectangle",
    "shade",
    "sign",
    "tree",
]

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Colour = tuple[float, float, float]
Rng = np.random.Generator

_GLASS: Colour = (46, 60, 74)
_DARK: Colour = (26, 26, 29)


def rectangle(image: Bytes, scale: float, u0: float, v0: float, u1: float, v1: float, colour: Any) -> None:
    """Fill a rectangle in metres, `scale` pixels each."""
    a, b = (round(u0 * scale), round(v0 * scale)), (round(u1 * scale) - 1, round(v1 * scale) - 1)
    if b[0] >= a[0] and b[1] >= a[1]:
        cv2.rectangle(image, a, b, tuple(float(c) for c in np.atleast_1d(colour)), -1)


def polygon(image: Bytes, scale: float, points: Any, colour: Any) -> None:
    """Fill a polygon with corners in metres."""
    corners = np.round(np.asarray(points, np.float64) * scale).astype(np.int32)
    cv2.fillPoly(image, [corners], tuple(float(c) for c in np.atleast_1d(colour)))


def any_colour(rng: Rng, low: float, high: float) -> Colour:
    """Return a colour whose channels lie in [low, high)."""
    r, g, b = rng.uniform(low, high, 3)
    return float(r), float(g), float(b)


def shade(colour: Colour, factor: float) -> Colour:
    """Return a colour made brighter or darker."""
    r, g, b = (min(255.0, c * factor) for c in colour)
    return r, g, b


def blank(width_m: float, height_m: float, scale: float, colour: Colour) -> Bytes:
    """Return an image of one colour, `scale` pixels to a metre."""
    shape = (max(8, round(height_m * scale)), max(8, round(width_m * scale)), 3)
    return np.full(shape, np.asarray(colour, np.float64).astype(np.uint8), np.uint8)


def blotches(rng: Rng, image: Bytes, amount: float) -> Bytes:
    """Return `image` with band-limited brightness noise of several octaves, `amount` grey levels."""
    height, width = (max(2, size // 3) for size in image.shape[:2])
    total = np.zeros((height, width), np.float32)
    for cells, weight in ((4, 1.0), (12, 0.8), (36, 0.6), (90, 0.5)):
        rows, columns = min(height, max(2, cells * height // width + 2)), min(width, cells + 2)
        noise = rng.standard_normal((rows, columns), np.float32)
        total += np.float32(amount * weight) * cv2.resize(noise, (width, height), interpolation=cv2.INTER_LINEAR)
    total = cv2.resize(total, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.add(image, cv2.merge([total] * 3), dtype=cv2.CV_8U), np.uint8)


def car_end(colour: Colour, *, front: bool) -> tuple[Bytes, Mask]:
    """Return the rear or the front of a car, 1.8 x 1.55 m, and its outline."""
    scale, width, height = 110.0, 1.8, 1.55
    image = blank(width, height, scale, colour)
    mask = np.zeros(image.shape[:2], np.uint8)
    outline = [
        (0.02, 0.72),
        (0.22, 0.12),
        (0.4, 0.0),
        (1.4, 0.0),
        (1.58, 0.12),
        (1.78, 0.72),
        (1.8, 1.3),
        (0, 1.3),
    ]
    polygon(mask, scale, outline, 1)
    for u in (0.06, 1.5):
        rectangle(mask, scale, u, 1.2, u + 0.24, 1.55, 1)
    rectangle(image, scale, 0, 1.28, width, height, _DARK)
    polygon(image, scale, [(0.2, 0.66), (0.38, 0.12), (1.42, 0.12), (1.6, 0.66)], _GLASS)
    polygon(image, scale, [(0.75, 0.66), (1.0, 0.12), (1.2, 0.12), (0.95, 0.66)], shade(_GLASS, 1.7))
    rectangle(image, scale, 0, 0.7, width, 0.73, shade(colour, 0.55))
    rectangle(image, scale, 0, 1.08, width, 1.28, shade(colour, 0.62))
    lamp: Colour = (236, 234, 218) if front else (178, 26, 30)
    for u in (0.05, 1.41):
        rectangle(image, scale, u, 0.78, u + 0.34, 0.98, lamp)
        rectangle(
            image,
            scale,
            u + (0.22 if u < 1 else 0.02),
            0.8,
            u + (0.32 if u < 1 else 0.12),
            0.96,
            (214, 140, 40),
        )
    if front:
        for v in (0.82, 0.88, 0.94):
            rectangle(image, scale, 0.5, v, 1.3, v + 0.04, _DARK)
    else:
        rectangle(image, scale, 0.2, 0.66, 1.6, 0.68, shade(colour, 1.25))
    rectangle(image, scale, 0.62, 1.1, 1.18, 1.22, (226, 226, 220))
    for k in range(6):
        rectangle(image, scale, 0.68 + 0.08 * k, 1.12, 0.72 + 0.08 * k, 1.2, _DARK)
    return image, mask > 0


def car_side(colour: Colour, *, van: bool) -> tuple[Bytes, Mask]:
    """Return the side of an estate car, or of a van, 4.3 x 1.55 m, and its outline.

    The estate car has its rear at the left, the van, upright at both ends, its front.
    """
    scale, width, height = 80.0, 4.3, 1.55
    image = blank(width, height, scale, colour)
    mask = np.zeros(image.shape[:2], np.uint8)
    bonnet = [(3.9, 0.0), (4.18, 0.06), (4.28, 0.6)] if van else [(2.2, 0.0), (2.55, 0.1), (3.15, 0.62), (4.1, 0.76)]
    pane = [(4.0, 0.12), (4.1, 0.62)] if van else [(2.2, 0.12), (2.45, 0.2), (2.95, 0.62)]
    outline = [(0.0, 0.72), (0.12, 0.06), (0.3, 0.0), *bonnet, (4.3, 0.95), (4.3, 1.3), (0.0, 1.3)]
    polygon(mask, scale, outline, 1)
    polygon(image, scale, [(0.3, 0.62), (0.4, 0.12), *pane], _GLASS)
    polygon(image, scale, [(0.6, 0.62), (0.9, 0.12), (1.1, 0.12), (0.8, 0.62)], shade(_GLASS, 1.7))
    for u in (1.02, 1.98, 2.95):
        rectangle(image, scale, u, 0.1, u + 0.09, 0.64, colour)
    for u in (1.06, 2.02, 3.1):
        rectangle(image, scale, u, 0.64, u + 0.02, 1.24, shade(colour, 0.55))
    for u in (1.12, 2.08):
        rectangle(image, scale, u, 0.74, u + 0.2, 0.78, shade(colour, 0.5))
    rectangle(image, scale, 0, 0.68, 4.2, 0.7, shade(colour, 1.3))
    rectangle(image, scale, 0, 1.2, width, height, _DARK)
    lamps: list[Colour] = [(178, 26, 30), (236, 234, 218)]
    for u, lamp in ((0.0, lamps[van]), (4.12, lamps[not van])):
        rectangle(image, scale, u, 0.8, u + 0.18, 0.98, lamp)
    for u in (0.85, 3.45):
        centre = (round(u * scale), round(1.23 * scale))
        cv2.circle(image, centre, round(0.37 * scale), _DARK, -1)
        cv2.circle(mask, centre, round(0.32 * scale), 1, -1)
        cv2.circle(image, centre, round(0.2 * scale), (156, 158, 162), -1)
        for angle in range(0, 180, 36):
            cv2.ellipse(image, centre, (round(0.2 * scale), 1), angle, 0, 360, _DARK, -1)
    return image, mask > 0


def tree(rng: Rng, width_m: float, height_m: float, hue: Colour, *, scale: float = 44.0) -> tuple[Bytes, Mask]:
    """Return a street tree, its trunk on the middle of the lower edge, and its outline."""
    image = blank(width_m, height_m, scale, (62, 52, 42))
    mask = np.zeros(image.shape[:2], np.uint8)
    middle, crown = width_m / 2, height_m * 0.36
    trunk = [
        (middle - 0.1, 0.3 * height_m),
        (middle + 0.1, 0.3 * height_m),
        (middle + 0.16, height_m),
        (middle - 0.16, height_m),
    ]
    polygon(mask, scale, trunk, 1)
    for _ in range(7):
        end = (middle + rng.uniform(-0.34, 0.34) * width_m, rng.uniform(0.12, 0.4) * height_m)
        start = (round(middle * scale), round(0.66 * height_m * scale))
        cv2.line(mask, start, (round(end[0] * scale), round(end[1] * scale)), 1, max(1, round(scale / 15)))
    count = 330
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(0, 1, count))
    u = middle + np.cos(angle) * radius * width_m * 0.41
    v = crown + np.sin(angle) * radius * height_m * 0.29
    for k in np.argsort(-v):  # the lit upper leaves last
        size = rng.uniform(0.12, 0.34)
        light = min(1.6, max(0.3, 1.25 - 0.75 * v[k] / (0.72 * height_m) + rng.normal(0, 0.14)))
        axes = (round(size * scale), round(size * scale * rng.uniform(0.5, 1.0)))
        centre = (round(u[k] * scale), round(v[k] * scale))
        turn = float(rng.uniform(0, 180))
        cv2.ellipse(image, centre, axes, turn, 0, 360, shade(hue, light), -1)
        cv2.ellipse(mask, centre, axes, turn, 0, 360, 1, -1)
    return blotches(rng, image, 9.0), mask > 0


def person(rng: Rng) -> tuple[Bytes, Mask]:
    """Return someone walking, 0.8 x 1.8 m, and the outline."""
    scale = 110.0
    coat: Colour = any_colour(rng, 40, 220)
    legs: Colour = any_colour(rng, 30, 90)
    image = blank(0.8, 1.8, scale, coat)
    mask = np.zeros(image.shape[:2], np.uint8)
    parts = [
        ([(0.3, 0.9), (0.52, 0.9), (0.32, 1.76), (0.14, 1.76)], legs),
        ([(0.34, 0.9), (0.54, 0.9), (0.68, 1.76), (0.52, 1.76)], shade(legs, 0.8)),
        ([(0.1, 1.72), (0.32, 1.72), (0.32, 1.8), (0.08, 1.8)], _DARK),
        ([(0.5, 1.72), (0.7, 1.72), (0.74, 1.8), (0.5, 1.8)], _DARK),
        ([(0.24, 0.3), (0.56, 0.3), (0.64, 0.42), (0.58, 1.0), (0.26, 1.0), (0.2, 0.42)], coat),
        ([(0.22, 0.4), (0.3, 0.42), (0.2, 0.9), (0.1, 0.88)], shade(coat, 0.75)),
        ([(0.52, 0.42), (0.62, 0.4), (0.72, 0.86), (0.62, 0.9)], shade(coat, 0.8)),
        ([(0.36, 0.42), (0.46, 0.42), (0.46, 0.98), (0.36, 0.98)], shade(coat, 1.25)),
    ]
    for points, colour in parts:
        polygon(image, scale, points, colour)
        polygon(mask, scale, points, 1)
    centre = (round(0.4 * scale), round(0.16 * scale))
    cv2.ellipse(mask, centre, (round(0.1 * scale), round(0.14 * scale)), 0, 0, 360, 1, -1)
    cv2.ellipse(image, centre, (round(0.11 * scale), round(0.16 * scale)), 0, 0, 360, (202, 160, 132), -1)
    cv2.ellipse(image, centre, (round(0.11 * scale), round(0.16 * scale)), 0, 180, 360, (58, 40, 28), -1)
    return image, mask > 0


def sign(rng: Rng) -> tuple[Bytes, Mask]:
    """Return a round or a triangular road sign, 0.8 x 0.8 m, and its outline."""
    scale = 110.0
    image = blank(0.8, 0.8, scale, (188, 24, 30))
    mask = np.zeros(image.shape[:2], np.uint8)
    centre = (round(0.4 * scale), round(0.4 * scale))
    if rng.random() < 0.5:
        cv2.circle(mask, centre, round(0.4 * scale), 1, -1)
        cv2.circle(image, centre, round(0.3 * scale), (232, 232, 228), -1)
        cv2.putText(image, "30", (round(0.2 * scale), round(0.52 * scale)), cv2.FONT_HERSHEY_SIMPLEX, 1.15, _DARK, 4)
    else:
        polygon(mask, scale, [(0.0, 0.74), (0.4, 0.02), (0.8, 0.74)], 1)
        polygon(image, scale, [(0.16, 0.65), (0.4, 0.22), (0.64, 0.65)], (232, 232, 228))
        rectangle(image, scale, 0.37, 0.34, 0.43, 0.52, _DARK)
        rectangle(image, scale, 0.37, 0.55, 0.43, 0.61, _DARK)
    return image, mask > 0


def hedge(rng: Rng, width_m: float, height_m: float) -> Bytes:
    """Return a strip of leaves, from the photograph of grass."""
    grey = photograph("grass").astype(np.float32)
    rows = round(min(512, 512 * height_m / 2))
    strip = grey[:rows, : round(min(512, 512 * width_m / 4))]
    tint = np.array([0.62, 0.92, 0.4], np.float32) * np.float32(rng.uniform(0.75, 1.0))
    return np.asarray(np.clip(strip[..., None] * tint, 0, 255), np.uint8)
