"""What the parts of the general refiner are worth: trained without each of them, with several seeds.

``python -m stereokit_evaluation.commands.ablation --data DATA --cache CACHE -o OUT.json`` renders pairs, makes samples
of them, trains each variant of `stereokit_evaluation.training.ablation.VARIANTS` with each seed on the same samples,
and scores it on all pairs below DATA at half size, with S2, in fp32. One number is the geometric mean of the figures
against those of S2 at full size. The file is written after each training; the same command goes on where it was killed.
All variants have their first seed before any has its second. ``--start WEIGHTS`` begins with weights, of which what a
variant lacks is taken away, instead of from scratch.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from stereokit import __version__
from stereokit.errors import FileError, OptionError
from stereokit.images.check import check_integer, check_number
from stereokit.io import check_output, parsing, read_text, write_bytes
from stereokit_evaluation.common.folders import make_folder
from stereokit_evaluation.common.scripts import exit_status
from stereokit_evaluation.training.ablation import VARIANTS, samples_of, trained, variants_named
from stereokit_evaluation.training.domains import geometric_mean, matched_pairs, pooled, scores
from stereokit_refiners.weights import WeightFile, read

__all__ = ["main", "measure", "table"]

Run = tuple[str, int]
"""Variant and seed."""


def measure(
    output: Path, settings: dict[str, Any], runs: Sequence[Run], data: Path, cache: Path, start: Path | None = None
) -> dict[str, Any]:
    """Train and score what the file `output` does not have; return its content.

    Parameters
    ----------
    output : Path
        JSON, written after each training.
    settings : dict
        ``pairs``, ``samples`` of each, ``steps``, ``batch``, ``rows`` and ``columns`` of the crops, ``rate``, and
        ``start``, the fingerprint of the weights to begin with or None.
    runs : sequence of (str, int)
        Variants and seeds, in the order in which they are trained.
    data : Path
        Folder of the sets `stereokit_evaluation.training.domains.SETS`.
    cache : Path
        Folder of pairs, samples and weights.
    start : Path, optional
        Weight file to begin with.

    Raises
    ------
    OptionError
        If the file is of other settings.
    FileError
        If a file cannot be read or written.
    """
    document = _begun(output, settings)
    results = document["runs"]
    missing = [run for run in runs if run not in {(result["variant"], result["seed"]) for result in results}]
    if not missing:
        return document
    pairs = list(matched_pairs(data))
    full = pooled(pairs, [pair.full for pair in pairs])
    linear = pooled(pairs, [pair.linear for pair in pairs])
    document |= {"full": full, "linear": linear, "linear mean": geometric_mean(linear, full)}
    folders: dict[Any, Path] = {}  # of samples, which are looked through once
    for name, seed in missing:
        variant = VARIANTS[name]
        kind = variant.kinds, variant.encoder
        if kind not in folders:
            folders[kind] = samples_of(variant, settings["pairs"], settings["samples"], cache)
        weights = _train(name, seed, settings, folders[kind], cache, start)
        figures = scores(weights, pairs, variant.encoder)
        mean = geometric_mean(figures, full)
        row = {"variant": name, "seed": seed, "weights": weights.fingerprint, "mean": mean, "figures": figures}
        results.append(row)
        write_bytes(output, (json.dumps(document, indent=1) + "\n").encode())
    return document


def _begun(output: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the file's content if there is one, else an empty one."""
    if not output.exists():
        return {
            "command": "python -m stereokit_evaluation.commands.ablation --data DATA --cache CACHE -o OUT.json",
            "version": __version__, "torch": torch.__version__, "settings": settings, "runs": [],
        }  # fmt: skip
    with parsing(output, "output", "output must be a file of this command, or none"):
        document: dict[str, Any] = json.loads(read_text(output, "output"))
        stored = document["settings"]
        [(result["variant"], result["seed"]) for result in document["runs"]]
    if stored != settings:
        raise OptionError(f"output must be of the same settings, {settings}, got those of {str(output)!r}: {stored}")
    return document


def _train(
    name: str, seed: int, settings: dict[str, Any], samples: Path, cache: Path, start: Path | None
) -> WeightFile:  # fmt: skip
    folder = make_folder(cache / "ablation" / "-".join(map(str, settings.values())), "cache")
    weights = folder / f"{name.replace(' ', '-')}-{seed}.safetensors"
    size = settings["rows"] // 4, settings["columns"] // 4
    options = {key: settings[key] for key in ("steps", "batch", "rate")}
    return trained(VARIANTS[name], seed, samples, weights, size=size, start=start, **options)


def table(document: dict[str, Any]) -> list[str]:
    """Return lines of a file: for each variant the mean over seeds, the smallest and the largest geometric mean."""
    means: dict[str, list[float]] = {}
    for result in document["runs"]:
        means.setdefault(result["variant"], []).append(result["mean"])
    rows = [f"{'variant':18} seeds   mean     least    most"]
    for name, values in means.items():
        figures = "   ".join(f"{x:.4f}" for x in (sum(values) / len(values), min(values), max(values)))
        rows.append(f"{name:18} {len(values):5}   {figures}")
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the real pairs, a folder for each set")
    parser.add_argument("--cache", type=Path, required=True, help="folder of pairs, samples and weights")
    parser.add_argument("--output", "-o", type=Path, required=True, help="JSON to write, or to go on with")
    for name, value in (("pairs", 420), ("samples", 3), ("steps", 1400), ("batch", 2), ("rows", 256), ("columns", 384)):
        parser.add_argument(f"--{name}", type=int, default=value, help=f"{value} by default")
    parser.add_argument("--rate", type=float, default=2e-3, help="learning rate, %(default)s by default")
    parser.add_argument("--start", type=Path, help="weight file to begin with; from scratch by default")
    parser.add_argument("--seeds", default="0,1,2", help="of the trainings")
    parser.add_argument("--variants", default=",".join(VARIANTS), help="by default all: %(default)s")
    arguments = parser.parse_args(argv)
    check_output(arguments.output, (".json",), "output")
    names = ("pairs", "samples", "steps", "batch", "rows", "columns")
    settings: dict[str, Any] = {name: check_integer(name, getattr(arguments, name), 1) for name in names}
    start = arguments.start
    settings["rate"] = check_number("rate", arguments.rate, 0, 10)
    settings["start"] = None if start is None else read(start).fingerprint
    for name in ("rows", "columns"):
        if settings[name] % 32:
            raise OptionError(f"{name} must be a multiple of 32, got {settings[name]}")
    if not arguments.data.is_dir():
        raise FileError(f"data must be a folder, got {str(arguments.data)!r}, which is not")
    runs = [(name, seed) for seed in _seeds(arguments.seeds) for name in variants_named(arguments.variants.split(","))]
    make_folder(arguments.cache, "cache")
    print("\n".join(table(measure(arguments.output, settings, runs, arguments.data, arguments.cache, start))))


def _seeds(text: str) -> list[int]:
    parts = text.split(",")
    if not all(part.isdecimal() for part in parts):
        raise OptionError(f"seeds must be whole numbers with commas between them, got {text!r}")
    return [int(part) for part in parts]


if __name__ == "__main__":
    sys.exit(exit_status(main))
