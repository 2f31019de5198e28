"""OpenCV's ``StereoSGBM`` with stereokit behind it: change one import, and what calls it stays.

>>> import numpy as np
>>> from stereokit.opencv import StereoSGBM_create
>>> left = np.random.default_rng(0).integers(0, 256, (40, 120), dtype=np.uint8)
>>> right = np.roll(left, -5, axis=1)
>>> sgbm = StereoSGBM_create(minDisparity=0, numDisparities=32, uniquenessRatio=5)
>>> disparity = sgbm.compute(left, right)
>>> disparity.dtype, int(np.median(disparity)) // 16
(dtype('int16'), 5)

Arguments, setters, getters and results are OpenCV's; the matching is ``census+sgm``, whose parameters have other units.
What has no counterpart is kept for its getter, and named in one warning. See docs/opencv.md for the table.
"""

from __future__ import annotations

from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError, OptionError
from stereokit.images.check import check_integer
from stereokit.matching import Matcher
from stereokit.notices import warn

__all__ = [
    "STEREO_SGBM_MODE_HH",
    "STEREO_SGBM_MODE_HH4",
    "STEREO_SGBM_MODE_SGBM",
    "STEREO_SGBM_MODE_SGBM_3WAY",
    "StereoSGBM",
    "StereoSGBM_create",
]

STEREO_SGBM_MODE_SGBM = 0
STEREO_SGBM_MODE_HH = 1
STEREO_SGBM_MODE_SGBM_3WAY = 2
STEREO_SGBM_MODE_HH4 = 3

_STEPS = 16
"""Steps of a result in a pixel."""

_DEFAULTS = {
    "minDisparity": 0, "numDisparities": 16, "blockSize": 3, "P1": 0, "P2": 0, "disp12MaxDiff": 0, "preFilterCap": 0,
    "uniquenessRatio": 0, "speckleWindowSize": 0, "speckleRange": 0, "mode": STEREO_SGBM_MODE_SGBM,
}  # fmt: skip

_WITHOUT_COUNTERPART = ("blockSize", "P1", "P2", "preFilterCap", "speckleRange", "mode")


