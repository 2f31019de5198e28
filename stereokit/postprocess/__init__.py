"""Post-processing of disparity maps: consistency, filling, median."""

from stereokit.postprocess.fill import fill
from stereokit.postprocess.median import median
from stereokit.postprocess.smp import single_matching_phase

__all__ = ["fill", "median", "single_matching_phase"]
