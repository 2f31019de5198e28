"""D1 by kind of pixel: object, occlusion, disparity, texture, and the regions that the StereoVAE paper calls hard.

* ``seen``, ``occluded``: both cameras see it, or only the left one (pairs whose truth tells).
* ``background``, ``object``: by the object map.
* ``above 32 px`` to ``below 8 px``: by the true disparity. With KITTI's cameras the borders are at 12, 24 and 48 m.
* ``flat``, ``weak``, ``textured``: the standard deviation of the left grey image in 9x9 pixels is below 2 of 256 grey
  levels, below 8, or larger.
* ``textureless``, ``specular``, ``brightness``: the hard regions of the paper (its figure 6), known exactly on the
  synthetic street scenes: plain surfaces, highlights, and brightness that one camera sees differently; ``ordinary``:
  none of them. There, these four count the pixels that both cameras see.

Counts are pooled over pairs, over filled maps, by the rule of KITTI's development kit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.images.intensity import display_8bit
from stereokit.notices import collecting
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.kitti import Tally, fill_background, tally
from stereokit_evaluation.study.configurations import Configuration

__all__ = ["REGIONS", "RegionRow", "masks", "measure_regions"]

REGIONS = (
    "seen", "occluded", "background", "object", "above 32 px", "16 to 32 px", "8 to 16 px", "below 8 px", "flat",
    "weak", "textured", "textureless", "specular", "brightness", "ordinary",
)  # fmt: skip
"""The regions, in the order of the tables."""

_DISPARITIES = (8.0, 16.0, 32.0)  # pixels
_WINDOW = 9
_DEVIATIONS = (2.0, 8.0)  # grey levels of 256
_HARD = ("textureless", "specular", "brightness")

Mask = NDArray[np.bool_]
Masks = Callable[[Frame], Mapping[str, Mask]]


@dataclass
class RegionRow:
    """The counts of one configuration by region.

    Attributes
    ----------
    configuration : Configuration
    tallies : dict of str to Tally
        By region; regions without a pixel are left out.
    missing : str or None
        The reason why there are none.
    """

    configuration: Configuration
    tallies: dict[str, Tally] = field(default_factory=dict)
    missing: str | None = None

    def d1(self, region: str) -> float | None:
        """Return the D1 error of a region, percent, None where it has no pixel."""
        return self.tallies[region].d1() if region in self.tallies else None


def masks(
    left: NDArray[Any],
    *,
    noc: NDArray[np.float32] | None,
    occ: NDArray[np.float32] | None,
    objects: NDArray[Any] | None = None,
    hard: Mapping[str, Mask] | None = None,
) -> dict[str, Mask]:
    """Return the pixels of each region that have a true disparity.

    Parameters
    ----------
    left : (H, W) or (H, W, 3) array
        The left image.
    noc, occ : (H, W) float32 or None
        True disparity of what both cameras see, and of all pixels; NaN unknown. One of them must be there.
    objects : (H, W) integers, optional
        0 is background.
    hard : mapping of str to (H, W) bool, optional
        The paper's hard regions, if they are known.
    """
    truth = noc if occ is None else occ
    assert truth is not None
    known = np.isfinite(truth)
    regions: dict[str, Mask] = {}
    seen = known if noc is None or occ is None else known & np.isfinite(noc)
    if noc is not None and occ is not None:
        regions |= {"seen": seen, "occluded": known & ~seen}
    if objects is not None:
        regions |= {"background": known & (objects == 0), "object": known & (objects != 0)}
    low, middle, high = _DISPARITIES
    with np.errstate(invalid="ignore"):
        regions |= {
            "above 32 px": known & (truth > high),
            "16 to 32 px": known & (truth > middle) & (truth <= high),
            "8 to 16 px": known & (truth > low) & (truth <= middle),
            "below 8 px": known & (truth <= low),
        }
    deviation = _deviation(left)
    weak, textured = _DEVIATIONS
    regions |= {
        "flat": known & (deviation < weak),
        "weak": known & (deviation >= weak) & (deviation < textured),
        "textured": known & (deviation >= textured),
    }
    if hard is not None:
        regions |= {name: seen & hard[name] for name in _HARD}
        regions["ordinary"] = seen & ~np.any([hard[name] for name in _HARD], axis=0)
    return regions


def measure_regions(
    frames: Sequence[Frame],
    configurations: Sequence[Configuration],
    hard: Masks | None = None,
    *,
    step: Callable[[str], object] = lambda text: None,
) -> list[RegionRow]:
    """Return the counts of all configurations, pooled over frames.

    Parameters
    ----------
    frames : sequence of Frame
        With truth; those without are left out.
    configurations : sequence of Configuration
        Those without a matcher are reported as missing.
    hard : callable, optional
        Returns the paper's hard regions of a frame.
    step : callable
        Called with a few words after each map.
    """
    rows = [RegionRow(configuration, missing=configuration.missing) for configuration in configurations]
    for frame in frames:
        noc, occ = frame.load_noc(), frame.load_occ()
        truth = noc if occ is None else occ
        if truth is None:
            continue
        left, right = frame.load_pair(gray=True)
        regions = masks(
            left, noc=noc, occ=occ, objects=frame.load_objects(), hard=None if hard is None else hard(frame)
        )
        for row in rows:
            step(f"{frame.name}: {row.configuration.name}")
            if row.configuration.matcher is None:
                continue
            with collecting():
                filled = fill_background(row.configuration.matcher(left, right).disparity)
            error = np.abs(np.where(np.isnan(filled), np.float32(-1), filled) - truth)
            for name, mask in regions.items():
                if mask.any():
                    row.tallies[name] = row.tallies.get(name, Tally()) + tally(error[mask], truth[mask])
    return rows


def _deviation(left: NDArray[Any]) -> NDArray[np.float32]:
    """Return the standard deviation around each pixel, grey levels of 256."""
    image = display_8bit(left)
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    values = gray.astype(np.float64)
    size = (_WINDOW, _WINDOW)
    mean, square = cv2.blur(values, size), cv2.blur(values * values, size)
    return np.sqrt(np.maximum(square - mean * mean, 0)).astype(np.float32)
