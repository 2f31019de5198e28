"""The refiner of the network `stereokit_refiners.networks.evidence.Evidence` on torch tensors, where they are.

`hypotheses` and `network_input` are those of `stereokit_refiners.runtimes`, operation by operation: the same
integers and floats, bit for bit. `mixture` is that of `stereokit_refiners.runtimes.mixture` but for its exponentials,
and the network runs in fp32. Nothing is copied to the host, no shape depends on the values, and nothing is waited for.

Eager torch computes one IEEE operation at a time, so that no product and sum become one operation. Three of its forms
are avoided: on a GPU a division by a Python number is a product with its reciprocal, and everywhere so is one of a
number by a tensor; on a processor a square root may be wrong in its last bit, but not as a float64 that is rounded.
Sums of floats are written out, because reductions have an order of their own.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from stereokit_refiners.networks.evidence import GAINS, LOGITS, STEPS, VALUES, WINDOWS
from stereokit_refiners.runtimes.evidence import MOST_GAIN, MULTIPLE
from stereokit_refiners.runtimes.evidence_rows import BLIND, REACH
from stereokit_refiners.runtimes.tensors import enlarged, loaded_module, running_on
from stereokit_refiners.runtimes.torch import Module
from stereokit_refiners.weights import WeightFile

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = ["TensorHypotheses", "hypotheses", "mixture", "network_input", "weigh_on_device"]

_NONE = -1e9  # where the right view has no surface
# The eight neighbours, and the eight that a knight of chess reaches; their order is nothing to a Hamming distance.
_NEIGHBOURS = tuple((i, j) for i in range(5) for j in range(5) if i % 2 or j % 2)


class TensorHypotheses(NamedTuple):
    """The values to choose from and their evidence: `stereokit_refiners.runtimes.evidence.Hypotheses` as tensors.

    Attributes
    ----------
    base : () int32
    step : {1, 2, 4}
    coarse : (H, W) float32
    half : (H/2, W/2) float32
    others : (4, H/2, W/2) float32
    cost : (H/2, W/2) int32
    gains : (6, H/2, W/2) int32
    """

    base: Tensor
    step: int
    coarse: Tensor
    half: Tensor
    others: Tensor
    cost: Tensor
    gains: Tensor

    @property
    def apart(self) -> int:
        """How far "less" and "more" are from the coarse map, full-size pixels."""
        return _apart(self.step)


def weigh_on_device(
    content: WeightFile, coarse: DeviceDisparity, left: Any, right: Any, step: int, stream: Any, passes: int = 1
) -> tuple[Tensor, Tensor, Tensor]:
    """Refine a map that lies on the GPU by evidence from both images; see `stereokit_refiners.contract.DeviceRefiner`.

    Parameters
    ----------
    content : WeightFile
        Of the network "evidence".
    coarse : DeviceDisparity
        With confidence and candidates; dense.
    left, right : (H, W) uint8 on the device
    step : {1, 2, 4}
        Full-size pixels of a coarse pixel.
    stream : numba stream
    passes : int
        How often; from the second time on its own map.

    Returns
    -------
    disparity, valid, confidence : (H, W) float32, uint8, float32 tensors
    """
    with running_on(stream, left) as device:
        module = _cached_module(content, str(device))
        arrays = coarse.disparity, coarse.candidates, coarse.confidence, coarse.valid, left, right
        disparity, candidates, confidence, known, one, other = (torch.as_tensor(array) for array in arrays)
        rows, columns = one.shape
        with torch.inference_mode():
            known = enlarged(known, step, rows, columns)
            for _ in range(passes):
                values = hypotheses(disparity, candidates, one, other, step)
                channels = network_input(values, confidence, one, columns)
                head = module({"evidence": channels[None]})["map"][0]
                disparity, confidence = mixture(head, values, rows, columns)
                candidates = torch.stack([enlarged(each, step, rows, columns) * step for each in candidates])
                step = 1
            return disparity, known, confidence


@lru_cache(maxsize=8)
def _cached_module(content: WeightFile, device: str) -> Module:
    return loaded_module(content, torch.device(device))


def hypotheses(disparity: Tensor, candidates: Tensor, left: Tensor, right: Tensor, step: int) -> TensorHypotheses:
    """Return the values and their evidence for a pair: `stereokit_refiners.runtimes.evidence.hypotheses`.

    Parameters
    ----------
    disparity : (h, w) float32
        Coarse map, coarse pixels, without NaN.
    candidates : (2, h, w) float32
        The matcher's candidates, coarse pixels.
    left, right : (rows, columns) uint8
        Full-size images; h and w are theirs divided by `step`, rounded up.
    step : {1, 2, 4}

    Returns
    -------
    TensorHypotheses
        At the size of the images, extended to multiples of `MULTIPLE`; on their device.
    """
    rows, columns = left.shape
    height, width = (-(-side // MULTIPLE) * MULTIPLE for side in (rows, columns))
    fixed = torch.floor(torch.cat([disparity[None], candidates]) * 256 + 0.5) * (1 / 256)
    lowest = fixed[0].min().floor()
    fixed = (fixed - lowest) * step
    near = _extended(fixed[0], height // step, width // step)[None, None]
    coarse = near if step == 1 else F.interpolate(near, scale_factor=step, mode="bilinear", align_corners=False)
    coarse = coarse[0, 0]
    others = torch.cat([_extremes(near, step), _on_grid(fixed[1:], step, height, width)])
    base = (lowest * step).int()
    half = _sum_by_two(coarse) * 0.25
    bits = _census(torch.stack([left, right]), height, width)
    totals = _costs(bits, coarse, others, base, columns, _apart(step))
    gains = ((totals[0] - totals[1:]) >> 1).clamp(-MOST_GAIN, MOST_GAIN)
    return TensorHypotheses(base, step, coarse, half, others, totals[0] >> 1, gains)


def _apart(step: int) -> int:
    return 2 if step == 4 else 1


def _at(maps: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Return the values of (..., h, w) at rows and columns, of which those outside are the border's."""
    for axis, places in ((-2, rows), (-1, columns)):
        maps = maps.index_select(axis, places.clamp(0, maps.shape[axis] - 1))
    return maps


