"""Synthetic street scenes: stereo pairs whose disparity and occlusion are known exactly, at every pixel.

A scene is a list of planar patches (`_street`) seen by two cameras (`_geometry`) and painted with continuous
textures (`_textures`). Both views are drawn from the same functions at exactly corresponding points, so the
truth is that of the pixel centre, in closed form, and no view was warped from the other. On top come the
hard cases that the StereoVAE paper names (textureless and mirror-like surfaces, brightness that differs
between the views) and a plain camera: blur, gain and offset, Gaussian noise, rounding to 8 bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError
from stereokit_evaluation.synthetic import backdrops
from stereokit_evaluation.synthetic.geometry import Camera, Plane, occlusion, plane_of, rasterise, texture_coordinates
from stereokit_evaluation.synthetic.street import CAMERA_HEIGHT_M, street
from stereokit_evaluation.synthetic.textures import Texture, paint

__all__ = ["CAMERA_HEIGHT_M", "Scene", "generate"]

_BASELINE_M = 0.54  # the baseline, the focal length per width and the horizon are those of the KITTI cameras
_FOCAL_PER_WIDTH = 0.581
_HORIZON = 0.46
_SAMPLES = ((-0.25, -0.25), (0.25, 0.25))  # two per pixel, against stairs along both axes
_GLINT = 0.06  # a highlight weaker than this share is none


@dataclass(frozen=True, eq=False)
class Scene:
    """A stereo pair and all that is known about it.

    Attributes
    ----------
    left, right : (H, W, 3) uint8
        RGB.
    disparity, disparity_right : (H, W) float32, pixels
        Of the left and of the right view, dense and exact; 0 in the sky.
    occluded : (H, W) bool
        Left pixels that the right view does not show: hidden by something nearer, or left of its border.
    objects : (H, W) uint8
        0 for ground, houses, trees and sky, else the number of a car, person, pole or board.
    textureless, specular, brightness : (H, W) bool
        Left pixels on a plain surface; where a highlight lies in either view; where the right view's
        brightness was changed.
    surface : (H, W) int16
        0 for the sky, else 1 + the row of `planes`; 1 is the ground.
    planes : (N, 3) float64
        ``a, b, c`` of each surface's disparity ``a*x + b*y + c`` in the left view.
    focal_px, cx, cy : float
        Focal length and principal point of both cameras, pixels.
    baseline_m : float
        Distance between the cameras, metres.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    disparity: NDArray[np.float32]
    disparity_right: NDArray[np.float32]
    occluded: NDArray[np.bool_]
    objects: NDArray[np.uint8]
    textureless: NDArray[np.bool_]
    specular: NDArray[np.bool_]
    brightness: NDArray[np.bool_]
    surface: NDArray[np.int16]
    planes: NDArray[np.float64]
    focal_px: float
    cx: float
    cy: float
    baseline_m: float

    @property
    def occ(self) -> NDArray[np.float32]:
        """Ground truth of all pixels as KITTI gives it: (H, W) float32, NaN in the sky."""
        return np.where(self.surface > 0, self.disparity, np.float32(np.nan))

    @property
    def noc(self) -> NDArray[np.float32]:
        """Ground truth of the pixels that both views show: `occ`, NaN where occluded."""
        return np.where(self.occluded, np.float32(np.nan), self.occ)


