"""StereoVAE (Chang et al., ICRA 2023, table I) and its sibling without the latent, the paper's "non-VAE NN".

Two 5x5 convolutions read the coarse disparity and the half-size grey image; an encoder halves the size twice, a
decoder doubles it three times, "R" blocks append what they compute to what they read. In between, StereoVAE squeezes
everything through one latent channel of means and log standard deviations, drawn from while training and taken at
its mean at inference.

Table I leaves open what follows the 1x1 layers of mean and deviation and the last layer: nothing does, here. 162,380
parameters, and 136,618 without the latent, as a count of the table gives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from stereokit_refiners.networks.layers import Layer, Ops
from stereokit_refiners.outputs import Direct, Output, Residual

__all__ = ["NonVae", "StereoVae"]


def _table(latent: bool) -> tuple[Layer, ...]:
    wide = 80 if latent else 48  # D_1, EN_2 and EN_2_R, or the last two alone
    middle = (
        Layer("MU", 48, 1, kernel=1),
        Layer("SIGMA", 48, 1, kernel=1),
        Layer("D_1", 1, 32, kernel=1),
    )
    return (
        Layer("FE_1", 1, 32),
        Layer("FE_2", 1, 32),
        Layer("EN_1", 64, 16, stride=2),
        Layer("EN_1_R", 16, 8),
        Layer("EN_2", 24, 32, stride=2),
        Layer("EN_2_R", 32, 16),
        *(middle if latent else ()),
        Layer("D_1_R", wide, 16),
        Layer("D_2", wide + 16, 16, up=True),
        Layer("D_2_R", 40, 8),
        Layer("D", 48, 16, up=True),
        Layer("Y", 81, 1, up=True),
    )


@dataclass(frozen=True)
class StereoVae:
    """Table I, layer by layer: half-size disparity and image in, full-size map out."""

    name: ClassVar[str] = "stereovae"
    layers: ClassVar[tuple[Layer, ...]] = _table(latent=True)
    inputs: ClassVar[dict[str, int]] = {"disparity": 1, "image": 1}
    stride: ClassVar[int] = 4
    innermost: ClassVar[bool] = False
    outputs: ClassVar[Mapping[str, Output]] = {"residual": Residual(), "direct": Direct()}
    latent: ClassVar[bool] = True

    def forward(self, ops: Ops[Any], inputs: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``map``, the phases of Y, and for the loss ``mean`` and ``log_sigma`` of the latent."""
        heads: dict[str, Any] = {}
        x0, x1 = inputs["disparity"], inputs["image"]
        fe_1 = ops.conv("FE_1", [x0])
        fe_2 = ops.conv("FE_2", [x1])
        en_1 = ops.conv("EN_1", [fe_1, fe_2])
        en_1_r = ops.conv("EN_1_R", [en_1])
        en_2 = ops.conv("EN_2", [en_1, en_1_r])
        en_2_r = ops.conv("EN_2_R", [en_2])
        below = [en_2, en_2_r]
        if self.latent:
            # z = (mu - 1) + eps * exp(sigma - 1): equation 7
            heads["mean"] = ops.shift(ops.conv("MU", below, activate=False), -1.0)
            heads["log_sigma"] = ops.shift(ops.conv("SIGMA", below, activate=False), -1.0)
            z = ops.sample(heads["mean"], heads["log_sigma"])
            below = [ops.conv("D_1", [z]), *below]
        d_1_r = ops.conv("D_1_R", below)
        d_2 = ops.conv("D_2", [*below, d_1_r])
        d_2_r = ops.conv("D_2_R", [d_2, en_1, en_1_r])
        d = ops.conv("D", [d_2, en_1, en_1_r, d_2_r])
        heads["map"] = ops.conv_transpose_phases("Y", [d, x0, fe_1, fe_2])
        return heads


@dataclass(frozen=True)
class NonVae(StereoVae):
    """The same encoder and decoder with the latent taken out (``D_1`` gone, ``D_1_R`` reads the encoder)."""

    name: ClassVar[str] = "cnn"
    layers: ClassVar[tuple[Layer, ...]] = _table(latent=False)
    latent: ClassVar[bool] = False
