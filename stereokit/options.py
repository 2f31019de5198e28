"""The options of `stereokit.Matcher` and `stereokit.match` with their types, for type checkers and editors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, TypedDict

if TYPE_CHECKING:
    from stereokit.result import Disparity

__all__ = ["MatchOptions", "StageOptions", "WarmupOptions"]


class StageOptions(TypedDict, total=False):
    """Options of the built-in stages, of the pipeline and of the refiners.

    Stages of other packages have options of their own: a dictionary of them, ``**{"name": value}``, is accepted.
    """

    # census, zncc
    window: str | int
    steps: int
    # sgm
    p1: float | None
    p2: float | None
    paths: Literal[4, 5, 8]
    edge: float
    edge_factor: float
    # dt
    sigma_s: float
    sigma_v: float | None
    sigma_r: float
    passes: int
    mode: Literal["rf", "sum"]
    # the pipeline
    smooth: float
    uniqueness: float
    smp: bool
    speckle: float
    fill: Literal["background", "nearest", "none"] | None
    median: Literal[0, 3, 5]
    border_cost: float | None
    outside: float | None  # the old name of border_cost
    subpixel: bool
    nodata: float | None
    confidence: bool
    right: bool
    search: Literal["auto", "full", "coarse-to-fine"]
    # learned refiners
    weights: str | None
    backend: str
    precision: str
    evidence_scale: float
    refinements: int | None


class WarmupOptions(StageOptions, total=False):
    """Options of `stereokit.warmup` beside the range's end."""

    min_disparity: int
    scale: float
    refiner: str | Callable[..., Disparity] | None
    device: Literal["auto", "cpu", "cuda"]
    threads: int | None


class MatchOptions(WarmupOptions, total=False):
    """All options of `stereokit.match`."""

    max_disparity: int


OPENCV_NAMES: dict[str, str] = {
    "minDisparity": "min_disparity",
    "numDisparities": "max_disparity (the end of the range)",
    "uniquenessRatio": "uniqueness",
    "speckleWindowSize": "speckle (a share of the image)",
    "disp12MaxDiff": "smp (bool)",
    "P1": "p1 of sgm (in another unit)",
    "P2": "p2 of sgm (in another unit)",
    "blockSize": "window of the cost",
    "preFilterCap": "",
    "speckleRange": "",
}
"""OpenCV's parameters, and what they are called here."""


def opencv_hint(names: Any) -> str | None:
    """Return the line for the first of `names` that is one of OpenCV's parameters, or None."""
    for name in names:
        if name in OPENCV_NAMES:
            own = OPENCV_NAMES[name]
            counterpart = f"is {own} here" if own else "has no counterpart here"
            return f"option {name!r} is OpenCV's: it {counterpart}; stereokit.opencv.StereoSGBM_create takes OpenCV's"
    return None
