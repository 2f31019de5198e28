"""A refiner that follows the image: each pixel takes the disparity of the half-size pixel nearby that looks like it.

The entry point in pyproject.toml makes it known by name: ``stereokit.match(..., scale=0.5, refiner="guided")``.
"""

from dataclasses import dataclass

import numpy as np

from stereokit import Disparity, OptionError


@dataclass(frozen=True)
class Guided:
    """Of the 3x3 half-size pixels around, the nearest in grey; each step away counts as `pull` grey levels."""

    pull: float = 8.0  # fields are the options: stereokit.match(..., refiner="guided", pull=4)

    def __post_init__(self):
        if not self.pull >= 0:
            raise OptionError(f"pull must be at least 0 grey levels, got {self.pull}")

    def __call__(self, coarse, left, *, threads=1):
        """Return the map at the size of `left`."""
        (rows, columns), (height, width) = left.shape, coarse.disparity.shape
        y, x = np.indices(left.shape) // 2  # the half-size pixel that covers each pixel
        even = np.pad(left, ((0, rows % 2), (0, columns % 2)), mode="edge")  # sizes are rounded up
        gray = even.reshape(height, 2, width, 2).mean(axis=(1, 3), dtype=np.float32)
        full, least = np.full(left.shape, np.nan, np.float32), np.inf
        for dy, dx in np.ndindex(3, 3):
            near = np.clip(y + dy - 1, 0, height - 1), np.clip(x + dx - 1, 0, width - 1)
            distance = np.abs(gray[near] - left) + self.pull * (abs(dy - 1) + abs(dx - 1))
            better = (distance < least) & np.isfinite(coarse.disparity[near])
            full[better] = 2 * coarse.disparity[near][better]  # half-size pixels to full-size ones
            least = np.where(better, distance, least)
        full[np.isnan(coarse.disparity)[y, x]] = np.nan  # gaps stay gaps
        valid = coarse.valid[y, x] & np.isfinite(full)
        confidence = None if coarse.confidence is None else coarse.confidence[y, x] * valid
        return Disparity(full, valid, confidence)
