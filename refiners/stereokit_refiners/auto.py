"""The refiner ``"auto"``: the general one where it helps, linear upscaling where it does not.

Linear is taken where the general refiner cannot run (no runtime computes its network rightly here), and for images with
a side below `SMALLEST` pixels, which were not measured. At full size, where linear upscaling changes nothing, that
leaves the matcher's map as it is. Neither the scale nor a GPU is a reason: at 1, 0.5 and 0.25 the
general one is better, and so it is for crops of a street down to 16x32 pixels (bad-1 38.7 % against linear's 44.9 %).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from numpy.typing import NDArray

from stereokit.errors import OptionError, StereokitError
from stereokit.notices import warn
from stereokit.result import Disparity
from stereokit_refiners.general import EvidenceRefiner
from stereokit_refiners.linear import Linear

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = ["SMALLEST", "AutoRefiner"]

SMALLEST = 16
"""Rows and columns of the smallest image that the general refiner gets, pixels."""


@dataclass(frozen=True)
class AutoRefiner:
    """The general refiner or linear upscaling.

    Parameters
    ----------
    backend, precision : str
        Of the general one; see `stereokit_refiners.LearnedRefiner`.

    Warns
    -----
    StereokitWarning
        If the general refiner cannot run here; maps are then upscaled linearly.
    """

    backend: str = "auto"
    precision: str = "auto"
    any_scale: ClassVar[bool] = True
    maps_are_new: ClassVar[bool] = True
    general: EvidenceRefiner | None = field(init=False, repr=False)
    """None where it cannot run."""

    def __post_init__(self) -> None:
        general = None
        try:
            general = EvidenceRefiner(backend=self.backend, precision=self.precision)
            general.check_runtime()
        except OptionError:
            raise
        except StereokitError as error:
            warn(f"refiner 'auto' is linear: {error}")
            general = None
        object.__setattr__(self, "general", general)

    @property
    def needs_right(self) -> bool:
        """Whether the right image must come too."""
        return self.general is not None

    needs_candidates = needs_confidence = needs_right

    @property
    def fingerprint(self) -> str:
        """What the result depends on, beside the inputs."""
        return "linear" if self.general is None else f"{self.general.fingerprint}-{SMALLEST}"

    def __call__(
        self, coarse: Disparity, left: NDArray[Any], *, right: NDArray[Any] | None = None, scale: float = 0.5,
        threads: int = 1, passes: int | None = None,
    ) -> Disparity:  # fmt: skip
        """Return the refined map at the size of `left`; see `stereokit_refiners.contract.Refiner`."""
        if self.general is None or min(left.shape) < SMALLEST:
            return Linear()(coarse, left, scale=scale, threads=threads)
        return self.general(coarse, left, right=right, scale=scale, threads=threads, passes=passes)

    @property
    def bytes_per_pixel(self) -> int:
        """What refining takes at most."""
        return Linear.bytes_per_pixel if self.general is None else self.general.bytes_per_pixel

    @property
    def for_search(self) -> Callable[..., Disparity]:
        """What refines the half-size map that says where to search."""
        return partial(self, passes=1)

    def on_device(
        self, coarse: DeviceDisparity, left: Any, stream: Any, *, right: Any = None, scale: float = 0.5
    ) -> tuple[Any, Any, Any]:
        """Return the map at the size of `left`, on the GPU; see `stereokit_refiners.contract.DeviceRefiner`."""
        if self.general is None or min(left.shape) < SMALLEST:
            return Linear().on_device(coarse, left, stream, scale=scale)
        return self.general.on_device(coarse, left, stream, right=right, scale=scale)
