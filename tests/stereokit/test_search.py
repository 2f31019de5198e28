"""Coarse to fine: the narrow search against loops, where it looks, and what it must not lose."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace

import cv2
import numpy as np
import oracles
import pytest
from typer.testing import CliRunner

import stereokit
from stereokit import Census, Matcher
from stereokit.aggregation.sgm import Sgm
from stereokit.cli import app
from stereokit.costs.rows import UNEXPECTED, CostInput, Levels, Search, produce_volume
from stereokit.errors import DeviceError, OptionError, UnknownNameError
from stereokit.images.gray import GrayPair
from stereokit.images.resize import half_size
from stereokit.kernels.simd import LANES
from stereokit.kernels.workspace import Workspace
from stereokit.result import Disparity
from stereokit.search import halved_levels, plan_search, restore_thin
from stereokit.selection.wta import selection_output

PAIR = Census("5x5")


def textured(height, width, shift, seed=0):
    """Return a pair of smooth noise whose right view is shifted."""
    rng = np.random.default_rng(seed)
    wide = cv2.GaussianBlur(rng.integers(0, 256, (height, width + shift), dtype=np.uint8), (0, 0), 1)
    wide = cv2.normalize(wide, None, 0, 255, cv2.NORM_MINMAX)
    return np.ascontiguousarray(wide[:, :width]), np.ascontiguousarray(wide[:, shift:])


def open_search(starts):
    """Return a search in which all levels are expected."""
    return Search(starts, np.zeros(starts.shape, np.uint8), np.full(starts.shape, LANES - 1, np.uint8))


def narrow(left, right, search, levels, paths=4, threads=1, bad=(None, None), border=0.5, p1=3.0, p2=17.0):
    """Return disparity, cost, confidence and both candidates of a narrow search."""
    search = search if isinstance(search, Search) else open_search(search)
    starts = search.starts
    workspace = Workspace()
    pair = CostInput(left, right, *bad, levels, border, threads, None, starts)
    stage = Sgm(p1=p1, p2=p2, paths=paths, edge_factor=1.0)
    shape = left.shape
    disparity, confidence = np.empty(shape, np.float32), np.empty(shape, np.float32)
    cost, candidates = np.empty(shape, np.uint16), np.empty((2, *shape), np.float32)
    out = selection_output(disparity, cost, confidence, LANES, levels.minimum, True, 0, candidates, starts)
    stage.sweep(PAIR.prepare(pair, workspace, 2), levels, PAIR, left, workspace, threads, out, search=search)
    return disparity, cost, confidence, candidates


def volume_of(left, right, levels, border=0.5, bad=(None, None)):
    """Return the census costs of all levels, those without evidence at the border's cost."""
    volume = oracles.census(left, right, levels.minimum, levels.count, 5, 5, border)
    worst = round(border * PAIR.cost_max)
    width = left.shape[1]
    for y, x, k in np.ndindex(volume.shape):
        column = x - k - levels.minimum
        outside = bad[1] is not None and 0 <= column < width and bad[1][y, column]
        if outside or (bad[0] is not None and bad[0][y, x]):
            volume[y, x, k] = worst
    return volume


def expected(left, right, search, levels, paths, bad=(None, None), p1=3, p2=17):
    """Return disparity and cost, by loops."""
    search = search if isinstance(search, Search) else open_search(search)
    starts = search.starts
    volume = volume_of(left, right, levels, bad=bad)
    for y, x, k in np.ndindex(volume.shape):
        if not search.low[y, x] <= k - starts[y, x] <= search.high[y, x]:
            volume[y, x, k] += UNEXPECTED
    total = oracles.narrow_sgm(volume, starts, LANES, p1, p2, oracles.DIRECTIONS[paths])
    own = np.stack([[t[s : s + LANES] for t, s in zip(*row, strict=True)] for row in zip(total, starts, strict=True)])
    disparity, cost, _ = oracles.select(own, levels.minimum)
    return disparity + starts, cost


