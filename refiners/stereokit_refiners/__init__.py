"""Refiners: from a half-size disparity map and the left image to a full-size map.

Importing this package imports neither torch nor any runtime: they are loaded when a refiner needs them.
"""

from stereokit_refiners.auto import AutoRefiner
from stereokit_refiners.contract import Refiner
from stereokit_refiners.general import EvidenceRefiner
from stereokit_refiners.learned import CnnRefiner, LearnedRefiner, PyramidRefiner, StereoVaeRefiner
from stereokit_refiners.linear import Linear
from stereokit_refiners.weights import WeightFile

__all__ = [
    "AutoRefiner",
    "CnnRefiner",
    "EvidenceRefiner",
    "LearnedRefiner",
    "Linear",
    "PyramidRefiner",
    "Refiner",
    "StereoVaeRefiner",
    "WeightFile",
]
