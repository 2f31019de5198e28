"""Selection: from the aggregated costs of a pixel to its disparity."""

from stereokit.selection.wta import select

__all__ = ["select"]
