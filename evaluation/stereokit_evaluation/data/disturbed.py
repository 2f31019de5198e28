"""Frames with a controlled fault of the cameras (`stereokit_evaluation.synthetic.disturbances`) and their old truth."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from stereokit.io import read_image
from stereokit_evaluation.data.frame import Frame, Loader
from stereokit_evaluation.synthetic.disturbances import DISTURBANCES, disturb

__all__ = ["disturbed"]


def disturbed(frame: Frame, kind: str, strength: float) -> Frame:
    """Return a frame whose images have a fault; it is made when they are loaded.

    Parameters
    ----------
    frame : Frame
    kind : str
        A key of `stereokit_evaluation.synthetic.disturbances.DISTURBANCES`.
    strength : float
        In its unit.
    """
    left = frame.left if DISTURBANCES[kind].views == "right" else partial(_view, frame.left, kind, strength, "left",
                                                                          frame.name)  # fmt: skip
    right = partial(_view, frame.right, kind, strength, "right", frame.name)
    return replace(frame, name=f"{frame.name} {kind} {strength:g}", left=left, right=right, benchmark=None)


def _view(source: Path | Loader, kind: str, strength: float, view: str, name: str) -> NDArray[Any]:
    image = read_image(source) if isinstance(source, Path) else source()
    return disturb(image, kind, strength, view, name)
