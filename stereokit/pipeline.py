"""The protocol of pipelines from a pair to a map, and the pipeline of the CPU.

A pipeline is built from `stereokit.settings.MatchSettings`. Its only state between calls is its buffers; many threads
may use it at the same time. The pipeline of the GPU is `stereokit.cuda.pipeline.CudaPipeline`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereokit.costs.rows import CostInput, Levels, Search, takes_8_bits
from stereokit.errors import OptionError
from stereokit.images.blank import blank_pixels
from stereokit.images.blur import smooth
from stereokit.images.evidence import joined
from stereokit.images.gray import GrayPair
from stereokit.images.intensity import scale_guide
from stereokit.images.resize import half_size, reduced
from stereokit.kernels.simd import LANES
from stereokit.kernels.trace import span
from stereokit.kernels.workspace import Pool, Workspace
from stereokit.postprocess.chain import post_process
from stereokit.result import Disparity
from stereokit.search import EXPECTED_CONFIDENCE, halved_levels, plan_search, restore_thin
from stereokit.selection.wta import selection_output
from stereokit.settings import Detail, MatchSettings

__all__ = ["CpuPipeline", "Pipeline", "concluded", "refined", "with_blank"]

_HALF_SIZE_MEDIAN = 5
"""Side of the median of maps that tell where to search, whatever `median` is: that of `match_large`'s windows is 0."""
_PROBES = (256, 512)
"""Sides of the images that are matched to measure the growth of the buffers, pixels."""


class Pipeline(Protocol):
    """From a checked pair to the left view's map."""

    @property
    def settings(self) -> MatchSettings:
        """Everything a map depends on, except the images."""

    def match(self, pair: GrayPair, threads: int) -> Disparity:
        """Match a checked pair.

        Parameters
        ----------
        pair : GrayPair
            At full size, also where it is matched at half size.
        threads : int
            Threads that this call may use; the result does not depend on it.

        Returns
        -------
        Disparity, (H, W)
            Refined, where the settings have a refiner; without the right view's map.
        """

    def replaced(self, **changes: Any) -> Pipeline:
        """Return a pipeline of the same kind whose settings differ in some values."""

    def nbytes(self, height: int, width: int, dtype: Any = np.uint8, threads: int = 1) -> float:
        """Return the bytes of the buffers for a pair, without images, maps and the refiner.

        Parameters
        ----------
        height, width : int
            Of the images, pixels.
        dtype : dtype
            Of the grey images, uint8 or uint16.
        threads : int
            Each has buffers of its own.
        """


def refined(settings: MatchSettings, coarse: Disparity, pair: GrayPair, threads: int) -> Disparity:
    """Return the final map of a pipeline: at full size, without the outputs that only the refiner needed.

    Raises
    ------
    OptionError
        If the refiner returns something else than a map of the image's size.
    """
    if settings.refiner is None:
        return coarse
    with span("refine", "refine"):
        full = _refine(settings, coarse, pair, settings.scale, threads)
    disparity = full.disparity
    if settings.bounds is not None:
        low, high = settings.bounds
        own = disparity if getattr(settings.refiner, "maps_are_new", False) else None
        disparity = np.clip(disparity, np.float32(low), np.float32(high), out=own)
    return Disparity(disparity, full.valid, full.confidence if settings.confidence else None)


def _refine(
    settings: MatchSettings, coarse: Disparity, pair: GrayPair, scale: float, threads: int, *, for_search: bool = False
) -> Disparity:
    """Return what the refiner makes of a map; OptionError if that has not the size of the image."""
    refiner: Any = settings.refiner
    keywords: dict[str, Any] = {}
    if getattr(refiner, "any_scale", False):
        keywords["scale"] = scale
    if getattr(refiner, "needs_right", False):
        keywords["right"] = pair.right if pair.right.dtype == np.uint8 else scale_guide(pair.right, *pair.span)
    call = getattr(refiner, "for_search", refiner) if for_search else refiner
    full: Any = call(coarse, pair.guide, threads=threads, **keywords)
    if not isinstance(full, Disparity) or full.disparity.shape != pair.guide.shape:
        received = full.disparity.shape if isinstance(full, Disparity) else type(full).__name__
        size = pair.guide.shape
        raise OptionError(
            f"refiner {settings.refiner_name!r} must return a Disparity of the image's {size}, got {received}"
        )
    return full


