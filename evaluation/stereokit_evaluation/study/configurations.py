"""The configurations of the robustness study: each matcher in each variant, with everything its results depend on.

The variants are the settings of the StereoVAE paper, section "Robustness": *Original* matches at full size; *Mini+X*
matches at half size and the refiner X brings the map to full size. *Mini+CNN* is the paper's network without the latent
sampling ("non-VAE" in its table II). Any other registered refiner is a further variant.

A refiner that is not installed, or whose runtime is not, leaves its configurations in the list, with the reason.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2

import stereokit
from stereokit.errors import FileError, OptionError, UnknownNameError, did_you_mean
from stereokit.matching import METHODS, Matcher
from stereokit.methods import find_refiner, option_names, parse_method
from stereokit.registry import AGGREGATIONS, COSTS, REFINERS
from stereokit_evaluation.bench import baselines
from stereokit_evaluation.common.weights import is_of_half_size
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.outside import MapFolder, OutsideMethod
from stereokit_evaluation.scoring.runner import Matching

__all__ = [
    "BASELINE",
    "PAPER_VARIANTS",
    "Configuration",
    "available_variants",
    "baseline",
    "baseline_key",
    "build",
    "describe_error",
    "fingerprint",
    "merged",
    "outside",
    "parse_variant",
    "title",
]

PAPER_VARIANTS = {"linear": "Mini+Linear", "original": "Original", "cnn": "Mini+CNN", "stereovae": "Mini+StereoVAE"}
"""The paper's variants, by the names that ``--variant`` takes."""
BASELINE = "peer"
"""The variant of a method that is not ours: another library's matcher, a function, a program, finished maps."""

_NO_VARIANTS = ("auto", "file", "general")  # choose among others, take a path, are another's second name

Trained = Mapping[tuple[str, str], Any]
"""Method and variant to the refiner of `stereokit.Matcher`: a weight file, or a refiner object."""


@dataclass(frozen=True, eq=False)
class Configuration:
    """A method in a variant.

    Attributes
    ----------
    method : str
        ``"zncc+sgm"``, or the name of a baseline.
    label : str
        ``"S4"``, or the method where it has no short name.
    variant : str
        A key of `PAPER_VARIANTS`, another refiner's name, or `BASELINE`.
    matcher : callable or None
        The function of two images; None if it cannot be built, and for a method of others.
    identity : dict
        Everything its maps depend on, except the images: resolved options, weights, source.
    missing : str or None
        Why it cannot be built, in one line.
    outside : OutsideMethod or None
        A method of others, which is given the frame and its images as they are stored.
    by_frame : mapping, optional
        Where one row has frames of several data sets: each frame's own configuration and frame, by the name in the row.
    """

    method: str
    label: str
    variant: str
    matcher: Matching | None = None
    identity: dict[str, Any] = field(default_factory=dict)
    missing: str | None = None
    outside: OutsideMethod | None = None
    by_frame: Mapping[str, tuple[Configuration, Frame]] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """``"stereokit"``, ``"opencv"`` (another library), ``"function"``, ``"program"`` or ``"maps"``."""
        if self.outside is not None:
            return self.outside.kind
        return "opencv" if self.variant == BASELINE else "stereokit"

    @property
    def can_match(self) -> bool:
        """Whether it can be built, and has maps of any images: finished ones have none of others."""
        return self.matcher is not None or self.outside is not None

    def identity_on(self, frame: Frame) -> dict[str, Any]:
        """Return `identity` with what else a map of this frame depends on: the file of a finished one.

        Raises
        ------
        FileError
            If there is no such file.
        """
        if isinstance(self.outside, MapFolder):
            return {**self.identity, "file": self.outside.digest_of(frame)}
        return self.identity

    def match_frame(self, frame: Frame, *, gray: bool = True) -> Any:
        """Return the result of matching a frame, whose images are loaded as the method wants them."""
        chosen, own = self.by_frame.get(frame.name, (self, frame))
        left, right = own.load_pair(gray=gray and chosen.outside is None)
        return chosen.match(own, left, right)

    def match(self, frame: Frame, left: Any, right: Any) -> Any:
        """Return the result for two images of a frame: grey ones, or for a method of others as they are stored."""
        if self.outside is not None:
            return self.outside(frame, left, right)
        assert self.matcher is not None
        return self.matcher(left, right)

    @property
    def name(self) -> str:
        """The name in tables: ``"S4 Mini+Linear"``."""
        return self.label if self.variant == BASELINE else f"{self.label} {title(self.variant)}"

    @property
    def scale(self) -> float:
        """The size of the matching."""
        return 1.0 if self.variant in ("original", BASELINE) else 0.5


