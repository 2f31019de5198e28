"""From a method's name to a disparity map: ``"zncc+sgm"`` -> cost, aggregation, selection, post-processing.

A `Matcher` checks its options once, keeps its buffers between calls, and may be called from any number of threads
at the same time. `match` is the one-line form.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import Levels, Pair
from stereokit.cuda.driver import has_device, require_device
from stereokit.defaults import METHODS, defaults_of
from stereokit.errors import DeviceError, InputError, OptionError, UnknownNameError, did_you_mean
from stereokit.images.gray import (
    GrayPair,
    check_flag,
    check_integer,
    check_names,
    check_number,
    gray_pair,
    guide_of,
    reduced,
    smooth,
)
from stereokit.kernels.threads import available_threads, crew
from stereokit.kernels.workspace import Pool, Workspace
from stereokit.methods import check_levels, find_refiner, option_names, parse_method
from stereokit.postprocess.chain import Chain, post_process
from stereokit.postprocess.fill import FILLS
from stereokit.registry import AGGREGATIONS, COSTS
from stereokit.result import Disparity
from stereokit.selection.wta import winners_like

if TYPE_CHECKING:
    from stereokit.cuda.pipeline import CudaPipeline, DeviceDisparity, Settings

__all__ = ["METHODS", "Matcher", "match", "warmup"]

_PIPELINE = (
    "confidence",
    "fill",
    "median",
    "outside",
    "right",
    "smooth",
    "smp",
    "speckle",
    "subpixel",
    "uniqueness",
)


class Matcher:
    """A stereo matcher for rectified pairs.

    Parameters
    ----------
    method : str
        ``"cost+aggregation"`` or S1 to S4, any case.
    max_disparity, min_disparity : int
        Disparities ``min_disparity <= d < max_disparity`` are tried, in full-size pixels. The minimum may be
        negative. 1 to 2048 levels.
    scale : {1.0, 0.5, 0.25}
        0.5 and 0.25 match at half and at a quarter of the size, and let `refiner` bring the map to full size.
    refiner : str, callable or None
        The name of a refiner, a weight file (``.safetensors``), or a refiner itself (see
        `stereokit_refiners.Refiner`); None is ``"linear"``, and no refiner at full size. Learned ones need
        ``stereokit[fast]``; those other than ``"general"`` need ``scale=0.5``.
    device : {"auto", "cpu", "cuda"}
        Where to compute; the map is the same. "cuda" needs an NVIDIA GPU and ``stereokit[cuda]``; "auto" takes it
        where it can be used, else the CPU. Refiners run on the CPU, but for `on_device`.
    threads : int or None
        Threads of one call; None uses the processors at hand. The result does not depend on it.
    fill : {"background", "nearest"} or None
        How invalid pixels are filled; None (or ``"none"``) leaves them NaN.
    **options
        Options of the stages by name: those of the cost and of the aggregation (see `stereokit.Census`,
        `stereokit.Zncc`, `stereokit.aggregation.sgm.Sgm`, `stereokit.aggregation.dt.Dt`) and of the refiner,
        ``subpixel``, and of the pipeline: ``smooth`` (sigma in pixels of a Gaussian on both images before matching),
        ``uniqueness`` (percent by which the best rival must cost more, or the pixel is invalid), ``smp`` (bool,
        single matching phase), ``speckle`` (largest region of like disparity that is removed, as a share of the
        image), ``median`` (0, 3 or 5), ``outside`` (cost of matches outside the right image as a share of the cost's
        range, or None for the nearest border pixel), ``confidence`` (bool) and ``right`` (bool, the right view's map
        too; twice the time). Defaults are those of `stereokit.defaults`.

    Raises
    ------
    OptionError
        If an option does not exist or breaks its rule.
    DeviceError
        If `device` is "cuda" and there is no GPU, or a stage has no CUDA kernels.

    Examples
    --------
    >>> import numpy as np
    >>> left = np.random.default_rng(0).integers(0, 256, (20, 60), dtype=np.uint8)
    >>> right = np.roll(left, -4, axis=1)
    >>> result = Matcher("census+sgm", max_disparity=16)(left, right)
    >>> float(np.median(result.disparity))
    4.0
    """

    def __init__(
        self, method: str = "zncc+sgm", *, max_disparity: int = 128, min_disparity: int = 0, scale: float = 1.0,
        refiner: str | Callable[..., Disparity] | None = None, device: str = "auto", threads: int | None = None,
        **options: Any,
    ) -> None:  # fmt: skip
        self.method = parse_method(method)
        levels = check_levels(min_disparity, max_disparity)
        self.min_disparity = levels.minimum
        self.max_disparity = levels.minimum + levels.count
        if isinstance(scale, bool) or not isinstance(scale, (int, float, np.number)) or scale not in (1, 0.5, 0.25):
            raise OptionError(f"scale must be 1, 0.5 or 0.25, got {scale!r}")
        self.scale = float(scale)
        if not isinstance(device, str) or device not in ("auto", "cpu", "cuda"):
            raise OptionError(f"device must be 'auto', 'cpu' or 'cuda', got {device!r}")
        if device == "cuda":
            require_device()
        self.threads = available_threads() if threads is None else check_integer("threads", threads, 1, 1024)
        self.refiner: str | None = None
        self._refine: Callable[..., Disparity] | None = None
        refiner_options: list[str] = []
        if self.scale != 1 or refiner is not None:
            self.refiner, factory, refiner_options = find_refiner("linear" if refiner is None else refiner)
            self._refine = factory(**{k: options[k] for k in refiner_options if k in options})
            if self.scale != 0.5 and not getattr(self._refine, "any_scale", False):
                raise OptionError(f"refiner {self.refiner!r} needs scale=0.5, got scale={self.scale:g}")
        self._set_stages({k: v for k, v in options.items() if k not in refiner_options}, refiner_options)
        self._asks = bool(getattr(self._refine, "needs_candidates", False))
        self._confident = self.confidence or self._asks or bool(getattr(self._refine, "needs_confidence", False))
        self._pool = Pool()
        self.device = "cpu"
        self._cuda: CudaPipeline | None = None
        if device == "cuda" or (device == "auto" and has_device()):
            self._set_device(fall_back=device == "auto")

    def _set_device(self, fall_back: bool) -> None:
        from stereokit.cuda.pipeline import CudaPipeline  # numba.cuda is imported late

        try:
            if self.scale == 0.25:
                raise DeviceError("scale must be 1 or 0.5 with device 'cuda', got 0.25")
            self._cuda = CudaPipeline(self._cuda_settings(), getattr(self._refine, "on_device", None))
            self.device = "cuda"
        except DeviceError:
            if not fall_back:
                raise

    def _cuda_settings(self) -> Settings:
        """Return what `stereokit.cuda.pipeline` needs to know."""
        from stereokit.cuda.pipeline import Settings

        return Settings(
            self.cost, self.aggregation, self._levels(), self.scale == 0.5, self.smooth, self.outside, self.subpixel,
            self.uniqueness, 2 if self._asks else int(self._confident), self.right, self.smp, self.speckle, self.fill,
            self.median,
        )  # fmt: skip

    def _levels(self) -> Levels:
        """Return the levels of the size at which is matched."""
        low, high = self.min_disparity, self.max_disparity
        step = round(1 / self.scale)
        low, high = low // step, max(-(-high // step), low // step + 1)
        return Levels(low, high - low)

    def _set_stages(self, options: dict[str, Any], elsewhere: list[str]) -> None:
        cost_name, aggregation_name = self.method.split("+")
        cost, aggregation = COSTS.get(cost_name), AGGREGATIONS.get(aggregation_name)
        cost_options, aggregation_options = option_names(cost), option_names(aggregation)
        check_names("option", options, sorted({*_PIPELINE, *cost_options, *aggregation_options, *elsewhere}))
        merged = {**defaults_of(self.method, half=self.scale != 1), **options}
        self.cost = cost(**{k: merged[k] for k in cost_options if k in merged})
        if "p2" not in options and "p2" in merged:  # a default gives way to what the cost leaves of 8 bits
            merged["p2"] = min(merged["p2"], (255 - self.cost.cost_max) / self.cost.unit)
        self.aggregation = aggregation(**{k: merged[k] for k in aggregation_options if k in merged})
        if hasattr(self.aggregation, "penalties"):
            self.aggregation.penalties(self.cost.cost_max, self.cost.unit)
        self.fill = None if merged["fill"] in (None, "none") else merged["fill"]
        if self.fill is not None and (not isinstance(self.fill, str) or self.fill not in FILLS):
            raise UnknownNameError(did_you_mean("fill", str(self.fill), (*FILLS, "none")))
        self.median = check_integer("median", merged["median"])
        if self.median not in (0, 3, 5):
            raise OptionError(f"median must be 0, 3 or 5, got {self.median}")
        outside = merged["outside"]
        self.outside = None if outside is None else check_number("outside", outside, 0, 1)
        self.smooth = check_number("smooth", merged["smooth"], 0, 10)
        self.uniqueness = check_number("uniqueness", merged["uniqueness"], 0, 100)
        self.speckle = check_number("speckle", merged["speckle"], 0, 1)
        self.smp = check_flag("smp", merged["smp"])
        self.subpixel = check_flag("subpixel", merged["subpixel"])
        self.confidence = check_flag("confidence", merged["confidence"])
        self.right = check_flag("right", merged["right"])

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_pool", "_cuda")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._pool = Pool()
        self._cuda = None
        if self.device == "cuda":
            require_device()
            self._set_device(fall_back=False)

    def __repr__(self) -> str:
        levels = f"min_disparity={self.min_disparity}, max_disparity={self.max_disparity}"
        return f"Matcher({self.method!r}, {levels}, scale={self.scale:g}, {self.cost}, {self.aggregation})"

    def on_device(self, left: Any, right: Any, stream: Any = None) -> DeviceDisparity:
        """Match a rectified pair that lies on the GPU, such as PyTorch's CUDA tensors; the map stays there.

        Parameters
        ----------
        left, right : (H, W) or (H, W, 3) uint8, C-contiguous, with ``__cuda_array_interface__``
            Grey or RGB; taken without a copy and never modified.
        stream : stream of PyTorch, CuPy or numba, int, or None
            The CUDA stream to run on; None is the default stream. Nothing waits for it.

        Returns
        -------
        stereokit.cuda.pipeline.DeviceDisparity
            Arrays with ``__cuda_array_interface__``: ``torch.as_tensor(result.disparity)`` takes one without a copy.

        Raises
        ------
        InputError
            If the images cannot be used.
        DeviceError
            If the matcher's device is not "cuda", the refiner of half size works on the host only or `fill` is None
            there, or the device is short of memory.
        """
        if self._cuda is None:
            raise DeviceError("device must be 'cuda' for images on the device, got 'cpu'")
        if self.scale == 1 and self.refiner is not None:
            raise DeviceError(f"refiner must be None for images on the device with scale=1, got {self.refiner!r}")
        found = self._cuda.device(left, right, stream)
        return found if self.confidence else replace(found, confidence=None)

    def __call__(self, left: Any, right: Any) -> Disparity:
        """Match a rectified pair.

        Parameters
        ----------
        left, right : (H, W) or (H, W, 3), uint8, uint16, float32 or float64
            Grey or RGB, of one size and type; never modified. NaN and infinite pixels count as no evidence.

        Returns
        -------
        Disparity
            Map of the left view, ``float32`` ``(H, W)`` in pixels, with ``valid`` and, if asked for,
            ``confidence`` and the ``right`` view's map. Where no pixel at all could be measured (blank images),
            a filled map is `min_disparity` everywhere; learned refiners may add a pixel or two.

        Raises
        ------
        InputError
            If the images cannot be used.
        """
        return self._call(left, right, self.threads)

    def map(
        self, pairs: Iterable[tuple[Any, Any]], *, progress: Callable[[int], object] | None = None
    ) -> Iterator[Disparity]:
        """Match a sequence of pairs, several frames at a time, one thread each.

        Frames in parallel use the processors better than threads within a frame, and any number of them. The
        results are those of one call per pair, and come in the order of the pairs.

        Parameters
        ----------
        pairs : iterable of (left, right)
            Taken from one at a time, at most twice `threads` ahead of the result that was last handed out, so
            that memory stays bounded however long the sequence is.
        progress : callable or None
            Called with the number of results so far, after each.

        Yields
        ------
        Disparity

        Raises
        ------
        InputError
            When the turn comes of a pair that cannot be used.
        """
        ahead: deque[Future[Disparity]] = deque()
        source = iter(pairs)
        workers = self.threads if self._cuda is None else min(2, self.threads)  # each has buffers on the device
        with ThreadPoolExecutor(workers, thread_name_prefix="stereokit-map") as executor:
            try:
                failure: BaseException | None = None  # of the source: what it gave before is still matched
                for done in itertools.count(1):
                    while failure is None and len(ahead) < 2 * self.threads:
                        try:
                            pair = next(source)
                            left, right = pair
                        except (TypeError, ValueError):
                            failure = InputError("pairs must give (left, right) each time")
                        except BaseException as error:
                            failure = error
                        else:
                            ahead.append(executor.submit(self._call, left, right, 1))
                    if not ahead:
                        if isinstance(failure, StopIteration):
                            return
                        assert failure is not None
                        raise failure
                    yield ahead.popleft().result()
                    if progress is not None:
                        progress(done)
            finally:
                for waiting in ahead:
                    waiting.cancel()

    def _call(self, left: Any, right: Any, threads: int) -> Disparity:
        pair = gray_pair(left, right)
        with self._pool.take() as workspace:
            full = self.match_gray(pair, workspace, threads)
            if not self.right:
                return full
            mirrored = self.match_gray(_mirror(pair), workspace, threads)
        other = np.ascontiguousarray(mirrored.disparity[:, ::-1])
        return Disparity(full.disparity, full.valid, full.confidence, other)

    def match_gray(self, pair: GrayPair, workspace: Workspace, threads: int) -> Disparity:
        """Match a pair that was checked and is grey, with buffers of the caller; no right view's map."""
        if self._cuda is not None:
            found = self._cuda.host(pair)
        else:
            with crew(threads):
                small = reduced(pair, round(1 / self.scale))
                found = self._match_with_crew(small, self._levels(), workspace, threads)
        if self._refine is None:
            return found
        further: dict[str, Any] = {}
        if getattr(self._refine, "any_scale", False):
            further["scale"] = self.scale
        if getattr(self._refine, "needs_right", False):
            further["right"] = guide_of(pair.right, pair.left)
        refined = self._refine(found, pair.guide, threads=threads, **further)
        # A level of a smaller image stands for several of the full one: some of them are outside the range.
        within = np.clip(refined.disparity, self.min_disparity, self.max_disparity - 1)
        return Disparity(within, refined.valid, refined.confidence if self.confidence else None)

    def _match_with_crew(self, pair: GrayPair, levels: Levels, workspace: Workspace, threads: int) -> Disparity:
        low = levels.minimum
        pair = smooth(pair, self.smooth, workspace, threads)
        shape = pair.left.shape
        rows = self.cost.prepare(
            Pair(pair.left, pair.right, pair.left_bad, pair.right_bad, levels, self.outside, threads, pair.ranges),
            workspace,
            max(2, threads),
        )
        disparity = workspace.array("match.disparity", shape, np.float32)
        cost = workspace.array("match.cost", shape, self.aggregation.total_dtype)
        confidence = np.empty(shape, np.float32) if self._confident else None
        candidates = np.empty((2, *shape), np.float32) if self._asks else None
        out = winners_like(disparity, cost, confidence, levels.count, low, self.subpixel, self.uniqueness, candidates)
        self.aggregation.sweep(rows, levels, self.cost, pair.guide, workspace, threads, out)
        chain = Chain(self.smp, int(self.speckle * disparity.size), self.fill, self.median, low)
        disparity, valid = post_process(disparity, cost, pair.left_bad, chain, workspace, threads)
        if confidence is not None:
            confidence[~valid] = 0
        return Disparity(disparity, valid, confidence, candidates=candidates)


