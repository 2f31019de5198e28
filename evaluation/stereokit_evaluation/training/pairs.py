"""Pairs to train on: frames of a data set, and synthetic streets under many cameras.

The streets are those of `stereokit_evaluation.synthetic.scenes`, each with its own size, noise, blur and exposure,
drawn from its seed. They are slow to render, so they are cached in a folder, by seed and a digest of the sources.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError
from stereokit.io import make_folder, parsing, write_bytes
from stereokit_evaluation.common.fingerprint import fingerprint
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.synthetic.scenes import generate
from stereokit_refiners.training.samples import Pair

__all__ = ["FIRST_SEED", "pair_of", "scene_pair"]

FIRST_SEED = 100_000
"""Seeds of streets to train on start here; those of tests and demonstrations lie far below."""


def pair_of(frame: Frame) -> Pair:
    """Return a frame as a pair for training; missing ground truth is NaN.

    Raises
    ------
    InputError
        If it has no ground truth at all.
    """
    noc, occ = frame.load_noc(), frame.load_occ()
    if noc is None and occ is None:
        raise InputError(f"frame {frame.name} has no ground truth to train on")
    if noc is None:
        noc = np.full_like(occ, np.nan)  # which of these pixels are hidden from the right camera is not known
    if occ is None:
        occ = noc
    return Pair(frame.name, frame.load_left(gray=True), frame.load_right(gray=True), noc, occ)


def scene_pair(seed: int, cache: Path | None = None) -> Pair:
    """Return a synthetic street as a pair for training.

    Parameters
    ----------
    seed : int
        Seed of the street, its size, and the camera.
    cache : Path, optional
        Folder of rendered streets.
    """
    path = None if cache is None else cache / f"street-{seed}-{_fingerprint()}.npz"
    if path is not None and path.exists():
        with parsing(path, "street", "cache must hold streets of this program"), np.load(path) as file:
            content = {name: file[name] for name in ("left", "right", "noc", "occ")}
    else:
        content = _render(seed)
        if path is not None:
            buffer = io.BytesIO()
            np.savez(buffer, allow_pickle=False, **content)
            make_folder("cache", path.parent)
            write_bytes(path, buffer.getvalue())
    noc, occ = (_decoded(content[name]) for name in ("noc", "occ"))
    return Pair(f"street-{seed}", content["left"], content["right"], noc, occ)


def _render(seed: int) -> dict[str, NDArray[Any]]:
    camera, size = np.random.default_rng([seed, 2]), np.random.default_rng([seed, 3])
    noise, blur = float(camera.uniform(0.5, 3.5)), float(camera.uniform(0.3, 0.8))
    gain, offset = float(np.exp(camera.normal(0, 0.06))), float(camera.normal(0, 4))
    hard = bool(camera.random() < 0.8)
    width, height = int(size.integers(900, 1300)), int(size.integers(320, 400))
    scene = generate(seed, width, height, noise=noise, blur=blur, gain=gain, offset=offset, hard_cases=hard)
    left, right = (cv2.cvtColor(view, cv2.COLOR_RGB2GRAY) for view in (scene.left, scene.right))
    return {"left": left, "right": right, "noc": _encoded(scene.noc), "occ": _encoded(scene.occ)}


def _encoded(truth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return a map in KITTI's encoding: 1/256 pixels, 0 unknown."""
    known = np.clip(np.rint(np.nan_to_num(truth) * 256), 1, 65535)
    return np.where(np.isnan(truth), 0, known).astype(np.uint16)


def _decoded(truth: NDArray[np.uint16]) -> NDArray[np.float32]:
    known = truth.astype(np.float32) / np.float32(256)
    return np.asarray(np.where(truth > 0, known, np.float32(np.nan)), np.float32)


def _fingerprint() -> str:
    """Return a digest of the sources that draw streets."""
    here = Path(__file__)
    parts = ("scenes", "street", "geometry", "textures", "sprites", "backdrops")
    return fingerprint((*(here.parents[1] / "synthetic" / f"{part}.py" for part in parts), here))
