"""Training of `stereokit_refiners.networks.evidence.Evidence`: on pairs with dense truth, from generated scenes.

``python -m stereokit_refiners.training.evidence samples PAIRS FOLDER`` matches each pair of a folder under many
conditions and stores what the network sees of it, and ``... fit FOLDER OUTPUT`` trains on these, from the checkpoint
OUTPUT.pt if there is one. Both may run at once: samples that appear are taken up.

A pair is an ``.npz`` file with ``left``, ``right`` (H, W) uint8, ``truth`` (H, W) float32, pixels, and ``seen`` (H, W)
bool, whether the right camera sees it too.
"""

from __future__ import annotations

import argparse
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

import stereokit
from stereokit.errors import OptionError
from stereokit.result import Disparity
from stereokit_refiners.networks.evidence import CHANNELS, GAINS, LOGITS, STEPS, WINDOWS, Evidence
from stereokit_refiners.runtimes.evidence import hypotheses
from stereokit_refiners.runtimes.features import network_input
from stereokit_refiners.runtimes.torch import Module, calibrate
from stereokit_refiners.weights import WeightFile, read, write

__all__ = ["LOSSES", "Encoder", "Source", "fit", "loss", "make_sample", "mixture", "packed", "unpacked"]

LOSSES = ("general", "d1")
"""What an error counts: soft counts of those over about 1 and 3 pixels; or of those over 3 pixels alone, KITTI's."""

_FIELDS: dict[str, tuple[int, Any]] = {
    "input": (sum(CHANNELS.values()), np.int8),
    "others": (16, np.float16),  # the last four values less the mean of the coarse map over 2x2
    "within": (16, np.float16),  # the coarse map less that mean, by pixel of the 4x4
    "miss": (16, np.float16),  # truth less coarse map
    "kind": (16, np.uint8),  # 0 truth unknown, 1 seen by both cameras, 2 by the left one only
}
"""What is stored of each 4x4 pixels."""

Encoder = Callable[..., NDArray[np.int8]]
"""Makes what the network sees, as `stereokit_refiners.runtimes.features.network_input` does."""

_FIRST = {name: sum(list(CHANNELS.values())[:k]) for k, name in enumerate(CHANNELS)}  # channel of the input
_OCCLUDED = 0.3  # weight of pixels that the right camera does not see
_HARM = 0.7  # how much more it counts to make a pixel worse than to make another one better by as much
_EXACT = ("up_1_sum", "merge_0")
"""Activations that are not held to 8 bits: what logits are made of. It takes hardly longer."""
_MOST_SMALL = 10_000  # samples in a row that are smaller than a crop
_TOO_HARD = 0.25  # samples with a larger share of outliers teach nothing


