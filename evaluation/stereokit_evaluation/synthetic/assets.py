"""Photographs and models of a folder, for scenes: `read_assets` checks them once, and keeps what scenes read of them.

A scene that is drawn with assets depends on its seed and on `Assets.digest` alone: the names and the contents of all
photographs, models and files that models may name.
"""

from __future__ import annotations

import hashlib
import json
import posixpath
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, OptionError
from stereokit.io import make_folder, parsing, read_bytes, read_image, write_bytes
from stereokit.notices import say, warn
from stereokit_evaluation.common.fingerprint import fingerprint
from stereokit_evaluation.synthetic import models
from stereokit_evaluation.synthetic.models import MODEL_SUFFIXES, Model, import_trimesh, pack, read_model, unpack

__all__ = ["MANIFEST", "Assets", "check_assets", "read_assets"]

Bytes = NDArray[np.uint8]

MANIFEST = "manifest.json"
"""File that names the licence of each asset, in the folder or below: ``{"files": [{"file": ..., "licence": ...}]}``."""

_PHOTOGRAPHS = (".png", ".jpg", ".jpeg")
_PARTS = (".mtl", ".bin")  # other files that models name
_LEAST = 128  # pixels of a photograph's shorter side
_MOST = 768  # to which a larger one is reduced
_TONES = 4.0  # standard deviation of grey levels; a picture of one tone is no texture


@dataclass(frozen=True, eq=False)
class Assets:
    """Photographs and models that scenes may use.

    Attributes
    ----------
    photographs, models : tuple of str
        Their names: paths in the folder, sorted.
    digest : str
        Of all names and contents, 12 hexadecimal digits.
    licences : dict
        How many of them have which licence, by the manifests in the folder.
    """

    photographs: tuple[str, ...]
    models: tuple[str, ...]
    digest: str
    licences: dict[str, int]
    _files: dict[str, Path] = field(repr=False)

    def photograph(self, number: int) -> Bytes:
        """Return a photograph, (H, W) or (H, W, 3) uint8, RGB, reduced to 768 pixels; read-only."""
        return _photograph(self._files[self.photographs[number]])

    def model(self, number: int) -> Model:
        """Return a model."""
        return _model(self._files[self.models[number]])

    @property
    def notes(self) -> dict[str, Any]:
        """The entry of a weight file's notes."""
        return {
            "digest": self.digest,
            "photographs": len(self.photographs),
            "models": len(self.models),
            "licences": dict(sorted(self.licences.items())),
        }


@lru_cache(maxsize=64)
def _photograph(path: Path) -> Bytes:
    image: Bytes = np.ascontiguousarray(read_image(path), np.uint8)
    image.setflags(write=False)
    return image


@lru_cache(maxsize=128)
def _model(path: Path) -> Model:
    with parsing(path, "model", "cache must hold models of this program"), np.load(path) as arrays:
        return unpack(arrays)


def check_assets(folder: Path) -> None:
    """Refuse assets that are no folder, or one in which no name is that of a photograph or a model.

    Raises
    ------
    OptionError
    """
    if not folder.is_dir():
        raise OptionError(f"assets must be a folder, got {str(folder)!r}")
    if not any(_suffix(path.name) in (*_PHOTOGRAPHS, *MODEL_SUFFIXES) for path in folder.rglob("*")):
        raise OptionError(_none_in(folder))


def read_assets(folder: Path, cache: Path, step: Callable[[str], object] | None = None) -> Assets:
    """Read the photographs and models of a folder and below; what cannot be used is left out with a warning each.

    Parameters
    ----------
    folder : Path
        Has photographs (PNG, JPEG: those of at least 128 pixels that are not of one tone), models (OBJ with MTL and
        pictures, GLB, glTF), and manifests. Hidden files are not looked at.
    cache : Path
        Folder of what scenes read: reduced photographs, simplified models. A file is read again only if it, or one
        that it names, changed.
    step : callable, optional
        Called with the name of each file that was read.

    Returns
    -------
    Assets

    Raises
    ------
    OptionError, FileError
        If the folder is none, or has nothing that can be used.
    StereokitError
        If there are models, and trimesh is not installed.
    """
    folder, cache = Path(folder), Path(cache)
    check_assets(folder)
    make_folder("cache", cache)
    contents = _digests(folder)
    if any(_suffix(name) in MODEL_SUFFIXES for name in contents):
        import_trimesh()
    code = fingerprint([Path(models.__file__)])
    files: dict[str, Path] = {}
    small = 0
    for name in contents:
        suffix = _suffix(name)
        try:
            if suffix in _PHOTOGRAPHS:
                path = _stored_photograph(folder, name, contents, cache)
                small += path is None
            elif suffix in MODEL_SUFFIXES:
                path = _stored_model(folder, name, contents, cache, code)
            else:
                continue
        except FileError as error:
            warn(f"assets: left out: {error}")
            continue
        finally:
            if step is not None:
                step(name)
        if path is not None:
            files[name] = path
    photographs = tuple(name for name in files if _suffix(name) in _PHOTOGRAPHS)
    shapes = tuple(name for name in files if _suffix(name) in MODEL_SUFFIXES)
    if not files:
        raise OptionError(_none_in(folder))
    others = f"; {small} pictures are too small or of one tone, and are no textures" if small else ""
    say(f"assets: {len(photographs)} photographs, {len(shapes)} models{others}")
    digest = hashlib.sha256(json.dumps(sorted(contents.items())).encode()).hexdigest()[:12]
    terms = _terms(folder)
    return Assets(photographs, shapes, digest, dict(Counter(terms.get(name, "not stated") for name in files)), files)


