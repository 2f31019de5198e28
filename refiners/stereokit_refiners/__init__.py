"""Refiners: from a half-size disparity map and the left image to a full-size map."""

from stereokit_refiners.linear import Linear
from stereokit_refiners.refiner import Refiner

__all__ = ["Linear", "Refiner"]