@pytest.mark.parametrize("paths", [4, 5, 8])
@pytest.mark.parametrize(("height", "width"), [(7, 9), (1, 12), (8, 1), (2, 2), (1, 1), (6, 40)])
def test_narrow_paths_are_those_of_loops(random_pair, paths, height, width):
    left, right = random_pair(height, width, seed=height + paths)
    levels = Levels(-3, 150)
    rng = np.random.default_rng(paths)
    starts = rng.choice([0, 1, 7, 8, 40, 86], (height, width)).astype(np.int16)  # less than, just, and beyond a search
    disparity, cost, *_ = narrow(left, right, starts, levels, paths)
    wanted, wanted_cost = expected(left, right, starts, levels, paths)
    np.testing.assert_array_equal(cost, wanted_cost)
    np.testing.assert_allclose(disparity, wanted, atol=1e-5)


def test_unexpected_levels_cost_more(random_pair):
    left, right = random_pair(6, 20, seed=3)
    levels, rng = Levels(0, 130), np.random.default_rng(5)
    ends = np.sort(rng.integers(0, LANES, (2, 6, 20)), axis=0).astype(np.uint8)
    ends[:, 0] = [[0], [LANES - 1]]  # all of them
    ends[:, 1], ends[:, 2] = 0, LANES - 1  # one level at either end
    search = Search(rng.choice([0, 8, 66], (6, 20)).astype(np.int16), *ends)
    disparity, cost, *_ = narrow(left, right, search, levels)
    wanted, wanted_cost = expected(left, right, search, levels, 4)
    np.testing.assert_array_equal(cost, wanted_cost)
    np.testing.assert_allclose(disparity, wanted, atol=1e-5)


def test_narrow_paths_of_like_starts_are_those_of_a_full_search(random_pair):
    left, right = random_pair(9, 30, seed=4)
    levels = Levels(5, LANES)
    starts = np.zeros(left.shape, np.int16)
    disparity, cost, confidence, candidates = narrow(left, right, starts, levels)
    volume = stereokit.cost_volume(
        left, right, "census", window="5x5", border_cost=0.5, min_disparity=5, max_disparity=5 + LANES
    )
    total = stereokit.aggregate(volume, left, "sgm", cost=PAIR, p1=3.0, p2=17.0, edge_factor=1.0)
    whole = stereokit.select(total, min_disparity=5)
    for mine, other in zip((disparity, cost, confidence), whole, strict=True):
        np.testing.assert_array_equal(mine, other)
    np.testing.assert_array_equal(candidates[0], disparity)


def test_a_rival_is_given_in_pixels(random_pair):
    left, right = random_pair(4, 20, seed=9)
    starts = np.full(left.shape, 30, np.int16)
    disparity, _, _, candidates = narrow(left, right, starts, Levels(-2, 120))
    assert candidates[1].min() >= 28 and candidates[1].max() < 28 + LANES
    assert (abs(candidates[1] - np.rint(disparity)) > 1).all()


def test_pixels_without_evidence_have_the_cost_of_the_border(random_pair):
    left, right = random_pair(6, 50, seed=2)
    rng = np.random.default_rng(0)
    bad = rng.random(left.shape) < 0.1, rng.random(left.shape) < 0.1
    levels = Levels(-40, 130)
    starts = rng.choice([0, 8, 32, 66], left.shape).astype(np.int16)
    disparity, cost, *_ = narrow(left, right, starts, levels, bad=bad)
    wanted, wanted_cost = expected(left, right, starts, levels, 4, bad)
    np.testing.assert_array_equal(cost, wanted_cost)
    np.testing.assert_allclose(disparity, wanted, atol=1e-5)


@pytest.mark.parametrize(("window", "steps"), [(3, 31), (5, 31), (7, 200)])
def test_narrow_rows_of_zncc_are_parts_of_whole_ones(random_pair, window, steps):
    left, noise = random_pair(11, 60, seed=window)
    right = np.roll(left, -9, axis=1) // 2 + noise // 8
    levels, cost = Levels(-5, 150), stereokit.Zncc(window, steps)
    starts = np.random.default_rng(1).choice([0, 8, 40, 86], (11, 10)).repeat(6, axis=1).astype(np.int16)
    pair = CostInput(left, right, None, None, levels, 0.5)
    whole = produce_volume(cost.prepare(pair, Workspace(), 1), left.shape, levels, 1)
    rows = cost.prepare(replace(pair, starts=starts), Workspace(), 1)
    narrow_volume = produce_volume(rows, left.shape, Levels(0, LANES), 1)
    wanted = np.take_along_axis(whole, starts[..., None].astype(np.int64) + np.arange(LANES), axis=2)
    np.testing.assert_array_equal(narrow_volume, wanted)


