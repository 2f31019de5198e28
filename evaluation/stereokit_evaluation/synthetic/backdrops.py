"""Painted backdrops of the synthetic street: fronts of houses, the ground from above, and the sky."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.sprites import Colour, any_colour, blank, blotches, polygon, rectangle, shade

__all__ = ["facade", "ground", "sky"]

Bytes = NDArray[np.uint8]
Rng = np.random.Generator

_GLASS: Colour = (46, 60, 74)


def facade(
    rng: Rng, width_m: float, height_m: float, colour: Colour, *, bare: bool = False, scale: float = 40.0
) -> Bytes:
    """Return the front of a house, `scale` pixels per metre; `bare` leaves the plaster empty."""
    image = blank(width_m, height_m, scale, colour)
    if bare:
        rectangle(image, scale, 0, height_m - 0.5, width_m, height_m, shade(colour, 0.6))
        return image
    trim = shade(colour, float(rng.uniform(1.25, 1.5)))
    storey, bay = float(rng.uniform(2.9, 3.4)), float(rng.uniform(2.1, 2.9))
    bays = max(1, int(width_m / bay))
    bay = width_m / bays
    shutters: Colour = any_colour(rng, 50, 150)
    has_shutters = rng.random() < 0.4
    ground_floor = height_m - storey
    rectangle(image, scale, 0, ground_floor, width_m, height_m, shade(colour, 0.72))
    top = ground_floor
    while top > 0.3:
        rectangle(image, scale, 0, top - 0.12, width_m, top + 0.08, trim)
        for k in range(bays):
            u = (k + 0.5) * bay
            v = top - storey + 0.75
            _window(rng, image, scale, u, v, 1.15, 1.6, trim, shutters if has_shutters else None)
        top -= storey
    rectangle(image, scale, 0, 0, width_m, 0.3, shade(trim, 0.8))
    door = int(rng.integers(bays))
    for k in range(bays):
        u = (k + 0.5) * bay
        if k == door:
            wood: Colour = any_colour(rng, 40, 120)
            rectangle(image, scale, u - 0.7, height_m - 2.5, u + 0.7, height_m, trim)
            rectangle(image, scale, u - 0.55, height_m - 2.35, u + 0.55, height_m, wood)
            for row in (2.1, 1.1):
                for column in (-0.42, 0.06):
                    rectangle(
                        image, scale, u + column, height_m - row, u + column + 0.36, height_m - row + 0.8,
                        shade(wood, 0.7),
                    )  # fmt: skip
        else:
            _window(rng, image, scale, u, height_m - 2.3, 1.4, 1.5, trim, None)
    rectangle(image, scale, 0, height_m - 0.45, width_m, height_m, shade(colour, 0.5))
    return blotches(rng, image, 5.0)


def _window(
    rng: Rng, image: Bytes, scale: float, u: float, v: float, width: float, height: float, trim: Colour,
    shutters: Colour | None,
) -> None:  # fmt: skip
    """Draw a window whose top middle is at (u, v) metres."""
    half = width / 2
    rectangle(image, scale, u - half - 0.12, v - 0.12, u + half + 0.12, v + height + 0.12, trim)
    rectangle(image, scale, u - half, v, u + half, v + height, shade(_GLASS, float(rng.uniform(0.6, 1.5))))
    curtain = shade((178, 170, 158), float(rng.uniform(0.6, 1.1)))
    kind = rng.integers(4)
    if kind == 0:  # a roller blind, part of the way down
        stop = v + height * float(rng.uniform(0.3, 1.0))
        rectangle(image, scale, u - half, v, u + half, stop, curtain)
        for line in np.arange(v, stop, 0.12):
            rectangle(image, scale, u - half, line, u + half, line + 0.04, shade(curtain, 0.75))
    elif kind == 1:
        rectangle(image, scale, u - half, v, u - half + 0.3, v + height, curtain)
        rectangle(image, scale, u + half - 0.3, v, u + half, v + height, curtain)
    elif kind == 2:  # the sky in the upper part of the pane
        points = [(u - half, v), (u + half, v), (u + half, v + height * 0.25), (u - half, v + height * 0.65)]
        polygon(image, scale, points, (118, 138, 158))
    frame: Colour = (214, 211, 204)
    rectangle(image, scale, u - 0.04, v, u + 0.04, v + height, frame)
    rectangle(image, scale, u - half, v + height * 0.4 - 0.03, u + half, v + height * 0.4 + 0.03, frame)
    if shutters is not None:
        for side in (-half - 0.55, half + 0.05):
            rectangle(image, scale, u + side, v, u + side + 0.5, v + height, shutters)
            for line in np.arange(v + 0.08, v + height - 0.1, 0.16):
                rectangle(image, scale, u + side + 0.06, line, u + side + 0.44, line + 0.07, shade(shutters, 0.7))


def ground(rng: Rng, half_width_m: float, depth_m: float, kerb_m: float, cars: list[tuple[float, float]]) -> Bytes:
    """Return the street from above, far end first: road, markings, pavements, and the shadows below `cars`.

    `cars` are (X, Z of the near end), metres.
    """
    scale = 30.0
    image = blank(2 * half_width_m, depth_m, scale, (104, 104, 108))

    def strip(x0: float, x1: float, z0: float, z1: float, colour: Colour) -> None:
        rectangle(image, scale, x0 + half_width_m, depth_m - z1, x1 + half_width_m, depth_m - z0, colour)

    for side in (-1, 1):
        low, high = sorted((side * kerb_m, side * half_width_m))
        strip(low, high, 0, depth_m, (146, 138, 128))
        for line in np.arange(kerb_m + 0.15, half_width_m, 0.6):
            strip(side * line - 0.02, side * line + 0.02, 0, depth_m, (112, 106, 98))
        for z in np.arange(0, min(depth_m, 40.0), 0.6):
            strip(low, high, z, z + 0.045, (116, 110, 102))
        strip(side * kerb_m - 0.09, side * kerb_m + 0.09, 0, depth_m, (182, 178, 170))
        strip(side * kerb_m - 0.16 * side - 0.07, side * kerb_m - 0.16 * side + 0.07, 0, depth_m, (66, 66, 68))
        strip(side * (kerb_m - 2.1) - 0.06, side * (kerb_m - 2.1) + 0.06, 0, depth_m, (208, 206, 200))
    for z in np.arange(1.0 + float(rng.uniform(0, 2)), depth_m, 6.0):
        strip(-0.08, 0.08, z, z + 3.0, (222, 220, 212))
    crossing = float(rng.uniform(24, 32))
    for x in np.arange(-kerb_m + 0.4, kerb_m - 0.4, 1.0):
        strip(x, x + 0.5, crossing, crossing + 3.0, (214, 212, 206))
    for _ in range(9):  # repaired asphalt and covers
        x, z = float(rng.uniform(-kerb_m + 1, kerb_m - 1)), float(rng.uniform(4, 40))
        tone = float(rng.uniform(70, 92))
        if rng.random() < 0.4:
            centre = (round((x + half_width_m) * scale), round((depth_m - z) * scale))
            cv2.circle(image, centre, round(0.33 * scale), (72, 66, 60), -1)
            cv2.circle(image, centre, round(0.26 * scale), (94, 86, 78), 2)
        else:
            strip(x, x + float(rng.uniform(0.6, 2.0)), z, z + float(rng.uniform(1, 5)), (tone, tone, tone + 3))
    image = blotches(rng, image, 3.0)
    shadow: NDArray[Any] = np.ones((image.shape[0] // 4, image.shape[1] // 4), np.float32)
    for x, z in cars:
        near = (round((x - 1.05 + half_width_m) * scale / 4), round((depth_m - z - 4.5) * scale / 4))
        far = (round((x + 1.05 + half_width_m) * scale / 4), round((depth_m - z + 0.15) * scale / 4))
        cv2.rectangle(shadow, near, far, 0.25, -1)
    shadow = cv2.resize(cv2.GaussianBlur(shadow, (0, 0), 1.6), image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.multiply(image, cv2.merge([shadow] * 3), dtype=cv2.CV_8U), np.uint8)


def sky(rng: Rng) -> Bytes:
    """Return a summer sky, 128 x 512, from the horizon's haze up to a deeper blue."""
    height, width = 128, 512
    up = np.linspace(1, 0, height, dtype=np.float32)[:, None, None] ** np.float32(0.8)
    image = np.array([214, 224, 234], np.float32) + up * (np.array([96, 146, 206], np.float32) - [214, 224, 234])
    image = np.repeat(image, width, axis=1)
    cloud = np.zeros((height, width), np.float32)
    for cells, weight in ((5, 1.0), (11, 0.6), (24, 0.35), (50, 0.2)):
        noise = rng.standard_normal((max(2, cells // 2), cells), np.float32)
        cloud += weight * cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    share = np.clip(cloud - 0.1, 0, 1)[..., None] * np.float32(0.85)
    return np.asarray(np.clip(image + share * (np.float32(246) - image), 0, 255), np.uint8)