def with_blank(pair: GrayPair, settings: MatchSettings, threads: int) -> GrayPair:
    """Return the pair with its blank pixels: those around which the left view has no texture as far as a match looks.

    Parameters
    ----------
    pair : GrayPair
        At full size.
    settings : MatchSettings
        Of whose cost the window counts, of whose smoothing the kernel, and the size of the matching. Costs that do not
        say how far they look have no blank pixels.
    threads : int
        Threads to use.
    """
    if settings.reach is None or pair.left_blank is not None:
        return pair
    with span("prepare", "blank pixels"):
        return replace(pair, left_blank=blank_pixels(pair.left, *settings.reach, threads))


def concluded(result: Disparity, pair: GrayPair, keeps_blank: bool = True) -> Disparity:
    """Return a map that says nothing of pixels without evidence, and calls no blank pixel measured.

    Parameters
    ----------
    result : Disparity
        At full size.
    pair : GrayPair
    keeps_blank : bool
        Whether blank pixels keep the value that their neighbours gave them.
    """
    bad, blank = pair.left_bad, pair.left_blank
    unmeasured = joined(bad, blank)
    if unmeasured is None:
        return result
    parts: dict[str, Any] = {"disparity": result.disparity, "valid": result.valid & ~unmeasured}
    empty = bad if keeps_blank else unmeasured
    if empty is not None:
        parts["disparity"] = np.where(empty, np.float32(np.nan), result.disparity)
    if result.confidence is not None:
        parts["confidence"] = np.where(unmeasured, np.float32(0), result.confidence)
    return replace(result, **parts)


