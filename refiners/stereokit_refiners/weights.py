"""Weight files: safetensors, checked against the architecture, never code.

A file holds the float32 arrays of one network and, as metadata, the format's version, the architecture, its form, the
ranges for int8 and how it was trained. The shipped ones are in ``weights/`` beside this file.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, StereokitError, did_you_mean
from stereokit.io import parsing, write_bytes
from stereokit_refiners.networks.evidence import Evidence
from stereokit_refiners.networks.layers import Network, activations, shapes
from stereokit_refiners.networks.pyramid import Pyramid
from stereokit_refiners.networks.stereovae import NonVae, StereoVae

__all__ = ["NETWORKS", "WeightFile", "network_named", "read", "shipped", "write"]

NETWORKS: dict[str, Network] = {network.name: network for network in (StereoVae(), NonVae(), Pyramid(), Evidence())}
"""Architectures by name."""

_FORMAT = "stereokit-refiner/2"
_DISPARITIES = (0.0, 128.0)  # of the training of files that do not say


@dataclass(frozen=True, eq=False)
class WeightFile:
    """The content of a weight file.

    Parameters
    ----------
    network : str
        Architecture.
    form : {"residual", "literal"}
    arrays : dict of float32 arrays
    ranges : dict of lists of float
        Largest absolute value of each channel of each activation, for int8; empty when it was not calibrated.
    notes : dict
        How it was trained: free, JSON. ``"disparities"`` are the smallest and the largest of the training, pixels.
    """

    network: str
    form: str
    arrays: Mapping[str, NDArray[np.float32]]
    ranges: Mapping[str, list[float]] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def disparities(self) -> tuple[float, float]:
        """The smallest and the largest disparity of the training, full-size pixels."""
        low, high = self.notes.get("disparities", _DISPARITIES)
        return float(low), float(high)

    @property
    def fingerprint(self) -> str:
        """A digest of everything that decides the result."""
        found = hashlib.sha256(f"{self.network} {self.form} {sorted(self.ranges.items())}".encode())
        for name in sorted(self.arrays):
            found.update(name.encode() + self.arrays[name].tobytes())
        return found.hexdigest()[:16]


def network_named(name: str) -> Network:
    """Return the architecture called `name`.

    Raises
    ------
    FileError
        If there is none.
    """
    if name not in NETWORKS:
        raise FileError(did_you_mean("network", name, tuple(NETWORKS)))
    return NETWORKS[name]


def _library() -> Any:
    try:
        import safetensors
        import safetensors.numpy
    except ImportError:
        raise StereokitError(
            "learned refiners need safetensors, which is not installed: pip install 'stereokit[refiners]'"
        ) from None
    return safetensors


def write(path: str | Path, content: WeightFile) -> None:
    """Write a weight file, all of it or nothing.

    Raises
    ------
    FileError
        If the arrays are not those of the network, or the file cannot be written.
    """
    _check(str(path), content.network, content.form, content.arrays, content.ranges)
    metadata = {
        "format": _FORMAT,
        "network": content.network,
        "form": content.form,
        "ranges": json.dumps(dict(content.ranges), sort_keys=True),
        "notes": json.dumps(content.notes, sort_keys=True),
    }
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in content.arrays.items()}
    write_bytes(path, _library().numpy.save(arrays, metadata=metadata))


def read(path: str | Path) -> WeightFile:
    """Read a weight file.

    Raises
    ------
    FileError
        If it is missing, no such file, of another version, or its arrays are not those of its architecture.
    """
    library = _library()
    text = str(path)
    if not os.path.isfile(path):
        raise FileError(f"weights must name a file, got {text!r}, which is not there")
    with (
        parsing(path, "weights", "weights must be a safetensors file"),
        library.safe_open(text, framework="np") as held,
    ):
        metadata = held.metadata() or {}
        arrays = {name: held.get_tensor(name) for name in held.keys()}
    if metadata.get("format") != _FORMAT:
        raise FileError(f"weights must have the format {_FORMAT!r}, got {metadata.get('format')!r} in {text!r}")
    name, form = metadata.get("network", ""), metadata.get("form", "")
    with parsing(path, "weights", "weights must hold ranges and notes as JSON"):
        ranges = {str(k): [float(x) for x in v] for k, v in json.loads(metadata.get("ranges", "{}")).items()}
        notes = json.loads(metadata.get("notes", "{}"))
        if not isinstance(notes, dict) or not _are_names(notes.get("frames", [])):
            raise ValueError("notes are an object, whose frames are names")
    _check(text, name, form, arrays, ranges)
    _check_disparities(text, notes)
    return WeightFile(name, form, arrays, ranges, notes)


def _are_names(frames: Any) -> bool:
    return isinstance(frames, list) and all(isinstance(name, str) for name in frames)


def shipped(name: str) -> WeightFile:
    """Return the weights of `name` that come with the package.

    Raises
    ------
    FileError
        If none do.
    """
    path = files("stereokit_refiners") / "weights" / f"{name}.safetensors"
    if not path.is_file():
        raise FileError(f"no weights for {name!r} come with this version")
    return read(str(path))


def _check_disparities(path: str, notes: Mapping[str, Any]) -> None:
    """Raise FileError unless the disparities of the training, if the notes have them, are two numbers in order."""
    given = notes.get("disparities", _DISPARITIES)
    numbers = isinstance(given, (list, tuple)) and len(given) == 2 and all(type(x) in (int, float) for x in given)
    if not numbers or not -math.inf < given[0] < given[1] < math.inf:
        raise FileError(f"disparities in notes must be two numbers, the smaller first, got {given!r} in {path!r}")


def _check(
    path: str, name: str, form: str, arrays: Mapping[str, NDArray[Any]], ranges: Mapping[str, list[float]]
) -> None:
    """Raise FileError unless all of it fits the architecture."""
    network = network_named(name)
    if form not in network.forms:
        raise FileError(f"form of {name!r} must be one of {', '.join(network.forms)}, got {form!r} in {path!r}")
    wanted = shapes(network)
    missing, unknown = sorted(set(wanted) - set(arrays)), sorted(set(arrays) - set(wanted))
    if missing or unknown:
        what = f"lacks {missing[0]!r}" if missing else f"has an unknown {unknown[0]!r}"
        raise FileError(f"weights must be those of {name!r}, but {path!r} {what}")
    for key, shape in wanted.items():
        if arrays[key].shape != shape or arrays[key].dtype != np.float32:
            found = f"{arrays[key].dtype} {arrays[key].shape}"
            rule = f"weights must hold {key!r} as float32 {shape} in this version of {name!r}"
            raise FileError(f"{rule}, got {found} in {path!r}")
        if not np.isfinite(arrays[key]).all():
            raise FileError(f"weights must be finite, but {key!r} in {path!r} is not")
    channels = activations(network)
    for key, bounds in ranges.items():
        if key not in channels:
            raise FileError(f"ranges must be of activations of {name!r}, got {key!r} in {path!r}")
        if len(bounds) != channels[key] or not all(math.isfinite(b) and b >= 0 for b in bounds):
            rule = f"{channels[key]} finite numbers of at least 0"
            raise FileError(f"range of {key!r} must be {rule}, got {len(bounds)}: {bounds} in {path!r}")
