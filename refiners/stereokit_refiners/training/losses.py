"""What refiners are trained on.

The paper's first loss is ``|noc - Y| + |occ - Y|``, each over its own known pixels, so that pixels of both count
twice (`stereokit_refiners.training.samples.Crop` carries the weights). Its second is printed as something that is no
divergence; equation 7 makes ``sigma - 1`` a log standard deviation, and the Kullback-Leibler divergence of
``N(mu - 1, exp(sigma - 1))`` from ``N(0, 1)`` is then ``(m**2 + exp(2 s) - 1 - 2 s) / 2`` with ``m = mu - 1``,
``s = sigma - 1``: that is what is used.
"""

from __future__ import annotations

import torch
from torch import Tensor

from stereokit.errors import OptionError
from stereokit_refiners.training.settings import LOSSES

__all__ = ["LOSSES", "distance", "divergence"]


def distance(kind: str, error: Tensor, truth: Tensor) -> Tensor:
    """Return the loss of each pixel.

    Parameters
    ----------
    kind : {"l1", "bounded", "d1"}
        The absolute error; one that grows like it up to a few pixels and then hardly any more, so that hopeless
        pixels do not decide; and one that adds a soft count of KITTI's outliers, over 3 pixels and 5 %.
    error : Tensor
        Estimate minus truth, pixels.
    truth : Tensor
        Pixels.
    """
    size = error.abs()
    if kind == "l1":
        return size
    if kind == "bounded":
        return 4 * size / (size + 3) + 0.1 * size
    if kind == "d1":
        limit = (0.05 * truth).clamp(min=3)
        return 0.25 * size.clamp(max=20) + 3 * torch.sigmoid(2 * (size - limit))
    raise OptionError(f"loss must be one of {', '.join(LOSSES)}, got {kind!r}")


def divergence(mean: Tensor, log_sigma: Tensor) -> Tensor:
    """Return the mean Kullback-Leibler divergence from the standard normal distribution, nats per latent value."""
    return 0.5 * (mean.square() + torch.exp(2 * log_sigma) - 1 - 2 * log_sigma).mean()
