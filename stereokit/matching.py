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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereokit.aggregation.contract import Aggregation
from stereokit.checks import PairWatch
from stereokit.costs.rows import Cost
from stereokit.cuda.driver import require_device
from stereokit.defaults import METHODS
from stereokit.errors import DeviceError, InputError, OptionError, shown
from stereokit.images.check import check_integer
from stereokit.images.gray import GrayPair, gray_pair, guide_of
from stereokit.kernels.threads import Job, Workers, available_threads, team
from stereokit.kernels.trace import span
from stereokit.notices import PairWarning, collecting, warn
from stereokit.options import MatchOptions, StageOptions, WarmupOptions
from stereokit.pairs.signs import map_signs
from stereokit.pipeline import CpuPipeline, Pipeline, concluded, with_blank
from stereokit.result import Disparity
from stereokit.settings import MatchSettings

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from stereokit.cuda.pipeline import DeviceDisparity

__all__ = ["METHODS", "Matcher", "compile_kernels", "match", "warmup"]


class Matcher:
    """A stereo matcher for rectified pairs.

    Parameters
    ----------
    method : str
        ``"cost+aggregation"`` or S1 to S4, any case; the default, S2, is the most accurate of the four.
    max_disparity, min_disparity : int
        Disparities ``min_disparity <= d < max_disparity`` are searched, in full-size pixels. The minimum may be
        negative. 1 to 2048 levels.
    scale : {1.0, 0.5, 0.25}
        0.5 and 0.25 match at half and at a quarter of the size, and let `refiner` bring the map to full size.
    refiner : str, callable or None
        The name of a refiner, a weight file (``.safetensors``), or a refiner itself (see
        `stereokit_refiners.Refiner`); None is ``"linear"``, and no refiner at full size. Learned ones are
        faster with ``stereokit[refiners]``; those other than ``"stereokit"`` and ``"auto"`` need ``scale=0.5``.
    device : {"auto", "cpu", "cuda"}
        Where to compute; with one `search` the map is the same. "cuda" needs an NVIDIA GPU and ``stereokit[cuda]``,
        and searches in full. "auto" is the CPU for now, with a GPU too: the kernels are tested in an interpreter and
        have not run on a GPU yet. Refiners run on the CPU, but for `on_device`.
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
        image), ``median`` (0, 3 or 5), ``border_cost`` (cost of matches outside the right image as a share of the
        cost's range, or None for the nearest border pixel; its old name is ``outside``), ``nodata`` (value of pixels
        without evidence, which match nothing and are never ``valid``; None leaves it to NaN, alpha and the marks that
        `stereokit.images.intensity` detects), ``confidence`` (bool), ``right`` (bool, the right view's map too;
        twice the time) and ``search`` ("full" tries all disparities at each pixel, "coarse-to-fine" 64 around the
        map of half the size, so that time and memory do not grow with the range; "auto" does so with S2 at full
        size from 65 on, on the CPU). Defaults are those of `stereokit.defaults`.

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
        self, method: str = "census+sgm", *, max_disparity: int = 128, min_disparity: int = 0, scale: float = 1.0,
        refiner: str | Callable[..., Disparity] | None = None, device: str = "auto", threads: int | None = None,
        **options: Unpack[StageOptions],
    ) -> None:  # fmt: skip
        if not isinstance(device, str) or device not in ("auto", "cpu", "cuda"):
            raise OptionError(f"device must be 'auto', 'cpu' or 'cuda', got {shown(device)}")
        if device == "cuda":
            require_device()
        count = available_threads() if threads is None else check_integer("threads", threads, 1, 1024)
        settings = MatchSettings.parse(
            method,
            max_disparity=max_disparity,
            min_disparity=min_disparity,
            scale=scale,
            refiner=refiner,
            options={**options},
        )
        self._begin(_pipeline(settings, device), count)

    @property
    def settings(self) -> MatchSettings:
        """All options of the match, resolved and checked."""
        return self._pipeline.settings

    @property
    def method(self) -> str:
        """``"cost+aggregation"``."""
        return self.settings.method

    @property
    def min_disparity(self) -> int:
        """The smallest disparity of the search, full-size pixels."""
        return self.settings.levels.minimum

    @property
    def max_disparity(self) -> int:
        """The upper bound of the search, exclusive, full-size pixels."""
        return self.settings.levels.minimum + self.settings.levels.count

    @property
    def scale(self) -> float:
        """The size of the matching: 1, 0.5 or 0.25."""
        return self.settings.scale

    @property
    def cost(self) -> Cost:
        """The cost with its options."""
        return self.settings.cost

    @property
    def aggregation(self) -> Aggregation:
        """The aggregation with its options."""
        return self.settings.aggregation

    @property
    def refiner(self) -> str | None:
        """The refiner's name, or the path of its weights; None where no refiner runs."""
        return self.settings.refiner_name

    @property
    def refine(self) -> Callable[..., Disparity] | None:
        """The refiner itself (`stereokit_refiners.contract.Refiner`); None where no refiner runs."""
        return self.settings.refiner

    @property
    def device(self) -> str:
        """``"cpu"`` or ``"cuda"``."""
        return "cpu" if isinstance(self._pipeline, CpuPipeline) else "cuda"

    def identity(self) -> dict[str, Any]:
        """Return everything a map depends on, except the images, as plain values, fit for JSON.

        Neither `device` nor `threads` is among them. The ``fingerprint`` of a refiner identifies its weights.
        """
        return self.settings.identity()

    def replaced(self, **changes: Any) -> Matcher:
        """Return a matcher that differs in some of its `settings`, by their names."""
        matcher = Matcher.__new__(Matcher)
        matcher._begin(self._pipeline.replaced(**changes), self.threads)
        return matcher

    def _begin(self, pipeline: Pipeline, threads: int) -> None:
        """Set what every matcher has, however it is made."""
        self._pipeline = pipeline
        self.threads = threads
        self._watch = PairWatch(self.scale, self.settings.searched)

    def nbytes(self, height: int, width: int, dtype: Any = np.uint8) -> float:
        """Return the bytes of the buffers for a pair; see `stereokit.pipeline.Pipeline`."""
        return self._pipeline.nbytes(height, width, dtype, self.threads)

    def __getstate__(self) -> dict[str, Any]:
        return {"settings": self.settings, "threads": self.threads, "device": self.device}

    def __setstate__(self, state: dict[str, Any]) -> None:
        if state["device"] == "cuda":
            require_device()
        self._begin(_pipeline(state["settings"], state["device"]), state["threads"])

    def __repr__(self) -> str:
        levels = f"min_disparity={self.min_disparity}, max_disparity={self.max_disparity}"
        return f"Matcher({self.method!r}, {levels}, scale={self.scale:g}, {self.cost}, {self.aggregation})"

    def on_device(self, left: Any, right: Any, stream: Any = None) -> DeviceDisparity:
        """Match a rectified pair that lies on the GPU, such as PyTorch's CUDA tensors; the map stays there.

        The images are taken as they are: nobody looks for black borders, areas without texture or faults of the pair,
        for which the matcher itself, called with images of the host, looks.

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
            If the matcher's device is not "cuda", there is a refiner and it works on the host only or `fill` is None,
            or the device is short of memory.
        """
        if isinstance(self._pipeline, CpuPipeline):
            raise DeviceError("device must be 'cuda' for images on the device, got 'cpu'")
        if self.settings.nodata is not None:
            raise DeviceError(f"nodata must be None for images on the device, got {self.settings.nodata:g}")
        pipeline: Any = self._pipeline
        result: DeviceDisparity = pipeline.match_on_device(left, right, stream)
        return result

    def __call__(self, left: Any, right: Any, *, mask: Any = None, right_mask: Any = None) -> Disparity:
        """Match a rectified pair.

        Parameters
        ----------
        left, right : (H, W), (H, W, 3) or (H, W, 4), numbers
            Grey, RGB or RGBA, of one size and type; never modified. One may be grey and the other in colour: both are
            matched in grey. Pixels that are NaN, infinite, `nodata`, of alpha 0 or evident marks such as -3.4e38
            have no evidence; nor have black borders, as rectification leaves them.
        mask, right_mask : (H, W) bool, optional
            True where a pixel of the left, and of the right image is usable. The others have no evidence.

        Returns
        -------
        Disparity
            Map of the left view, ``float32`` ``(H, W)`` in pixels, with ``valid`` and, on request,
            ``confidence`` and the ``right`` view's map. Pixels without evidence are NaN, also where the rest is filled.
            Where no pixel at all could be measured (blank images), a filled map is `min_disparity` everywhere.

        Warns
        -----
        PairWarning
            If the pair looks as if it were not rectified, exchanged, given twice or out of range; see
            `stereokit.check_pair`, which tells more.
        StereokitWarning
            If few grey levels hold nearly all pixels of images of more than 8 bits.

        Raises
        ------
        InputError
            If the images or a mask cannot be used.
        """
        result, lines = self._call(left, right, mask, right_mask, self.threads)
        for line in lines:
            warn(line, PairWarning)
        return result

    def map(
        self, pairs: Iterable[tuple[Any, Any]], *, progress: Callable[[int], object] | None = None,
        mask: Any = None, right_mask: Any = None,
    ) -> Iterator[Disparity]:  # fmt: skip
        """Match a sequence of pairs, as many at a time as are waiting.

        Frames in parallel use the processors better than threads within a frame, so each frame gets one thread where
        as many wait as there are threads when it begins, and its share of them where fewer do, as in short sequences
        and from slow sources. The results are those of one call per pair, and come in the order of the pairs.

        Parameters
        ----------
        pairs : iterable of (left, right)
            Taken from one at a time, at most twice `threads` ahead of the result that was last handed out, so
            that memory stays bounded however long the sequence is.
        progress : callable or None
            Called with the number of results so far, after each.
        mask, right_mask : (H, W) bool, optional
            Usable pixels of all left, and of all right images.

        Yields
        ------
        Disparity

        Warns
        -----
        PairWarning
            At the first pair that looks wrong.

        Raises
        ------
        InputError
            When the turn comes of a pair that cannot be used.
        """
        queue: deque[Job[tuple[Disparity, list[str]]]] = deque()
        source = iter(pairs)
        # On a GPU each worker has its own buffers.
        workers = Workers(self.threads if self.device == "cpu" else min(2, self.threads))
        unfinished: set[int] = set()  # frames that wait or are matched

        def call(number: int, left: Any, right: Any) -> tuple[Disparity, list[str]]:
            share = self.threads // max(1, len(unfinished)) if self.device == "cpu" else 1
            try:
                return self._call(left, right, mask, right_mask, max(1, share))
            finally:
                unfinished.discard(number)

        try:
            numbers = itertools.count()
            has_warned = False
            failure: Exception | None = None  # of the source; the pairs before it are still matched
            for count in itertools.count(1):
                while failure is None and len(queue) < 2 * self.threads:
                    try:
                        pair = next(source)
                        left, right = pair
                    except (TypeError, ValueError):
                        failure = InputError("pairs must give (left, right) each time")
                    except Exception as error:
                        failure = error
                    else:
                        number = next(numbers)
                        unfinished.add(number)
                        queue.append(Job(call, number, left, right))
                        workers.submit(queue[-1])
                if not queue:
                    if isinstance(failure, StopIteration):
                        return
                    assert failure is not None
                    raise failure
                result, lines = queue[0].result()
                queue.popleft()
                for line in lines:
                    if not has_warned:
                        warn(f"pair {count - 1}: {line}", PairWarning)
                    has_warned = True
                yield result
                if progress is not None:
                    progress(count)
        finally:
            for job in queue:
                job.withdraw()
            workers.close()

    def _call(self, left: Any, right: Any, mask: Any, right_mask: Any, threads: int) -> tuple[Disparity, list[str]]:
        """Match a pair; return the map and the warnings about them."""
        with team(threads) as members:
            if self.device == "cpu":
                members.summon()
            with span("prepare", "checks and grey"):
                pair = gray_pair(left, right, self.settings.nodata, mask, right_mask)
            result = self.match_gray(pair, threads)
            with span("clean", "signs of a bad pair"):
                faults = self._watch.faults(pair, result, self.min_disparity, self.max_disparity)
        return result, [fault.message for fault in faults]

    def match_gray(self, pair: GrayPair, threads: int, keeps_blank: bool | None = None) -> Disparity:
        """Match a pair that was checked and is grey.

        Parameters
        ----------
        pair : GrayPair
        threads : int
        keeps_blank : bool or None
            Whether pixels without texture keep the value that their neighbours gave them, although they do not count as
            measured; None asks whether the map is filled.
        """
        keeps = self.settings.fill is not None if keeps_blank is None else keeps_blank
        full = self._match_view(pair, threads, keeps)
        if not self.settings.right:
            return full
        mirrored = self._match_view(_mirror(pair), threads, keeps)
        other = np.ascontiguousarray(mirrored.disparity[:, ::-1])
        return Disparity(full.disparity, full.valid, full.confidence, other)

    def _match_view(self, pair: GrayPair, threads: int, keeps_blank: bool) -> Disparity:
        with team(threads):
            pair = with_blank(pair, self.settings, threads)
            return concluded(self._pipeline.match(pair, threads), pair, keeps_blank)


