"""Quick comparisons of the CPU's stages with the oracles, on inputs where flaws show; run by `cpu.interpreter`.

Each imports stereokit when it is called, so that it sees the copy whose kernels are interpreted.
"""

from __future__ import annotations

import functools

import numpy as np
import oracles

__all__ = ["CHECKS"]

NAN = np.nan


def noise(shape, high=256, seed=0, dtype=np.uint8):
    return np.random.default_rng(seed).integers(0, high, shape).astype(dtype)


@functools.cache
def census_volume(shape, minimum, count, window, outside, seed=0, high=4):
    left, right = noise((2, *shape), high, seed)
    volume = oracles.census(left, right, minimum, count, *map(int, window.split("x")), outside)
    return left, right, volume


def check_census(shape=(5, 9), minimum=-2, count=6, window="9x7", outside=1.0):
    """Compare all cells of a pair with many equal neighbours."""
    import stereokit

    left, right, expected = census_volume(shape, minimum, count, window, outside)
    volume = stereokit.cost_volume(
        left, right, "census", window=window, outside=outside, min_disparity=minimum, max_disparity=minimum + count,
        threads=1,
    )  # fmt: skip
    np.testing.assert_array_equal(volume, expected)


def check_census_of_full_blocks():
    """Compare where no level pads, and the last one leaves the image at the last column but two."""
    check_census((1, 66), 0, 64, "5x5", 0.5)


def check_bad_pixels():
    """Compare with pixels without evidence in both views."""
    import stereokit

    left, right, expected = census_volume((4, 9), 0, 6, "5x5", 0.5)
    holes = [image.astype(np.float32) for image in (left, right)]
    holes[0][:, 4] = holes[1][2, :] = NAN
    volume = stereokit.cost_volume(*holes, "census", window="5x5", outside=0.5, max_disparity=6, threads=1)
    assert (volume[:, 4] == 12).all() and (volume[2] == 12).all()
    far = np.s_[0, 7:, :1]  # no hole in either window
    np.testing.assert_array_equal(volume[far], expected[far])


