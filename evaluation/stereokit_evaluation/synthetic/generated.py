"""Stereo pairs of many kinds of scenes from a seed: `generate_pair`, and `pairs` for a training set."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.scenes import generate
from stereokit_evaluation.synthetic.closeups import closeup
from stereokit_evaluation.synthetic.objects import flying, pile
from stereokit_evaluation.synthetic.outdoor import garden, road
from stereokit_evaluation.synthetic.render import Rendered, Rig, render
from stereokit_evaluation.synthetic.rooms import hall, room
from stereokit_evaluation.synthetic.sensors import Sensor, draw_sensors, expose
from stereokit_evaluation.synthetic.stage import Stage
from stereokit_evaluation.synthetic.terrain import terrain

__all__ = ["KINDS", "GeneratedPair", "generate_pair"]

Rng = np.random.Generator

KINDS: dict[str, Callable[[Stage], None]] = {
    "flying": flying, "pile": pile, "room": room, "hall": hall, "terrain": terrain, "closeup": closeup, "road": road, "garden": garden,
}  # fmt: skip
_SIZES = ((640, 384), (640, 480), (720, 480), (768, 432), (800, 448), (832, 384), (960, 384), (960, 544))


@dataclass(frozen=True, eq=False)
class GeneratedPair:
    """A pair and its truth.

    Attributes
    ----------
    left, right : (H, W) uint8
        Grey.
    truth : (H, W) float32, pixels
        Disparity at the centres of the left pixels; 0 in the sky.
    seen : (H, W) bool
        Visible in both views.
    kind, seed : str and int
        What made it.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    truth: NDArray[np.float32]
    seen: NDArray[np.bool_]
    kind: str
    seed: int


def _street(seed: int, width: int, height: int, largest: float, sensors: tuple[Sensor, Sensor], noise: Rng) -> Rendered:
    """Return a street of `stereokit_evaluation.scenes` taken by these cameras."""
    scene = generate(seed, width, height, max(int(largest), 16), noise=0, blur=0, gain=1, offset=0)
    pictures = []
    for view, truth, sensor in ((scene.left, scene.disparity, sensors[0]), (scene.right, scene.disparity_right, sensors[1])):
        grey = cv2.cvtColor(view, cv2.COLOR_RGB2GRAY)
        light = ((np.arange(256) / 255) ** 2.2)[grey].repeat(2, axis=0).repeat(2, axis=1)
        fine = truth.astype(np.float64).repeat(2, axis=0).repeat(2, axis=1)
        pictures.append(expose((light / 0.2).astype(np.float32), fine, sensor, noise))
    return Rendered(pictures[0], pictures[1], scene.disparity, ~scene.occluded)


def generate_pair(seed: int, kind: str) -> GeneratedPair:
    """Return the pair of a kind that a seed stands for."""
    number = sum(ord(letter) << (3 * k) for k, letter in enumerate(kind))
    world, camera, noise = (np.random.default_rng([seed, number, part]) for part in range(3))
    width, height = _SIZES[int(camera.integers(len(_SIZES)))]
    largest = float(np.exp(camera.uniform(np.log(12), np.log(200))))
    harsh = float(camera.beta(1.1, 2.6)) if kind != "terrain" else float(camera.beta(2.0, 1.6))
    crooked = camera.random() < (0.4 if kind != "terrain" else 0.7)
    left, right = draw_sensors(camera, harsh)
    rig = Rig(
        width, height, min(largest, width / 4), float(camera.uniform(0.5, 6)),
        lift=float(camera.uniform(-0.4, 0.4)) if crooked else float(camera.normal(0, 0.04)),
        roll=float(camera.normal(0, 2.5e-4)) if crooked else 0.0,
        left=left, right=right,
    )  # fmt: skip
    if kind == "street":
        made = _street(seed, width, height, rig.largest, (left, right), noise)
    else:
        stage = Stage(world)
        KINDS[kind](stage)
        made = render(stage, rig, noise)
    return GeneratedPair(made.left, made.right, made.truth, made.seen, kind, seed)


def pairs(count: int, seed: int = 0) -> Iterator[GeneratedPair]:
    """Yield `count` pairs, kinds in turn."""
    names = list(KINDS)
    for k in range(count):
        yield generate_pair(seed + k, names[k % len(names)])
