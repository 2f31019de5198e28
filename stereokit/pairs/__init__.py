"""Pairs of images before they are matched: whether they are rectified, left and right, and in range."""

from stereokit.pairs.align import align_rows
from stereokit.pairs.check import KINDS, Fault, PairReport, check_pair

__all__ = ["KINDS", "Fault", "PairReport", "align_rows", "check_pair"]
