"""The KITTI evaluation against loops written from the development kit, and numbers worked out by hand."""

from __future__ import annotations

import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.errors import InputError, OptionError
from stereokit_evaluation.scoring.error_map import COLOURS, error_map
from stereokit_evaluation.scoring.kitti import (
    Counts,
    Regions,
    Score,
    Tally,
    as_written,
    fill_background,
    outliers,
    score,
)

NAN = np.nan
DATA = Path(os.environ.get("STEREOKIT_DATA", Path(__file__).parents[2].parent / "shared" / "data"))


def oracle_fill(disparity):
    """Fill in place on lists with -1 as the unknown, in the order of the development kit."""
    rows = [[float(v) if v >= 0 and not math.isinf(v) else -1.0 for v in row] for row in disparity]
    height, width = len(rows), len(rows[0])
    for row in rows:
        count = 0
        for u in range(width):
            if row[u] < 0:
                count += 1
                continue
            if count and u - count > 0:
                low = min(row[u - count - 1], row[u])
                for k in range(u - count, u):
                    row[k] = low
            count = 0
        for u in range(width):
            if row[u] >= 0:
                row[:u] = [row[u]] * u
                break
        for u in range(width - 1, -1, -1):
            if row[u] >= 0:
                row[u + 1 :] = [row[u]] * (width - 1 - u)
                break
    for u in range(width):
        for v in range(height):
            if rows[v][u] >= 0:
                for k in range(v):
                    rows[k][u] = rows[v][u]
                break
        for v in range(height - 1, -1, -1):
            if rows[v][u] >= 0:
                for k in range(v + 1, height):
                    rows[k][u] = rows[v][u]
                break
    return rows


def oracle_counts(estimate, truth, objects=None):
    """Return {region: [errors, pixels, errors measured, pixels measured]} with the kit's float arithmetic."""
    filled = oracle_fill(estimate)
    out = {"all": [0] * 4, "bg": [0] * 4, "fg": [0] * 4}
    for v in range(len(filled)):
        for u in range(len(filled[0])):
            gt = np.float32(truth[v][u])
            if not gt >= 0:
                continue
            error = abs(np.float32(gt - np.float32(filled[v][u])))
            # C++ divides two floats, then widens the quotient to compare it with the double 0.05
            bad = float(error) > 3.0 and (gt == 0 or float(np.float32(error / gt)) > 0.05)
            regions = ["all"] if objects is None else ["all", "fg" if objects[v][u] > 0 else "bg"]
            for region in regions:
                out[region][0] += bad
                out[region][1] += 1
                if estimate[v][u] >= 0:
                    out[region][2] += bad
                    out[region][3] += 1
    return out


def as_lists(regions):
    return {
        name: [part.filled.outliers, part.filled.pixels, part.measured.outliers, part.measured.pixels]
        for name, part in (("all", regions.all), ("bg", regions.bg), ("fg", regions.fg))
    }


def random_map(rng, shape, missing, top=80.0):
    disparity = (rng.integers(0, int(top * 256), shape) / 256).astype(np.float32)
    disparity[rng.random(shape) < missing] = NAN
    return disparity


def test_fill_by_hand():
    given_map = [
        [NAN, NAN, NAN, NAN, NAN],
        [NAN, 5.0, NAN, 3.0, NAN],
        [NAN, NAN, NAN, NAN, NAN],
        [2.0, NAN, NAN, 9.0, 1.5],
        [NAN, NAN, NAN, NAN, NAN],
    ]
    first, last = [5.0, 5.0, 3.0, 3.0, 3.0], [2.0, 2.0, 2.0, 9.0, 1.5]
    expected = np.array([first, first, [NAN] * 5, last, last], np.float32)
    filled = fill_background(given_map)
    assert filled.dtype == np.float32
    np.testing.assert_array_equal(filled, expected)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (7, 5), (6, 33)])