def _extended(maps: Tensor, height: int, width: int, before: int = 0) -> Tensor:
    """Return (..., h, w) as (..., height, width): `before` rows and columns more before, the others after."""
    sides = (torch.arange(-before, side - before, device=maps.device) for side in (height, width))
    return _at(maps, *sides)


def _on_grid(maps: Tensor, step: int, height: int, width: int) -> Tensor:
    """Return coarse maps (..., h, w) for each 2x2 pixels of full size, (..., H/2, W/2)."""
    sides = (torch.arange(0, side, 2, device=maps.device) // step for side in (height, width))
    return _at(maps, *sides)


def _extremes(near: Tensor, step: int) -> Tensor:
    """Return the smallest and the largest value around each 2x2 pixels, (2, H/2, W/2), of a map (1, 1, h, w)."""
    both = torch.cat([-near, near])
    large = F.max_pool2d(both, 2 * REACH + 1, stride=2 if step == 1 else 1, padding=REACH)[:, 0]
    large = torch.stack([-large[0], large[1]])
    return large.repeat_interleave(2, 1).repeat_interleave(2, 2) if step == 4 else large


def _sum_by_two(plane: Tensor) -> Tensor:
    """Return the sums over 2x2, in the order of the compiled loops."""
    upper, lower = plane[::2], plane[1::2]
    return upper[:, ::2] + lower[:, ::2] + upper[:, 1::2] + lower[:, 1::2]


def _census(images: Tensor, height: int, width: int) -> Tensor:
    """Return 16 bits a pixel of (n, rows, columns) images, (n, height, width) int32."""
    wide = _extended(images, height + 6, width + 6, 3).short()
    lines = wide[:, :-2] + 4 * wide[:, 1:-1] + wide[:, 2:]
    smooth = lines[:, :, :-2] + 4 * lines[:, :, 1:-1] + lines[:, :, 2:]
    centre = smooth[:, 2:-2, 2:-2]
    bits = torch.zeros(centre.shape, dtype=torch.int32, device=images.device)
    for k, (i, j) in enumerate(_NEIGHBOURS):
        bits.add_(smooth[:, i : i + height, j : j + width] < centre, alpha=1 << k)
    return bits


def _ones(v: Tensor) -> Tensor:
    """Return the number of ones in 16 bits."""
    v = v - ((v >> 1) & 0x5555)
    v = (v & 0x3333) + ((v >> 2) & 0x3333)
    v = (v + (v >> 4)) & 0x0F0F
    return (v + (v >> 8)) & 31


def _costs(bits: Tensor, coarse: Tensor, others: Tensor, base: Tensor, columns: int, apart: int) -> Tensor:
    """Return the cost of each value, (7, H/2, W/2) int32, eighths of a bit: of two of the 2x2 pixels, summed."""
    height, width = others.shape[1:]
    mine = torch.stack([bits[0, s::2, s::2] for s in (0, 1)])
    theirs = bits[1].reshape(height, 2, 2 * width).transpose(0, 1)
    own = torch.stack([coarse[s::2, s::2] for s in (0, 1)])
    values = torch.cat([own[None].expand(3, -1, -1, -1), others[:, None].expand(-1, 2, -1, -1)])
    eighths = torch.floor(values * 8 + 0.5).int()
    first = torch.arange(0, 2 * width, 2, device=bits.device, dtype=torch.int32)
    place = torch.stack([first, first + 1])[:, None] - base - (eighths >> 3)
    place[VALUES.index("less")] += apart
    place[VALUES.index("more")] -= apart
    part = eighths & 7
    places = torch.stack([place, place - 1])
    seen = theirs.expand(2, len(VALUES), -1, -1, -1).gather(-1, places.clamp(0, 2 * width - 1).long())
    differing = _ones(seen ^ mine).masked_fill((places < 0) | (places >= columns), BLIND)
    total = 8 * differing[0] + part * (differing[1] - differing[0])
    return total[:, 0] + total[:, 1]


def network_input(values: TensorHypotheses, confidence: Tensor, left: Tensor, columns: int) -> Tensor:
    """Return the network's input: `stereokit_refiners.runtimes.features.network_input`.

    Parameters
    ----------
    values : TensorHypotheses
    confidence : (h, w) float32
        The matcher's, 0 to 1.
    left : (rows, columns) uint8
        Full-size image.
    columns : int
        Of the right image.

    Returns
    -------
    (C, H/4, W/4) float32
        Whole numbers from -128 to 127.
    """
    height, width = values.coarse.shape
    image = _extended(left, height, width)
    grey, inverse, relief = _averages(image, values.half)
    levels = (image.float() - _by(4, grey)) * _by(4, inverse)
    half, others, cost = values.half, values.others, values.cost
    planes = torch.cat(
        [
            _whole(_on_grid(confidence, values.step, height, width) * (4 * STEPS) - 2 * STEPS)[None],
            _squashed(half - _by(2, relief), 8)[None],
            _squashed(others - half, 2),
            (((cost * 5) >> 2) - STEPS)[None],
            values.gains,
        ]
    )
    surface, away = _surfaces(values, (columns + 1) // 2)
    outside = _blocks(away[None], 2).sum(0, dtype=torch.int32) * (STEPS // 4)
    scale = torch.full_like(outside, {1: -STEPS, 2: 0, 4: STEPS}[values.step])
    return torch.cat(
        [
            _blocks(_whole(levels.clamp(-3 * STEPS, 3 * STEPS))[None], 4),
            _blocks(planes, 2),
            _blocks(surface, 2),
            outside[None].float(),
            scale[None].float(),
        ]
    )


def _by(times: int, plane: Tensor) -> Tensor:
    """Return each pixel of (..., h, w) ``times * times`` times."""
    return plane.repeat_interleave(times, -2).repeat_interleave(times, -1)


def _blocks(planes: Tensor, side: int) -> Tensor:
    """Return (n, side * h, side * w) as (n * side * side, h, w): the pixels of each block as channels, row by row."""
    count, rows, columns = planes.shape
    cut = planes.reshape(count, rows // side, side, columns // side, side)
    return cut.permute(0, 2, 4, 1, 3).reshape(-1, rows // side, columns // side)


def _averages(image: Tensor, half: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean grey level around 4x4 pixels, one over the spread there, in steps, and the mean coarse map."""
    grey = image.int()
    sums = torch.stack([_blocks(plane[None], 4).sum(0, dtype=torch.int32) for plane in (grey, grey * grey)])
    mean, square = _window_sum(sums.float() * (1 / 16), 4) * (1 / 81)
    spread = (square - mean * mean).clamp(min=0).double().sqrt().float()
    relief = _window_sum((_sum_by_two(half) * 0.25)[None], 8)[0] * (1 / 289)
    return mean, torch.full_like(spread, STEPS) / (spread + 3), relief


def _window_sum(planes: Tensor, reach: int) -> Tensor:
    """Return the sums over windows of (n, h, w), down first, in the order of the compiled loops."""
    for axis in (-2, -1):
        side = planes.shape[axis]
        places = torch.arange(-reach, side + reach, device=planes.device).clamp(0, side - 1)
        wide = planes.index_select(axis, places)
        planes = torch.zeros_like(planes)
        for k in range(2 * reach + 1):
            planes += wide.narrow(axis, k, side)
    return planes


def _whole(x: Tensor) -> Tensor:
    return torch.floor(x + 0.5)


def _squashed(x: Tensor, unit: int) -> Tensor:
    """Return x between -2 and 2, in steps."""
    return _whole(x / (x.abs() + unit) * (2 * STEPS))


def _surfaces(values: TensorHypotheses, reach: int) -> tuple[Tensor, Tensor]:
    """Return the nearest surface of the right view where each value points to, less the value, and what lies outside.

    The right view's map is the left one's, each pixel moved to where it is seen; it has `reach` places and one more at
    either end, where nothing is.

    Returns
    -------
    surface : (5, H/2, W/2) float32
        Squashed; of the coarse map and the other values, 0 where nothing is.
    outside : (H/2, W/2) bool
        Whether the coarse map points outside the right image.
    """
    half = values.half
    rows, width = half.shape
    even = torch.arange(0, 2 * width, 2, device=half.device, dtype=torch.int32)
    origin = (even - values.base).float()
    place = torch.floor((origin - half) * 0.5).long() + 1
    nearest = torch.full((rows, reach + 2), _NONE, device=half.device)
    for more in (0, 1):
        to = (place[:, :reach] + more).clamp(0, reach + 1)
        nearest.scatter_reduce_(1, to, half[:, :reach], "amax")
    nearest[:, 0] = _NONE
    nearest[:, reach + 1] = _NONE
    pointed = torch.cat([half[None], values.others])
    to = (torch.floor((origin - pointed) * 0.5 + 0.5).long() + 1).clamp(0, reach + 1)
    there = nearest.expand(len(pointed), -1, -1).gather(-1, to)
    beyond = (there - pointed).masked_fill(there < _NONE / 2, 0)
    return _squashed(beyond, 2), (place < 1) | (place > reach)


def mixture(head: Tensor, values: TensorHypotheses, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """Return the map, and how sure it is: `stereokit_refiners.runtimes.mixture.mixture`.

    Parameters
    ----------
    head : (C, H/4, W/4) float32
    values : TensorHypotheses
    rows, columns : int
        Size of the map, at most H x W.

    Returns
    -------
    disparity : (rows, columns) float32, pixels
    sure : (rows, columns) float32
        0 to 1.
    """
    prior = F.pixel_shuffle(head[None, :LOGITS], 2)[0]
    near = F.pad(values.gains.float(), [max(WINDOWS) // 2] * 4, mode="replicate")
    for n, side in enumerate(WINDOWS):
        cut = (max(WINDOWS) - side) // 2
        inner = near[:, cut : near.shape[1] - cut, cut : near.shape[2] - cut]
        sums = F.avg_pool2d(inner, side, stride=1, divisor_override=1)
        share, rest = (_by(2, head[LOGITS + 2 * n + k] * (1 / 16 / side**2)) for k in (0, 1))
        prior = prior + torch.cat([sums[:2] * share, sums[2:] * rest])
    weights = prior.clamp(-40, 40).exp()
    own = 1 + weights[0] + weights[1]
    other = (weights[1] - weights[0]) * values.apart + (weights[2:] * values.others).sum(0)
    total = own + weights[2:].sum(0)
    own, other = _by(2, own / total), _by(2, other / total)
    full = values.coarse * own + other + values.base.float()
    sure = _by(2, torch.sigmoid(F.pixel_shuffle(head[None, LOGITS + GAINS :], 2)[0, 0]))
    return full[:rows, :columns].contiguous(), sure[:rows, :columns].contiguous()
