"""Post-processing of disparity maps: consistency, filling, median."""

from stereokit.postprocess.fill import fill
from stereokit.postprocess.median import median
from stereokit.postprocess.smp import single_matching_phase
from stereokit.postprocess.speckle import remove_speckles

__all__ = ["fill", "median", "remove_speckles", "single_matching_phase"]
