"""A street as a list of flat patches: ground, houses, trees, parked and moving cars, people, poles.

All sizes are metres, so that a picture of any size shows the same street. Everything is drawn from one
generator in a fixed order: the same seed gives the same street whatever the image size.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic import backdrops, sprites
from stereokit_evaluation.synthetic.geometry import Patch
from stereokit_evaluation.synthetic.textures import Decal, Look, Texture, photograph

__all__ = ["CAMERA_HEIGHT_M", "street"]

CAMERA_HEIGHT_M = 1.65
"""Height of both cameras above the ground, as on the KITTI car."""

_KERB_M = 5.6
_HALF_WIDTH_M = 13.0
_FAR_M = 95.0

Colour = tuple[float, float, float]
Bytes = NDArray[np.uint8]
Rng = np.random.Generator

_PLASTER: tuple[Colour, ...] = (
    (206, 176, 128), (190, 122, 92), (170, 178, 160), (214, 202, 178), (150, 92, 76), (184, 150, 150),
    (150, 164, 182), (222, 188, 110), (196, 196, 192), (128, 84, 70),
)  # fmt: skip
_PAINT: tuple[Colour, ...] = (
    (168, 28, 32), (34, 66, 128), (196, 198, 202), (58, 62, 68), (228, 228, 224), (30, 92, 74),
    (204, 146, 34), (92, 126, 158), (110, 30, 52),
)  # fmt: skip
_LEAVES: tuple[Colour, ...] = ((92, 124, 50), (72, 108, 46), (128, 132, 44), (176, 122, 38), (84, 116, 64))
_LEAFY, _WOVEN, _PAINTED = ("grass", 1.7, 0.4), ("brick", 1.1, 0.35), ("gravel", 0.9, 0.2)
_PICTURES = ("chelsea", "astronaut", "coffee", "rocket")


@lru_cache(maxsize=8)
def _grain(name: str, size_m: float) -> Texture:
    """Return a photograph as a grey tile, its slow changes of brightness taken out."""
    grey = photograph(name).astype(np.float32)
    return Texture(np.clip(grey - grey.mean() + 128, 0, 255).astype(np.uint8), size_m, size_m, tile=True)


def _glint(u0: float, v0: float, u1: float, v1: float, u: float, v: float, radius: float, shift: float) -> Decal:
    """Return a highlight at (u, v) within a pane, `shift` metres further along u in the right view."""
    return Decal(
        "specular",
        u0,
        v0,
        u1,
        v1,
        (205.0, 210.0, 214.0),
        u=u,
        v=v,
        radius_u=radius,
        radius_v=radius,
        shift_u=shift,
    )


class _Street:
    """The list as it grows; one instance per street."""

    def __init__(self, rng: Rng, *, hard_cases: bool) -> None:
        self.rng = rng
        self.hard = hard_cases
        self.patches: list[Patch] = []
        self.objects = 0
        self.pictures = list(rng.permutation(_PICTURES))

    def _one_of(self, choices: tuple[Colour, ...]) -> Colour:
        r, g, b = choices[int(self.rng.integers(len(choices)))]
        return r, g, b

    def _new_object(self) -> int:
        self.objects = min(self.objects + 1, 255)
        return self.objects

    def upright(self, image: Bytes, mask: NDArray[np.bool_] | None, middle: float, z: float, width: float,
                height: float, *, foot: float = 0.0, light: float = 1.0, yaw: float = 0.0, object_id: int = 0,
                grain: tuple[str, float, float] = ("gravel", 1.7, 0.3),
                decals: tuple[Decal, ...] = ()) -> None:  # fmt: skip
        """Stand a picture up, facing the camera but for `yaw` (radians), its foot `foot` above the ground."""
        across = (float(np.cos(yaw)), 0.0, float(np.sin(yaw)))
        top = CAMERA_HEIGHT_M - foot - height
        origin = (middle - across[0] * width / 2, top, z - across[2] * width / 2)
        look = Look(Texture(image, width, height), _grain(grain[0], grain[1]), grain[2], light, decals)
        self.patches.append(Patch(origin, across, (0, 1, 0), width, height, look, object_id, mask))

    def houses(self, side: int) -> None:
        """Put up one row of houses along the street, left (-1) or right (+1)."""
        rng = self.rng
        light = 1.08 if side > 0 else 0.74
        z = -3.0
        while z < 78:
            width, height = float(rng.uniform(9, 16)), float(rng.uniform(8, 15))
            distance = 8.6 + float(rng.uniform(0, 1.6))
            colour, brick = self._one_of(_PLASTER), rng.random() < 0.5
            grain = _grain("brick", 1.9) if brick else _grain("gravel", 2.0)
            bare = self.hard and 12 < z < 40 and rng.random() < 0.3
            fine = 40.0 if z < 20 else 20.0 if z < 45 else 12.0
            lean = float(rng.uniform(-0.035, 0.035))
            decals = self._facade_decals(width, height) if not bare else ()
            look = Look(
                Texture(backdrops.facade(rng, width, height, colour, bare=bare, scale=fine), width, height),
                None if bare else grain, 0.9 if brick else 0.35, light, decals, flat=bare,
            )  # fmt: skip
            top = CAMERA_HEIGHT_M - height
            along = (side * float(np.sin(lean)), 0.0, float(np.cos(lean)))
            if side < 0:
                corner = (-distance, top, z)
            else:  # pictures run from left to right as seen from the street, so from the far end
                corner = (distance + along[0] * width, top, z + along[2] * width)
                along = (-along[0], 0.0, -along[2])
            self.patches.append(Patch(corner, along, (0, 1, 0), width, height, look))
            gable = Look(
                Texture(backdrops.facade(rng, 9.0, height, colour, scale=min(fine, 24.0)), 9.0, height),
                grain, 0.8, light * 0.85,
            )  # fmt: skip
            start = -distance - 9.0 if side < 0 else distance
            self.patches.append(Patch((start, top, z), (1, 0, 0), (0, 1, 0), 9.0, height, gable))
            if 4 < z < 34 and self.pictures and rng.random() < 0.75:
                self._poster(corner, along, side, width, height, light)
            z += width + (float(rng.uniform(2.5, 6)) if rng.random() < 0.35 else 0.0)

    def _poster(self, corner: tuple[float, float, float], along: tuple[float, float, float], side: int,
                width: float, height: float, light: float) -> None:  # fmt: skip
        """Hang a photograph on a house, a hand's breadth in front of the wall."""
        image = photograph(self.pictures.pop())
        tall = 3.0
        wide = tall * image.shape[1] / image.shape[0]
        u = float(self.rng.uniform(0.2, max(0.3, width - wide - 0.2)))
        place = (corner[0] + along[0] * u - side * 0.12, corner[1] + height - 6.6, corner[2] + along[2] * u)
        look = Look(Texture(image, wide, tall), None, 0.0, light * 1.05)
        self.patches.append(Patch(place, along, (0, 1, 0), wide, tall, look))

    def _facade_decals(self, width: float, height: float) -> tuple[Decal, ...]:
        """Return a hard case for matching on a house: empty plaster or a changed brightness."""
        rng = self.rng
        if not self.hard:
            return ()
        decals: list[Decal] = []
        kind = rng.random()
        u, v = float(rng.uniform(0.5, width - 4)), float(rng.uniform(height - 6.5, height - 3.2))
        if kind < 0.3:
            tone = float(rng.uniform(150, 205))
            decals.append(Decal("textureless", u, v, u + 2.6, v + 2.4, colour=(tone, tone * 0.97, tone * 0.9)))
        elif kind < 0.6:
            gain = float(rng.choice([0.6, 0.7, 1.35]))
            decals.append(Decal("brightness", u, v, u + 3.4, v + 3.0, gain=gain, offset=6.0))
        return tuple(decals)

    def cars(self, places: list[tuple[float, float]]) -> None:
        """Put cars at (X of the middle, Z of the near end); those beyond the middle line come towards us."""
        rng = self.rng
        for middle, z in places:
            number, colour = self._new_object(), self._one_of(_PAINT)
            light = float(rng.uniform(0.85, 1.05))
            image, mask = sprites.car_end(colour, front=middle < 0)
            decals: tuple[Decal, ...] = ()
            if self.hard and rng.random() < 0.4:
                decals = (
                    _glint(
                        0.3,
                        0.12,
                        1.5,
                        0.66,
                        float(rng.uniform(0.6, 1.0)),
                        0.35,
                        0.16,
                        float(rng.uniform(0.1, 0.4)),
                    ),
                )
            self.upright(
                image,
                mask,
                middle,
                z,
                1.8,
                1.55,
                light=light,
                object_id=number,
                grain=_PAINTED,
                decals=decals,
            )
            inner = middle - 0.9 if middle > 0 else middle + 0.9
            if abs(inner) < 0.8 or inner * middle < 0:
                continue
            side_image, side_mask = sprites.car_side(colour, van=middle < 0)
            plain = self.hard and rng.random() < 0.25
            top = CAMERA_HEIGHT_M - 1.55
            if middle < 0:  # the near end at the left of the picture
                origin, along = (inner, top, z), (0.0, 0.0, 1.0)
            else:
                origin, along = (inner, top, z + 4.3), (0.0, 0.0, -1.0)
                side_image, side_mask = side_image[:, ::-1], side_mask[:, ::-1]
            panel = (Decal("textureless", 0.9, 0.72, 3.2, 1.18, colour),) if plain else ()
            look = Look(
                Texture(np.ascontiguousarray(side_image), 4.3, 1.55),
                _grain("gravel", 0.9),
                0.2,
                light * 0.8,
                panel,
            )
            self.patches.append(
                Patch(origin, along, (0, 1, 0), 4.3, 1.55, look, number, np.ascontiguousarray(side_mask))
            )

    def furniture(self) -> None:
        """Put trees, lamps, signs, people, boxes and hedges on both pavements."""
        rng = self.rng
        for side in (-1, 1):
            for z in np.arange(float(rng.uniform(11, 17)), 70, 13.0):
                wide, tall = float(rng.uniform(3.6, 5.2)), float(rng.uniform(5.6, 7.6))
                x = side * float(rng.uniform(6.4, 7.2))
                image, mask = sprites.tree(rng, wide, tall, self._one_of(_LEAVES), scale=44.0 if z < 30 else 24.0)
                self.upright(image, mask, x, float(z), wide, tall, light=1.0 if side > 0 else 0.85, grain=_LEAFY)
            for z in (float(rng.uniform(7.0, 9.5)), float(rng.uniform(20, 28)), float(rng.uniform(38, 50))):
                grey = float(rng.uniform(70, 150))
                pole = np.linspace(1.25, 0.5, 16)[None, :, None] * np.full((64, 1, 3), grey)
                x, number = side * float(rng.uniform(5.9, 6.2)), self._new_object()
                tall = float(rng.uniform(2.6, 3.2)) if rng.random() < 0.5 else 7.0
                picture = np.clip(pole, 0, 255).astype(np.uint8)
                self.upright(picture, None, x, z, 0.13, tall, object_id=number)
                if tall < 4:
                    image, mask = sprites.sign(rng)
                    self.upright(image, mask, x, z - 0.06, 0.8, 0.8, foot=tall - 0.75, object_id=number)
            for _ in range(int(rng.integers(1, 3))):
                image, mask = sprites.person(rng)
                x, z = side * float(rng.uniform(6.3, 7.8)), float(rng.uniform(9, 26))
                tall = float(rng.uniform(1.6, 1.9))
                self.upright(image, mask, x, z, 0.8 * tall / 1.8, tall, yaw=float(rng.uniform(-0.4, 0.4)),
                             object_id=self._new_object(), grain=_WOVEN)  # fmt: skip
            wide, tall = float(rng.uniform(2, 4)), float(rng.uniform(0.7, 1.1))
            x, z = side * 7.4, float(rng.uniform(10, 22))
            self.upright(sprites.hedge(rng, wide, tall), None, x, z, wide, tall, grain=_LEAFY,
                         yaw=-side * float(rng.uniform(0.2, 0.7)))  # fmt: skip
        if self.pictures:  # a board on the pavement
            picture = photograph(self.pictures.pop())
            side = int(rng.choice([-1, 1]))
            self.upright(picture, None, side * float(rng.uniform(6.6, 7.2)), float(rng.uniform(9, 13)),
                         1.5 * picture.shape[1] / picture.shape[0], 1.5, foot=0.35,
                         object_id=self._new_object(),
                         yaw=-side * float(rng.uniform(0.1, 0.5)))  # fmt: skip

    def far_end(self) -> None:
        """Close the street with a house across it and trees before it."""
        rng = self.rng
        for x in np.arange(-60, 60, 15.0):
            height = float(rng.uniform(9, 17))
            image = backdrops.facade(rng, 15.0, height, self._one_of(_PLASTER), scale=10.0)
            z = _FAR_M - float(rng.uniform(0, 6))
            self.upright(image, None, float(x) + 7.5, z, 15.0, height, grain=_WOVEN, light=0.95)
        for x in np.arange(-26, 27, 6.5):
            wide, tall = float(rng.uniform(6, 9)), float(rng.uniform(6, 10))
            image, mask = sprites.tree(rng, wide, tall, self._one_of(_LEAVES), scale=16.0)
            self.upright(image, mask, float(x), float(rng.uniform(76, 84)), wide, tall, grain=_LEAFY)


