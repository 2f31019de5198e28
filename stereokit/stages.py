"""The stages on whole volumes, for use on their own.

With the same options, ``select(aggregate(cost_volume(left, right), guide))`` equals the map of `stereokit.Matcher`
before post-processing, bit for bit: the same compiled code runs over rows of a stored volume instead of rows computed
on the way. The stages do not depend on methods, so they have their own plain defaults; those of a method are in
`stereokit.defaults` (window, penalties, ``smooth`` and ``border_cost``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import Cost, CostInput, Levels, VolumeRows, produce_volume, takes_8_bits
from stereokit.errors import InputError, OptionError
from stereokit.images.blur import smooth as smoothed
from stereokit.images.check import check_integer, check_nodata, check_number, writable
from stereokit.images.gray import gray_pair
from stereokit.images.maps import numbers
from stereokit.kernels.threads import available_threads
from stereokit.kernels.workspace import Workspace
from stereokit.methods import build_aggregation, build_cost, check_levels, current_names
from stereokit.selection.wta import selection_output

__all__ = ["aggregate", "cost_volume"]


def cost_volume(
    left: Any, right: Any, cost: str | Cost = "zncc", *, max_disparity: int = 128, min_disparity: int = 0,
    border_cost: float | None = 1.0, smooth: float = 0.0, nodata: float | None = None, threads: int | None = None,
    **options: Any,
) -> NDArray[np.uint8]:  # fmt: skip
    """Return the matching costs of all pixels and levels.

    Parameters
    ----------
    left, right : (H, W), (H, W, 3) or (H, W, 4), numbers
        Rectified images, as `stereokit.match` takes them.
    cost : str or Cost
        Name of the cost, or the cost itself.
    max_disparity, min_disparity : int
        Levels ``min_disparity <= d < max_disparity``, pixels.
    border_cost : float or None
        Cost of matches outside the right image as a share of the cost's range; None takes the border pixel.
    smooth : float
        Sigma in pixels of a Gaussian on both images before matching.
    nodata : float or None
        Value of pixels without evidence.
    threads : int or None
        Threads; None uses the processors at hand.
    **options
        Those of the cost; ``outside`` is the old name of `border_cost`.

    Returns
    -------
    (H, W, D) uint8
        0 is equal; element ``[y, x, d]`` compares left column x with right column ``x - d - min_disparity``.

    Raises
    ------
    InputError, OptionError
        If an image or an option cannot be used.
    """
    options = current_names(options)
    border_cost = options.pop("border_cost", border_cost)
    stage: Cost = build_cost(cost, options)
    levels = check_levels(min_disparity, max_disparity)
    count = available_threads() if threads is None else check_integer("threads", threads, 1, 1024)
    share = None if border_cost is None else check_number("border_cost", border_cost, 0, 1)
    sigma = check_number("smooth", smooth, 0, 10)
    gray = smoothed(gray_pair(left, right, check_nodata(nodata)), sigma, eight_bits=takes_8_bits(stage))
    pair = CostInput(gray.left, gray.right, gray.left_bad, gray.right_bad, levels, share, count)
    return produce_volume(stage.prepare(pair, Workspace(), count), gray.left.shape, levels, count)


def aggregate(
    volume: NDArray[Any], guide: Any, aggregation: str = "sgm", *, cost: str | Cost = "zncc",
    threads: int | None = None, **options: Any,
) -> NDArray[Any]:  # fmt: skip
    """Aggregate a volume of costs.

    Parameters
    ----------
    volume : (H, W, D) uint8, or float32 for ``"dt"``
        Costs, as `cost_volume` returns them; not modified.
    guide : (H, W) uint8
        The left grey image, along whose edges costs are not mixed.
    aggregation : str
        Name of the aggregation.
    cost : str or Cost
        The cost of the volume: its range and unit scale the penalties of ``"sgm"``.
    threads : int or None
        Threads; None uses the processors at hand.
    **options
        Those of the aggregation.

    Returns
    -------
    (H, W, D)
        ``uint16`` sums over the paths for ``"sgm"``; for ``"dt"`` ``int16`` in 1/64 units of cost with
        ``mode="rf"``, ``float32`` with ``mode="sum"`` or for a float volume.

    Raises
    ------
    InputError, OptionError
        If the volume, the guide or an option cannot be used.
    """
    stage = build_aggregation(aggregation, options)
    cost_stage: Cost = build_cost(cost, {})
    volume = numbers("volume", volume)
    floats = volume.dtype == np.float32
    if volume.ndim != 3 or 0 in volume.shape or not (volume.dtype == np.uint8 or floats):
        raise InputError(f"volume must be (H, W, D) uint8 or float32, got {volume.dtype} {volume.shape}")
    if floats and not getattr(stage, "accepts_floats", False):
        raise InputError(f"volume must be uint8 for aggregation {stage.name!r}, got float32")
    if floats and not np.isfinite(volume).all():
        raise InputError("volume must be finite, got NaN or infinity")
    guide = writable(numbers("guide", guide))
    if guide.dtype != np.uint8 or guide.shape != volume.shape[:2]:
        raise InputError(f"guide must be uint8 {volume.shape[:2]}, got {guide.dtype} {guide.shape}")
    count = available_threads() if threads is None else check_integer("threads", threads, 1, 1024)
    if not floats and int(volume.max()) > cost_stage.cost_max:
        raise OptionError(
            f"cost {cost_stage.name!r} has costs up to {cost_stage.cost_max}, but the volume has {volume.max()}"
        )
    height, width, depth = volume.shape
    levels = Levels(0, depth)
    total_dtype = np.dtype(np.float32) if floats else np.dtype(stage.total_dtype)
    total = np.empty((height, width, levels.padded), total_dtype)
    maps = np.empty((height, width), np.float32), np.empty((height, width), total_dtype)
    out = selection_output(*maps, None, depth, 0, False)
    rows = [VolumeRows(writable(volume), levels.padded)] * max(2, count)
    keywords: dict[str, Any] = {}
    if floats:
        padded = np.zeros((height, width, levels.padded), np.float32)
        padded[:, :, :depth] = volume
        keywords["volume"] = padded
    stage.sweep(rows, levels, cost_stage, guide, Workspace(), count, out, total, **keywords)
    return np.ascontiguousarray(total[:, :, :depth])
