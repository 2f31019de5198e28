"""Results of the study on disk, one small file for each frame and configuration: a run goes on where it ended.

A result is filed under a digest of all that it depends on: the content of the images and of the ground truth, the
resolved options of the matcher, the refiner's weights, the source of the packages, and what its times depend on
(threads, repeats, processor). So nothing stale is ever read, a changed option recomputes only the configurations
that it touches, and going back to earlier options costs nothing. Files are written whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stereokit.errors import FileError
from stereokit.io import parsing, read_bytes, write_bytes
from stereokit_evaluation.common.folders import make_folder
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.scoring.assessment import Official
from stereokit_evaluation.scoring.kitti import Counts, Regions, Score, Tally
from stereokit_evaluation.scoring.measures import SETS, Errors, Measures

__all__ = ["Record", "Store", "digest", "frame_digest"]

_FORMAT = 2


@dataclass(frozen=True)
class Record:
    """The stored result of one configuration on one frame.

    Attributes
    ----------
    score : Score
        The counts.
    ms : dict of str to float
        Median milliseconds: ``"total"`` and, where known, by group of stages; empty if nothing was timed.
    measures : Measures
        Further figures, by set of pixels.
    official : mapping or None
        By the rules of the frame's benchmark.
    """

    score: Score
    ms: dict[str, float]
    measures: Measures = field(default_factory=Measures)
    official: Official | None = None


class Store:
    """A folder of records; with None it stores nothing.

    Parameters
    ----------
    folder : Path or None
        Created at the first record.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def get(self, path: str, key: str) -> Record | None:
        """Return the record filed under `path` and `key`, None if there is none that can be read.

        Parameters
        ----------
        path : str
            The readable part of the name: matcher, variant and frame, such as ``"S4/original/000000_10"``.
        key : str
            The digest of what the record depends on.
        """
        if self.folder is None:
            return None
        try:
            file = self._file(path, key)
            with parsing(file, "record"):
                content = json.loads(read_bytes(file))
                ms = {str(name): float(value) for name, value in content["ms"].items()}
                return Record(_score(content["score"]), ms, _measures(content["measures"]), content["official"])
        except FileError:
            return None

    def put(self, path: str, key: str, record: Record, about: Mapping[str, Any]) -> None:
        """Write a record, and with it `about`, the plain content of the key.

        Raises
        ------
        FileError
            If the folder cannot be written to.
        """
        if self.folder is None:
            return
        file = self._file(path, key)
        make_folder(file.parent)
        content = {**asdict(record), "key": key, "about": about}
        write_bytes(file, json.dumps(content, default=str).encode())

    def _file(self, path: str, key: str) -> Path:
        assert self.folder is not None
        *parts, frame = path.split("/", 2)
        safe = [re.sub(r"[^A-Za-z0-9+_.@-]", "_", part).lstrip(".") for part in (*parts, frame)]
        return Path(self.folder, *safe[:-1], f"{safe[-1]}-{key[:20]}.json")


def digest(content: Any) -> str:
    """Return the SHA-256 of a JSON value, as hexadecimal digits."""
    text = json.dumps([_FORMAT, content], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def frame_digest(frame: Frame) -> str:
    """Return the SHA-256 of a frame's content: its images and its ground truth.

    Files are read without decoding; functions are called, and their arrays are read.

    Raises
    ------
    FileError
        If a file cannot be read.
    """
    hasher = hashlib.sha256()
    for name in ("left", "right", "noc", "occ", "objects"):
        hasher.update(f"\\0{name}\\0".encode())
        _feed(hasher, getattr(frame, name))
    return hasher.hexdigest()


def _feed(hasher: Any, source: Any) -> None:
    """Add a source's content: a file's bytes, the parts of a partial function, an array."""
    if isinstance(source, Path):
        hasher.update(hashlib.sha256(read_bytes(source)).digest())
    elif isinstance(source, partial):
        hasher.update(source.func.__qualname__.encode())
        for part in (*source.args, *source.keywords.values()):
            _feed(hasher, part)
    elif callable(source):
        array = np.ascontiguousarray(source())
        hasher.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    else:
        hasher.update(repr(source).encode())


def _measures(content: Mapping[str, Any]) -> Measures:
    def errors(part: Mapping[str, Any]) -> Errors:
        pixels, measured, outliers, pairs = (int(part[name]) for name in ("pixels", "measured", "outliers", "pairs"))
        quantiles, bad = (tuple(float(value) for value in part["quantile_sums"]), tuple(int(n) for n in part["bad"]))
        sums = float(part["error_sum"]), float(part["square_sum"])
        return Errors(pixels, measured, outliers, bad, *sums, pairs, quantiles)

    return Measures(**{name: errors(content[name]) for name in SETS})


def _score(content: Mapping[str, Any]) -> Score:
    def tally(part: Mapping[str, Any]) -> Tally:
        bad = tuple(int(count) for count in part["bad"])
        return Tally(int(part["pixels"]), int(part["outliers"]), bad, float(part["error_sum"]))

    def regions(part: Mapping[str, Any]) -> Regions:
        return Regions(**{n: Counts(tally(part[n]["filled"]), tally(part[n]["measured"])) for n in ("all", "bg", "fg")})

    return Score(regions(content["noc"]), regions(content["occ"]))
