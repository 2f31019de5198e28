"""Training of refiners: the loop, its checkpoints, and the score that stops it.

Nothing random is kept between steps: the batch and the noise of step ``n`` are functions of the seed and ``n``. So a
run that was killed goes on from its checkpoint as if nothing had happened. What is evaluated and saved is an
exponential moving average of the weights (Polyak and Juditsky 1992).
"""

from __future__ import annotations

import contextlib
import csv
import io
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from stereokit.errors import OptionError
from stereokit.io import make_folder, parsing, write_bytes
from stereokit_refiners.networks.layers import Network, Weights, check_output_mode, output_rule
from stereokit_refiners.runtimes.encode import base_of, encode
from stereokit_refiners.runtimes.torch import Module, calibrate
from stereokit_refiners.training.losses import distance, divergence
from stereokit_refiners.training.samples import Crop, Sample, SampleFiles, crop, whole
from stereokit_refiners.training.settings import PRESETS, Settings

__all__ = ["PRESETS", "History", "Settings", "Source", "bad_pixels", "calibrated", "fit", "predict", "restored"]


@dataclass(frozen=True)
class Source:
    """Samples of one origin.

    Parameters
    ----------
    samples : sequence of Sample
    weight : float
        Share of the crops that it gives, beside the other sources' weights.
    """

    samples: Sequence[Sample]
    weight: float = 1.0


@dataclass
class History:
    """What was measured on the way: step, mean training loss since the last look, and bad pixels in percent."""

    rows: list[tuple[int, float, float | None]] = field(default_factory=list)

    def csv(self) -> bytes:
        """Return the table as a CSV file."""
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(["step", "loss", "d1_noc_percent"])
        writer.writerows(["" if cell is None else cell for cell in row] for row in self.rows)
        return text.getvalue().encode()


def _device() -> torch.device:
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _batch(network: Network, output_mode: str, crops: Sequence[Crop]) -> dict[str, Tensor]:
    """Return crops as tensors, all (B, C, ., .).

    The network's inputs, and in pixels ``coarse``, ``values`` (of the candidates) and ``truth``, and ``weight``.
    """
    names, unit = tuple(network.inputs), output_rule(network, output_mode).unit_inputs
    encoded = [encode(names, unit, c.disparity, c.left, c.confidence, c.candidates) for c in crops]
    arrays = {name: np.stack([inputs[name] for inputs in encoded]) for name in names}
    arrays["values"] = np.stack([c.candidates for c in crops])
    arrays["coarse"] = np.stack([c.disparity[None] for c in crops])
    arrays["truth"] = np.stack([c.truth[None] for c in crops])
    arrays["weight"] = np.stack([c.weight[None] for c in crops])
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}


def _draw(
    network: Network, sources: Sequence[Source], settings: Settings, step: int, rank: int = 0
) -> dict[str, Tensor]:
    rng = np.random.default_rng([settings.seed, step, rank])
    shares = np.array([source.weight for source in sources])
    crops = []
    for _ in range(settings.batch):
        source = sources[int(rng.choice(len(sources), p=shares / shares.sum()))]
        sample = source.samples[int(rng.integers(len(source.samples)))]
        crops.append(crop(sample, settings.rows, settings.columns, rng))
    return _batch(network, settings.output_mode, crops)


def _batches(
    network: Network, sources: Sequence[Source], settings: Settings, first: int, rank: int
) -> Iterator[tuple[int, dict[str, Tensor]]]:
    """Yield the batches from step `first` on, two ahead of their use."""
    with ThreadPoolExecutor(1) as executor:
        ahead: list[tuple[int, Future[dict[str, Tensor]]]] = []
        upcoming = iter(range(first, settings.steps))
        while True:
            for step in upcoming:
                ahead.append((step, executor.submit(_draw, network, sources, settings, step, rank)))
                if len(ahead) > 2:
                    break
            if not ahead:
                return
            step, waiting = ahead.pop(0)
            yield step, waiting.result()