@pytest.mark.parametrize("missing", [0.0, 0.5, 0.9, 1.0])
def test_fill_agrees_with_the_loop(shape, missing):
    rng = np.random.default_rng(7)
    for _ in range(5):
        disparity = random_map(rng, shape, missing)
        before = disparity.copy()
        filled = fill_background(disparity)
        np.testing.assert_array_equal(np.nan_to_num(filled, nan=-1.0), np.float32(oracle_fill(disparity)))
        np.testing.assert_array_equal(disparity, before)


def test_fill_takes_strided_negative_and_infinite():
    wide = np.array([[1.0, 8.0, -2.0, 8.0, np.inf, 8.0, 4.0, 8.0]])
    np.testing.assert_array_equal(fill_background(wide[:, ::2]), np.float32([[1, 1, 1, 4]]))


@pytest.mark.parametrize("shape", [(0, 4), (4, 0), (0, 0)])
def test_empty_maps_have_no_score(shape):
    empty = np.zeros(shape, np.float32)
    assert fill_background(empty).shape == shape
    result = score(empty, noc=empty)
    assert result.noc.all.filled.d1() is None and result.noc.all.density() is None


def test_a_full_map_is_kept_bit_for_bit():
    disparity = np.random.default_rng(1).random((5, 6), np.float32)
    np.testing.assert_array_equal(fill_background(disparity), disparity)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 12), st.sampled_from([0.0, 0.3, 0.8]))
def test_counts_agree_with_the_loop(seed, height, width, missing):
    rng = np.random.default_rng(seed)
    truth = random_map(rng, (height, width), 0.4)
    estimate = truth + rng.choice([0, 0.5, 2.996, 3.0, 3.0039, -3.0039, -7.0], truth.shape).astype(np.float32)
    estimate = np.where(rng.random(truth.shape) < missing, np.float32(NAN), np.nan_to_num(estimate, nan=9.0))
    objects = rng.integers(0, 3, truth.shape)
    result = score(estimate, noc=truth, occ=truth, objects=objects)
    assert as_lists(result.noc) == oracle_counts(estimate, truth, objects)
    assert as_lists(result.occ) == as_lists(result.noc)


def test_d1_by_hand():
    truth = np.float32([[10, 10, 10, 100, 100, 100, 200, NAN]])
    estimate = np.float32([[13, 13.5, 6.5, 104, 105, 106, 209, 50]])
    #                       =3   bad  bad  4 %  5 %  6 %  4.5 %  no truth
    objects = np.array([[0, 0, 1, 1, 0, 2, 0, 1]])
    result = score(estimate, noc=truth, objects=objects).noc
    assert as_lists(result) == {"all": [4, 7, 4, 7], "bg": [2, 4, 2, 4], "fg": [2, 3, 2, 3]}
    assert result.all.filled.d1() == 100 * 4 / 7


def test_three_pixels_are_no_error():
    truth = np.float32([10, 20, 59])
    assert not outliers(np.full(3, 3, np.float32), truth).any()
    assert outliers(np.full(3, np.nextafter(np.float32(3), np.float32(4))), truth).all()


