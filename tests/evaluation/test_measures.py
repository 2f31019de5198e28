"""Error figures by set of pixels, by hand and against plain loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stereokit_evaluation.scoring.kitti import THRESHOLDS
from stereokit_evaluation.scoring.measures import (
    FIGURES,
    Errors,
    Measures,
    error_quantiles,
    errors_of,
    measure_map,
    near_edges,
)

NAN = np.nan


def row(*values):
    return np.float32([values])


def test_figures_by_hand():
    truth = row(10, 10, 10, 10, 100, NAN)
    estimate = row(10, 10.75, 12, 14, 104, 3)  # errors 0, 0.75, 2, 4, 4: of 100 px 4 is no D1 error
    figures = measure_map(estimate, occ=truth, measured=np.array([[1, 1, 0, 1, 1, 1]])).main.figures()
    assert figures["d1"] == 20 and figures["density"] == 80
    assert [figures[f"bad-{x:g}"] for x in THRESHOLDS] == [80, 60, 40, 40, 0]
    assert figures["epe"] == pytest.approx(10.75 / 5)
    assert figures["rmse"] == pytest.approx(math.sqrt((0.75**2 + 4 + 16 + 16) / 5))
    # places 2, 4, 4, 4 of 0, 0.75, 2, 4, 4
    assert [figures[name] for name in ("a50", "a90", "a95", "a99")] == [2, 4, 4, 4]


def test_a_gap_is_filled_and_not_measured():
    errors = measure_map(row(8, NAN, 5, NAN), occ=row(8, 8, 8, 8)).main
    assert (errors.pixels, errors.measured, errors.error_sum) == (4, 2, 0 + 3 + 3 + 3)


def test_an_unknown_map_counts_as_minus_one():
    errors = measure_map(row(NAN, NAN), noc=row(1, 40)).main
    assert (errors.error_sum, errors.measured, errors.outliers) == (2 + 41, 0, 1)


def test_sets_of_pixels():
    occ = row(10, 10, 10, 20, 20, NAN)
    noc = row(10, NAN, 10, 20, NAN, NAN)
    measures = measure_map(row(10, 19, 10, 20, 29, 50), noc=noc, occ=occ)
    assert (measures.all.pixels, measures.noc.pixels, measures.occluded.pixels) == (5, 3, 2)
    assert measures.main == measures.noc and measures.occluded.outliers == 2 and measures.noc.outliers == 0
    assert measures.edges.pixels == 3  # all lie within 4 px of the jump from 10 to 20
    only_all = measure_map(row(10, 19), occ=row(10, 10))
    assert only_all.main == only_all.all and only_all.noc == only_all.occluded == Errors()
    empty_noc = measure_map(row(10, 19), occ=row(10, 10), noc=row(NAN, NAN))
    assert empty_noc.main == empty_noc.all and empty_noc.occluded == Errors()
    assert measure_map(row(10, 19)) == Measures()


def test_pairs_add_up_and_quantiles_are_means():
    near, far = (measure_map(np.full((2, 5), 10.0 + e), occ=np.full((2, 5), 10.0, np.float32)) for e in (1, 5))
    wide = measure_map(np.full((4, 5), 10.0), occ=np.full((4, 5), 10.0, np.float32))
    total = sum((near, far, wide), Measures()).main
    assert total.pairs == 3 and total.figure("d1") == 100 * 10 / 40
    assert total.figure("epe") == (10 + 50) / 40 and total.figure("rmse") == math.sqrt((10 + 250) / 40)
    assert total.figure("a90") == (1 + 5 + 0) / 3
    assert all(Errors().figure(name) is None for name in FIGURES)


@pytest.mark.parametrize("size", [1, 2, 9, 10, 11, 20, 99, 100, 1000, 4001])
def test_quantiles_are_values_of_the_sorted_errors(size):
    errors = np.random.default_rng(size).permutation(size).astype(np.float32)
    places = [math.floor(np.float32(size) * np.float32(q)) for q in (0.5, 0.9, 0.95, 0.99)]
    assert error_quantiles(errors) == tuple(float(min(place, size - 1)) for place in places)


def test_ten_errors_have_their_ninth_quantile_at_the_last_place():
    # 10 * 0.9 is 9 in float32 (0.9 is a little less, the product rounds up): the tenth value, not the ninth
    assert error_quantiles(np.arange(10, dtype=np.float32))[1] == 9


def edges_by_loop(truth, near, jump, gap):
    height, width = truth.shape
    ends = set()
    for y in range(height):
        for x in range(width):
            for dy, dx in ((0, 1), (1, 0)):
                if not truth[y, x] >= 0:
                    continue
                for step in range(1, gap + 1):
                    v, u = y + step * dy, x + step * dx
                    if v >= height or u >= width:
                        break
                    if truth[v, u] >= 0:
                        if abs(truth[v, u] - truth[y, x]) > jump:
                            ends |= {(y, x), (v, u)}
                        break
    out = np.zeros(truth.shape, bool)
    for y in range(height):
        for x in range(width):
            out[y, x] = any(abs(y - v) <= near and abs(x - u) <= near for v, u in ends)
    return out


@pytest.mark.parametrize("missing", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("shape", [(1, 1), (1, 12), (12, 1), (9, 14)])
def test_edges_agree_with_the_loop(shape, missing):
    rng = np.random.default_rng(3)
    for near, jump, gap in ((0, 2.0, 1), (1, 2.0, 3), (2, 1.0, 2)):
        truth = rng.integers(0, 4, shape).astype(np.float32)
        truth[rng.random(shape) < missing] = NAN
        np.testing.assert_array_equal(near_edges(truth, near, jump, gap), edges_by_loop(truth, near, jump, gap))


def test_a_slope_is_no_edge_and_a_wide_gap_hides_one():
    assert not near_edges(np.arange(0, 20, 2, dtype=np.float32)[None]).any()
    assert near_edges(row(1, NAN, NAN, 9)).all()
    assert not near_edges(row(1, NAN, NAN, NAN, 9)).any()


def test_no_pixels_have_no_errors():
    nothing = np.zeros(0, np.float32)
    assert errors_of(nothing, nothing, np.zeros(0, bool)) == Errors()
    assert measure_map(np.zeros((0, 4), np.float32), occ=np.zeros((0, 4), np.float32)).main == Errors()