def _rate_factor(settings: Settings, step: int) -> float:
    """Return by what the learning rate of the settings is multiplied at a step."""
    if settings.schedule == "paper":
        return float(0.97 ** (step // (10 * settings.epoch)))
    warm = min(1.0, (step + 1) / 100)
    return warm * (0.5 * (1 + float(np.cos(np.pi * step / settings.steps))) + 0.005)


def _averaged(module: Module, decay: float) -> AveragedModel:
    """Return the exponential moving average of a module's weights, which begins with what they are now.

    It follows faster at first: after ``n`` steps the weight of the past is at most ``(n + 1) / (n + 10)``.
    """

    def update(average: Any, current: Any, count: Any) -> None:
        keep = min(decay, float(count) / (float(count) + 9)) if decay > 0 else 0.0
        torch._foreach_lerp_(list(average), list(current), 1 - keep)

    average = AveragedModel(module, multi_avg_fn=update)
    average.n_averaged.fill_(1)  # the beginning counts as the first
    return average


def _loss(
    settings: Settings, network: Network, heads: dict[str, Tensor], batch: dict[str, Tensor], step: int
) -> Tensor:
    estimate = output_rule(network, settings.output_mode).tensor_map(heads["map"], batch["coarse"], batch["values"])
    kind = settings.finish if settings.finish and 3 * step >= 2 * settings.steps else settings.loss
    pixels = distance(kind, estimate - batch["truth"], batch["truth"]) * batch["weight"]
    loss = pixels.sum() / batch["weight"].sum().clamp(min=1)
    if "mean" in heads:
        loss = loss + settings.divergence * divergence(heads["mean"].float(), heads["log_sigma"].float())
    return loss


@contextlib.contextmanager
def _precision(device: torch.device, half: bool) -> Iterator[None]:
    with torch.autocast(device.type, dtype=torch.bfloat16, enabled=half):
        yield


def predict(module: Module, output_mode: str, sample: Sample, *, half: bool = False) -> NDArray[np.float32]:
    """Return the refined map of a whole sample, (H, W) float32 in full-size pixels, as the refiner makes it."""
    device = next(module.parameters()).device
    part = whole(sample, module.network.stride)
    height, width = sample.coarse.shape
    maps = [part.disparity[:height, :width]]
    if "candidates" in module.network.inputs:
        maps.append(part.candidates[:, :height, :width])
    shift = np.float32(2 * base_of([one / np.float32(2) for one in maps]))  # half-size pixels, as the refiner's
    low, high = min(one.min() for one in maps), max(one.max() for one in maps)
    part = replace(part, disparity=part.disparity - shift, candidates=part.candidates - shift)
    batch = {name: tensor.to(device) for name, tensor in _batch(module.network, output_mode, [part]).items()}
    training = module.training
    module.eval()
    with torch.inference_mode(), _precision(device, half):
        heads = module({name: batch[name] for name in module.network.inputs})
        full = output_rule(module.network, output_mode).tensor_map(heads["map"], batch["coarse"], batch["values"])
    module.train(training)
    rows, columns = sample.size
    estimate: NDArray[np.float32] = full[0, 0, :rows, :columns].float().cpu().numpy() + shift
    return np.clip(estimate, low, high)


def bad_pixels(estimate: NDArray[np.float32], sample: Sample, *, occluded: bool = False) -> tuple[int, int]:
    """Return how many known pixels are wrong by over 3 pixels and 5 %, and how many are known.

    Those that both cameras see, or with `occluded` all. For reports there is `stereokit_evaluation.scoring.kitti`.
    """
    rows, columns = sample.size
    truth = sample.truth[:rows, :columns].astype(np.float32) / np.float32(256)
    known = truth > 0
    if not occluded:
        known &= sample.seen[:rows, :columns]
    error = np.abs(estimate - truth)
    return int(np.count_nonzero(known & (error > 3) & (error > np.float32(0.05) * truth))), int(np.count_nonzero(known))


def _score(module: Module, settings: Settings, samples: Sequence[Sample]) -> float | None:
    counts = [bad_pixels(predict(module, settings.output_mode, s, half=settings.half), s) for s in samples]
    known = sum(n for _, n in counts)
    return 100 * sum(bad for bad, _ in counts) / known if known else None


def fit(
    network: Network, sources: Sequence[Source], validation: Sequence[Sample], settings: Settings, *,
    start: Weights | None = None, checkpoint: Path | None = None, save_every_s: float = 60.0,
    progress: Callable[[int, float, float | None], object] | None = None, rank: int = 0, world: int = 1,
) -> tuple[dict[str, NDArray[np.float32]], History]:  # fmt: skip
    """Train a network.

    Parameters
    ----------
    network : Network
    sources : sequence of Source
    validation : sequence of Sample
        Looked at every `Settings.evaluate_every` steps; with patience, the best average is what is returned.
    settings : Settings
    start : mapping, optional
        Weights to begin with; None draws them from the seed.
    checkpoint : Path, optional
        File that the state is written to, and from which a run with the same settings goes on.
    save_every_s : float
        Seconds between checkpoints.
    progress : callable, optional
        Called with the step, the training loss and the last score after each step.
    rank, world : int
        This process and how many there are, when torch.distributed was set up (``torchrun``): each draws crops of
        its own and the gradients are averaged; the first one writes.

    Returns
    -------
    weights : dict of float32 arrays
        The average.
    history : History
    """
    if not sources or not all(source.samples for source in sources):
        raise OptionError("sources must hold at least one sample each, got an empty one")
    check_output_mode(network, settings.output_mode)
    identity = _described(network, sources, validation, settings, start, world)
    device = _device()
    module = Module(network, torch.Generator().manual_seed(settings.seed))
    if start is not None:
        module.load(start)
    layout: Any = {"memory_format": torch.channels_last}
    module.to(device, **layout)
    averaged = _averaged(module, settings.ema)
    average: Any = averaged.module
    optimizer = torch.optim.AdamW(
        module.parameters(), settings.learning_rate, betas=settings.betas, weight_decay=settings.decay
    )
    schedule = LambdaLR(optimizer, partial(_rate_factor, settings))
    history = History()
    first, best, best_arrays, misses = 0, float("inf"), None, 0
    losses: list[float] = []  # since the last look
    if checkpoint is not None and checkpoint.exists():
        with parsing(checkpoint, "checkpoint", "checkpoint must be one of this program's"):
            state = torch.load(checkpoint, map_location=device, weights_only=True)
        if not isinstance(state, dict) or state.get("identity") != identity:
            raise OptionError(
                f"checkpoint {str(checkpoint)!r} is of other settings; remove it or choose another folder"
            )
        with parsing(checkpoint, "checkpoint", "checkpoint must be one of this program's"):
            module.load_state_dict(state["module"])
            averaged.load_state_dict(state["average"])
            optimizer.load_state_dict(state["optimizer"])
            schedule.load_state_dict(state["schedule"])
            history.rows = [tuple(row) for row in state["history"]]
            first, best, misses, losses = state["step"], state["best"], state["misses"], state["losses"]
            best_arrays = {k: v.numpy() for k, v in state["best_arrays"].items()} or None

    def save(step: int) -> None:
        if checkpoint is None or rank > 0:
            return
        buffer = io.BytesIO()
        torch.save(
            {
                "identity": identity,
                "losses": losses, "step": step, "module": module.state_dict(),
                "average": averaged.state_dict(), "optimizer": optimizer.state_dict(),
                "schedule": schedule.state_dict(), "best": best, "misses": misses,
                "history": [list(row) for row in history.rows],
                "best_arrays": {k: torch.from_numpy(v) for k, v in (best_arrays or {}).items()},
            },
            buffer,
        )  # fmt: skip
        make_folder("output", checkpoint.parent)
        write_bytes(checkpoint, buffer.getvalue())

    module.train()
    saved, score = time.monotonic(), history.rows[-1][2] if history.rows else None
    for step, drawn in _batches(network, sources, settings, first, rank):
        torch.manual_seed((settings.seed * 1_000_003 + step) * world + rank)
        batch = {name: tensor.to(device, non_blocking=True) for name, tensor in drawn.items()}
        inputs = {name: batch[name].contiguous(**layout) for name in network.inputs}
        with _precision(device, settings.half):
            heads = module(inputs)
        loss = _loss(settings, network, heads, batch, step)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        if world > 1:
            for parameter in module.parameters():
                assert parameter.grad is not None
                torch.distributed.all_reduce(parameter.grad)
                parameter.grad.div_(world)
        if settings.clip > 0:
            torch.nn.utils.clip_grad_norm_(module.parameters(), settings.clip)
        optimizer.step()
        schedule.step()
        averaged.update_parameters(module)
        losses.append(float(loss.detach()))
        done = step + 1
        if done % settings.evaluate_every == 0 or done == settings.steps:
            score = _score(average, settings, validation)
            history.rows.append((done, float(np.mean(losses)), score))
            losses = []
            if settings.patience > 0 and score is not None:
                misses = 0 if score < best else misses + 1
                if score < best:
                    best, best_arrays = score, average.arrays()
        if progress is not None:
            progress(done, float(loss.detach()), score)
        last = done == settings.steps or (settings.patience > 0 and misses >= settings.patience)
        if last or time.monotonic() - saved > save_every_s:
            save(done)
            saved = time.monotonic()
        if last:
            break
    return best_arrays or average.arrays(), history


def restored(network: Network, arrays: Weights) -> Module:
    """Return a module with the weights of a file."""
    module = Module(network)
    module.load(arrays)
    return module.eval()


def calibrated(module: Module, output_mode: str, sources: Sequence[Source], count: int = 24) -> dict[str, list[float]]:
    """Return the ranges of the activations for int8, over whole samples taken evenly from `sources`."""
    batches = []
    for source in sources:
        step = max(1, len(source.samples) * len(sources) // count)
        for sample in source.samples[::step]:
            batches.append(_batch(module.network, output_mode, [whole(sample, module.network.stride)]))
    return calibrate(module, ({name: b[name] for name in module.network.inputs} for b in batches))


def _described(
    network: Network, sources: Sequence[Source], validation: Sequence[Sample], settings: Settings,
    start: Weights | None, world: int,
) -> dict[str, Any]:  # fmt: skip
    """Return all that a training depends on, for the checkpoint."""

    def digest(samples: Sequence[Sample]) -> int:
        if isinstance(samples, SampleFiles):
            return samples.digest
        number = 0
        for sample in samples:
            for array in (sample.coarse, sample.left, sample.truth):
                number = zlib.crc32(array.tobytes(), number)
        return number

    begun = 0
    for name in sorted(start or {}):
        begun = zlib.crc32((start or {})[name].tobytes(), begun)
    return {
        "network": network.name,
        "settings": {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(settings).items()},
        "sources": [[float(source.weight), digest(source.samples)] for source in sources],
        "validation": digest(validation),
        "start": begun,
        "world": world,
    }