def _mirror(pair: GrayPair) -> GrayPair:
    """Return the pair as a camera behind a mirror sees it: the right view becomes the left one."""

    def flip(image: NDArray[Any] | None) -> NDArray[Any] | None:
        return None if image is None else np.ascontiguousarray(image[:, ::-1])

    left, right = flip(pair.right), flip(pair.left)
    assert left is not None and right is not None
    ranges = None if pair.ranges is None else (pair.ranges[1], pair.ranges[0])
    return GrayPair(left, right, flip(pair.right_bad), flip(pair.left_bad), guide_of(left, right), ranges)


_matchers: dict[Any, Matcher] = {}
_matchers_lock = threading.Lock()


def match(left: Any, right: Any, method: str = "zncc+sgm", **options: Any) -> NDArray[np.float32]:
    """Match a rectified pair and return the left view's disparity map.

    Parameters
    ----------
    left, right : (H, W) or (H, W, 3), uint8, uint16, float32 or float64
        Rectified images of one size and type, grey or RGB.
    method : str
        ``"cost+aggregation"`` or S1 to S4.
    **options
        Those of `Matcher`.

    Returns
    -------
    (H, W) float32, pixels
        Dense, unless ``fill=None``, which leaves NaN where nothing was measured.

    Raises
    ------
    InputError, OptionError
        If an image or an option cannot be used.
    """
    try:
        key = (method, tuple((name, type(options[name]), options[name]) for name in sorted(options)))
        hash(key)
    except TypeError:
        return Matcher(method, **options)(left, right).disparity
    with _matchers_lock:
        matcher = _matchers.pop(key, None) or Matcher(method, **options)
        _matchers[key] = matcher  # the most recently used is last
        while len(_matchers) > 4:
            _matchers.pop(next(iter(_matchers)))
    return matcher(left, right).disparity


def warmup(*methods: str, max_disparity: int = 128) -> None:
    """Compile ahead (or load from the disk cache) what the methods need, so that no later call waits for it.

    Parameters
    ----------
    *methods : str
        Methods; none means S1 to S4.
    max_disparity : int
        As it will be used: code is compiled per 64 levels.
    """
    image = np.arange(16 * 16, dtype=np.uint8).reshape(16, 16)
    for method in methods or METHODS:
        Matcher(method, max_disparity=max_disparity)(image, image)


def _forget_matchers() -> None:
    global _matchers_lock
    _matchers.clear()
    _matchers_lock = threading.Lock()  # the old one may be held by a thread that the child does not have


if hasattr(os, "register_at_fork"):  # buffers of a call that was under way stay with the parent
    os.register_at_fork(after_in_child=_forget_matchers)
