"""A look at a pair before it is matched: whether it is rectified, left and right, and within the searched range.

Features that both views show tell (`stereokit.pairs.features`): in a rectified pair they lie on the same rows, and the
right view has them further to the left, by the disparities. What else can be told by the pixels alone, such as blank
and saturated shares, is told beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError
from stereokit.images.check import check_flag, check_integer, check_nodata
from stereokit.images.gray import GrayPair, gray_pair
from stereokit.pairs.features import Matches, Points, match_points, points_of, stretched
from stereokit.pairs.rows import FEWEST, Rows, fit_rows

__all__ = ["KINDS", "Fault", "PairReport", "check_gray", "check_pair", "same_pixels", "unusable_fault"]

KINDS = {
    "same": "one view was given twice",
    "exchanged": "left and right are exchanged",
    "mirrored": "one view is mirrored",
    "rotated": "one view is turned",
    "rows": "the rows of the views do not meet",
    "range": "disparities lie outside of the range",
    "unrelated": "the views do not show the same scene",
    "density": "few pixels could be measured",
    "unusable": "no pixel may be matched",
    "sparse": "hardly anything could be measured, although the pair looks right",
    "exposure": "the views differ in brightness",
    "sharpness": "the views differ in sharpness",
    "blank": "much of the left view has no texture",
    "saturated": "much of the left view is white",
}
"""What can be wrong with a pair, the worst first; up to "unusable" the map suffers. "density" and "sparse" are what
matchers say, who have a map."""

SERIOUS = frozenset(list(KINDS)[: list(KINDS).index("unusable") + 1])

_SIDE = 1000  # pixels of the longer side on which features are looked for
_QUICK_SIDE = 640
_TOLERANCE = 1.0  # of rows, pixels of the image that is looked at
_MAJORITY = 0.5  # of the points that agree
_STILL = 0.25  # pixels of disparity that no point of a picture given twice has
_OFFSET, _ROLL, _SCALE = 0.6, 0.15, 0.007  # pixels, degrees, a share: beyond these rows do not meet
_ERRORS = 4.0  # standard errors that are added to those
_TURN, _TURN_SPREAD = 8.0, 12.0  # degrees
_INSIDE, _OUTSIDE = 0.2, 0.8  # shares of the points that lie in the range, and would if the views were exchanged
_CLIPPED, _FEWEST_CLIPPED, _SLACK = 0.03, 6, 1.5  # share, points and pixels beyond an end of the range
_FEW = 0.15  # of the features, that agree where both views are of one scene and neither is mirrored
_LARGE_ROLL = 1.0  # degrees beyond which disparities are not what they will be
_MANY = 150  # features of either view that two views of one scene have many of in common
_FEW_AGREE, _FEW_MATCHES = 0.25, 0.04
_BRIGHTER, _SHARPER, _BLURRED = 1.5, 1.4, 2.5
_BLANK, _WHITE = 0.5, 0.3
_PATCH = 7  # side of the patch whose brightness is compared, pixels


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with a pair.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    message : str
        What was seen and what to do about it, in one line.
    """

    kind: str
    message: str

    @property
    def serious(self) -> bool:
        """Whether maps suffer from it; the other kinds are worth knowing."""
        return self.kind in SERIOUS


@dataclass(frozen=True)
class PairReport:
    """What `check_pair` has seen.

    Attributes
    ----------
    width, height : int
        Of the images, pixels.
    points : int
        Features that both views show.
    agreement : float
        Share of them on whose rows a shift, a roll and a scale agree; 0 where there are too few to tell.
    row_offset : float or None
        How much lower the right view shows what the left view shows, in its middle, pixels.
    roll : float or None
        By how many degrees the right view is turned clockwise.
    scale : float or None
        How many times as high as the left view the right one shows things.
    disparities : (float, float) or None
        First and 99th percentile of the disparities of the points that agree, pixels.
    brightness, sharpness : float
        Of the right view, relative to the left one.
    blank : float
        Share of the left view without any texture within 7x7 pixels.
    saturated : float
        Share of the left view that is as bright as can be.
    faults : tuple of Fault
        What is wrong, the worst first.
    """

    width: int
    height: int
    points: int
    agreement: float
    row_offset: float | None = None
    roll: float | None = None
    scale: float | None = None
    disparities: tuple[float, float] | None = None
    brightness: float = 1.0
    sharpness: float = 1.0
    blank: float = 0.0
    saturated: float = 0.0
    faults: tuple[Fault, ...] = field(default=())

    @property
    def rows_known(self) -> bool:
        """Whether enough points agree to tell how the rows lie."""
        return self.row_offset is not None

    def row_errors(self) -> float:
        """Return the largest row offset within the image, pixels; 0 where rows are not known."""
        if self.row_offset is None or self.roll is None or self.scale is None:
            return 0.0
        slopes = abs(math.tan(math.radians(self.roll))) * self.width + abs(self.scale - 1) * self.height
        return abs(self.row_offset) + slopes / 2


