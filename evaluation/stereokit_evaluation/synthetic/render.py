"""Two views of a stage, the truth of the left one, and which of its pixels the right one shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.meshes import Mesh
from stereokit_evaluation.synthetic.raster import edge_functions, hidden, visible
from stereokit_evaluation.synthetic.sensors import Sensor, expose
from stereokit_evaluation.synthetic.shading import LIGHT, MATERIAL, shade
from stereokit_evaluation.synthetic.stage import Stage, Triangles

__all__ = ["Rendered", "Rig", "render"]

Float = NDArray[np.float64]

_SHADOW_SIDE = 1024
_SLACK_PX = 1e-3


@dataclass(frozen=True)
class Rig:
    """Two cameras.

    Attributes
    ----------
    width, height : int
        Pixels.
    largest : float
        Disparity of the nearest pixel of the left view; the baseline follows from it.
    smallest : float
        Disparity of the farthest one, for a stage with an offset.
    lift, roll : float
        How far the right picture lies below its place, pixels, and how it is turned, radians: what a calibration
        leaves.
    left, right : Sensor
    """

    width: int
    height: int
    largest: float
    smallest: float
    lift: float
    roll: float
    left: Sensor
    right: Sensor


@dataclass(frozen=True, eq=False)
class Rendered:
    """A pair, its truth at the pixel centres of the left view, and what both views see."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    truth: NDArray[np.float32]
    seen: NDArray[np.bool_]


def _shadows(scene: Triangles, stage: Stage, sun: Float) -> tuple[Float, Float, float]:
    """Return the view of the sun: inverse depths, its camera as (3, 4), and its focal length."""
    centre = (stage.shadow_centre - stage.place) @ stage.turn
    forward = -sun
    aside = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0])
    aside /= np.sqrt((aside * aside).sum())
    turn = np.stack([aside, np.cross(forward, aside), forward])
    far = 400.0 * stage.shadows
    shift = -turn @ (centre - far * forward)
    points = scene.mesh.points @ turn.T + shift
    focal = _SHADOW_SIDE / 2 / stage.shadows * far
    edges = edge_functions(points, scene.mesh.faces)
    middle = _SHADOW_SIDE / 2 - 0.5
    _, inverse = visible(
        points,
        scene.mesh.faces,
        edges,
        scene.mesh.uv,
        scene.mask,
        scene.masks,
        focal,
        middle,
        middle,
        0.0,
        1.0,
        _SHADOW_SIDE,
        0.0,
        1.0,
        _SHADOW_SIDE,
    )
    return inverse, np.concatenate([turn, shift[:, None]], axis=1), focal


def render(stage: Stage, rig: Rig, noise: np.random.Generator) -> Rendered:
    """Return the pair that two cameras take of a stage.

    Parameters
    ----------
    stage : Stage
        The scene.
    rig : Rig
        The cameras.
    noise : Generator
        Draws the noise.
    """
    scene = stage.triangles()
    mesh, width, height = scene.mesh, rig.width, rig.height
    focal = width / 2 / float(np.tan(stage.field_of_view / 2))
    cx, cy = (width - 1) / 2, (height - 1) / 2
    fixed: tuple[Any, ...] = (mesh.uv, scene.mask, scene.masks)
    edges = edge_functions(mesh.points, mesh.faces)
    _, inverse = visible(mesh.points, mesh.faces, edges, *fixed, focal, cx, cy, 0.0, 1.0, width, 0.0, 1.0, height)
    nearest, farthest = max(float(inverse.max()), 1e-9), float(inverse.min())
    spread = nearest - farthest if stage.offset else nearest
    wanted = rig.largest - rig.smallest if stage.offset else rig.largest
    baseline = min(wanted / (focal * max(spread, 1e-12)), stage.base_ratio / nearest)
    shift = focal * baseline * farthest - rig.smallest if stage.offset else 0.0
    disparity = np.maximum(focal * baseline * inverse - shift, 0.0)

    moved = mesh.points - np.array([baseline, 0.0, 0.0])
    right_edges = edge_functions(moved, mesh.faces)
    x = np.arange(width)[None] - disparity
    order = np.argsort(x, axis=1, kind="stable")
    covered = hidden(
        moved,
        mesh.faces,
        right_edges,
        *fixed,
        focal,
        cx + shift,
        cy,
        np.take_along_axis(x, order, axis=1),
        np.take_along_axis(inverse, order, axis=1),
        _SLACK_PX / (focal * baseline),
    )
    seen = np.empty_like(covered)
    np.put_along_axis(seen, order, ~covered, axis=1)
    seen &= x >= 0

    cosine, sine = float(np.cos(rig.roll)), float(np.sin(rig.roll))
    roll = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    pictures = []
    gain = 0.0
    opaque = scene.materials[scene.material, MATERIAL.index("clear")] == 0
    materials = scene.materials
    for right in (False, True):
        if right and stage.fickle > 0:
            materials = materials.copy()
            materials[:, [5, 6, 10]] *= np.exp(stage.fickle * noise.standard_normal((len(materials), 3)))
        if not right or stage.later:
            light = stage.lights(right=right)
            light[LIGHT.index("shadow_bias")] = 4 * stage.shadows / _SHADOW_SIDE
            shadow, sun_turn, sun_focal = np.zeros((1, 1)), np.zeros((3, 4)), 1.0
            if stage.shadows > 0 and light[LIGHT.index("sun")] > 0:
                shadow, sun_turn, sun_focal = _shadows(scene, stage, light[:3])
        points = moved @ roll.T if right else mesh.points
        view = Mesh(points, mesh.normals, mesh.uv, mesh.faces)
        own = edge_functions(points, mesh.faces) if right else edges
        middle_x, middle = (cx + shift, cy + rig.lift) if right else (cx, cy)
        place = (-0.25, 0.5, 2 * width, -0.25, 0.5, 2 * height)
        shown, near = visible(view.points, view.faces, own, *fixed, focal, middle_x, middle, *place)
        rest = (
            materials,
            scene.bank,
            light,
            shadow,
            sun_turn,
            sun_focal,
            focal,
            middle_x,
            middle,
            -0.25,
            0.5,
            -0.25,
            0.5,
            baseline if right else 0.0,
            cosine if right else 1.0,
            sine if right else 0.0,
        )
        behind = np.zeros((1, 1), np.float32)
        if not opaque.all():
            through, deep = visible(
                view.points,
                view.faces[opaque],
                own[opaque],
                mesh.uv,
                scene.mask[opaque],
                scene.masks,
                focal,
                middle_x,
                middle,
                *place,
            )
            panes = (shown >= 0) & ~opaque[np.maximum(shown, 0)]
            behind = shade(
                np.where(panes, through, -2).astype(np.int32),
                deep,
                own[opaque],
                view.faces[opaque],
                view.uv,
                view.normals,
                scene.material[opaque],
                *rest,
                behind,
            )
        bright = shade(shown, near, own, view.faces, view.uv, view.normals, scene.material, *rest, behind)
        gain = gain or 1 / max(float(np.minimum(bright, 1.5).mean()), 1e-3)
        pictures.append(
            expose(
                bright * np.float32(gain),
                np.maximum(near * focal * baseline - shift, 0.0),
                rig.right if right else rig.left,
                noise,
            )
        )
    return Rendered(pictures[0], pictures[1], disparity.astype(np.float32), seen)
