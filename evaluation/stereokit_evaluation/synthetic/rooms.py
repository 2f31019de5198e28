"""Rooms: walls with and without texture, furniture, shelves, lamps, plants, wires, mirrors and windows."""

from __future__ import annotations

import numpy as np

from stereokit_evaluation.synthetic.meshes import box, heightfield, rotation, sheet
from stereokit_evaluation.synthetic.objects import studio_light
from stereokit_evaluation.synthetic.stage import Stage
from stereokit_evaluation.synthetic.things import bookshelf, chair, lamp, plant, solid, standing, table, wire

__all__ = ["hall", "room"]


def room(stage: Stage) -> None:
    """Fill `stage` with a furnished room, the camera at one end."""
    rng = stage.rng
    stage.plain = float(rng.choice([0.05, 0.2, 0.45], p=[0.45, 0.35, 0.2]))
    stage.field_of_view = float(rng.uniform(0.7, 1.5))
    width, depth, height = rng.uniform(2.5, 9), rng.uniform(3, 12), rng.uniform(2.2, 4.5)
    eye = rng.uniform(0.7, 1.9)
    stage.place = np.array([rng.uniform(-0.25, 0.25) * width, -eye, rng.uniform(0.0, 0.15) * depth])
    stage.look(float(rng.normal(0, 0.3)), float(rng.normal(-0.12, 0.12)), float(rng.normal(0, 0.02)))
    studio_light(stage)
    if rng.random() < 0.6:
        stage.light |= {
            "lamp": rng.uniform(0.5, 4.0),
            "lamp_x": rng.normal(0, width / 4),
            "lamp_y": -height * 0.9,
            "lamp_z": rng.uniform(0.3, 0.9) * depth,
        }
    stage.light["around_radius"] = float(rng.uniform(2, 8))
    floor = stage.paint(
        str(rng.choice(["wood", "tiles", "fractal", "weave", "stripes", "speckle"])),
        float(rng.uniform(0.4, 2.5)),
        gloss=float(rng.choice([0, 0.3, 0.8])),
        mirror=float(rng.choice([0, 0, 0.05, 0.15])),
    )
    stage.add(heightfield(np.zeros((2, 2)), width + 4, depth + 4), floor, None, None, (0, 0, -2))
    paper = stage.paint(
        str(rng.choice(["fractal", "stripes", "tiles", "speckle", "collage", "photograph"])),
        float(rng.uniform(0.5, 3)),
        float(rng.uniform(0.4, 0.85)),
        float(rng.uniform(0.03, 0.5)),
    )
    other = stage.paint(size=float(rng.uniform(0.5, 3)), albedo=float(rng.uniform(0.3, 0.85)))
    roof = stage.paint(size=2.0, albedo=0.8, contrast=0.1)
    half, quarter = width / 2, np.pi / 2
    stage.add(sheet(width, height), paper, None, None, (0, -height / 2, depth))
    stage.add(sheet(depth + 4, height), paper, None, rotation(quarter), (-half, -height / 2, depth / 2 - 2))
    stage.add(sheet(depth + 4, height), other, None, rotation(-quarter), (half, -height / 2, depth / 2 - 2))
    stage.add(sheet(width, depth + 4), roof, None, rotation(0, quarter), (0, -height, depth / 2 - 2))
    for _ in range(int(rng.integers(1, 9))):  # pictures, boards, mirrors and windows on the walls
        w, h = rng.uniform(0.3, 1.8), rng.uniform(0.3, 1.5)
        y = -rng.uniform(1.0, height - 0.4)
        kind = rng.random()
        if kind < 0.6:
            coat = stage.paint(
                str(rng.choice(["photograph", "collage", "print", "facade"])),
                float(max(w, h)),
                0.5,
                0.8,
                gloss=float(rng.choice([0, 0.5])),
                mirror=float(rng.choice([0, 0.05])),
                plain=False,
            )
        elif kind < 0.8:
            coat = stage.paint(plain=True, albedo=0.1, mirror=float(rng.uniform(0.5, 0.95)))
        else:
            coat = stage.paint(plain=bool(rng.random() < 0.6), emission=float(rng.uniform(0.5, 1.5)))
        side = int(rng.integers(3))
        if side == 0:
            stage.add(sheet(w, h), coat, None, None, (rng.uniform(-half, half), y, depth - 0.02))
        else:
            sign = -1 if side == 1 else 1
            stage.add(
                sheet(w, h), coat, None, rotation(-sign * quarter), (sign * (half - 0.02), y, rng.uniform(1, depth))
            )

    def spot(margin: float = 0.4) -> np.ndarray:
        """Return a free-looking place on the floor within view."""
        z = rng.uniform(1.2, depth - margin)
        return np.array([np.clip(rng.uniform(-0.8, 0.8) * z + stage.place[0], -half + margin, half - margin), 0.0, z])

    for _ in range(int(rng.integers(0, 4))):
        position, yaw = spot(0.8), float(rng.uniform(-3, 3))
        size = float(rng.uniform(0.7, 1.2))
        w, d = table(stage, size, position, yaw)
        for _ in range(int(rng.integers(0, 9))):
            place = rotation(yaw) @ np.array([rng.uniform(-0.45, 0.45) * w, 0, rng.uniform(-0.45, 0.45) * d])
            thing = float(rng.uniform(0.08, 0.4))
            solid(
                stage,
                thing,
                position + place + np.array([0, -0.77 * size - thing * 0.45, 0]),
                rotation(float(rng.uniform(-3, 3))),
            )
    for _ in range(int(rng.integers(0, 6))):
        chair(stage, float(rng.uniform(0.85, 1.1)), spot(), float(rng.uniform(-3, 3)))
    for _ in range(int(rng.integers(0, 3))):
        lamp(stage, float(rng.uniform(0.5, 1.8)), spot())
    for _ in range(int(rng.integers(0, 4))):
        size = float(rng.uniform(0.4, 1.5))
        plant(
            stage, size, spot() + np.array([0, -size * rng.uniform(0.6, 0.9), 0]), rotation(float(rng.uniform(-3, 3)))
        )
    for _ in range(int(rng.integers(0, 3))):
        side, w = int(rng.integers(3)), float(rng.uniform(0.6, 2.0))
        if side == 0:
            position, yaw = np.array([rng.uniform(-half + 1, half - 1), 0, depth - 0.2]), 0.0
        else:
            sign = -1 if side == 1 else 1
            position, yaw = np.array([sign * (half - 0.2), 0, rng.uniform(1.8, depth - 1)]), sign * quarter
        bookshelf(stage, w, float(rng.uniform(0.8, height - 0.2)), position, yaw)
    for _ in range(int(rng.integers(0, 12))):
        size = float(np.exp(rng.uniform(np.log(0.15), np.log(1.0))))
        solid(stage, size, spot() + np.array([0, -size / 2, 0]), rotation(float(rng.uniform(-3, 3))))
    standing(stage, 10, 0.5, 2.2, spot)
    if rng.random() < 0.35:
        coat = stage.paint(plain=True, albedo=float(rng.uniform(0.02, 0.5)))
        for _ in range(int(rng.integers(1, 6))):
            a, b = spot(), spot()
            a[1], b[1] = -height * rng.uniform(0.3, 1), -height * rng.uniform(0.3, 1)
            wire(stage, a, b, float(rng.uniform(0, 0.4)), float(rng.uniform(0.003, 0.012)), coat)
    if rng.random() < 0.4:
        stage.shadows, stage.shadow_centre = max(width, depth) * 0.7, np.array([0, -height / 2, depth / 2])
        stage.light["sun_z"] = -float(rng.uniform(0.3, 1.5))


