"""Methods by name: ``"zncc+sgm"`` or S4 -> a cost and an aggregation with their options.

The built-in stages register themselves when this module imports them; others come through entry points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

from stereokit import costs as _costs  # noqa: F401  (registers the built-in costs)
from stereokit.aggregation import dt as _dt  # noqa: F401
from stereokit.aggregation import sgm as _sgm  # noqa: F401
from stereokit.costs.rows import Levels
from stereokit.defaults import METHODS
from stereokit.errors import OptionError, UnknownNameError, did_you_mean, shown
from stereokit.images.check import MAX_DISPARITY, check_integer, check_names
from stereokit.registry import AGGREGATIONS, COSTS, REFINERS

__all__ = [
    "build_aggregation",
    "build_cost",
    "check_levels",
    "current_names",
    "find_refiner",
    "option_names",
    "parse_method",
]

_MAX_LEVELS = 2048
_OLD_NAMES = {"outside": "border_cost"}


def parse_method(method: str) -> str:
    """Return the canonical name, ``"cost+aggregation"``, of a method in any case, or of S1 to S4.

    Raises
    ------
    UnknownNameError
        If there is no such method, cost or aggregation.
    """
    if not isinstance(method, str):
        raise OptionError(f"method must be a name such as 'zncc+sgm' or 'S4', got {shown(method)}")
    text = method.strip()
    text = METHODS.get(text.upper(), text.lower())
    parts = [part.strip() for part in text.split("+")]
    if len(parts) != 2:
        known = [*METHODS, *(f"{c}+{a}" for c in COSTS.names() for a in AGGREGATIONS.names())]
        raise UnknownNameError(did_you_mean("method", method, known))
    COSTS.get(parts[0])
    AGGREGATIONS.get(parts[1])
    return "+".join(parts)


def current_names(options: dict[str, Any]) -> dict[str, Any]:
    """Return options under their present names; raise OptionError for one that has both its old and its new name."""
    for old, new in _OLD_NAMES.items():
        if old in options and new in options:
            raise OptionError(f"{old} is the old name of {new}, got both")
    return {_OLD_NAMES.get(name, name): value for name, value in options.items()}


def check_levels(min_disparity: Any, max_disparity: Any) -> Levels:
    """Return the levels ``min_disparity <= d < max_disparity``; raise OptionError if there are none or too many."""
    low = check_integer("min_disparity", min_disparity, -MAX_DISPARITY, MAX_DISPARITY)
    high = check_integer("max_disparity", max_disparity, low + 1)
    if high - low > _MAX_LEVELS:
        raise OptionError(f"max_disparity - min_disparity must be at most {_MAX_LEVELS}, got {shown(high - low)}")
    return Levels(low, high - low)


def build_cost(name: Any, options: dict[str, Any]) -> Any:
    """Return the cost called `name` with `options`; raise OptionError for those that it does not have.

    A cost object in place of a name is returned as it is.
    """
    if hasattr(name, "prepare") and not isinstance(name, type) and not options:
        return name
    return _build("cost", COSTS.get(name), options)


def build_aggregation(name: str, options: dict[str, Any]) -> Any:
    """Return the aggregation called `name` with `options`; raise OptionError for those that it does not have."""
    return _build("aggregation", AGGREGATIONS.get(name), options)


def _build(kind: str, factory: Any, options: dict[str, Any]) -> Any:
    check_names(f"option of this {kind}", options, option_names(factory))
    return factory(**options)


def find_refiner(refiner: Any) -> tuple[str, Callable[..., Any], list[str]]:
    """Return the name of a refiner, its factory, and the names of its options.

    Parameters
    ----------
    refiner : str or callable
        A name, the path of a weight file, or a refiner itself, which has no further options.

    Raises
    ------
    UnknownNameError
        If there is no such refiner.
    OptionError
        If it is neither a name nor callable.
    """
    if isinstance(refiner, str) and refiner.lower().endswith(".safetensors"):
        factory = REFINERS.get("file")
        return refiner, partial(factory, weights=refiner), [n for n in option_names(factory) if n != "weights"]
    if isinstance(refiner, str):
        factory = REFINERS.get(refiner)
        return refiner.lower(), factory, option_names(factory)
    if not callable(refiner):
        raise OptionError(f"refiner must be a name, a weight file or callable, got {shown(refiner)}")
    return type(refiner).__name__.lower(), lambda: refiner, []


def option_names(factory: Any) -> list[str]:
    """Return the names of the options of a stage; a stage that is no dataclass has none."""
    if not (isinstance(factory, type) and is_dataclass(factory)):
        return []
    return [f.name for f in fields(factory) if f.init]