class StereoSGBM:
    """What `StereoSGBM_create` returns: OpenCV's interface, stereokit's maps."""

    MODE_SGBM: ClassVar[int] = STEREO_SGBM_MODE_SGBM
    MODE_HH: ClassVar[int] = STEREO_SGBM_MODE_HH
    MODE_SGBM_3WAY: ClassVar[int] = STEREO_SGBM_MODE_SGBM_3WAY
    MODE_HH4: ClassVar[int] = STEREO_SGBM_MODE_HH4

    def __init__(self, **parameters: int) -> None:
        self._parameters = dict(_DEFAULTS)
        self._matchers: dict[int, Matcher] = {}
        for name, value in parameters.items():
            self._set(name, value, quiet=True)
        without = [name for name in _WITHOUT_COUNTERPART if self._parameters[name] != _DEFAULTS[name]]
        _warn_of(without)
        self.matcher(1)  # contradictions are refused here, not at the first pair

    create: ClassVar[Any]

    def _set(self, name: str, value: Any, quiet: bool = False) -> None:
        low = {"numDisparities": 1, "uniquenessRatio": 0, "speckleWindowSize": 0}.get(name)
        high = {"uniquenessRatio": 100}.get(name)
        before = self._parameters[name]
        self._parameters[name] = check_integer(name, value, low, high)
        lowest, count = self._parameters["minDisparity"], self._parameters["numDisparities"]
        if not -2047 <= lowest or lowest + count > 2048:
            self._parameters[name] = before
            raise OptionError(
                "minDisparity and numDisparities must stay within -2047 .. 2047 pixels, which is what 16 bits hold, "
                f"got {lowest} and {count}"
            )
        if not quiet and name in _WITHOUT_COUNTERPART and self._parameters[name] != before:
            _warn_of([name])
        self._matchers.clear()

    def matcher(self, pixels: int) -> Matcher:
        """Return the matcher for images of so many pixels: speckles are counted in pixels here, in shares there."""
        if pixels not in self._matchers:
            parameters = self._parameters
            self._matchers[pixels] = Matcher(
                "census+sgm",
                min_disparity=parameters["minDisparity"],
                max_disparity=parameters["minDisparity"] + parameters["numDisparities"],
                uniqueness=parameters["uniquenessRatio"],
                smp=parameters["disp12MaxDiff"] >= 0,
                speckle=min((parameters["speckleWindowSize"] + 0.5) / pixels, 1)
                if parameters["speckleWindowSize"]
                else 0,
                fill=None,
            )
        return self._matchers[pixels]

    def compute(self, left: Any, right: Any, disparity: NDArray[np.int16] | None = None) -> NDArray[np.int16]:
        """Match a rectified pair.

        Parameters
        ----------
        left, right : (H, W) or (H, W, 3) uint8
            Grey, or BGR as OpenCV has it.
        disparity : (H, W) int16, optional
            Where the result goes, if it fits.

        Returns
        -------
        (H, W) int16
            Sixteenths of a pixel; ``16 * (minDisparity - 1)`` where there is no valid disparity. The columns at the
            left border are matched too, which OpenCV leaves invalid.

        Raises
        ------
        InputError
            If the images cannot be used.
        """
        images = [self._grey(name, image) for name, image in (("left", left), ("right", right))]
        result = self.matcher(images[0].size)(*images)
        invalid = _STEPS * (self._parameters["minDisparity"] - 1)
        pixels = np.where(result.valid, result.disparity, invalid / _STEPS)
        steps: NDArray[np.int16] = np.rint(pixels * _STEPS).astype(np.int16)
        if isinstance(disparity, np.ndarray) and disparity.shape == steps.shape and disparity.dtype == steps.dtype:
            disparity[...] = steps
            return disparity
        return steps

    @staticmethod
    def _grey(name: str, image: Any) -> NDArray[np.uint8]:
        if image is None:
            raise InputError(f"{name} must be an image, got None: cv2.imread returns it for a file that it cannot read")
        array = np.asarray(image)
        if array.dtype != np.uint8 or array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (1, 3)):
            raise InputError(
                f"{name} must be (H, W) or (H, W, 3) uint8 as for OpenCV, got {array.dtype} of shape {array.shape}; "
                "stereokit.match takes other types"
            )
        if array.ndim == 3 and array.shape[2] == 3 and array.size:
            return np.asarray(cv2.cvtColor(np.ascontiguousarray(array), cv2.COLOR_BGR2GRAY), np.uint8)
        return array.reshape(array.shape[:2])

    def getMinDisparity(self) -> int:
        """Return the smallest disparity, pixels."""
        return self._parameters["minDisparity"]

    def setMinDisparity(self, minDisparity: int) -> None:
        """Set the smallest disparity, pixels."""
        self._set("minDisparity", minDisparity)

    def getNumDisparities(self) -> int:
        """Return how many disparities are tried."""
        return self._parameters["numDisparities"]

    def setNumDisparities(self, numDisparities: int) -> None:
        """Set how many disparities are tried; any number, not only multiples of 16."""
        self._set("numDisparities", numDisparities)

    def getBlockSize(self) -> int:
        """Return what was set; the census window is 5x5 whatever it is."""
        return self._parameters["blockSize"]

    def setBlockSize(self, blockSize: int) -> None:
        """Set a value that has no counterpart."""
        self._set("blockSize", blockSize)

    def getP1(self) -> int:
        """Return what was set; the penalties are those of ``census+sgm``."""
        return self._parameters["P1"]

    def setP1(self, P1: int) -> None:
        """Set a value that has no counterpart: costs have another unit."""
        self._set("P1", P1)

    def getP2(self) -> int:
        """Return what was set; the penalties are those of ``census+sgm``."""
        return self._parameters["P2"]

    def setP2(self, P2: int) -> None:
        """Set a value that has no counterpart: costs have another unit."""
        self._set("P2", P2)

    def getDisp12MaxDiff(self) -> int:
        """Return what was set; negative switches the check off."""
        return self._parameters["disp12MaxDiff"]

    def setDisp12MaxDiff(self, disp12MaxDiff: int) -> None:
        """Set whether matches are checked against the right view: not if negative."""
        self._set("disp12MaxDiff", disp12MaxDiff)

    def getPreFilterCap(self) -> int:
        """Return what was set; census needs no pre-filter."""
        return self._parameters["preFilterCap"]

    def setPreFilterCap(self, preFilterCap: int) -> None:
        """Set a value that has no counterpart."""
        self._set("preFilterCap", preFilterCap)

    def getUniquenessRatio(self) -> int:
        """Return by how many percent the best rival must cost more."""
        return self._parameters["uniquenessRatio"]

    def setUniquenessRatio(self, uniquenessRatio: int) -> None:
        """Set by how many percent the best rival must cost more."""
        self._set("uniquenessRatio", uniquenessRatio)

    def getSpeckleWindowSize(self) -> int:
        """Return the size of the largest region that is removed, pixels."""
        return self._parameters["speckleWindowSize"]

    def setSpeckleWindowSize(self, speckleWindowSize: int) -> None:
        """Set the size of the largest region that is removed, pixels; 0 removes none."""
        self._set("speckleWindowSize", speckleWindowSize)

    def getSpeckleRange(self) -> int:
        """Return what was set; neighbours within a pixel belong together."""
        return self._parameters["speckleRange"]

    def setSpeckleRange(self, speckleRange: int) -> None:
        """Set a value that has no counterpart."""
        self._set("speckleRange", speckleRange)

    def getMode(self) -> int:
        """Return what was set; the number of paths does not depend on it."""
        return self._parameters["mode"]

    def setMode(self, mode: int) -> None:
        """Set a value that has no counterpart."""
        self._set("mode", mode)


