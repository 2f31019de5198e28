"""A training from its data to its weights, for ``stereokit train`` and the study.

The result is a folder with ``weights.safetensors``, ``curves.csv``, ``curves.png``, and a checkpoint. A killed run
resumes from the checkpoint when it is called again with the same options. With `folds` each group of frames is held
out once.
"""

from __future__ import annotations

import io
import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from stereokit.cli.options import parse_settings
from stereokit.errors import InputError, OptionError, StereokitError
from stereokit.images.check import check_integer
from stereokit.io import make_folder, write_bytes
from stereokit.methods import check_levels, parse_method
from stereokit_evaluation.common.progress import progress
from stereokit_evaluation.data.datasets import load_frames, select_frames
from stereokit_evaluation.data.frame import Frame
from stereokit_evaluation.synthetic.assets import check_assets
from stereokit_evaluation.training.general import GENERAL, RealFrames, train_general
from stereokit_evaluation.training.generated import generated_pairs, levels_for, stored_assets
from stereokit_evaluation.training.pairs import FIRST_SEED, pair_of, scene_pair

__all__ = ["run_training"]

_MATCHERS = ("S1", "S2", "S3", "S4")


def run_training(
    output: Path, refiner: str = "stereovae", *, dataset: str | None = None, root: Path | None = None,
    frames: str | None = None, validation: str | None = None, folds: str | None = None, extra: Sequence[str] = (),
    extra_share: float = 0.2, streets: int = 0, generated: int = 0, street_share: float = 0.5,
    method: Sequence[str] = _MATCHERS, variants: int = 9, start: Path | None = None, preset: str = "default",
    settings: Sequence[str] = (), max_disparity: int = 128, cache: Path | None = None, assets: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Train a refiner; after a kill, the same call resumes from the checkpoint.

    Parameters
    ----------
    output : Path
        Folder of the result; created if missing.
    refiner : str
        Architecture, one of `stereokit_refiners.weights.NETWORKS`, or ``"stereokit"``, the general refiner.
    dataset, root : str, Path, optional
        A data set and its folder.
    frames, validation, folds : str, optional
        Frames to train on, to validate on, and groups to hold out in turn (``0-3/13-17``).
    extra : sequence of str
        More frames to train on, ``DATASET:ROOT``, never held out; `extra_share` of the crops.
    streets : int
        Synthetic streets to train on; `street_share` of the crops.
    generated : int
        Generated pairs of all kinds to train on, as streets are.
    method : sequence of str
        Matchers whose maps are trained on; the general refiner draws those of generated pairs itself.
    variants : int
        Variants of each frame and matcher.
    start : Path, optional
        Weights to begin with.
    preset, settings : str, sequence of str
        Settings of `stereokit_refiners.training.settings`, ``KEY=VALUE``.
    max_disparity : int
        Disparities of the matchers, full-size pixels.
    cache : Path, optional
        Folder of coarse maps; by default ``output/cache``.
    assets : Path, optional
        Folder of photographs and models that generated pairs may show.

    Returns
    -------
    dict
        The refiner, its settings and frames, and the scores of held-out frames; ``"rank"`` is this process' number.

    Raises
    ------
    OptionError, InputError, FileError, StereokitError
        If an option breaks its rule, frames have no ground truth, files cannot be used, or torch is not installed.
    """
    torch = _torch()
    general = refiner in GENERAL
    check_integer("generated", generated, 0)
    if general and streets:
        raise OptionError(f"streets must be 0 for refiner {refiner!r}, whose generated pairs hold some, got {streets}")
    if general and preset != "default":
        raise OptionError(f"preset must be default for refiner {refiner!r}, got {preset!r}")
    if assets is not None:
        if generated < 1:
            raise OptionError(f"assets must come with generated pairs, got {str(assets)!r} and none of them")
        check_assets(assets)
    from stereokit_refiners.networks.layers import output_rule
    from stereokit_refiners.training.loop import Source
    from stereokit_refiners.training.samples import SampleFiles, store_variant
    from stereokit_refiners.weights import NETWORKS, read

    training_settings: Any = None if general else _training_settings(preset, settings)
    if not general and refiner not in NETWORKS:
        raise OptionError(f"refiner to train must be one of {', '.join(NETWORKS)}, got {refiner!r}")
    if dataset is None and streets < 1 and generated < 1 and not extra:
        raise OptionError("dataset, extra, streets or generated must be set, got none of them")
    if folds is not None and (dataset is None or validation is not None):
        raise OptionError(f"folds must come with a dataset and without validation, got {folds!r}")
    if not (0 <= extra_share and 0 <= street_share and extra_share + street_share <= 1) or streets < 0 or variants < 1:
        raise OptionError(
            "street_share and extra_share must be at least 0 and together at most 1, streets at least 0 and variants "
            f"at least 1, got {street_share:g}, {extra_share:g}, {streets} and {variants}"
        )
    content = None if start is None else read(start)
    if content is not None and not general and content.network != refiner:
        raise OptionError(f"start must hold weights of {refiner!r}, got those of {content.network!r}")
    methods = list(method)
    for name in methods:
        parse_method(name)
    check_levels(0, max_disparity)
    if not general:
        output_rule(NETWORKS[refiner], training_settings.output_mode)
    all_frames = [] if dataset is None else list(load_frames(dataset, root))
    groups = _groups(all_frames, frames, validation, folds)
    extra_frames = _extra(extra)
    test_names = {f"{dataset}/{frame.name}" for _, part in groups for frame in part}
    if shared := sorted(test_names & extra_frames.keys()):
        raise OptionError(f"extra must not bring frames that are held out, got {shared[0]!r}")
    if dataset is not None and not all(training for training, _ in groups):
        raise OptionError("frames must leave some to train on that are not held out, got none")
    for frame in (*extra_frames.values(), *(f for pair in groups for part in pair for f in part)):
        if frame.noc is None and frame.occ is None:
            raise InputError(f"frame {frame.name} has no ground truth to train on")
    if general:
        real = RealFrames(
            groups, dataset, extra_frames, methods, variants, max_disparity, extra_share, street_share,
            folds=folds is not None,
        )  # fmt: skip
        document = train_general(output, generated, real, start=start, settings=settings, cache=cache, assets=assets)
        return document | {"streets": 0, "pooled": _pooled(document["results"], methods)}
    if cache is not None:
        make_folder("cache", cache)
    make_folder("output", output)
    cache_folder = output / "cache" if cache is None else cache
    own = stored_assets(assets, cache_folder)
    world = _join_group(torch)

    def stored(frame: Frame, numbers: range, step: Callable[..., None]) -> list[Path]:
        pair = pair_of(frame)
        paths = []
        for name in methods:
            for number in numbers:
                paths.append(store_variant(pair, name, training_settings.seed, number, max_disparity, cache_folder))
                step(f"{frame.name} {name}")
        return paths

    def stored_streets(step: Callable[..., None]) -> list[Path]:
        paths = []
        for k in range(streets):
            pair = scene_pair(FIRST_SEED + k, cache_folder)
            for n in (0, 1):
                name = methods[(k + 2 * n) % len(methods)]
                paths.append(store_variant(pair, name, training_settings.seed, n + 1, max_disparity, cache_folder))
                step(pair.name)
        return paths

    searched = [max_disparity]  # by samples of whatever kind

    def stored_pairs(step: Callable[..., None]) -> list[Path]:
        paths = []
        for pair in generated_pairs(generated, cache_folder / "pairs", own):
            levels = max(max_disparity, levels_for(pair))
            searched.append(levels)
            for n, name in itertools.product((0, 1), methods):
                paths.append(store_variant(pair, name, training_settings.seed, n, levels, cache_folder))
                step(f"{pair.name} {name}")
        return paths

    training_frames = {frame.name: frame for training, _ in groups for frame in training} | extra_frames
    test_frames = {frame.name: frame for _, held_out in groups for frame in held_out}
    total = (len(training_frames) * variants + len(test_frames)) * len(methods) + 2 * streets
    total += 2 * generated * len(methods)
    with progress(total) as (_, step):
        maps = {name: stored(frame, range(variants), step) for name, frame in training_frames.items()}
        held_out_maps = {name: stored(frame, range(1), step) for name, frame in test_frames.items()}
        scenes = [*stored_streets(step), *stored_pairs(step)]
    results = []
    for number, (training, held_out) in enumerate(groups):
        own_maps = [path for frame in training for path in maps[frame.name]]
        extra_maps = [path for name in extra_frames for path in maps[name]]
        street_part = (street_share if own_maps or extra_maps else 1.0) if scenes else 0.0
        extra_part = (extra_share if own_maps else 1 - street_part) if extra_maps else 0.0
        shares = ((scenes, street_part), (own_maps, 1 - street_part - extra_part), (extra_maps, extra_part))
        sources = [Source(SampleFiles(paths), share) for paths, share in shares if paths and share > 0]
        folder = output if folds is None else output / f"fold-{number}"
        labels = [(frame.name, name) for frame in held_out for name in methods]
        held_out_samples = SampleFiles([path for frame in held_out for path in held_out_maps[frame.name]])
        trained_on = [*(f"{dataset}/{frame.name}" for frame in training), *extra_frames]
        outcome = _train_one(
            refiner,
            sources,
            held_out_samples,
            labels,
            training_settings,
            content,
            folder,
            world,
            trained_on,
            max(searched),
            {"streets": streets, "generated": generated, "first_seed": FIRST_SEED, "methods": methods}
            | ({} if own is None else {"assets": own.notes}),
        )
        results.append(outcome | {"held_out": [frame.name for frame in held_out]})
    return {
        "refiner": refiner, "settings": asdict(training_settings), "methods": methods, "streets": streets,
        "generated": generated, "assets": None if own is None else own.notes,
        "frames": sorted(training_frames), "results": results, "pooled": _pooled(results, methods), "rank": world[0],
    }  # fmt: skip


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise StereokitError("training needs torch, which is not installed: pip install 'stereokit[train]'") from None
    return torch


def _training_settings(preset: str, texts: Sequence[str]) -> Any:
    from stereokit_refiners.training.loop import PRESETS, Settings

    if preset not in PRESETS:
        raise OptionError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
    options = parse_settings(texts, frozenset())
    known = [f.name for f in fields(Settings)]
    for name in options:
        if name not in known:
            raise OptionError(f"no setting named {name!r}. Known: {', '.join(known)}")
    try:
        return Settings(**{**PRESETS[preset], **options})
    except TypeError as error:
        raise OptionError(f"a setting has a value of the wrong type ({error})") from None


def _groups(
    all_frames: Sequence[Frame], frames: str | None, validation: str | None, folds: str | None
) -> list[tuple[list[Frame], list[Frame]]]:
    """Return (training, held out) pairs of frames; no frame is in both."""
    if folds is None:
        held_out = select_frames(all_frames, validation) if validation is not None else []
        training = [f for f in select_frames(all_frames, frames) if f not in held_out]
        return [(training, held_out)]
    parts = [select_frames(all_frames, part) for part in folds.split("/")]
    names = [frame.name for part in parts for frame in part]
    if len(parts) < 2 or len(set(names)) < len(names):
        raise OptionError(f"folds must be two groups or more that share no frame, got {folds!r}")
    extra = [] if frames is None else [f for f in select_frames(all_frames, frames) if f.name not in names]
    return [([*(f for other in parts if other is not part for f in other), *extra], part) for part in parts]


def _extra(texts: Sequence[str]) -> dict[str, Frame]:
    """Return the frames of further data sets by unique names, ``DATASET/NAME``."""
    frames = {}
    for source in texts:
        dataset, colon, root = source.partition(":")
        if not colon or not root:
            raise OptionError(f"extra must be DATASET:ROOT, got {source!r}")
        for frame in load_frames(dataset, root):
            name = f"{dataset}/{frame.name}"
            if name in frames:
                raise OptionError(f"extra must not bring two frames called {name!r}, got {source!r}")
            frames[name] = frame
    return frames


def _join_group(torch: Any) -> tuple[int, int]:
    """Join the processes of torchrun; return this one's number, and their count."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        return 0, 1
    torch.distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return int(os.environ["RANK"]), size


def _train_one(
    refiner: str, sources: Any, held_out_samples: Sequence[Any], labels: Sequence[tuple[str, str]], settings: Any,
    start: Any, folder: Path, world: tuple[int, int], trained_on: Sequence[str], largest: int, more: dict[str, Any],
) -> dict[str, Any]:  # fmt: skip
    """Train, calibrate, write the folder; return the counts of bad and known pixels by matcher."""
    from stereokit_refiners.training.loop import bad_pixels, calibrated, fit, predict, restored
    from stereokit_refiners.weights import NETWORKS, WeightFile, write

    network = NETWORKS[refiner]
    make_folder("output", folder)
    with progress(settings.steps) as (_, step):
        steps = 0

        def report(steps_done: int, loss: float, score: float | None) -> None:
            nonlocal steps
            score_text = "" if score is None else f" D1 {score:.2f} %"
            step(f"{folder.name} loss {loss:.2f}{score_text}", steps_done - steps)
            steps = steps_done

        arrays, history = fit(
            network, sources, held_out_samples, settings, start=None if start is None else start.arrays,
            checkpoint=folder / "checkpoint.pt", progress=report, rank=world[0], world=world[1],
        )  # fmt: skip
    module = restored(network, arrays)
    counts: dict[str, list[int]] = {}
    for sample, (_, name) in zip(held_out_samples, labels, strict=True):
        bad, known = bad_pixels(predict(module, settings.output_mode, sample), sample)
        total = counts.setdefault(name, [0, 0])
        total[0] += bad
        total[1] += known
    if world[0] == 0:
        ranges = calibrated(module, settings.output_mode, sources)
        notes = {
            "disparities": [0, largest],
            "frames": sorted(trained_on),
            "settings": asdict(settings),
            "start": None if start is None else start.fingerprint,
            **more,
        }
        write(folder / "weights.safetensors", WeightFile(refiner, settings.output_mode, arrays, ranges, notes))
        write_bytes(folder / "curves.csv", history.csv())
        write_bytes(folder / "curves.png", _curves(history))
    return {"folder": str(folder), "bad_and_known": counts, "steps": history.rows[-1][0] if history.rows else 0}


def _curves(history: Any) -> bytes:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    left = figure.add_subplot()
    steps = [row[0] for row in history.rows]
    left.plot(steps, [row[1] for row in history.rows], color="tab:blue", label="training loss")
    left.set_xlabel("step")
    left.set_ylabel("training loss", color="tab:blue")
    if any(row[2] is not None for row in history.rows):
        right = left.twinx()
        right.plot(steps, [row[2] for row in history.rows], color="tab:red", label="validation D1")
        right.set_ylabel("validation D1 noc, %", color="tab:red")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def _pooled(results: Sequence[dict[str, Any]], methods: Sequence[str]) -> dict[str, float | None]:
    pooled: dict[str, float | None] = {}
    for name in methods:
        counts = [r["bad_and_known"][name] for r in results if name in r["bad_and_known"]]
        known = sum(n for _, n in counts)
        pooled[name] = 100 * sum(bad for bad, _ in counts) / known if known else None
    return pooled