def _pipeline(settings: MatchSettings, device: str) -> Pipeline:
    """Return the pipeline of the CPU or the GPU; "auto" is the CPU until the kernels have run on a GPU."""
    if device != "cuda":
        return CpuPipeline(settings)
    from stereokit.cuda.pipeline import CudaPipeline  # numba.cuda is imported late

    if settings.scale == 0.25:
        raise DeviceError("scale must be 1 or 0.5 with device 'cuda', got 0.25")
    return CudaPipeline(settings)


def _mirror(pair: GrayPair) -> GrayPair:
    """Return the pair as a camera behind a mirror sees it: the right view becomes the left one."""

    def flip(image: NDArray[Any] | None) -> NDArray[Any] | None:
        return None if image is None else np.ascontiguousarray(image[:, ::-1])

    left, right = flip(pair.right), flip(pair.left)
    assert left is not None and right is not None
    ranges = None if pair.ranges is None else (pair.ranges[1], pair.ranges[0])
    return GrayPair(left, right, flip(pair.right_bad), flip(pair.left_bad), guide_of(left, right), ranges, pair.span)


_matchers: dict[Any, Matcher] = {}
_matchers_lock = threading.Lock()


def match(
    left: Any, right: Any, /, method: str = "census+sgm", *, mask: Any = None, right_mask: Any = None,
    **options: Unpack[MatchOptions],
) -> NDArray[np.float32]:  # fmt: skip
    """Match a rectified pair and return the left view's disparity map.

    The map is **filled**: where nothing was measured it holds what its surroundings make likely. ``fill=None`` leaves
    NaN there, and `Matcher` tells which is which.

    Parameters
    ----------
    left, right : (H, W), (H, W, 3) or (H, W, 4), numbers
        Rectified images of one size and type, grey, RGB or RGBA.
    method : str
        ``"cost+aggregation"`` or S1 to S4.
    mask, right_mask : (H, W) bool, optional
        True where a pixel of the left, and of the right image is usable.
    **options
        Those of `Matcher`, but ``right``: this returns the left view's map alone.

    Returns
    -------
    (H, W) float32, pixels
        Dense but for pixels without evidence (see `Matcher`), which are NaN; with ``fill=None`` all that was not
        measured is.

    Raises
    ------
    InputError, OptionError
        If an image or an option cannot be used.
    """
    values: dict[str, Any] = {**options}
    if values.pop("right", False) is not False:
        raise OptionError("right must be False here, where only the left view's map is returned; see Matcher")
    try:
        key = (method, tuple((name, type(values[name]), _file_version(values[name])) for name in sorted(values)))
        hash(key)
    except TypeError:
        return Matcher(method, **values)(left, right, mask=mask, right_mask=right_mask).disparity
    with _matchers_lock:
        matcher = _matchers.pop(key, None) or Matcher(method, **values)
        _matchers[key] = matcher  # the most recently used is last
        while len(_matchers) > 4:
            _matchers.pop(next(iter(_matchers)))
    return matcher(left, right, mask=mask, right_mask=right_mask).disparity


