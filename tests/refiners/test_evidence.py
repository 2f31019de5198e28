"""The evidence refiner's kernels against plain loops, and what must hold for any weights."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from refining import tuned_to_kitti

import stereokit
from stereokit.errors import FileError, OptionError
from stereokit_refiners import weights
from stereokit_refiners.general import EvidenceRefiner
from stereokit_refiners.networks.evidence import CHANNELS, GAINS, LOGITS, STEPS, Evidence
from stereokit_refiners.networks.layers import shapes
from stereokit_refiners.runtimes.evidence import hypotheses
from stereokit_refiners.runtimes.features import network_input
from stereokit_refiners.runtimes.mixture import mixture
from stereokit_refiners.weights import WeightFile

ROWS, COLUMNS = 13, 37


def _case(step, seed=0, rows=ROWS, columns=COLUMNS, lowest=-3.0):
    rng = np.random.default_rng(seed)
    left, right = (rng.integers(0, 256, (rows, columns), dtype=np.uint8) for _ in range(2))
    size = -(-rows // step), -(-columns // step)
    disparity = (rng.random(size) * 9 + lowest).astype(np.float32)
    candidates = (rng.random((2, *size)) * 9 + lowest).astype(np.float32)
    confidence = rng.random(size).astype(np.float32)
    return disparity, candidates, confidence, left, right


def _at(image, y, x):
    return image[min(max(y, 0), len(image) - 1), min(max(x, 0), image.shape[1] - 1)]


def _grown(image, rows, columns):
    return np.array([[_at(image, y, x) for x in range(columns)] for y in range(rows)])


def _upscaled(coarse, step, y, x):
    """Bilinear, pixel centres kept, borders clamped."""
    v, u = (y + 0.5) / step - 0.5, (x + 0.5) / step - 0.5
    y0, x0 = math.floor(v), math.floor(u)
    a, b = v - y0, u - x0
    top = (1 - b) * _at(coarse, y0, x0) + b * _at(coarse, y0, x0 + 1)
    bottom = (1 - b) * _at(coarse, y0 + 1, x0) + b * _at(coarse, y0 + 1, x0 + 1)
    return (1 - a) * top + a * bottom


# The eight neighbours, and the eight that a knight of chess reaches.
NEIGHBOURS = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if i % 2 or j % 2]


def _bits(image):
    def smooth(y, x):
        weights = (1, 4, 1)
        return sum(weights[i] * weights[j] * int(_at(image, y + i - 1, x + j - 1)) for i in range(3) for j in range(3))

    # The image is extended first, then smoothed: a neighbour outside is a smoothed pixel of the extended image.
    height, width = image.shape
    wide = {(y, x): smooth(y, x) for y in range(-2, height + 2) for x in range(-2, width + 2)}
    return [[[wide[y + i, x + j] < wide[y, x] for i, j in NEIGHBOURS] for x in range(width)] for y in range(height)]


def _plain(step, disparity, candidates, left, right):
    """Return the coarse map, its means, the other values, the coarse map's cost and the gains, eighths of a bit."""
    rows, columns = left.shape
    height, width = (-(-n // 32) * 32 for n in (rows, columns))
    h, w = height // step, width // step
    fixed = [_grown(np.rint(m.astype(np.float64) * 256) / 256, h, w) * step for m in (disparity, *candidates)]
    near = fixed[0]
    coarse = np.array([[_upscaled(near, step, y, x) for x in range(width)] for y in range(height)])
    extremes = []
    for choose in (min, max):
        extremes.append(
            np.array(
                [
                    [choose(_at(near, y + i, x + j) for i in range(-3, 4) for j in range(-3, 4)) for x in range(w)]
                    for y in range(h)
                ]
            )
        )
    maps = [*extremes, *fixed[1:]]
    grid = [(y, x) for y in range(height // 2) for x in range(width // 2)]
    others = np.array([[[m[2 * y // step, 2 * x // step] for x in range(width // 2)] for y in range(height // 2)]
                       for m in maps])  # fmt: skip
    bits = [_bits(_grown(image, height, width)) for image in (left, right)]

    def distance(y, x, right_x):
        if not 0 <= right_x < columns:
            return 8
        return sum(a != b for a, b in zip(bits[0][y][x], bits[1][y][right_x], strict=True))

    def cost(y, x, value):
        eighths = math.floor(value * 8 + 0.5)
        whole, part = eighths // 8, eighths % 8
        return (8 - part) * distance(y, x, x - whole) + part * distance(y, x, x - whole - 1)

    apart = 2 if step == 4 else 1
    half, costs = np.zeros((height // 2, width // 2)), np.zeros((7, height // 2, width // 2))
    for y, x in grid:
        half[y, x] = coarse[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].mean()
        for i in (0, 1):
            b = coarse[2 * y + i, 2 * x + i]
            values = [b, b - apart, b + apart, *others[:, y, x]]
            costs[:, y, x] += [cost(2 * y + i, 2 * x + i, v) for v in values]
    gains = np.clip(np.floor((costs[:1] - costs[1:]) / 2), -127, 127)
    return coarse, half, others, np.floor(costs[0] / 2), gains


@pytest.mark.parametrize("step", [1, 2, 4])
def test_values_and_costs_are_those_of_plain_loops(step):
    disparity, candidates, _, left, right = _case(step)
    fields = hypotheses(disparity, candidates, left, right, step)
    coarse, half, others, cost, gains = _plain(step, disparity, candidates, left, right)
    np.testing.assert_array_equal(fields.coarse + fields.base, coarse)
    np.testing.assert_array_equal(fields.half + fields.base, half)
    np.testing.assert_array_equal(fields.others + fields.base, others)
    np.testing.assert_array_equal(fields.cost, cost)
    np.testing.assert_array_equal(fields.gains, gains)


def _plain_input(fields, confidence, left, columns):
    height, width = fields.coarse.shape
    step = fields.step
    image = _grown(left, height, width).astype(np.float64)
    sure = _grown(confidence, height // step, width // step)
    block = lambda plane, y, x, n: plane[n * y : n * y + n, n * x : n * x + n]  # noqa: E731
    quarter = height // 4, width // 4
    grid = [(y, x) for y in range(quarter[0]) for x in range(quarter[1])]
    half = np.array([[block(fields.coarse, y, x, 2).mean() for x in range(width // 2)] for y in range(height // 2)])
    means = {name: np.zeros(quarter) for name in ("grey", "square", "coarse")}
    for y, x in grid:
        means["grey"][y, x] = block(image, y, x, 4).mean()
        means["square"][y, x] = (block(image, y, x, 4) ** 2).mean()
        means["coarse"][y, x] = block(fields.coarse, y, x, 4).mean()

    def around(plane, y, x, reach):
        cells = range(-reach, reach + 1)
        return np.mean([_at(plane, y + i, x + j) for i in cells for j in cells])

    squash = lambda x, unit: 2 * x / (abs(x) + unit)  # noqa: E731
    reach = (columns + 1) // 2
    surface = np.zeros((5, *half.shape))
    outside = np.zeros(half.shape)
    for y in range(half.shape[0]):
        nearest = {}
        for x in range(half.shape[1]):
            target = math.floor((2 * x - fields.base - half[y, x]) / 2)
            outside[y, x] = not 0 <= target < reach
            for place in (target, target + 1):
                if 0 <= place < reach and x < reach:
                    nearest[place] = max(nearest.get(place, -1e9), half[y, x])
        for k in range(5):
            for x in range(half.shape[1]):
                value = half[y, x] if k == 0 else fields.others[k - 1, y, x]
                target = math.floor((2 * x - fields.base - value) / 2 + 0.5)
                surface[k, y, x] = nearest[target] - value if target in nearest else 0
    out = np.zeros((sum(CHANNELS.values()), *quarter))
    for y, x in grid:
        grey = around(means["grey"], y, x, 4)
        spread = math.sqrt(max(around(means["square"], y, x, 4) - grey**2, 0))
        levels = np.clip((block(image, y, x, 4) - grey) / (spread + 3), -3, 3)
        by_two = lambda f: [f(2 * y + i, 2 * x + j) for i in (0, 1) for j in (0, 1)]  # noqa: B023, E731
        column = [*levels.ravel()]
        column += by_two(lambda v, u: 4 * sure[2 * v // step, 2 * u // step] - 2)
        column += by_two(lambda v, u: squash(half[v, u] - around(means["coarse"], y, x, 8), 8))  # noqa: B023
        for k in range(4):
            column += by_two(lambda v, u: squash(fields.others[k, v, u] - half[v, u], 2))  # noqa: B023
        column += by_two(lambda v, u: fields.cost[v, u] / 32 - 1)
        for k in range(6):
            column += by_two(lambda v, u: fields.gains[k, v, u] / 40)  # noqa: B023
        for k in range(5):
            column += by_two(lambda v, u: squash(surface[k, v, u], 2))  # noqa: B023
        column += [block(outside, y, x, 2).mean(), {1: -1, 2: 0, 4: 1}[step]]
        out[:, y, x] = column
    return out * STEPS


@pytest.mark.parametrize("step", [1, 2, 4])
def test_the_networks_input_is_that_of_plain_loops(step):
    disparity, candidates, confidence, left, right = _case(step, seed=1)
    fields = hypotheses(disparity, candidates, left, right, step)
    options = network_input(fields, confidence, left, COLUMNS)
    assert options.dtype == np.int8
    wanted = _plain_input(fields, confidence, left, COLUMNS)
    assert np.abs(options - wanted).max() <= 1  # the cost is rounded down
    assert np.abs(np.delete(options - wanted, slice(40, 44), 0)).max() < 0.51


def _head(rng, fields, scale=2.0):
    height, width = fields.coarse.shape
    return (rng.normal(size=(height // 4, width // 4, LOGITS + GAINS + 4)) * scale).astype(np.float32)


def _plain_mixture(head, fields, y, x):
    cell, part = head[y // 4, x // 4].astype(np.float64), 2 * (y % 4 // 2) + x % 4 // 2
    v, u = y // 2, x // 2
    b = float(fields.coarse[y, x])
    values = [b, b - fields.apart, b + fields.apart, *(float(fields.others[k, v, u]) for k in range(4))]
    weights = [1.0]
    for k in range(6):
        logit = cell[4 * k + part]
        for n, reach in enumerate((1, 3)):
            cells = range(-reach, reach + 1)
            mean = np.mean([float(_at(fields.gains[k], v + i, u + j)) for i in cells for j in cells])
            logit += cell[LOGITS + 2 * n + (k >= 2)] * mean / 16
        weights.append(math.exp(min(max(logit, -40), 40)))
    sure = cell[LOGITS + GAINS + part]
    return fields.base + np.dot(weights, values) / sum(weights), 1 / (1 + math.exp(-sure))


def test_the_mixture_is_that_of_plain_loops():
    disparity, candidates, _, left, right = _case(2, seed=2)
    fields = hypotheses(disparity, candidates, left, right, 2)
    head = _head(np.random.default_rng(3), fields, 0.7)
    full, sure = mixture(head, fields, ROWS, COLUMNS)
    for y in range(ROWS):
        for x in range(COLUMNS):
            assert (full[y, x], sure[y, x]) == pytest.approx(_plain_mixture(head, fields, y, x), abs=2e-4)


def test_a_head_that_refuses_all_others_leaves_the_upscaled_map():
    disparity, candidates, _, left, right = _case(2, seed=4)
    fields = hypotheses(disparity, candidates, left, right, 2)
    head = np.zeros_like(_head(np.random.default_rng(0), fields))
    head[..., :LOGITS] = -40
    full, _ = mixture(head, fields, ROWS, COLUMNS)
    np.testing.assert_allclose(full, (fields.coarse + fields.base)[:ROWS, :COLUMNS], atol=1e-6)


@pytest.mark.parametrize("step", [1, 2, 4])
def test_threads_change_nothing(step):
    disparity, candidates, confidence, left, right = _case(step, seed=5, rows=70, columns=90)
    one, three = (hypotheses(disparity, candidates, left, right, step, threads) for threads in (1, 3))
    for name in ("coarse", "half", "others", "cost", "gains"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
    inputs = [network_input(one, confidence, left, 90, threads) for threads in (1, 3)]
    np.testing.assert_array_equal(*inputs)
    head = _head(np.random.default_rng(6), one)
    for a, b in zip(*(mixture(head, one, 70, 90, threads) for threads in (1, 3)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("by", [8, -8, 200, 1000])
def test_a_constant_added_to_all_disparities_changes_no_bit_of_the_input(by):
    """The right view slides by as much; only what then leaves or enters it may differ."""
    rng = np.random.default_rng(7)
    rows, columns, margin = 40, 1600, 1100
    left = rng.integers(0, 256, (rows, columns), dtype=np.uint8)
    row = rng.integers(0, 256, (rows, columns + 2 * margin), dtype=np.uint8)
    slid = [np.ascontiguousarray(row[:, margin + s : margin + s + columns]) for s in (0, by)]
    size = rows // 2, columns // 2
    disparity = rng.integers(0, 20 * 256, size).astype(np.float32) / 256  # what is kept of a map
    candidates = rng.integers(0, 20 * 256, (2, *size)).astype(np.float32) / 256
    confidence = rng.random(size).astype(np.float32)
    fields = [
        hypotheses(disparity + np.float32(s / 2), candidates + np.float32(s / 2), left, right, 2)
        for s, right in zip((0, by), slid, strict=True)
    ]
    assert fields[1].base - fields[0].base == by
    np.testing.assert_array_equal(fields[0].coarse, fields[1].coarse)
    inputs = [network_input(f, confidence, left, columns) for f in fields]
    inner = slice((max(by, 0) + 64) // 4, (columns - 64 + min(by, 0)) // 4)
    np.testing.assert_array_equal(inputs[0][:, :, inner], inputs[1][:, :, inner])
    head = _head(rng, fields[0])
    columns_in = slice(4 * inner.start + 8, 4 * inner.stop - 8)
    maps = [mixture(head, f, rows, columns)[0][:, columns_in] for f in fields]
    np.testing.assert_allclose(maps[0] + np.float32(by), maps[1], atol=2e-4)


def _weights(seed=0, scale=0.3):
    rng = np.random.default_rng(seed)
    arrays = {
        name: (rng.normal(size=shape) * scale / max(1, math.prod(shape[1:])) ** 0.5).astype(np.float32)
        for name, shape in shapes(Evidence()).items()
    }
    return WeightFile("evidence", "residual", arrays)


def _refiner(backend="auto"):
    pytest.importorskip({"openvino": "openvino", "onnxruntime": "onnxruntime", "torch": "torch"}.get(backend, "numpy"))
    return EvidenceRefiner.of(_weights(), backend=backend, precision="fp32")


@pytest.mark.parametrize("backend", ["openvino", "onnxruntime", "opencv"])
def test_runtimes_agree_with_torch(backend):
    disparity, candidates, confidence, left, right = _case(2, seed=8, rows=61, columns=75)
    coarse = stereokit.Disparity(disparity, np.ones(disparity.shape, bool), confidence, candidates=candidates)
    maps = [_refiner(name)(coarse, left, right=right).disparity for name in ("torch", backend)]
    np.testing.assert_allclose(*maps, atol=1e-3)


@pytest.mark.parametrize("scale", [1, 0.5, 0.25])
@pytest.mark.parametrize(("low", "high"), [(0, 32), (-7, 9), (-33, -1), (5, 64)])
def test_maps_stay_inside_the_range_at_any_scale(scale, low, high):
    blank = np.full((35, 50), 90, np.uint8)
    rng = np.random.default_rng(9)
    noise = rng.integers(0, 256, (2, 35, 50), dtype=np.uint8)
    refiner = _refiner()
    matcher = stereokit.Matcher(
        "S2", min_disparity=low, max_disparity=high, scale=scale, refiner=refiner, device="cpu", confidence=True
    )
    for left, right in ((blank, blank), noise):
        fields = matcher(left, right)
        assert fields.disparity.shape == (35, 50)
        assert np.isfinite(fields.disparity).all()
        assert fields.disparity.min() >= low
        assert fields.disparity.max() <= high - 1
        assert fields.confidence is not None
        assert 0 <= fields.confidence.min() <= fields.confidence.max() <= 1


@pytest.mark.parametrize("scale", [0.5, 0.25])
@pytest.mark.parametrize("low", [-7, 5])
def test_linear_maps_of_odd_ranges_stay_inside_too(scale, low):
    noise = np.random.default_rng(10).integers(0, 256, (2, 35, 50), dtype=np.uint8)
    fields = stereokit.match(*noise, "S2", min_disparity=low, max_disparity=low + 14, scale=scale, device="cpu")
    assert low <= fields.min()
    assert fields.max() <= low + 13


def test_gaps_stay_gaps_and_neighbours_are_as_if_filled():
    noise = np.random.default_rng(11).integers(0, 256, (2, 40, 60), dtype=np.uint8)
    fields = stereokit.Matcher("S2", max_disparity=32, scale=0.5, refiner=_refiner(), fill=None, device="cpu")(*noise)
    gaps = np.isnan(fields.disparity)
    assert gaps.any()
    assert not gaps.all()
    assert not fields.valid[gaps].any()


def test_grey_level_and_gain_change_little():
    """Census costs do not change at all under gain and offset; grey levels are normalised by their surroundings."""
    disparity, candidates, confidence, left, right = _case(2, seed=12, rows=64, columns=96)
    dark = [(image // 2 + 10).astype(np.uint8) for image in (left, right)]
    doubled = [((image - 10) * 2).astype(np.uint8) for image in dark]
    fields = [hypotheses(disparity, candidates, *pair, 2) for pair in (dark, doubled)]
    np.testing.assert_array_equal(fields[0].gains, fields[1].gains)
    inputs = [network_input(f, confidence, pair[0], 96) for f, pair in zip(fields, (dark, doubled), strict=True)]
    grey = slice(0, CHANNELS["grey"])
    assert np.abs(inputs[0][grey].astype(int) - inputs[1][grey]).max() < 0.15 * STEPS
    np.testing.assert_array_equal(inputs[0][16:], inputs[1][16:])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": 0.25}, "coarse map must be a quarter of the size of left"),
        ({"right": np.zeros((5, 5), np.uint8)}, "right must have the size of left"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    disparity, candidates, confidence, left, right = _case(2, seed=13)
    coarse = stereokit.Disparity(disparity, np.ones(disparity.shape, bool), confidence, candidates=candidates)
    with pytest.raises(OptionError, match=message):
        _refiner()(coarse, left, **{"right": right, **change})


def test_other_networks_refuse_other_scales():
    tuned_to_kitti("stereovae")
    with pytest.raises(OptionError, match=r"refiner 'stereovae' needs scale=0.5, got scale=0.25"):
        stereokit.Matcher("S2", scale=0.25, refiner="stereovae", weights="kitti", device="cpu")


def _scene():
    """Return a wall with a square of many pixels before it, both views and the truth."""
    rng = np.random.default_rng(14)
    rows, columns = 128, 256
    wall, square = (
        cv2.GaussianBlur(rng.integers(0, 256, (rows, columns + 64), dtype=np.uint8), (0, 0), 1.2) for _ in range(2)
    )
    left, right = wall[:, :columns].copy(), wall[:, 6 : columns + 6].copy()
    left[40:90, 90:150] = square[40:90, 90:150]
    right[40:90, 75:135] = square[40:90, 90:150]
    truth = np.full((rows, columns), 6, np.float32)
    truth[40:90, 90:150] = 15
    return left, right, truth


@pytest.mark.parametrize("scale", [1, 0.5, 0.25])
def test_shipped_weights_sharpen_edges_and_keep_what_is_right(scale):
    left, right, truth = _scene()
    options = {"max_disparity": 32, "scale": scale, "device": "cpu"}
    plain, general = (stereokit.match(left, right, "S2", refiner=r, **options) for r in ("linear", "general"))
    wrong = [float((np.abs(fields - truth)[:, 20:] > 1).mean()) for fields in (plain, general)]
    assert wrong[1] <= wrong[0]
    if scale < 1:
        assert wrong[1] < 0.7 * wrong[0]
    assert abs(float(np.median(general - truth))) < (0.05 if scale > 0.25 else 0.15)


def _plane(first, slope):
    """Return both views of a textured plane whose disparities are ``first + slope * x``, and these."""
    rng = np.random.default_rng(15)
    rows, columns, margin = 96, 320, 120
    noise = rng.integers(0, 256, (rows, columns + 2 * margin)).astype(np.float32)
    texture = np.clip((cv2.GaussianBlur(noise, (0, 0), 1.3) - 128) * 3 + 128, 0, 255)
    y, x = np.indices((rows, columns), np.float32)
    truth = np.float32(first) + np.float32(slope) * x
    left = cv2.remap(texture, x - truth + margin, y, cv2.INTER_CUBIC)
    pair = (np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in (left, texture[:, margin : margin + columns]))
    return *pair, truth


@pytest.mark.parametrize(("first", "slope"), [(2.3, 0), (7.6, 0), (20.25, 0.02), (60.7, -0.1)])
@pytest.mark.parametrize(("scale", "most"), [(1, 0.05), (0.5, 0.05), (0.25, 0.09)])
def test_shipped_weights_have_no_bias_on_planes(scale, most, first, slope):
    left, right, truth = _plane(first, slope)
    refined = stereokit.match(left, right, "S2", max_disparity=96, scale=scale, refiner="general", device="cpu")
    seen = np.arange(truth.shape[1]) >= truth
    assert abs(float(np.median((refined - truth)[seen]))) < most


def test_shipped_weights_follow_an_offset_of_all_disparities():
    left, right, truth = _scene()
    by = 200
    wide = [np.pad(image, ((0, 0), (by, 0)), mode="edge") for image in (left, right)]
    wide[1] = np.roll(wide[1], -by, axis=1)
    options = {"scale": 0.5, "refiner": "general", "device": "cpu"}
    near = stereokit.match(*wide, "S2", min_disparity=by, max_disparity=by + 32, **options)[:, by:] - by
    plain = stereokit.match(left, right, "S2", max_disparity=32, **options)
    medians = [float(np.median((fields - truth)[:, 40:])) for fields in (near, plain)]
    assert medians[0] == pytest.approx(medians[1], abs=0.02)
    assert np.abs(near - plain)[:, 64:].mean() < 0.05


@pytest.mark.parametrize("backend", ["openvino", "onnxruntime", "opencv"])
def test_weights_tuned_to_kitti_run_alike_everywhere(backend):
    tuned_to_kitti("evidence")
    for name in {backend, "torch"} - {"opencv"}:
        pytest.importorskip(name)
    disparity, candidates, confidence, left, right = _case(2, seed=5, rows=61, columns=75)
    coarse = stereokit.Disparity(disparity, np.ones(disparity.shape, bool), confidence, candidates=candidates)
    maps = [
        EvidenceRefiner(weights="kitti", backend=name, precision="fp32")(coarse, left, right=right).disparity
        for name in ("torch", backend)
    ]
    np.testing.assert_allclose(*maps, atol=2e-3)
    assert np.abs(maps[0] - EvidenceRefiner(precision="fp32")(coarse, left, right=right).disparity).max() > 0.1


@pytest.mark.parametrize("scale", [1, 0.5, 0.25])
def test_weights_tuned_to_kitti_serve_all_scales(scale):
    tuned_to_kitti("evidence")
    left, right, truth = _scene()
    options = {"max_disparity": 32, "scale": scale, "device": "cpu"}
    maps = [
        stereokit.match(left, right, "S2", **options, refiner=refiner, **tuned)
        for refiner, tuned in (("linear", {}), ("stereokit", {"weights": "kitti"}))
    ]
    wrong = [float((np.abs(fields - truth)[:, 20:] > 3).mean()) for fields in maps]
    assert wrong[1] <= wrong[0] + 0.005


def test_weights_tuned_to_kitti_are_not_there_without_their_package(monkeypatch):
    monkeypatch.setattr(weights, "entry_points", lambda group: ())
    image = np.zeros((32, 48), np.uint8)
    with pytest.raises(
        FileError, match=r"^weights 'kitti' are a package of their own, .* pip install \./refiners/kitti"
    ):
        stereokit.match(image, image, "S2", scale=0.5, refiner="stereokit", weights="kitti")
