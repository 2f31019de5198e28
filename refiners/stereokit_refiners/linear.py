"""Linear upscaling: the setting "Mini + Linear" of the StereoVAE paper.

A disparity of d half-size pixels is 2 d full-size pixels. Pixel centres are kept: half-size pixel ``i`` covers the
full-size pixels ``2 i`` and ``2 i + 1``. Odd sizes were extended by one before halving, so the result is cropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.result import Disparity
from stereokit_refiners.contract import on_tensors

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = ["Linear"]


@dataclass(frozen=True)
class Linear:
    """Bilinear upscaling; the left image is used for its size only."""

    any_scale: ClassVar[bool] = True

    def __call__(self, coarse: Disparity, left: NDArray[Any], *, threads: int = 1, scale: float = 0.5) -> Disparity:
        """Return the map at the size of `left`; see `stereokit_refiners.contract.Refiner`."""
        height, width = left.shape
        step = round(1 / scale)

        def upscale(image: NDArray[Any], method: int) -> NDArray[Any]:
            size = (step * image.shape[1], step * image.shape[0])
            full = np.asarray(cv2.resize(image, size, interpolation=method)).reshape(size[1], size[0])
            return np.ascontiguousarray(full[:height, :width])

        disparity = upscale(coarse.disparity, cv2.INTER_LINEAR) * np.float32(step)
        valid = upscale(coarse.valid.view(np.uint8), cv2.INTER_NEAREST).astype(bool)
        valid &= ~np.isnan(disparity)
        confidence = None
        if coarse.confidence is not None:
            confidence = upscale(coarse.confidence, cv2.INTER_LINEAR)
            confidence[~valid] = 0
        return Disparity(disparity, valid, confidence)

    def on_device(self, coarse: DeviceDisparity, left: Any, stream: Any) -> tuple[Any, Any, Any]:
        """Return the map at the size of `left`, on the GPU; see `stereokit_refiners.contract.DeviceRefiner`."""
        found: tuple[Any, Any, Any] = on_tensors().linear_on_device(coarse, left, stream)
        return found