class CpuPipeline:
    """The pipeline of the CPU.

    Parameters
    ----------
    settings : MatchSettings
    """

    def __init__(self, settings: MatchSettings) -> None:
        self.settings = settings
        self._refines = settings.refines_search
        self._workspaces = Pool(Workspace)
        self._growth: dict[tuple[np.dtype[Any], int], NDArray[np.float64]] = {}  # of the buffers, by image and threads

    def match(self, pair: GrayPair, threads: int) -> Disparity:
        """Match a checked pair; see `Pipeline`."""
        with self._workspaces.take() as workspace:
            coarse = self._coarse(pair, workspace, threads)
        return refined(self.settings, coarse, pair, threads)

    def _coarse(self, pair: GrayPair, workspace: Workspace, threads: int) -> Disparity:
        """Return the map at the size of the matching."""
        settings = self.settings
        if settings.scale != 1:
            with span("prepare", "half size"):
                pair = reduced(pair, settings.step, threads)
        return self._map(pair, settings.matched_levels, settings.detail, workspace, threads)

    def _search(
        self, pair: GrayPair, smoothed: GrayPair, levels: Levels, workspace: Workspace, threads: int
    ) -> Search | None:
        """Return what each pixel of a pair tries; None where every pixel tries all levels."""
        is_matched_size = levels == self.settings.matched_levels
        if not self.settings.coarse_to_fine or not (is_matched_size or levels.count > LANES):
            return None
        with span("prepare", "half size"):
            half = half_size(pair, threads, tolerant=True)
            if pair.ranges is None and getattr(self.settings.cost, "needs_ranges", False):
                left, right = ((int(view.min()), int(view.max())) for view in (smoothed.left, smoothed.right))
                half = replace(half, ranges=(left, right))  # all sizes have one range, as in windows of larger images
        refines = is_matched_size and self._refines
        detail = self.settings.detail if refines else Detail.DISPARITY
        coarse = self._map(half, halved_levels(levels), detail, workspace.part("half"), threads, plans=True)
        if refines:
            coarse = self._refined_guide(coarse, half, halved_levels(levels), threads)
        with span("prepare", "search ranges"):
            shape = pair.left.shape
            search = Search(
                workspace.array("search.starts", shape, np.int16),
                workspace.array("search.low", shape, np.uint8),
                workspace.array("search.high", shape, np.uint8),
            )
            plan_search(coarse.disparity, coarse.valid, levels, search, threads)
        return search

    def _refined_guide(self, coarse: Disparity, half: GrayPair, levels: Levels, threads: int) -> Disparity:
        """Return the half-size map as the refiner makes it, called measured where it is sure; thin things stay."""
        with span("refine", "refine at half size"):
            better = _refine(self.settings, coarse, half, 1, threads, for_search=True)
        lowest, highest = np.float32(levels.minimum), np.float32(levels.minimum + levels.count - 1)
        disparity = np.clip(better.disparity, lowest, highest)
        disparity = np.where(np.isnan(disparity), coarse.disparity, disparity)
        restore_thin(coarse.disparity, disparity, threads)
        sure = coarse.valid if better.confidence is None else better.confidence > EXPECTED_CONFIDENCE
        return Disparity(disparity, sure if half.left_blank is None else sure & ~half.left_blank)

    def _map(
        self, pair: GrayPair, levels: Levels, detail: Detail, workspace: Workspace, threads: int, *,
        plans: bool = False,
    ) -> Disparity:  # fmt: skip
        """Return the map of a pair at its own size; one that `plans` the search of the next size is filled."""
        settings = self.settings
        cost, aggregation = settings.cost, settings.aggregation
        guide = pair.guide
        with span("prepare", "smooth"):
            smoothed = smooth(pair, settings.smooth, workspace, threads, eight_bits=takes_8_bits(cost))
        search = self._search(pair, smoothed, levels, workspace, threads)
        starts = None if search is None else search.starts
        pair = smoothed
        shape = pair.left.shape
        with span("prepare", "prepare cost"):
            rows = cost.prepare(
                CostInput(
                    pair.left,
                    pair.right,
                    joined(pair.left_bad, pair.left_blank),
                    pair.right_bad,
                    levels,
                    settings.border_cost,
                    threads,
                    pair.ranges,
                    starts,
                ),
                workspace,
                max(2, threads),
            )
        disparity = workspace.array("match.disparity", shape, np.float32)
        total = workspace.array("match.cost", shape, aggregation.total_dtype)
        confidence = np.empty(shape, np.float32) if detail >= Detail.CONFIDENCE else None
        candidates = np.empty((2, *shape), np.float32) if detail >= Detail.CANDIDATES else None
        searched = levels.count if starts is None else LANES
        out = selection_output(
            disparity, total, confidence, searched, levels.minimum, settings.subpixel, settings.uniqueness,
            candidates, starts,
        )  # fmt: skip
        keywords: dict[str, Any] = {} if search is None else {"search": search}
        with span("match", "sweep, around its kernels"):
            aggregation.sweep(rows, levels, cost, guide, workspace, threads, out, **keywords)
        selected = None
        if plans:
            selected = workspace.array("match.selected", shape, np.float32)
            np.copyto(selected, disparity)
        with span("clean", "post-processing"):
            chain = settings.post_processing(disparity.size)
            if plans:
                chain = replace(chain, fill="nearest", median=_HALF_SIZE_MEDIAN, empty_value=levels.minimum)
            bad = None if plans else pair.left_bad
            disparity, valid = post_process(disparity, total, bad, chain, workspace, threads)
            if selected is not None:
                restore_thin(selected, disparity, threads)
            if pair.left_blank is not None:
                valid &= ~pair.left_blank
            if confidence is not None:
                confidence[~valid] = 0
        return Disparity(disparity, valid, confidence, candidates=candidates)

    def replaced(self, **changes: Any) -> CpuPipeline:
        """Return a pipeline whose settings differ in some values."""
        return CpuPipeline(self.settings.replaced(**changes))

    def nbytes(self, height: int, width: int, dtype: Any = np.uint8, threads: int = 1) -> float:
        """Return the bytes of the buffers for a pair; see `Pipeline`. Measured on four small pairs."""
        if threads > 2:  # each has as much more
            two, three = (self.nbytes(height, width, dtype, 2), self._measured(height, width, dtype, 3))
            return two + max(min(threads, -(-height // 4)) - 2, 0) * max(three - two, 0)
        return self._measured(height, width, dtype, threads)

    def _measured(self, height: int, width: int, dtype: Any, threads: int) -> float:
        dtype = np.dtype(dtype)
        if (dtype, threads) not in self._growth:
            sizes = [(rows, columns) for rows in _PROBES for columns in _PROBES]
            terms = np.array([(1, rows, columns, rows * columns) for rows, columns in sizes], float)
            nbytes = np.array([self._buffer_nbytes(*size, dtype, threads) for size in sizes], float)
            self._growth[dtype, threads] = np.linalg.solve(terms, nbytes)
        return float(self._growth[dtype, threads] @ (1, height, width, height * width))

    def _buffer_nbytes(self, height: int, width: int, dtype: Any, threads: int) -> int:
        """Return the bytes of the buffers of one match, after matching a made-up pair."""
        image = (np.arange(height * width, dtype=np.uint32) * 2654435761 >> 16).astype(dtype).reshape(height, width)
        workspace = Workspace()
        probe = CpuPipeline(self.settings)
        probe._refines = False  # a refiner's buffers are its own
        probe._coarse(GrayPair(image, image, None, None, image.astype(np.uint8)), workspace, threads)
        return workspace.nbytes
