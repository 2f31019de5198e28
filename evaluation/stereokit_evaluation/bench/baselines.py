"""The contenders of ``stereokit bench``: our methods, and other libraries as baselines.

A baseline is a name, the module that it needs and a factory; it takes part only when that module can be imported. All
take two grey ``uint8`` images and are called as their users call them. Only baselines that were run are listed.

OpenCV's matchers get the whole image without padding (which costs them the leftmost columns, not time), their usual
penalties for block size 5, a uniqueness ratio, the left-right check and no speckle filter. Pandora (CNES) runs its
census and libSGM with its default penalties, sub-pixel refinement, median and left-right check; it chooses its own
threads, and takes so long that it is called at most three times.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.defaults import METHODS
from stereokit.io import from_opencv
from stereokit.matching import Matcher
from stereokit.result import Disparity

__all__ = [
    "BASELINES",
    "HH",
    "THREE_WAY",
    "Baseline",
    "Call",
    "baselines",
    "label",
    "make",
    "opencv_threads",
    "padded",
    "usable_levels",
]

Call = Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[Any]]
"""Left and right image, both (H, W) uint8, to a disparity map."""

HH, THREE_WAY = "OpenCV HH", "OpenCV 3WAY"

_BLOCK = 5


@dataclass(frozen=True)
class Baseline:
    """A matcher of another library.

    Attributes
    ----------
    name : str
        The name in the table.
    module : str
        The module that it needs.
    make : callable
        Takes the number of disparity levels and returns the call that is timed.
    bytes_per_cell : int
        Known memory per pixel and level, to leave it out where the machine cannot hold it; 0 if little or unknown.
    max_rounds : int or None
        Largest number of timed calls.
    """

    name: str
    module: str
    make: Callable[[int], Call]
    bytes_per_cell: int = 0
    max_rounds: int | None = None


def _opencv(mode: int) -> Callable[[int], Call]:
    def build(levels: int) -> Call:
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=usable_levels(levels),
            blockSize=_BLOCK,
            P1=8 * _BLOCK * _BLOCK,
            P2=32 * _BLOCK * _BLOCK,
            disp12MaxDiff=1,
            preFilterCap=63,
            uniquenessRatio=5,
            speckleWindowSize=0,
            speckleRange=0,
            mode=mode,
        )
        return matcher.compute

    return build


def _pandora(levels: int) -> Call:
    pandora, xarray = import_module("pandora"), import_module("xarray")
    add_disparity = import_module("pandora.img_tools").add_disparity
    new_machine = import_module("pandora.state_machine").PandoraMachine
    check = import_module("pandora.check_configuration").check_pipeline_section
    logging.getLogger("transitions.core").setLevel(logging.ERROR)  # it warns of every step, right or wrong
    pandora.import_plugin()
    steps = {
        "matching_cost": {"matching_cost_method": "census", "window_size": 5},
        "optimization": {"optimization_method": "sgm"},
        "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
        "refinement": {"refinement_method": "vfit"},
        "filter": {"filter_method": "median", "filter_size": 3},
        "validation": {"validation_method": "cross_checking_accurate"},
    }

    def dataset(image: NDArray[np.uint8], disparities: list[int]) -> Any:
        coordinates = {"row": np.arange(image.shape[0]), "col": np.arange(image.shape[1])}
        attributes = {"no_data_img": 0, "valid_pixels": 0, "no_data_mask": 1, "crs": None, "transform": None}
        view = xarray.Dataset({"im": (["row", "col"], image.astype(np.float32))}, coordinates, attributes)
        return add_disparity(view, disparities, None)

    def call(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[Any]:
        pair = dataset(left, [1 - levels, 0]), dataset(right, [0, levels - 1])  # its disparities are negative
        machine = new_machine()
        settings = check({"pipeline": steps}, *(view.assign_coords(band_im=[None]) for view in pair), machine)
        maps, _ = pandora.run(machine, *pair, settings)
        return -np.asarray(maps["disparity_map"].values)

    return call


# The full modes keep two volumes of int16, costs and sums, for the whole image.
BASELINES: dict[str, Baseline] = {
    baseline.name: baseline
    for baseline in (
        Baseline("OpenCV SGBM", "cv2", _opencv(cv2.STEREO_SGBM_MODE_SGBM)),
        Baseline(THREE_WAY, "cv2", _opencv(cv2.STEREO_SGBM_MODE_SGBM_3WAY)),
        Baseline(HH, "cv2", _opencv(cv2.STEREO_SGBM_MODE_HH), 4),
        Baseline("OpenCV HH4", "cv2", _opencv(cv2.STEREO_SGBM_MODE_HH4), 4),
        Baseline("pandora libSGM", "pandora_plugin_libsgm", _pandora, 26, 3),
    )
}
"""Baselines by name: OpenCV's semi-global matcher in 5, 3, 8 and 4 directions, and pandora's."""


def baselines() -> list[str]:
    """Return the names of the baselines whose module is installed."""
    return [baseline.name for baseline in BASELINES.values() if find_spec(baseline.module) is not None]


def usable_levels(levels: int) -> int:
    """Return OpenCV's number of levels for `levels`: the next multiple of 16."""
    return -(-levels // 16) * 16


def label(key: str) -> str:
    """Return a contender's name in the table: that of a baseline, or such as ``"S2 census+sgm"``."""
    if key in BASELINES:
        return key
    return " ".join([*(short for short, name in METHODS.items() if name == key), key])


def make(key: str, levels: int, threads: int) -> Call:
    """Return the call to time.

    Parameters
    ----------
    key : str
        The name of a baseline, or a method of stereokit, which runs with its default options.
    levels : int
        Disparities 0 to `levels` - 1.
    threads : int
        Threads of our methods. OpenCV's are a setting of the process, ``cv2.setNumThreads``.

    Raises
    ------
    UnknownNameError
        If there is no such baseline or method.
    """
    if key in BASELINES:
        return BASELINES[key].make(levels)
    matcher = Matcher(key, max_disparity=levels, threads=threads, device="cpu")
    return lambda left, right: matcher(left, right).disparity


@contextmanager
def opencv_threads(threads: int) -> Iterator[None]:
    """Let OpenCV use so many threads inside the context."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def padded(key: str, levels: int) -> Callable[[NDArray[Any], NDArray[Any]], Disparity]:
    """Return an OpenCV baseline as a matcher that gives the leftmost columns a disparity too.

    Both images are extended on the left by as many columns as there are levels, with copies of the border pixel,
    and the map is cropped; without that OpenCV leaves these columns without a value.

    Parameters
    ----------
    key : str
        A name in `BASELINES` that starts with OpenCV.
    levels : int
        Disparities 0 to `levels` - 1, rounded up to a multiple of 16.
    """
    compute, columns = BASELINES[key].make(levels), usable_levels(levels)

    def match(left: NDArray[Any], right: NDArray[Any]) -> Disparity:
        wide: list[Any] = [cv2.copyMakeBorder(image, 0, 0, columns, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
        disparity = from_opencv(compute(wide[0], wide[1])[:, columns:])
        disparity[disparity < 0] = np.nan
        return Disparity(np.ascontiguousarray(disparity), np.isfinite(disparity))

    return match
