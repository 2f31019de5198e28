"""Outdoors at eye height, under the sky: roads, and rough ground with plants and rocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.meshes import blob, box, cards, heightfield, merge, rotation, sheet
from stereokit_evaluation.synthetic.roadside import car, fence, front, hedge, pole
from stereokit_evaluation.synthetic.stage import Stage
from stereokit_evaluation.synthetic.terrain import relief
from stereokit_evaluation.synthetic.things import bumps, solid, standing, tree, wire

__all__ = ["garden", "road"]

Float = NDArray[np.float64]


def _daylight(stage: Stage, reach: float) -> None:
    """Light from the sky, and mostly from the sun, with its shadows up to `reach` metres around."""
    rng = stage.rng
    sunny = rng.random() < 0.65
    sky = float(rng.choice([0.9, 1.6, 3.0]))
    stage.light = {
        "sun": float(rng.uniform(0.6, 1.8)) if sunny else 0.0,
        "sun_x": float(rng.normal(0, 0.9)),
        "sun_y": -float(rng.uniform(0.35, 1.3)),
        "sun_z": float(rng.normal(-0.3, 0.8)),
        "ambient": float(rng.uniform(0.2, 0.5)) if sunny else float(rng.uniform(0.6, 0.9)),
        "sky_low": sky,
        "sky_high": sky * float(rng.uniform(0.35, 1.0)),
        "clouds": float(rng.choice([0.0, 0.2, 0.8])) * sky,
        "around": stage.slot(str(rng.choice(["fractal", "facade", "photograph", "speckle"]))),
        "around_level": float(rng.integers(1, 5)),
        "around_gain": float(rng.uniform(0.6, 1.8)),
        "fog": float(rng.choice([0.0, 0.002, 0.008, 0.02], p=[0.5, 0.3, 0.15, 0.05])),
        "fog_brightness": 0.6 * sky,
    }
    if sunny:
        stage.shadows, stage.shadow_centre = reach, np.array([0.0, 0.0, reach * 0.8])


def road(stage: Stage) -> None:
    """Fill `stage` with a road between fronts, trees, fences and cars."""
    rng = stage.rng
    stage.plain = float(rng.choice([0.02, 0.1, 0.25]))
    stage.field_of_view = float(rng.uniform(0.6, 1.5))
    eye = float(rng.uniform(1.1, 2.4))
    stage.place = np.array([0.0, -eye, 0.0])
    stage.look(float(rng.normal(0, 0.15)), float(rng.normal(-0.07, 0.07)), float(rng.normal(0, 0.01)))
    _daylight(stage, float(rng.uniform(14, 40)))
    weak, wet = rng.random() < 0.5, float(rng.choice([0.0, rng.uniform(0.02, 0.12)], p=[0.8, 0.2]))
    asphalt = stage.paint(
        str(rng.choice(["fractal", "speckle", "cells"])),
        float(rng.uniform(0.5, 4)),
        float(rng.uniform(0.15, 0.5)),
        float(rng.uniform(0.1, 0.3)) if weak else float(rng.uniform(0.3, 0.8)),
        mirror=wet,
        plain=False,
    )
    verge = stage.paint(
        str(rng.choice(["strokes", "fractal", "tiles", "cells"])),
        float(rng.uniform(0.8, 3)),
        float(rng.uniform(0.15, 0.6)),
    )
    half = float(rng.uniform(2.5, 6))
    for side in (-1, 1):
        stage.add(box(40, 0.3, 260), verge, None, None, (side * (half + 20), 0.05 if rng.random() < 0.5 else 0.14, 115))
    stage.add(heightfield(np.zeros((2, 2)), half * 2, 260).moved(None, (0, 0, -5)), asphalt)
    white = stage.paint("fractal", 0.4, 0.75, 0.2, plain=bool(rng.random() < 0.5))
    if rng.random() < 0.8:
        lines = [
            sheet(0.13, float(rng.uniform(1.5, 3))).moved(rotation(0, np.pi / 2), (0, -0.004, 3 + 6.0 * k))
            for k in range(12)
        ]
        lines += [sheet(0.12, 200).moved(rotation(0, np.pi / 2), (s * (half - 0.3), -0.004, 100)) for s in (-1, 1)]
        stage.add(merge(lines), white)
    for side in (-1, 1):
        kind, gap = rng.random(), half + float(rng.uniform(1.5, 8))
        z = float(rng.uniform(-4, 4))
        while z < 70 and kind < 0.75:
            w = float(rng.uniform(6, 18))
            if kind < 0.5 or rng.random() < 0.5:
                front(stage, w, float(rng.uniform(4, 16)), np.array([side * gap, 0, z + w / 2]), side * np.pi / 2)
            z += w + (float(rng.uniform(1, 8)) if rng.random() < 0.4 else 0)
        for _ in range(int(rng.integers(0, 8))):
            tree(
                stage,
                float(rng.uniform(3, 11)),
                np.array([side * (half + rng.uniform(0.8, 12)), 0, rng.uniform(4, 60)]),
                bool(rng.random() < 0.8),
            )
        for _ in range(int(rng.integers(0, 3))):
            x, z0 = side * (half + rng.uniform(0.5, 4)), float(rng.uniform(2, 30))
            a, b = np.array([x, 0, z0]), np.array([x + rng.normal(0, 1), 0, z0 + rng.uniform(4, 20)])
            (hedge if rng.random() < 0.5 else fence)(stage, a, b, float(rng.uniform(0.7, 2)))
        for _ in range(int(rng.integers(0, 6))):
            pole(stage, np.array([side * (half + rng.uniform(0.1, 2)), 0, rng.uniform(3, 40)]))
        z = float(rng.uniform(3, 12))
        while z < 45 and rng.random() < 0.75:
            car(
                stage,
                np.array([side * (half - 1.1), 0, z]),
                float(rng.normal(0, 0.05)) + (np.pi if rng.random() < 0.5 else 0),
            )
            z += float(rng.uniform(5.2, 14))
    for _ in range(int(rng.integers(0, 3))):
        car(stage, np.array([rng.uniform(-0.5, 0.5) * half, 0, rng.uniform(7, 50)]), float(rng.normal(0, 0.25)))
    end = float(rng.uniform(60, 110))
    for _ in range(int(rng.integers(0, 5))):
        front(
            stage, float(rng.uniform(8, 25)), float(rng.uniform(4, 20)), np.array([rng.uniform(-40, 40), 0, end]), 0.0
        )
    if rng.random() < 0.5:
        hedge(stage, np.array([-45.0, 0, end + 2]), np.array([45.0, 0, end + 2]), float(rng.uniform(3, 10)))
    if rng.random() < 0.35:
        coat = stage.paint(plain=True, albedo=0.05)
        for k in range(int(rng.integers(1, 6))):
            y = -float(rng.uniform(4.5, 7))
            wire(stage, np.array([-half - 3, y, 8.0 + 4 * k]), np.array([half + 3, y, 10.0 + 5 * k]), 0.5, 0.012, coat)
    for _ in range(int(rng.integers(0, 5))):  # people, bins, hydrants
        size = float(rng.uniform(0.5, 1.8))
        x = float(rng.choice([-1, 1])) * (half + rng.uniform(-0.5, 1.5))
        solid(stage, size, np.array([x, -size / 2, rng.uniform(4, 25)]), rotation(float(rng.uniform(-3, 3))))

    def beside() -> Float:
        """Return a place beside the road."""
        return np.array([float(rng.choice([-1, 1])) * (half + rng.uniform(-0.5, 4)), 0, rng.uniform(3, 25)])

    standing(stage, 12, 0.5, 3.0, beside)


def garden(stage: Stage) -> None:
    """Fill `stage` with rough ground, plants, rocks, walls, fences: nature, parks, yards, work sites."""
    rng = stage.rng
    stage.plain = float(rng.choice([0.03, 0.15, 0.3]))
    stage.field_of_view = float(rng.uniform(0.6, 1.5))
    hills = relief(rng, 96, float(rng.uniform(1.5, 2.4))) * float(rng.uniform(0.02, 0.9))
    hills[:, :] -= hills[8, 48]
    hills *= np.clip(np.linspace(-0.05, 1.4, 96), 0.1, 1)[:, None]
    eye = float(rng.uniform(0.5, 2.0))
    stage.place = np.array([0.0, -eye, 0.0])
    stage.look(float(rng.normal(0, 0.1)), float(rng.normal(-0.08, 0.1)), float(rng.normal(0, 0.02)))
    _daylight(stage, float(rng.uniform(6, 20)))
    deep = float(rng.uniform(14, 60))

    def on(x: float, z: float) -> Float:
        """Return the point of the ground at a place."""
        row = np.clip(round((z + 3) / (deep + 3) * 95), 0, 95)
        column = np.clip(round((x / (deep * 2) + 0.5) * 95), 0, 95)
        return np.array([x, -float(hills[row, column]), z])

    earth = stage.paint(
        str(rng.choice(["strokes", "fractal", "cells", "speckle", "photograph", "tiles"])),
        float(rng.uniform(0.6, 4)),
        float(rng.uniform(0.15, 0.6)),
        gloss=0.0,
    )
    stage.add(heightfield(hills, deep * 2, deep + 3).moved(None, (0, 0, -3)), earth)

    def spot(near: float = 2.0) -> tuple[float, float]:
        """Return a place within view."""
        z = near + (deep - near) * rng.random() ** 1.7
        return float(rng.uniform(-1, 1) * z * np.tan(stage.field_of_view / 2) * 1.1), float(z)

    for _ in range(int(rng.integers(0, 9))):
        tree(stage, float(rng.uniform(1.5, 9)), on(*spot(3.0)), bool(rng.random() < 0.8))
    rock = stage.paint(str(rng.choice(["fractal", "cells", "speckle"])), 1.0, float(rng.uniform(0.25, 0.7)))
    for _ in range(int(rng.integers(0, 12))):
        size = float(np.exp(rng.uniform(np.log(0.15), np.log(1.5))))
        stage.add(
            blob(size / 2, bumps(rng, 20, 0.3), steps=20), rock, None, rotation(*rng.uniform(-3, 3, 3)), on(*spot())
        )
    for _ in range(int(rng.integers(0, 5))):
        (x, z), (u, w) = spot(), spot()
        (hedge if rng.random() < 0.5 else fence)(stage, on(x, z), on(u, w), float(rng.uniform(0.4, 1.8)))
    count = int(np.exp(rng.uniform(np.log(10), np.log(500))))  # grass and flowers, near ones single
    tufts = np.stack([on(*spot(1.0)) for _ in range(count)])
    sizes = rng.uniform(0.1, 0.5, (count, 1)) * np.array([[1.0, 1.0]])
    tufts[:, 1] -= sizes[:, 1] / 2
    turns = np.stack([rng.uniform(-3, 3, count), rng.normal(0, 0.1, count), np.zeros(count)], axis=1)
    grass = stage.paint("strokes", 0.3, float(rng.uniform(0.15, 0.5)), 0.3, plain=False)
    stage.add(cards(tufts, turns, sizes), grass, "blades")
    if rng.random() < 0.6:
        for _ in range(int(rng.integers(1, 4))):
            x, z = spot(5.0)
            front(
                stage,
                float(rng.uniform(3, min(15.0, z))),
                float(rng.uniform(1.5, 8)),
                on(x, z),
                float(rng.normal(0, 0.6)),
            )
    if rng.random() < 0.6:
        hedge(stage, np.array([-deep, 0.5, deep]), np.array([deep, 0.5, deep]), float(rng.uniform(2, 8)))
    for _ in range(int(rng.integers(0, 14))):
        size = float(np.exp(rng.uniform(np.log(0.2), np.log(1.3))))
        solid(stage, size, on(*spot()) - [0, size / 2, 0], rotation(float(rng.uniform(-3, 3))))
    standing(stage, 12, 0.4, 3.0, lambda: on(*spot()))
    for _ in range(int(rng.integers(0, 4))):
        pole(stage, on(*spot()))
    if rng.random() < 0.3:
        x, z = spot(5.0)
        car(stage, on(x, z), float(rng.uniform(-3, 3)))
