"""Learned refiners: a network's weights behind the contract of `stereokit_refiners.contract`."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError
from stereokit.notices import warn
from stereokit.postprocess import fill
from stereokit.registry import REFINERS
from stereokit.result import Disparity
from stereokit_refiners.contract import on_tensors
from stereokit_refiners.linear import doubled, enlarged
from stereokit_refiners.runtimes.choice import CompiledNetwork, backend_named, precision_named
from stereokit_refiners.runtimes.encode import base_of, encode
from stereokit_refiners.runtimes.evidence import hypotheses
from stereokit_refiners.runtimes.features import network_input
from stereokit_refiners.runtimes.mixture import mixture
from stereokit_refiners.weights import WeightFile, find, network_named

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = [
    "CnnRefiner",
    "LearnedRefiner",
    "PyramidRefiner",
    "StereoVaeRefiner",
    "learned_names",
    "right_of",
]

_FEW = 0.01  # of the pixels may lie beyond the disparities of the training


@dataclass(frozen=True, eq=False)
class LearnedRefiner:
    """A refiner that is a network.

    Parameters
    ----------
    weights : str or None
        A weight file, or the name of an installed collection, such as ``"kitti"``; None takes those that come with the
        package.
    backend : {"auto", "openvino", "onnxruntime", "torch", "opencv"}
        What runs the network; "auto" is the first that is installed.
    precision : {"auto", "fp32", "bf16", "int8"}
        bf16 and int8 need OpenVINO. "auto" is the fastest that this processor has instructions for.

    Raises
    ------
    OptionError
        If an option breaks its rule, or the two do not go together.
    FileError
        If the weights cannot be used.
    StereokitError
        If the backend is not installed.
    """

    weights: str | None = None
    backend: str = "auto"
    precision: str = "auto"
    architecture: ClassVar[str] = ""
    maps_are_new: ClassVar[bool] = True
    """Whether the matcher may write to the maps that it returns."""
    of_half_size: ClassVar[bool] = True
    """Whether it is one of half-size maps alone: commands give their option for weights to these first."""
    _file: WeightFile = field(init=False, repr=False, compare=False)
    _compiled: CompiledNetwork = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.weights is None and not self.architecture:
            raise OptionError("refiner 'file' needs weights, the path of a .safetensors file, got none")
        if not isinstance(self.weights, (str, os.PathLike, type(None))):
            raise OptionError(f"weights must be the path of a .safetensors file, got {self.weights!r}")
        self._use(find(self.architecture, self.weights))

    @classmethod
    def of(cls, content: WeightFile, *, backend: str = "auto", precision: str = "auto") -> LearnedRefiner:
        """Return a refiner of weights that are in memory."""
        refiner = object.__new__(cls)
        for name, value in (("weights", None), ("backend", backend), ("precision", precision)):
            object.__setattr__(refiner, name, value)
        refiner._use(content)
        return refiner

    def _use(self, content: WeightFile) -> None:
        object.__setattr__(self, "_file", content)
        object.__setattr__(self, "backend", backend_named(self.backend))
        object.__setattr__(self, "precision", precision_named(self.precision, self.backend, content))
        object.__setattr__(self, "_compiled", CompiledNetwork(content, self.backend, self.precision))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, LearnedRefiner) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def __getstate__(self) -> dict[str, Any]:
        names = ("weights", "backend", "precision", "_file")
        return {name: getattr(self, name) for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        content = state.pop("_file")
        for name, value in state.items():
            object.__setattr__(self, name, value)
        self._use(content)

    @property
    def fingerprint(self) -> str:
        """What the result depends on, beside the inputs."""
        return f"{self._file.fingerprint}-{self._compiled.backend}-{self._compiled.precision}"

    @property
    def trained_on(self) -> frozenset[str]:
        """The frames that the weights were trained on, ``DATASET/NAME``, as far as their file says."""
        return frozenset(str(name) for name in self._file.notes.get("frames", ()))

    @property
    def trained_disparities(self) -> tuple[float, float]:
        """The smallest and the largest disparity of the training, full-size pixels, as the weight file says."""
        return self._file.disparities

    @property
    def needs_confidence(self) -> bool:
        """Whether the coarse map must come with the matcher's confidence."""
        return not {"confidence", "evidence"}.isdisjoint(network_named(self._file.network).inputs)

    @property
    def needs_candidates(self) -> bool:
        """Whether the coarse map must come with the matcher's candidates."""
        return not {"candidates", "evidence"}.isdisjoint(network_named(self._file.network).inputs)

    @property
    def needs_right(self) -> bool:
        """Whether the right image must come too."""
        return "evidence" in network_named(self._file.network).inputs

    @property
    def any_scale(self) -> bool:
        """Whether maps of other sizes than half are taken."""
        return self.needs_right

    def __call__(
        self, coarse: Disparity, left: NDArray[Any], *, right: NDArray[Any] | None = None, scale: float = 0.5,
        threads: int = 1, passes: int | None = None,
    ) -> Disparity:  # fmt: skip
        """Return the refined map at the size of `left`; see `stereokit_refiners.contract.Refiner`.

        A network that weighs values does so `passes` times, from the second time on its own map; None is its usual.
        Where the coarse map is NaN, the result is; the network sees it filled. Networks of half-size maps alone know
        disparities from 0 on:
        one whose map goes below sees it lifted by as much, one whose map begins far above sees it lowered (see
        `stereokit_refiners.runtimes.encode.base_of`). No disparity lies beyond the smallest and the largest that the
        matcher has found.

        Warns
        -----
        StereokitWarning
            Once, if disparities beyond those of the training remain.
        """
        step = _step_of(scale)
        _check_size(coarse.disparity, left, step)
        if self.any_scale:
            return self._weighed(
                coarse, left, right, step, threads, self._passes_at(step) if passes is None else passes
            )
        rows, columns = left.shape
        disparity = coarse.disparity
        unknown = np.isnan(disparity)
        gaps = bool(unknown.any())
        if gaps:
            disparity = np.nan_to_num(fill(disparity, "nearest", threads=threads))
        candidates = coarse.candidates if self.needs_candidates else None
        maps = [disparity] if candidates is None else [disparity, candidates]
        shift = base_of(maps)  # whole, so that float32 holds it
        self._check_trained(disparity, shift)
        lowered = None if candidates is None else candidates - shift
        full = self.network_map(disparity - shift, lowered, coarse.confidence, left, threads)
        if shift != 0:
            full += 2 * shift
        np.clip(full, 2 * min(a.min() for a in maps), 2 * max(a.max() for a in maps), out=full)
        known = doubled(coarse.valid.view(np.uint8), rows, columns).astype(bool)
        if gaps:
            missing = doubled(unknown.view(np.uint8), rows, columns).astype(bool)
            full[missing] = np.nan
            known &= ~missing
        sure = None if coarse.confidence is None else doubled(coarse.confidence, rows, columns)
        return Disparity(full, known, sure)

    @property
    def bytes_per_pixel(self) -> int:
        """What refining takes at most, with buffers for four sizes of images: measured with the general network."""
        return 240 if self._compiled.backend == "openvino" else 430

    @property
    def for_search(self) -> Callable[..., Disparity]:
        """What refines the half-size map that says where to search: once, which serves as well there."""
        return partial(self, passes=1)

    def check_runtime(self) -> None:
        """Choose the runtime now rather than at the first map.

        Raises
        ------
        StereokitError
            If none that is installed computes the network rightly here.
        """
        self._compiled.settle()

    def network_map(
        self, disparity: NDArray[np.float32], candidates: NDArray[np.float32] | None,
        confidence: NDArray[np.float32] | None, left: NDArray[Any], threads: int = 1,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Return what the network itself makes of a half-size map, as exported graphs do.

        The map is neither lowered before nor held to a range after.

        Parameters
        ----------
        disparity : (h, w) float32
            Half-size pixels, without NaN.
        candidates : (2, h, w) float32 or None
            Half-size pixels; only for networks that look at them.
        confidence : (h, w) float32 or None
            0 to 1; only for networks that look at it.
        left : (H, W) uint8
            Full-size image.
        threads : int

        Returns
        -------
        (H, W) float32, pixels
        """
        network = network_named(self._file.network)
        rows, columns = left.shape
        height, width = disparity.shape
        below, beside = -height % network.stride, -width % network.stride
        disparity = _extended(disparity * np.float32(2), below, beside)
        confidence = None if confidence is None else _extended(confidence, below, beside)
        image = _extended(left, 2 * (height + below) - rows, 2 * (width + beside) - columns)
        candidates = None if candidates is None else _extended_each(candidates * np.float32(2), below, beside)
        rule = self._file.rule
        inputs = encode(tuple(network.inputs), rule.unit_inputs, disparity, image, confidence, candidates)
        finish = partial(rule.map, coarse=disparity, rows=rows, columns=columns, threads=threads, candidates=candidates)
        full: NDArray[np.float32] = self._compiled.run(inputs, threads, finish)
        return full

    def _check_trained(self, disparity: NDArray[np.float32], shift: float) -> None:
        """Warn, once, where a map in half-size pixels, lowered by `shift`, goes beyond what was trained."""
        low, high = self.trained_disparities
        share = np.count_nonzero(disparity - shift > high / 2) / disparity.size
        if share > _FEW and not self._compiled.warned:
            self._compiled.warned = True
            lowered = f", {2 * shift:g} px taken off" if shift > 0 else ""
            warn(
                f"refiner {self._file.network!r} was trained on disparities from {low:g} to {high:g} px, "
                f"{100 * share:.0f} % of this map lie beyond{lowered}: they come out 1 to 2 % too small; "
                "refiner 'linear' takes any"
            )

    def _weighed(
        self, coarse: Disparity, left: NDArray[Any], right: NDArray[Any] | None, step: int, threads: int, passes: int
    ) -> Disparity:
        """Return the map of a network that weighs values by evidence from both images."""
        rows, columns = left.shape
        candidates, confidence, other = _evidence_of(coarse, left, right)
        disparity = coarse.disparity
        unknown = np.isnan(disparity)
        gaps = bool(unknown.any())
        if gaps:
            disparity = np.nan_to_num(fill(disparity, "nearest", threads=threads))
        full, sure = self._one_pass(disparity, candidates, confidence, left, other, step, threads)
        for again in range(1, passes):
            if again == 1:
                candidates = np.stack([enlarged(one, step, rows, columns) * np.float32(step) for one in candidates])
            full, sure = self._one_pass(full, candidates, sure, left, other, 1, threads)
        known = enlarged(coarse.valid.view(np.uint8), step, rows, columns).view(np.bool_)
        if gaps:
            missing = enlarged(unknown.view(np.uint8), step, rows, columns).view(np.bool_)
            full[missing] = np.nan
            known &= ~missing
        return Disparity(full, known, sure)

    def _one_pass(
        self, disparity: NDArray[np.float32], candidates: NDArray[np.float32], confidence: NDArray[np.float32],
        left: NDArray[Any], right: NDArray[Any], step: int, threads: int,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
        """Return the map and how sure it is."""
        rows, columns = left.shape
        with self._compiled.workspaces(rows, columns, step).take() as workspace:
            values = hypotheses(disparity, candidates, left, right, step, threads, workspace)
            inputs = {"evidence": network_input(values, confidence, left, columns, threads, workspace)}
            finish = partial(mixture, found=values, rows=rows, columns=columns, threads=threads)
            full, sure = self._compiled.run(inputs, threads, finish)
        return full, sure

    def _passes_at(self, step: int) -> int:
        """Return how often a network that weighs values does so: from the second time on its own map."""
        return 2 if step == 1 else 1

    def on_device(
        self, coarse: DeviceDisparity, left: Any, stream: Any, *, right: Any = None, scale: float = 0.5
    ) -> tuple[Any, Any, Any]:
        """Return the refined map on the GPU, with torch in fp32; see `stereokit_refiners.contract.DeviceRefiner`."""
        maps: tuple[Any, Any, Any]
        if self.any_scale:
            step = _step_of(scale)
            _check_size(coarse.disparity, left, step)
            _evidence_of(coarse, left, right)
            maps = on_tensors("evidence_tensors").weigh_on_device(
                self._file, coarse, left, right, step, stream, self._passes_at(step)
            )
        else:
            maps = on_tensors().refine_on_device(self._file, coarse, left, stream)
        return maps


@dataclass(frozen=True, eq=False)
class StereoVaeRefiner(LearnedRefiner):
    """StereoVAE (Chang et al. 2023); see `stereokit_refiners.networks.stereovae`."""

    architecture: ClassVar[str] = "stereovae"


@dataclass(frozen=True, eq=False)
class CnnRefiner(LearnedRefiner):
    """The paper's network without the latent."""

    architecture: ClassVar[str] = "cnn"


@dataclass(frozen=True, eq=False)
class PyramidRefiner(LearnedRefiner):
    """A pyramid with a mixture on top: see `stereokit_refiners.networks.pyramid`."""

    architecture: ClassVar[str] = "pyramid"


def learned_names() -> list[str]:
    """Return the names of the registered refiners that are networks."""
    return [name for name in REFINERS.names() if getattr(REFINERS.get(name), "architecture", "")]


def _step_of(scale: float) -> int:
    """Return how many full-size pixels a coarse pixel is wide; OptionError unless 1, 2 or 4."""
    if scale not in (1, 0.5, 0.25):
        raise OptionError(f"scale must be 1, 0.5 or 0.25, got {scale!r}")
    return round(1 / scale)


def _check_size(disparity: Any, left: Any, step: int) -> None:
    """Raise OptionError unless a coarse map has the size that goes with the image's."""
    rows, columns = left.shape
    if tuple(disparity.shape) != (-(-rows // step), -(-columns // step)):
        size = {1: "the", 2: "half the", 4: "a quarter of the"}[step]
        raise OptionError(f"coarse map must be {size} size of left {tuple(left.shape)}, got {tuple(disparity.shape)}")


def _evidence_of(coarse: Disparity | DeviceDisparity, left: Any, right: Any) -> tuple[Any, Any, Any]:
    """Return candidates, confidence and the right image; OptionError where one is missing or has another size."""
    right = right_of(left, right)
    if coarse.confidence is None or coarse.candidates is None:
        raise OptionError("coarse must come with confidence and candidates for this refiner, got none")
    return coarse.candidates, coarse.confidence, right


def right_of(left: Any, right: Any) -> Any:
    """Return the right image; OptionError where it is missing or has another size than the left one."""
    if right is None or tuple(right.shape) != tuple(left.shape):
        got = "none" if right is None else tuple(right.shape)
        raise OptionError(f"right must have the size of left {tuple(left.shape)} for this refiner, got {got}")
    return right


def _extended(image: NDArray[Any], below: int, beside: int) -> NDArray[Any]:
    if below == 0 and beside == 0:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.copyMakeBorder(image, 0, below, 0, beside, cv2.BORDER_REPLICATE))


def _extended_each(maps: NDArray[np.float32], below: int, beside: int) -> NDArray[np.float32]:
    return maps if below == 0 and beside == 0 else np.stack([_extended(one, below, beside) for one in maps])
