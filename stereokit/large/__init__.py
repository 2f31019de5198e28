"""Matching of images that are too large for memory."""

from stereokit.large.matching import OVERLAP, LargeResult, match_large

__all__ = ["OVERLAP", "LargeResult", "match_large"]