def _none_in(folder: Path) -> str:
    return (
        f"assets must hold photographs (PNG, JPEG, {_LEAST} pixels and up) or models (OBJ, GLB, glTF) that can be "
        f"read, got none in {str(folder)!r}"
    )


def _suffix(name: str) -> str:
    return posixpath.splitext(name)[1].lower()


def _digests(folder: Path) -> dict[str, str]:
    """Return a digest of the content of each file that matters, by its path in the folder, sorted."""
    digests = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if _suffix(name) not in (*_PHOTOGRAPHS, *MODEL_SUFFIXES, *_PARTS) or not path.is_file():
            continue
        if any(part.startswith(".") for part in name.split("/")):
            continue
        try:
            digests[name] = hashlib.sha256(read_bytes(path)).hexdigest()
        except FileError as error:
            warn(f"assets: left out: {error}")
    return digests


def _stored_photograph(folder: Path, name: str, contents: dict[str, str], cache: Path) -> Path | None:
    """Return the file of a photograph in the cache, None if it is no texture; make it if it is not there."""
    stem = f"photograph-{contents[name][:16]}-{_LEAST}-{_MOST}-{_TONES:g}"
    path, none = cache / f"{stem}.png", cache / f"{stem}.none"
    if none.exists():
        return None
    if not path.exists():
        image = read_image(folder / name)
        if image.dtype != np.uint8:
            image = (image / 257).astype(np.uint8)  # a PNG has 8 or 16 bits
        least = min(image.shape[:2])
        if least < _LEAST or float(image.std(axis=(0, 1)).max()) < _TONES:
            write_bytes(none, b"")
            return None
        if least > _MOST:
            size = [max(1, round(side * _MOST / least)) for side in image.shape[1::-1]]
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        shown = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        write_bytes(path, cv2.imencode(".png", shown)[1].tobytes())
    return path


def _stored_model(folder: Path, name: str, contents: dict[str, str], cache: Path, code: str) -> Path:
    """Return the file of a model in the cache; make it if it is not there, or if a file that it names changed.

    Raises
    ------
    FileError
        If it cannot be used.
    """
    stem = hashlib.sha256(f"{name} {contents[name]}".encode()).hexdigest()[:16]
    needs_path = cache / f"model-{stem}-{code}.json"
    if needs_path.exists():
        with parsing(needs_path, "list of files", "cache must hold models of this program"):
            stored = json.loads(needs_path.read_bytes())
            if all(contents.get(part) == digest for part, digest in stored["needs"].items()):
                if stored["fault"]:
                    raise FileError(stored["fault"])
                path = cache / str(stored["file"])
                if path.exists():
                    return path
    needs: dict[str, str | None] = {}

    def fetch(key: str) -> bytes:
        part = posixpath.normpath(posixpath.join(posixpath.dirname(name), key.replace("\\", "/")))
        needs[part] = contents.get(part)
        if part not in contents:  # elsewhere, of another type, or missing
            raise KeyError(key)
        return read_bytes(folder / part)

    fault, file = "", ""
    try:
        with parsing(folder / name, "model"):
            content = pack(read_model(name, read_bytes(folder / name), fetch))
    except FileError as error:
        if isinstance(error.__cause__ or error.__context__, (ImportError, MemoryError)):
            raise  # of this machine, not of the file
        fault = str(error)
    else:
        file = f"model-{hashlib.sha256(content).hexdigest()[:16]}.npz"
        write_bytes(cache / file, content)
    write_bytes(needs_path, json.dumps({"needs": needs, "file": file, "fault": fault}).encode())
    if fault:
        raise FileError(fault)
    return cache / file


def _terms(folder: Path) -> dict[str, str]:
    """Return the licence of each file by its path in the folder, as the manifests have it."""
    terms = {}
    for path in sorted(folder.rglob(MANIFEST)):
        base = path.parent.relative_to(folder)
        with parsing(path, "manifest", f"{MANIFEST} must be {{'files': [{{'file': ..., 'licence': ...}}]}}"):
            for entry in json.loads(path.read_bytes())["files"]:
                terms[(base / entry["file"]).as_posix()] = str(entry["licence"])
    return terms