def street(rng: Rng, *, hard_cases: bool = True) -> list[Patch]:
    """Return the patches of a street; the first one is the ground plane.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all choices come from.
    hard_cases : bool
        Include textureless, mirror-like and brightness-changed parts.
    """
    town = _Street(rng, hard_cases=hard_cases)
    places = [(float(rng.uniform(1.5, 2.2)), float(rng.uniform(13, 24)))]
    places.append((float(rng.uniform(-2.3, -1.6)), float(rng.uniform(15, 32))))
    for side in (-1, 1):
        z = float(rng.uniform(6.0, 9.0))
        while z < 50:
            if rng.random() < 0.75:
                places.append((side * float(rng.uniform(4.35, 4.7)), z))
            z += float(rng.uniform(5.4, 8.5))
    image = backdrops.ground(rng, _HALF_WIDTH_M, _FAR_M, _KERB_M, places)
    decals: tuple[Decal, ...] = ()
    if hard_cases:
        u, v = _HALF_WIDTH_M + float(rng.uniform(-3.5, 1.0)), _FAR_M - float(rng.uniform(9.5, 13))
        decals = (
            Decal("brightness", u, v, u + 2.4, v + 3.5, gain=float(rng.choice([0.65, 1.3])), offset=4.0),
            replace(
                _glint(0.0, 0.0, 2 * _HALF_WIDTH_M, _FAR_M, _HALF_WIDTH_M + float(rng.uniform(-2, 1)),
                       _FAR_M - float(rng.uniform(9, 14)), 0.5, 0.54),
                colour=(90.0, 88.0, 82.0), radius_v=2.5,
            ),
        )  # fmt: skip
    look = Look(Texture(image, 2 * _HALF_WIDTH_M, _FAR_M), _grain("gravel", 1.3), 0.55, 1.0, decals)
    far = (-_HALF_WIDTH_M, CAMERA_HEIGHT_M, _FAR_M)
    town.patches.append(Patch(far, (1, 0, 0), (0, 0, -1), 2 * _HALF_WIDTH_M, _FAR_M, look))
    for x in (-60.0, _HALF_WIDTH_M):
        lawn = Look((88.0, 112.0, 62.0), _grain("grass", 2.0), 0.8)
        town.patches.append(
            Patch((x, CAMERA_HEIGHT_M, _FAR_M), (1, 0, 0), (0, 0, -1), 60 - _HALF_WIDTH_M, _FAR_M, lawn)
        )
    town.houses(-1)
    town.houses(1)
    town.far_end()
    town.furniture()
    town.cars(places)
    return town.patches
