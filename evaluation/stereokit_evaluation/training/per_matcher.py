"""Refiners for one matcher each, trained by ``stereokit study --train``, as the paper's must have been.

A refiner is tied to its matcher: a network that was trained on the half-size maps of one does worse on those of
another. Only `retrain` connects the training (`stereokit_evaluation.training.run`) to the study.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import stereokit_evaluation
import stereokit_refiners
from stereokit.errors import OptionError
from stereokit.io import write_bytes
from stereokit_evaluation.common.folders import make_folder
from stereokit_evaluation.data import datasets
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.data.splits import split
from stereokit_evaluation.study.configurations import fingerprint
from stereokit_evaluation.study.store import digest, frame_digest
from stereokit_evaluation.training.run import run_training
from stereokit_refiners.weights import NETWORKS

__all__ = ["TRAINED", "retrain", "training_frames"]

TRAINED = tuple(NETWORKS)
"""The variants whose refiners are trained; others have nothing to learn, or come with their weights."""

_STREETS = 160


def training_frames(dataset: str, root: Path | None, scored: Sequence[Frame]) -> list[Frame]:
    """Return the frames to train on: of KITTI 2015 the paper's training split, without those that are scored.

    Parameters
    ----------
    dataset : str
        ``"kitti2015"``, or ``"scenes"``, which trains on other streets and needs none.
    root : Path or None
        Folder of the data set.
    scored : sequence of Frame
        Frames of the study.

    Raises
    ------
    OptionError
        If the data set is another one, or no frame is left.
    """
    if dataset == "scenes":
        return []
    if dataset != "kitti2015":
        raise OptionError(f"train must go with dataset kitti2015 or scenes, got {dataset!r}")
    names = {frame.name for frame in scored}
    remaining = [frame for frame in split(datasets.load_frames(dataset, root), "train")[1] if frame.name not in names]
    if not remaining:
        raise OptionError("train must leave frames to train on, but all are scored; choose some by --frames or --split")
    return remaining


def retrain(
    method: str,
    refiner: str,
    frames: Sequence[Frame],
    folder: Path,
    *,
    dataset: str,
    root: Path | None,
    max_disparity: int,
    settings: Sequence[str] = (),
) -> str:
    """Train a refiner on the half-size maps of one matcher and return its weight file.

    Parameters
    ----------
    method : str
        ``"cost+aggregation"``.
    refiner : str
        One of `TRAINED`.
    frames : sequence of Frame
        Frames to train on; without any, synthetic streets that the study does not score.
    folder : Path
        Folder of checkpoint and weights: an interrupted training resumes, a finished one is not repeated.
    dataset, root : str, Path or None
        The source of `frames`.
    max_disparity : int
        Of the matcher, full-size pixels.
    settings : sequence of str
        Settings of the training, ``KEY=VALUE``.

    Raises
    ------
    OptionError, FileError, StereokitError
        If a setting is wrong, the folder cannot be written to, or torch is not installed.
    """
    packages = (stereokit_refiners.__file__, stereokit_evaluation.__file__)
    source = [fingerprint(Path(str(file)).parent) for file in packages]
    key = digest([method, refiner, [frame_digest(f) for f in frames], max_disparity, list(settings), source])
    training_folder = make_folder(folder / f"{method}-{refiner}-{key[:12]}")
    weights, marker = training_folder / "weights.safetensors", training_folder / "done.json"
    if weights.is_file() and marker.is_file():
        return str(weights)
    run_training(
        training_folder,
        refiner,
        dataset=dataset if frames else None,
        root=root if frames else None,
        frames=",".join(frame.name for frame in frames) or None,
        streets=0 if frames else _STREETS,
        method=[method],
        settings=settings,
        max_disparity=max_disparity,
        cache=folder / "cache",
    )
    write_bytes(marker, json.dumps({"method": method, "refiner": refiner, "settings": list(settings)}).encode())
    return str(weights)
