"""Where ``stereokit study --train`` gets refiners that were trained for one matcher, as the paper's must have been.

A refiner is tied to its matcher: a network that was trained on the half-size maps of one does worse on those of
another. `retrain` is the one place where training plugs into the study.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from stereokit.errors import OptionError
from stereokit_evaluation import datasets
from stereokit_evaluation.frames import Frame
from stereokit_evaluation.splits import split

__all__ = ["TRAINED", "retrain", "training_frames"]

TRAINED = frozenset({"cnn", "stereovae"})
"""The settings whose refiners are trained; the others have nothing to learn, or come as they are."""

_SCENES = 160


def training_frames(dataset: str, root: Path | None, count: int) -> list[Frame]:
    """Return frames to train on that the study does not score.

    Parameters
    ----------
    dataset : str
        ``"kitti2015"``: the paper's training split. ``"scenes"``: the 160 scenes after those that are scored.
    root : Path or None
        Folder of the data set.
    count : int
        Number of scenes that are scored.

    Raises
    ------
    OptionError
        If the data set is another one, or has no training frames.
    """
    if dataset == "kitti2015":
        return split(datasets.load(dataset, root), "train")[1]
    if dataset == "scenes":
        return datasets.scenes(count + _SCENES)[count:]
    raise OptionError(f"train must go with dataset kitti2015 or scenes, got {dataset!r}")


def retrain(
    method: str,
    refiner: str,
    frames: Sequence[Frame],
    folder: Path,
    *,
    options: Mapping[str, Any],
    tell: Callable[[str], None] = lambda line: None,
) -> Callable[[], Any]:
    """Train a refiner on the half-size maps of one matcher.

    Parameters
    ----------
    method : str
        ``"cost+aggregation"``.
    refiner : str
        A name of `TRAINED`.
    frames : sequence of Frame
        What to train on; ground truth is loaded frame by frame.
    folder : Path
        Where checkpoints and weights are kept, so that an interrupted training goes on and a finished one is not
        done again.
    options : mapping
        The matcher's options, ``max_disparity`` among them: half-size maps come from
        ``Matcher(method, scale=0.5, **options)``.
    tell : callable
        Takes one line about how it goes.

    Returns
    -------
    callable
        Builds the trained refiner, without arguments. It is called as every refiner is, and its attribute
        ``fingerprint`` tells its weights from others, so that results are recomputed when they change.

    Raises
    ------
    OptionError
        Always, in this version: there is no training yet.
    """
    raise OptionError(f"train must be off: training of refiner {refiner!r} is not part of this version")
