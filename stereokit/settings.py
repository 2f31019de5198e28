"""The options of a match, parsed and checked once; every pipeline takes them as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np

from stereokit.aggregation.contract import Aggregation
from stereokit.costs.rows import Cost, Levels
from stereokit.defaults import defaults_of
from stereokit.errors import OptionError, UnknownNameError, did_you_mean, shown
from stereokit.images.check import check_flag, check_integer, check_names, check_nodata, check_number
from stereokit.methods import check_levels, find_refiner, option_names, parse_method
from stereokit.postprocess.chain import PostProcessing
from stereokit.postprocess.fill import FILLS
from stereokit.registry import AGGREGATIONS, COSTS
from stereokit.result import Disparity

__all__ = ["Detail", "MatchSettings"]

_PIPELINE = (
    "confidence",
    "fill",
    "median",
    "nodata",
    "outside",
    "right",
    "smooth",
    "smp",
    "speckle",
    "subpixel",
    "uniqueness",
)


class Detail(IntEnum):
    """What the selection tells of a pixel; each level brings what those below it bring."""

    DISPARITY = 0
    CONFIDENCE = 1
    CANDIDATES = 2


@dataclass(frozen=True)
class MatchSettings:
    """All that a disparity map depends on, beside the images.

    Attributes
    ----------
    method : str
        ``"cost+aggregation"``.
    levels : Levels
        Disparities that are tried, full-size pixels.
    scale : float
        1, 0.5 or 0.25: the size at which is matched.
    cost : Cost
    aggregation : Aggregation
    refiner : callable or None
        What brings the map to full size, or makes it better there.
    refiner_name : str or None
        Its name, or the path of its weights.
    smooth : float
        Sigma of a Gaussian on both images, pixels; 0 for none.
    nodata : float or None
        Value of pixels that hold nothing.
    outside : float or None
        Cost of matches outside the right image, as a share of the cost's range; None takes the border's pixel.
    subpixel : bool
        Interpolate between levels.
    uniqueness : float
        Percent by which the best rival must cost more.
    smp : bool
        Single matching phase.
    speckle : float
        Largest region that is removed, as a share of the image.
    fill : {"background", "nearest"} or None
        Rule of filling; ``"none"`` is None.
    median : {0, 3, 5}
        Side of the window.
    confidence : bool
        The result brings the confidence.
    right : bool
        The result brings the right view's map.

    Raises
    ------
    OptionError
        If a value breaks its rule.
    """

    method: str
    levels: Levels
    scale: float
    cost: Cost
    aggregation: Aggregation
    refiner: Callable[..., Disparity] | None
    refiner_name: str | None
    smooth: float
    nodata: float | None
    outside: float | None
    subpixel: bool
    uniqueness: float
    smp: bool
    speckle: float
    fill: str | None
    median: int
    confidence: bool
    right: bool

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        if isinstance(self.fill, str) and self.fill == "none":
            put("fill", None)
        if self.fill is not None and (not isinstance(self.fill, str) or self.fill not in FILLS):
            raise UnknownNameError(did_you_mean("fill", self.fill, (*FILLS, "none")))
        put("median", check_integer("median", self.median))
        if self.median not in (0, 3, 5):
            raise OptionError(f"median must be 0, 3 or 5, got {self.median}")
        put("nodata", check_nodata(self.nodata))
        if self.outside is not None:
            put("outside", check_number("outside", self.outside, 0, 1))
        for name, high in (("smooth", 10), ("uniqueness", 100), ("speckle", 1)):
            put(name, check_number(name, getattr(self, name), 0, high))
        for name in ("smp", "subpixel", "confidence", "right"):
            put(name, check_flag(name, getattr(self, name)))

    @classmethod
    def parse(
        cls, method: str, *, max_disparity: Any, min_disparity: Any, scale: Any, refiner: Any, options: dict[str, Any]
    ) -> MatchSettings:
        """Return the settings for the arguments of `stereokit.Matcher`.

        Raises
        ------
        OptionError
            If an option does not exist or breaks its rule.
        """
        method = parse_method(method)
        levels = check_levels(min_disparity, max_disparity)
        if (
            isinstance(scale, bool)
            or not isinstance(scale, (int, float, np.integer, np.floating))
            or scale not in (1, 0.5, 0.25)
        ):
            raise OptionError(f"scale must be 1, 0.5 or 0.25, got {shown(scale)}")
        refine: Callable[..., Disparity] | None = None
        refiner_name: str | None = None
        refiner_options: list[str] = []
        if scale != 1 or refiner is not None:
            refiner_name, factory, refiner_options = find_refiner("linear" if refiner is None else refiner)
            refine = factory(**{k: options[k] for k in refiner_options if k in options})
            options = {k: v for k, v in options.items() if k not in refiner_options}
            if scale != 0.5 and not getattr(refine, "any_scale", False):
                raise OptionError(f"refiner {refiner_name!r} needs scale=0.5, got scale={scale:g}")
        cost_name, aggregation_name = method.split("+")
        make_cost, make_aggregation = COSTS.get(cost_name), AGGREGATIONS.get(aggregation_name)
        of_cost, of_aggregation = option_names(make_cost), option_names(make_aggregation)
        check_names("option", options, sorted({*_PIPELINE, *of_cost, *of_aggregation, *refiner_options}))
        merged = {**defaults_of(method, half=scale != 1), **options}
        cost = make_cost(**{k: merged[k] for k in of_cost if k in merged})
        chosen = {k: merged[k] for k in of_aggregation if k in merged}
        aggregation = make_aggregation(**_fitting(make_aggregation, cost, chosen, options))
        if hasattr(aggregation, "check_cost"):
            aggregation.check_cost(cost)
        return cls(
            method=method, levels=levels, scale=float(scale), cost=cost, aggregation=aggregation, refiner=refine,
            refiner_name=refiner_name, **{name: merged[name] for name in _PIPELINE},
        )  # fmt: skip

    @property
    def matched_levels(self) -> Levels:
        """The levels of the size at which is matched."""
        step = self.step
        low = self.levels.minimum // step
        high = max(-(-(self.levels.minimum + self.levels.count) // step), low + 1)
        return Levels(low, high - low)

    @property
    def step(self) -> int:
        """Full-size pixels along a pixel of the size at which is matched."""
        return round(1 / self.scale)

    @property
    def floor(self) -> int | None:
        """The minimum, where the levels of a smaller size begin below it: refined maps are raised to it."""
        below = self.step * self.matched_levels.minimum < self.levels.minimum
        return self.levels.minimum if below else None

    @property
    def detail(self) -> Detail:
        """What the selection must tell, for the result and for the refiner."""
        if getattr(self.refiner, "needs_candidates", False):
            return Detail.CANDIDATES
        needed = self.confidence or bool(getattr(self.refiner, "needs_confidence", False))
        return Detail.CONFIDENCE if needed else Detail.DISPARITY

    def post_processing(self, pixels: int) -> PostProcessing:
        """Return what is done to a selected map of so many pixels."""
        return PostProcessing(self.smp, int(self.speckle * pixels), self.fill, self.median, self.matched_levels.minimum)

    def replaced(self, **changes: Any) -> MatchSettings:
        """Return settings that differ in some values."""
        return replace(self, **changes)

    def identity(self) -> dict[str, Any]:
        """Return what a map depends on as plain values, fit for JSON; refiners as the fingerprint of their weights."""
        plain: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "levels":
                plain["min_disparity"], plain["max_disparity"] = value.minimum, value.minimum + value.count
            elif field.name == "refiner":
                plain["weights"] = _fingerprint(value)
            elif field.name == "refiner_name":
                plain["refiner"] = value
            else:
                plain[field.name] = value if isinstance(value, (int, float, str, type(None))) else repr(value)
        return plain


def _fitting(factory: Any, cost: Cost, chosen: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """Return an aggregation's options; defaults give way to what the cost leaves of 8 bits."""
    fit = getattr(factory, "fitting", None)
    if fit is None:
        return chosen
    defaults = {name: value for name, value in chosen.items() if name not in given}
    return {**chosen, **fit(cost, defaults)}


def _fingerprint(refiner: Any) -> str | None:
    found = getattr(refiner, "fingerprint", None)
    found = found() if callable(found) else found
    return found if isinstance(found, str) else None