def _warn_of(names: list[str]) -> None:
    if names:
        many = len(names) > 1
        warn(
            f"{', '.join(names)} {'have' if many else 'has'} no counterpart in stereokit and {'are' if many else 'is'} "
            "not used; see docs/opencv.md"
        )


def StereoSGBM_create(
    minDisparity: int = 0, numDisparities: int = 16, blockSize: int = 3, P1: int = 0, P2: int = 0,
    disp12MaxDiff: int = 0, preFilterCap: int = 0, uniquenessRatio: int = 0, speckleWindowSize: int = 0,
    speckleRange: int = 0, mode: int = STEREO_SGBM_MODE_SGBM,
) -> StereoSGBM:  # fmt: skip
    """Return a matcher with the arguments of ``cv2.StereoSGBM_create``.

    Parameters
    ----------
    minDisparity, numDisparities : int
        ``minDisparity <= d < minDisparity + numDisparities`` is tried, pixels.
    uniquenessRatio : int
        Percent by which the best rival must cost more, 0 to 100.
    disp12MaxDiff : int
        Negative switches the check against the right view off; its tolerance is stereokit's own.
    speckleWindowSize : int
        Largest region of like disparity that is removed, pixels.
    blockSize, P1, P2, preFilterCap, speckleRange, mode : int
        Have no counterpart; one warning names those that differ from OpenCV's defaults.

    Raises
    ------
    OptionError
        If a value breaks its rule.

    Warns
    -----
    StereokitWarning
        If a value that has no counterpart is not OpenCV's default.
    """
    return StereoSGBM(
        minDisparity=minDisparity, numDisparities=numDisparities, blockSize=blockSize, P1=P1, P2=P2,
        disp12MaxDiff=disp12MaxDiff, preFilterCap=preFilterCap, uniquenessRatio=uniquenessRatio,
        speckleWindowSize=speckleWindowSize, speckleRange=speckleRange, mode=mode,
    )  # fmt: skip


StereoSGBM.create = staticmethod(StereoSGBM_create)
