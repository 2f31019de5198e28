"""Generated calls of the public functions: random images, options and threads, and nonsense among them.

A good call gives a map of the right type and shape, within the range, the same each time, and leaves its images as they
are. A call with nonsense either gives such a map, or one of stereokit's errors on one line.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import stereokit
from stereokit.errors import StereokitError
from stereokit.postprocess import fill, median, remove_speckles, single_matching_phase

__all__ = ["run_call"]

Rng = np.random.Generator

METHODS = ("S1", "S2", "S3", "S4")
OTHER_KERNELS: tuple[dict[str, Any], ...] = (
    {"method": "S1", "mode": "sum"},
    {"method": "S2", "paths": 8},
    {"method": "S2", "paths": 5},
    {"method": "S4", "paths": 8},
    {"method": "S2", "window": "7x7"},
)
"""What compiles kernels of its own; the rest of the options do not."""

NONSENSE: tuple[Any, ...] = (
    None, "", "x", "nearest", "S1", b"1", -1, 0, 1, 3, 10**5000, -(10**30), 0.5, 1.5, -0.5, np.nan, np.inf, 1e300, 1j,
    True, False, [], [1, 2], (), {}, {"a": 1}, {1}, np.array([1, 2]), np.zeros((2, 2)), np.float32(3), np.int8(-1),
    np.complex64(1), np.datetime64(0, "s"), np.str_("sgm"), object, len, Ellipsis, range(3), slice(1),
)  # fmt: skip
NAMES = (
    "method", "max_disparity", "min_disparity", "scale", "refiner", "threads", "fill", "median", "border_cost",
    "smooth",
    "uniqueness", "speckle", "smp", "subpixel", "confidence", "right", "window", "steps", "p1", "p2", "paths", "edge",
    "edge_factor", "sigma_s", "sigma_v", "sigma_r", "passes", "mode", "nodata", "unknown",
)  # fmt: skip


def run_call(seed: int, number: int) -> int:
    """Make one case; return how many calls it made.

    Raises
    ------
    Exception
        Whatever is a finding.
    """
    rng = np.random.default_rng([seed, number])
    kinds = (good_match, nonsense_match, stages, filters, nonsense_filters, several)
    return kinds[rng.choice(len(kinds), p=(0.45, 0.25, 0.1, 0.1, 0.05, 0.05))](rng)


def check(condition: Any, what: str) -> None:
    """Raise AssertionError with a message unless a property holds."""
    if not condition:
        raise AssertionError(what)


def refused(call: Any) -> Any:
    """Return the result of a call, or None if it was refused in one line."""
    try:
        return call()
    except StereokitError as error:
        check("\n" not in str(error) and 0 < len(str(error)) < 1000, f"not one short line: {error}")
        return None


def shape_of(rng: Rng) -> tuple[int, int]:
    """Return a small size, often a degenerate one."""
    kind = rng.integers(8)
    if kind == 0:
        return 1, int(rng.integers(1, 80))
    if kind == 1:
        return int(rng.integers(1, 80)), 1
    if kind == 2:
        return int(rng.integers(30, 64)), int(rng.integers(60, 200))
    return int(rng.integers(1, 24)), int(rng.integers(1, 70))


def grey(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Return whole numbers from 0 to 255: noise, texture, blank, a ramp or two levels."""
    kind = rng.integers(5)
    if kind == 0:
        return rng.integers(0, 256, shape)
    if kind == 1:
        coarse = rng.integers(0, 256, (shape[0] // 4 + 1, shape[1] // 4 + 1))
        return coarse.repeat(4, 0).repeat(4, 1)[: shape[0], : shape[1]]
    if kind == 2:
        return np.full(shape, rng.integers(0, 256))
    if kind == 3:
        return (np.arange(shape[1]) * rng.integers(0, 9) + np.arange(shape[0])[:, None]) % 256
    return rng.integers(0, 2, shape) * 255


def laid_out(rng: Rng, image: np.ndarray) -> Any:
    """Return an image in another layout of memory, of the same values."""
    kind = rng.integers(8)
    if kind == 0:
        return np.asfortranarray(image)
    if kind == 1:
        return np.repeat(image, 2, axis=1)[:, ::2]
    if kind == 2:
        return image[::-1].copy()[::-1]
    if kind == 3:
        return image.astype(image.dtype.newbyteorder(">"))
    if kind == 4:
        raw = np.empty(image.nbytes + 1, np.uint8)[1:]
        unaligned = raw.view(image.dtype).reshape(image.shape) if image.size else image
        unaligned[...] = image
        return unaligned
    if kind == 5:
        image.flags.writeable = False
    return image


def pair(rng: Rng, shape: tuple[int, int]) -> tuple[Any, Any]:
    """Return two images of one size and type."""
    left = grey(rng, shape)
    right = np.roll(left, -int(rng.integers(0, 9)), axis=1) if rng.random() < 0.8 else grey(rng, shape)
    dtype = rng.choice([np.uint8, np.uint8, np.uint16, np.float32, np.float64])
    images = []
    channels = rng.random() < 0.2
    for whole in (left, right):
        image = whole.astype(dtype)
        if dtype == np.uint16:
            image *= dtype(257)
        if dtype in (np.float32, np.float64):
            image = image * dtype(rng.choice([1.0, 1 / 255, 1e-30, 1e30, 0.37])) + dtype(rng.choice([0, 0, -3]))
            for value in (np.nan, np.inf, -np.inf):
                if rng.random() < 0.2:
                    image[rng.random(shape) < rng.choice([0.02, 0.5, 1])] = value
        if channels:
            image = np.stack([image] * 3, axis=2)
        images.append(laid_out(rng, image))
    return images[0], images[1]


def options_of(rng: Rng) -> dict[str, Any]:
    """Return options that are within their rules."""
    options: dict[str, Any] = {"method": str(rng.choice(METHODS)), "device": "cpu"}
    if rng.random() < 0.1:
        options.update(OTHER_KERNELS[rng.integers(len(OTHER_KERNELS))])
    low = int(rng.choice([0, 0, 0, 1, 5, -7, -20, 200]))
    many = rng.random() < 0.1
    options["min_disparity"] = low
    options["max_disparity"] = low + int(rng.integers(65, 129) if many else rng.integers(1, 65))
    choices: dict[str, tuple[Any, ...]] = {
        "threads": (1, 2, 2, 3, 7), "fill": (None, "background", "nearest"), "median": (0, 3, 5),
        "border_cost": (None, 0.0, 0.5, 1.0), "smooth": (0, 0.6, 1.4), "uniqueness": (0, 3, 100),
        "speckle": (0, 0.002, 0.2, 1), "smp": (True, False), "subpixel": (True, False), "confidence": (True, False),
        "right": (False, True), "scale": (1, 0.5),
    }  # fmt: skip
    for name, values in choices.items():
        if rng.random() < 0.4:
            options[name] = values[rng.integers(len(values))]
    return options


def check_map(result: Any, shape: tuple[int, ...], options: dict[str, Any]) -> None:
    """Check what holds of any result."""
    check(isinstance(result, stereokit.Disparity), "the result is no Disparity")
    check(result.disparity.dtype == np.float32 and result.disparity.shape == shape[:2], "type or shape of the map")
    check(result.valid.dtype == np.bool_ and result.valid.shape == shape[:2], "type or shape of what is valid")
    low, high = options["min_disparity"], options["max_disparity"]
    maps = [result.disparity] + ([] if result.right is None else [result.right])
    check(len(maps) == 1 + bool(options.get("right", False)), "the right view's map")
    high_end = high - 1 if options.get("scale", 1) == 1 else max(2 * (-(-high // 2) - 1), low)
    for values in maps:
        known = values[~np.isnan(values)]
        check(known.size == 0 or (low <= known.min() and known.max() <= high_end), "disparity out of range")
        if options.get("fill", "nearest") is not None:
            check(known.size == values.size, "gaps in a filled map")
    if options.get("confidence"):
        check(result.confidence is not None and result.confidence.shape == shape[:2], "no confidence")
        check(result.confidence.min() >= 0 and result.confidence.max() <= 1, "confidence out of range")
        check(not result.confidence[~result.valid].any(), "confidence of what is not valid")
    else:
        check(result.confidence is None, "a confidence that nobody asked for")


def same(a: Any, b: Any) -> bool:
    """Return whether two arrays hold the same, NaN too."""
    return bool(np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind == "f"))


def good_match(rng: Rng) -> int:
    """Match a pair twice, with other threads, and as `match` does."""
    left, right = pair(rng, shape_of(rng))
    before = left.copy(), right.copy()
    options = options_of(rng)
    result = stereokit.Matcher(**options)(left, right)
    check_map(result, left.shape, options)
    again = stereokit.Matcher(**{**options, "threads": 1})(left, right)
    for name in ("disparity", "valid", "confidence", "right"):
        check(same(getattr(result, name), getattr(again, name)), f"{name} depends on the threads or the time")
    plain = {name: value for name, value in options.items() if name != "right"}
    simple = stereokit.match(np.ascontiguousarray(left), np.ascontiguousarray(right), **plain)
    check(same(result.disparity, simple), "match differs from Matcher")
    check(same(left, before[0]) and same(right, before[1]), "an image was modified")
    return 3


def nonsense_match(rng: Rng) -> int:
    """Match with one or two options, or an image, that may be nonsense."""
    shape = shape_of(rng)
    left, right = pair(rng, shape)
    options = options_of(rng)
    for _ in range(rng.integers(0, 3)):
        options[str(rng.choice(NAMES))] = NONSENSE[rng.integers(len(NONSENSE))]
    images = [left, right]
    if rng.random() < 0.5:
        images[rng.integers(2)] = bad_image(rng, left)
    error = refused(lambda: stereokit.Matcher(**options)(*images))
    if error is not None:
        check(isinstance(error, stereokit.Disparity) and error.disparity.shape == np.shape(images[0])[:2], "no map")
    refused(lambda: stereokit.match(*images, **options))
    return 2


def bad_image(rng: Rng, image: np.ndarray) -> Any:
    """Return something that is no image, or none of the same size or type."""
    kind = rng.integers(12)
    if kind == 0:
        return NONSENSE[rng.integers(len(NONSENSE))]
    if kind == 1:
        with np.errstate(all="ignore"):
            return image.astype(rng.choice([np.int32, np.int8, np.uint64, np.float16, np.complex64, bool, object]))
    if kind == 2:
        return image[: rng.integers(0, 2)]
    if kind == 3:
        return image.tolist()
    if kind == 4:
        return np.stack([image] * int(rng.integers(1, 6)), axis=-1)
    if kind == 5:
        return np.ma.masked_array(image)
    if kind == 6:
        return image.astype("U4") if image.dtype.kind != "f" else image.astype("S8")
    if kind == 7:
        return np.zeros((), image.dtype)
    if kind == 8:
        return [[1, 2], [3]]
    if kind == 9:
        return np.zeros((3, 4), [("a", "f4")])
    if kind == 10:
        return np.broadcast_to(np.zeros((), image.dtype), image.shape)
    return image.view(np.recarray)


def stages(rng: Rng) -> int:
    """Run the stages on volumes, with odd arguments among them."""
    left, right = pair(rng, shape_of(rng))
    count = int(rng.integers(1, 65))
    low = int(rng.integers(-9, 9))
    cost = str(rng.choice(["census", "zncc"]))
    threads = int(rng.integers(1, 4))
    volume = stereokit.cost_volume(
        left,
        right,
        cost,
        min_disparity=low,
        max_disparity=low + count,
        threads=threads,
        smooth=float(rng.choice([0, 0.7])),
    )
    check(volume.dtype == np.uint8 and volume.shape == (*left.shape[:2], count), "type or shape of the volume")
    guide = rng.integers(0, 256, left.shape[:2], dtype=np.uint8)
    total = stereokit.aggregate(volume, guide, str(rng.choice(["sgm", "dt"])), cost=cost, threads=threads)
    check(total.shape == volume.shape, "shape of the aggregated volume")
    disparity, least, confidence = stereokit.select(total, min_disparity=low, subpixel=bool(rng.integers(2)))
    check(low <= disparity.min() and disparity.max() <= low + count - 1, "selection out of range")
    check(same(least, total.min(axis=2)), "cost of the winner")
    check(confidence.min() >= 0 and confidence.max() <= 1, "confidence out of range")
    floats = rng.random((*left.shape[:2], count)).astype(np.float32) * np.float32(rng.choice([1.0, 1e-38, 1e38]))
    floats[rng.random(floats.shape) < rng.choice([0, 0.3, 1])] = rng.choice([np.nan, np.inf])
    disparity, least, confidence = stereokit.select(floats, min_disparity=low)
    nothing = ~np.isfinite(floats).any(axis=2)
    check(same(np.isnan(disparity), nothing) and same(np.isnan(least), nothing), "NaN where there are no costs")
    known = disparity[~nothing]
    check(known.size == 0 or (low <= known.min() and known.max() <= low + count - 1), "selection out of range")
    odd = NONSENSE[rng.integers(len(NONSENSE))]
    refused(lambda: stereokit.aggregate(odd, guide))
    refused(lambda: stereokit.aggregate(volume, odd))
    refused(lambda: stereokit.aggregate(volume, guide, odd))
    refused(lambda: stereokit.aggregate(volume, guide, cost=odd))
    refused(lambda: stereokit.select(odd))
    refused(lambda: stereokit.select(total, min_disparity=odd))
    refused(lambda: stereokit.cost_volume(left, right, odd))
    refused(lambda: stereokit.cost_volume(left, right, cost, max_disparity=odd))
    return 12


def some_map(rng: Rng) -> np.ndarray:
    """Return a map with gaps."""
    shape = shape_of(rng)
    values = (rng.integers(-40, 400, shape) / 8).astype(np.float32)
    values[rng.random(shape) < rng.choice([0, 0.2, 0.9, 1])] = np.nan
    if rng.random() < 0.2:
        values[rng.random(shape) < 0.1] = rng.choice([np.inf, -np.inf, 3e38, -3e38])
    return values


def filters(rng: Rng) -> int:
    """Post-process a map."""
    disparity = some_map(rng)
    before = disparity.copy()
    gaps = np.isnan(disparity)
    threads = int(rng.integers(1, 4))
    filled = fill(disparity, str(rng.choice(["nearest", "background"])), threads=threads)
    check(np.isnan(filled).all() if gaps.all() else not np.isnan(filled).any(), "gaps after a fill")
    check(same(filled[~gaps], disparity[~gaps]), "a fill changed what is valid")
    smooth = median(disparity, int(rng.choice([3, 5])))
    check(same(np.isnan(smooth), gaps), "the median changed what is valid")
    check(np.isin(smooth[~gaps], disparity).all(), "a median that is no value of the map")
    clean = remove_speckles(disparity, int(rng.integers(0, 30)), float(rng.choice([0, 1, 5])), threads=threads)
    check(same(clean[~np.isnan(clean)], disparity[~np.isnan(clean)]), "a speckle filter changed a value")
    cost = rng.integers(0, 9, disparity.shape).astype(rng.choice([np.uint16, np.int16, np.float32]))
    single = single_matching_phase(disparity, cost, threads=threads)
    columns = np.arange(disparity.shape[1]) - single + np.float32(0.5)
    for row in np.floor(columns):
        matched = row[~np.isnan(row)]
        check(len(np.unique(matched)) == len(matched), "two pixels match one")
    check(same(disparity, before), "a map was modified")
    return 4


def nonsense_filters(rng: Rng) -> int:
    """Post-process with arguments that may be nonsense."""
    disparity = some_map(rng)
    odd = NONSENSE[rng.integers(len(NONSENSE))]
    for content in (odd, bad_image(rng, disparity)):
        refused(lambda content=content: fill(content))
        refused(lambda content=content: median(content))
        refused(lambda content=content: remove_speckles(content, 3))
        refused(lambda content=content: single_matching_phase(content, disparity))
        refused(lambda content=content: single_matching_phase(disparity, content))
    refused(lambda: fill(disparity, odd))
    refused(lambda: fill(disparity, threads=odd))
    refused(lambda: median(disparity, odd))
    refused(lambda: remove_speckles(disparity, odd))
    refused(lambda: remove_speckles(disparity, 3, odd))
    refused(lambda: remove_speckles(disparity, 3, threads=odd))
    refused(lambda: single_matching_phase(disparity, disparity, threads=odd))
    refused(lambda: stereokit.warmup(odd))
    return 18


def several(rng: Rng) -> int:
    """Match several pairs with one matcher, at once and one by one."""
    options = options_of(rng)
    matcher = stereokit.Matcher(**options)
    pairs = [pair(rng, shape_of(rng)) for _ in range(3)]
    results = list(matcher.map(pairs))
    for (left, right), result in zip(pairs, results, strict=True):
        check_map(result, left.shape, options)
        check(same(result.disparity, matcher(left, right).disparity), "map differs from a call")
    return 6