@functools.cache
def zncc_volume(shape, minimum, count, window, seed=1):
    left = noise(shape, 256, seed)
    right = (np.roll(left, -1, axis=1) // 2 + noise(shape, 20, seed + 1)).astype(np.uint8)  # level 1 is right
    return left, right, oracles.zncc(left, right, minimum, count, window)


def check_zncc(shape=(8, 9), minimum=-2, count=6, window=5, steps=31, order=(0, 1, 2, 3, 7, 6, 5, 4, 5)):
    """Compare all cells of rows that are asked for downwards, upwards and out of turn, and of parts of rows."""
    from stereokit import Zncc
    from stereokit.costs.rows import CostInput, Levels, cost_row
    from stereokit.kernels.workspace import Workspace

    left, right, expected = zncc_volume(shape, minimum, count, window)
    levels = Levels(minimum, count)
    (rows,) = Zncc(window, steps).prepare(CostInput(left, right, None, None, levels, 1.0), Workspace(), 1)
    for y in order:
        out = np.full(shape[1] * levels.padded, 77, np.uint8)
        cost_row(rows, y, 0, shape[1], out)
        row = out.reshape(shape[1], levels.padded)
        assert np.abs(row[:, :count] - expected[y] * steps).max() <= 0.5 + 1e-4 * steps
        assert (row[:, count:] == 255).all()
    for y, x0, x1 in ((3, 0, 4), (4, 0, 4), (5, 0, 6), (6, 5, 9), (5, 5, 9), (5, 2, 3)):
        out = np.full(shape[1] * levels.padded, 77, np.uint8)
        cost_row(rows, y, x0, x1, out)
        row = out.reshape(shape[1], levels.padded)
        assert np.abs(row[x0:x1, :count] - expected[y, x0:x1] * steps).max() <= 0.5 + 1e-4 * steps
        assert (row[:x0] == 77).all() and (row[x1:] == 77).all()


def check_zncc_of_many_steps():
    """Compare costs that do not fit a signed byte."""
    check_zncc(steps=200)


def check_zncc_without_variance():
    """Compare windows of one grey value on either side."""
    import stereokit

    left, right = noise((2, 5, 14), 256, 3)
    left[:, :7], right[:, 9:] = 50, 60
    expected = oracles.zncc(left, right, 0, 3, 3)
    volume = stereokit.cost_volume(left, right, "zncc", window=3, steps=31, max_disparity=3, threads=1)
    assert np.abs(volume - expected * 31).max() <= 0.51


PATTERNS = {
    "noise": lambda shape, largest: noise(shape, largest + 1, 4),
    "worst": lambda shape, largest: np.full(shape, largest, np.uint8),
    # a step of many levels at every pixel
    "jumps": lambda shape, largest: np.fromfunction(
        lambda y, x, d: (y + x + (d > shape[2] // 2)) % 2 * largest, shape
    ).astype(np.uint8),
    # one level is best everywhere, and path costs grow to their largest
    "steep": lambda shape, largest: np.where(np.arange(shape[2]) == 3, 0, np.full(shape, largest)).astype(np.uint8),
}


@functools.cache
def path_sums(shape, count, p1, p2, paths, pattern, largest, edge_factor):
    volume = PATTERNS[pattern]((*shape, count), largest)
    guide = noise(shape, 256, 5)
    guide[:, :2] = [0, 255]
    expected = oracles.sgm(volume, p1, p2, oracles.DIRECTIONS[paths], guide, 8, edge_factor)
    return volume, guide, expected


def check_paths(
    shape=(5, 6),
    count=7,
    p1=7,
    p2=60,
    paths=8,
    pattern="noise",
    largest=62,
    edge_factor=1.0,
    recovers=False,
    guide=None,
    threads=1,
):
    """Compare sums over the paths, exactly."""
    from stereokit import RowCost, aggregate

    class Cost(RowCost):
        costly_to_recompute = recovers

    volume, own, expected = path_sums(shape, count, p1, p2, paths, pattern, largest, edge_factor)
    guide = own if guide is None else guide
    options = {"p1": p1, "p2": p2, "paths": paths, "edge": 8, "edge_factor": edge_factor, "threads": threads}
    total = aggregate(volume, guide, "sgm", cost=Cost(lambda *_: None, largest), **options)
    np.testing.assert_array_equal(total, expected)


def check_edges():
    """Compare penalties that follow the guide, on jumps of one threshold and of nearly all grey values."""
    for paths in (4, 8):
        check_paths((4, 6), paths=paths, edge_factor=0.3)
    guide = np.array([[0, 8, 0, 7, 20], [8, 8, 1, 9, 255], [0, 0, 16, 0, 247]], np.uint8)
    volume = noise((3, 5, 6), 63, 6)
    from stereokit import RowCost, aggregate

    for paths in (4, 8):
        expected = oracles.sgm(volume, 9, 40, oracles.DIRECTIONS[paths], guide, 8, 0.25)
        options = {"p1": 9, "p2": 40, "paths": paths, "edge": 8, "edge_factor": 0.25, "threads": 1}
        total = aggregate(volume, guide, "sgm", cost=RowCost(lambda *_: None, 62), **options)
        np.testing.assert_array_equal(total, expected)


def check_many_levels():
    """Compare two, three and eight blocks of levels, the last of them full or not."""
    for count in (70, 128, 130, 512):
        for p1, p2 in ((9, 60), (9, 193)):  # sums of bytes and of words
            check_paths((3, 4), count, p1, p2, 8)


def check_tall():
    """Compare where there are more rows than columns: diagonals wrap more than once."""
    check_paths((9, 3))


def check_recovered():
    """Compare costs that the second sweep takes back from path costs."""
    for count in (5, 70, 130):
        for largest, p2 in ((62, 60), (31, 224), (254, 1)):
            check_paths((5, 4), count, p2 // 3, p2, 4, largest=largest, recovers=True, edge_factor=0.5)


def check_shared():
    """Compare what three threads make together, of bands of columns and then of pairs of rows."""
    for recovers in (False, True):
        check_paths((14, 100), 5, paths=4, edge_factor=0.5, recovers=recovers, threads=3)


def check_bytes():
    """Compare sums that just fit a byte, and sums that just do not."""
    for pattern in ("worst", "steep"):
        for recovers in (False, True):
            check_paths((3, 4), 64, 10, 60, 4, pattern, 62, recovers=recovers)
            check_paths((9, 9), 64, 80, 80, 4, pattern, 31, recovers=recovers)


def check_largest():
    """Compare under the largest penalties that a byte leaves."""
    for pattern in PATTERNS:
        for count in (9, 130):
            for largest in (1, 62, 127, 254):
                check_paths((3, 4), count, (255 - largest) // 2, 255 - largest, 8, pattern, largest)


def check_close_penalties():
    """Compare jumps of many levels for hardly more than a step of one."""
    check_paths(p1=20, p2=22)


def check_rf(shape=(7, 30), passes=1, largest=62):
    """Compare the recursive filter of costs, within the bound of its fixed point."""
    from stereokit import RowCost, aggregate

    guide = noise(shape, 256, 7)
    guide[: shape[0] // 2, : shape[1] // 2] //= 64
    volume = noise((*shape, 3), largest + 1, 8)
    options = {"sigma_s": 20, "sigma_r": 30, "sigma_v": 6, "passes": passes, "threads": 1}
    total = aggregate(volume, guide, "dt", cost=RowCost(lambda *_: None, largest), **options)
    expected = oracles.slices(oracles.domain_transform, volume, guide, 20, 30, passes, 6)
    step = 2.0 ** -(8 - largest.bit_length())
    assert np.abs(total / 64 - expected).max() < step / 2 * (2 * passes - 1) + 0.1


def check_rf_of_passes():
    """Compare two passes, whose volume is written back between them."""
    check_rf(passes=2)


def check_rf_of_flat_guides():
    """Compare with a long memory: each step may lose a unit in the last place, and the way back must not lose more."""
    from stereokit import RowCost, aggregate

    guide = np.full((2, 200), 9, np.uint8)
    volume = (noise((2, 200, 2), 63, 9) > 55).astype(np.uint8) * 3
    total = aggregate(
        volume, guide, "dt", cost=RowCost(lambda *_: None, 62), sigma_s=60, sigma_r=30, sigma_v=60, threads=1
    )
    expected = oracles.slices(oracles.domain_transform, volume, guide, 60, 30, 1, 60)
    assert np.abs(total / 64 - expected).max() < 0.5
    assert abs(np.mean(total / 64 - expected)) < 0.2


def check_rf_of_constants():
    """Filter what is constant, up to the largest cost: it stays so."""
    from stereokit import RowCost, aggregate

    for value in (1, 254):
        volume = np.full((4, 5, 2), value, np.uint8)
        cost = RowCost(lambda *_: None, 254)
        assert (aggregate(volume, noise((4, 5)), "dt", cost=cost, passes=2, threads=1) == value * 64).all()


def check_sum():
    """Compare the plain sum, of costs and of floats."""
    from stereokit import aggregate

    guide, volume = noise((4, 6), 40, 10), noise((4, 6, 5), 63, 11)
    expected = oracles.slices(oracles.cascade, volume, guide)
    for costs in (volume, volume.astype(np.float32)):
        total = aggregate(costs, guide, "dt", cost="census", mode="sum", threads=1)
        np.testing.assert_allclose(total, expected, rtol=1e-5)


def check_selection(shape=(3, 5), counts=(1, 2, 3, 9, 64, 130), dtype=np.uint16, high=20):
    """Compare winner, fraction, margin and candidates, with many equal costs; the costs stay as they are."""
    from stereokit.selection.wta import keys_of, select_row, selection_output

    for count in counts:
        padded = -(-count // 64) * 64
        values = np.full((*shape, padded), 30000, dtype)
        values[:, :, :count] = volume = noise((*shape, count), high, count).astype(dtype)
        disparity, confidence = np.empty((2, *shape), np.float32)
        cost, candidates = np.empty(shape, dtype), np.full((2, *shape), -99, np.float32)
        out = selection_output(disparity, cost, confidence, count, -7, True, 0, candidates)
        for y in range(shape[0]):
            row = values[y].ravel()
            select_row(keys_of(row), row, shape[1], tuple(range(padded // 64)), shape[1] * y, out)
            np.testing.assert_array_equal(row.reshape(shape[1], padded)[:, :count], volume[y])
        expected = oracles.select(volume, -7)
        np.testing.assert_allclose(disparity, expected[0], rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(cost, expected[1])
        np.testing.assert_allclose(confidence, expected[2], rtol=1e-6, atol=1e-7)
        np.testing.assert_array_equal(candidates[0], disparity)
        np.testing.assert_array_equal(candidates[1], oracles.rivals(volume, -7))


def map_of(shape, seed, gaps, low=-3, high=12):
    """Return a map of eighths of pixels with gaps."""
    rng = np.random.default_rng(seed)
    disparity = (rng.integers(8 * low, 8 * high, shape) / 8).astype(np.float32)
    disparity[rng.random(shape) < gaps] = NAN
    return disparity


def check_narrow(p1=3, p2=17, high=256, paths=(4, 8)):
    """Compare searches of 64 levels that begin elsewhere at every pixel."""
    from stereokit import Census
    from stereokit.aggregation.sgm import Sgm
    from stereokit.costs.rows import CostInput, Levels, Search
    from stereokit.kernels.workspace import Workspace
    from stereokit.selection.wta import selection_output

    shape, levels, cost = (5, 8), Levels(-3, 150), Census("5x5")
    left, right, volume = census_volume(shape, -3, 150, "5x5", 0.5, 6, high)
    starts = np.random.default_rng(7).choice([0, 7, 86], shape).astype(np.int16)
    low, high = np.sort(np.random.default_rng(8).integers(0, 64, (2, *shape)), axis=0).astype(np.uint8)
    volume = volume.copy()
    for y, x, k in np.ndindex(volume.shape):
        volume[y, x, k] += not low[y, x] <= k - starts[y, x] <= high[y, x]
    for count in paths:
        total = oracles.narrow_sgm(volume, starts, 64, p1, p2, oracles.DIRECTIONS[count])
        own = np.stack([[total[y, x, s:][:64] for x, s in enumerate(row)] for y, row in enumerate(starts)])
        expected, expected_cost, _ = oracles.select(own, -3)
        workspace, disparity = Workspace(), np.empty(shape, np.float32)
        best = np.empty(shape, np.uint16)
        out = selection_output(disparity, best, None, 64, -3, True, 0, None, starts)
        rows = cost.prepare(CostInput(left, right, None, None, levels, 0.5, 1, None, starts), workspace, 2)
        stage = Sgm(p1=p1, p2=p2, paths=count, edge_factor=1.0)
        stage.sweep(rows, levels, cost, left, workspace, 1, out, search=Search(starts, low, high))
        np.testing.assert_array_equal(best, expected_cost)
        np.testing.assert_allclose(disparity, expected + starts, atol=1e-5)


def check_narrow_worst():
    """Compare with the largest penalties that bytes allow."""
    check_narrow(230, 230, 2, (4,))


def check_narrow_zncc(shape=(5, 12), window=5):
    """Compare rows of searches that begin anew after every third pixel with the same levels of the loops."""
    from stereokit import Zncc
    from stereokit.costs.rows import CostInput, Levels, cost_row
    from stereokit.kernels.workspace import Workspace

    left, right, expected = zncc_volume(shape, -2, 100, window)
    starts = np.random.default_rng(3).choice([0, 8, 36], (shape[0], shape[1] // 3)).repeat(3, axis=1).astype(np.int16)
    pair = CostInput(left, right, None, None, Levels(-2, 100), 1.0, 1, None, starts)
    (rows,) = Zncc(window, 31).prepare(pair, Workspace(), 1)
    for y, x0, x1 in ((0, 0, 12), (3, 0, 12), (2, 0, 12), (2, 0, 5), (2, 4, 12)):
        out = np.full(shape[1] * 64, 77, np.uint8)
        cost_row(rows, y, x0, x1, out)
        wanted = np.array([expected[y, x, s:][:64] for x, s in enumerate(starts[y])]) * 31
        row = out.reshape(wanted.shape)
        assert np.abs(row - wanted)[x0:x1].max() <= 0.5 + 1e-4 * 31
        assert (row[:x0] == 77).all() and (row[x1:] == 77).all()


def check_smp():
    """Compare the single matching phase, with many equal costs."""
    from stereokit.postprocess import single_matching_phase

    for seed in range(3):
        disparity, cost = map_of((5, 14), seed, 0.2), noise((5, 14), 4, seed, np.uint16)
        expected = oracles.single_matching_phase(disparity, cost)
        np.testing.assert_array_equal(single_matching_phase(disparity, cost), expected)


def check_fill():
    """Compare both rules of filling."""
    from stereokit.postprocess import fill

    for gaps in (0.5, 0.9):
        disparity = map_of((6, 14), 5, gaps)
        for mode in ("background", "nearest"):
            np.testing.assert_array_equal(fill(disparity, mode), oracles.fill(disparity, mode))


def check_median():
    """Compare both windows, with and without gaps, whole and in bands."""
    from stereokit.postprocess import median
    from stereokit.postprocess.median import median_rows

    for gaps in (0, 0.3, 0.9):
        disparity = map_of((7, 9), 6, gaps)
        for size in (3, 5):
            expected = oracles.median(disparity, size)
            np.testing.assert_array_equal(median(disparity, size), expected)
            out = np.empty_like(disparity)
            for y0, y1 in ((0, 1), (1, 4), (4, 7)):
                median_rows(disparity, size, y0, y1, out)
            np.testing.assert_array_equal(out, expected)


def check_speckle():
    """Compare regions up to several sizes, in one band and in three."""
    from stereokit.postprocess import remove_speckles

    for gaps, size in ((0, 2), (0.3, 3), (0.1, 6)):
        disparity = map_of((9, 14), 10, gaps, 0, 4)
        expected = oracles.remove_speckles(disparity, size)
        for threads in (1, 3):
            np.testing.assert_array_equal(remove_speckles(disparity, size, threads=threads), expected)
    meeting = np.array([[0, 1, 2, 3, 4, 5, 6], [4] * 7], np.float32)  # two runs that are alike only in their middles
    np.testing.assert_array_equal(remove_speckles(meeting, 7), meeting)


CHECKS = {name.removeprefix("check_"): value for name, value in vars().copy().items() if name.startswith("check_")}
"""Every check by name."""
