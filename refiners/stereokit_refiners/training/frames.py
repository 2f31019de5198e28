"""Samples of real frames for `stereokit_refiners.networks.evidence.Evidence`: their truth is sparse, and they are few.

So each frame is matched many times: mirrored, with copies of its own objects, at another size and exposure
(`stereokit_refiners.training.augment`), now and then by a poor camera, at half size mostly. None is turned upside down:
below is the ground, and a refiner for one kind of scenes may know it. A sample is a function of its frame, the matcher,
the seed and its number alone; it is made once and stored under a name that says all of that.
"""

from __future__ import annotations

import hashlib
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereokit.io import make_folder
from stereokit.io.atomic import replacing
from stereokit.kernels.jit import FINGERPRINT
from stereokit.notices import collecting
from stereokit_refiners.training import evidence
from stereokit_refiners.training.augment import Views, copy_paste, mirrored, photographed, rescaled
from stereokit_refiners.training.samples import Pair, drawn_options

__all__ = ["frame_sample", "store_frame"]

_SCALES, _SHARES = (0.5, 1.0, 0.25), (0.7, 0.15, 0.15)
_POOR = 0.2  # share of the samples whose camera is one of `evidence.photographed`
_HERE = Path(__file__)
_SOURCES = (
    *(_HERE.with_name(f"{name}.py") for name in ("augment", "evidence", "frames", "samples")),
    *(_HERE.parents[1] / name / "evidence.py" for name in ("networks", "runtimes")),
)
_OWN = hashlib.sha256(b"".join(path.read_bytes() for path in _SOURCES)).hexdigest()[:8]


def frame_sample(pair: Pair, method: str, seed: int, number: int, max_disparity: int) -> NDArray[np.uint8]:
    """Match one variant of a frame; see `stereokit_refiners.training.evidence.make_sample`.

    Parameters
    ----------
    pair : Pair
        Its truth may be sparse.
    method : str
        As `stereokit.Matcher` takes it.
    seed, number : int
        Which variant; number 0 is the frame as it is, at half size, with the matcher's defaults.
    max_disparity : int
        Of the matcher, full-size pixels; more where the truth of a variant goes beyond.
    """
    views = Views(pair.left, pair.right, pair.noc, pair.occ)
    scale, options = 0.5, {}
    if number > 0:
        rng = np.random.default_rng([seed, number, int(pair.digest[:8], 16), zlib.crc32(method.encode())])
        if number % 2 == 0 and np.isfinite(views.noc).any():
            views = mirrored(views)
        views = rescaled(rng, copy_paste(rng, views))
        if rng.random() < _POOR:
            left, right = evidence.photographed(views.left, views.right, rng)
            views = Views(left, right, views.noc, views.occ)
        else:
            views = photographed(rng, views)
        scale = float(rng.choice(_SCALES, p=_SHARES))
        if scale == 0.5:
            options = drawn_options(rng, method)
    seen = np.isfinite(views.noc)
    truth = np.where(seen, views.noc, views.occ)
    with collecting():  # hard pairs are wanted
        record, _ = evidence.make_sample(
            views.left, views.right, truth, seen, method, scale, max_disparity=max_disparity, **options
        )
    return record


def store_frame(pair: Pair, method: str, seed: int, number: int, max_disparity: int, folder: Path) -> Path:
    """Return the file of `frame_sample` in a folder; make it if it is not there."""
    name = f"{pair.digest}-{method.lower().replace('+', '_')}-{max_disparity}-{seed}-{number}-{FINGERPRINT}-{_OWN}"
    path = folder / f"{name}.npy"
    if not path.exists():
        record = frame_sample(pair, method, seed, number, max_disparity)
        make_folder("cache", folder)
        with replacing(path) as temporary, open(temporary, "wb") as stream:
            np.save(stream, record)
    return path
