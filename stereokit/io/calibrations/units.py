"""Lengths of calibration files in metres, which most formats do not say that they have."""

from __future__ import annotations

from stereokit.errors import OptionError, shown
from stereokit.io.calibrations.content import UNITS, Content
from stereokit.notices import warn

__all__ = ["in_metres"]

_MILLIMETRES_FROM = 10.0
_DOUBTFUL_FROM = 1.5
_SURE_M = 0.001, 100.0
"""Baselines outside of these are warned of, whatever says that they are in metres."""


def in_metres(content: Content, unit: str | None, name: str) -> Content:
    """Return what a file says with all lengths in metres.

    Parameters
    ----------
    content : Content
    unit : str or None
        Of its lengths, one of `UNITS`, whatever the file says. None is what file or format say, or else metres, unless
        the baseline is then 10 or more: those are taken for millimetres.
    name : str
        Of the file, for warnings.

    Warns
    -----
    StereokitWarning
        If the unit had to be guessed from an odd number, or the baseline is under 1 mm or over 100 m.

    Raises
    ------
    OptionError
        If `unit` is none.
    """
    if unit is not None and unit not in UNITS:
        raise OptionError(f"unit must be one of {', '.join(UNITS)}, got {shown(unit)}")
    baseline = content.baseline or 0.0
    source = unit or content.unit
    way_out = "say so with unit= (stereokit rig --unit)"
    if source is None:
        source = "mm" if baseline >= _MILLIMETRES_FROM else "m"
        if source == "mm":
            warn(
                f"{name!r} has a baseline of {baseline:g}, which is taken for millimetres "
                f"({baseline / 1000:g} m); if it is in another unit, {way_out}"
            )
        elif baseline >= _DOUBTFUL_FROM:
            warn(
                f"{name!r} has a baseline of {baseline:g}, taken for metres; "
                f"if the board's squares were in another unit, or in squares, {way_out}"
            )
    length_m = baseline * UNITS[source]
    if length_m and not _SURE_M[0] <= length_m <= _SURE_M[1]:
        warn(f"{name!r} has a baseline of {length_m:g} m: is it in the unit that it should be in?")
    return content.scaled(UNITS[source])
