"""Matching on the GPU: the stages of `stereokit.Matcher` as launches on one stream, with nothing in between.

Every stage is the twin of the CPU's and gives the same integers and floats, so the maps are those of the CPU. Images
of the host are checked there, as for the CPU, and uploaded; images of 8 bits that lie on the device already are taken
from there, and their map stays there. Buffers remain on the device from call to call; a call that comes while others
are running gets a queue, with buffers, of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from stereokit.costs.rows_cuda import DevicePair
from stereokit.cuda.dry import DryQueue
from stereokit.cuda.kernel import KERNELS, Kernel, Queue, blocks_for, cuda
from stereokit.cuda.stream import DeviceQueue, stream_of
from stereokit.errors import DeviceError, InputError
from stereokit.images.evidence import joined
from stereokit.images.gray import GrayPair
from stereokit.images.prepare_cuda import flip, halve, smooth, take
from stereokit.images.resize import reduced_mask
from stereokit.kernels.workspace import Pool
from stereokit.pipeline import refined
from stereokit.postprocess.chain_cuda import hold, post_process
from stereokit.registry import AGGREGATIONS, COSTS
from stereokit.result import Disparity
from stereokit.selection.wta_cuda import Maps, zero_invalid_confidence
from stereokit.settings import Detail, MatchSettings

__all__ = ["CudaPipeline", "DeviceDisparity", "all_kernels"]

Shape = tuple[int, int]


@dataclass(frozen=True, eq=False)
class DeviceDisparity:
    """A disparity map that stays on the GPU; each array has ``__cuda_array_interface__``.

    The arrays are the caller's own, no later call writes to them. They are ready when the stream is on which they
    were made.

    Attributes
    ----------
    disparity : (H, W) float32 on the device
        Pixels, NaN where invalid. Dense after a fill.
    valid : (H, W) uint8 on the device
        Not 0 where the disparity was measured.
    confidence : (H, W) float32 on the device, or None
        From 0, no better than another disparity, to 1.
    right : (H, W) float32 on the device, or None
        The map of the right view.
    candidates : (2, H, W) float32 on the device, or None
        As `stereokit.Disparity` has them.
    """

    disparity: Any
    valid: Any
    confidence: Any = None
    right: Any = None
    candidates: Any = None


class _DeviceMaps(NamedTuple):
    """Maps of a match on the device: resident and flat, the next match on the queue writes over them."""

    disparity: Any
    valid: Any
    confidence: Any = None
    candidates: Any = None


class _Image(NamedTuple):
    """An image on the device, flat."""

    pixels: Any
    dtype: np.dtype[Any]
    channels: int
    shape: Shape


def _from_device(name: str, image: Any) -> _Image:
    """Return an image of the caller on the device, without a copy."""
    if not hasattr(image, "__cuda_array_interface__"):
        raise InputError(f"left and right must both lie on the device or both on the host, but {name} does not")
    array = cuda.as_cuda_array(image)
    if array.dtype != np.uint8:
        raise InputError(
            f"{name} must be uint8 on the device, got {array.dtype}; images of the host may have other types"
        )
    if not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)) or 0 in array.shape:
        raise InputError(f"{name} must be grey (H, W) or RGB (H, W, 3), got shape {tuple(array.shape)}")
    if not array.is_c_contiguous():
        raise InputError(f"{name} must be C-contiguous on the device, got strides {tuple(array.strides)}")
    channels = 1 if array.ndim == 2 else 3
    return _Image(array.reshape(array.size), array.dtype, channels, tuple(array.shape[:2]))


def _reshaped(array: Any, shape: tuple[int, ...]) -> Any:
    """Return a flat array of the device as one of this shape."""
    return array.reshape(*shape)


def _flat(array: Any) -> Any:
    """Return an array of the device as a flat one of numba."""
    array = cuda.as_cuda_array(array)
    return array.reshape(array.size)


def new_queue(stream: Any) -> Any:
    """Return a queue of the GPU on a stream of numba, or on one of its own."""
    return DeviceQueue(stream)


class CudaPipeline:
    """The way through the GPU (`stereokit.pipeline.Pipeline`); may be used by many threads at the same time.

    Parameters
    ----------
    settings : MatchSettings
        Options. Costs and aggregations name the modules of their CUDA twins; a refiner with ``on_device`` serves
        `match_on_device`. A pixel tries all levels, also where ``search`` is "auto".

    Raises
    ------
    DeviceError
        If a stage has no CUDA kernels, or the search shall go from coarse to fine.
    """

    def __init__(self, settings: MatchSettings) -> None:
        if settings.search == "coarse-to-fine":
            raise DeviceError("search must be 'full' or 'auto' with device 'cuda', got 'coarse-to-fine'")
        self.settings = settings.replaced(search="full")
        self._cost = _twin("cost", settings.cost)
        self._aggregation = _twin("aggregation", settings.aggregation)
        if hasattr(self._cost, "check"):
            self._cost.check(settings.cost)
        self._queues: dict[int | None, Pool[Any]] = {}

    def replaced(self, **changes: Any) -> CudaPipeline:
        """Return a pipeline whose settings differ in some values."""
        return CudaPipeline(self.settings.replaced(**changes))

    def nbytes(self, height: int, width: int, dtype: Any = np.uint8, threads: int = 1) -> float:
        """Return the bytes of buffers that a pair takes on the device; see `stereokit.pipeline.Pipeline`."""
        queue = DryQueue()
        dtype = np.dtype(dtype)
        pixels = height * width
        images = queue.array("images", 2 * pixels, dtype)
        guide = images[:pixels] if dtype == np.uint8 else queue.array("guide", pixels, np.uint8)
        bad = queue.array("bad", 2 * pixels, np.uint8)
        self.run(queue, images, dtype, guide, bad, (height, width), None)
        return float(queue.nbytes)

    def match(self, pair: GrayPair, threads: int) -> Disparity:
        """Match a checked pair of the host; see `stereokit.pipeline.Pipeline`."""
        return refined(self.settings, self._coarse(pair), pair, threads)

    def _coarse(self, pair: GrayPair) -> Disparity:
        """Return the map of the size at which is matched."""
        with self._queue(None) as queue:
            height, width = shape = pair.left.shape
            dtype = pair.left.dtype
            images = queue.upload("images", np.stack([pair.left, pair.right]))
            guide = images[: height * width] if dtype == np.uint8 else queue.upload("guide", pair.guide)
            bad = excluded = None
            left_bad = joined(pair.left_bad, pair.left_blank)
            if left_bad is not None or pair.right_bad is not None:
                none = np.zeros(shape, np.bool_)
                masks = (none if mask is None else mask for mask in (left_bad, pair.right_bad))
                bad = queue.upload("bad", np.stack(list(masks)).view(np.uint8))
            if pair.left_blank is not None:  # has no cost of its own, but a value
                excluded = queue.upload("excluded", (none if pair.left_bad is None else pair.left_bad).view(np.uint8))
            maps, shape = self.run(queue, images, dtype, guide, bad, (height, width), pair.ranges, excluded)
            disparity, valid = queue.fetch(maps.disparity), queue.fetch(maps.valid).view(np.bool_)
            confidence = None if maps.confidence is None else queue.fetch(maps.confidence).reshape(shape)
            candidates = None
            if maps.candidates is not None:
                candidates = queue.fetch(maps.candidates).reshape(2, *shape)
        valid = valid.reshape(shape)
        blank = reduced_mask(pair.left_blank, self.settings.step)
        if blank is not None:
            valid = valid & ~blank
            confidence = None if confidence is None else np.where(blank, np.float32(0), confidence)
        return Disparity(disparity.reshape(shape), valid, confidence, candidates=candidates)

    def match_on_device(self, left: Any, right: Any, stream: Any = None) -> DeviceDisparity:
        """Match a pair that lies on the device, and wait for nothing.

        Parameters
        ----------
        left, right : (H, W) or (H, W, 3) uint8, C-contiguous, with ``__cuda_array_interface__``
            Grey or RGB; not modified.
        stream : stream of numba, PyTorch or CuPy, int, or None
            Stream of the launches; None is the default stream, which waits for all others but non-blocking ones.

        Raises
        ------
        InputError
            If the images cannot be used.
        DeviceError
            If the refiner works on the host only or gets a map that is not filled, or memory is short.
        """
        refines = self.settings.refiner is not None
        if refines and getattr(self.settings.refiner, "on_device", None) is None:
            raise DeviceError("refiner must be one with on_device for images on the device: linear, or a learned one")
        if refines and self.settings.fill is None:
            raise DeviceError("fill must not be None for images on the device with a refiner, which needs a dense map")
        views = _from_device("left", left), _from_device("right", right)
        if views[0].shape != views[1].shape:
            raise InputError(f"left and right must have the same size, got {views[0].shape} and {views[1].shape}")
        shape = views[0].shape
        stream = cuda.default_stream() if stream is None else stream_of(stream)
        with self._queue(stream) as queue:
            maps = self._match_views(queue, views, False, stream)
            if not refines:  # what refiners return is new
                maps = _DeviceMaps(*(None if part is None else _reshaped(queue.copy(part), shape) for part in maps))
            other = None
            if self.settings.right:
                mirrored = _flat(self._match_views(queue, views[::-1], True, stream).disparity)
                out = queue.copy(mirrored)
                queue.launch(flip, blocks_for(out.size, flip.block), mirrored, out, *shape)
                other = _reshaped(out, shape)
        confidence = maps.confidence if self.settings.confidence else None
        return DeviceDisparity(maps.disparity, maps.valid, confidence, other)

    def _match_views(self, queue: Queue, views: tuple[_Image, ...], mirrored: bool, stream: Any) -> _DeviceMaps:
        """Match two images on the device, or what a camera behind a mirror sees of them, and refine."""
        shape, dtype = views[0].shape, views[0].dtype
        pixels = shape[0] * shape[1]
        images = queue.array("images", 2 * pixels, dtype)
        for place, image in enumerate(views):
            take(queue, image.pixels, dtype, images, place, image.channels, mirrored, shape)
        maps, size = self.run(queue, images, dtype, images[:pixels], None, shape)
        if self.settings.refiner is None:
            return maps
        disparity, valid, sure = (None if part is None else _reshaped(part, size) for part in maps[:3])
        two = None if maps.candidates is None else _reshaped(maps.candidates, (2, *size))
        coarse = DeviceDisparity(disparity, valid, sure, candidates=two)
        left, right = (_reshaped(part, shape) for part in (images[:pixels], images[pixels:]))
        full = self._refined(coarse, left, right, stream)
        if self.settings.bounds is None:
            return full
        within = _flat(full.disparity)
        queue.launch(hold, blocks_for(pixels, hold.block), within, *self.settings.bounds, pixels)
        return full._replace(disparity=_reshaped(within, shape))

    def _refined(self, coarse: DeviceDisparity, left: Any, right: Any, stream: Any) -> _DeviceMaps:
        """Return what the refiner makes of a map: `stereokit_refiners.contract.DeviceRefiner`."""
        refiner: Any = self.settings.refiner
        keywords: dict[str, Any] = {"right": right} if getattr(refiner, "needs_right", False) else {}
        if getattr(refiner, "any_scale", False) and (keywords or self.settings.scale != 0.5):
            keywords["scale"] = self.settings.scale
        return _DeviceMaps(*refiner.on_device(coarse, left, stream, **keywords))

    @contextmanager
    def _queue(self, stream: Any) -> Iterator[Any]:
        """Lend a queue on `stream`; None is a stream of the queue's own."""
        key = None if stream is None else int(stream)
        with self._queues.setdefault(key, Pool(lambda: new_queue(stream))).take() as queue:
            yield queue

    def run(
        self, queue: Queue, images: Any, dtype: np.dtype[Any], guide: Any, bad: Any, shape: Shape,
        ranges: tuple[tuple[int, int], tuple[int, int]] | None = None, excluded: Any = None,
    ) -> tuple[_DeviceMaps, Shape]:  # fmt: skip
        """Run all stages on grey images that a queue holds; return the maps and their size.

        Parameters
        ----------
        queue : Queue
            Queue of launches.
        images : (2 * H * W,) uint8 or uint16 on the device
            Left and right image.
        dtype : numpy dtype
            Their type.
        guide : (H * W,) uint8 on the device
            Image of the edges.
        bad : (2 * H * W,) uint8 on the device, or None
            Not 0 where a pixel has no evidence.
        shape : (int, int)
            Height and width, pixels, before halving.
        ranges : ((int, int), (int, int)) or None
            As of `stereokit.costs.rows.Pair`.
        excluded : (H * W,) uint8 on the device, or None
            Not 0 where a pixel of the left view gets no value; None is where it is `bad`.
        """
        settings, levels = self.settings, self.settings.matched_levels
        if settings.scale != 1:
            guide = halve(queue, "half.guide", guide, np.dtype(np.uint8), 1, shape, False)
            images = halve(queue, "half.images", images, dtype, 2, shape, False)
            if bad is not None:
                bad = halve(queue, "half.bad", bad, np.dtype(np.uint8), 2, shape, True)
            if excluded is not None:
                excluded = halve(queue, "half.excluded", excluded, np.dtype(np.uint8), 1, shape, True)
            shape = (shape[0] + 1) // 2, (shape[1] + 1) // 2
        height, width = shape
        pixels = height * width
        if settings.smooth > 0:
            images, dtype = smooth(queue, images, dtype, settings.smooth, shape), np.dtype(np.uint16)
        masks = queue.array("no.bad", 1, np.uint8) if bad is None else bad
        pair = DevicePair(images, dtype, masks, bad is not None, height, width, levels, settings.border_cost, ranges)
        if pixels * pair.padded >= 2**34:
            raise DeviceError(
                f"levels of all pixels must be fewer than 2**34 on the device, got {pixels * pair.padded}"
            )
        confidence = queue.array("match.confidence", (0, 1, 3)[settings.detail] * pixels or 1, np.float32)
        maps = Maps(
            queue.array("match.disparity", pixels, np.float32),
            queue.array("match.cost", pixels, np.uint16 if not _floats(settings.aggregation) else np.float32),
            confidence,
            levels.count,
            levels.minimum,
            int(settings.subpixel),
            np.float32(settings.uniqueness / 100),
            int(settings.detail),
        )
        self._aggregate(queue, pair, guide, maps)
        candidates = None
        if settings.detail >= Detail.CANDIDATES:
            confidence, candidates = confidence[:pixels], confidence[pixels:]
        left_bad = excluded if excluded is not None or bad is None else bad[:pixels]
        steps = settings.post_processing(pixels)
        disparity, valid = post_process(queue, maps.disparity, maps.cost, left_bad, steps, shape)
        if settings.detail == Detail.DISPARITY:
            return _DeviceMaps(disparity, valid), shape
        queue.launch(
            zero_invalid_confidence, blocks_for(pixels, zero_invalid_confidence.block), confidence, valid, pixels
        )
        return _DeviceMaps(disparity, valid, confidence, candidates), shape

    def _aggregate(self, queue: Queue, pair: DevicePair, guide: Any, maps: Maps) -> None:
        """Compute the costs, aggregate them and select."""
        cost, aggregation = self.settings.cost, self.settings.aggregation
        volume = self._cost.volume(queue, cost, pair)
        shape = pair.height, pair.width
        self._aggregation.aggregate(queue, aggregation, cost, volume, guide, shape, pair.padded, maps)


def _floats(aggregation: Any) -> bool:
    """Return whether aggregated costs are floats."""
    return bool(np.dtype(aggregation.total_dtype).kind == "f")


def all_kernels() -> dict[str, Kernel]:
    """Return every CUDA kernel of this package by name: those of the twins of all stages that are registered."""
    for registry in (COSTS, AGGREGATIONS):
        for name in registry.names():
            module = getattr(registry.get(name), "cuda", None)
            if module is not None:
                import_module(module)
    return KERNELS


def _twin(kind: str, stage: Any) -> Any:
    """Return the module with the CUDA twin of a stage; raise DeviceError if it has none."""
    module = getattr(stage, "cuda", None)
    if module is None:
        raise DeviceError(f"{kind} {stage.name!r} has no CUDA kernels: it cannot run on device 'cuda'")
    return import_module(module)
