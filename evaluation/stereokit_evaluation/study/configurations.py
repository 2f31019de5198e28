"""The grid of the robustness study: matchers times settings, each with all that its results depend on.

Settings are those of the StereoVAE paper, section "Robustness": *Original* matches at full size; *Mini+X* matches at
half size and lets the refiner X bring the map to full size. *Mini+CNN* is the paper's network without the latent
sampling ("non-VAE" in its table II). Any other registered refiner joins as a further setting.

A refiner that is not installed, or whose runtime is not, leaves its configurations in the grid with the reason.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2

import stereokit
from stereokit.errors import FileError, OptionError, UnknownNameError, did_you_mean
from stereokit.matching import METHODS, Matcher
from stereokit.methods import find_refiner, option_names, parse_method
from stereokit.registry import AGGREGATIONS, COSTS, REFINERS
from stereokit_evaluation.bench import peers
from stereokit_evaluation.common.weights import needs_weights
from stereokit_evaluation.scoring.runner import Matching

__all__ = [
    "PAPER_SETTINGS",
    "PEER",
    "Configuration",
    "build",
    "describe_error",
    "fingerprint",
    "parse_setting",
    "peer",
    "settings_at_hand",
    "title",
]

PAPER_SETTINGS = {"linear": "Mini+Linear", "original": "Original", "cnn": "Mini+CNN", "stereovae": "Mini+StereoVAE"}
"""The paper's settings, by the names that ``--setting`` takes."""
PEER = "peer"
"""The setting of another library's matcher."""

_NO_SETTINGS = ("auto", "file", "general")  # choose among others, take a path, are another's second name

Trained = Mapping[tuple[str, str], Any]
"""Method and setting to what `stereokit.Matcher` takes as its refiner: a weight file, or a refiner."""


@dataclass(frozen=True, eq=False)
class Configuration:
    """One cell of the grid.

    Attributes
    ----------
    method : str
        ``"zncc+sgm"``, or a peer's name.
    label : str
        ``"S4"``, or the method where it has no short name.
    setting : str
        A key of `PAPER_SETTINGS`, another refiner's name, or `PEER`.
    matcher : callable or None
        What is called; None if it cannot be built.
    identity : dict
        All that its maps depend on beside the images: resolved options, weights, source.
    missing : str or None
        Why it cannot be built, in one line.
    """

    method: str
    label: str
    setting: str
    matcher: Matching | None = None
    identity: dict[str, Any] = field(default_factory=dict)
    missing: str | None = None

    @property
    def name(self) -> str:
        """Its name for people: ``"S4 Mini+Linear"``."""
        return self.label if self.setting == PEER else f"{self.label} {title(self.setting)}"

    @property
    def scale(self) -> float:
        """The size at which it matches."""
        return 1.0 if self.setting in ("original", PEER) else 0.5


def title(setting: str) -> str:
    """Return what tables call a setting: ``"Mini+CNN"``."""
    return PAPER_SETTINGS.get(setting) or f"Mini+{Path(setting).stem if _is_file(setting) else setting}"


def settings_at_hand() -> list[str]:
    """Return the paper's settings and one for each further refiner that is registered."""
    return [*PAPER_SETTINGS, *(n for n in REFINERS.names() if n not in PAPER_SETTINGS and n not in _NO_SETTINGS)]


def parse_setting(text: str) -> str:
    """Return the setting called `text`: ``"original"``, a refiner, ``"Mini+REFINER"``, or a weight file.

    Raises
    ------
    UnknownNameError
        If the paper has no such setting and no such refiner is registered.
    FileError
        If there is no such weight file.
    """
    if _is_file(text):
        if not Path(text).is_file():
            raise FileError(f"setting must name a weight file that exists, got {text!r}")
        return text
    known = settings_at_hand()
    name = text.strip().lower().removeprefix("mini+")
    if name not in known:
        raise UnknownNameError(did_you_mean("setting", text, known))
    return name


