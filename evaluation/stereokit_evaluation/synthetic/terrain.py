"""The ground from far above: fields, roads, houses, woods, as from an aircraft or a satellite."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.meshes import blob, box, cards, grid, heightfield, merge, rotation, sheet
from stereokit_evaluation.synthetic.stage import Stage

__all__ = ["relief", "terrain"]

Float = NDArray[np.float64]


def relief(rng: np.random.Generator, side: int, fall: float, lowest: float = 1.0) -> Float:
    """Return a random height map (side, side), mean 0 and deviation 1; amplitudes fall with frequency ** `fall`."""
    f = np.hypot(np.fft.fftfreq(side, 1 / side)[:, None], np.fft.rfftfreq(side, 1 / side)[None])
    spectrum = np.fft.rfft2(rng.standard_normal((side, side))) / np.maximum(f, lowest) ** fall
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, (side, side))
    return np.asarray(field / max(float(field.std()), 1e-12))


def _roof(width: float, depth: float, height: float) -> tuple[Float, Float]:
    """Return the corner grid (2, 3, 3) of a gable roof and its coordinates."""
    x, z = np.array([-width / 2, 0.0, width / 2]), np.array([-depth / 2, depth / 2])
    points = np.empty((2, 3, 3))
    points[..., 0], points[..., 1], points[..., 2] = x[None], np.array([0.0, -height, 0.0])[None], z[:, None]
    uv = np.empty((2, 3, 4))
    uv[..., 0], uv[..., 1], uv[..., 2:] = x[None], z[:, None], 0.5
    return points, uv


def terrain(stage: Stage) -> None:
    """Fill `stage` with a landscape or a town of about 100 units across, seen from above."""
    rng = stage.rng
    town = rng.random() < 0.65
    stage.plain = float(rng.choice([0.1, 0.3, 0.5]))
    stage.field_of_view = float(rng.uniform(0.08, 0.5))
    far = 50 / np.tan(stage.field_of_view / 2)
    tilt = float(rng.normal(0, 0.12))
    stage.place = np.array([0.0, -far, -far * np.tan(tilt)])
    stage.look(0, -np.pi / 2 + tilt, 0)
    stage.offset = True
    stage.base_ratio = float(rng.uniform(0.15, 0.6))
    hills = relief(rng, 128, float(rng.uniform(1.3, 2.4))) * float(
        np.exp(rng.uniform(np.log(0.1), np.log(2.0 if town else 7.0)))
    )
    size = 150.0

    def ground(x: float, z: float) -> float:
        """Return the height of the hills at a place."""
        k = np.clip((np.array([z + size / 2, x + size / 2]) / size * 127).round().astype(int), 0, 127)
        return float(hills[k[0], k[1]])

    earth = stage.paint(
        str(rng.choice(["fractal", "speckle", "photograph", "cells"])),
        float(rng.uniform(10, 60)),
        float(rng.uniform(0.2, 0.5)),
        float(rng.uniform(0.1, 0.6)),
        detail_size=float(rng.uniform(3, 25)),
        detail_contrast=float(rng.uniform(0.05, 0.5)),
        plain=False,
    )
    stage.add(heightfield(hills, size, size).moved(None, (0, 0, -size / 2)), earth)
    turn = rotation(float(rng.uniform(0, 3.1)))
    for _ in range(int(rng.integers(0, 14))):  # fields
        coat = stage.paint(
            str(rng.choice(["stripes", "strokes", "fractal"])), float(rng.uniform(4, 25)), float(rng.uniform(0.15, 0.6))
        )
        x, z = rng.uniform(-60, 60, 2)
        patch = sheet(float(rng.uniform(8, 30)), float(rng.uniform(8, 30))).moved(rotation(0, np.pi / 2))
        if np.abs(hills).max() < 1.0:
            stage.add(patch, coat, None, turn, (x, -float(hills.max()) - 0.02, z))
    if town:
        asphalt = stage.paint("fractal", 20.0, float(rng.uniform(0.15, 0.4)), 0.1, plain=bool(rng.random() < 0.5))
        pitch = float(rng.uniform(9, 30))
        level = -float(np.abs(hills).max()) - 0.05 if np.abs(hills).max() < 0.8 else None
        if level is not None:
            for k in range(-8, 9):
                for quarter in (0.0, np.pi / 2):
                    strip = sheet(pitch * 0.18, size).moved(rotation(0, np.pi / 2), (k * pitch, 0, 0))
                    stage.add(strip, asphalt, None, turn @ rotation(quarter), (0, level - 0.01 * (quarter > 0), 0))
        roofs = [
            stage.paint(
                str(rng.choice(["tiles", "stripes", "fractal", "facade", "speckle"])),
                float(rng.uniform(3, 12)),
                float(rng.uniform(0.15, 0.85)),
                gloss=float(rng.choice([0, 0.4])),
            )
            for _ in range(8)
        ]
        walls = [stage.paint("facade", float(rng.uniform(4, 12))) for _ in range(4)]
        tall = float(np.exp(rng.uniform(np.log(1.0), np.log(14))))
        for _ in range(int(rng.integers(20, 160))):
            cell = (rng.integers(-4, 5, 2) + 0.5) * pitch + rng.uniform(-0.3, 0.3, 2) * pitch
            w, d = pitch * rng.uniform(0.12, 0.6, 2)
            h = tall * float(np.exp(rng.normal(0, 0.5)))
            place = turn @ np.array([cell[0], 0, cell[1]])
            position = place + np.array([0, -ground(place[0], place[2]), 0])
            own = turn @ rotation(float(rng.normal(0, 0.04)))
            stage.add(box(w, h * 2, d), walls[int(rng.integers(4))], None, own, position)
            roof = roofs[int(rng.integers(8))]
            if rng.random() < 0.5:
                points, uv = _roof(w * 1.08, d * 1.08, w * rng.uniform(0.15, 0.5))
                stage.add(grid(points, uv), roof, None, own, position + np.array([0, -h, 0]))
            else:
                stage.add(box(w * 0.99, 0.1, d * 0.99), roof, None, own, position + np.array([0, -h - 0.02, 0]))
                for _ in range(int(rng.integers(0, 4))):
                    part = rng.uniform(0.05, 0.2, 3) * min(w, d)
                    spot = own @ np.array([rng.uniform(-0.4, 0.4) * w, -h, rng.uniform(-0.4, 0.4) * d])
                    stage.add(box(*part), roofs[int(rng.integers(8))], None, own, position + spot)
    leaves = stage.paint(str(rng.choice(["fractal", "speckle"])), 3.0, float(rng.uniform(0.08, 0.3)), 0.2, plain=False)
    woods = rng.uniform(-60, 60, (int(rng.integers(1, 7)), 2))
    crowns = []
    for _ in range(int(rng.integers(0, 320))):
        at2 = (
            rng.uniform(-70, 70, 2)
            if rng.random() < 0.4
            else woods[int(rng.integers(len(woods)))] + rng.normal(0, 8, 2)
        )
        radius = float(rng.uniform(0.7, 2.4))
        position = np.array([at2[0], -ground(at2[0], at2[1]) - radius * 0.7, at2[1]])
        crowns.append(
            blob(radius, rng.uniform(-0.15, 0.15, (9, 17)), steps=8).moved(
                rotation(float(rng.uniform(0, 6))), tuple(position)
            )
        )
    if crowns:
        stage.add(merge(crowns), leaves)
    count = int(rng.integers(0, 90))
    if count:  # cars and sheds
        places = rng.uniform(-60, 60, (count, 2))
        heights = np.array([-ground(x, z) - 0.3 for x, z in places])
        spots = np.stack([places[:, 0], heights, places[:, 1]], axis=1)
        turns = np.stack([rng.choice([0.0, np.pi / 2], count), np.full(count, np.pi / 2), np.zeros(count)], axis=1)
        coat = stage.paint(size=3.0, gloss=0.6)
        stage.add(cards(spots, turns, rng.uniform(0.8, 2.2, (count, 2))), coat)
    stage.light = {
        "sun": float(rng.uniform(0.4, 1.2)),
        "sun_x": float(rng.normal(0, 1)),
        "sun_y": -float(rng.uniform(0.5, 1.5)),
        "sun_z": float(rng.normal(0, 1)),
        "ambient": float(rng.uniform(0.15, 0.6)),
        "around": stage.slot("fractal"),
        "around_level": 3.0,
        "around_gain": 1.0,
    }
    if rng.random() < 0.75:  # taken at another time
        amount = float(rng.choice([0.05, 0.3, 0.8]))
        stage.later = {f"sun_{axis}": stage.light[f"sun_{axis}"] + float(rng.normal(0, amount)) for axis in "xz"}
        stage.fickle = float(rng.choice([0.1, 0.25, 0.45]))
        stage.later["sun"] = stage.light["sun"] * float(np.exp(rng.normal(0, 0.3)))
    if rng.random() < 0.85:
        stage.shadows, stage.shadow_centre = 80.0, np.zeros(3)
