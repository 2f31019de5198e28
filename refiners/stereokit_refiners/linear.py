"""Linear upscaling: the setting "Mini + Linear" of the StereoVAE paper.

A disparity of d half-size pixels is 2 d full-size pixels. Pixel centres are kept: half-size pixel ``i`` covers the
full-size pixels ``2 i`` and ``2 i + 1``. Odd sizes were extended by one before halving, so the result is cropped.
The sums are of single IEEE operations in a fixed order, so that the bits are the same on every processor; those of
``cv2.resize`` are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.threads import run, spans
from stereokit.result import Disparity
from stereokit_refiners.contract import on_tensors

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = ["Linear", "doubled", "enlarged", "upscaled"]


@dataclass(frozen=True)
class Linear:
    """Bilinear upscaling; the left image is used for its size only."""

    any_scale: ClassVar[bool] = True
    bytes_per_pixel: ClassVar[int] = 12

    def __call__(self, coarse: Disparity, left: NDArray[Any], *, threads: int = 1, scale: float = 0.5) -> Disparity:
        """Return the map at the size of `left`; see `stereokit_refiners.contract.Refiner`."""
        height, width = left.shape
        step = round(1 / scale)
        disparity = _upscaled_by(step, coarse.disparity, step, height, width, threads)
        valid = enlarged(coarse.valid.view(np.uint8), step, height, width).astype(bool)
        valid &= ~np.isnan(disparity)
        confidence = None
        if coarse.confidence is not None:
            confidence = _upscaled_by(step, coarse.confidence, 1, height, width, threads)
            confidence[~valid] = 0
        return Disparity(disparity, valid, confidence)

    def on_device(
        self, coarse: DeviceDisparity, left: Any, stream: Any, *, scale: float = 0.5
    ) -> tuple[Any, Any, Any]:  # fmt: skip
        """Return the map at the size of `left`, on the GPU; see `stereokit_refiners.contract.DeviceRefiner`."""
        maps: tuple[Any, Any, Any] = on_tensors().linear_on_device(coarse, left, stream, round(1 / scale))
        return maps


def doubled(image: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """Return each pixel four times, cut to a size."""
    return enlarged(image, 2, rows, columns)


def enlarged(image: NDArray[Any], step: int, rows: int, columns: int) -> NDArray[Any]:
    """Return each pixel ``step * step`` times, cut to a size."""
    size = (step * image.shape[1], step * image.shape[0])
    large = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)).reshape(size[1], size[0])
    return np.ascontiguousarray(large[:rows, :columns])


def _upscaled_by(
    step: int, image: NDArray[np.float32], gain: float, rows: int, columns: int, threads: int
) -> NDArray[np.float32]:
    """Return `gain` times an image at `step` times its size, bilinearly, cut to a size: a copy, or as `upscaled`."""
    if step == 2:
        return upscaled(image, gain, rows, columns, threads)
    image = np.ascontiguousarray(image, np.float32)
    if step == 4:
        image = _fourfold(_fourfold(image.T * np.float32(gain)).T)
    return np.array(image[:rows, :columns]) if step == 4 else image[:rows, :columns] * np.float32(gain)


def _fourfold(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an image at four times its width, bilinearly: its pixel and the next one in eighths, each sum rounded."""
    height, width = image.shape
    before, after = (image[:, np.clip(np.arange(width) + side, 0, width - 1)] for side in (-1, 1))
    out = np.empty((height, width, 4), np.float32)
    for phase, (share, other) in enumerate(((5, before), (7, before), (7, after), (5, after))):
        out[:, :, phase] = image * np.float32(share / 8) + other * np.float32(1 - share / 8)
    return out.reshape(height, 4 * width)


def upscaled(image: NDArray[np.float32], gain: float, rows: int, columns: int, threads: int = 1) -> NDArray[np.float32]:
    """Return `gain` times an image at twice its size, bilinearly, cut to a size.

    Parameters
    ----------
    image : (h, w) float32
    gain : float
        A power of two, so that it adds no rounding.
    rows, columns : int
        Size of the result, at most ``2h`` x ``2w``.
    threads : int

    Returns
    -------
    (rows, columns) float32
    """
    image = np.ascontiguousarray(image, np.float32)
    out = np.empty((rows, columns), np.float32)
    parts = spans(-(-rows // 2), threads)
    lines = np.empty((len(parts), image.shape[1] + 2), np.float32)
    run(
        [partial(_upscale, image, np.float32(gain), y0, y1, lines[k], out) for k, (y0, y1) in enumerate(parts)], threads
    )
    return out


@inline
def _mixed(mine: Any, other: Any) -> Any:
    """Return the value a quarter of the way from a pixel's centre to the next one's."""
    return np.float32(0.75) * mine + np.float32(0.25) * other


@kernel
def _upscale(
    image: NDArray[np.float32], gain: np.float32, y0: int, y1: int, line: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    """Down the columns first, into a line with one more value at each end, then along it."""
    height, width = image.shape
    for row in range(2 * y0, min(2 * y1, out.shape[0])):
        y = row // 2
        mine = image[y]
        other = image[min(max(y - 1 + 2 * (row % 2), 0), height - 1)]
        for x in range(width):
            line[x + 1] = gain * _mixed(mine[x], other[x])
        line[0] = line[1]
        line[width + 1] = line[width]
        for x in range(out.shape[1] // 2):
            out[row, 2 * x] = _mixed(line[x + 1], line[x])
            out[row, 2 * x + 1] = _mixed(line[x + 1], line[x + 2])
        if out.shape[1] % 2 == 1:
            out[row, out.shape[1] - 1] = _mixed(line[width], line[width - 1])
