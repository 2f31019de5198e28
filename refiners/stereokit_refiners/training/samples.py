"""Training samples: what a matcher makes of a pair under many conditions, and crops of that.

Before matching, a pair is rescaled (disparities with it), its brightness and noise are changed, and the matcher's
penalties and filters are drawn around their defaults, so that a refiner meets the mistakes of a matcher rather than
those of a few images. Each *variant* is a function of (pair, method, seed, number) alone: it is made once, stored in a
cache folder under a name that says all of that, and the same on every machine. Variant 0 is the pair as it is.
"""

from __future__ import annotations

import hashlib
import io
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import cv2
import numpy as np
from numpy.typing import NDArray

import stereokit
from stereokit.defaults import defaults_of
from stereokit.io import make_folder, parsing, write_bytes
from stereokit.kernels.jit import FINGERPRINT
from stereokit.methods import parse_method
from stereokit.notices import collecting
from stereokit.result import Disparity
from stereokit_refiners.training.augment import Views, copy_paste, mirrored, photographed, rescaled

__all__ = [
    "Crop",
    "Pair",
    "Sample",
    "SampleFiles",
    "crop",
    "drawn_options",
    "load_variant",
    "make_variant",
    "store_variant",
    "whole",
]

_STEP = np.float32(1 / 256)  # of a pixel, as in KITTI
_HERE = Path(__file__)
_SOURCES = _HERE.read_bytes() + _HERE.with_name("augment.py").read_bytes()
_OWN = hashlib.sha256(_SOURCES).hexdigest()[:8]  # says what made a cached sample


