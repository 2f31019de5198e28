"""Things that stand, lie, hang or fly in a scene: solids, sheets, cut-outs, furniture, plants, wires."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.cutouts import CUTS
from stereokit_evaluation.synthetic.meshes import Mesh, blob, box, cards, lathe, rotation, sheet, tube
from stereokit_evaluation.synthetic.stage import Stage

__all__ = [
    "SOLIDS",
    "bookshelf",
    "chair",
    "fur",
    "has_models",
    "lamp",
    "loose",
    "model",
    "plant",
    "solid",
    "standing",
    "sticks",
    "table",
    "tree",
    "wire",
]

Float = NDArray[np.float64]
_Maker = Callable[[Stage, float, Float, Float], None]

_MODEL_SHARE = 0.6  # of loose things, where there are models
_BARE_SHARE = 0.25  # of models: painted like other things, not with their own pictures


def _coat(stage: Stage, size: float) -> int:
    """Return a new material for a thing of a size: mostly matt, some glossy, few like mirrors."""
    rng = stage.rng
    kind = rng.random()
    repeat = size * float(np.exp(rng.uniform(-1.2, 0.9)))
    if kind < 0.70:
        return stage.paint(size=repeat, turned=True)
    if kind < 0.93:
        return stage.paint(size=repeat, gloss=rng.uniform(0.1, 1.2), sharpness=int(rng.integers(2, 8)), turned=True)
    return stage.paint(
        size=repeat, gloss=0.5, sharpness=7, mirror=rng.uniform(0.05, 0.6), albedo=rng.uniform(0.02, 0.5)
    )


def _box(stage: Stage, size: float, position: Float, turn: Float) -> None:
    w, h, d = size * np.exp(stage.rng.uniform(-1.0, 0.3, 3))
    stage.add(box(w, h, d), _coat(stage, size), None, turn, position)


def _ball(stage: Stage, size: float, position: Float, turn: Float) -> None:
    rng = stage.rng
    mesh = blob(size / 2, power=float(rng.choice([1.0, 0.6, 0.35, 1.6])), steps=28)
    stage.add(mesh, _coat(stage, size), None, turn * np.exp(rng.uniform(-0.5, 0.2, 3)), position)


def bumps(rng: np.random.Generator, steps: int, amount: float, order: int = 5) -> Float:
    """Return a smooth random relief for `meshes.blob`, (steps + 1, 2 * steps + 1), closed around."""
    down, angle = np.linspace(0, np.pi, steps + 1)[:, None], np.linspace(0, 2 * np.pi, 2 * steps + 1)[None]
    out = np.zeros((steps + 1, 2 * steps + 1))
    for k in range(1, order + 1):
        for m in range(order + 1):
            a = rng.normal(0, amount / (k + m))
            out += (
                a
                * np.sin(down) ** max(m, 1)
                * np.cos(k * down + rng.uniform(0, 6))
                * np.cos(m * angle + rng.uniform(0, 6))
            )
    return np.asarray(np.clip(out, -0.6, 0.9))


def _lump(stage: Stage, size: float, position: Float, turn: Float) -> None:
    mesh = blob(size / 2, bumps(stage.rng, 36, float(stage.rng.uniform(0.1, 0.5))), steps=36)
    stage.add(mesh, _coat(stage, size), None, turn, position)


def _vase(stage: Stage, size: float, position: Float, turn: Float) -> None:
    rng = stage.rng
    n = int(rng.integers(4, 9))
    knots = rng.uniform(0.12, 0.5, n) * size
    heights = np.linspace(-size / 2, size / 2, 24)
    radii = np.interp(heights, np.linspace(-size / 2, size / 2, n), knots)
    if rng.random() < 0.7:
        radii = np.convolve(np.pad(radii, 2, mode="edge"), [0.1, 0.25, 0.3, 0.25, 0.1], mode="valid")
    cut = str(rng.choice(["lattice", "holes"])) if rng.random() < 0.12 else None
    stage.add(lathe(radii, heights, 36, float(rng.uniform(0.6, 1.0))), _coat(stage, size), cut, turn, position)


def _can(stage: Stage, size: float, position: Float, turn: Float) -> None:
    rng = stage.rng
    radius, h = size * rng.uniform(0.12, 0.45), size * rng.uniform(0.3, 1.0)
    profile = np.array([1e-6, radius, radius * rng.uniform(0.5, 1.1), 1e-6])
    stage.add(lathe(profile, np.array([-h, -h, h, h]) / 2, 40), _coat(stage, size), None, turn, position)


def _paper(stage: Stage, size: float, position: Float, turn: Float) -> None:
    rng = stage.rng
    w, h = size * np.exp(rng.uniform(-0.6, 0.3, 2))
    bend = float(rng.normal(0, 0.8)) if rng.random() < 0.5 else 0.0
    wave = float(size * rng.uniform(0, 0.08)) if rng.random() < 0.3 else 0.0
    cut = str(rng.choice(CUTS)) if rng.random() < 0.6 else None
    stage.add(
        sheet(w, h, bend, wave, float(rng.uniform(0.5, 3)), 1 if bend == 0 and wave == 0 else 24),
        _coat(stage, size),
        cut,
        turn,
        position,
    )


def _ring(stage: Stage, size: float, position: Float, turn: Float) -> None:
    rng = stage.rng
    angle = np.linspace(0, 2 * np.pi * rng.uniform(0.4, 1.0), 36)
    path = (
        np.stack([np.cos(angle), np.sin(angle) * rng.uniform(0.4, 1), angle * rng.uniform(0, 0.2)], axis=1) * size * 0.4
    )
    stage.add(tube(path, size * rng.uniform(0.02, 0.12), 10), _coat(stage, size), None, turn, position)


def wire(stage: Stage, start: Float, end: Float, sag: float, radius: float, material: int) -> None:
    """Hang a wire between two points."""
    t = np.linspace(0, 1, 16 if sag else 2)[:, None]
    path = (1 - t) * start + t * end
    path[:, 1] += sag * 4 * (t * (1 - t))[:, 0]
    stage.add(tube(path, radius, 6), material)


def sticks(stage: Stage, size: float, position: Float, turn: Float, count: int | None = None) -> None:
    """Add a bundle of thin rods that cross each other."""
    rng = stage.rng
    material = stage.paint(size=size, plain=bool(rng.random() < 0.6))
    for _ in range(int(rng.integers(2, 9)) if count is None else count):
        a, b = rng.normal(0, 0.35, (2, 3)) * size
        b[:] = -a + rng.normal(0, 0.2, 3) * size
        stage.add(
            tube(np.stack([a, b]), size * float(np.exp(rng.uniform(-5.0, -3.0))), 6), material, None, turn, position
        )


def plant(stage: Stage, size: float, position: Float, turn: Float) -> None:
    """Add a pot plant or a bush: stems and many single leaves."""
    rng = stage.rng
    count = int(np.exp(rng.uniform(np.log(25), np.log(220))))
    leaf = stage.paint(
        str(rng.choice(["fractal", "vessels", "strokes"])),
        size * 0.3,
        rng.uniform(0.12, 0.5),
        rng.uniform(0.05, 0.4),
        gloss=float(rng.choice([0.0, 0.3])),
        plain=bool(rng.random() < 0.3),
    )
    centres = rng.normal(0, 1, (count, 3))
    centres *= (rng.random(count) ** 0.4 / np.sqrt((centres**2).sum(axis=1)))[:, None] * size * 0.5
    length = size * rng.uniform(0.06, 0.3)
    sizes = np.stack([np.full(count, length), np.full(count, length * rng.uniform(0.15, 0.7))], axis=1)
    sizes *= rng.uniform(0.6, 1.3, (count, 1))
    stage.add(cards(centres, rng.uniform(-1.5, 1.5, (count, 3)), sizes), leaf, "leaf", turn, position)
    stem = stage.paint(size=size, plain=True)
    for k in range(min(count, 18)):
        path = np.stack([np.array([0, size * 0.6, 0]), centres[k] * 0.5 + [0, 0.2 * size, 0], centres[k]])
        stage.add(tube(path, size * 0.006, 5), stem, None, turn, position)


def tree(stage: Stage, height: float, position: Float, leafy: bool = True) -> None:
    """Add a tree whose foot is `position`: a trunk, branches, and cards of leaves."""
    rng = stage.rng
    bark = stage.paint(str(rng.choice(["strokes", "fractal", "wood"])), 0.5, rng.uniform(0.1, 0.4))
    top = np.array([rng.normal(0, 0.05), -1.0, rng.normal(0, 0.05)]) * height * 0.75
    stage.add(
        tube(np.stack([np.zeros(3), top * 0.5, top]), height * rng.uniform(0.012, 0.035), 8, 0.3),
        bark,
        None,
        None,
        position,
    )
    for _ in range(int(rng.integers(4, 22))):
        foot = top * rng.uniform(0.35, 1.0)
        tip = foot + rng.normal(0, 0.22, 3) * height - [0, 0.1 * height, 0]
        stage.add(tube(np.stack([foot, tip]), height * 0.008, 5, 0.3), bark, None, None, position)
    if not leafy:
        return
    count = int(rng.integers(40, 260))
    spread = np.array([rng.uniform(0.2, 0.45), rng.uniform(0.2, 0.4), 0.0])
    spread[2] = spread[0]
    centres = rng.normal(0, 1, (count, 3))
    centres *= (rng.random(count) ** 0.33 / np.sqrt((centres**2).sum(axis=1)))[:, None]
    centres = centres * spread * height + top * rng.uniform(0.8, 1.0)
    sizes = height * rng.uniform(0.06, 0.18) * rng.uniform(0.6, 1.4, (count, 1)) * np.ones((1, 2))
    leaves = stage.paint(
        str(rng.choice(["fractal", "speckle", "strokes"])),
        height * 0.2,
        rng.uniform(0.12, 0.45),
        rng.uniform(0.1, 0.4),
        plain=False,
    )
    stage.add(cards(centres, rng.uniform(-3, 3, (count, 3)), sizes), leaves, "foliage", None, position)


def table(stage: Stage, size: float, position: Float, yaw: float) -> tuple[float, float]:
    """Add a table that stands at `position`; return the width and the depth of its top. Its height is 0.75 * size."""
    rng = stage.rng
    w, d, h = size * rng.uniform(0.8, 1.7), size * rng.uniform(0.6, 1.0), size * 0.75
    wood = stage.paint(
        str(rng.choice(["wood", "fractal", "wood"])),
        size,
        gloss=float(rng.choice([0, 0.3, 0.8])),
        sharpness=5,
        mirror=float(rng.choice([0, 0, 0.08])),
    )
    turn = rotation(yaw)
    stage.add(box(w, size * 0.04, d), wood, None, turn, position + np.array([0, -h, 0]))
    leg = size * rng.uniform(0.015, 0.05)
    for sx in (-1, 1):
        for sz in (-1, 1):
            place = turn @ np.array([sx * (w / 2 - leg * 2), -h / 2, sz * (d / 2 - leg * 2)])
            stage.add(box(leg, h, leg), wood, None, turn, position + place)
    return float(w), float(d)


def chair(stage: Stage, size: float, position: Float, yaw: float) -> None:
    """Add a chair: thin legs, a seat, a back of bars or cane."""
    rng = stage.rng
    coat = stage.paint(str(rng.choice(["wood", "fractal", "weave"])), size * 0.5)
    turn = rotation(yaw)
    seat, h, leg = size * 0.45, size * 0.45, size * rng.uniform(0.012, 0.035)
    stage.add(box(seat, size * 0.04, seat), coat, None, turn, position + np.array([0, -h, 0]))
    for sx in (-1, 1):
        for sz in (-1, 1):
            tall = 2.0 if sz > 0 else 1.0
            place = turn @ np.array([sx * seat * 0.46, -h * tall / 2, sz * seat * 0.46])
            stage.add(box(leg, h * tall, leg), coat, None, turn, position + place)
    back = turn @ np.array([0, -1.6 * h, seat * 0.46])
    kind = rng.random()
    if kind < 0.4:
        for k in range(int(rng.integers(3, 8))):
            place = turn @ np.array([seat * (k / 7 * 0.9 - 0.4), -1.5 * h, seat * 0.46])
            stage.add(box(leg * 0.8, h, leg * 0.8), coat, None, turn, position + place)
    else:
        stage.add(sheet(seat * 0.95, h * 0.75), coat, None if kind < 0.7 else "lattice", turn, position + back)


def lamp(stage: Stage, size: float, position: Float) -> None:
    """Add a standing lamp: foot, thin pole, bright shade."""
    rng = stage.rng
    pole = stage.paint(size=size, plain=True, gloss=0.8)
    stage.add(
        tube(np.array([[0, 0, 0], [0, -size, 0]]), size * rng.uniform(0.004, 0.012), 8), pole, None, None, position
    )
    radius = size * rng.uniform(0.08, 0.18)
    shade = stage.paint(
        size=radius * 2, albedo=0.7, emission=float(rng.choice([0.0, 0.4, 1.2])), plain=bool(rng.random() < 0.7)
    )
    h = radius * rng.uniform(0.8, 2.0)
    stage.add(
        lathe(np.array([radius * rng.uniform(0.4, 1), radius]), np.array([-h / 2, h / 2]), 36),
        shade,
        None,
        None,
        position + np.array([0, -size, 0]),
    )


def bookshelf(stage: Stage, width: float, height: float, position: Float, yaw: float) -> None:
    """Add a shelf with books; `position` is the middle of its foot."""
    rng = stage.rng
    turn, depth = rotation(yaw), 0.3
    coat = stage.paint("wood", 1.0)
    rows = max(2, int(height / rng.uniform(0.28, 0.45)))
    for k in range(rows + 1):
        stage.add(box(width, 0.02, depth), coat, None, turn, position + np.array([0, -height * k / rows, 0]))
    for side in (-1, 1):
        stage.add(
            box(0.02, height, depth), coat, None, turn, position + turn @ np.array([side * width / 2, -height / 2, 0])
        )
    if rng.random() < 0.7:
        stage.add(sheet(width, height), coat, None, turn, position + turn @ np.array([0, -height / 2, depth / 2]))
    coats = [stage.paint(size=float(rng.uniform(0.1, 0.6)), turned=False) for _ in range(6)]
    for k in range(rows):
        x = -width / 2 + 0.03
        while x < width / 2 - 0.05:
            thick = float(rng.uniform(0.012, 0.06))
            h = height / rows * rng.uniform(0.5, 0.9)
            if rng.random() < 0.85:
                deep = depth * rng.uniform(0.5, 0.95)
                place = turn @ np.array([x + thick / 2, -height * k / rows - h / 2 - 0.01, (depth - deep) / 2 - 0.02])
                lean = rotation(0, 0, float(rng.normal(0, 0.05)) if rng.random() < 0.2 else 0.0)
                stage.add(box(thick, h, deep), coats[int(rng.integers(6))], None, turn @ lean, position + place)
            x += thick * 1.03


def fur(stage: Stage, size: float, position: Float, turn: Float) -> None:
    """Add a hairy ball: tufts of blades all over it."""
    rng = stage.rng
    count = int(rng.integers(150, 700))
    coat = stage.paint(
        str(rng.choice(["strokes", "fractal"])), size * 0.2, gloss=float(rng.choice([0.0, 0.4])), plain=False
    )
    stage.add(blob(size * 0.42, steps=16), coat, None, turn, position)
    out = rng.normal(0, 1, (count, 3))
    out /= np.sqrt((out * out).sum(axis=1, keepdims=True))
    pitch, yaw = -np.arcsin(np.clip(out[:, 1], -1, 1)) - np.pi / 2, np.arctan2(out[:, 0], out[:, 2])
    turns = np.stack([yaw, pitch, rng.uniform(-3, 3, count)], axis=1) + rng.normal(0, 0.25, (count, 3))
    length = size * rng.uniform(0.1, 0.3)
    stage.add(
        cards(out * (size * 0.42 + length * 0.3), turns, length * rng.uniform(0.6, 1.2, (count, 2))),
        coat,
        "blades",
        turn,
        position,
    )


def has_models(stage: Stage) -> bool:
    """Return whether the assets of a stage have models."""
    return stage.assets is not None and bool(stage.assets.models)


def model(stage: Stage, size: float, position: Float, turn: Float) -> None:
    """Add a model of the assets, drawn by chance; its longest side is `size`.

    An upright one (`turn` is a yaw) stands where a cube of that size would.
    """
    rng, assets = stage.rng, stage.assets
    assert assets is not None
    number = int(rng.integers(len(assets.models)))
    shape = assets.model(number)
    bare = bool(rng.random() < _BARE_SHARE)
    coat = _coat(stage, size)
    points = shape.points.astype(np.float64) * size
    if turn[1, 1] > 1 - 1e-9:
        position = position + np.array([0.0, size / 2 - points[:, 1].max(), 0.0])
    for row, (albedo, clear, gloss, picture, repeat) in enumerate(shape.looks):
        triangles = np.flatnonzero(shape.part == row)
        if not len(triangles):
            continue
        corners = slice(3 * triangles[0], 3 * triangles[-1] + 3)
        uv = shape.uv[corners].astype(np.float64)
        own = picture >= 0
        step = size * repeat if own else size  # coordinates are repeats of a picture, or parts of the size
        slot, cut = -1, None
        if own:
            key = (f"model {number}", int(picture))
            if not bare:
                slot = stage.picture(key, shape.pictures[int(picture)])
            if not shape.holes[int(picture)].all():
                cut = (key, shape.holes[int(picture)])
        material = stage.repaint(coat, albedo, gloss=gloss, clear=clear, slot=slot, size=step)
        faces = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
        mesh = Mesh(points[corners], shape.normals[corners].astype(np.float64), np.hstack([uv * step, uv]), faces)
        stage.add(mesh, material, cut, turn, position)


SOLIDS: tuple[_Maker, ...] = (
    _box,
    _ball,
    _lump,
    _vase,
    _can,
    _paper,
    _paper,
    _ring,
    sticks,
    plant,
    fur,
)
"""Makers of loose things: called with the stage, a size, a place, and a turn."""


def standing(stage: Stage, most: int, low: float, high: float, spot: Callable[[], Float]) -> None:
    """Add up to `most` models of the assets, `low` to `high` metres large, that stand at places that `spot` draws."""
    rng = stage.rng
    for _ in range(int(rng.integers(most // 4, most)) if has_models(stage) else 0):
        size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        model(stage, size, spot() - np.array([0, size / 2, 0]), rotation(float(rng.uniform(-3, 3))))


def loose(stage: Stage) -> _Maker:
    """Return the maker of a loose thing, drawn by chance: one of `SOLIDS`, or `model`."""
    if has_models(stage) and stage.rng.random() < _MODEL_SHARE:
        return model
    return SOLIDS[int(stage.rng.integers(len(SOLIDS)))]


def solid(stage: Stage, size: float, position: Float, turn: Float | None = None) -> None:
    """Add a thing of any kind."""
    maker = loose(stage)
    maker(stage, size, position, rotation(*stage.rng.uniform(-3.1, 3.1, 3)) if turn is None else turn)
