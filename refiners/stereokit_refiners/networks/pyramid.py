"""A pyramid that chooses among coarse values rather than inventing new ones.

What a half-size map gets wrong is mostly *where* a disparity ends, not its value: windows and smoothing drag the
foreground over its edge. So the output is a mixture: each full-size pixel is a weighted mean, the weights from a
softmax, of the coarse values at `OFFSETS` around it, after a small correction of those values, plus a small residual
(`stereokit_refiners.outputs.mixture`). Sharp edges stay sharp, because a weight near one copies a value from one side.
The two `candidates` of the matcher can be chosen too: its best value before any check or filter, and the best rival.
In a fifth of the pixels that stay wrong without them one of the two is right.

The work is spent at 1/4, 1/8 and 1/16 of the full size with 3x3 kernels: a receptive field of several hundred pixels
at the arithmetic of the paper's network. The image comes in at full size, its four phases as channels, and the map
with the matcher's confidence: the fifth of the pixels that it is least sure of has half of the errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from stereokit_refiners.networks.layers import Layer, Ops, added_to, block
from stereokit_refiners.outputs import Mixture, Output

__all__ = ["OFFSETS", "Pyramid"]

OFFSETS = (
    *((dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)),
    (-3, 0), (0, -3), (0, 3), (3, 0),
)  # fmt: skip
"""Where the coarse values lie that a pixel chooses from, rows and columns of the half-size map."""

_RULE = Mixture(OFFSETS)

_A, _B, _C, _D, _E = 16, 40, 48, 48, 20


@dataclass(frozen=True)
class Pyramid:
    """Three levels down with residual blocks, three up by addition, a mixture on top."""

    name: ClassVar[str] = "pyramid"
    layers: ClassVar[tuple[Layer, ...]] = (
        Layer("stem", 8, _A, kernel=3),
        Layer("down_1", _A, _B, kernel=3, stride=2),
        Layer("block_1a", _B, _B, kernel=3),
        Layer("block_1b", _B, _B, kernel=3),
        Layer("down_2", _B, _C, kernel=3, stride=2),
        Layer("block_2a", _C, _C, kernel=3),
        Layer("block_2b", _C, _C, kernel=3),
        Layer("down_3", _C, _D, kernel=3, stride=2),
        Layer("block_3a", _D, _D, kernel=3),
        Layer("block_3b", _D, _D, kernel=3),
        Layer("up_3", _D, _C, kernel=1),
        Layer("merge_2", _C, _C, kernel=3),
        Layer("up_2", _C, _B, kernel=1),
        Layer("merge_1", _B, _B, kernel=3),
        Layer("up_1", _B, _A, kernel=1),
        Layer("merge_0", _A, _E, kernel=3),
        Layer("head", _E, _RULE.channels, kernel=1),
    )
    inputs: ClassVar[dict[str, int]] = {"disparity": 1, "confidence": 1, "phases": 4, "candidates": 2}
    stride: ClassVar[int] = 8
    innermost: ClassVar[bool] = False
    outputs: ClassVar[Mapping[str, Output]] = {"residual": _RULE}
    latent: ClassVar[bool] = False

    def forward(self, ops: Ops[Any], inputs: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``map``: a correction of the coarse map, four phases of residuals, four times the weights' logits."""
        a = ops.conv("stem", [inputs[name] for name in self.inputs])
        b = block(ops, "block_1", ops.conv("down_1", [a]))
        c = block(ops, "block_2", ops.conv("down_2", [b]))
        d = block(ops, "block_3", ops.conv("down_3", [c]))
        c = ops.conv("merge_2", [added_to(ops, "up_3", c, d, ops.upsample2x)])
        b = ops.conv("merge_1", [added_to(ops, "up_2", b, c, ops.upsample2x)])
        a = ops.conv("merge_0", [added_to(ops, "up_1", a, b, ops.upsample2x)])
        return {"map": ops.conv("head", [a], activate=False)}
