"""A scene as it is put together: meshes, what they are painted with, the light, and the camera."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereokit_evaluation.synthetic.assets import Assets
from stereokit_evaluation.synthetic.bank import KINDS, cropped, halvings, pyramid
from stereokit_evaluation.synthetic.cutouts import mask
from stereokit_evaluation.synthetic.meshes import Mesh, merge, rotation
from stereokit_evaluation.synthetic.shading import LIGHT, MATERIAL

__all__ = ["Stage", "Triangles"]

Float = NDArray[np.float64]
Rng = np.random.Generator

_PER_KIND = 24  # textures of a kind in the bank
_OWN_ANY, _OWN_PHOTOGRAPH = 0.25, 0.8  # how often a texture is of the assets: of any kind, and a photograph


@dataclass(frozen=True, eq=False)
class Triangles:
    """All meshes of a stage as arrays, in the left camera's coordinates."""

    mesh: Mesh
    material: NDArray[np.int32]
    mask: NDArray[np.int32]
    masks: NDArray[np.uint8]
    materials: Float
    bank: NDArray[np.uint8]


@dataclass(eq=False)
class Stage:
    """A scene.

    Attributes
    ----------
    rng : Generator
        Draws everything in it.
    plain : float
        Share of its surfaces without texture.
    field_of_view : float
        Across, radians.
    place, turn : (3,) and (3, 3) float64
        The left camera in the world, and the directions of its axes.
    light : dict
        Entries of `shading.LIGHT`; directions and places are in the world's coordinates.
    shadows : float
        Half the side of the region that the sun's shadows cover, metres; 0 for none.
    shadow_centre : (3,) float64
        Its middle.
    later : dict
        What differs in the light when the right view is taken.
    fickle : float
        How much the brightness and the contrast of each material differ in the right view, standard deviation of the
        logarithm: views taken on different days.
    offset : bool
        Shift the right view so that the smallest disparity is small, as rectified pictures of a far scene are.
    base_ratio : float
        The baseline over the smallest distance stays below this.
    assets : Assets or None
        Photographs and models to use beside those that are computed.
    """

    rng: Rng
    plain: float = 0.2
    field_of_view: float = 1.0
    place: Float = field(default_factory=lambda: np.zeros(3))
    turn: Float = field(default_factory=lambda: np.eye(3))
    light: dict[str, float] = field(default_factory=dict)
    shadows: float = 0.0
    shadow_centre: Float = field(default_factory=lambda: np.array([0.0, 0.0, 5.0]))
    later: dict[str, float] = field(default_factory=dict)
    fickle: float = 0.0
    offset: bool = False
    base_ratio: float = 0.4
    assets: Assets | None = None
    _parts: list[tuple[Mesh, int, int]] = field(default_factory=list)
    _materials: list[Float] = field(default_factory=list)
    _textures: dict[tuple[str, int], int] = field(default_factory=dict)
    _masks: dict[tuple[str, int], int] = field(default_factory=dict)
    _pictures: dict[tuple[str, int], NDArray[np.uint8]] = field(default_factory=dict)
    _holes: dict[tuple[str, int], NDArray[np.uint8]] = field(default_factory=dict)

    def look(self, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> None:
        """Turn the camera: to the right, upwards, and about its axis; radians."""
        self.turn = rotation(yaw, pitch, roll)

    def slot(self, kind: str | None = None) -> int:
        """Return where a texture of a kind lies among those in use; drawn if not there yet."""
        if self.assets is not None and self.assets.photographs and kind in (None, "photograph"):
            if self.rng.random() < (_OWN_ANY if kind is None else _OWN_PHOTOGRAPH):
                return self._own_photograph(self.assets)
        if kind is None:
            names = list(KINDS)
            kind = names[int(self.rng.integers(len(names)))]
        key = (kind, int(self.rng.integers(_PER_KIND)))
        return self._textures.setdefault(key, len(self._textures))

    def _own_photograph(self, assets: Assets) -> int:
        number, part = int(self.rng.integers(len(assets.photographs))), int(self.rng.integers(4))
        key = ("photograph of the assets", 4 * number + part)
        if key not in self._textures:
            rng = np.random.default_rng([13, number, part])
            self._pictures[key] = halvings(cropped(assets.photograph(number), rng))
        return self._textures.setdefault(key, len(self._textures))

    def picture(self, key: tuple[str, int], image: NDArray[np.uint8]) -> int:
        """Return the slot of a texture (512, 512) of one's own, known by `key`."""
        if key not in self._textures:
            self._pictures[key] = halvings(image)
        return self._textures.setdefault(key, len(self._textures))

    def paint(
        self,
        kind: str | None = None,
        size: float = 1.0,
        albedo: float | None = None,
        contrast: float | None = None,
        *,
        detail: str | None = "fractal",
        detail_size: float | None = None,
        detail_contrast: float | None = None,
        gloss: float = 0.0,
        sharpness: int = 5,
        mirror: float = 0.0,
        emission: float = 0.0,
        clear: float = 0.0,
        plain: bool | None = None,
        turned: bool = False,
    ) -> int:
        """Return a new material's number.

        Parameters
        ----------
        kind, size : str and float
            Of the texture; one repeat covers `size` metres.
        albedo, contrast : float
            Mean brightness, and how far the texture goes from it.
        detail, detail_size, detail_contrast : str and float
            A second texture on top.
        gloss, sharpness : float and int
            Strength of the highlights of sun and lamp; each step of `sharpness` squares their fall.
        mirror : float
            Share of the surroundings that it mirrors when seen from the front.
        emission : float
            Light of its own.
        clear : float
            Share of the light behind it that it lets through.
        plain : bool
            Without texture; by default drawn from the stage's share.
        turned : bool
            Lay the texture at any angle.
        """
        rng = self.rng
        if plain is None:
            plain = bool(rng.random() < self.plain)
        row = np.zeros(len(MATERIAL))
        angle = rng.uniform(0, 2 * np.pi) if turned else rng.choice([0.0, np.pi / 2]) + rng.normal(0, 0.01)
        row[:5] = self.slot(kind), np.cos(angle) / size, np.sin(angle) / size, *rng.random(2)
        row[5] = rng.uniform(0.12, 0.85) if albedo is None else albedo
        row[6] = (
            min(np.exp(rng.uniform(np.log(0.35), np.log(2.0))), 1.6 * row[5] + 0.1) if contrast is None else contrast
        )
        if detail is not None:
            fine = size * np.exp(rng.uniform(-2.2, -0.3)) if detail_size is None else detail_size
            turn = rng.uniform(0, 2 * np.pi)
            row[7:10] = self.slot(detail), np.cos(turn) / fine, np.sin(turn) / fine
            row[10] = np.exp(rng.uniform(np.log(0.05), np.log(0.6))) if detail_contrast is None else detail_contrast
        if plain:
            row[6] *= rng.choice([0.0, 0.03, 0.08])
            row[10] *= rng.choice([0.0, 0.04, 0.12])
        row[11:] = gloss, sharpness, mirror, emission, clear
        self._materials.append(row)
        return len(self._materials) - 1

    def repaint(
        self, material: int, albedo: float, *, gloss: float = 0.0, clear: float = 0.0, slot: int = -1, size: float = 1.0
    ) -> int:
        """Return a new material: as `material`, of another brightness, maybe with a texture of its own.

        Parameters
        ----------
        material : int
            Of `paint`.
        albedo, gloss, clear : float
            As for `paint`.
        slot, size : int and float
            A texture of `picture`, laid as it is, -1 to keep that of `material`; one repeat covers `size` metres.
        """
        row = self._materials[material].copy()
        row[5], row[11], row[15] = albedo, max(row[11], gloss), clear
        if slot >= 0:
            row[:7] = slot, 1 / size, 0.0, 0.0, 0.0, 0.5, 1.0
        self._materials.append(row)
        return len(self._materials) - 1

    def add(
        self,
        mesh: Mesh,
        material: int,
        cut: str | tuple[tuple[str, int], NDArray[np.uint8]] | None = None,
        turn: Float | None = None,
        shift: tuple[float, float, float] | Float = (0.0, 0.0, 0.0),
    ) -> None:
        """Put a mesh into the scene; `cut` names a kind of mask, or is a key and one's own mask (256, 256)."""
        number = -1
        if isinstance(cut, tuple):
            self._holes[cut[0]] = cut[1]
            number = self._masks.setdefault(cut[0], len(self._masks))
        elif cut is not None:
            number = self._masks.setdefault((cut, int(self.rng.integers(16))), len(self._masks))
        self._parts.append((mesh.moved(turn, tuple(float(v) for v in shift)), material, number))

    def triangles(self) -> Triangles:
        """Return everything as arrays."""
        lengths = [len(mesh.faces) for mesh, _, _ in self._parts]
        world = merge([mesh for mesh, _, _ in self._parts])
        holes = self._holes
        masks = [holes[key] if key in holes else mask(*key) for key in self._masks] or [np.ones((256, 256), np.uint8)]
        seen = Mesh(
            _snapped((world.points - self.place) @ self.turn), _snapped(world.normals @ self.turn), _snapped(world.uv),
            world.faces,
        )  # fmt: skip
        return Triangles(
            mesh=seen,
            material=np.repeat(np.array([part[1] for part in self._parts], np.int32), lengths),
            mask=np.repeat(np.array([part[2] for part in self._parts], np.int32), lengths),
            masks=np.stack(masks),
            materials=_snapped(np.stack(self._materials)),
            bank=np.concatenate(
                [self._pictures[key] if key in self._pictures else pyramid(*key) for key in self._textures]
            ),
        )

    def lights(self, *, right: bool = False) -> Float:
        """Return the light as `shading.shade` takes it, directions turned into the camera's axes."""
        light = self.light | self.later if right else self.light
        row = np.array([light.get(name, 0.0) for name in LIGHT])
        sun = row[:3] / max(float(np.sqrt((row[:3] ** 2).sum())), 1e-12)
        row[:3] = sun @ self.turn
        row[5:8] = np.array([0.0, -1.0, 0.0]) @ self.turn
        row[8:11] = (row[8:11] - self.place) @ self.turn
        return _snapped(row)


def _snapped(values: Float) -> Float:
    """Return values on a grid of 2 ** -24, a few millionths of a millimetre.

    Processors differ in the last bit of a sine or a matrix product; on the grid they all render the same scene.
    """
    return np.asarray(np.rint(values * 2.0**24) / 2.0**24)
