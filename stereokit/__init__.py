"""Classical stereo matching in plain Python: Census and ZNCC costs, SGM and domain-transform aggregation.

>>> import stereokit
>>> disparity = stereokit.match(left, right)  # doctest: +SKIP
"""

from stereokit.calibration import Calibration
from stereokit.costs import Census, RowCost, Zncc
from stereokit.errors import (
    DeviceError,
    FileError,
    InputError,
    OptionError,
    StereokitError,
    StereokitWarning,
    UnknownNameError,
)
from stereokit.io import read_disparity, read_image, write_disparity
from stereokit.large import LargeResult, match_large
from stereokit.matching import METHODS, Matcher, match, warmup
from stereokit.notices import PairWarning
from stereokit.pairs import Fault, PairReport, align_rows, check_pair
from stereokit.registry import AGGREGATIONS, COSTS, REFINERS
from stereokit.result import Disparity
from stereokit.rig import StereoRig, read_rig
from stereokit.selection import select
from stereokit.stages import aggregate, cost_volume

__all__ = [
    "AGGREGATIONS",
    "COSTS",
    "METHODS",
    "REFINERS",
    "Calibration",
    "Census",
    "DeviceError",
    "Disparity",
    "Fault",
    "FileError",
    "InputError",
    "LargeResult",
    "Matcher",
    "OptionError",
    "PairReport",
    "PairWarning",
    "RowCost",
    "StereoRig",
    "StereokitError",
    "StereokitWarning",
    "UnknownNameError",
    "Zncc",
    "__version__",
    "aggregate",
    "align_rows",
    "check_pair",
    "cost_volume",
    "match",
    "match_large",
    "read_disparity",
    "read_image",
    "read_rig",
    "select",
    "warmup",
    "write_disparity",
]

__version__ = "0.1.0"