@pytest.mark.parametrize("paths", [4, 5, 8])
def test_largest_costs_and_penalties_do_not_overflow(paths):
    left = np.zeros((6, 70), np.uint8)
    right = (np.indices(left.shape).sum(axis=0) % 2 * 255).astype(np.uint8)
    levels = Levels(0, 140)
    starts = (np.indices(left.shape)[1] % 3 * 30).astype(np.int16)
    p2 = 255.0 - PAIR.cost_max
    search = Search(starts, np.full(left.shape, 5, np.uint8), np.full(left.shape, 9, np.uint8))
    disparity, cost, *_ = narrow(left, right, search, levels, paths, p1=p2, p2=p2)
    most = int(p2) - UNEXPECTED  # what is left of 8 bits
    wanted, wanted_cost = expected(left, right, search, levels, paths, p1=most, p2=most)
    np.testing.assert_array_equal(cost, wanted_cost)
    np.testing.assert_allclose(disparity, wanted, atol=1e-5)


def planned(coarse, levels, height, width, measured=None):
    """Return the search for a half-size map."""
    search = Search(*(np.full((height, width), 77, dtype) for dtype in (np.int16, np.uint8, np.uint8)))
    measured = np.ones(coarse.shape, bool) if measured is None else measured
    plan_search(coarse.astype(np.float32), measured, levels, search)
    return search


def test_searches_hold_what_the_half_size_map_has_around_a_pixel():
    rng = np.random.default_rng(3)
    levels = Levels(-6, 200)
    coarse = rng.random((9, 14)) * 20 + 30
    starts = planned(coarse, levels, 17, 28).starts
    assert (starts >= 0).all() and (starts <= levels.count - LANES).all()
    for y, x in np.ndindex(starts.shape):
        around = coarse[max(y // 2 - 4, 0) : y // 2 + 5, max(x // 2 - 4, 0) : x // 2 + 5]
        assert starts[y, x] - 6 <= 2 * around.min() and 2 * around.max() + 1 < starts[y, x] - 6 + LANES


def test_searches_keep_to_the_pixels_own_value_where_both_do_not_fit():
    coarse = np.full((6, 40), 20.0)
    coarse[:, 20:] = 200
    starts = planned(coarse, Levels(0, 500), 12, 80).starts
    own = 2 * np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)
    assert (starts <= own - 5).all() and (own + 6 < starts + LANES).all()


@pytest.mark.parametrize("value", [-50, 0, 1000])
def test_searches_stay_within_the_range(value):
    search = planned(np.full((3, 4), value, float), Levels(-4, 90), 5, 7)
    assert search.starts.min() >= 0 and search.starts.max() <= 90 - LANES
    assert (search.low <= search.high).all() and search.high.max() < LANES


def test_flat_and_measured_pixels_expect_their_levels():
    rng = np.random.default_rng(8)
    levels, minimum = Levels(-6, 200), -6
    coarse = 40 + 0.3 * rng.random((9, 14))
    coarse[:, 9:] += 8  # a jump
    measured = rng.random(coarse.shape) < 0.7
    search = planned(coarse, levels, 17, 27, measured)
    for y, x in np.ndindex(17, 27):
        y2, x2 = y // 2, x // 2
        around = coarse.astype(np.float32)[max(y2 - 1, 0) : y2 + 2, max(x2 - 1, 0) : x2 + 2]
        wanted = 0, LANES - 1
        if measured[y2, x2] and around.max() - around.min() <= 0.5:
            first = minimum + search.starts[y, x]
            wanted = np.floor(2 * around.min() - 0.5) - first, np.ceil(2 * around.max() + 1.5) - first
        assert (search.low[y, x], search.high[y, x]) == wanted


@pytest.mark.parametrize(("minimum", "count"), [(0, 128), (-3, 130), (5, 67), (-129, 129), (7, 1)])
def test_halved_levels_hold_half_of_every_level(minimum, count):
    half = halved_levels(Levels(minimum, count))
    for level in range(minimum, minimum + count):
        assert half.minimum <= level / 2 <= half.minimum + half.count - 0.5


def test_thin_things_come_back_into_a_cleaned_map():
    cleaned = np.full((9, 9), 10, np.float32)
    selected = cleaned.copy()
    selected[:, 4] = 40  # a pole
    selected[2, 7] = 40  # noise: nobody confirms it
    selected[5, 1:3] = np.nan
    selected[7, 0] = 2  # lies behind
    restore_thin(selected, cleaned)
    wanted = np.full((9, 9), 10, np.float32)
    # Two neighbours, above and below, confirm a line one pixel wide: too few.
    np.testing.assert_array_equal(cleaned, wanted)
    selected[:, 5] = 40.5
    restore_thin(selected, cleaned)
    wanted[:, 4], wanted[:, 5] = 40, 40.5
    np.testing.assert_array_equal(cleaned, wanted)


@pytest.mark.parametrize("threads", [2, 3, 5, 8, 16])
def test_the_map_does_not_depend_on_the_threads(threads):
    left, right = textured(61, 301, 150)
    one = Matcher("S2", max_disparity=300, threads=1, confidence=True)(left, right)
    many = Matcher("S2", max_disparity=300, threads=threads, confidence=True)(left, right)
    for name in ("disparity", "valid", "confidence"):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))