def test_five_percent_rounds_up_to_an_error():
    # The kit, compiled by g++ for x86-64, calls all of these errors: 1/20 as a float exceeds the double 0.05.
    truth = np.arange(61 * 256 // 20 * 20 + 20, 230 * 256, 20, dtype=np.float32) / np.float32(256)
    error = truth / np.float32(20)
    assert error.min() > 3
    assert outliers(error, truth).all()
    assert not outliers(np.nextafter(error, np.float32(0)), truth)[truth == 80].any()


def test_bad_x_and_epe_by_hand():
    truth = np.float32([[8, 8, 8, 8, 8, 8]])
    estimate = np.float32([[8, 8.5, 9, 10.5, NAN, 13]])  # the gap takes 10.5
    counts = score(estimate, occ=truth).occ.all
    assert [counts.filled.bad_x(x) for x in (0.5, 1.0, 2.0, 3.0, 4.0)] == [
        pytest.approx(100 * n / 6) for n in (4, 3, 3, 1, 1)
    ]
    assert counts.filled.epe() == pytest.approx((0 + 0.5 + 1 + 2.5 + 2.5 + 5) / 6)
    assert counts.measured.epe() == pytest.approx((0 + 0.5 + 1 + 2.5 + 5) / 5)
    assert counts.measured.bad_x(2.0) == 40.0
    assert counts.density() == pytest.approx(100 * 5 / 6)
    with pytest.raises(OptionError, match=r"threshold must be one of .*, got 1\.5"):
        counts.filled.bad_x(1.5)


def test_an_empty_estimate_is_compared_as_minus_one():
    truth = np.float32([[1.0, 2.0, 3.0, 40.0]])
    counts = score(np.full((1, 4), NAN), noc=truth).noc.all
    assert counts.filled.outliers == 2  # |1 + 1| and |2 + 1| do not exceed 3
    assert counts.filled.pixels == 4 and counts.measured == Tally()
    assert counts.density() == 0.0 and counts.measured.d1() is None


def test_measured_marks_a_map_that_was_filled_before():
    truth = np.float32([[8, 8, 8]])
    estimate = np.float32([[8, 20, NAN]])
    counts = score(estimate, noc=truth, measured=np.array([[True, False, True]])).noc.all
    assert (counts.filled.outliers, counts.measured.outliers, counts.measured.pixels) == (2, 0, 1)


def test_pooling_divides_once():
    one = score(np.float32([[50.0]]), noc=np.float32([[10.0]]))
    many = score(np.full((3, 3), 10.0), noc=np.full((3, 3), 10.0), occ=np.full((3, 3), 14.0))
    total = sum([one, many], Score())
    assert total.noc.all.filled.d1() == 10.0  # and not the mean of 100 and 0
    assert total.occ.all.filled == Tally(9, 9, (9, 9, 9, 9, 0), 36.0)
    assert total.noc.bg == Counts() and total.noc.bg.filled.d1() is None
    assert total.main is total.noc.all and Score(occ=total.occ).main is total.occ.all
    assert Score() + Score() == Score(Regions(), Regions())


def test_as_written_is_what_a_file_keeps():
    disparity = np.float32([[0.0, 1 / 512, 1 / 256, 1.9999, 255.996, NAN, -1.0, np.inf]])
    expected = [[1 / 256, 1 / 256, 1 / 256, 511 / 256, 65534 / 256, NAN, NAN, NAN]]
    np.testing.assert_array_equal(as_written(disparity), np.float32(expected))
    with pytest.raises(InputError, match="below 256 px"):
        as_written([[256.0]])


@pytest.mark.parametrize(
    ("estimate", "rest", "message"),
    [
        (np.zeros(3), {}, r"estimate must have shape \(H, W\), got \(3,\)"),
        (np.zeros((2, 2), bool), {}, "estimate must hold numbers, got bool"),
        (np.zeros((2, 2)), {"noc": np.zeros((2, 3))}, "noc must have the size"),
        (np.zeros((2, 2)), {"objects": np.zeros((1, 2))}, "objects must have the size"),
        (np.zeros((2, 2)), {"measured": np.zeros((1, 2))}, "measured must have the size"),
    ],
)
def test_wrong_input_is_refused_in_one_line(estimate, rest, message):
    with pytest.raises(InputError, match=message) as caught:
        score(estimate, **rest)
    assert "\n" not in str(caught.value)


def oracle_error_map(filled, occ, noc):
    height, width = occ.shape
    picture = np.zeros((height, width, 3), np.uint8)
    low = [0.0] + [2.0**k for k in range(-4, 5)]
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            if not occ[v, u] >= 0:
                continue
            error = float(abs(filled[v][u] - occ[v, u]))
            normal = np.float32(min(error / 3.0, 20.0 * error / float(occ[v, u])))
            colour = COLOURS[max(k for k in range(10) if normal >= low[k])]
            if not noc[v, u] >= 0:
                colour = tuple(int(c * 0.5) for c in colour)
            picture[v - 1 : v + 2, u - 1 : u + 2] = colour
    return picture


@pytest.mark.parametrize("shape", [(9, 13), (3, 3), (2, 5), (5, 2), (1, 1)])
def test_error_map_agrees_with_the_loop(shape):
    rng = np.random.default_rng(3)
    occ = random_map(rng, shape, 0.6) + np.float32(1)
    noc = np.where(rng.random(shape) < 0.3, np.float32(NAN), occ)
    estimate = np.nan_to_num(occ, nan=5.0) * rng.choice([1.0, 1.01, 1.05, 1.5, 3.0], shape).astype(np.float32)
    picture = error_map(estimate, occ, noc)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, oracle_error_map(estimate, occ, noc))


