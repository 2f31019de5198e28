"""Detection and false alarms of `stereokit.check_pair`: good pairs of all data sets, and the same pairs disturbed.

``python -m stereokit_evaluation.commands.faults --data DIR --output faults.csv`` looks at every pair below `DIR`
(``kitti2015``, ``kitti2012``, ``eth3d``, ``middlebury``, ``satellite``, ``rendered``; those that are there), and
disturbs one in `--every` of them, and KITTI 2015's tunnel, frame 000104, in two dozen ways. It prints, for each kind of
fault, how often it was said of good pairs, and for each disturbance, how often one of the expected faults was said.
``--quick`` looks at the small copies that `stereokit.Matcher` looks at; ``--match`` matches as well and counts the
warnings of the matcher.
"""

from __future__ import annotations

import argparse
import csv
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit import Matcher
from stereokit.notices import collecting
from stereokit.pairs import KINDS, check_pair
from stereokit_evaluation.data.datasets import Frame, eth3d, folder, kitti2012, kitti2015, middlebury
from stereokit_evaluation.synthetic.disturbances import warped
from stereokit_evaluation.synthetic.sensors import compressed

__all__ = ["Case", "cases", "good_pairs", "main"]

_SETS = {
    "kitti2015": kitti2015, "kitti2012": kitti2012, "eth3d": eth3d, "middlebury": middlebury, "satellite": folder,
    "rendered": folder,
}  # fmt: skip
_TUNNEL = "000104"
_MAX_DISPARITY = 128
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


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--match", metavar="METHOD")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    pairs = list(good_pairs(options.data))
    alarms: Counter[str] = Counter()
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    with options.output.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["pair", "disturbance", "expected", "said", "warned"])

        def look(name: str, case: Case) -> tuple[set[str], int]:
            levels: dict[str, Any] = {"min_disparity": case.min_disparity, "max_disparity": case.max_disparity}
            report = check_pair(case.left, case.right, quick=options.quick, **levels)
            warned = 0
            if options.match:
                with collecting() as lines:
                    Matcher(options.match, **levels)(case.left, case.right)
                warned = len(lines)
            said = {fault.kind for fault in report.faults}
            rows.writerow([name, case.name, " ".join(sorted(case.expected)), " ".join(sorted(said)), warned])
            file.flush()
            return said, warned

        warnings = 0
        for name, left, right in pairs:
            said, warned = look(name, Case("", frozenset(), left, right))
            alarms.update(said)
            warnings += warned
        print(
            f"{len(pairs)} good pairs; false alarms:", {kind: alarms[kind] for kind in KINDS}, f"warned of: {warnings}"
        )
        chosen = [k for k, (name, *_) in enumerate(pairs) if k % options.every == 0 or _TUNNEL in name]
        for k in chosen:
            name, left, right = pairs[k]
            for case in cases(left, right, pairs[(k + len(pairs) // 2) % len(pairs)][2]):
                said, warned = look(name, case)
                counts[case.name][0] += bool(said & case.expected)
                counts[case.name][1] += 1
                counts[case.name][2] += warned > 0
    print(f"{sum(total for _, total, _ in counts.values())} disturbed pairs:")
    for case_name, (detected, total, warned) in counts.items():
        print(f"  {case_name:28s} {detected:3d} of {total:3d} {100 * detected / total:6.1f} %  warned of {warned}")


if __name__ == "__main__":
    main()
