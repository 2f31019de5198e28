"""Stereo pairs of many kinds of scenes with exact truth, from a seed: to train on.

`generate_pair` renders one; `pairs` walks through seeds, and keeps what it rendered in a folder.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError
from stereokit.io import write_bytes
from stereokit_evaluation.common.fingerprint import fingerprint
from stereokit_evaluation.common.folders import make_folder
from stereokit_evaluation.synthetic.assets import Assets
from stereokit_evaluation.synthetic.closeups import closeup
from stereokit_evaluation.synthetic.objects import flying, pile
from stereokit_evaluation.synthetic.outdoor import garden, road
from stereokit_evaluation.synthetic.render import Rendered, Rig, render
from stereokit_evaluation.synthetic.rooms import hall, room
from stereokit_evaluation.synthetic.scenes import generate
from stereokit_evaluation.synthetic.sensors import Sensor, draw_sensors, expose
from stereokit_evaluation.synthetic.stage import Stage
from stereokit_evaluation.synthetic.terrain import terrain

__all__ = ["KINDS", "GeneratedPair", "generate_pair", "kind_of", "pair_name", "pairs"]

Rng = np.random.Generator

_MAKERS: dict[str, Callable[[Stage], None]] = {
    "closeup": closeup, "flying": flying, "garden": garden, "hall": hall, "pile": pile, "road": road, "room": room,
    "terrain": terrain,
}  # fmt: skip

KINDS = (*_MAKERS, "street")
"""Kinds of scenes; ``"street"`` is that of `stereokit_evaluation.synthetic.scenes` with other cameras."""

_MIX = (
    *["road"] * 4, *["garden"] * 2, *["flying"] * 3, *["terrain"] * 2, *["closeup"] * 2, *["street"] * 2, *["room"] * 2,
    *["hall"] * 2, *["pile"] * 2,
)  # fmt: skip
_SIZES = ((640, 384), (640, 480), (720, 480), (768, 432), (800, 448), (832, 384), (960, 384), (960, 544))
_SMALLEST, _LARGEST = 12.0, 200.0  # of the largest disparity


@dataclass(frozen=True, eq=False)
class GeneratedPair:
    """A pair and its truth.

    Attributes
    ----------
    left, right : (H, W) uint8
        Grey.
    truth : (H, W) float32, pixels
        Disparity at the centres of the left pixels, 0 and up; 0 where nothing is, as in the sky.
    seen : (H, W) bool
        Whether the right view shows the point at a left pixel's centre: it lies inside, and nothing covers it.
    kind, seed : str and int
        The seed of the scene.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    truth: NDArray[np.float32]
    seen: NDArray[np.bool_]
    kind: str
    seed: int

    @property
    def occ(self) -> NDArray[np.float32]:
        """Truth of all pixels as KITTI gives it: (H, W) float32, NaN in the sky."""
        return np.where(self.truth > 0, self.truth, np.float32(np.nan))

    @property
    def noc(self) -> NDArray[np.float32]:
        """Truth of the pixels that both views show: `occ`, NaN where hidden."""
        return np.where(self.seen, self.occ, np.float32(np.nan))


def _street(seed: int, width: int, height: int, largest: float, sensors: tuple[Sensor, Sensor], noise: Rng) -> Rendered:
    """Return a street of `stereokit_evaluation.scenes` taken by these cameras."""
    scene = generate(seed, width, height, max(int(largest), 16), noise=0, blur=0, gain=1, offset=0)
    pictures = []
    for view, truth, sensor in (
        (scene.left, scene.disparity, sensors[0]),
        (scene.right, scene.disparity_right, sensors[1]),
    ):
        grey = cv2.cvtColor(view, cv2.COLOR_RGB2GRAY)
        light = ((np.arange(256) / 255) ** 2.2)[grey].repeat(2, axis=0).repeat(2, axis=1)
        fine = truth.astype(np.float64).repeat(2, axis=0).repeat(2, axis=1)
        pictures.append(expose((light / 0.2).astype(np.float32), fine, sensor, noise))
    return Rendered(pictures[0], pictures[1], scene.disparity, ~scene.occluded)


def _checked(name: str, value: int, least: int = 0) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise OptionError(f"{name} must be a whole number of at least {least}, got {value!r}")
    return int(value)


def kind_of(seed: int) -> str:
    """Return the kind of scene that a seed draws by itself."""
    return _MIX[_checked("seed", seed) % len(_MIX)]


