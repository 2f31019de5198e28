"""Calibration files: what each format says of two cameras, in one form, whoever wrote it.

`read_content` tells the format by what a file holds, not by its name, and returns a `Content`; what that means for a
rectified pair or for raw cameras is for those who ask.
"""

from stereokit.io.calibrations.content import Content, Lens, check_projections
from stereokit.io.calibrations.dispatch import KNOWN, read_content

__all__ = ["KNOWN", "Content", "Lens", "check_projections", "read_content"]
