"""Which refiners of a command get its ``--weights``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stereokit.errors import OptionError
from stereokit.methods import find_refiner

__all__ = ["check_weights", "needs_weights", "weights_option"]


def needs_weights(refiner: str) -> bool:
    """Return whether a refiner comes without weights."""
    return bool(getattr(find_refiner(refiner)[1], "needs_weights", False))


def weights_option(refiner: str | None, weights: str | None) -> dict[str, Any]:
    """Return `weights` as an option of `stereokit.Matcher`, if the refiner comes without; else nothing."""
    return {} if weights is None or refiner is None or not needs_weights(refiner) else {"weights": weights}


def check_weights(refiners: Sequence[str], weights: str | None) -> None:
    """Raise OptionError if weights are given for refiners of which none takes them."""
    if weights is not None and not any(needs_weights(name) for name in refiners):
        names = ", ".join(refiners) or "none"
        raise OptionError(f"weights must come with a refiner that needs some, got {weights!r} with refiner {names}")
