"""What parts of the general refiner are worth: its network, trained from scratch without them, on the same samples.

A part is taken away by weights that are held at a value during the training. So the weight files of all variants are of
the network as it is, and run as it does: a channel whose weights are 0 is not seen, a value whose logit is -1000 is not
chosen, and half of the channels with weights of 0 is half the width.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from stereokit.errors import OptionError
from stereokit.kernels.workspace import Workspace
from stereokit_evaluation.common.folders import make_folder
from stereokit_evaluation.synthetic.generated import KINDS
from stereokit_evaluation.training.general import _exactly, _generated_samples, _link
from stereokit_refiners.networks.evidence import CHANNELS, GAINS, LOGITS, STEPS, VALUES
from stereokit_refiners.runtimes.evidence import Hypotheses
from stereokit_refiners.runtimes.features import network_input
from stereokit_refiners.runtimes.torch import Module
from stereokit_refiners.training import evidence
from stereokit_refiners.weights import WeightFile

__all__ = ["VARIANTS", "Variant", "absolute_input", "prepare", "samples_of", "trained", "variants_named"]

_NEVER = -1000.0
"""A logit. No evidence makes up for it; runtimes take it for -40."""
_STREETS = ("road", "street")
_BY_VALUE = {"values": VALUES[3:], "gain": VALUES[1:], "surface": (VALUES[0], *VALUES[3:])}
"""Which values the channels of the input are of, four for each."""
_DISPARITY = 64.0  # pixels; half of the range of an input


@dataclass(frozen=True)
class Variant:
    """What is taken away.

    Attributes
    ----------
    channels : tuple of str
        Of `stereokit_refiners.networks.evidence.CHANNELS`: the network does not see them.
    values : tuple of str
        Of `stereokit_refiners.networks.evidence.VALUES`: they are not chosen, and the network does not see them.
    gains : bool
        Whether gains times evidence are added to the logits.
    kinds : tuple of str
        Kinds of scenes to train on.
    narrow : bool
        Half as many channels in every layer of the trunk.
    encoder : callable
        Makes the network's input, as `stereokit_refiners.runtimes.features.network_input` does.
    """

    channels: tuple[str, ...] = ()
    values: tuple[str, ...] = ()
    gains: bool = True
    kinds: tuple[str, ...] = KINDS
    narrow: bool = False
    encoder: evidence.Encoder = network_input

    def unseen(self) -> list[int]:
        """Return the channels of the input that the network does not see, by number."""
        numbers: list[int] = []
        first = 0
        for name, count in CHANNELS.items():
            gone = [name in self.channels] * count
            for k, value in enumerate(_BY_VALUE.get(name, ())):
                if value in self.values:
                    gone[4 * k : 4 * k + 4] = [True] * 4
            numbers += [first + k for k in range(count) if gone[k]]
            first += count
        return numbers


def absolute_input(
    values: Hypotheses, confidence: NDArray[np.float32], left: NDArray[np.uint8], columns: int, threads: int = 1,
    workspace: Workspace | None = None,
) -> NDArray[np.int8]:  # fmt: skip
    """Return the network's input with the coarse disparity itself where its relief was.

    Arguments and result are those of `stereokit_refiners.runtimes.features.network_input`. A disparity of 64 pixels is
    1, others are squashed to below 2.
    """
    inputs = network_input(values, confidence, left, columns, threads, workspace)
    disparity = (values.half + np.float32(values.base)) / np.float32(_DISPARITY)
    squashed = np.rint(2 * STEPS * (disparity / (np.abs(disparity) + 1)))
    first = evidence._FIRST["relief"]
    inputs[first : first + CHANNELS["relief"]] = evidence._folded(squashed.astype(np.int8), 2)
    return inputs


VARIANTS: dict[str, Variant] = {
    "all": Variant(),
    "no cost": Variant(channels=("cost", "gain"), gains=False),
    "no surface": Variant(channels=("surface", "outside")),
    "no grey": Variant(channels=("grey",)),
    "no candidates": Variant(values=("candidate", "rival")),
    "no extremes": Variant(values=("lowest", "highest")),
    "no less and more": Variant(values=("less", "more")),
    "streets": Variant(kinds=_STREETS),
    "no streets": Variant(kinds=tuple(kind for kind in KINDS if kind not in _STREETS)),
    "half width": Variant(narrow=True),
    "no relief": Variant(channels=("relief",)),
    "absolute": Variant(encoder=absolute_input),
}
"""The variants by name. ``"no relief"`` is what ``"absolute"``, which has no relief either, is to be compared with."""


def variants_named(names: Sequence[str]) -> list[str]:
    """Return the names of variants; OptionError where one is none."""
    for name in names:
        if name not in VARIANTS:
            raise OptionError(f"variants must be of {', '.join(VARIANTS)}, got {name!r}")
    return list(names)


def prepare(module: Module, variant: Variant) -> None:
    """Take away what a variant lacks, and hold it there: the gradient of weights that are held is 0.

    Parameters
    ----------
    module : Module
        Of `stereokit_refiners.networks.evidence.Evidence`.
    variant : Variant
    """
    weights = module.weights
    free = {key: torch.ones_like(weight) for key, weight in weights.items()}
    with torch.no_grad():
        if variant.narrow:
            _narrow(module, free)
        free["stem-weight"][:, variant.unseen()] = 0
        for value in variant.values:
            first = 4 * VALUES.index(value) - 4  # the logit of the first value is 0
            free["head-weight"][first : first + 4] = free["head-bias"][first : first + 4] = 0
            weights["head-bias"][first : first + 4] = _NEVER
        if not variant.gains:
            gains = slice(LOGITS, LOGITS + GAINS)
            free["head-weight"][gains] = free["head-bias"][gains] = 0
            weights["head-bias"][gains] = 0
        for key, weight in weights.items():
            if key.endswith("weight"):
                weight.mul_(free[key])
    for key, mask in free.items():
        if not bool(mask.all()):
            weights[key].register_hook(lambda gradient, mask=mask: gradient * mask)


def _narrow(module: Module, free: dict[str, torch.Tensor]) -> None:
    """Leave the first half of the channels between layers; what is left begins as a network of that width would."""
    for layer in module.network.layers:
        weight, bias = (f"{layer.name}-{part}" for part in ("weight", "bias"))
        if layer.name != "stem":
            free[weight][:, layer.inputs // 2 :] = 0
            module.weights[weight].mul_(2**0.5)
        if layer.name != "head":
            free[weight][layer.outputs // 2 :] = 0
            free[bias][layer.outputs // 2 :] = 0


def samples_of(variant: Variant, count: int, each: int, cache: Path) -> Path:
    """Return a folder of links to a variant's samples; what is missing of these and of the pairs is made.

    Parameters
    ----------
    variant : Variant
    count, each : int
        Pairs to render, and samples of each.
    cache : Path
        Folder of pairs and samples, as that of `stereokit_evaluation.training.general.train_general`.

    Raises
    ------
    OptionError
        If none of the pairs is of the variant's kinds.
    """
    samples = _generated_samples(count, cache, None, each)
    if variant.encoder is not network_input:
        exact = _exactly(cache / "pairs", count, cache)[0]
        samples = make_folder(samples.with_name(f"{samples.name}-{variant.encoder.__name__}"), "cache")
        for number in range(each):
            evidence._store(exact, samples, number + 1, variant.encoder)
    kinds = () if variant.kinds == KINDS else variant.kinds
    chosen = make_folder(samples.with_name("-".join((samples.name, f"first-{each}", *kinds))), "cache")
    for path in samples.glob("*.npy"):
        if path.name.partition("-")[0] in variant.kinds and int(path.stem.split("_")[-3]) < each:
            _link(path, chosen / path.name)
    if not any(chosen.iterdir()):
        raise OptionError(f"pairs must be so many that some are of {', '.join(variant.kinds)}, got {count}")
    return chosen


def trained(
    variant: Variant,
    seed: int,
    samples: Path,
    output: Path,
    *,
    steps: int,
    batch: int,
    size: tuple[int, int] = (64, 96),
    rate: float = 2e-3,
    start: Path | None = None,
) -> WeightFile:
    """Train a variant on a folder of samples, from where a killed training was; return its weights.

    Arguments are as for `stereokit_refiners.training.evidence.fit`.
    """
    notes = {"unseen": variant.unseen(), "values": list(variant.values), "kinds": list(variant.kinds)}
    with redirect_stdout(sys.stderr):  # what it reports on the way is no result
        return evidence.fit(
            [evidence.Source(samples)], output, steps=steps, rate=rate, batch=batch, seed=seed, start=start, size=size,
            notes=notes, prepare=lambda module: prepare(module, variant),
        )  # fmt: skip
