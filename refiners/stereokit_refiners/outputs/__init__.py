"""Output rules of networks: from a head to the full-size map."""

from stereokit_refiners.outputs.contract import Output
from stereokit_refiners.outputs.direct import Direct
from stereokit_refiners.outputs.mixture import Mixture
from stereokit_refiners.outputs.residual import Residual

__all__ = ["Direct", "Mixture", "Output", "Residual"]