@pytest.mark.parametrize(
    ("minimum", "maximum", "shift"), [(0, 129, 100), (0, 512, 257), (-100, 200, 77), (33, 290, 201)]
)
def test_a_shift_is_found_wherever_it_lies(minimum, maximum, shift):
    left, right = textured(64, 640, shift)
    for method in ("S2", "S4"):
        result = Matcher(method, min_disparity=minimum, max_disparity=maximum, search="coarse-to-fine")(left, right)
        inner = result.disparity[:, shift + 8 :]
        assert (abs(inner - shift) < 0.5).mean() > 0.995
        assert result.disparity.min() >= minimum and result.disparity.max() < maximum


@pytest.mark.parametrize("shape", [(1, 300), (2, 2), (3, 200), (40, 1), (1, 1), (33, 45)])
def test_small_images_of_a_large_range(shape, random_pair):
    left, right = random_pair(*shape)
    result = Matcher("S2", max_disparity=400, search="coarse-to-fine")(left, right)
    assert result.disparity.shape == shape
    assert np.isfinite(result.disparity).all()
    assert result.disparity.min() >= 0 and result.disparity.max() < 400


@pytest.mark.parametrize("kind", ["blank", "nan", "deep", "strided"])
def test_images_of_all_kinds(kind):
    left, right = textured(60, 400, 140)
    if kind == "blank":
        left, right = np.full_like(left, 9), np.full_like(right, 9)
    elif kind == "nan":
        left, right = left.astype(np.float32), right.astype(np.float32)
        left[:, 200:210], right[20:24] = np.nan, np.nan
    elif kind == "deep":
        left, right = left.astype(np.uint16) * 200, right.astype(np.uint16) * 200
    else:
        left, right = np.repeat(left, 2, axis=1)[:, ::2], np.repeat(right, 2, axis=0)[::2]
    with pytest.warns(stereokit.StereokitWarning) if kind == "blank" else nullcontext():
        result = Matcher("S2", max_disparity=256)(left, right)
    if kind == "blank":
        assert not result.valid.any()
    else:
        seen = result.valid[:, 148:]
        assert seen.mean() > 0.8
        assert (abs(result.disparity[:, 148:][seen] - 140) < 1).mean() > 0.99
    if kind == "nan":
        assert np.isnan(result.disparity[:, 200:210]).all()


def test_many_bad_pixels_do_not_blind_the_half_size_map():
    """One pixel in four is bad: so are two thirds of the 2x2, and nearly all of the 4x4."""
    left, right = textured(120, 400, 140)
    usable = np.random.default_rng(2).random((2, *left.shape)) > 0.25
    shares = []
    for search in ("full", "coarse-to-fine"):
        result = Matcher("S2", max_disparity=256, search=search)(left, right, mask=usable[0], right_mask=usable[1])
        right_ones = abs(result.disparity[:, 148:][usable[0][:, 148:]] - 140) < 1
        shares.append(right_ones.mean())
    assert shares[0] > 0.9 and shares[1] > 0.98 * shares[0], shares