def _file_version(option: Any) -> Any:
    """Return an option; for the path of a weight file with the file's time, size and inode, which tell its versions."""
    if isinstance(option, (str, os.PathLike)) and os.fspath(option).endswith(".safetensors"):
        try:
            status = os.stat(option)
        except OSError:
            return option
        return option, status.st_mtime_ns, status.st_size, status.st_ino
    return option


def warmup(*methods: str, max_disparity: int = 128, **options: Unpack[WarmupOptions]) -> None:
    """Compile the kernels of the methods (or load them from the disk cache), so that no later call waits for it.

    Parameters
    ----------
    *methods : str
        Methods; none means S1 to S4.
    max_disparity : int
        As it will be used: code is compiled per 64 levels.
    **options
        Those of `Matcher`, as they will be used.

    Raises
    ------
    OptionError
        If an option cannot be used.
    """
    values: dict[str, Any] = {**options, "max_disparity": max_disparity}
    for method in methods or METHODS:
        compile_kernels(Matcher(method, **values))


def compile_kernels(matcher: Matcher, shape: tuple[int, ...] = (), dtype: Any = np.uint8) -> None:
    """Compile what a matcher needs for images of a type, so that a time taken afterwards is that of matching.

    Parameters
    ----------
    matcher : Matcher
    shape : tuple of int
        ``()`` for grey images, ``(3,)`` or ``(4,)`` for colour.
    dtype : numpy type
    """
    side = 320  # speckles are a share of the pixels: at a quarter of the size there must be some to remove
    image = np.zeros((side, side, *shape), dtype)
    image[:, ::2] = 1
    with collecting():
        matcher(image, image)
        everywhere = np.ones((side, side), np.bool_)
        map_signs(gray_pair(image, image), np.zeros((side, side), np.float32), everywhere, 0, 1)  # for `PairWatch`


def _forget_matchers() -> None:
    global _matchers_lock
    _matchers.clear()
    _matchers_lock = threading.Lock()  # the owner of the old one may be a thread that the child does not have


if hasattr(os, "register_at_fork"):  # buffers of a call that was under way stay with the parent
    os.register_at_fork(after_in_child=_forget_matchers)
