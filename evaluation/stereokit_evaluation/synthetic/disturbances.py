"""Controlled faults of a camera pair: noise, gain, gamma, blur, rain, JPEG, rows that do not meet, exposure, darkness.

Each is a deterministic function of a pair's name, the kind, its strength and the view: the same call gives the same
bytes. What differs between two cameras (gain, gamma, focus, offset, roll) is done to the right view alone, because the
truth is that of the left one; what both share (blur, rain, JPEG, exposure, darkness) to both, with noise and drops of
its own in each. Strengths are in grey levels of 255, whatever the image's type.

Random noise is the same in all channels of a colour image, so that its strength does not depend on whether a method
looks at colours. Light is taken as the grey value to the power of `CODING`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import InputError, OptionError, UnknownNameError, did_you_mean
from stereokit_evaluation.synthetic.sensors import blurred, compressed, sensor_noise

__all__ = ["CODING", "DISTURBANCES", "Disturbance", "disturb", "parse_disturbances", "warped"]

CODING = 2.2
"""The exponent from grey values to light."""
_SHOT, _READ = 2e-4, 2e-3  # of darkness: variance per light, standard deviation without; of the range 0..1
_STREAK = 28.0  # mean length of a streak of rain, pixels
_RAIN_LIGHT = 210.0  # grey value of a drop

Gray = NDArray[np.float64]
Apply = Callable[[Any, float, np.random.Generator], Any]


@dataclass(frozen=True)
class Disturbance:
    """A kind of fault.

    Attributes
    ----------
    name : str
    unit : str
        Of the strength.
    views : {"right", "both"}
    strengths : tuple of float
        Those that are measured by default.
    neutral : float
        The strength that changes nothing, for axes.
    about : str
        The fault in a few words.
    low, high : float
        The strengths that it takes.
    apply : callable
        Of an image in grey levels, float64, the strength and a generator.
    """

    name: str
    unit: str
    views: str
    strengths: tuple[float, ...]
    neutral: float
    about: str
    low: float
    high: float
    apply: Apply


def warped(image: NDArray[Any], offset: float = 0.0, roll: float = 0.0) -> NDArray[Any]:
    """Return an image moved down by `offset` pixels and turned clockwise by `roll` degrees about its middle."""
    height, width = image.shape[:2]
    cos, sin = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    x, y = (width - 1) / 2, (height - 1) / 2
    matrix = np.array([[cos, -sin, x - cos * x + sin * y], [sin, cos, y - sin * x - cos * y + offset]])
    moved = cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(moved, image.dtype)


def _noise(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    return image + _spread(strength * rng.standard_normal(image.shape[:2]), image)


def _gain(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    return image * strength


def _gamma(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    return np.asarray(255.0 * (image / 255.0) ** strength)


def _blur(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    if image.ndim == 2:
        return blurred(image, strength)
    return np.stack([blurred(np.ascontiguousarray(image[..., k]), strength) for k in range(image.shape[2])], axis=2)


def _rain(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    height, width = image.shape[:2]
    count = round(strength / 100 * height * width / _STREAK)
    layer = np.zeros((height, width), np.uint8)
    slant = rng.uniform(-0.2, 0.2)
    for _ in range(count):
        x, y, length = rng.uniform(0, width), rng.uniform(-_STREAK, height), rng.uniform(0.5, 1.5) * _STREAK
        ends = (round(16 * x), round(16 * y)), (round(16 * (x + slant * length)), round(16 * (y + length)))
        cv2.line(layer, *ends, color=int(rng.integers(90, 170)), thickness=1, lineType=cv2.LINE_AA, shift=4)
    cover = _spread(layer / 255.0, image)
    return np.asarray(image * (1 - cover) + _RAIN_LIGHT * cover)


def _jpeg(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    picture = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return compressed(picture, round(strength)).astype(np.float64)


def _offset(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    return warped(image, strength)


def _roll(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    return warped(image, 0.0, strength)


def _exposure(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    return np.asarray(image * 2.0 ** (strength / CODING))


def _darkness(image: Gray, strength: float, rng: np.random.Generator) -> Gray:
    light: Gray = (image / 255.0) ** CODING / 2.0**strength
    if image.ndim == 3:
        noise = rng.standard_normal(image.shape[:2])[..., None]
        light = light + np.sqrt(_SHOT * np.maximum(light, 0) + _READ**2) * noise
    else:
        light = sensor_noise(light, _SHOT, _READ, rng)
    return np.asarray(255.0 * np.maximum(light, 0.0) ** (1 / CODING))


DISTURBANCES: dict[str, Disturbance] = {
    kind.name: kind
    for kind in (
        Disturbance("noise", "grey levels", "both", (2, 5, 10, 20), 0, "white noise", 0, 255, _noise),
        Disturbance("gain", "factor", "right", (0.5, 0.7, 1.4, 2), 1, "right view brighter, darker", 0.01, 100, _gain),
        Disturbance(
            "gamma", "exponent", "right", (0.5, 0.7, 1.4, 2), 1, "right view's curve differs", 0.05, 20, _gamma
        ),
        Disturbance("blur", "px, sigma", "both", (0.5, 1, 2, 3), 0, "both views blurred", 0, 50, _blur),
        Disturbance("defocus", "px, sigma", "right", (0.5, 1, 2, 3), 0, "right view blurred", 0, 50, _blur),
        Disturbance("rain", "% of the pixels", "both", (0.5, 1, 2, 5), 0, "bright streaks", 0, 50, _rain),
        Disturbance("jpeg", "quality", "both", (80, 50, 20, 10), 100, "JPEG compression", 1, 100, _jpeg),
        Disturbance("offset", "px", "right", (0.25, 0.5, 1, 2), 0, "right view lower", -100, 100, _offset),
        Disturbance("roll", "degrees", "right", (0.1, 0.25, 0.5, 1), 0, "right view turned", -45, 45, _roll),
        Disturbance("exposure", "stops", "both", (0.5, 1, 2, 3), 0, "overexposed, clipped", -8, 8, _exposure),
        Disturbance("darkness", "stops", "both", (2, 4, 6, 8), 0, "less light, sensor noise", 0, 16, _darkness),
    )
}
"""The kinds of faults by name."""


def disturb(image: NDArray[Any], kind: str, strength: float, view: str, name: str) -> NDArray[Any]:
    """Return an image with a fault.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) uint8 or uint16
    kind : str
        A key of `DISTURBANCES`.
    strength : float
        In its unit.
    view : {"left", "right"}
        The left view stays as it is where the kind has ``views`` "right".
    name : str
        Of the pair, which the random numbers depend on.

    Returns
    -------
    array like `image`

    Raises
    ------
    UnknownNameError, OptionError, InputError
        If there is no such kind, its strength is beyond its range, or the image has another type.
    """
    fault = _kind(kind)
    _check_strength(fault, strength)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"image must be uint8 or uint16 to be disturbed, got {image.dtype}")
    if fault.views == "right" and view == "left":
        return image
    seed = hashlib.sha256(f"{name}|{kind}|{float(strength)!r}|{view}".encode()).digest()
    top = float(np.iinfo(image.dtype).max)
    values = fault.apply(image * (255.0 / top), float(strength), np.random.default_rng(list(seed[:16])))
    return np.asarray(np.clip(np.rint(values * (top / 255.0)), 0, top), image.dtype)


def parse_disturbances(texts: list[str]) -> dict[str, tuple[float, ...]]:
    """Return the strengths of each kind in texts such as ``"noise"``, ``"offset:0.25,0.5"`` and ``"all"``.

    Raises
    ------
    UnknownNameError, OptionError
        If there is no such kind, a strength is no number or beyond its range, or a kind appears twice.
    """
    chosen: dict[str, tuple[float, ...]] = {}
    for text in texts:
        name, separator, numbers = (part.strip() for part in text.partition(":"))
        if name == "all":
            if separator:
                raise OptionError(f"disturb must name a kind with its strengths, got {text!r}")
            chosen |= {kind: fault.strengths for kind, fault in DISTURBANCES.items() if kind not in chosen}
            continue
        fault = _kind(name)
        if name in chosen:
            raise OptionError(f"disturb must name each kind once, got {name!r} twice")
        strengths = fault.strengths
        if separator:
            try:
                strengths = tuple(float(number) for number in numbers.split(","))
            except ValueError as error:
                raise OptionError(f"disturb must be KIND:S1,S2 with numbers, got {text!r}") from error
        for strength in strengths:
            _check_strength(fault, strength)
        chosen[name] = tuple(dict.fromkeys(strengths))
    return chosen


def _kind(name: str) -> Disturbance:
    if name not in DISTURBANCES:
        raise UnknownNameError(did_you_mean("disturbance", name, [*DISTURBANCES, "all"]))
    return DISTURBANCES[name]


def _check_strength(fault: Disturbance, strength: float) -> None:
    if not math.isfinite(strength) or not fault.low <= strength <= fault.high:
        raise OptionError(
            f"{fault.name} must have strengths from {fault.low:g} to {fault.high:g} {fault.unit}, got {strength:g}"
        )


def _spread(layer: Gray, image: Gray) -> Gray:
    """Return a layer (H, W) for all channels of an image."""
    return layer if image.ndim == 2 else layer[..., None]
