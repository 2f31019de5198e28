"""Weight files: safetensors, checked against the architecture, never code.

A file holds the float32 arrays of one network and, as metadata, the format's version, the architecture, its output
mode, the ranges for int8 and how it was trained. Those that come with the package are in ``weights/`` beside this file.
Other distributions bring collections, packages with a file for each network, and announce them in the entry-point group
``stereokit.weights``.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save

from stereokit.errors import FileError, OptionError, did_you_mean
from stereokit.io import parsing, write_bytes
from stereokit_refiners.networks.evidence import Evidence
from stereokit_refiners.networks.layers import Network, activations, check_output_mode, output_rule, shapes
from stereokit_refiners.networks.pyramid import Pyramid
from stereokit_refiners.networks.stereovae import NonVae, StereoVae
from stereokit_refiners.outputs import Output

__all__ = [
    "COLLECTIONS",
    "NETWORKS",
    "WeightFile",
    "collection_file",
    "find",
    "network_named",
    "read",
    "shipped",
    "write",
]

NETWORKS: dict[str, Network] = {network.name: network for network in (StereoVae(), NonVae(), Pyramid(), Evidence())}
"""Architectures by name."""

COLLECTIONS = "stereokit.weights"
"""Entry-point group of collections of weights: a name and the package that holds the files."""

_KITTI = (
    "weights 'kitti' are a package of their own, under CC BY-NC-SA 3.0 (not for commercial use), which is not "
    "installed: pip install ./refiners/kitti in a checkout"
)
_FORMAT = "stereokit-refiner/2"
_OLD_MODES = {"literal": "direct"}  # of files that call the output mode a form
_DISPARITIES = (0.0, 128.0)  # of the training of files that do not say


@dataclass(frozen=True, eq=False)
class WeightFile:
    """The content of a weight file.

    Parameters
    ----------
    network : str
        Architecture.
    output_mode : {"residual", "direct"}
        Which of `Network.outputs` makes the map.
    arrays : dict of float32 arrays
    ranges : dict of lists of float
        Largest absolute value of each channel of each activation, for int8; empty when it was not calibrated.
    notes : dict
        How it was trained: free, JSON. ``"disparities"`` are the smallest and the largest of the training, pixels.
    """

    network: str
    output_mode: str
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
        digest = hashlib.sha256(f"{self.network} {self.output_mode} {sorted(self.ranges.items())}".encode())
        for name in sorted(self.arrays):
            digest.update(name.encode() + self.arrays[name].tobytes())
        return digest.hexdigest()[:16]

    @property
    def rule(self) -> Output:
        """What makes the map of the head and the coarse map; OptionError if the network needs more than that."""
        return output_rule(network_named(self.network), self.output_mode)


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


def write(path: str | Path, content: WeightFile) -> None:
    """Write a weight file, all of it or nothing.

    Raises
    ------
    FileError
        If the arrays are not those of the network, or the file cannot be written.
    """
    _check(str(path), content.network, content.output_mode, content.arrays, content.ranges)
    metadata = {
        "format": _FORMAT,
        "network": content.network,
        "output_mode": content.output_mode,
        "ranges": json.dumps(dict(content.ranges), sort_keys=True),
        "notes": json.dumps(content.notes, sort_keys=True),
    }
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in content.arrays.items()}
    write_bytes(path, save(arrays, metadata=metadata))


def read(path: str | os.PathLike[str]) -> WeightFile:
    """Read a weight file.

    Raises
    ------
    FileError
        If it is missing, no such file, of another version, or its arrays are not those of its architecture.
    """
    text = str(path)
    if not os.path.isfile(path):
        raise FileError(f"weights must name a file, got {text!r}, which is not there")
    with (
        parsing(path, "weights", "weights must be a safetensors file"),
        safe_open(text, framework="np") as file,
    ):
        metadata = file.metadata() or {}
        arrays = {name: file.get_tensor(name) for name in file.keys()}
    if metadata.get("format") != _FORMAT:
        raise FileError(f"weights must have the format {_FORMAT!r}, got {metadata.get('format')!r} in {text!r}")
    name, mode = metadata.get("network", ""), metadata.get("output_mode") or metadata.get("form", "")
    mode = _OLD_MODES.get(mode, mode)
    with parsing(path, "weights", "weights must hold ranges and notes as JSON"):
        ranges = {str(k): [float(x) for x in v] for k, v in json.loads(metadata.get("ranges", "{}")).items()}
        notes = json.loads(metadata.get("notes", "{}"))
        if not isinstance(notes, dict) or not _are_names(notes.get("frames", [])):
            raise ValueError("notes are an object, whose frames are names")
    _check(text, name, mode, arrays, ranges)
    _check_disparities(text, notes)
    return WeightFile(name, mode, arrays, ranges, notes)


def _are_names(frames: Any) -> bool:
    return isinstance(frames, list) and all(isinstance(name, str) for name in frames)


def find(network: str, weights: str | os.PathLike[str] | None) -> WeightFile:
    """Return the weights that a refiner's option `weights` stands for.

    Parameters
    ----------
    network : str
        Architecture; empty if any file will do.
    weights : str, path or None
        A weight file, the name of a collection, or None for those that come with the package.

    Raises
    ------
    FileError
        If there are none, or the file cannot be used.
    OptionError
        If they are not those of the network.
    """
    if weights is None:
        return shipped(network)
    if isinstance(weights, str) and re.fullmatch(r"[\w-]+", weights) and not os.path.exists(weights):
        content = read(collection_file(weights, network))
    else:
        content = read(weights)
    if network and content.network != network:
        raise OptionError(f"weights of refiner {network!r} must be its own, got those of {content.network!r}")
    return content


def collection_file(collection: str, network: str) -> str:
    """Return the path of a network's weights in a collection of an installed package.

    Raises
    ------
    FileError
        If no collection has that name, or it has no such weights.
    """
    entries = {entry.name: entry for entry in entry_points(group=COLLECTIONS)}
    if collection not in entries:
        raise FileError(_KITTI if collection == "kitti" else did_you_mean("weights", collection, tuple(entries)))
    folder = files(entries[collection].load())
    path = folder / f"{network}.safetensors"
    if not path.is_file():
        names = sorted(str(file.name).removesuffix(".safetensors") for file in folder.iterdir() if _is_weights(file))
        raise FileError(f"weights {collection!r} are of {', '.join(names)}, got refiner {network or 'file'!r}")
    return str(path)


def _is_weights(file: Any) -> bool:
    return str(file.name).endswith(".safetensors")


def shipped(network: str) -> WeightFile:
    """Return the weights of a network that come with the package.

    Raises
    ------
    FileError
        If none do.
    """
    path = files("stereokit_refiners") / "weights" / f"{network}.safetensors"
    if not path.is_file():
        raise FileError(
            f"refiner {network!r} needs weights: 'kitti', after pip install ./refiners/kitti in a checkout (not for "
            f"commercial use), or a file of `stereokit train --refiner {network}`"
        )
    return read(str(path))


def _check_disparities(path: str, notes: Mapping[str, Any]) -> None:
    """Raise FileError unless the disparities of the training, if the notes have them, are two numbers in order."""
    ends = notes.get("disparities", _DISPARITIES)
    numbers = isinstance(ends, (list, tuple)) and len(ends) == 2 and all(type(x) in (int, float) for x in ends)
    if not numbers or not -math.inf < ends[0] < ends[1] < math.inf:
        raise FileError(f"disparities in notes must be two numbers, the smaller first, got {ends!r} in {path!r}")


def _check(
    path: str, name: str, mode: str, arrays: Mapping[str, NDArray[Any]], ranges: Mapping[str, list[float]]
) -> None:
    """Raise FileError unless all of it fits the architecture."""
    network = network_named(name)
    try:
        check_output_mode(network, mode)
    except OptionError as error:
        raise FileError(f"{error} in {path!r}") from None
    wanted = shapes(network)
    missing, unknown = sorted(set(wanted) - set(arrays)), sorted(set(arrays) - set(wanted))
    if missing or unknown:
        what = f"lacks {missing[0]!r}" if missing else f"has an unknown {unknown[0]!r}"
        raise FileError(f"weights must be those of {name!r}, but {path!r} {what}")
    for key, shape in wanted.items():
        if arrays[key].shape != shape or arrays[key].dtype != np.float32:
            present = f"{arrays[key].dtype} {arrays[key].shape}"
            rule = f"weights must hold {key!r} as float32 {shape} in this version of {name!r}"
            raise FileError(f"{rule}, got {present} in {path!r}")
        if not np.isfinite(arrays[key]).all():
            raise FileError(f"weights must be finite, but {key!r} in {path!r} is not")
    channels = activations(network)
    for key, bounds in ranges.items():
        if key not in channels:
            raise FileError(f"ranges must be of activations of {name!r}, got {key!r} in {path!r}")
        if len(bounds) != channels[key] or not all(math.isfinite(b) and b >= 0 for b in bounds):
            rule = f"{channels[key]} finite numbers of at least 0"
            raise FileError(f"range of {key!r} must be {rule}, got {len(bounds)}: {bounds} in {path!r}")
