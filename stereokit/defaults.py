"""What the methods are called and how they are set when nobody says otherwise."""

from __future__ import annotations

from typing import Any

__all__ = ["DEFAULTS", "METHODS"]

METHODS = {"S1": "census+dt", "S2": "census+sgm", "S3": "zncc+dt", "S4": "zncc+sgm"}
"""The four matchers of the StereoVAE paper."""

DEFAULTS: dict[str, dict[str, Any]] = {
    "": {
        "confidence": False,
        "fill": "nearest",
        "median": 5,
        "outside": 0.5,
        "right": False,
        "smooth": 0.6,
        "smp": True,
        "speckle": 0.0002,
        "subpixel": True,
        "uniqueness": 0,
    },
    "census+dt": {"smooth": 0.7, "speckle": 0.0003, "window": "5x5"},
    "census+sgm": {"p1": 15, "p2": 85, "window": "5x5"},
    "zncc+dt": {"smooth": 0.7, "speckle": 0.0003, "window": 3},
    "zncc+sgm": {"p1": 20 / 31, "p2": 120 / 31},
}
"""Options by method; those under the empty name hold for all methods that do not say otherwise."""