@dataclass(frozen=True, eq=False)
class Pair:
    """A stereo pair with ground truth.

    Parameters
    ----------
    name : str
    left, right : (H, W) uint8
    noc, occ : (H, W) float32
        True disparity of what both cameras see, and of all pixels; full-size pixels, NaN unknown. One of them may
        stand for both.
    """

    name: str
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    noc: NDArray[np.float32]
    occ: NDArray[np.float32]

    @cached_property
    def digest(self) -> str:
        """A fingerprint of the content."""
        digest = hashlib.sha256()
        for array in (self.left, self.right, self.noc, self.occ):
            digest.update(str(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class Sample:
    """A coarse map with its image and the truth, in compact types.

    Parameters
    ----------
    coarse : (h, w) uint16
        Coarse map in 1/256 half-size pixels, filled.
    confidence : (h, w) uint8
        The matcher's confidence in 1/255, 0 where nothing was measured.
    candidates : (2, h, w) uint16
        The matcher's candidates in 1/256 half-size pixels.
    left : (2h, 2w) uint8
    truth : (2h, 2w) uint16
        1/256 full-size pixels, 0 unknown.
    seen : (2h, 2w) bool
        Where the truth is of a pixel that both cameras see.
    size : (int, int)
        Rows and columns of the image before it was extended to an even size.
    """

    coarse: NDArray[np.uint16]
    confidence: NDArray[np.uint8]
    candidates: NDArray[np.uint16]
    left: NDArray[np.uint8]
    truth: NDArray[np.uint16]
    seen: NDArray[np.bool_]
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Crop:
    """Input and target of a network, in floating point.

    Parameters
    ----------
    disparity : (h, w) float32
        Coarse map in full-size pixels.
    confidence : (h, w) float32
        0 to 1, 0 where nothing was measured.
    candidates : (2, h, w) float32
        The matcher's candidates in full-size pixels.
    left : (2h, 2w) float32
        Grey levels, 0 to 255.
    truth : (2h, 2w) float32
        Full-size pixels; 0 where `weight` is.
    weight : (2h, 2w) float32
        2 where both cameras see the pixel, 1 where only the left one does, 0 where the truth is unknown: the
        paper's first loss, which counts pixels of both ground truths two times.
    """

    disparity: NDArray[np.float32]
    confidence: NDArray[np.float32]
    candidates: NDArray[np.float32]
    left: NDArray[np.float32]
    truth: NDArray[np.float32]
    weight: NDArray[np.float32]


def _cut(sample: Sample, y: int, x: int, rows: int, columns: int) -> Crop:
    small = np.s_[y : y + rows, x : x + columns]
    large = np.s_[2 * y : 2 * (y + rows), 2 * x : 2 * (x + columns)]
    truth = sample.truth[large]
    weight = np.where(truth > 0, np.where(sample.seen[large], np.float32(2), np.float32(1)), np.float32(0))
    return Crop(
        sample.coarse[small] * (np.float32(2) * _STEP),
        sample.confidence[small] * np.float32(1 / 255),
        sample.candidates[:, y : y + rows, x : x + columns] * (np.float32(2) * _STEP),
        sample.left[large].astype(np.float32),
        truth * _STEP,
        weight.astype(np.float32),
    )


def crop(sample: Sample, rows: int, columns: int, rng: np.random.Generator) -> Crop:
    """Return a random part of a sample, `rows` x `columns` half-size pixels, at another exposure.

    Smaller samples are extended by their border; what is added there has no weight.
    """
    height, width = sample.coarse.shape
    y = int(rng.integers(0, max(height - rows, 0) + 1))
    x = int(rng.integers(0, max(width - columns, 0) + 1))
    part = _cut(sample, y, x, min(rows, height), min(columns, width))
    gamma, contrast = float(np.exp(rng.normal(0, 0.2))), float(np.exp(rng.normal(0, 0.15)))
    level = float(rng.normal(0, 12))
    values = 255 * (part.left / np.float32(255)) ** np.float32(gamma)
    left = np.clip((values - np.float32(128)) * np.float32(contrast) + np.float32(128 + level), 0, 255)
    more = ((0, rows - part.disparity.shape[0]), (0, columns - part.disparity.shape[1]))
    if more == ((0, 0), (0, 0)):
        return Crop(part.disparity, part.confidence, part.candidates, left.astype(np.float32), part.truth, part.weight)
    doubled = tuple((0, 2 * amount) for _, amount in more)
    return Crop(
        np.pad(part.disparity, more, mode="edge"),
        np.pad(part.confidence, more, mode="edge"),
        np.pad(part.candidates, ((0, 0), *more), mode="edge"),
        np.pad(left, doubled, mode="edge").astype(np.float32),
        np.pad(part.truth, doubled),
        np.pad(part.weight, doubled),
    )


def whole(sample: Sample, multiple: int) -> Crop:
    """Return all of a sample, extended to a multiple of `multiple` half-size pixels by its border."""
    height, width = sample.coarse.shape
    part = _cut(sample, 0, 0, height, width)
    more = ((0, -height % multiple), (0, -width % multiple))
    doubled = tuple((0, 2 * amount) for _, amount in more)
    return Crop(
        np.pad(part.disparity, more, mode="edge"),
        np.pad(part.confidence, more, mode="edge"),
        np.pad(part.candidates, ((0, 0), *more), mode="edge"),
        np.pad(part.left, doubled, mode="edge"),
        np.pad(part.truth, doubled),
        np.pad(part.weight, doubled),
    )


def make_variant(pair: Pair, method: str, seed: int, number: int, max_disparity: int = 128) -> Sample:
    """Match one variant of a pair at half size.

    Parameters
    ----------
    pair : Pair
    method : str
        As `stereokit.Matcher` takes it.
    seed, number : int
        Which variant; number 0 is the pair as it is, with the matcher's defaults.
    max_disparity : int
        Of the matcher, full-size pixels.

    Returns
    -------
    Sample
    """
    views = Views(pair.left, pair.right, pair.noc, pair.occ)
    options: dict[str, Any] = {}
    if number > 0:
        rng = np.random.default_rng([seed, number, int(pair.digest[:8], 16)])
        if number % 2 == 0 and np.isfinite(views.noc).any():
            views = mirrored(views)
        views = photographed(rng, rescaled(rng, copy_paste(rng, views)))
        options = drawn_options(rng, method)
    noc, occ = views.noc, views.occ
    left, right = _even(views.left), _even(views.right)
    capture = _CaptureCoarse()
    matcher = stereokit.Matcher(method, max_disparity=max_disparity, scale=0.5, refiner=capture, threads=1, **options)
    with collecting():  # hard pairs are wanted
        matcher(left, right)
    coarse_map = capture.coarse
    height, width = left.shape
    truth = np.zeros((height, width), np.uint16)
    seen = np.zeros((height, width), np.bool_)
    rows, columns = noc.shape
    seen[:rows, :columns] = np.isfinite(noc)
    known = np.where(np.isfinite(noc), noc, occ)
    truth[:rows, :columns] = np.where(np.isfinite(known), np.clip(np.rint(known / _STEP), 1, 65535), 0)
    assert coarse_map.confidence is not None and coarse_map.candidates is not None
    coarse, candidates = (
        np.clip(np.rint(disparity / _STEP), 0, 65535).astype(np.uint16)
        for disparity in (coarse_map.disparity, coarse_map.candidates)
    )
    confidence = np.clip(np.rint(coarse_map.confidence * 255), 0, 255).astype(np.uint8)
    return Sample(coarse, confidence, candidates, left, truth, seen, (rows, columns))


class _CaptureCoarse:
    """A refiner that stores the coarse map."""

    needs_candidates = True
    coarse: Disparity

    def __call__(self, coarse: Disparity, left: NDArray[Any], *, threads: int = 1) -> Disparity:
        self.coarse = coarse
        return Disparity(np.zeros(left.shape, np.float32), np.zeros(left.shape, np.bool_))


def _even(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image.shape
    return np.asarray(cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE))


def drawn_options(rng: np.random.Generator, method: str) -> dict[str, Any]:
    """Return the matcher's options, drawn around the defaults of `stereokit.defaults`."""
    name = parse_method(method)
    base = defaults_of(name, half=True)
    options: dict[str, Any] = {
        "smooth": float(np.clip(base["smooth"] * np.exp(rng.normal(0, 0.15)), 0.3, 1.2)),
        "speckle": float(base["speckle"] * np.exp(rng.normal(0, 0.4))),
        "median": int(rng.choice([3, 5, 5, 5])),
    }
    if "p1" in base:
        scale = float(np.exp(rng.normal(0, 0.2)))
        options["p1"] = base["p1"] * scale
        options["p2"] = float(
            np.clip(base["p2"] * scale * np.exp(rng.normal(0, 0.2)), base["p1"] * scale, base["p2"] * 1.5)
        )
    return options


def cache_name(pair: Pair, method: str, seed: int, number: int, max_disparity: int) -> str:
    """Return the file name of a variant: all that it depends on."""
    which = f"{pair.digest}-{method.lower().replace('+', '_')}-{max_disparity}-{seed}-{number}"
    return f"{which}-{FINGERPRINT}-{_OWN}.npz"


def load_variant(
    pair: Pair, method: str, seed: int, number: int, max_disparity: int = 128, cache: Path | None = None
) -> Sample:
    """Return a variant, from the cache folder if it is there; otherwise make it and keep it."""
    if cache is None:
        return make_variant(pair, method, seed, number, max_disparity)
    return _read(store_variant(pair, method, seed, number, max_disparity, cache))


def store_variant(pair: Pair, method: str, seed: int, number: int, max_disparity: int, cache: Path) -> Path:
    """Return the file of a variant in the cache folder; make it if it is not there."""
    path = cache / cache_name(pair, method, seed, number, max_disparity)
    if not path.exists():
        sample = make_variant(pair, method, seed, number, max_disparity)
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **{k: np.asarray(v) for k, v in vars(sample).items()})
        make_folder("cache", path.parent)
        write_bytes(path, buffer.getvalue())
    return path


def _read(path: Path) -> Sample:
    with parsing(path, "sample", "cache must hold samples of this program"), path.open("rb") as file:
        with np.load(file) as arrays:
            return Sample(
                arrays["coarse"],
                arrays["confidence"],
                arrays["candidates"],
                arrays["left"],
                arrays["truth"],
                arrays["seen"],
                tuple(arrays["size"].tolist()),
            )


class SampleFiles(Sequence[Sample]):
    """Samples in files, read each time one is asked for: as many as the disk holds, in little memory.

    Parameters
    ----------
    paths : sequence of Path
        Files of `store_variant`.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = list(paths)

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> SampleFiles: ...
    def __getitem__(self, index: int | slice) -> Sample | SampleFiles:
        return SampleFiles(self._paths[index]) if isinstance(index, slice) else _read(self._paths[index])

    @property
    def digest(self) -> int:
        """A number that says which samples these are: their names tell all that they depend on."""
        return zlib.crc32("/".join(path.name for path in self._paths).encode())
