"""Training of the general refiner, on generated pairs, on frames with ground truth, or on both.

Every pair and every sample (`stereokit_refiners.training.evidence`) is a file of the cache folder, so that the same
command goes on where it was killed. Held-out frames are scored by the refiner itself, at half size.
"""

from __future__ import annotations

import os
import sys
import zlib
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import stereokit
from stereokit.cli.options import parse_settings
from stereokit.errors import OptionError
from stereokit.images.check import check_integer, check_number
from stereokit.io import make_folder, write_bytes
from stereokit.notices import collecting
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.synthetic.assets import Assets
from stereokit_evaluation.synthetic.generated import pair_name, pairs
from stereokit_evaluation.training.generated import stored_assets
from stereokit_evaluation.training.pairs import FIRST_SEED, pair_of
from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.weights import WeightFile, read

__all__ = ["GENERAL", "RealFrames", "train_general"]

GENERAL = ("stereokit", "general")
"""Names of the refiner that is trained here."""

_SAMPLES = 5  # of each generated pair: matchers, sizes, options and cameras, drawn from its name
_SETTINGS: dict[str, Any] = {
    "steps": 30000, "learning_rate": 2e-3, "batch": 4, "seed": 0, "rows": 256, "columns": 384, "loss": "general",
}  # fmt: skip


@dataclass(frozen=True)
class RealFrames:
    """Frames with ground truth to train on.

    Parameters
    ----------
    groups : sequence of (list of Frame, list of Frame)
        Frames to train on and frames to hold out, once for each training.
    dataset : str
        What `groups` are of.
    extra : mapping of str to Frame
        More frames to train on by ``DATASET/NAME``, never held out.
    methods : sequence of str
        Matchers.
    variants : int
        Samples of each frame and matcher.
    max_disparity : int
        Of the matchers, full-size pixels.
    extra_share, generated_share : float
        Shares of the steps on extra frames and on generated pairs.
    folds : bool
        Whether each group has a folder of its own.
    """

    groups: Sequence[tuple[Sequence[Frame], Sequence[Frame]]] = (((), ()),)
    dataset: str | None = None
    extra: Mapping[str, Frame] = field(default_factory=dict)
    methods: Sequence[str] = ("S1", "S2", "S3", "S4")
    variants: int = 9
    max_disparity: int = 128
    extra_share: float = 0.2
    generated_share: float = 0.5
    folds: bool = False

    @property
    def training(self) -> dict[str, Frame]:
        """All frames to train on, by ``DATASET/NAME``."""
        frames = {f"{self.dataset}/{frame.name}": frame for training, _ in self.groups for frame in training}
        return {**frames, **self.extra}


