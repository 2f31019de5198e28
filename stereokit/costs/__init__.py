"""Matching costs: each produces rows of ``uint8`` costs, ``(W, D)``, for one row of the image."""

from stereokit.costs.census import Census
from stereokit.costs.custom import RowCost
from stereokit.costs.zncc import Zncc

__all__ = ["Census", "RowCost", "Zncc"]
