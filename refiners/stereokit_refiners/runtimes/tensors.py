"""Refining torch tensors where they are: on a GPU, without a copy to the host.

`TensorRefiner` is `LearnedRefiner` of half-size maps in torch from end to end (scaling, network, upsampling). It takes
tensors, or anything that torch can view without a copy, such as the device arrays of numba or CuPy
(``__cuda_array_interface__``). `stereokit_refiners.runtimes.evidence_tensors` is the general refiner.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from stereokit.errors import InputError, OptionError
from stereokit_refiners.networks.layers import output_rule
from stereokit_refiners.runtimes.encode import BEGINNING
from stereokit_refiners.runtimes.torch import Module
from stereokit_refiners.weights import NETWORKS, WeightFile, find, read

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = [
    "TensorRefiner",
    "enlarged",
    "linear_on_device",
    "loaded_module",
    "refine_on_device",
    "running_on",
    "upscaled",
]

# Of the `step` pixels along one of a map: its share, and which next one has the rest, that before (0) or after (1).
_PHASES = {2: ((0.75, 0), (0.75, 1)), 4: ((0.625, 0), (0.875, 0), (0.875, 1), (0.625, 1))}


class TensorRefiner:
    """A learned refiner of tensors.

    Parameters
    ----------
    refiner : str or WeightFile
        A name ("stereovae", "cnn", "pyramid"), the path of a ``.safetensors`` file, or its content. The general refiner
        sees both images: see `stereokit_refiners.runtimes.evidence_tensors`.
    device : str
        Where to compute: "cuda", "cuda:1", "cpu".
    weights : str or None
        Of a name: a weight file, or a collection such as "kitti".

    Raises
    ------
    OptionError
        If torch has no such device, or the network sees more than a half-size map and the left image.
    FileError
        If the weights cannot be used.
    """

    def __init__(self, refiner: str | WeightFile, device: str = "cuda", *, weights: str | None = None) -> None:
        if isinstance(refiner, str):
            refiner = read(refiner) if refiner.endswith(".safetensors") else find(refiner, weights)
        try:
            self.device = torch.device(device)
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise OptionError(f"device must be one that torch has, got {device!r} ({reason})") from None
        self.content = refiner
        self.network = NETWORKS[refiner.network]
        if "evidence" in self.network.inputs:
            raise OptionError(
                f"refiner must be one that sees a half-size map alone, got {self.network.name!r}, "
                "which Matcher.on_device runs on a GPU"
            )
        self._rule = output_rule(self.network, refiner.output_mode)
        self._module = loaded_module(refiner, self.device)

    def __call__(self, coarse: Any, confidence: Any, left: Any, candidates: Any = None) -> Tensor:
        """Return the full-size map, on the device.

        Parameters
        ----------
        coarse : (ceil(H/2), ceil(W/2)) float32
            Half-size map in half-size pixels, without NaN.
        confidence : (ceil(H/2), ceil(W/2)) float32, or None
            The matcher's, 0 where nothing was measured; None for networks that do not look at it.
        left : (H, W) uint8
            Grey image.
        candidates : (2, ceil(H/2), ceil(W/2)) float32, or None
            The matcher's, half-size pixels; None for networks that do not look at them.

        Returns
        -------
        (H, W) float32 tensor, full-size pixels

        Raises
        ------
        InputError
            If the sizes do not fit one another.
        """
        for name, array in (("confidence", confidence), ("candidates", candidates)):
            if array is None and name in self.network.inputs:
                raise InputError(f"{name} must be given for refiner {self.network.name!r}, got None")
        disparity, image = (torch.as_tensor(x, device=self.device) for x in (coarse, left))
        sureness = (
            torch.zeros_like(disparity) if confidence is None else torch.as_tensor(confidence, device=self.device)
        )
        pair = torch.stack([disparity] * 2) if candidates is None else torch.as_tensor(candidates, device=self.device)
        if image.ndim != 2 or disparity.shape != ((image.shape[0] + 1) // 2, (image.shape[1] + 1) // 2):
            sizes = f"{tuple(disparity.shape)} and {tuple(image.shape)}"
            raise InputError(f"coarse must be (H/2, W/2), rounded up, of left (H, W), got {sizes}")
        if sureness.shape != disparity.shape:
            shapes = f"{tuple(disparity.shape)}, got {tuple(sureness.shape)}"
            raise InputError(f"confidence must have the shape of coarse {shapes}")
        if pair.shape != (2, *disparity.shape):
            rule = f"candidates must be two maps of the shape of coarse {tuple(disparity.shape)}"
            raise InputError(f"{rule}, got {tuple(pair.shape)}")
        rows, columns = image.shape
        height, width = disparity.shape
        below, beside = -height % self.network.stride, -width % self.network.stride
        with torch.inference_mode():
            maps = [disparity.float(), pair.float()] if "candidates" in self.network.inputs else [disparity.float()]
            lowest = torch.stack([one.min() for one in maps]).min()
            highest = torch.stack([one.max() for one in maps]).max()
            shift = _base_of(maps[0], lowest)
            disparity = _extended((disparity.float() - shift) * 2, below, beside)
            sureness = _extended(sureness.float(), below, beside)
            pair = _extended((pair.float() - shift) * 2, below, beside)
            gray = _extended(image.float(), 2 * (height + below) - rows, 2 * (width + beside) - columns)
            heads = self._module(self._encoded(disparity, sureness, pair, gray))
            full = self._rule.tensor_map(heads["map"], disparity, pair)
            return (full[0, 0, :rows, :columns] + 2 * shift).clamp(2 * lowest, 2 * highest).contiguous()

    def _encoded(self, disparity: Tensor, confidence: Tensor, candidates: Tensor, left: Tensor) -> dict[str, Tensor]:
        """Return the network's inputs: `stereokit_refiners.runtimes.encode.encode` in torch."""
        unit = self._rule.unit_inputs
        gray = left / 255 if unit else (left / 255 - 0.4) * 4
        encoded = {
            "disparity": disparity / 256 if unit else disparity / 16 - 1.5,
            "image": F.avg_pool2d(gray, 2),
            "phases": F.pixel_unshuffle(gray, 2),
            "confidence": confidence * 4 - 2,
            "candidates": candidates / 16 - 1.5,
        }
        return {name: encoded[name] for name in self.network.inputs}