def title(variant: str) -> str:
    """Return the title of a variant in tables: ``"Mini+CNN"``."""
    return PAPER_VARIANTS.get(variant) or f"Mini+{Path(variant).stem if _is_file(variant) else variant}"


def available_variants() -> list[str]:
    """Return the paper's variants and one for each further registered refiner."""
    return [*PAPER_VARIANTS, *(n for n in REFINERS.names() if n not in PAPER_VARIANTS and n not in _NO_VARIANTS)]


def parse_variant(text: str) -> str:
    """Return the variant named `text`: ``"original"``, a refiner, ``"Mini+REFINER"``, or a weight file.

    Raises
    ------
    UnknownNameError
        If the paper has no such variant and no such refiner is registered.
    FileError
        If there is no such weight file.
    """
    if _is_file(text):
        if not Path(text).is_file():
            raise FileError(f"variant must name a weight file that exists, got {text!r}")
        return text
    known = available_variants()
    name = text.strip().lower().removeprefix("mini+")
    if name not in known:
        raise UnknownNameError(did_you_mean("variant", text, known))
    return name


def build(
    methods: Sequence[str],
    variants: Sequence[str],
    options: Mapping[str, Any],
    trained: Trained | None = None,
) -> list[Configuration]:
    """Return the configurations, matcher by matcher, in the order of the arguments.

    Parameters
    ----------
    methods : sequence of str
        Methods, by any of their names.
    variants : sequence of str
        As `parse_variant` returns them.
    options : mapping
        Options of `stereokit.Matcher`. An option of a stage, or of a refiner, applies only where it exists.
    trained : mapping, optional
        Refiners that were trained for one method: (method, variant) to a weight file or a refiner.

    Raises
    ------
    OptionError
        If no chosen method knows an option, or one refuses its value.
    """
    method_names = list(dict.fromkeys(parse_method(method) for method in methods))
    for option in options:
        if all(option in _foreign(name) for name in method_names):
            raise OptionError(f"option {option!r} must belong to a chosen method, got {', '.join(method_names)}")
    refiner_options = {variant: _refiner_options(variant) for variant in variants}
    all_refiner_options = {option for names_ in refiner_options.values() for option in names_}
    receivers = {variant for variant in variants if refiner_options[variant] and is_of_half_size(variant)}

    def options_of(name: str, variant: str) -> dict[str, Any]:
        excluded = _foreign(name) | all_refiner_options - refiner_options[variant]
        if variant not in receivers or (name, variant) in (trained or {}):
            excluded |= {"weights"}
        return {option: value for option, value in options.items() if option not in excluded}

    weights = trained or {}
    return [
        _configure(name, variant, options_of(name, variant), refiner_options[variant], weights.get((name, variant)))
        for name in method_names
        for variant in dict.fromkeys(variants)
    ]


def baseline(key: str, levels: int) -> Configuration:
    """Return another library's matcher as a configuration: `key` is one of `stereokit_evaluation.bench.baselines`."""
    source = fingerprint(Path(baselines.__file__))
    identity = {"peer": key, "levels": levels, "opencv": cv2.__version__, "source": source}
    return Configuration(key, key, BASELINE, baselines.padded(key, levels), identity)


def baseline_key(text: str) -> str | None:
    """Return the name of OpenCV's mode that `text` names, such as ``"OpenCV HH"`` or ``"opencv-hh"``, None for none."""

    def plain(name: str) -> str:
        return re.sub(r"[^a-z0-9]", "", name.lower())

    keys = (key for key in baselines.BASELINES if key.startswith("OpenCV"))
    return next((key for key in keys if plain(key) == plain(text)), None)


def outside(method: OutsideMethod) -> Configuration:
    """Return a method of others as a configuration."""
    return Configuration(method.name, method.name, BASELINE, identity=method.identity(), outside=method)