def generate_pair(
    seed: int, kind: str | None = None, *, size: tuple[int, int] | None = None, assets: Assets | None = None
) -> GeneratedPair:
    """Render the pair that a seed stands for.

    Parameters
    ----------
    seed : int
        Draws the scene, its size, the largest disparity (12 to 200 pixels) and the cameras; same seed, same bytes.
    kind : str, optional
        One of `KINDS`, else that of `kind_of`.
    size : (int, int), optional
        Width and height in pixels, instead of those drawn; the scene stays the same.
    assets : Assets, optional
        Photographs and models to use too, of `stereokit_evaluation.synthetic.assets.read_assets`; other assets, other
        scenes. A ``"street"`` uses none.

    Returns
    -------
    GeneratedPair

    Raises
    ------
    OptionError
        If an option is outside its rule.
    StereokitError
        If scikit-image, which brings the photographs, is not installed.
    """
    kind = kind_of(seed) if kind is None else kind
    seed = _checked("seed", seed)
    if kind not in KINDS:
        raise OptionError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    number = sum(ord(letter) << (3 * k) for k, letter in enumerate(kind))
    world, camera, noise = (np.random.default_rng([seed, number, part]) for part in range(3))
    width, height = _SIZES[int(camera.integers(len(_SIZES)))]
    largest = float(np.exp(camera.uniform(np.log(_SMALLEST), np.log(_LARGEST))))
    from_above = kind == "terrain"  # two passes of a satellite differ more than two cameras on one bar
    harsh = float(camera.beta(2.0, 1.6) if from_above else camera.beta(1.1, 2.6))
    crooked = camera.random() < (0.7 if from_above else 0.4)
    left, right = draw_sensors(camera, harsh)
    if size is not None:
        width, height = (_checked("size", value, 1) for value in size)
    rig = Rig(
        width=width,
        height=height,
        largest=min(largest, width / 4),
        smallest=float(camera.uniform(0.5, 6)),
        lift=float(camera.uniform(-0.4, 0.4)) if crooked else float(camera.normal(0, 0.04)),
        roll=float(camera.normal(0, 2.5e-4)) if crooked else 0.0,
        left=left,
        right=right,
    )
    if kind == "street":
        pair = _street(seed, width, height, rig.largest, (left, right), noise)
    else:
        stage = Stage(world, assets=assets)
        _MAKERS[kind](stage)
        pair = render(stage, rig, noise)
    return GeneratedPair(pair.left, pair.right, pair.truth, pair.seen, kind, seed)


def pairs(
    count: int,
    first_seed: int = 0,
    *,
    kind: str | None = None,
    folder: Path | None = None,
    assets: Assets | None = None,
) -> Iterator[GeneratedPair]:
    """Render the pairs of `count` seeds, one after the other.

    Parameters
    ----------
    count : int
        How many.
    first_seed : int
        Seed of the first; the others follow.
    kind : str, optional
        Of all of them, else each seed draws its own.
    folder : Path, optional
        Folder of the pairs, one file each, of `pair_name`; existing files are read, not rendered. A stopped run resumes
        where it ended.
    assets : Assets, optional
        As for `generate_pair`.

    Yields
    ------
    GeneratedPair
    """
    for seed in range(_checked("first_seed", first_seed), first_seed + _checked("count", count)):
        if folder is None:
            yield _generate(seed, kind, assets)
            continue
        path = make_folder(folder, "folder") / pair_name(seed, kind, assets)
        if not path.exists():
            pair = _generate(seed, kind, assets)
            buffer = io.BytesIO()
            np.savez(buffer, allow_pickle=False, left=pair.left, right=pair.right, truth=pair.truth, seen=pair.seen)
            write_bytes(path, buffer.getvalue())
        with np.load(path) as stored:
            left, right, truth, seen = (stored[name] for name in ("left", "right", "truth", "seen"))
        yield GeneratedPair(left, right, truth, seen, kind or kind_of(seed), seed)


def _generate(seed: int, kind: str | None, assets: Assets | None) -> GeneratedPair:
    return generate_pair(seed, kind) if assets is None else generate_pair(seed, kind, assets=assets)


def pair_name(seed: int, kind: str | None = None, assets: Assets | None = None) -> str:
    """Return the name of a pair's file: its kind, its seed, and digests of the sources and of the assets it may use."""
    kind = kind or kind_of(seed)
    uses = "" if assets is None or kind == "street" else f"-{assets.digest}"
    return f"{kind}-{seed}-{_sources()}{uses}.npz"


def _sources() -> str:
    """Return the digest of all modules that draw scenes."""
    return fingerprint(sorted(Path(__file__).parent.glob("*.py")))
