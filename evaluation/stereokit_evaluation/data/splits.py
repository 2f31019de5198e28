"""The paper's split of KITTI 2015: 160 frames to train on, 40 to validate on, by sorted name.

The 200 training frames are 000000 to 000199; the first 160 are the training split (StereoVAE, section "Preparation",
which does not name the frames; sorted order is this project's reading of it).
"""

from __future__ import annotations

from collections.abc import Sequence

from stereokit.errors import OptionError
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.data.published import TEST_FRAMES, TRAINING_FRAMES, VALIDATION_FRAMES

__all__ = ["SPLITS", "comparison", "count_frames", "split", "split_of"]

SPLITS = ("all", "train", "validation")

_SIZES = {"all": TRAINING_FRAMES + VALIDATION_FRAMES, "train": TRAINING_FRAMES, "validation": VALIDATION_FRAMES}


def split_of(frame: Frame) -> str | None:
    """Return ``"train"`` or ``"validation"``, None for a frame that is no KITTI 2015 pair."""
    number = frame.name.partition("_")[0]
    if not number.isdecimal() or int(number) >= _SIZES["all"]:
        return None
    return "train" if int(number) < TRAINING_FRAMES else "validation"


def split(frames: Sequence[Frame], which: str | None) -> tuple[str, list[Frame], str | None]:
    """Return the frames of one part of KITTI 2015 that have ground truth.

    Parameters
    ----------
    frames : sequence of Frame
        Those of `stereokit_evaluation.data.datasets.kitti2015`.
    which : {"all", "train", "validation"} or None
        None is the validation split where it is complete, as in the paper, and else all that can be scored.

    Returns
    -------
    which : str
    chosen : list of Frame
    warning : str or None
        The number of missing frames, in one line.

    Raises
    ------
    OptionError
        If there is no such split, or none of its frames.
    """
    if which is not None and which not in SPLITS:
        raise OptionError(f"split must be one of {', '.join(SPLITS)}, got {which!r}")
    parts: dict[str, list[Frame]] = {"all": [], "train": [], "validation": []}
    for frame in frames:
        if (part := split_of(frame)) is not None and (frame.noc is not None or frame.occ is not None):
            parts["all"].append(frame)
            parts[part].append(frame)
    if which is None:
        which = "validation" if len(parts["validation"]) == VALIDATION_FRAMES else "all"
    chosen = parts[which]
    if not chosen:
        counts_text = ", ".join(f"{len(parts[name])} for {name}" for name in ("train", "validation"))
        raise OptionError(f"split {which!r} must have frames with ground truth, got none (there are {counts_text})")
    missing = _SIZES[which] - len(chosen)
    if not missing:
        return which, chosen, None
    counts = [f"{_SIZES[name] - len(parts[name])} of the {_SIZES[name]} for {name}" for name in ("train", "validation")]
    detail = f" ({', '.join(counts)})" if which == "all" else ""
    return which, chosen, f"{missing} of {_SIZES[which]} frames of KITTI 2015 are missing{detail}"


def count_frames(frames: Sequence[Frame]) -> str:
    """Return the number of frames as text, such as ``"2 frames"``."""
    return f"{len(frames)} frame{'' if len(frames) == 1 else 's'}"


def comparison(dataset: str, frames: Sequence[Frame]) -> str:
    """Return a line about the frames of our scores and of the published ones: the same, or not."""
    published = (
        f"the paper's {VALIDATION_FRAMES} validation frames (e4) and {TEST_FRAMES} test frames (e5) of KITTI 2015"
    )
    if dataset != "kitti2015":
        return f"No published figures: they are of KITTI 2015, ours of {count_frames(frames)} of {dataset}."
    shared = sum(split_of(frame) == "validation" for frame in frames)
    if shared == len(frames) == VALIDATION_FRAMES:
        return (
            f"Ours are of the same {VALIDATION_FRAMES} frames as the published e4 (by sorted name; the paper does "
            f"not list them). Published e5 is of {TEST_FRAMES} other frames, the test server's."
        )
    return (
        f"Not the same frames: published figures are of {published}, ours of {len(frames)} training frames, "
        f"{shared} of them among those {VALIDATION_FRAMES}."
    )