def check_pair(
    left: Any, right: Any, *, max_disparity: int = 128, min_disparity: int = 0, nodata: float | None = None,
    quick: bool = False,
) -> PairReport:  # fmt: skip
    """Look at a pair, and say what is wrong with it.

    Parameters
    ----------
    left, right : (H, W), (H, W, 3) or (H, W, 4), numbers
        The images, as `stereokit.Matcher` takes them.
    max_disparity, min_disparity : int
        The range that will be searched, pixels.
    nodata : float or None
        Value of pixels that hold nothing.
    quick : bool
        Look at images of at most 640 pixels: half the time, and row offsets to a fifth of a pixel.

    Returns
    -------
    PairReport
        Whose `faults` are empty for a good pair.

    Raises
    ------
    InputError, OptionError
        If an image or an option cannot be used.
    """
    low = check_integer("min_disparity", min_disparity)
    high = check_integer("max_disparity", max_disparity)
    if high <= low:
        raise OptionError(f"max_disparity must be above min_disparity={low}, got {high}")
    pair = gray_pair(left, right, check_nodata(nodata))
    return check_gray(pair, low, high, quick=check_flag("quick", quick))


def check_gray(pair: GrayPair, min_disparity: int, max_disparity: int, *, quick: bool = False) -> PairReport:
    """Look at a pair that was checked and is grey; see `check_pair`."""
    height, width = pair.left.shape
    if any(bad is not None and bad.all() for bad in (pair.left_bad, pair.right_bad)):
        return PairReport(width, height, 0, 0.0, faults=(unusable_fault(),))
    side = _QUICK_SIDE if quick else _SIDE
    left, factor = stretched(pair.left, side)
    right, _ = stretched(pair.right, side)
    usable = _usable(pair.left_bad, left.shape), _usable(pair.right_bad, right.shape)
    mine, theirs = points_of(left, factor, usable[0]), points_of(right, factor, usable[1])
    matches = match_points(mine, theirs)
    rows = fit_rows(matches, height, width, _TOLERANCE / factor)
    known = rows if rows is not None and rows.share >= _MAJORITY else None
    faults: list[Fault] = []
    if same_pixels(pair.left, pair.right):
        faults.append(_fault("same", "left and right hold the same pixels: was one view given twice?"))
    else:
        few = _FEW * min(len(mine.angles), len(theirs.angles))
        if known is None or known.agreeing.sum() < few:
            faults += _apart(mine, matches, right, factor, pair, rows)
            if faults and faults[0].kind != "rows":
                known = None
        if known is not None:
            faults = _of_rows(known, height, width)
            if abs(known.roll_degrees) < _LARGE_ROLL:
                faults += _of_disparities(matches, known, min_disparity, max_disparity)
    blank, white = _blank(left, usable[0]), _saturated(pair.left, pair.left_bad)
    sharpness = _sharpness(right) / _sharpness(left)
    if known is None and faults and not 1 / _BLURRED < sharpness < _BLURRED:
        faults = []  # features of so different views tell nothing
    places = (matches.left[known.agreeing], matches.right[known.agreeing]) if known is not None else None
    brightness = _brightness(pair, places)
    faults += _of_light(brightness, sharpness if not faults or known is not None else 1.0, blank, white)
    order = list(KINDS)
    faults.sort(key=lambda fault: order.index(fault.kind))
    seen: dict[str, Any] = {}
    if known is not None:
        across = (matches.left - matches.right)[known.agreeing, 0]
        low, high = np.percentile(across, (1, 99))
        seen = {"row_offset": known.offset, "roll": known.roll_degrees, "scale": 1 + known.scale}
        seen["disparities"] = float(low), float(high)
    return PairReport(
        width, height, len(matches.turns), 0.0 if rows is None else rows.share, **seen, brightness=brightness,
        sharpness=sharpness, blank=blank, saturated=white, faults=tuple(faults),
    )  # fmt: skip


def unusable_fault() -> Fault:
    """Return the fault of a pair without any usable pixel."""
    return Fault("unusable", "no pixel is usable: mask, no-data value, alpha or black borders exclude them all")