@pytest.mark.parametrize("shape", [(4, 6), (5, 7), (1, 1), (1, 4), (3, 1)])
def test_half_size_pixels_are_bad_if_one_is_or_all_are(shape):
    rng = np.random.default_rng(shape[0])
    image, bad = rng.integers(0, 256, shape, np.uint8), rng.random(shape) < 0.6
    pair = GrayPair(image, image, bad, ~bad, image)
    for tolerant, rule in ((False, any), (True, all)):
        half = half_size(pair, tolerant=tolerant)
        for mine, whole in ((half.left_bad, bad), (half.right_bad, ~bad)):
            assert mine.shape == half.left.shape
            for y, x in np.ndindex(mine.shape):
                assert mine[y, x] == rule(whole[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].ravel())


def test_poles_in_front_of_a_far_wall_are_not_lost():
    rng = np.random.default_rng(1)
    height, width, wall = 120, 640, 20

    def texture(columns):
        noise = cv2.GaussianBlur(rng.integers(0, 256, (height, columns)).astype(np.float32), (0, 0), 1)
        return cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)

    base = texture(width + wall)
    for gap, side, share in ((20, 6, 0.9), (40, 6, 0.9), (80, 8, 0.8), (80, 12, 0.9)):
        left, right = base[:, :width].copy(), base[:, wall:].copy()
        pole = np.zeros(left.shape, bool)
        for x in range(240, width - 40, 100):
            surface = texture(side)
            left[:, x : x + side] = surface
            right[:, x - wall - gap : x - wall - gap + side] = surface
            pole[:, x : x + side] = True
        shares = []
        for search in ("full", "coarse-to-fine"):
            disparity = stereokit.match(left, right, max_disparity=256, search=search)
            shares.append((abs(disparity[pole] - wall - gap) < 1.5).mean())
        assert shares[1] >= share * shares[0] > 0.5 * share, (gap, side, shares)


def test_auto_searches_in_full_up_to_64_levels():
    assert not Matcher("S2", max_disparity=64).settings.coarse_to_fine
    assert Matcher("S2", max_disparity=65).settings.coarse_to_fine
    assert Matcher("S2", max_disparity=64, refiner="auto").settings.coarse_to_fine  # for accuracy
    assert not Matcher("S2", max_disparity=63, refiner="auto").settings.coarse_to_fine
    assert not Matcher("S2", max_disparity=512, scale=0.5).settings.coarse_to_fine
    assert Matcher("S2", max_disparity=512, scale=0.5, search="coarse-to-fine").settings.coarse_to_fine
    assert not Matcher("S1", max_disparity=512).settings.coarse_to_fine
    assert not Matcher("S4", max_disparity=512).settings.coarse_to_fine
    assert Matcher("S4", max_disparity=512, search="coarse-to-fine").settings.coarse_to_fine
    assert Matcher("S2", max_disparity=65).identity()["search"] == "coarse-to-fine"
    assert Matcher("S2", max_disparity=64).identity()["search"] == "full"


def test_ranges_below_64_levels_are_searched_in_full(random_pair):
    left, right = random_pair(20, 200)
    full, matcher = Matcher("S2", max_disparity=63), Matcher("S2", max_disparity=63, search="coarse-to-fine")
    np.testing.assert_array_equal(full(left, right).disparity, matcher(left, right).disparity)
    assert full.identity() == matcher.identity()
    half = Matcher("S2", max_disparity=126, search="coarse-to-fine", scale=0.5)
    assert half.identity()["search"] == "full"
    assert half.replaced(scale=1.0, refiner=None, refiner_name=None).identity()["search"] == "coarse-to-fine"


