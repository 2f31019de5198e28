"""How a refiner is trained: the settings, checked, and the presets.

Kept apart from the loop (`stereokit_refiners.training.loop`), which needs torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stereokit.errors import OptionError
from stereokit.images.check import check_flag, check_integer, check_number

__all__ = ["LOSSES", "OUTPUT_MODES", "PRESETS", "Settings"]

OUTPUT_MODES = ("residual", "direct")
"""See `stereokit_refiners.networks.layers.Network.outputs`."""

LOSSES = ("l1", "bounded", "d1")
"""See `stereokit_refiners.training.losses`."""


@dataclass(frozen=True)
class Settings:
    """How to train.

    Parameters
    ----------
    steps : int
        Steps in all.
    batch : int
        Crops per step.
    rows, columns : int
        Size of a crop, half-size pixels.
    output_mode : {"residual", "direct"}
        See `stereokit_refiners.runtimes.encode`.
    loss : {"l1", "bounded", "d1"}
        See `stereokit_refiners.training.losses`.
    finish : str or None
        Loss of the last third; None keeps `loss`.
    divergence : float
        Weight of the latent's divergence beside a loss in pixels.
    learning_rate : float
    schedule : {"cosine", "paper"}
        Down to nothing along a cosine after a short warm-up; or times 0.97 every 10 epochs.
    epoch : int
        Steps to an epoch, for the paper's schedule.
    betas : (float, float)
        Of Adam.
    decay : float
        Weight decay (decoupled: Loshchilov and Hutter 2019).
    clip : float
        Largest norm of the gradient; 0 for no limit.
    ema : float
        Decay of the average of the weights per step; 0 for none.
    seed : int
    half : bool
        Compute in bfloat16 where that is safe.
    evaluate_every : int
        Steps between looks at the validation samples.
    patience : int
        Looks without improvement after which to stop; 0 never stops early.
    """

    steps: int = 6000
    batch: int = 4
    rows: int = 96
    columns: int = 208
    output_mode: str = "residual"
    loss: str = "l1"
    finish: str | None = None
    divergence: float = 1e-3
    learning_rate: float = 1e-3
    schedule: str = "cosine"
    epoch: int = 160
    betas: tuple[float, float] = (0.9, 0.999)
    decay: float = 1e-4
    clip: float = 5.0
    ema: float = 0.998
    seed: int = 0
    half: bool = True
    evaluate_every: int = 500
    patience: int = 0

    def __post_init__(self) -> None:
        if self.output_mode not in OUTPUT_MODES:
            raise OptionError(f"output_mode must be one of {', '.join(OUTPUT_MODES)}, got {self.output_mode!r}")
        for loss in (self.loss, self.loss if self.finish is None else self.finish):
            if loss not in LOSSES:
                raise OptionError(f"loss must be one of {', '.join(LOSSES)}, got {loss!r}")
        if self.schedule not in ("cosine", "paper"):
            raise OptionError(f"schedule must be cosine or paper, got {self.schedule!r}")
        for name in ("steps", "batch", "rows", "columns", "epoch", "evaluate_every"):
            check_integer(name, getattr(self, name), 1)
        for name in ("seed", "patience"):
            check_integer(name, getattr(self, name), 0)
        for name, high in (("learning_rate", 10.0), ("divergence", 1e6), ("decay", 1.0), ("clip", 1e9), ("ema", 1.0)):
            check_number(name, getattr(self, name), 0, high)
        if not isinstance(self.betas, (tuple, list)) or len(self.betas) != 2:
            raise OptionError(f"betas must be two numbers from 0 to 1, got {self.betas!r}")
        for beta in self.betas:
            check_number("betas", beta, 0, 0.999999)
        check_flag("half", self.half)
        if self.rows % 8 or self.columns % 8:
            raise OptionError(f"rows and columns must be multiples of 8, got {self.rows} and {self.columns}")


PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {
        "steps": 160_000, "batch": 1, "output_mode": "direct", "loss": "l1", "divergence": 256.0, "learning_rate": 5e-4,
        "schedule": "paper", "betas": (0.99, 0.999), "decay": 0.0, "clip": 0.0, "ema": 0.0, "half": False,
        "rows": 184, "columns": 616, "evaluate_every": 1600,
    },
}  # fmt: skip
"""Settings by name. "paper" is the recipe as printed: whole images, 1000 epochs of 160 frames, Adam(0.99, 0.999)."""