def hall(stage: Stage) -> None:
    """Fill `stage` with a work hall: crates, racks, pipes, machines, cables, bare walls, ladders, bars."""
    rng = stage.rng
    stage.plain = float(rng.choice([0.02, 0.1, 0.25], p=[0.5, 0.35, 0.15]))
    stage.field_of_view = float(rng.uniform(0.6, 1.4))
    width, depth, height = rng.uniform(5, 16), rng.uniform(6, 25), rng.uniform(3, 8)
    half, quarter = width / 2, np.pi / 2
    stage.place = np.array([rng.uniform(-0.25, 0.25) * width, -rng.uniform(1.0, 2.5), 0.0])
    stage.look(float(rng.normal(0, 0.3)), float(rng.normal(-0.08, 0.1)), float(rng.normal(0, 0.02)))
    studio_light(stage)
    if rng.random() < 0.7:
        stage.light |= {
            "lamp": rng.uniform(1, 5),
            "lamp_x": rng.normal(0, width / 4),
            "lamp_y": -height * 0.9,
            "lamp_z": rng.uniform(0.3, 0.9) * depth,
        }
    stage.light["around_radius"] = float(rng.uniform(4, 12))
    floor = stage.paint(
        str(rng.choice(["fractal", "tiles", "cells", "speckle"])),
        float(rng.uniform(1, 5)),
        0.4,
        float(rng.uniform(0.1, 0.6)),
        mirror=float(rng.choice([0, 0, 0.08])),
    )
    stage.add(heightfield(np.zeros((2, 2)), width + 6, depth + 6), floor, None, None, (0, 0, -3))
    for w, turn, centre in (
        (width, None, (0, -height / 2, depth)),
        (depth + 6, rotation(quarter), (-half, -height / 2, depth / 2 - 3)),
        (depth + 6, rotation(-quarter), (half, -height / 2, depth / 2 - 3)),
    ):
        kind = str(rng.choice(["tiles", "fractal", "stripes", "facade", "wood"]))
        stage.add(sheet(w, height), stage.paint(kind, float(rng.uniform(1, 6))), None, turn, centre)
    stage.add(
        sheet(width, depth + 6), stage.paint("stripes", 3.0), None, rotation(0, quarter), (0, -height, depth / 2 - 3)
    )
    for k in range(int(rng.integers(0, 9))):  # beams below the roof, and pillars
        beam = stage.paint("fractal", 2.0, plain=True)
        stage.add(box(width, 0.3, 0.2), beam, None, None, (0, -height + 0.3, 2 + k * depth / 9))
        if rng.random() < 0.5:
            stage.add(
                box(0.25, height, 0.25),
                beam,
                None,
                None,
                (rng.uniform(-0.9, 0.9) * half, -height / 2, 2 + k * depth / 9),
            )

    def spot() -> np.ndarray:
        """Return a place on the floor within view."""
        z = rng.uniform(2.0, depth - 0.5)
        return np.array([np.clip(rng.uniform(-0.8, 0.8) * z + stage.place[0], -half, half), 0.0, z])

    coats = [
        stage.paint(str(rng.choice(["wood", "print", "collage", "fractal"])), float(rng.uniform(0.5, 2)))
        for _ in range(6)
    ]
    for _ in range(int(rng.integers(3, 25))):  # crates in stacks
        position, yaw = spot(), rotation(float(rng.normal(0, 0.5)))
        y = 0.0
        for _ in range(int(rng.integers(1, 5))):
            w, h, d = rng.uniform(0.3, 1.2, 3)
            stage.add(
                box(w, h, d),
                coats[int(rng.integers(6))],
                None,
                yaw,
                position + np.array([rng.normal(0, 0.05), y - h / 2, 0]),
            )
            y -= h
    steel = stage.paint("fractal", 1.0, gloss=0.7, plain=bool(rng.random() < 0.7))
    for _ in range(int(rng.integers(0, 12))):  # pipes and rails
        a = spot() - np.array([0, rng.uniform(0.5, height), 0])
        along = rng.choice([0, 1, 2], p=[0.45, 0.2, 0.35])
        b = a.copy()
        b[along] += rng.uniform(1, 8)
        wire(stage, a, b, 0.0, float(rng.uniform(0.01, 0.12)), steel)
    for _ in range(int(rng.integers(0, 4))):  # ladders, bars and netting
        w, h = rng.uniform(0.5, 3), rng.uniform(1, 3)
        stage.add(
            sheet(w, h),
            steel,
            str(rng.choice(["lattice", "fence"])),
            rotation(float(rng.uniform(-1.2, 1.2))),
            spot() - np.array([0, h / 2, 0]),
        )
    for _ in range(int(rng.integers(0, 3))):
        bookshelf(
            stage,
            float(rng.uniform(1, 3)),
            float(rng.uniform(1.5, 3)),
            spot(),
            float(rng.choice([0, quarter, -quarter])),
        )
    for _ in range(int(rng.integers(2, 16))):
        size = float(np.exp(rng.uniform(np.log(0.2), np.log(1.8))))
        solid(stage, size, spot() - np.array([0, size / 2, 0]), rotation(float(rng.uniform(-3, 3))))
    standing(stage, 16, 0.5, 3.0, spot)
    for _ in range(int(rng.integers(0, 6))):
        a, b = spot(), spot()
        a[1], b[1] = -height * rng.uniform(0.4, 1, 2)
        wire(stage, a, b, float(rng.uniform(0, 0.8)), float(rng.uniform(0.005, 0.02)), steel)
    if rng.random() < 0.5:
        stage.shadows, stage.shadow_centre = max(width, depth) * 0.7, np.array([0, -height / 2, depth / 2])