def _folded(plane: NDArray[Any], side: int) -> NDArray[Any]:
    height, width = plane.shape
    parts = plane.reshape(height // side, side, width // side, side).transpose(1, 3, 0, 2)
    return np.asarray(parts.reshape(side * side, height // side, width // side))


def packed(fields: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Return (C, h, w) arrays by name as one (h, w, bytes) array; see `unpacked`."""
    parts = []
    for name, (channels, dtype) in _FIELDS.items():
        array = fields[name]
        if dtype == np.float16:
            array = np.clip(array, -6e4, 6e4)
        moved = np.ascontiguousarray(array.transpose(1, 2, 0).astype(dtype))
        assert moved.shape[2] == channels
        parts.append(moved.view(np.uint8).reshape(*moved.shape[:2], -1))
    return np.concatenate(parts, 2)


def unpacked(record: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Return arrays by name, (..., C), of what `packed` made."""
    found, at = {}, 0
    for name, (channels, dtype) in _FIELDS.items():
        size = channels * np.dtype(dtype).itemsize
        found[name] = np.ascontiguousarray(record[..., at : at + size]).view(dtype)
        at += size
    return found


class _Keeper:
    """A refiner that keeps what it is given."""

    needs_candidates = True
    needs_confidence = True
    any_scale = True

    def __call__(self, coarse: Disparity, left: NDArray[Any], *, threads: int = 1, scale: float = 1) -> Disparity:
        self.coarse = coarse
        return Disparity(np.zeros(left.shape, np.float32), np.zeros(left.shape, np.bool_))


def make_sample(
    left: NDArray[np.uint8], right: NDArray[np.uint8], truth: NDArray[np.float32], seen: NDArray[np.bool_],
    method: str, scale: float, *, max_disparity: int = 0, encoder: Encoder = network_input, **options: Any,
) -> tuple[NDArray[np.uint8], float]:  # fmt: skip
    """Match a pair; return what the network sees and should make of it, and the coarse map's share of outliers.

    Parameters
    ----------
    left, right : (H, W) uint8
    truth : (H, W) float32
        Pixels; NaN and 0 (the sky) are unknown.
    seen : (H, W) bool
        Where the right camera sees it too.
    method : str
        As `stereokit.Matcher` takes it.
    scale : {1, 0.5, 0.25}
    max_disparity : int
        The search goes so far at least, pixels; it always holds the largest of the truth.
    encoder : callable
        Makes what the network sees, as `stereokit_refiners.runtimes.features.network_input` does.
    **options
        Of the matcher.
    """
    known = np.isfinite(truth) & (truth > 0)
    farthest = float(truth[known].max(initial=0))
    keeper = _Keeper()
    levels = max(max_disparity, int(np.ceil((farthest + 8) / 32) * 32))
    stereokit.Matcher(
        method, max_disparity=levels, scale=scale, refiner=keeper, threads=1, device="cpu", **options
    )(left, right)  # fmt: skip
    coarse = keeper.coarse
    assert coarse.candidates is not None
    assert coarse.confidence is not None
    found = hypotheses(coarse.disparity, coarse.candidates, left, right, round(1 / scale))
    upscaled = (found.coarse + np.float32(found.base))[: left.shape[0], : left.shape[1]]
    miss = np.zeros(found.coarse.shape, np.float32)
    kind = np.zeros(found.coarse.shape, np.uint8)
    miss[: left.shape[0], : left.shape[1]] = np.where(known, truth - upscaled, 0)
    kind[: left.shape[0], : left.shape[1]] = np.where(known, np.where(seen, 1, 2), 0)

    fields = {
        "input": encoder(found, coarse.confidence, left, left.shape[1]),
        "others": np.concatenate([_folded(values - found.half, 2) for values in found.others]),
        "within": _folded(found.coarse - found.half.repeat(2, 0).repeat(2, 1), 4),
        "miss": _folded(miss, 4),
        "kind": _folded(kind, 4),
    }
    scored = seen & known if (seen & known).any() else known
    error = np.abs(upscaled - truth)[scored]
    outliers = (error > 3) & (error > 0.05 * truth[scored])
    share = float(outliers.sum() / max(1, outliers.size))
    return packed(fields)[: left.shape[0] // 4, : left.shape[1] // 4], share


def photographed(
    left: NDArray[np.uint8], right: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return a pair as poor cameras see it: dark, flat, blurred, noisy, saturated, of two gains, with rows off."""
    a: Any = left.astype(np.float32)
    b: Any = right.astype(np.float32)
    if rng.random() < 0.35:
        contrast = np.exp(rng.uniform(np.log(0.15), 0))
        offset = rng.uniform(0, 200 * (1 - contrast))
        a, b = a * contrast + offset, b * contrast + offset
    if rng.random() < 0.3:
        sigma = rng.uniform(0.3, 1.0)
        a, b = cv2.GaussianBlur(a, (0, 0), sigma), cv2.GaussianBlur(b, (0, 0), sigma * rng.uniform(0.8, 1.2))
    if rng.random() < 0.4:
        b = b * np.exp(rng.normal(0, 0.1)) + rng.normal(0, 4)
    if rng.random() < 0.35:
        brighter = rng.uniform(1.1, 2.0)
        a, b = a * brighter, b * brighter
    if rng.random() < 0.5:
        noise = np.exp(rng.uniform(np.log(0.3), np.log(3)))
        a, b = (image + rng.normal(size=image.shape) * noise for image in (a, b))
    if rng.random() < 0.35:
        slope = np.array([[1, 0, 0], [rng.normal(0, 0.3) / a.shape[1], 1, rng.normal(0, 0.25)]], np.float32)
        b = cv2.warpAffine(b, slope, b.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    one, two = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in (a, b))
    return one, two


def _store(pairs: Path, folder: Path, most: int, encoder: Encoder = network_input) -> None:
    """Store up to `most` samples of each pair; those that are there are left as they are."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(most):
        for path in sorted(pairs.glob("*.npz"), key=lambda path: zlib.crc32(path.stem.encode())):  # kinds mixed
            if any(folder.glob(f"{path.stem}_{number:02d}_*.npy")):
                continue
            rng = np.random.default_rng([number, zlib.crc32(path.stem.encode())])
            with np.load(path) as pair:
                left, right, truth, seen = (pair[name] for name in ("left", "right", "truth", "seen"))
            if rng.random() < 0.5:
                left, right, truth, seen = (np.ascontiguousarray(x[::-1]) for x in (left, right, truth, seen))
            if number or rng.random() < 0.7:
                left, right = photographed(left, right, rng)
            method = str(rng.choice(["S1", "S2", "S2", "S2", "S3", "S4", "S4"]))
            scale = float(rng.choice([1, 0.5, 0.5, 0.5, 0.25] if number else [1, 0.5, 0.5]))
            options: dict[str, Any] = {} if rng.random() < 0.5 else {"smooth": float(0.5 * np.exp(rng.normal(0, 0.3)))}
            truth = truth.astype(np.float32)
            record, outliers = make_sample(left, right, truth, seen, method, scale, encoder=encoder, **options)
            name = folder / f"{path.stem}_{number:02d}_{method}_{1000 * outliers:03.0f}.npy"
            part = name.with_suffix(".part")
            with open(part, "wb") as stream:
                np.save(stream, record)
            os.replace(part, name)


def gains_around(given: NDArray[np.int8]) -> NDArray[np.float32]:
    """Return the means of the gains over each of `WINDOWS`, (N, h, w, 2 C), for stored inputs (N, h, w, C)."""
    first = _FIRST["gain"]
    gains = given[..., first : first + LOGITS].astype(np.float32)
    count, height, width, _ = gains.shape
    by_two = gains.reshape(count, height, width, -1, 2, 2).transpose(0, 1, 4, 2, 5, 3)
    planes = np.ascontiguousarray(by_two).reshape(count, 2 * height, 2 * width, -1)
    means = [
        np.stack([cv2.blur(plane, (side, side), borderType=cv2.BORDER_REPLICATE) for plane in planes])
        for side in WINDOWS
    ]
    return np.concatenate(means, 3)


def mixture(head: Tensor, means: Tensor, others: Tensor, within: Tensor, apart: Tensor) -> Tensor:
    """Return the map less the coarse one's mean over 2x2: the twin of `stereokit_refiners.runtimes.mixture.mixture`.

    Parameters
    ----------
    head : (B, C, h, w)
    means : (B, 2 C, 2h, 2w)
        See `gains_around`.
    others, within : (B, ., h, w)
        As they are stored.
    apart : (B,)
        How far "less" and "more" are from the coarse map, pixels.

    Returns
    -------
    (B, 4h, 4w)
    """
    batch = len(head)

    def doubled(x: Tensor) -> Tensor:
        rows, columns = x.shape[-2:]
        wide = x[..., :, None, :, None].expand(*x.shape[:-2], rows, 2, columns, 2)
        return wide.reshape(*x.shape[:-2], 2 * rows, 2 * columns)

    logits = F.pixel_shuffle(head[:, :LOGITS], 2)
    count = logits.shape[1]
    factors = doubled(head[:, LOGITS : LOGITS + GAINS] / 16)
    for n in range(len(WINDOWS)):
        mean = means[:, n * count : (n + 1) * count]
        near, far = factors[:, 2 * n : 2 * n + 1], factors[:, 2 * n + 1 : 2 * n + 2]
        logits = logits + torch.cat([near * mean[:, :2], far * mean[:, 2:]], 1)
    weights = logits.clamp(-40, 40).exp()
    total = 1 + weights.sum(1)
    share = (1 + weights[:, 0] + weights[:, 1]) / total
    rest = (weights[:, 2:] * F.pixel_shuffle(others, 2)).sum(1)
    rest = (rest + (weights[:, 1] - weights[:, 0]) * apart.view(batch, 1, 1)) / total
    return doubled(share) * F.pixel_shuffle(within, 4)[:, 0] + doubled(rest)


def _badness(error: Tensor, objective: str) -> Tensor:
    """Return what an error counts, one of `LOSSES`; both have a clipped L1 beside the soft counts."""
    if objective == "d1":
        return 3 * torch.sigmoid(2 * (error - 3)) + 0.25 * error.clamp(max=20)
    square = error * error
    return square / (square + 0.6) + 0.7 * square / (square + 7) + 0.08 * error.clamp(max=30)


def loss(head: Tensor, fields: dict[str, Tensor], apart: Tensor, objective: str = "general") -> tuple[Tensor, Tensor]:
    """Return the loss, and that of the coarse map alone; `objective` is one of `LOSSES`."""
    within = fields["within"].float()
    out = mixture(head, fields["means"], fields["others"].float(), within, apart)
    miss, kind = (F.pixel_shuffle(fields[name].float(), 4)[:, 0] for name in ("miss", "kind"))
    weight = (kind == 1).float() + _OCCLUDED * (kind == 2).float()
    error = (out - F.pixel_shuffle(within, 4)[:, 0] - miss).abs()
    now, before = _badness(error, objective), _badness(miss.abs(), objective)
    total = weight.sum().clamp(min=1)
    main = ((now + _HARM * F.relu(now - before)) * weight).sum() / total
    right = F.avg_pool2d((error.detach() < 1.5).float()[:, None], 2)
    sure = F.binary_cross_entropy_with_logits(F.pixel_shuffle(head[:, LOGITS + GAINS :], 2), right, reduction="none")
    by_two = F.avg_pool2d(weight[:, None], 2)
    return main + 0.2 * 4 * (sure * by_two).sum() / total, (before * weight).sum() / total


def _begun(module: Module) -> None:
    """Start at the identity: the coarse value has nearly all the weight."""
    with torch.no_grad():
        bias = module.weights["head-bias"]
        bias[:LOGITS] = -3
        bias[LOGITS : LOGITS + GAINS] = 0.1


@dataclass(frozen=True)
class Source:
    """Samples of one origin.

    Parameters
    ----------
    samples : Path or sequence of Path
        A folder that may still grow, of which samples are drawn the less the more of them is wrong; or files, alike.
    share : float
        Of the steps, beside the other sources' shares.
    """

    samples: Path | Sequence[Path]
    share: float = 1.0

    def listed(self) -> tuple[list[Path], NDArray[np.float64]]:
        """Return the files that there are now, and their sums of shares."""
        if not isinstance(self.samples, Path):
            return list(self.samples), np.arange(1.0, len(self.samples) + 1)
        paths = sorted(self.samples.glob("*.npy"))
        outliers = np.array([int(path.stem.rpartition("_")[2]) / 1000 for path in paths])
        return paths, np.where(outliers > _TOO_HARD, 0, 1 / (1 + (outliers / 0.12) ** 2)).cumsum()


def _batches(
    sources: Sequence[Source], batch: int, size: tuple[int, int], rng: np.random.Generator
) -> Iterator[dict[str, Tensor]]:
    """Yield random crops of one source at a time, `size` blocks of 4x4 pixels each; folders are looked at each minute.

    Crops of dense truth beside those of sparse truth would have most of a step's known pixels.
    """
    looked = -1e9
    parts = np.cumsum([source.share for source in sources])
    while True:
        if time.monotonic() - looked > 60:
            listed = [source.listed() for source in sources]
            looked = time.monotonic()
        paths, shares = listed[int(np.searchsorted(parts, rng.random() * parts[-1]))] if len(sources) > 1 else listed[0]
        crops: list[NDArray[np.uint8]] = []
        small = 0
        while len(crops) < batch:
            record = np.load(paths[int(np.searchsorted(shares, rng.random() * shares[-1]))], mmap_mode="r")
            if record.shape[0] < size[0] or record.shape[1] < size[1]:
                small += 1
                if small > _MOST_SMALL:
                    raise OptionError(f"crops must fit into the samples, got {4 * size[0]}x{4 * size[1]} pixels")
                continue
            y, x = (int(rng.integers(0, record.shape[k] - size[k] + 1)) for k in (0, 1))
            crops.append(np.array(record[y : y + size[0], x : x + size[1]]))
        fields = unpacked(np.stack(crops))
        fields["means"] = gains_around(fields["input"])
        yield {name: torch.from_numpy(a).permute(0, 3, 1, 2).contiguous() for name, a in fields.items()}


def _input_of(fields: dict[str, Tensor]) -> Tensor:
    return (fields["input"].float() / STEPS).contiguous(memory_format=torch.channels_last)


def _by_steps(arrays: Mapping[str, NDArray[np.float32]], factor: float) -> dict[str, NDArray[np.float32]]:
    """Return weights whose first layer takes other units: files are for bytes, training is for units."""
    return {**arrays, "stem.weight": arrays["stem.weight"] * np.float32(factor)}


def fit(
    samples: Path | Sequence[Source], output: Path, *, steps: int = 30000, rate: float = 2e-3, batch: int = 4,
    seed: int = 0, start: Path | None = None, size: tuple[int, int] = (64, 96), objective: str = "general",
    notes: dict[str, Any] | None = None, report: int = 200, prepare: Callable[[Module], None] | None = None,
) -> WeightFile:  # fmt: skip
    """Train on stored samples, from a checkpoint if there is one, and write the weights.

    Parameters
    ----------
    samples : Path or sequence of Source
        A folder of them, or several sources.
    output : Path
        Weight file; the checkpoint is beside it, ``.pt``.
    steps, batch, seed : int
    rate : float
        Learning rate after the first 200 steps; down a cosine.
    start : Path or None
        Weight file to begin with.
    size : tuple of int
        Crops in blocks of 4x4 pixels, multiples of 8.
    objective : {"general", "d1"}
        One of `LOSSES`.
    notes : dict or None
        For the weight file.
    report : int
        Steps between lines on standard output.
    prepare : callable, optional
        Changes the network before the first step, such as by a hook that holds some of its weights.
    """
    network = Evidence()
    module = Module(network, torch.Generator().manual_seed(seed))
    _begun(module)
    module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(module.parameters(), lr=rate, weight_decay=1e-4, betas=(0.9, 0.99))
    checkpoint, done = output.with_suffix(".pt"), 0
    if start is not None:
        module.load(_by_steps(read(start).arrays, STEPS))
    if prepare is not None:
        prepare(module)
    average = {name: value.clone() for name, value in module.state_dict().items()}
    if checkpoint.is_file():
        held = torch.load(checkpoint)
        module.load_state_dict(held["module"])
        optimizer.load_state_dict(held["optimizer"])
        average, done = held["average"], held["done"]
    rng = np.random.default_rng([seed, done])
    sources = [Source(samples)] if isinstance(samples, Path) else samples
    batches = _batches(sources, batch, size, rng)
    compiled = torch.compile(loss)
    saved = time.monotonic()
    while done < steps:
        for group in optimizer.param_groups:
            cosine = 0.5 * (1 + np.cos(np.pi * done / steps))
            group["lr"] = float(rate * min(1, (done + 1) / 200) * (0.02 + 0.98 * cosine))
        fields = next(batches)
        given = _input_of(fields)
        apart = torch.where(given[:, _FIRST["scale"], 0, 0] > 0.5, 2.0, 1.0)
        with torch.autocast("cpu", torch.bfloat16):
            head = module({"evidence": given})["map"]
        value, before = compiled(head.float().contiguous(), fields, apart, objective)
        optimizer.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(module.parameters(), 5.0)
        optimizer.step()
        done += 1
        with torch.no_grad():
            keep = min(0.999, (1 + done) / (50 + done))
            for name, tensor in module.state_dict().items():
                average[name].mul_(keep).add_(tensor, alpha=1 - keep)
        if done % report == 0:
            print(f"{done} loss {float(value.detach()):.4f}, of the coarse maps {float(before):.4f}", flush=True)
        if done == steps or time.monotonic() - saved > 120:
            state = {"module": module.state_dict(), "optimizer": optimizer.state_dict(), "average": average}
            part = checkpoint.with_suffix(".part")
            torch.save({**state, "done": done}, part)
            os.replace(part, checkpoint)
            saved = time.monotonic()
    module.load_state_dict(average)
    ranges = calibrate(module, ({"evidence": _input_of(next(batches))} for _ in range(16)))
    ranges = {name: bounds for name, bounds in ranges.items() if name not in _EXACT}
    content = WeightFile(
        "evidence",
        "residual",
        _by_steps(module.arrays(), 1 / STEPS),
        ranges,
        {**(notes or {}), "steps": done, "seed": seed},
    )
    write(output, content)
    return content


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    samples = commands.add_parser("samples")
    samples.add_argument("pairs", type=Path)
    samples.add_argument("folder", type=Path)
    samples.add_argument("--each", type=int, default=5)
    train = commands.add_parser("fit")
    train.add_argument("folder", type=Path)
    train.add_argument("output", type=Path)
    train.add_argument("--steps", type=int, default=30000)
    train.add_argument("--rate", type=float, default=2e-3)
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--start", type=Path)
    train.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    if given.command == "samples":
        _store(given.pairs, given.folder, given.each)
        return
    torch.set_num_threads(given.threads)
    fit(given.folder, given.output, steps=given.steps, rate=given.rate, seed=given.seed, start=given.start)


if __name__ == "__main__":
    main()
