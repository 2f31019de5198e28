"""The general refiner: the network `stereokit_refiners.networks.evidence`, at several sizes, once or more often."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import DeviceError, OptionError
from stereokit.images.check import check_integer
from stereokit.images.resize import halved
from stereokit.result import Disparity
from stereokit_refiners.learned import LearnedRefiner, right_of
from stereokit_refiners.linear import enlarged, upscaled

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = ["EvidenceRefiner"]

_MOST_REFINEMENTS = 4


@dataclass(frozen=True, eq=False)
class EvidenceRefiner(LearnedRefiner):
    """The one for every camera: see `stereokit_refiners.networks.evidence`.

    Parameters
    ----------
    weights, backend, precision : str
        As of `LearnedRefiner`.
    evidence_scale : {1, 0.5}
        Size of the images that are looked at. With 0.5 it refines a map of a quarter or half of the size up to half
        size, and upscales that linearly: in less than half of the time, with errors between its own and linear ones.
    refinements : int or None
        How often it refines, 1 to 4: from the second time on its own map. Indoors and of near things two leave up to a
        tenth fewer errors than one, on roads as many; each takes as long as the first. None is two with ``scale=1``,
        where accuracy counts, and else one. The half-size map that says where to search is refined once.

    Raises
    ------
    OptionError, FileError, StereokitError
        As `LearnedRefiner`.
    """

    evidence_scale: float = 1
    refinements: int | None = None
    architecture: ClassVar[str] = "evidence"
    of_half_size: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if isinstance(self.evidence_scale, bool) or self.evidence_scale not in (1, 0.5):
            raise OptionError(f"evidence_scale must be 1 or 0.5, got {self.evidence_scale!r}")
        if self.refinements is not None:
            count = check_integer("refinements", self.refinements, 1, _MOST_REFINEMENTS)
            object.__setattr__(self, "refinements", count)
        super().__post_init__()

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "evidence_scale": self.evidence_scale, "refinements": self.refinements}

    @property
    def fingerprint(self) -> str:
        """What the result depends on, beside the inputs."""
        scale = "" if self.evidence_scale == 1 else f"-{self.evidence_scale:g}"
        return super().fingerprint + scale + ("" if self.refinements is None else f"-x{self.refinements}")

    def __call__(
        self, coarse: Disparity, left: NDArray[Any], *, right: NDArray[Any] | None = None, scale: float = 0.5,
        threads: int = 1, passes: int | None = None,
    ) -> Disparity:  # fmt: skip
        """Return the refined map at the size of `left`; see `stereokit_refiners.contract.Refiner`."""
        if self.evidence_scale == 1:
            return super().__call__(coarse, left, right=right, scale=scale, threads=threads, passes=passes)
        self.check_scale(scale)
        views = halved(left, threads), halved(right_of(left, right), threads)
        passes = (self.refinements or 1) if passes is None else passes
        half = super().__call__(coarse, views[0], right=views[1], scale=2 * scale, threads=threads, passes=passes)
        rows, columns = left.shape
        disparity = upscaled(half.disparity, 2, rows, columns, threads)
        known = enlarged(coarse.valid.view(np.uint8), round(1 / scale), rows, columns).view(np.bool_)
        if np.isnan(coarse.disparity).any():
            known &= ~np.isnan(disparity)
        assert half.confidence is not None
        return Disparity(disparity, known, upscaled(half.confidence, 1, rows, columns, threads))

    def check_scale(self, scale: float) -> None:
        """Raise OptionError if maps of this size cannot be refined."""
        if scale > self.evidence_scale:
            raise OptionError(f"evidence_scale must be 1 with scale={scale:g}, got {self.evidence_scale:g}")

    def _passes_at(self, step: int) -> int:
        """Return how often a map is refined; `step` are the pixels of the image to one of the map."""
        return super()._passes_at(step) if self.refinements is None else self.refinements

    def on_device(
        self, coarse: DeviceDisparity, left: Any, stream: Any, *, right: Any = None, scale: float = 0.5
    ) -> tuple[Any, Any, Any]:
        """Return the refined map on the GPU, with torch in fp32; see `stereokit_refiners.contract.DeviceRefiner`."""
        if self.evidence_scale != 1:
            raise DeviceError(f"evidence_scale must be 1 for images on the device, got {self.evidence_scale:g}")
        return super().on_device(coarse, left, stream, right=right, scale=scale)