def test_weak_texture_follows_the_half_size_map():
    rng = np.random.default_rng(6)
    left, right = textured(120, 300, 30)
    left, right = (120 + image // 64 + rng.integers(0, 5, image.shape).astype(np.uint8) for image in (left, right))
    errors = []
    for search in ("full", "coarse-to-fine"):
        disparity = stereokit.match(left, right, max_disparity=96, search=search)
        errors.append((abs(disparity[:, 40:] - 30) > 1).mean())
    assert errors[1] < 0.75 * errors[0] < 0.2


def test_memory_does_not_grow_with_the_range():
    nbytes = [Matcher("S2", max_disparity=count).nbytes(600, 800) for count in (256, 512, 1024)]
    assert nbytes[2] < 1.35 * nbytes[0]
    assert nbytes[0] < 0.5 * Matcher("S2", max_disparity=256, search="full").nbytes(600, 800)


def test_what_cannot_search_so_says_so():
    with pytest.raises(OptionError, match="search must be 'full' or 'auto' with method 'census\\+dt', got 'coarse"):
        Matcher("S1", search="coarse-to-fine")
    with pytest.raises(UnknownNameError, match="search"):
        Matcher("S2", search="coarse")
    with pytest.raises(UnknownNameError, match="search"):
        Matcher("S2", search=None)


def test_classes_that_inherit_search_in_full():
    class Other(Census):
        pass

    settings = Matcher("S2", max_disparity=256).settings
    assert settings.coarse_to_fine
    assert not settings.replaced(cost=Other("5x5")).coarse_to_fine


def test_the_gpu_searches_in_full():
    from stereokit import matching

    settings = Matcher("S2", max_disparity=256).settings
    assert matching._pipeline(settings, "cuda").settings.search == "full"
    with pytest.raises(DeviceError, match="search must be 'full' or 'auto' with device 'cuda', got 'coarse-to-fine'"):
        matching._pipeline(settings.replaced(search="coarse-to-fine"), "cuda")
    with pytest.raises(DeviceError, match="coarse-to-fine"):
        matching._pipeline(settings, "cuda").replaced(search="coarse-to-fine")
    assert matching._pipeline(settings, "cuda").replaced(search="auto").settings.identity()["search"] == "full"


def test_the_command_line_takes_it(tmp_path):
    left, right = textured(40, 300, 30)
    for name, image in (("left", left), ("right", right)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    base = ["match", str(tmp_path / "left.png"), str(tmp_path / "right.png"), "-o", str(tmp_path / "d.pfm")]
    done = CliRunner().invoke(app.app, [*base, "--set", "search=coarse-to-fine", "--json", str(tmp_path / "j.json")])
    assert done.exit_code == 0, done.output
    assert "coarse-to-fine" in json.dumps(json.loads((tmp_path / "j.json").read_text()))
    failed = CliRunner().invoke(app.app, [*base, "--set", "search=fast"])
    assert failed.exit_code == 2


class Opinionated:
    """A refiner of any size that says the same of every pixel of a half-size map, and leaves others as they are."""

    needs_candidates = needs_confidence = needs_right = any_scale = True

    def __init__(self, disparity, confidence):
        self.disparity, self.confidence = disparity, confidence
        self.calls = []

    def __call__(self, coarse, left, *, right, scale, threads=1):
        self.calls.append((left.shape, right.shape, coarse.disparity.shape, scale))
        assert coarse.confidence is not None and coarse.candidates is not None and left.dtype == np.uint8
        if len(self.calls) % 2 == 0:
            return coarse
        shape = coarse.disparity.shape
        return Disparity(
            np.full(shape, self.disparity, np.float32),
            np.ones(shape, np.bool_),
            np.full(shape, self.confidence, np.float32),
        )


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_refiner_of_any_size_refines_the_half_size_map_too(kind):
    left = np.repeat(
        np.arange(41, dtype=kind)[:, None] * 5, 121, axis=1
    )  # all disparities fit: what is expected decides
    right = left.copy()
    shares = []
    for confidence in (0.2, 0.9):
        refiner = Opinionated(45.0, confidence)
        options = {"max_disparity": 140, "refiner": refiner, "threads": 1, "smp": False, "speckle": 0}
        disparity = Matcher("S2", **options)(left, right).disparity
        shares.append(float((np.abs(disparity[:, :50] - 90) <= 4).mean()))  # twice the opinion
        half, full = refiner.calls
        assert half == ((21, 61), (21, 61), (21, 61), 1) and full == ((41, 121), (41, 121), (41, 121), 1)
    assert shares == [0, 1]  # what is not sure is not expected


def test_other_refiners_see_the_full_size_map_alone():
    class Plain(Opinionated):
        needs_right = False

        def __call__(self, coarse, left, *, scale, threads=1):
            self.calls.append(left.shape)
            return coarse

    refiner = Plain(0, 0)
    left, right = np.random.default_rng(0).integers(0, 256, (2, 20, 150)).astype(np.uint8)
    Matcher("S2", max_disparity=100, refiner=refiner, threads=1)(left, right)
    assert refiner.calls == [(20, 150)]
