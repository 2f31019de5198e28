"""Close-ups of smooth, curved, wet or matt surfaces lit by a lamp next to the camera, as in an endoscope."""

from __future__ import annotations

import numpy as np

from stereokit_evaluation.synthetic.meshes import blob, grid, heightfield, lathe, rotation, tube
from stereokit_evaluation.synthetic.stage import Stage
from stereokit_evaluation.synthetic.terrain import relief
from stereokit_evaluation.synthetic.things import bumps, has_models, model

__all__ = ["closeup"]


def closeup(stage: Stage) -> None:
    """Fill `stage` with folds, lumps or the inside of a tube, about 10 units away."""
    rng = stage.rng
    stage.plain = 0.0
    stage.field_of_view = float(rng.uniform(0.6, 1.3))
    stage.look(0, 0, float(rng.normal(0, 0.3)))
    wet = rng.random() < 0.75
    half = np.tan(stage.field_of_view / 2) * 10

    def skin() -> int:
        """Return a material: cloudy, with vessels or pores, mostly wet."""
        kind = str(rng.choice(["vessels", "fractal", "speckle", "cells", "photograph"], p=[0.5, 0.25, 0.1, 0.1, 0.05]))
        return stage.paint(
            kind,
            float(rng.uniform(4, 16)),
            float(rng.uniform(0.25, 0.7)),
            float(np.exp(rng.uniform(np.log(0.12), np.log(0.9)))),
            detail_size=float(rng.uniform(0.8, 4)),
            detail_contrast=float(np.exp(rng.uniform(np.log(0.03), np.log(0.2)))),
            gloss=float(rng.uniform(0.3, 2.5)) if wet else 0.0,
            sharpness=int(rng.integers(4, 9)),
            plain=False,
            turned=True,
        )

    kind = rng.random()
    if kind < 0.3:  # inside a tube with folds
        turns, length = 96, 140
        along = np.linspace(-2, float(rng.uniform(40, 90)), length)
        angle = np.linspace(0, 2 * np.pi, turns + 1)
        radius = half * rng.uniform(0.5, 0.9) * np.ones((length, turns + 1))
        for _ in range(int(rng.integers(3, 9))):  # folds that narrow it
            center, depth = rng.uniform(4, 60), rng.uniform(0.1, 0.5)
            lean = 1 + 0.5 * np.cos(angle - rng.uniform(0, 6))
            radius *= 1 - depth * lean[None] / 1.5 * np.exp(-(((along - center) / rng.uniform(0.6, 2.5)) ** 2))[:, None]
        wobble = relief(rng, 128, 2.0)[:96, :96] * 0.04
        radius *= 1 + np.pad(np.concatenate([wobble, wobble[::-1]])[:length], ((0, 0), (0, 1)), mode="wrap")
        bend_x, bend_y = rng.normal(0, 0.004, 2)
        points = np.empty((length, turns + 1, 3))
        points[..., 0] = radius * np.cos(angle) + bend_x * (along**2)[:, None]
        points[..., 1] = radius * np.sin(angle) + bend_y * (along**2)[:, None]
        points[..., 2] = along[:, None]
        uv = np.zeros((length, turns + 1, 4))
        uv[..., 0], uv[..., 1] = angle[None] * half * 0.7, along[:, None]
        stage.add(grid(points, uv), skin())
    else:
        side = 160
        field = relief(rng, side, float(rng.uniform(1.8, 3.0)), float(rng.uniform(1, 3)))
        height = field * float(rng.uniform(0.3, 1.6)) + relief(rng, side, 1.2, 12.0) * float(
            rng.choice([0.0, 0.02, 0.06])
        )
        base = heightfield(height, half * 5, half * 5).moved(None, (0, 0, -half * 2.5))
        stand = rotation(float(rng.normal(0, 0.4)), np.pi / 2 + float(rng.normal(0, 0.5)), float(rng.normal(0, 0.5)))
        stage.add(base, skin(), None, stand, (0, 0, 12.0))
        for _ in range(int(rng.integers(0, 9))):
            radius = float(rng.uniform(0.08, 0.5)) * half
            z = float(rng.uniform(5.5, 12))
            spot = np.array([rng.uniform(-1, 1) * half * z / 10, rng.uniform(-0.8, 0.8) * half * z / 10, z])
            mesh = blob(radius, bumps(rng, 48, float(rng.uniform(0.05, 0.35))), steps=48)
            stage.add(mesh, skin(), None, rotation(*rng.uniform(-3, 3, 3)) * np.exp(rng.uniform(-0.5, 0.3, 3)), spot)
    for _ in range(int(rng.choice([0, 1, 2, 3], p=[0.4, 0.3, 0.2, 0.1]))):  # instruments
        metal = stage.paint(
            "strokes",
            3.0,
            float(rng.uniform(0.1, 0.6)),
            0.15,
            gloss=1.5,
            sharpness=5,
            mirror=float(rng.choice([0.0, 0.4])),
            plain=bool(rng.random() < 0.5),
        )
        tip = np.array([rng.uniform(-0.5, 0.5) * half * 0.8, rng.uniform(-0.4, 0.4) * half * 0.8, rng.uniform(6, 9)])
        side_x = float(rng.choice([-1, 1]))
        end = np.array([side_x * half * 1.3, rng.uniform(-0.2, 1.0) * half, rng.uniform(3.0, 5.5)])
        radius = float(rng.uniform(0.02, 0.07)) * half
        stage.add(tube(np.stack([end, 0.2 * end + 0.8 * tip, tip]), radius, 20), metal)
        if rng.random() < 0.5:
            cap = lathe(np.array([1e-6, radius * 1.2, radius * 1.2, 1e-6]), np.array([-0.3, -0.3, 0.3, 0.3]), 24)
            stage.add(cap, metal, None, rotation(0, 0, float(rng.uniform(0, 3))), tip)
    if has_models(stage):
        for _ in range(int(rng.choice([0, 1, 3], p=[0.5, 0.25, 0.25]))):
            z = float(rng.uniform(6, 10))
            spot = np.array([rng.uniform(-0.8, 0.8) * half * z / 10, rng.uniform(-0.6, 0.6) * half * z / 10, z])
            model(stage, float(rng.uniform(0.15, 0.7)) * half, spot, rotation(*rng.uniform(-3, 3, 3)))
    for _ in range(int(rng.choice([0, 1, 4], p=[0.7, 0.2, 0.1]))):  # threads
        a, b = (np.array([rng.uniform(-1, 1) * half, rng.uniform(-1, 1) * half, rng.uniform(7, 9)]) for _ in range(2))
        t = np.linspace(0, 1, 20)[:, None]
        path = (1 - t) * a + t * b + np.sin(t * rng.uniform(2, 9) + rng.normal(size=3)) * rng.uniform(0, 0.8)
        stage.add(tube(path, float(rng.uniform(0.02, 0.08)), 6), stage.paint(plain=True, gloss=0.5))
    stage.light = {
        "lamp": float(rng.uniform(60, 140)),
        "lamp_x": float(rng.normal(0, 0.8)),
        "lamp_y": float(rng.normal(0, 0.8)),
        "lamp_z": float(rng.uniform(-1.5, 0.5)),
        "ambient": float(rng.uniform(0.02, 0.3)),
        "around": stage.slot("fractal"),
        "around_level": 3.0,
        "around_gain": 0.8,
    }
    stage.offset = bool(rng.random() < 0.3)