def test_error_map_colours_single_pixels():
    occ = np.float32([[10, 10, 10, NAN, 0, 10]])
    estimate = np.float32([[10, 13, 70, 5, 0, 12.9]])
    picture = error_map(estimate, occ, noc=np.float32([[10, 10, NAN, NAN, 0, 10]]), dilate=False)
    #                  0 px        exactly 3 px     20 * 3, dark  unknown    0 / 0          just below
    expected = [(49, 54, 149), (254, 224, 144), (82, 0, 19), (0, 0, 0), (49, 54, 149), (224, 243, 248)]
    np.testing.assert_array_equal(picture[0], expected)
    with pytest.raises(InputError, match="occ must have the size"):
        error_map(estimate, occ[:, :3])


def test_error_map_without_noc_darkens_nothing():
    truth = np.full((4, 4), 10.0, np.float32)
    assert (error_map(truth, truth) == COLOURS[0]).all()


@pytest.mark.data
def test_authors_coarse_maps_score_as_the_loop_does():
    """Frames 0-3 of KITTI 2015, half-size maps of the StereoVAE authors, upscaled x2 bilinearly."""
    if not (DATA / "authors_coarse").is_dir():
        pytest.skip(f"no authors_coarse in {DATA}; set STEREOKIT_DATA")
    truth_folder = DATA / "kitti2015" / "training"
    total, loop = Score(), {"noc": [0] * 4, "occ": [0] * 4}
    for index in range(4):
        name = f"{index:06d}_10.png"
        stored = {
            kind: cv2.imread(str(truth_folder / f"disp_{kind}_0" / name), cv2.IMREAD_UNCHANGED)
            for kind in ("noc", "occ")
        }
        truth = {kind: np.where(raw == 0, np.float32(NAN), raw / np.float32(256)) for kind, raw in stored.items()}
        coarse = cv2.imread(str(DATA / "authors_coarse" / "disp" / name), cv2.IMREAD_UNCHANGED)
        height, width = stored["noc"].shape
        estimate = cv2.resize(coarse.astype(np.float32) / 256, (width, height)) * np.float32(2)
        total += score(estimate, **truth)
        for kind in ("noc", "occ"):
            counted = oracle_counts(estimate, truth[kind])["all"]
            loop[kind] = [a + b for a, b in zip(loop[kind], counted, strict=True)]
    assert as_lists(total.noc)["all"] == loop["noc"]
    assert as_lists(total.occ)["all"] == loop["occ"]
    # The loop gave, with OpenCV 5.0.0, 46547 of 387316 and 48780 of 391238; another resize may move a few.
    assert total.noc.all.filled.d1() == pytest.approx(12.0178, abs=0.005)
    assert total.occ.all.filled.d1() == pytest.approx(12.4681, abs=0.005)
    assert (total.noc.all.density(), total.occ.all.density()) == (100.0, 100.0)  # the maps are dense
