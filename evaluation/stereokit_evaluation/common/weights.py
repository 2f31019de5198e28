"""Which refiners of a command get its ``--weights``: those of half-size maps; if there are none, the general one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stereokit.errors import OptionError
from stereokit.methods import find_refiner

__all__ = ["check_weights", "is_of_half_size", "weights_option"]


def is_of_half_size(refiner: str) -> bool:
    """Return whether a refiner is a network of half-size maps alone."""
    return bool(getattr(find_refiner(refiner)[1], "of_half_size", False))


def _receivers(refiners: Sequence[str]) -> set[str]:
    first = {name for name in refiners if is_of_half_size(name)}
    return first or {name for name in refiners if "weights" in find_refiner(name)[2]}


def weights_option(refiner: str | None, weights: str | None, refiners: Sequence[str] = ()) -> dict[str, Any]:
    """Return `weights` as an option of `stereokit.Matcher`, if `refiner` gets it beside the other `refiners`."""
    if weights is None or refiner is None or refiner not in _receivers([refiner, *refiners]):
        return {}
    return {"weights": weights}


def check_weights(refiners: Sequence[str], weights: str | None) -> None:
    """Raise OptionError if weights are given for refiners of which none takes them."""
    if weights is not None and not _receivers(refiners):
        names = ", ".join(refiners) or "none"
        raise OptionError(f"weights must come with a refiner that takes some, got {weights!r} with refiner {names}")
