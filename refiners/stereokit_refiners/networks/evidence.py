"""A refiner for every camera: it chooses among values by how well each fits the two images.

For each full-size pixel there are seven values to choose from, `VALUES`: the coarse map upscaled linearly, the same a
little less and a little more, the smallest and the largest coarse value nearby, and the matcher's two candidates. For
each of them the images say how well it fits: the Hamming distance of census transforms at full size
(`stereokit_refiners.runtimes.evidence`). The output is a weighted mean of the values; a weight's logit is what the
network says for the place, plus gains, also the network's, times the evidence right there, averaged over a small window
and a larger one. So context of some hundred pixels, at a quarter of the size, decides together with evidence. Weights
stand for 2x2 pixels each.

Nothing that the network sees depends on the size of the disparities or on the grey level, only on differences: adding
a constant to all disparities adds it to the output.

The trunk is small enough for processors without 8-bit instructions: all of it works at 1/4 of the size and below.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from stereokit_refiners.networks.layers import Layer, Ops
from stereokit_refiners.outputs import Output

__all__ = ["CHANNELS", "GAINS", "LOGITS", "STEPS", "VALUES", "WINDOWS", "Evidence"]

VALUES = ("coarse", "less", "more", "lowest", "highest", "candidate", "rival")
"""What a pixel chooses from. The logit of the first is 0."""

STEPS = 40
"""Steps of the network's input to a unit. It comes in bytes, and weights are for these."""

CHANNELS = {
    "grey": 16,  # locally normalised, by pixel of the 4x4
    "confidence": 4,  # by 2x2 of the 4x4, and so are all that have four channels a value
    "relief": 4,  # the coarse map less its local mean
    "values": 16,  # the last four of `VALUES` less the coarse map
    "cost": 4,  # of the coarse map
    "gain": 24,  # how much less the others cost
    "surface": 20,  # what the right view has where a value points to, less the value: `VALUES` but "less" and "more"
    "outside": 1,  # share of the coarse matches outside the right image
    "scale": 1,  # at which was matched
}
"""Channels of the network's input, at a quarter of the size."""

WINDOWS = (3, 7)
"""Sides of the windows over which evidence is averaged, in 2x2 pixels."""

LOGITS = 4 * (len(VALUES) - 1)
"""Channels of the head that are logits: value by value, each by 2x2 of the 4x4."""

GAINS = 2 * len(WINDOWS)
"""Then come the gains of the evidence: for each window that for "less" and "more", and that for the others. Last come
four logits of how sure the result is, by 2x2 of the 4x4."""

_A, _B, _C, _D = 16, 24, 48, 64


@dataclass(frozen=True)
class Evidence:
    """Three levels down, three up by addition, a head that is read in phases."""

    name: ClassVar[str] = "evidence"
    layers: ClassVar[tuple[Layer, ...]] = (
        Layer("stem", sum(CHANNELS.values()), _A, kernel=1),
        Layer("down_1", _A, _B, kernel=3, stride=2),
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
        Layer("merge_0", _A, _A, kernel=1),
        Layer("head", _A, LOGITS + GAINS + 4, kernel=1),
    )
    inputs: ClassVar[dict[str, int]] = {"evidence": sum(CHANNELS.values())}
    stride: ClassVar[int] = 8
    innermost: ClassVar[bool] = True
    outputs: ClassVar[Mapping[str, Output | None]] = {"residual": None}  # see `runtimes.mixture`
    latent: ClassVar[bool] = False

    def forward(self, ops: Ops[Any], inputs: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``map``: logits, gains and sureness."""

        def block(name: str, x: Any) -> Any:
            inner = ops.conv(f"{name}b", [ops.conv(f"{name}a", [x])], activate=False)
            return ops.activate(name, ops.add(x, inner))

        def up(name: str, low: Any, skip: Any) -> Any:
            return ops.activate(f"{name}_sum", ops.add(skip, ops.repeat(ops.conv(name, [low], activate=False))))

        a = ops.conv("stem", [inputs["evidence"]])
        b = ops.conv("down_1", [a])
        c = block("block_2", ops.conv("down_2", [b]))
        d = block("block_3", ops.conv("down_3", [c]))
        c = ops.conv("merge_2", [up("up_3", d, c)])
        b = ops.conv("merge_1", [up("up_2", c, b)])
        a = ops.conv("merge_0", [up("up_1", b, a)])
        return {"map": ops.conv("head", [a], activate=False)}
