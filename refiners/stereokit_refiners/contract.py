"""The contract of a refiner.

A refiner is built by its factory (with options, if it is a dataclass that has some) and called with the half-size
map and the full-size left image. Packages announce theirs in the entry-point group ``stereokit.refiners``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol

from numpy.typing import NDArray

from stereokit.errors import StereokitError
from stereokit.result import Disparity

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = ["DeviceRefiner", "Refiner", "on_tensors"]


def on_tensors(module: str = "tensors") -> Any:
    """Return the module `stereokit_refiners.runtimes.tensors`, or another of that folder that needs torch.

    Raises
    ------
    StereokitError
        If torch is not installed.
    """
    try:
        return import_module(f"stereokit_refiners.runtimes.{module}")
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise StereokitError("refiners on the GPU need torch, which is not installed: pip install torch") from None


class Refiner(Protocol):
    """Brings a half-size map to full size.

    One that looks at the matcher's confidence has an attribute ``needs_confidence`` that is True, and one that looks at
    its candidates ``needs_candidates``; others may leave them out. `stereokit.Matcher` then gives it a coarse map with
    ``confidence``, or with both. One that looks at the right image too has a ``needs_right`` that is True, and is
    called with ``right=``, of the size and type of `left`. One that takes maps of other sizes has an ``any_scale``
    that is True, and is called with ``scale=``, the size at which was matched: 1, 0.5 or 0.25; rows and columns of
    the coarse map are those of `left` times that, rounded up. One that has both may be called two times for one pair:
    at full size with ``scale=1`` it first refines the pair of half the size, with ``scale=1`` too, whose map tells a
    search from coarse to fine where to look; what is called then is its ``for_search``, if it has one. One that can
    work on the GPU has a method ``on_device``, a `DeviceRefiner`, for `stereokit.Matcher.on_device`.
    """

    def __call__(self, coarse: Disparity, left: NDArray[Any], *, threads: int = 1) -> Disparity:
        """Return the full-size map.

        Must be safe to call from several threads at once.

        Parameters
        ----------
        coarse : Disparity, (ceil(H/2), ceil(W/2))
            Map of the half-size pair, in half-size pixels, NaN where invalid.
        left : (H, W) uint8
            Left grey image at full size.
        threads : int
            How many threads this call may use; the result must not depend on it.

        Returns
        -------
        Disparity, (H, W)
            In full-size pixels, on arrays of its own.
        """


class DeviceRefiner(Protocol):
    """Brings a map to full size on the GPU, without a copy to the host.

    It is called with what the attributes of its refiner ask for, as `Refiner` is. With ``needs_right`` that is also
    ``right=``, the right grey image at full size, (H, W) uint8 on the device. With ``any_scale`` that is also
    ``scale=``, 1, 0.5 or 0.25, which is left out where it is 0.5 and the right image is not asked for. The matcher
    holds the map of a refiner with ``needs_right`` to its range. It is called once for one view: a GPU searches in
    full, so that there is no smaller map to refine before.
    """

    def __call__(self, coarse: DeviceDisparity, left: Any, stream: Any) -> tuple[Any, Any, Any]:
        """Return the full-size disparity, what of it was measured, and the confidence.

        Must wait for nothing, and be safe to call from several threads at once.

        Parameters
        ----------
        coarse : stereokit.cuda.pipeline.DeviceDisparity, (ceil(H/2), ceil(W/2))
            Map of the half-size pair in half-size pixels, dense; with another `scale`, rows and columns are those of
            `left` times that, rounded up. Arrays with ``__cuda_array_interface__`` that the matcher will write over
            after what is on the stream.
        left : (H, W) uint8
            Left grey image at full size, on the device too.
        stream : numba stream
            Where to run; ``int(stream)`` is its address, 0 the default stream.

        Returns
        -------
        disparity, valid, confidence : (H, W) float32, uint8, float32 or None
            In full-size pixels; arrays with ``__cuda_array_interface__`` of their own, ready when the stream is.
        """
