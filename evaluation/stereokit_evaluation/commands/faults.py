"""Detection and false alarms of `stereokit.check_pair` and of the look of a matcher, on good and on disturbed pairs.

``python -m stereokit_evaluation.commands.faults --data DIR --output faults.csv`` looks at every pair below `DIR`
(``kitti2015``, ``kitti2012``, ``eth3d``, ``middlebury``, ``satellite``, ``rendered``; those that are there), and
disturbs one in `--every` of them, and KITTI 2015's tunnel, frame 000104, in two dozen ways. It prints, for each kind of
fault, how often it was said of good pairs, and for each disturbance, how often one of the expected faults was said.
``--quick`` looks at the small copies that `stereokit.Matcher` looks at. ``--match METHOD`` matches each pair with a new
matcher and counts the faults that it tells; ``--alike`` adds good pairs whose views were altered alike: at half size,
both top to bottom, both darkened with noise on them. ``--cost METHOD`` times a matcher and its look instead.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit import Matcher
from stereokit.checks import PairWatch
from stereokit.images.gray import gray_pair
from stereokit.pairs import KINDS, check_pair
from stereokit_evaluation.data.datasets import Frame, eth3d, folder, kitti2012, kitti2015, middlebury
from stereokit_evaluation.synthetic.disturbances import warped
from stereokit_evaluation.synthetic.sensors import compressed

__all__ = ["Case", "altered_alike", "cases", "good_pairs", "look_cost", "main", "matcher_kinds"]

_SETS = {
    "kitti2015": kitti2015, "kitti2012": kitti2012, "eth3d": eth3d, "middlebury": middlebury, "satellite": folder,
    "rendered": folder,
}  # fmt: skip
_TUNNEL = "000104"
_MAX_DISPARITY = 128
_WIDTHS = (1242, 621, 310, 155)  # of images whose look is timed, pixels
Gray = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Case:
    """A pair that was disturbed, and the kinds of fault of which one should be said."""

    name: str
    expected: frozenset[str]
    left: Gray
    right: Gray
    min_disparity: int = 0
    max_disparity: int = _MAX_DISPARITY


def good_pairs(data: Path) -> Iterator[tuple[str, Gray, Gray]]:
    """Yield the name and the grey views of each pair of the data sets below `data`."""
    for name, load in _SETS.items():
        if (data / name).is_dir():
            for frame in load(data / name):
                yield f"{name}/{frame.name}", *_gray(frame)


def _gray(frame: Frame) -> tuple[Gray, Gray]:
    left, right = frame.load_pair(gray=True)
    return np.asarray(left, np.uint8), np.asarray(right, np.uint8)


def cases(left: Gray, right: Gray, other: Gray) -> Iterator[Case]:
    """Yield disturbances of a good pair; `other` is a view of another scene."""

    def case(name: str, kinds: str, one: Any, two: Any, *levels: int) -> Case:
        first, second = (np.ascontiguousarray(view, np.uint8) for view in (one, two))
        return Case(name, frozenset(kinds.split()), first, second, *levels)

    for offset in (-10, -5, -2, -1, 1, 2, 5, 10):
        yield case(f"offset {abs(offset)} px", "rows", left, warped(right, offset))
    for roll in (-2, -1, -0.5, -0.25, 0.25, 0.5, 1, 2):
        yield case(f"roll {abs(roll):g} degrees", "rows", left, warped(right, 0, roll))
    yield case("roll 5 degrees", "rows rotated", left, warped(right, 0, 5))
    yield case("turned by 20 degrees", "rotated", left, warped(right, 0, 20))
    yield case("turned by 180 degrees", "rotated", left, right[::-1, ::-1])
    yield case("mirrored left to right", "mirrored", left, right[:, ::-1])
    yield case("mirrored top to bottom", "mirrored", left, right[::-1])
    yield case("exchanged", "exchanged", right, left)
    yield case("both upside down", "exchanged", left[::-1, ::-1], right[::-1, ::-1])
    yield case("one view twice", "same", left, left)
    yield case("one view twice, one as JPEG", "same", left, compressed(left, 80))
    yield case("another scene", "unrelated", left, cv2.resize(other, left.shape[::-1]))
    yield case("2.2 times as bright", "exposure", left, np.clip(right * 2.2, 0, 255))
    yield case("2.2 times as dark", "exposure", left, right / 2.2)
    yield case("right blurred, sigma 1.5", "sharpness", left, cv2.GaussianBlur(right, (0, 0), 1.5))
    yield case("left blurred, sigma 3", "sharpness", cv2.GaussianBlur(left, (0, 0), 3), right)
    disparities = check_pair(left, right).disparities
    if disparities is not None and disparities[1] - max(disparities[0], 0) > 6:
        low, high = max(disparities[0], 0), disparities[1]
        near, far = low + 0.7 * (high - low), low + 0.3 * (high - low)
        yield case("range ends too early", "range exchanged", left, right, 0, max(int(near), 1))
        yield case("range begins too late", "range", left, right, int(far) + 2, _MAX_DISPARITY + 64)


def altered_alike(left: Gray, right: Gray) -> Iterator[tuple[str, Gray, Gray]]:
    """Yield the name and the views of good pairs that come of a good pair, when both views are altered alike."""
    height, width = left.shape
    size = (width // 2, height // 2)
    small = [np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA), np.uint8) for view in (left, right)]
    yield "half size", small[0], small[1]
    yield "both top to bottom", np.ascontiguousarray(left[::-1]), np.ascontiguousarray(right[::-1])
    rng = np.random.default_rng(0)
    dark = [np.clip(view * 0.3 + rng.normal(0, 2, view.shape), 0, 255).astype(np.uint8) for view in (left, right)]
    yield "both darkened, with noise", dark[0], dark[1]


def matcher_kinds(method: str, case: Case) -> set[str]:
    """Return the kinds of fault that a new matcher tells of a pair."""
    matcher = Matcher(method, min_disparity=case.min_disparity, max_disparity=case.max_disparity)
    pair = gray_pair(case.left, case.right)
    result = matcher.match_gray(pair, matcher.threads)
    faults = PairWatch(matcher.scale, matcher.settings.searched).faults(
        pair, result, case.min_disparity, case.max_disparity
    )
    return {fault.kind for fault in faults}


def look_cost(
    pairs: list[tuple[str, Gray, Gray]], method: str, width: int, threads: int, rounds: int
) -> tuple[float, float, float]:  # fmt: skip
    """Return the seconds of a match and of the look at it, medians, and the share that all looks are of all matches.

    Parameters
    ----------
    pairs : list of (name, left, right)
    method : str
    width : int
        To which the pairs are shrunk, pixels; a tenth of it is searched.
    threads, rounds : int
    """
    matcher = Matcher(method, max_disparity=width // 10, threads=threads)
    watch, times = PairWatch(searched=matcher.settings.searched), []
    for turn in range(rounds + 1):
        for _, *views in pairs:
            size = width, round(views[0].shape[0] * width / views[0].shape[1])
            small = [np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA), np.uint8) for view in views]
            start = time.perf_counter()
            pair = gray_pair(small[0], small[1])
            result = matcher.match_gray(pair, threads)
            matched = time.perf_counter()
            watch.faults(pair, result, matcher.min_disparity, matcher.max_disparity)
            if turn:  # the first one compiles
                times.append((matched - start, time.perf_counter() - matched))
    match, look = np.median(times, axis=0)
    totals = np.sum(times, axis=0)
    return float(match), float(look), float(totals[1] / totals[0])


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--match", metavar="METHOD")
    parser.add_argument("--alike", action="store_true")
    parser.add_argument("--cost", metavar="METHOD")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    pairs = list(good_pairs(options.data))
    if options.cost:
        _print_cost(pairs[: 8 * options.every : options.every], options.cost)
        return
    if options.output is None:
        parser.error("--output is needed, unless --cost is given")
    with options.output.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["pair", "disturbance", "expected", "said", "warned"])

        def look(name: str, case: Case) -> tuple[set[str], set[str]]:
            levels: dict[str, Any] = {"min_disparity": case.min_disparity, "max_disparity": case.max_disparity}
            said = {fault.kind for fault in check_pair(case.left, case.right, quick=options.quick, **levels).faults}
            warned = matcher_kinds(options.match, case) if options.match else set[str]()
            rows.writerow([name, case.name, *(" ".join(sorted(kinds)) for kinds in (case.expected, said, warned))])
            file.flush()
            return said, warned

        _print_alarms(_good_cases(pairs, options.alike), look)
        chosen = [k for k, (name, *_) in enumerate(pairs) if k % options.every == 0 or _TUNNEL in name]
        counts: dict[str, Counter[str]] = defaultdict(Counter)
        for k in chosen:
            name, left, right = pairs[k]
            for case in cases(left, right, pairs[(k + len(pairs) // 2) % len(pairs)][2]):
                said, warned = look(name, case)
                counts[case.name].update(
                    {"said": bool(said & case.expected), "all": 1, "warned": bool(warned),
                     "warned so": bool(warned & case.expected)}
                )  # fmt: skip
    print(f"{sum(count['all'] for count in counts.values())} disturbed pairs:")
    for case_name, count in counts.items():
        matched = f"  warned of {count['warned']:3d}, by its kind {count['warned so']:3d}" if options.match else ""
        share = f"{count['said']:3d} of {count['all']:3d} {100 * count['said'] / count['all']:6.1f} %"
        print(f"  {case_name:28s} {share}{matched}")


def _print_cost(pairs: list[tuple[str, Gray, Gray]], method: str) -> None:
    for width in _WIDTHS:
        for threads in (2, 1):
            match, look, share = look_cost(pairs, method, width, threads, 8 * _WIDTHS[0] // width)
            times = f"match {1000 * match:.2f} ms, look {1000 * look:.3f} ms"
            print(f"{method} {width} pixels wide, {threads} threads: {times}; of all {100 * share:.1f} %")


def _good_cases(pairs: list[tuple[str, Gray, Gray]], alike: bool) -> Iterator[tuple[str, Case]]:
    for name, left, right in pairs:
        yield name, Case("", frozenset(), left, right)
        for change, one, two in altered_alike(left, right) if alike else ():
            levels = _MAX_DISPARITY // 2 if change == "half size" else _MAX_DISPARITY
            yield f"{name}, {change}", Case("", frozenset(), one, two, 0, levels)


def _print_alarms(
    good: Iterable[tuple[str, Case]], look: Callable[[str, Case], tuple[set[str], set[str]]]
) -> None:  # fmt: skip
    """Look at good pairs, and print how many there are and how often each kind of fault was said of them."""
    total, said, warned = 0, Counter[str](), Counter[str]()
    for name, case in good:
        by_check, by_matcher = look(name, case)
        total += 1
        said.update(by_check)
        warned.update(by_matcher)
    for who, alarms in (("check", said), ("matcher", warned)):
        print(f"{total} good pairs; false alarms of the {who}:", {kind: alarms[kind] for kind in KINDS})


if __name__ == "__main__":
    main()
