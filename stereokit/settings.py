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
from stereokit.kernels.simd import LANES
from stereokit.methods import check_levels, current_names, find_refiner, option_names, parse_method
from stereokit.options import opencv_hint
from stereokit.postprocess.chain import PostProcessing
from stereokit.postprocess.fill import FILLS
from stereokit.registry import AGGREGATIONS, COSTS
from stereokit.result import Disparity
from stereokit.search import SEARCHED_IN_FULL, SEARCHES

__all__ = ["Detail", "MatchSettings"]

_PIPELINE = (
    "border_cost",
    "confidence",
    "fill",
    "median",
    "nodata",
    "right",
    "search",
    "smooth",
    "smp",
    "speckle",
    "subpixel",
    "uniqueness",
)


class Detail(IntEnum):
    """The outputs of the selection for a pixel; each level includes those below it."""

    DISPARITY = 0
    CONFIDENCE = 1
    CANDIDATES = 2


@dataclass(frozen=True)
class MatchSettings:
    """Everything a disparity map depends on, except the images.

    Attributes
    ----------
    method : str
        ``"cost+aggregation"``.
    levels : Levels
        Disparities that are tried, full-size pixels.
    scale : float
        1, 0.5 or 0.25: the size of the matching.
    cost : Cost
    aggregation : Aggregation
    refiner : callable or None
        The function that brings the map to full size, or improves it there.
    refiner_name : str or None
        Its name, or the path of its weights.
    smooth : float
        Sigma of a Gaussian on both images, pixels; 0 for none.
    nodata : float or None
        Value of pixels without evidence.
    border_cost : float or None
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
        The result includes the confidence.
    right : bool
        The result includes the right view's map.
    search : {"auto", "full", "coarse-to-fine"}
        Which levels a pixel tries: all, or `LANES` around the map of half the size (`stereokit.search`). "auto" goes
        from coarse to fine at full size where there are more than `SEARCHED_IN_FULL` levels (with a refiner, as many),
        the method can, and its costs are cheap: then it is at least as accurate on all data sets.

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
    border_cost: float | None
    subpixel: bool
    uniqueness: float
    smp: bool
    speckle: float
    fill: str | None
    median: int
    confidence: bool
    right: bool
    search: str

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
        if self.border_cost is not None:
            put("border_cost", check_number("border_cost", self.border_cost, 0, 1))
        for name, high in (("smooth", 10), ("uniqueness", 100), ("speckle", 1)):
            put(name, check_number(name, getattr(self, name), 0, high))
        for name in ("smp", "subpixel", "confidence", "right"):
            put(name, check_flag(name, getattr(self, name)))
        if not isinstance(self.search, str) or self.search not in SEARCHES:
            raise UnknownNameError(did_you_mean("search", self.search, SEARCHES))
        if self.search == "coarse-to-fine" and not self._can_narrow:
            raise OptionError(f"search must be 'full' or 'auto' with method {self.method!r}, got 'coarse-to-fine'")

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
        method, options = parse_method(method), current_names(options)
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
            if hasattr(refine, "check_scale"):
                refine.check_scale(scale)
        cost_name, aggregation_name = method.split("+")
        make_cost, make_aggregation = COSTS.get(cost_name), AGGREGATIONS.get(aggregation_name)
        cost_names, aggregation_names = option_names(make_cost), option_names(make_aggregation)
        if (hint := opencv_hint(options)) is not None:
            raise OptionError(hint)
        check_names("option", options, sorted({*_PIPELINE, *cost_names, *aggregation_names, *refiner_options}))
        values = {**defaults_of(method, half=scale != 1), **options}
        cost = make_cost(**{k: values[k] for k in cost_names if k in values})
        aggregation_options = {k: values[k] for k in aggregation_names if k in values}
        aggregation = make_aggregation(**_fitting(make_aggregation, cost, aggregation_options, options))
        if hasattr(aggregation, "check_cost"):
            aggregation.check_cost(cost)
        return cls(
            method=method, levels=levels, scale=float(scale), cost=cost, aggregation=aggregation, refiner=refine,
            refiner_name=refiner_name, **{name: values[name] for name in _PIPELINE},
        )  # fmt: skip

    @property
    def matched_levels(self) -> Levels:
        """The levels at the size of the matching."""
        step = self.step
        low = self.levels.minimum // step
        high = max(-(-(self.levels.minimum + self.levels.count) // step), low + 1)
        return Levels(low, high - low)

    @property
    def _can_narrow(self) -> bool:
        # Said by the class itself: one that inherits may have rows of its own, which know of no starts.
        return all(vars(type(stage)).get("narrow", False) for stage in (self.cost, self.aggregation))

    @property
    def coarse_to_fine(self) -> bool:
        """Whether a pixel tries only levels around the map of half the size."""
        if self.search == "auto":
            # Costs are computed by both sweeps of a narrow search. Maps of less than the full size gain nothing, and 64
            # levels gain no time: there it is for those who ask for accuracy, by a refiner at full size.
            gains = self.scale == 1 and not self.cost.costly_to_recompute
            in_full = SEARCHED_IN_FULL if self.refiner is None else SEARCHED_IN_FULL - 1
            return self._can_narrow and gains and self.levels.count > in_full
        return self.search == "coarse-to-fine" and self.matched_levels.count >= LANES

    @property
    def refines_search(self) -> bool:
        """Whether the refiner improves the half-size map that says where to search: one that takes any size can."""
        takes_any = all(getattr(self.refiner, name, False) for name in ("any_scale", "needs_right"))
        return self.scale == 1 and self.coarse_to_fine and takes_any

    @property
    def searched(self) -> int | None:
        """Levels that a pixel tries at most; None for all."""
        return LANES if self.coarse_to_fine else None

    @property
    def step(self) -> int:
        """Full-size pixels along a pixel of the matched size."""
        return round(1 / self.scale)

    @property
    def reach(self) -> tuple[int, int] | None:
        """How far a match looks around a pixel, across and down, full-size pixels; None where the cost does not say."""
        window = getattr(self.cost, "reach", None)
        if window is None:
            return None
        kernel = (round(8 * self.smooth + 1) | 1) // 2 if self.smooth > 0 else 0  # of OpenCV, in 16 bits
        across, down = (self.step * (side + kernel) + self.step - 1 for side in window)
        return across, down

    @property
    def bounds(self) -> tuple[float, float] | None:
        """The smallest and the largest disparity that a refined map is held to; None where it lies within by itself.

        A refiner that looks at the right image measures for itself, and may leave the range. Other maps may only lie
        below, where the levels of a smaller size begin below.
        """
        low = self.levels.minimum
        if getattr(self.refiner, "needs_right", False):
            return float(low), float(low + self.levels.count - 1)
        return (float(low), np.inf) if self.step * self.matched_levels.minimum < low else None

    @property
    def detail(self) -> Detail:
        """The outputs of the selection that the result and the refiner need."""
        if getattr(self.refiner, "needs_candidates", False):
            return Detail.CANDIDATES
        needed = self.confidence or bool(getattr(self.refiner, "needs_confidence", False))
        return Detail.CONFIDENCE if needed else Detail.DISPARITY

    def post_processing(self, pixels: int) -> PostProcessing:
        """Return the post-processing of a selected map of so many pixels."""
        return PostProcessing(self.smp, int(self.speckle * pixels), self.fill, self.median, self.matched_levels.minimum)

    def replaced(self, **changes: Any) -> MatchSettings:
        """Return settings that differ in some values."""
        return replace(self, **current_names(changes))

    def identity(self) -> dict[str, Any]:
        """Return all settings as plain values, fit for JSON; refiners as the fingerprint of their weights."""
        content: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "levels":
                content["min_disparity"], content["max_disparity"] = value.minimum, value.minimum + value.count
            elif field.name == "refiner":
                content["weights"] = _fingerprint(value)
            elif field.name == "refiner_name":
                content["refiner"] = value
            elif field.name == "search":
                content["search"] = "coarse-to-fine" if self.coarse_to_fine else "full"
            else:
                content[field.name] = value if isinstance(value, (int, float, str, type(None))) else repr(value)
        return content


def _fitting(factory: Any, cost: Cost, values: dict[str, Any], user_options: dict[str, Any]) -> dict[str, Any]:
    """Return an aggregation's options; defaults are reduced to fit into 8 bits beside the cost's range."""
    fit = getattr(factory, "fitting", None)
    if fit is None:
        return values
    defaults = {name: value for name, value in values.items() if name not in user_options}
    return {**values, **fit(cost, defaults)}


def _fingerprint(refiner: Any) -> str | None:
    fingerprint = getattr(refiner, "fingerprint", None)
    fingerprint = fingerprint() if callable(fingerprint) else fingerprint
    return fingerprint if isinstance(fingerprint, str) else None
