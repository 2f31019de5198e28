"""Generated pairs to train on: rendered from seeds, each a file, so that a killed run goes on with what is missing."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.synthetic.assets import Assets, read_assets
from stereokit_evaluation.synthetic.generated import pairs
from stereokit_evaluation.training.pairs import FIRST_SEED
from stereokit_refiners.training.samples import Pair

__all__ = ["generated_pairs", "levels_for", "stored_assets"]


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