def same_pixels(left: Any, right: Any) -> bool:
    """Return whether two images, or parts of images, have equal pixels; mostly the first rows decide."""
    a, b = np.asarray(left), np.asarray(right)
    return a.shape == b.shape and bool(np.array_equal(a[:1], b[:1])) and bool(np.array_equal(a, b))


def _fault(kind: str, message: str) -> Fault:
    assert kind in KINDS
    return Fault(kind, message)


def _usable(bad: NDArray[np.bool_] | None, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """Return where a shrunk image may have features: not at, nor right beside, pixels without evidence."""
    if bad is None:
        return None
    wide = cv2.dilate(bad.view(np.uint8), np.ones((9, 9), np.uint8))
    small = np.asarray(cv2.resize(wide, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST))
    return np.asarray(small == 0)


def _of_rows(rows: Rows, height: int, width: int) -> list[Fault]:
    """Return what is wrong with rows that are known."""
    of_offset, of_roll, of_scale = (_ERRORS * error for error in rows.errors)
    offset = abs(rows.offset) > _OFFSET + of_offset
    roll = abs(rows.roll_degrees) > _ROLL + math.degrees(of_roll)
    scale = abs(rows.scale) > _SCALE + of_scale
    if not (offset or roll or scale):
        return []
    side = "lower" if rows.offset > 0 else "higher"
    turned = f", turned by {rows.roll_degrees:+.2f} degrees" if roll else ""
    larger = f" and {1 + rows.scale:.4f} times as high" if scale else ""
    worst = rows.worst(height, width)
    small = "; align=True (--align) corrects so little" if worst < 2 else ""
    return [
        _fault(
            "rows",
            f"rows do not meet: the right view lies {abs(rows.offset):.1f} px {side}{turned}{larger}, which is up to "
            f"{worst:.1f} px: rectify the pair{small}",
        )
    ]


def _of_disparities(matches: Matches, rows: Rows, low: int, high: int) -> list[Fault]:
    """Return what is wrong with the disparities of the points that agree."""
    across = (matches.left - matches.right)[rows.agreeing, 0]
    if np.percentile(np.abs(across), 80) < _STILL:
        return [_fault("same", "left and right show the same picture, without any parallax: was one view given twice?")]

    def inside(values: NDArray[np.float64]) -> float:
        return float(np.mean((values > low - _SLACK) & (values < high - 1 + _SLACK)))

    if inside(across) < _INSIDE and inside(-across) > _OUTSIDE:
        return [
            _fault(
                "exchanged",
                f"the views look exchanged (or both are upside down): {100 * np.mean(across < 0):.0f} % of "
                f"{across.size} common points lie further right in the right view; give the views the other way round",
            )
        ]
    ends = []
    fit_low, fit_high = low, high
    for name, beyond in (("below", across < low - _SLACK), ("above", across > high - 1 + _SLACK)):
        if beyond.mean() > _CLIPPED and beyond.sum() >= _FEWEST_CLIPPED:
            ends.append(f"{100 * beyond.mean():.0f} % {name}")
            if name == "below":
                fit_low = math.floor(np.percentile(across, 1.5)) - 2
            else:
                fit_high = 8 * math.ceil((1.05 * float(np.percentile(across, 98.5)) + 3) / 8)
    if not ends:
        return []
    return [
        _fault(
            "range",
            f"disparities of common points lie outside of {low} .. {high - 1}, {' and '.join(ends)}: "
            f"min_disparity={fit_low}, max_disparity={max(fit_high, fit_low + 8)} would fit",
        )
    ]


def _apart(
    mine: Points, matches: Matches, right: NDArray[np.uint8], factor: float, pair: GrayPair, rows: Rows | None
) -> list[Fault]:  # fmt: skip
    """Return why the rows of two views cannot be told."""
    height, width = pair.left.shape
    usable = _usable(pair.right_bad, right.shape)
    flipped = None if usable is None else np.ascontiguousarray(usable[:, ::-1])
    mirror = points_of(np.ascontiguousarray(right[:, ::-1]), factor, flipped)
    mirrored = match_points(mine, mirror)
    turn, share = _turn(mirrored)
    if share >= _MAJORITY and share * len(mirrored.turns) > max(2 * FEWEST, 1.5 * _consistent(matches)):
        if abs(turn) < _TURN:
            how = "left to right"
        else:
            how = "top to bottom" if abs(abs(turn) - 180) < _TURN else f"and turned by {turn:+.0f} degrees"
        return [_fault("mirrored", f"one view is mirrored, {how}: mirror it back")]
    turn, share = _turn(matches)
    if share >= _MAJORITY and abs(turn) > _TURN and share * len(matches.turns) > 2 * FEWEST:
        return [_fault("rotated", f"one view is turned by about {turn:+.0f} degrees to the other: turn it back")]
    if rows is not None and rows.share >= _MAJORITY:
        return []
    features = min(len(mine.angles), len(mirror.angles))
    agree = 0 if rows is None else int(rows.agreeing.sum())
    if features >= _MANY and agree < _FEW_MATCHES * features and (rows is None or rows.share < _FEW_AGREE):
        return [_fault("unrelated", "the views have hardly a point in common: are they of the same scene and moment?")]
    loose = fit_rows(matches, height, width, 0.02 * width)
    if loose is not None and loose.share >= _MAJORITY and loose.agreeing.sum() > 2 * FEWEST:
        return [
            _fault(
                "rows",
                f"rows do not meet: the points that both views show lie {loose.spread:.1f} px from the rows that fit "
                "them best: rectify the pair (and are both views of the same moment?)",
            )
        ]
    return []


def _consistent(matches: Matches) -> float:
    """Return how many points are turned alike."""
    return _turn(matches)[1] * len(matches.turns)


def _turn(matches: Matches) -> tuple[float, float]:
    """Return by how many degrees most points are turned, and the share of the points that are."""
    if len(matches.turns) < FEWEST:
        return 0.0, 0.0
    apart = np.abs((matches.turns[:, None] - matches.turns[None, :] + 180) % 360 - 180)
    near = apart < _TURN_SPREAD
    most = near.sum(axis=1).argmax()
    centre = matches.turns[most]
    others = (matches.turns[near[most]] - centre + 180) % 360 - 180
    turn = (centre + float(np.median(others)) + 180) % 360 - 180
    return float(turn), float(near[most].mean())


def _brightness(pair: GrayPair, places: tuple[NDArray[np.float64], NDArray[np.float64]] | None) -> float:
    """Return how many times as bright as the left view the right one is, at the points that both show."""
    if places is None:
        return 1.0
    grey = []
    for image, at in zip((pair.left, pair.right), places, strict=True):
        mean = cv2.blur(image, (_PATCH, _PATCH))
        x, y = np.rint(at).astype(int).T
        grey.append(mean[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)].astype(float))
    one = max(1.0, 0.01 * float(grey[0].max()))
    return float(np.median((grey[1] + one) / (grey[0] + one)))