def loaded_module(content: WeightFile, device: torch.device) -> Module:
    """Return a network with its weights on a device, ready to run."""
    module = Module(NETWORKS[content.network])
    module.load(content.arrays)
    module.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return module.eval().requires_grad_(False)


def refine_on_device(
    content: WeightFile, coarse: DeviceDisparity, left: Any, stream: Any
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Refine a map that lies on the GPU with a network; see `stereokit_refiners.contract.DeviceRefiner`."""
    with running_on(stream, left) as device:
        refined = _cached_refiner(content, str(device))(coarse.disparity, coarse.confidence, left, coarse.candidates)
        rows, columns = refined.shape
        sure = None if coarse.confidence is None else enlarged(_tensor(coarse.confidence), 2, rows, columns)
        return refined, enlarged(_tensor(coarse.valid), 2, rows, columns), sure


def linear_on_device(
    coarse: DeviceDisparity, left: Any, stream: Any, step: int = 2
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Upscale a map that lies on the GPU; see `stereokit_refiners.linear` and `DeviceRefiner`."""
    with running_on(stream, left):
        rows, columns = _tensor(left).shape
        known = enlarged(_tensor(coarse.valid), step, rows, columns)
        sure = None
        if coarse.confidence is not None:
            sure = upscaled(_tensor(coarse.confidence), 1, rows, columns, step) * (known != 0)
        return upscaled(_tensor(coarse.disparity), step, rows, columns, step), known, sure


def upscaled(image: Tensor, gain: float, rows: int, columns: int, step: int = 2) -> Tensor:
    """Return what `stereokit_refiners.linear.Linear` makes of an image: the same operations in order, the same bits."""
    if step == 1:
        return image[:rows, :columns] * gain
    for axis, factor in ((0, gain), (1, 1)):
        ends = image.narrow(axis, 0, 1), image.narrow(axis, image.shape[axis] - 1, 1)
        before = torch.cat([ends[0], image.narrow(axis, 0, image.shape[axis] - 1)], axis)
        after = torch.cat([image.narrow(axis, 1, image.shape[axis] - 1), ends[1]], axis)
        phases = [(image * share + (before, after)[side] * (1 - share)) * factor for share, side in _PHASES[step]]
        image = torch.stack(phases, axis + 1).flatten(axis, axis + 1)
    return image[:rows, :columns].contiguous()


def _base_of(disparity: Tensor, lowest: Tensor) -> Tensor:
    """Return what `base_of` returns of a map, (h, w), and the lowest value of all maps; the host never sees it."""
    width = disparity.shape[1]
    columns = torch.arange(width, device=disparity.device)
    hidden = columns < disparity.median().clamp(max=width // 2)
    seen = disparity.masked_fill(hidden, torch.inf).reshape(-1)
    first = torch.kthvalue(seen, seen.numel() // 100 + 1).values
    return torch.where(lowest < 0, lowest.floor(), (first - BEGINNING).floor().clamp(min=0))


def _tensor(array: Any) -> Tensor:
    """Return an array as a tensor of the same memory."""
    return torch.as_tensor(array)


@lru_cache(maxsize=8)
def _cached_refiner(content: WeightFile, device: str) -> TensorRefiner:
    return TensorRefiner(content, device)


@contextmanager
def running_on(stream: Any, left: Any) -> Iterator[torch.device]:
    """Run torch's work on a stream of numba; yield the device that `left` lies on."""
    device = _tensor(left).device
    if device.type != "cuda":
        yield device
        return
    address = int(stream)
    chosen: Any = torch.cuda.default_stream(device)
    if address:
        chosen = torch.cuda.ExternalStream(address, device=device)  # type: ignore[no-untyped-call]
    with torch.cuda.stream(chosen):
        yield device


def enlarged(image: Tensor, step: int, rows: int, columns: int) -> Tensor:
    """Return each pixel ``step * step`` times, cut to a size; a copy."""
    large = image.repeat_interleave(step, 0).repeat_interleave(step, 1)
    return large[:rows, :columns].contiguous()


def _extended(image: Tensor, below: int, beside: int) -> Tensor:
    """Return (..., rows, columns) as (1, ..., rows + below, columns + beside), its border repeated; at least 1 map."""
    return F.pad(image.reshape(1, -1, *image.shape[-2:]), (0, beside, 0, below), mode="replicate")