def build(
    methods: Sequence[str],
    settings: Sequence[str],
    options: Mapping[str, Any],
    trained: Trained | None = None,
) -> list[Configuration]:
    """Return the grid, matcher by matcher, in the order given.

    Parameters
    ----------
    methods : sequence of str
        Methods, in any of their forms.
    settings : sequence of str
        As `parse_setting` returns them.
    options : mapping
        Options of `stereokit.Matcher`. An option of a stage, or of a refiner, goes to those that have it only.
    trained : mapping, optional
        Refiners that were trained for one method: (method, setting) to a weight file or a refiner.

    Raises
    ------
    OptionError
        If no chosen method knows an option, or one refuses its value.
    """
    names = list(dict.fromkeys(parse_method(method) for method in methods))
    for option in options:
        if all(option in _foreign(name) for name in names):
            raise OptionError(f"option {option!r} must belong to a chosen method, got {', '.join(names)}")
    learned = {setting: _refiner_options(setting) for setting in settings}
    everywhere = {option for names_ in learned.values() for option in names_}
    without_weights = {setting for setting in settings if learned[setting] and needs_weights(setting)}

    def fitting(name: str, setting: str) -> dict[str, Any]:
        left_out = _foreign(name) | everywhere - learned[setting]
        if setting not in without_weights or (name, setting) in (trained or {}):
            left_out |= {"weights"}
        return {option: value for option, value in options.items() if option not in left_out}

    return [
        _configure(name, setting, fitting(name, setting), learned[setting], (trained or {}).get((name, setting)))
        for name in names
        for setting in dict.fromkeys(settings)
    ]


def peer(key: str, levels: int) -> Configuration:
    """Return another library's matcher as a configuration: `key` is one of `stereokit_evaluation.bench.peers`."""
    identity = {"peer": key, "levels": levels, "opencv": cv2.__version__, "source": fingerprint(Path(peers.__file__))}
    return Configuration(key, key, PEER, peers.padded(key, levels), identity)


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
    method: str, setting: str, options: dict[str, Any], learned: frozenset[str], trained: Any
) -> Configuration:
    label = next((short for short, name in METHODS.items() if name == method), method)
    if setting == "original":
        matcher = Matcher(method, **options)
        return Configuration(method, label, setting, matcher, _identity(matcher))
    # A bad option is the user's, and no reason to call a refiner missing.
    Matcher(method, scale=0.5, **{name: value for name, value in options.items() if name not in learned})
    if trained is None and not _is_file(setting) and setting not in REFINERS.names():
        return Configuration(method, label, setting, missing=f"no refiner named {setting!r} is installed")
    try:
        matcher = Matcher(method, scale=0.5, refiner=setting if trained is None else trained, **options)
        return Configuration(method, label, setting, matcher, _identity(matcher))
    except Exception as error:  # a plug-in's own trouble: weights or a runtime that are not there
        return Configuration(method, label, setting, missing=describe_error(error))


def _is_file(setting: str) -> bool:
    return setting.lower().endswith(".safetensors")


def _refiner_options(setting: str) -> frozenset[str]:
    """Return the names of a refiner's own options; of one that cannot be loaded, none."""
    if setting == "original":
        return frozenset()
    try:
        return frozenset(find_refiner(setting)[2])
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
    """Return what tells one refiner from another: its own fingerprint or its looks, and the files that it came in."""
    given = getattr(refiner, "fingerprint", None)
    given = given() if callable(given) else given
    module = sys.modules.get(type(refiner).__module__.partition(".")[0])
    file = getattr(module, "__file__", None)
    source = ""
    if file is not None:  # a package is its folder, a module its file alone
        place = Path(file).parent if hasattr(module, "__path__") else Path(file)
        source = fingerprint(place, everything=given is None)
    return {"weights": _stable(refiner) if given is None else str(given), "source": source}


def _stable(value: Any) -> str:
    """Return ``repr`` without addresses, which differ from run to run."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def _foreign(method: str) -> set[str]:
    """Return the names of options that only stages of other methods have."""
    cost, aggregation = method.split("+")
    stages = [COSTS.get(name) for name in COSTS.names()] + [AGGREGATIONS.get(name) for name in AGGREGATIONS.names()]
    own = {*option_names(COSTS.get(cost)), *option_names(AGGREGATIONS.get(aggregation))}
    return {name for stage in stages for name in option_names(stage)} - own