def generate(
    seed: int,
    width: int = 1242,
    height: int = 375,
    max_disparity: int = 128,
    *,
    hard_cases: bool = True,
    noise: float = 2.0,
    blur: float = 0.45,
    gain: float = 0.95,
    offset: float = 3.0,
) -> Scene:
    """Draw a street.

    Parameters
    ----------
    seed : int
        Same seed, same street; the camera's options change nothing of what stands in it.
    width, height : int
        Size in pixels, 1 and up.
    max_disparity : int
        All disparities stay below this, 2 and up; the baseline shrinks if need be.
    hard_cases : bool
        Include textureless, mirror-like and brightness-changed parts.
    noise : float
        Standard deviation of the Gaussian noise of each view and channel, grey levels.
    blur : float
        Standard deviation of the lens blur of both views, pixels.
    gain, offset : float
        The right view is multiplied by `gain`, then raised by `offset` grey levels.

    Returns
    -------
    Scene

    Raises
    ------
    OptionError
        If an option is outside its rule.
    StereokitError
        If scikit-image, which brings the photographs, is not installed.
    """
    for name, value, least in (
        ("seed", seed, 0), ("width", width, 1), ("height", height, 1), ("max_disparity", max_disparity, 2),
    ):  # fmt: skip
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
            raise OptionError(f"{name} must be a whole number of at least {least}, got {value!r}")
    for name, amount in (("noise", noise), ("blur", blur), ("gain", gain)):
        if not (np.isfinite(amount) and amount >= 0):
            raise OptionError(f"{name} must be finite and at least 0, got {amount!r}")
    if not np.isfinite(offset):
        raise OptionError(f"offset must be finite, got {offset!r}")
    world, sensor = (np.random.default_rng([seed, part]) for part in (0, 1))
    patches = street(world, hard_cases=hard_cases)
    heaven = Texture(backdrops.sky(world), 1.0, 1.0)
    columns, rows = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)
    camera = _camera(int(width), int(height), max_disparity)
    while True:
        lefts, rights = ([plane_of(patch, camera, right=side) for patch in patches] for side in (False, True))
        surface, disparity = rasterise(lefts, columns, rows)
        disparity_right = rasterise(rights, columns, rows)[1]
        largest = max(float(disparity.max()), float(disparity_right.max()))
        if largest <= max_disparity - 1:
            break
        camera = replace(camera, baseline_m=camera.baseline_m * 0.98 * (max_disparity - 1) / largest)
    pictures = []
    for planes in (lefts, rights):
        picture: NDArray[Any] = _render(planes, heaven, int(width), int(height), right=planes is rights)
        if blur > 0:
            picture = cv2.GaussianBlur(picture, (0, 0), blur).reshape(picture.shape)
        if planes is rights:
            picture = picture * np.float32(gain) + np.float32(offset)
        if noise > 0:
            picture += np.float32(noise) * sensor.standard_normal(picture.shape, np.float32)
        pictures.append(np.clip(np.rint(picture), 0, 255).astype(np.uint8))
    numbers = np.array([0] + [patch.object_id for patch in patches], np.uint8)
    regions = _regions(lefts, surface)
    nothing = np.zeros(3)
    return Scene(
        left=pictures[0],
        right=pictures[1],
        disparity=disparity.astype(np.float32),
        disparity_right=disparity_right.astype(np.float32),
        occluded=occlusion(rights, disparity),
        objects=numbers[surface],
        textureless=regions["textureless"],
        specular=regions["specular"],
        brightness=regions["brightness"],
        surface=surface,
        planes=np.array([nothing if plane is None else plane.disparity for plane in lefts]),
        focal_px=camera.focal,
        cx=camera.cx,
        cy=camera.cy,
        baseline_m=camera.baseline_m,
    )


def _camera(width: int, height: int, max_disparity: int) -> Camera:
    """Return a camera like KITTI's; where `max_disparity` is small for the size, with a shorter baseline."""
    focal = _FOCAL_PER_WIDTH * max(width, 1.6 * height)
    cx, cy = (width - 1) / 2, _HORIZON * height - 0.5
    ground = focal * CAMERA_HEIGHT_M / max(height - 1 - cy, 1e-6)  # the nearest ground that shows
    return Camera(focal, cx, cy, min(_BASELINE_M, min(ground, 6.0) * (max_disparity - 1) / focal))


def _split(surface: NDArray[np.int16]) -> list[tuple[int, NDArray[np.intp]]]:
    """Return each number in `surface` with the flat positions of its pixels, in reading order."""
    flat = surface.ravel()
    order = np.argsort(flat, kind="stable")
    numbers, starts = np.unique(flat[order], return_index=True)
    return [(int(number), part) for number, part in zip(numbers, np.split(order, starts[1:]), strict=True)]


def _render(
    planes: Sequence[Plane | None], heaven: Texture, width: int, height: int, *, right: bool
) -> NDArray[np.float32]:
    """Return one view without camera effects, (H, W, 3) float32."""
    picture = np.zeros((height * width, 3), np.float32)
    for dx, dy in _SAMPLES:
        columns = np.arange(width, dtype=np.float64) + dx
        rows = np.arange(height, dtype=np.float64) + dy
        for number, where in _split(rasterise(planes, columns, rows)[0]):
            x, y = columns[where % width], rows[where // width]
            plane = planes[number - 1] if number else None
            if plane is None:
                colour = heaven(x / width, y / (_HORIZON * height), np.zeros(x.size))
            else:
                u, v, depth, step = texture_coordinates(plane, x, y)
                colour = paint(plane.patch.look, u, v, depth, step, right=right)
            picture[where] += colour
    mean: NDArray[np.float32] = np.clip(picture / np.float32(len(_SAMPLES)), 0, 255)
    return mean.reshape(height, width, 3)


def _regions(planes: Sequence[Plane | None], surface: NDArray[np.int16]) -> dict[str, NDArray[np.bool_]]:
    """Return the masks of the hard cases in the left view."""
    width = surface.shape[1]
    masks = {kind: np.zeros(surface.size, np.bool_) for kind in ("textureless", "specular", "brightness")}
    for number, where in _split(surface):
        plane = planes[number - 1] if number else None
        if plane is None or not (plane.patch.look.flat or plane.patch.look.decals):
            continue
        look = plane.patch.look
        if look.flat:
            masks["textureless"][where] = True
        x, y = (where % width).astype(np.float64), (where // width).astype(np.float64)
        u, v, _, _ = texture_coordinates(plane, x, y)
        for decal in look.decals:
            inside = decal.inside(u, v)
            if decal.kind == "specular":
                inside &= np.maximum(decal.highlight(u, v, right=False), decal.highlight(u, v, right=True)) > _GLINT
            masks[decal.kind][where[inside]] = True
    return {kind: mask.reshape(surface.shape) for kind, mask in masks.items()}