def merged(configuration: Configuration, by_frame: Mapping[str, tuple[Configuration, Frame]]) -> Configuration:
    """Return one configuration for frames of several data sets (`Configuration.by_frame`)."""
    return replace(configuration, by_frame=dict(by_frame))


@cache
def fingerprint(place: Path, *, everything: bool = False) -> str:
    """Return a digest of a file, or of the Python source below a folder.

    Parameters
    ----------
    place : Path
        A file or a folder; it is read once in a process.
    everything : bool
        Read all files of the folder, such as weights, but compiled ones.
    """
    digest = hashlib.sha256()
    for path in [place] if place.is_file() else sorted(place.rglob("*" if everything else "*.py")):
        if path.is_file() and "__pycache__" not in path.parts:
            digest.update(path.relative_to(place).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def describe_error(error: BaseException) -> str:
    """Return an error in one line: those of other libraries with their type, a missing package by its name."""
    text = " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError) and error.name:
        return f"needs the package {error.name!r}, which is not installed"
    return text if isinstance(error, stereokit.StereokitError) else f"{type(error).__name__}: {text}".rstrip(": ")


def _configure(
    method: str, variant: str, options: dict[str, Any], refiner_options: frozenset[str], trained: Any
) -> Configuration:
    label = next((short for short, name in METHODS.items() if name == method), method)
    if variant == "original":
        matcher = Matcher(method, **options)
        return Configuration(method, label, variant, matcher, _identity(matcher))
    # A bad option is the user's, and no reason to call a refiner missing.
    Matcher(method, scale=0.5, **{name: value for name, value in options.items() if name not in refiner_options})
    if trained is None and not _is_file(variant) and variant not in REFINERS.names():
        return Configuration(method, label, variant, missing=f"no refiner named {variant!r} is installed")
    try:
        matcher = Matcher(method, scale=0.5, refiner=variant if trained is None else trained, **options)
        return Configuration(method, label, variant, matcher, _identity(matcher))
    except Exception as error:  # a plug-in's own trouble: weights or a runtime that are not there
        return Configuration(method, label, variant, missing=describe_error(error))


def _is_file(variant: str) -> bool:
    return variant.lower().endswith(".safetensors")


def _refiner_options(variant: str) -> frozenset[str]:
    """Return the names of a refiner's own options; of one that cannot be loaded, none."""
    if variant == "original":
        return frozenset()
    try:
        return frozenset(find_refiner(variant)[2])
    except Exception:
        return frozenset()


def _identity(matcher: Matcher) -> dict[str, Any]:
    options = matcher.identity()
    for name in ("refiner", "weights"):  # these follow
        options.pop(name)
    return {
        "options": {name: _stable(value) for name, value in sorted(options.items())},
        "source": fingerprint(Path(stereokit.__file__).parent),
        "refiner": None if matcher.refine is None else _weights(matcher.refine),
    }


def _weights(refiner: Any) -> dict[str, str]:
    """Return the identity of a refiner: its own fingerprint or its ``repr``, and a digest of its source files."""
    own_fingerprint = getattr(refiner, "fingerprint", None)
    own_fingerprint = own_fingerprint() if callable(own_fingerprint) else own_fingerprint
    module = sys.modules.get(type(refiner).__module__.partition(".")[0])
    file = getattr(module, "__file__", None)
    source = ""
    if file is not None:  # a package is its folder, a module its file alone
        path = Path(file).parent if hasattr(module, "__path__") else Path(file)
        source = fingerprint(path, everything=own_fingerprint is None)
    return {"weights": _stable(refiner) if own_fingerprint is None else str(own_fingerprint), "source": source}


def _stable(value: Any) -> str:
    """Return ``repr`` without addresses, which differ from run to run."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def _foreign(method: str) -> set[str]:
    """Return the names of options that only stages of other methods have."""
    cost, aggregation = method.split("+")
    stages = [COSTS.get(name) for name in COSTS.names()] + [AGGREGATIONS.get(name) for name in AGGREGATIONS.names()]
    own_names = {*option_names(COSTS.get(cost)), *option_names(AGGREGATIONS.get(aggregation))}
    return {name for stage in stages for name in option_names(stage)} - own_names
