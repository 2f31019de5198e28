"""The data of the reports' viewer for one stereo pair: both images, maps, truth, geometry.

The page draws pictures, errors and points itself from the maps (`stereokit_evaluation.report.packing`), so that
hovering reads numbers and each further method costs one map.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.calibration import Calibration
from stereokit.errors import InputError
from stereokit.images.intensity import display_8bit
from stereokit.result import color_range, colorize
from stereokit_evaluation.report.packing import pack_map, pack_mask
from stereokit_evaluation.scoring.error_map import COLOURS, EDGES
from stereokit_evaluation.scoring.kitti import D1_PIXELS, D1_SHARE, fill_background

__all__ = ["MethodMap", "constants", "counted_pixels", "pair"]

_JPEG_QUALITY = 85
_DIFFERENCE = ((33, 102, 220), (245, 245, 245), (214, 70, 20))  # blue, white, red: A smaller, equal, larger
_DIFFERENCE_PIXELS = 3.0  # beyond which the colour stays


@dataclass(frozen=True, eq=False)
class MethodMap:
    """The map of one method.

    Attributes
    ----------
    name : str
        The name in the viewer.
    disparity : (H, W) float32
        Pixels, NaN where unknown.
    valid : (H, W) bool
        Where it was measured.
    note : str
        A short text next to the name, such as its error on this pair.
    """

    name: str
    disparity: NDArray[np.float32]
    valid: NDArray[np.bool_]
    note: str = ""


def constants() -> dict[str, Any]:
    """Return the constants for drawing any pair: Turbo's colours, those of errors and their rule, of differences."""
    ramp = np.linspace(0.0, 1.0, 256, dtype=np.float32)[None]
    shades = [np.interp(np.linspace(0, 2, 65), (0, 1, 2), ends) for ends in zip(*_DIFFERENCE, strict=True)]
    return {
        "turbo": colorize(ramp, 0.0, 1.0)[0].tolist(),
        "error": {"colours": COLOURS, "edges": EDGES, "pixels": D1_PIXELS, "share": D1_SHARE},
        "difference": {"colours": np.rint(shades).astype(int).T.tolist(), "pixels": _DIFFERENCE_PIXELS},
    }


def pair(
    name: str,
    left: NDArray[Any],
    maps: Sequence[MethodMap],
    *,
    right: NDArray[Any] | None = None,
    noc: NDArray[np.float32] | None = None,
    occ: NDArray[np.float32] | None = None,
    calibration: Calibration | None = None,
) -> dict[str, Any]:
    """Return a pair as the page's JSON has it.

    Parameters
    ----------
    name : str
    left : (H, W) or (H, W, 3), uint8, uint16 or float
        The left image.
    maps : sequence of MethodMap
        At least one, as large as `left`. Where one has no value it is filled as for scoring, and marked as not
        measured.
    right : (H, W) or (H, W, 3), uint8, uint16 or float, optional
        The right image.
    noc, occ : (H, W) float32, optional
        True disparity of the pixels that both cameras see, and of all pixels; NaN unknown.
    calibration : Calibration, optional
        For depth; None leaves it out.

    Raises
    ------
    InputError
        If there is no map, or one has another size.
    """
    if not maps:
        raise InputError("maps must hold at least one map, got none")
    height, width = left.shape[:2]
    if right is not None and right.shape[:2] != (height, width):
        raise InputError(f"right must have the size of the left image, {(height, width)}, got {right.shape[:2]}")
    for label, array in (("noc", noc), ("occ", occ), *((method_map.name, method_map.disparity) for method_map in maps)):
        if array is not None and array.shape != (height, width):
            raise InputError(f"{label} must have the size of the left image, {(height, width)}, got {array.shape}")
    truth = noc if occ is None else occ
    reference = maps[0].disparity if truth is None else truth
    bottom, top = color_range(reference)
    return {
        "name": name,
        "width": width,
        "height": height,
        "left": _jpeg(left),
        "right": None if right is None else _jpeg(right),
        "bottom": bottom,
        "top": max(bottom + 1.0, top),
        "truth": None if truth is None else pack_map(truth),
        "pixels": counted_pixels(noc, occ),
        "seen": None if noc is None or occ is None else pack_mask(np.isfinite(noc)),
        "calibration": None if calibration is None else _geometry(calibration, width, height),
        "maps": [_packed(method_map) for method_map in maps],
    }


def counted_pixels(noc: NDArray[np.float32] | None, occ: NDArray[np.float32] | None) -> str:
    """Return which pixels the errors of a pair count, in words; empty without ground truth."""
    if noc is None and occ is None:
        return ""
    if occ is None:
        return f"{_count(noc)} pixels that both cameras see have a true disparity; the others do not count."
    if noc is None:
        return f"{_count(occ)} pixels have a true disparity and count, occluded ones too where the truth has them."
    return (
        f"{_count(occ)} pixels have a true disparity (D1 all); both cameras see {_count(noc)} of them (D1 noc); "
        "a pixel without a value is filled first."
    )


def _count(truth: NDArray[np.float32] | None) -> str:
    return f"{0 if truth is None else int(np.count_nonzero(np.isfinite(truth))):,}"


def _packed(method_map: MethodMap) -> dict[str, Any]:
    known = np.isfinite(method_map.disparity)
    # Filling for scoring takes negative values for unknown, so only maps with gaps go through it.
    filled = method_map.disparity if known.all() else fill_background(method_map.disparity)
    measured = pack_mask(known & method_map.valid)
    return {"name": method_map.name, "note": method_map.note, "measured": measured, "map": pack_map(filled)}


def _geometry(calibration: Calibration, width: int, height: int) -> dict[str, float]:
    calibration.check_size(width, height)
    names = ("fx", "fy", "cx0", "cy", "baseline_m", "doffs")
    return {name: float(getattr(calibration, name)) for name in names}


def _jpeg(image: NDArray[Any]) -> str:
    """Return an image as a data URI."""
    image = display_8bit(image)
    bgr = image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
    ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not ok:
        raise InputError(f"left cannot be written as JPEG, got shape {image.shape}")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
