"""Objects along roads and in yards: cars, fronts of houses, hedges, fences, poles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.meshes import blob, box, cards, lathe, merge, rotation, sheet, tube
from stereokit_evaluation.synthetic.stage import Stage

__all__ = ["car", "fence", "front", "hedge", "pole"]

Float = NDArray[np.float64]


def car(stage: Stage, position: Float, yaw: float) -> None:
    """Add a car: glossy, often dark paint without texture; panes that mirror the sky."""
    rng = stage.rng
    turn = rotation(yaw)
    length, width, height = rng.uniform(3.4, 5.0), rng.uniform(1.6, 2.0), rng.uniform(1.35, 2.1)
    coat = stage.paint(
        size=3.0,
        albedo=float(rng.choice([rng.uniform(0.01, 0.1), rng.uniform(0.1, 0.8)])),
        plain=True,
        gloss=float(rng.uniform(0.2, 1.0)),
        sharpness=int(rng.integers(4, 8)),
        mirror=float(rng.choice([0.0, 0.0, 0.05, 0.2])),
    )
    pane = stage.paint(
        "collage",
        1.0,
        0.05,
        float(rng.choice([0.0, 0.12])),
        plain=False,
        detail=None,
        gloss=0.5,
        sharpness=7,
        mirror=float(rng.uniform(0.1, 0.7)),
        clear=float(rng.choice([0.0, rng.uniform(0.3, 0.8)])),
    )
    low, waist = height * 0.18, height * 0.58
    body = blob(1.0, power=0.32, steps=20)
    stage.add(
        body,
        coat,
        None,
        turn @ np.diag([width / 2, (waist - low) / 2, length / 2]),
        position + np.array([0, -(waist + low) / 2, 0]),
    )
    shift = turn @ np.array([0, 0, length * rng.uniform(-0.05, 0.1)])
    roof = float(rng.uniform(0.27, 0.4))
    stage.add(
        blob(1.0, power=0.5, steps=20),
        pane,
        None,
        turn @ np.diag([width * 0.44, height * 0.42, length * roof]),
        position + np.array([0, -waist, 0]) + shift,
    )
    stage.add(
        box(width * 0.72, 0.05, length * roof * 1.2), coat, None, turn, position + np.array([0, -height, 0]) + shift
    )
    for sx in (-1, 1):
        for k in (-0.35, 0.35):
            post = turn @ np.array([sx * width * 0.42, -(waist + height) / 2, k * length * roof * 2])
            lean = rotation(0, float(np.sign(k)) * 0.35)
            stage.add(box(0.07, (height - waist) * 1.05, 0.09), coat, None, turn @ lean, position + post + shift)
    seat = stage.paint(size=1.0, albedo=float(rng.uniform(0.02, 0.3)))
    for aside in (-0.22, 0.22):
        for k in (-0.2, 0.15):
            chair = turn @ np.array([aside * width, -waist - 0.12, k * length * roof * 2])
            stage.add(box(0.5, 0.6, 0.15), seat, None, turn, position + chair + shift)
            stage.add(box(0.25, 0.22, 0.1), seat, None, turn, position + chair + shift - [0, 0.42, 0])
    tyre = stage.paint("fractal", 0.5, 0.05, 0.05, plain=False)
    rim = stage.paint("collage", 0.8, 0.5, 0.6, plain=False)
    radius = height * 0.2
    for sx in (-1, 1):
        for sz in (-1, 1):
            spot = position + turn @ np.array([sx * width * 0.47, -radius, sz * length * 0.32])
            side = turn @ rotation(0, 0, np.pi / 2)
            stage.add(
                lathe(np.array([1e-6, radius, radius, 1e-6]), np.array([-0.12, -0.12, 0.12, 0.12]), 24),
                tyre,
                None,
                side,
                spot,
            )
            stage.add(
                lathe(np.array([1e-6, radius * 0.65]), np.array([0.0, 0.0]), 20),
                rim,
                None,
                side,
                spot + turn @ np.array([sx * 0.125, 0, 0]),
            )
    lights = stage.paint("collage", 0.3, 0.6, 0.8, plain=False, gloss=1.0, emission=float(rng.choice([0, 0.5])))
    for sz in (-1, 1):
        for sx in (-1, 1):
            spot = turn @ np.array([sx * width * 0.36, -waist * 0.78, sz * length * 0.495])
            stage.add(box(0.35, 0.16, 0.06), lights, None, turn, position + spot)
        stage.add(
            sheet(0.5, 0.12),
            stage.paint("print", 0.4, 0.7, 0.8, plain=False),
            None,
            turn,
            position + turn @ np.array([0, -waist * 0.55, sz * (length * 0.505)]),
        )


def front(stage: Stage, width: float, height: float, position: Float, yaw: float) -> None:
    """Add the front of a house, with sills, balconies, pillars, pipes; `position` is the middle of its foot."""
    rng = stage.rng
    turn = rotation(yaw)
    wall = stage.paint(
        str(rng.choice(["facade", "facade", "facade", "tiles", "fractal", "photograph"])),
        float(rng.uniform(5, 16)),
        float(rng.uniform(0.25, 0.7)),
        float(rng.uniform(0.4, 1.4)),
        gloss=float(rng.choice([0, 0, 0.3])),
    )
    stage.add(box(width, height * 2, 8.0), wall, None, turn, position + turn @ np.array([0, 0, 4.0]))
    trim = stage.paint("fractal", 1.0, float(rng.uniform(0.3, 0.8)), plain=bool(rng.random() < 0.6))
    pitch = float(rng.uniform(2.0, 4.0))
    kind = rng.random()
    parts = []
    for k in range(int(width / pitch)):
        x = -width / 2 + (k + 0.5) * pitch
        if kind < 0.3:
            parts.append(box(0.3, height, 0.3).moved(None, (x, -height / 2, -0.15)))
        elif kind < 0.75:
            for storey in range(int(height / 3)):
                y = -3 * storey - 1.2
                parts.append(box(1.3, 0.08, 0.25).moved(None, (x, y, -0.12)))
                if kind > 0.6:
                    parts.append(box(1.6, 0.1, 1.0).moved(None, (x, y + 0.3, -0.5)))
                    parts.extend(
                        box(0.03, 0.9, 0.03).moved(None, (x - 0.75 + 0.15 * j, y - 0.15, -0.98)) for j in range(11)
                    )
    if parts:
        stage.add(merge(parts), trim, None, turn, position)
    if rng.random() < 0.35:  # panes that mirror what is around, which matches elsewhere
        pane = stage.paint(
            "facade",
            3.0,
            float(rng.uniform(0.03, 0.3)),
            float(rng.choice([0.0, 0.1, 0.3])),
            detail_contrast=0.03,
            gloss=0.5,
            sharpness=7,
            mirror=float(rng.uniform(0.1, 0.7)),
            plain=False,
        )
        w, h = pitch * rng.uniform(0.3, 0.8), rng.uniform(1.2, 2.4)
        panes = [
            sheet(w, h).moved(None, (-width / 2 + (k + 0.5) * pitch, -3 * storey - 1.6, -0.01))
            for k in range(int(width / pitch))
            for storey in range(int(height / 3))
        ]
        if panes:
            stage.add(merge(panes), pane, None, turn, position)


def hedge(stage: Stage, a: Float, b: Float, height: float) -> None:
    """Add a hedge or a row of bushes between two points on the ground."""
    rng = stage.rng
    count = int(rng.integers(60, 300))
    t = rng.random((count, 1))
    centres = (1 - t) * a + t * b + rng.normal(0, 0.25, (count, 3)) * height
    centres[:, 1] = a[1] - rng.random(count) * height
    leaves = stage.paint(
        str(rng.choice(["fractal", "speckle", "strokes"])), 0.6, float(rng.uniform(0.1, 0.35)), 0.3, plain=False
    )
    sizes = height * rng.uniform(0.2, 0.5, (count, 1)) * np.ones((1, 2))
    stage.add(cards(centres, rng.uniform(-3, 3, (count, 3)), sizes), leaves, "foliage")


def fence(stage: Stage, a: Float, b: Float, height: float) -> None:
    """Add a fence between two points on the ground: bars, boards, or netting, with posts."""
    rng = stage.rng
    along = b - a
    length = float(np.sqrt((along * along).sum()))
    yaw = float(np.arctan2(-along[2], along[0]))
    coat = stage.paint("wood", 2.0, plain=bool(rng.random() < 0.6))
    panels = max(1, int(length / height / 1.5))
    for k in range(panels):
        middle = a + along * ((k + 0.5) / panels) + np.array([0, -height / 2, 0])
        stage.add(
            sheet(length / panels, height), coat, str(rng.choice(["fence", "fence", "lattice"])), rotation(yaw), middle
        )
    posts = [
        tube(np.stack([a + along * (k / panels), a + along * (k / panels) - [0, height * 1.05, 0]]), 0.04, 6)
        for k in range(panels + 1)
    ]
    stage.add(merge(posts), coat)


def pole(stage: Stage, position: Float) -> None:
    """Add a pole: a sign, a lantern, or bare."""
    rng = stage.rng
    height = float(rng.uniform(2.2, 7))
    metal = stage.paint("fractal", 0.5, plain=True, gloss=0.5)
    stage.add(
        tube(
            np.stack([position, position - [0, height, 0]]),
            float(rng.uniform(0.025, 0.12)),
            8,
            float(rng.uniform(0.5, 1)),
        ),
        metal,
    )
    kind = rng.random()
    if kind < 0.5:
        sign = stage.paint(str(rng.choice(["collage", "print"])), 0.8, 0.5, 0.9, plain=False)
        stage.add(
            sheet(0.7, 0.7),
            sign,
            str(rng.choice(["disc", "star"])) if rng.random() < 0.6 else None,
            rotation(float(rng.normal(0, 0.4))),
            position + np.array([0, -height + 0.3, -0.1]),
        )
    elif kind < 0.75:
        tip = position + np.array([rng.uniform(-2, 2), -height - 0.3, 0])
        stage.add(tube(np.stack([position - [0, height, 0], tip]), 0.04, 6), metal)
        stage.add(blob(0.25, steps=8), metal, None, None, tip)
