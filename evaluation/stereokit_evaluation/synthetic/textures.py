"""Continuous textures: pyramids that are sampled at any real position, and what a patch is painted with.

A texture is a function of metres on its patch, so both views can ask for its colour at exactly corresponding
points. It is read bilinearly between two pyramid levels (Williams, "Pyramidal parametrics", SIGGRAPH 1983);
the level is a function of the left pixel, hence the same in both views. The photographs come with
scikit-image, inside its wheel; nothing is downloaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import StereokitError

__all__ = ["Decal", "Look", "Texture", "paint", "photograph"]

_COLUMNS = 1024  # cv2.remap takes at most 32767 rows: long lists of points are folded

Colour = tuple[float, float, float]
Bytes = NDArray[np.uint8]
Float = NDArray[np.float64]
Float32 = NDArray[np.float32]


@lru_cache(maxsize=16)
def photograph(name: str) -> Bytes:
    """Return a photograph of scikit-image as (H, W) or (H, W, 3) uint8, RGB, read-only.

    Raises
    ------
    StereokitError
        If scikit-image is not installed.
    """
    try:
        from skimage import data
    except ImportError as error:
        raise StereokitError(
            "synthetic scenes need scikit-image's photographs; pip install stereokit[scenes]"
        ) from error
    image: Bytes = np.ascontiguousarray(getattr(data, name)(), np.uint8)
    image.setflags(write=False)
    return image


class Texture:
    """An image as a function of metres, with a pyramid against aliasing.

    Parameters
    ----------
    image : (h, w) or (h, w, 3) uint8
        The finest level.
    width_m, height_m : float
        Size that the image covers on the patch. Past it a tile repeats, mirrored; any other image keeps its
        border.
    tile : bool
        Whether it repeats.
    """

    def __init__(self, image: Bytes, width_m: float, height_m: float, *, tile: bool = False) -> None:
        if tile:
            image = np.concatenate([image, image[:, ::-1]], axis=1)
            image = np.concatenate([image, image[::-1]], axis=0)
            width_m, height_m = 2 * width_m, 2 * height_m
        self.width_m, self.height_m, self.tile = width_m, height_m, tile
        self.step = max(width_m / image.shape[1], height_m / image.shape[0])
        levels: list[Any] = [image]
        while min(levels[-1].shape[:2]) > 4 and len(levels) < 9:
            h, w = levels[-1].shape[:2]
            levels.append(cv2.resize(levels[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA))
        border = cv2.BORDER_WRAP if tile else cv2.BORDER_REPLICATE
        framed = [cv2.copyMakeBorder(level, 1, 1, 1, 1, border) for level in levels]
        tops = np.cumsum([0] + [level.shape[0] for level in framed])
        self._atlas = np.zeros((tops[-1], framed[0].shape[1], *image.shape[2:]), np.uint8)
        for top, level in zip(tops, framed, strict=False):
            self._atlas[top : top + level.shape[0], : level.shape[1]] = level
        self._tops = tops[:-1].astype(np.float32)
        self._sizes = np.array([level.shape[:2] for level in levels], np.float32)

    def __call__(self, u: Float, v: Float, footprint_m: Float) -> Float32:
        """Return the colour at metres `u`, `v`, each (n,), as (n,) or (n, 3) float32 in 0..255.

        `footprint_m` (n,) is how far one pixel reaches on the patch.
        """
        s, t = (u / self.width_m).astype(np.float32), (v / self.height_m).astype(np.float32)
        if self.tile:
            s, t = s - np.floor(s), t - np.floor(t)
        else:
            s, t = np.clip(s, 0, 1), np.clip(t, 0, 1)
        last = len(self._sizes) - 1
        level = np.clip(np.log2(np.maximum(footprint_m / self.step, 1.0)), 0, last).astype(np.float32)
        fine = level.astype(np.intp)
        out = self._level(s, t, fine)
        share = level - fine
        if not share.any():
            return out
        coarse = self._level(s, t, np.minimum(fine + 1, last))
        return np.asarray(out + (share if out.ndim == 1 else share[:, None]) * (coarse - out))

    def _level(self, s: Float32, t: Float32, level: NDArray[np.intp]) -> Float32:
        rows, columns = self._sizes[level, 0], self._sizes[level, 1]
        n = s.size
        folded = np.zeros((2, -(-n // _COLUMNS) * _COLUMNS), np.float32)
        folded[0, :n] = s * columns + np.float32(0.5)  # + 1 for the frame, - 0.5 for the pixel centre
        folded[1, :n] = t * rows + (self._tops[level] + np.float32(0.5))
        x, y = folded.reshape(2, -1, _COLUMNS)
        picked = cv2.remap(self._atlas, x, y, cv2.INTER_LINEAR)
        return np.asarray(picked.reshape(x.size, *self._atlas.shape[2:])[:n], np.float32)


@dataclass(frozen=True)
class Decal:
    """A rectangle of a patch that is hard to match.

    Attributes
    ----------
    kind : {"textureless", "specular", "brightness"}
        A flat colour with a weak gradient; a highlight that each view sees in another place;
        a change of brightness in the right view only, soft over 0.4 m at its edges.
    u0, v0, u1, v1 : float
        Where it is, metres on the patch.
    colour : tuple of 3 float
        The flat colour, or the highlight's.
    gain, offset : float
        What the right view's brightness is multiplied by, then raised by, for ``"brightness"``.
    u, v, radius_u, radius_v : float
        Centre and reach of the highlight on the patch in the left view, metres.
    shift_u : float
        How far along `u` the right view sees it from there, metres. The image of a distant lamp in a mirror
        that faces the camera moves by the whole baseline.
    """

    kind: Literal["textureless", "specular", "brightness"]
    u0: float
    v0: float
    u1: float
    v1: float
    colour: Colour = (255.0, 255.0, 255.0)
    gain: float = 1.0
    offset: float = 0.0
    u: float = 0.0
    v: float = 0.0
    radius_u: float = 1.0
    radius_v: float = 1.0
    shift_u: float = 0.0

    def inside(self, u: Float, v: Float) -> NDArray[np.bool_]:
        """Return which points of the patch it covers."""
        return np.asarray((u >= self.u0) & (u < self.u1) & (v >= self.v0) & (v < self.v1))

    def highlight(self, u: Float, v: Float, *, right: bool) -> Float32:
        """Return the strength in [0, 1] of the highlight at points of the patch, as one view sees it."""
        centre = self.u + (self.shift_u if right else 0.0)
        reach = ((u - centre) / self.radius_u) ** 2 + ((v - self.v) / self.radius_v) ** 2
        return np.exp(-reach).astype(np.float32)


@dataclass(frozen=True)
class Look:
    """The appearance of a patch.

    Attributes
    ----------
    colour : Texture or tuple of 3 float
        Its picture, or one colour.
    grain : Texture or None
        A grey tile that modulates the colour; its mean leaves it as it is.
    grain_amount : float
        How much.
    light : float
        Brightness of the patch, 1 is full sun.
    decals : tuple of Decal
        Hard cases on it, later ones on top.
    flat : bool
        Whether the whole patch counts as textureless.
    """

    colour: Texture | Colour
    grain: Texture | None = None
    grain_amount: float = 1.0
    light: float = 1.0
    decals: tuple[Decal, ...] = ()
    flat: bool = False


def paint(look: Look, u: Float, v: Float, depth: Float, step: Float, *, right: bool) -> Float32:
    """Return the colours of n points of a patch, (n, 3) float32, about 0..255.

    Parameters
    ----------
    look : Look
        The patch's paint.
    u, v, depth, step : (n,) float64
        Place on the patch, distance, and reach of a pixel, metres.
    right : bool
        Which view.
    """
    if isinstance(look.colour, Texture):
        colour = look.colour(u, v, step)
    else:
        colour = np.tile(np.asarray(look.colour, np.float32), (u.size, 1))
    for decal in look.decals:
        if decal.kind == "textureless" and (inside := decal.inside(u, v)).any():
            colour[inside] = np.asarray(decal.colour, np.float32)
    light = np.full(u.size, look.light, np.float32)
    if look.grain is not None:
        light *= np.maximum(1 + np.float32(look.grain_amount / 128) * (look.grain(u, v, step) - 128), 0.1)
    for decal in look.decals:
        if decal.kind == "textureless" and (inside := decal.inside(u, v)).any():
            light[inside] = look.light * (1 + 0.06 * ((u - decal.u0) / (decal.u1 - decal.u0))[inside])
    colour = colour * light[:, None]
    air = (1 - np.exp(depth / -260.0)).astype(np.float32)[:, None]
    colour += air * (np.array([196, 208, 222], np.float32) - colour)
    for decal in look.decals:
        if decal.kind == "specular" and (inside := decal.inside(u, v)).any():
            seen = decal.highlight(u[inside], v[inside], right=right)
            colour[inside] += seen[:, None] * np.asarray(decal.colour, np.float32)
        elif decal.kind == "brightness" and right and (inside := decal.inside(u, v)).any():
            edge = np.minimum.reduce([u - decal.u0, decal.u1 - u, v - decal.v0, decal.v1 - v])[inside]
            share = np.minimum(edge / 0.4, 1.0).astype(np.float32)[:, None]
            colour[inside] += share * (colour[inside] * np.float32(decal.gain - 1) + np.float32(decal.offset))
    return np.asarray(colour, np.float32)
