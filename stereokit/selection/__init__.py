"""Selection: from the aggregated costs of a pixel to its disparity."""

from stereokit.selection.wta import Wta, select

__all__ = ["Wta", "select"]