def train_general(
    output: Path, count: int, real: RealFrames | None = None, *, start: Path | None = None,
    settings: Sequence[str] = (), cache: Path | None = None, assets: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Train the general refiner; killed, it goes on when called again with the same options.

    Parameters
    ----------
    output : Path
        Folder of ``weights.safetensors`` and its checkpoint; made if missing.
    count : int
        Pairs to render and train on.
    real : RealFrames, optional
        Frames to train on.
    start : Path, optional
        Weight file to begin with.
    settings : sequence of str
        ``KEY=VALUE``: steps, learning_rate, batch, seed, rows and columns of the crops, full-size pixels, and loss, one
        of `stereokit_refiners.training.evidence.LOSSES`.
    cache : Path, optional
        Folder of pairs and samples; by default ``output/cache``.
    assets : Path, optional
        Folder of photographs and models for the generated scenes.

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
    real = RealFrames() if real is None else real
    if start is not None and (network := read(start).network) != "evidence":
        raise OptionError(f"start must hold weights of {GENERAL[0]!r}, got those of {network!r}")
    cache = output / "cache" if cache is None else cache
    for name, folder in (("output", output), ("cache", cache)):
        make_folder(name, folder)
    shown = stored_assets(assets, cache)
    generated = _generated_samples(count, cache, shown) if count else None
    stored = _frame_samples(real, cache / "frames")
    results = []
    for number, (training, held_out) in enumerate(real.groups):
        own = [path for frame in training for path in stored[f"{real.dataset}/{frame.name}"]]
        extra = [path for name in real.extra for path in stored[name]]
        generated_part = (real.generated_share if own or extra else 1.0) if generated else 0.0
        extra_part = (real.extra_share if own else 1 - generated_part) if extra else 0.0
        parts = ((generated, generated_part), (own, 1 - generated_part - extra_part), (extra, extra_part))
        sources = [evidence.Source(samples, share) for samples, share in parts if samples and share > 0]
        folder = output / f"fold-{number}" if real.folds else output
        make_folder("output", folder)
        notes = {
            "frames": sorted([*(f"{real.dataset}/{frame.name}" for frame in training), *real.extra]),
            "generated": count, "first_seed": FIRST_SEED, "settings": chosen,
            "start": None if start is None else read(start).fingerprint,
            **({} if shown is None else {"assets": shown.notes}),
        }  # fmt: skip
        with redirect_stdout(sys.stderr):  # what it reports on the way is no result
            content = evidence.fit(
                sources, folder / "weights.safetensors", steps=chosen["steps"], rate=chosen["learning_rate"],
                batch=chosen["batch"], seed=chosen["seed"], start=start, objective=chosen["loss"], notes=notes,
                size=(chosen["rows"] // 4, chosen["columns"] // 4),
            )  # fmt: skip
        counts = _score(content, held_out, real) if held_out else {}
        results.append({"folder": str(folder), "held_out": [frame.name for frame in held_out], "bad_and_known": counts})
    return {
        "refiner": GENERAL[0], "settings": chosen, "methods": list(real.methods), "generated": count,
        "assets": None if shown is None else shown.notes,
        "frames": sorted(real.training), "results": results, "rank": 0,
    }  # fmt: skip


def _generated_samples(count: int, cache: Path, assets: Assets | None, each: int | None = None) -> Path:
    """Render what is missing of the pairs, and of their samples; return the folder of the samples."""
    from stereokit_refiners.training import evidence

    each = _SAMPLES if each is None else each
    with progress(count * (1 + each)) as (_, step):
        rendered = cache / "pairs"
        for pair in pairs(count, FIRST_SEED, folder=rendered, assets=assets):
            step(f"{pair.kind} {pair.seed}")
        exact, samples = _exactly(rendered, count, cache, assets)
        for number in range(each):
            evidence._store(exact, samples, number + 1)
            step(f"samples {number + 1} of each pair", count)
    return samples


def _frame_samples(real: RealFrames, folder: Path) -> dict[str, list[Path]]:
    """Make what is missing of the samples of all frames to train on; return their files by frame.

    They are the same for every seed of the training, as those of generated pairs are.
    """
    from stereokit_refiners.training.frames import store_frame

    frames, stored = real.training, {}
    with progress(len(frames) * len(real.methods) * real.variants) as (_, step):
        for name, frame in frames.items():
            pair, paths = pair_of(frame), []
            for method in real.methods:
                for number in range(real.variants):
                    paths.append(store_frame(pair, method, 0, number, real.max_disparity, folder))
                    step(f"{name} {method}")
            stored[name] = paths
    return stored


def _score(content: WeightFile, frames: Sequence[Frame], real: RealFrames) -> dict[str, list[int]]:
    """Return how many known pixels are wrong by over 3 pixels and 5 %, and how many are known, by matcher.

    Half size, fp32. What both cameras see counts.
    """
    refiner = LearnedRefiner.of(content, backend="torch", precision="fp32")
    counts = {method: [0, 0] for method in real.methods}
    with progress(len(frames) * len(real.methods)) as (_, step), collecting():
        for frame in frames:
            pair = pair_of(frame)
            known = np.isfinite(pair.noc)
            for method, count in counts.items():
                match = stereokit.Matcher(method, max_disparity=real.max_disparity, scale=0.5, refiner=refiner)
                error = np.abs(match(pair.left, pair.right).disparity - pair.noc)
                right = (error <= 3) | (error <= np.float32(0.05) * pair.noc)
                count[0] += int(np.count_nonzero(known & ~right))
                count[1] += int(np.count_nonzero(known))
                step(f"score {frame.name} {method}")
    return counts


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
        write_bytes(target, source.read_bytes())


def _settings(texts: Sequence[str]) -> dict[str, Any]:
    from stereokit_refiners.training.evidence import LOSSES

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
    if chosen["loss"] not in LOSSES:
        raise OptionError(f"loss must be one of {', '.join(LOSSES)} for the general refiner, got {chosen['loss']!r}")
    return chosen
