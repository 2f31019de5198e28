"""Training on generated pairs: rendered from seeds, matched, and taken up where a killed run ended.

Every pair is a file of the cache folder, and so is every coarse map, so that the same command goes on with what is
missing. The general refiner has samples and a loop of its own (`stereokit_refiners.training.evidence`).
"""

from __future__ import annotations

import math
import os
import shutil
import sys
import zlib
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from stereokit.cli.options import parse_settings
from stereokit.errors import OptionError
from stereokit.images.check import check_integer, check_number
from stereokit.io import make_folder
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.synthetic.assets import Assets, read_assets
from stereokit_evaluation.synthetic.generated import pair_name, pairs
from stereokit_evaluation.training.pairs import FIRST_SEED
from stereokit_refiners.training.samples import Pair

__all__ = ["GENERAL", "generated_pairs", "levels_for", "stored_assets", "train_general"]

GENERAL = ("stereokit", "general")
"""Names of the refiner that trains on generated pairs alone."""

_SAMPLES = 5  # of each pair: matchers, sizes, options and cameras, drawn from its name
_SETTINGS = {"steps": 30000, "learning_rate": 2e-3, "batch": 4, "seed": 0, "rows": 256, "columns": 384}


def stored_assets(folder: Path | None, cache: Path) -> Assets | None:
    """Read the folder of assets, if there is one; what scenes read of it is stored in ``cache/assets``.

    Raises
    ------
    OptionError, FileError, StereokitError
        As `read_assets`.
    """
    if folder is None:
        return None
    with progress(None) as (_, step):
        return read_assets(folder, cache / "assets", step)


def generated_pairs(count: int, folder: Path, assets: Assets | None = None) -> Iterator[Pair]:
    """Yield generated pairs as pairs for training; each is rendered once and stored in a folder.

    Parameters
    ----------
    count : int
        How many; seeds start at `stereokit_evaluation.training.pairs.FIRST_SEED`.
    folder : Path
    assets : Assets, optional
        Photographs and models for the scenes.
    """
    for pair in pairs(count, FIRST_SEED, folder=folder, assets=assets):
        yield Pair(f"{pair.kind}-{pair.seed}", pair.left, pair.right, pair.noc, pair.occ)


def levels_for(pair: Pair) -> int:
    """Return the disparities to search for a pair: a multiple of 32 that holds its largest, pixels."""
    return math.ceil((float(np.nanmax(pair.occ, initial=0)) + 8) / 32) * 32


def train_general(
    output: Path,
    count: int,
    *,
    start: Path | None = None,
    settings: Sequence[str] = (),
    cache: Path | None = None,
    assets: Path | None = None,
) -> dict[str, Any]:
    """Train the general refiner; killed, it goes on when called again with the same options.

    Parameters
    ----------
    output : Path
        Folder of ``weights.safetensors`` and its checkpoint; made if missing.
    count : int
        Pairs to render and train on.
    start : Path, optional
        Weight file to begin with.
    settings : sequence of str
        ``KEY=VALUE``: steps, learning_rate, batch, seed, and rows and columns of the crops, full-size pixels.
    cache : Path, optional
        Folder of pairs and samples; by default ``output/cache``.
    assets : Path, optional
        Folder of photographs and models for the scenes.

    Returns
    -------
    dict
        As of `stereokit_evaluation.training.run.run_training`.

    Raises
    ------
    OptionError, FileError
        If an option breaks its rule, or a file cannot be used.
    """
    from stereokit_refiners.training import evidence

    chosen = _settings(settings)
    cache = output / "cache" if cache is None else cache
    for name, folder in (("output", output), ("cache", cache)):
        make_folder(name, folder)
    own = stored_assets(assets, cache)
    with progress(count * (1 + _SAMPLES)) as (_, step):
        rendered = cache / "pairs"
        for pair in pairs(count, FIRST_SEED, folder=rendered, assets=own):
            step(f"{pair.kind} {pair.seed}")
        exact, samples = _exactly(rendered, count, cache, own)
        for number in range(_SAMPLES):
            evidence._store(exact, samples, number + 1)
            step(f"samples {number + 1} of each pair", count)
    weights = output / "weights.safetensors"
    notes: dict[str, Any] = {"generated": count, "first_seed": FIRST_SEED, "settings": chosen}
    if own is not None:
        notes["assets"] = own.notes
    with redirect_stdout(sys.stderr):  # what it reports on the way is no result
        evidence.fit(
            samples, weights, steps=chosen["steps"], rate=chosen["learning_rate"], batch=chosen["batch"],
            seed=chosen["seed"], start=start, size=(chosen["rows"] // 4, chosen["columns"] // 4), notes=notes,
        )  # fmt: skip
    return {
        "refiner": GENERAL[0], "settings": chosen, "methods": ["S1", "S2", "S3", "S4"], "generated": count,
        "assets": None if own is None else own.notes,
        "frames": [], "results": [{"folder": str(output), "held_out": []}], "pooled": {}, "rank": 0,
    }  # fmt: skip


def _exactly(rendered: Path, count: int, cache: Path, assets: Assets | None = None) -> tuple[Path, Path]:
    """Return a folder that holds these pairs and no others, and one for their samples."""
    chosen = sorted(rendered / pair_name(seed, assets=assets) for seed in range(FIRST_SEED, FIRST_SEED + count))
    key = f"{zlib.crc32('/'.join(path.name for path in chosen).encode()):08x}"
    exact, samples = cache / f"pairs-{key}", cache / f"samples-{key}"
    for folder in (exact, samples):
        make_folder("cache", folder)
    for path in chosen:
        _link(path, exact / path.name)
    return exact, samples


def _link(source: Path, target: Path) -> None:
    if target.exists():
        return
    try:
        os.link(source, target)
    except OSError:  # a file system without links
        shutil.copyfile(source, target)


def _settings(texts: Sequence[str]) -> dict[str, Any]:
    options = parse_settings(texts, frozenset())
    for name in options:
        if name not in _SETTINGS:
            raise OptionError(f"no setting named {name!r} of the general refiner. Known: {', '.join(_SETTINGS)}")
    chosen = {**_SETTINGS, **options}
    for name in ("steps", "batch", "rows", "columns"):
        chosen[name] = check_integer(name, chosen[name], 1)
    chosen["seed"] = check_integer("seed", chosen["seed"], 0)
    chosen["learning_rate"] = check_number("learning_rate", chosen["learning_rate"], 0, 10)
    for name in ("rows", "columns"):
        if chosen[name] % 32:
            raise OptionError(f"{name} must be a multiple of 32 for the general refiner, got {chosen[name]}")
    return chosen