def _sharpness(image: NDArray[np.uint8]) -> float:
    """Return how much of an image's slopes is of the finest scale: the energy of its Laplacian over its gradient's."""
    if min(image.shape) < 3:
        return 1.0
    soft = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    slopes = float(np.square(np.diff(soft, axis=0)).mean() + np.square(np.diff(soft, axis=1)).mean())
    return float(np.square(cv2.Laplacian(soft, cv2.CV_32F)).mean()) / max(slopes, 1e-6) + 1e-6


def _blank(image: NDArray[np.uint8], usable: NDArray[np.bool_] | None) -> float:
    """Return the share of the usable pixels whose neighbourhood has one value."""
    square = np.ones((7, 7), np.uint8)
    blank = np.asarray(cv2.dilate(image, square) == cv2.erode(image, square))
    return float(np.mean(blank if usable is None or not usable.any() else blank[usable]))


def _saturated(image: NDArray[Any], bad: NDArray[np.bool_] | None) -> float:
    """Return the share of the usable pixels that have the largest value; 0 if all have one, which need not be white."""
    values = image if bad is None else image[~bad]
    largest = values.max()
    return 0.0 if largest == values.min() else float(np.mean(values == largest))


def _of_light(brightness: float, sharpness: float, blank: float, white: float) -> list[Fault]:
    faults = []
    if not 1 / _BRIGHTER < brightness < _BRIGHTER:
        faults.append(
            _fault(
                "exposure",
                f"the right view is {brightness:.2f} times as bright as the left one: "
                "the costs allow for it, but dark or white areas match worse; expose both alike",
            )
        )
    if not 1 / _SHARPER < sharpness < _SHARPER:
        blurred = "right" if sharpness < 1 else "left"
        faults.append(
            _fault("sharpness", f"the {blurred} view is the less sharp one: is it out of focus, or scaled up?")
        )
    if blank > _BLANK:
        faults.append(
            _fault("blank", f"{100 * blank:.0f} % of the left view has no texture, where nothing is measured")
        )
    if white > _WHITE:
        faults.append(_fault("saturated", f"{100 * white:.0f} % of the left view is white: expose it less"))
    return faults
