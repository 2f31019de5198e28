"""Flying and lying objects, and piles of them, in front of walls: slanted, curved and cut-out surfaces."""

from __future__ import annotations

import numpy as np

from stereokit_evaluation.synthetic.meshes import heightfield, rotation, sheet
from stereokit_evaluation.synthetic.stage import Stage
from stereokit_evaluation.synthetic.things import loose, solid

__all__ = ["flying", "pile", "studio_light"]


def studio_light(stage: Stage) -> None:
    """Light from one side, with or without shadows, from a lamp, or from everywhere."""
    rng = stage.rng
    sun = float(rng.uniform(0.2, 1.0)) if rng.random() < 0.75 else 0.0
    stage.light = {
        "sun": sun,
        "sun_x": float(rng.normal(0, 0.6)),
        "sun_y": -1.0,
        "sun_z": float(rng.uniform(-1.2, 0.2)),
        "ambient": float(rng.uniform(0.15, 0.5) if sun else rng.uniform(0.5, 0.9)),
        "around": stage.slot(str(rng.choice(["facade", "collage", "photograph", "fractal"]))),
        "around_level": float(rng.integers(0, 4)),
        "around_gain": float(rng.uniform(0.6, 2.0)),
        "around_radius": float(rng.choice([0.0, rng.uniform(3, 20)])),
    }


def flying(stage: Stage) -> None:
    """Fill `stage` with things at all depths before a wall or two; some air is empty."""
    rng = stage.rng
    stage.plain = float(rng.choice([0.02, 0.1, 0.25], p=[0.5, 0.35, 0.15]))
    stage.field_of_view = float(rng.uniform(0.6, 1.4))
    stage.look(0, float(rng.normal(0, 0.1)), float(rng.normal(0, 0.1)))
    studio_light(stage)
    far = float(np.exp(rng.uniform(np.log(4), np.log(25))))
    half = far * np.tan(stage.field_of_view / 2)
    if rng.random() < 0.9:
        bend = float(rng.normal(0, 0.5)) if rng.random() < 0.4 else 0.0
        stage.add(
            sheet(half * 6, half * 5, bend, 0.0, 1.0, 40 if bend else 1),
            stage.paint(size=half * rng.uniform(0.3, 2.5)),
            None,
            rotation(float(rng.normal(0, 0.35)), float(rng.normal(0, 0.25))),
            (0, 0, far),
        )
    else:
        stage.light |= {
            "sky_low": rng.uniform(0.4, 1.2),
            "sky_high": rng.uniform(0.2, 1.0),
            "clouds": rng.uniform(0, 0.5),
        }
    if rng.random() < 0.6:
        floor = heightfield(np.zeros((2, 2)), half * 6, far * 2)
        stage.add(
            floor,
            stage.paint(size=far * rng.uniform(0.1, 0.6)),
            None,
            rotation(0, 0, float(rng.normal(0, 0.08))),
            (0, far * rng.uniform(0.1, 0.35), 0),
        )
    for _ in range(int(np.exp(rng.uniform(np.log(10), np.log(70))))):
        z = far * rng.uniform(0.22, 1.0) ** float(rng.uniform(0.6, 1.6))
        reach = z * np.tan(stage.field_of_view / 2)
        size = reach * float(np.exp(rng.uniform(np.log(0.05), np.log(0.7))))
        solid(stage, size, np.array([rng.uniform(-1.1, 1.1) * reach, rng.uniform(-0.75, 0.75) * reach, z]))
    if rng.random() < 0.5:
        stage.shadows, stage.shadow_centre = half * 1.5, np.array([0, 0, far * 0.7])


def pile(stage: Stage) -> None:
    """Fill `stage` with a heap of things on a table before a backdrop, close together, at many depths."""
    rng = stage.rng
    stage.plain = float(rng.choice([0.03, 0.15, 0.3], p=[0.45, 0.35, 0.2]))
    stage.field_of_view = float(rng.uniform(0.5, 1.0))
    stage.place = np.array([0.0, -float(rng.uniform(0.15, 0.7)), 0.0])
    stage.look(float(rng.normal(0, 0.1)), -float(rng.uniform(0.05, 0.45)), float(rng.normal(0, 0.02)))
    studio_light(stage)
    near, far = 1.0, float(rng.uniform(1.6, 3.2))
    half = np.tan(stage.field_of_view / 2)
    stage.add(heightfield(np.zeros((2, 2)), 12, 6), stage.paint(size=float(rng.uniform(0.3, 2))))
    wall = stage.paint(size=float(rng.uniform(0.5, 2.5)))
    stage.add(sheet(12, 8), wall, None, rotation(float(rng.normal(0, 0.25))), (0, -1, far + 0.3))
    upright = rng.random() < 0.6
    for _ in range(int(rng.integers(15, 90))):
        z = rng.uniform(near, far)
        size = float(np.exp(rng.uniform(np.log(0.06), np.log(0.55))))
        turn = rotation(*(rng.normal(0, 1, 3) * np.array([1.0, 0.15, 0.15]))) if upright else None
        maker = loose(stage)
        low = rng.random() < 0.6
        y = -size / 2 if low else -rng.uniform(0.0, 1.3)
        maker(
            stage,
            size,
            np.array([rng.uniform(-1.2, 1.2) * z * half, y, z]),
            rotation(*rng.uniform(-3.1, 3.1, 3)) if turn is None else turn,
        )
    if rng.random() < 0.75:
        stage.shadows, stage.shadow_centre = 2.0, np.array([0, -0.3, (near + far) / 2])
