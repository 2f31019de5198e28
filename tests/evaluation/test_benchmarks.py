"""The rules of Middlebury v3 and of ETH3D on arrays that were worked out by hand, and against plain loops."""

from __future__ import annotations

import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereokit.errors import InputError
from stereokit_evaluation.data import datasets
from stereokit_evaluation.data.frame import Benchmark, Frame
from stereokit_evaluation.scoring import eth3d, middlebury
from stereokit_evaluation.scoring.assessment import assess, average_official

NAN, INF = np.nan, np.inf
DATA = Path(os.environ.get("STEREOKIT_DATA", Path(__file__).parents[2].parent / "shared" / "data"))


def middlebury_by_loop(disp, gt, mask, threshold, maxdisp, rounddisp, size):
    """Return bad, invalid, all pixels and the sum of errors, as the development kit counts them."""
    scale = len(gt[0]) // len(disp[0])
    n = bad = invalid = 0
    total = 0.0
    for y in range(len(gt)):
        for x in range(len(gt[0])):
            if gt[y][x] == INF or (mask is not None and mask[y][x] != 255):
                continue
            d = np.float32(scale * disp[y // scale][x // scale])
            valid = d != INF
            if valid:
                d = max(np.float32(0), min(np.float32(scale * maxdisp), d))
                if rounddisp:
                    d = np.float32(math.floor(float(d) + 0.5))
            n += 1
            if not valid:
                invalid += 1
                continue
            error = np.float32(abs(d - gt[y][x]) / np.float32(size))
            total += float(error)
            bad += error > threshold
    return bad, invalid, n, total


def test_middlebury_by_hand():
    truth = np.float32([[10, 10, 10, 10, 10, INF, 10, 10]])
    disparity = np.float32([[10, 10.5, 12, 12.5, INF, 99, NAN, -5]])
    # errors: 0, 0.5, 2, 2.5, invalid, no truth, invalid, and -5 is clipped to 0: 10
    figures = middlebury.score_pair(disparity, truth)
    assert figures["pixels"] == 7 and figures["invalid"] == 100 * 2 / 7
    assert [figures[f"bad-{x}"] for x in ("0.5", "1", "2", "4")] == [100 * n / 7 for n in (3, 3, 2, 1)]
    assert [figures[f"total_bad-{x}"] for x in ("0.5", "1", "2", "4")] == [100 * n / 7 for n in (5, 5, 4, 3)]
    assert figures["avgerr"] == (0.5 + 2 + 2.5 + 10) / 5
    assert figures["rms"] == pytest.approx(math.sqrt((0.25 + 4 + 6.25 + 100) / 5))
    assert (figures["a50"], figures["a90"]) == (2.0, 10.0)
    masked = middlebury.score_pair(disparity, truth, np.array([[1, 1, 0, 0, 1, 1, 0, 0]]))
    assert masked["pixels"] == 3 and masked["bad-0.5"] == 0 and masked["total_bad-0.5"] == pytest.approx(100 / 3)


def test_middlebury_clips_to_the_range():
    truth = np.float32([[30, 30, 0]])
    figures = middlebury.score_pair(np.float32([[31, 500, -400]]), truth, ndisp=32)
    assert figures["avgerr"] == (1 + 2 + 0) / 3 and figures["bad-2"] == 0


def test_middlebury_rounds_where_the_truth_is_whole():
    truth = np.float32([[10, 10, 10, 10]])
    figures = middlebury.score_pair(np.float32([[10.49, 10.5, 9.5, 0.49999997]]), truth, integer=True)
    assert figures["avgerr"] == (0 + 1 + 0 + 10) / 4  # half up, and 0.49999997 to 0
    assert figures["bad-0.5"] == 50


def test_middlebury_thresholds_are_of_full_size():
    truth, disparity = np.float32([[10, 10, 10, 10]]), np.float32([[10.25, 10.5, 10.75, 14]])
    full = middlebury.score_pair(disparity, truth)
    half = middlebury.score_pair(disparity, truth, size=0.5)
    quarter = middlebury.score_pair(disparity, truth, size=0.25)
    assert [full[f"bad-{x}"] for x in ("0.5", "1", "2", "4")] == [50, 25, 25, 0]
    assert [half[f"bad-{x}"] for x in ("0.5", "1", "2", "4")] == [75, 50, 25, 25]
    assert [quarter[f"bad-{x}"] for x in ("0.5", "1", "2", "4")] == [100, 75, 50, 25]
    assert quarter["avgerr"] == 4 * full["avgerr"] == 2 * half["avgerr"]


def test_middlebury_enlarges_a_small_map():
    disparity = np.float32([[5, INF]])
    truth = np.float32([[10, 10, 10, 10], [11, 12, 10, INF]])
    figures = middlebury.score_pair(disparity, truth, ndisp=8)
    assert figures["pixels"] == 7 and figures["invalid"] == 100 * 3 / 7
    assert figures["avgerr"] == (0 + 0 + 1 + 2) / 4 and figures["bad-1"] == 100 / 7
    with pytest.raises(InputError, match="truth must be 1, 2 or 4 times as large as the map"):
        middlebury.score_pair(np.zeros((1, 2)), np.zeros((2, 6)))
    with pytest.raises(InputError, match="truth must be 1, 2 or 4 times"):
        middlebury.score_pair(np.zeros((1, 2)), np.zeros((3, 4)))
    with pytest.raises(InputError, match="mask must have the size of the truth"):
        middlebury.score_pair(np.zeros((1, 2)), np.zeros((1, 2)), np.ones((1, 3)))


@pytest.mark.parametrize("scale", [1, 2, 4])
@pytest.mark.parametrize("integer", [False, True])
@pytest.mark.parametrize("size", [1.0, 0.5])
def test_middlebury_agrees_with_the_loop(scale, integer, size):
    rng = np.random.default_rng(8)
    disparity = (rng.integers(-40, 400, (4, 5)) / 8).astype(np.float32)
    disparity[rng.random(disparity.shape) < 0.2] = INF
    truth = (rng.integers(0, 300, (4 * scale, 5 * scale)) / 8).astype(np.float32)
    truth[rng.random(truth.shape) < 0.3] = INF
    mask = rng.choice([0, 128, 255], truth.shape)
    for chosen in (None, mask):
        figures = middlebury.score_pair(
            disparity, truth, None if chosen is None else chosen == 255, ndisp=40, integer=integer, size=size
        )
        for x in middlebury.THRESHOLDS:
            bad, invalid, n, total = middlebury_by_loop(disparity, truth, chosen, x, 40, integer, size)
            assert figures["pixels"] == n and figures["invalid"] == pytest.approx(100 * invalid / n)
            assert figures[f"bad-{x:g}"] == pytest.approx(100 * bad / n)
            assert figures[f"total_bad-{x:g}"] == pytest.approx(100 * (bad + invalid) / n)
            assert figures["avgerr"] == pytest.approx(total / (n - invalid))


def test_no_valid_pixel_is_all_bad():
    figures = middlebury.score_pair(np.full((1, 2), INF), np.float32([[1, 2]]))
    assert (figures["bad-2"], figures["total_bad-2"], figures["invalid"], figures["avgerr"]) == (0, 100, 100, INF)
    assert middlebury.score_pair(np.zeros((1, 2)), np.full((1, 2), INF)) is None


def test_the_table_weighs_the_hard_pairs_by_half():
    assert sum(middlebury.WEIGHTS.values()) == 10 + 5 * 0.5 and len(middlebury.WEIGHTS) == 15
    assert {name for name, weight in middlebury.WEIGHTS.items() if weight == 0.5} == {
        "PianoL", "Playroom", "Playtable", "Shelves", "Vintage",
    }  # fmt: skip
    figures = {"trainingH/Piano": {"pixels": 9.0, "bad-2": 6.0}, "trainingH/PianoL": {"pixels": 1.0, "bad-2": 30.0}}
    assert middlebury.weighted_average({**figures, "2006/Aloe": {"bad-2": 99.0}, "trainingH/Pipes": None}) == {
        "bad-2": (6 + 0.5 * 30) / 1.5
    }
    assert middlebury.weighted_average({"2006/Aloe": {"bad-2": 99.0}}) is None


@pytest.mark.parametrize(
    ("name", "width", "size"),
    [("Motorcycle", 2964, 1), ("H/Motorcycle", 1482, 0.5), ("Motorcycle", 741, 0.25), ("Adirondack", 718, 0.25),
     ("Teddy", 900, 0.5), ("Teddy", 1800, 1), ("Flowers", 700, 1)],
)  # fmt: skip
def test_the_size_of_a_training_pair_is_known_by_its_width(name, width, size):
    assert middlebury.relative_size(name, width) == size


def test_eth3d_by_hand():
    truth = np.float32([[5, 5, 5, 2, 5, 5, NAN, INF, 1, 5]])
    disparity = np.float32([[5, 5.75, 6.5, -3, NAN, INF, 5, 5, 10.5, 5]])
    # errors: 0, 0.75, 1.5, 5 (a negative estimate is one), none, none, no truth (2), beyond the width of 10: none, 0
    figures = eth3d.score_pair(disparity, truth)
    assert figures["pixels"] == 8 and figures["coverage"] == 100 * 5 / 8
    assert [figures[f"bad-{x}"] for x in ("0.5", "1", "2", "4")] == [60, 40, 20, 20]
    assert figures["avgerr"] == (0.75 + 1.5 + 5) / 5
    assert figures["rms"] == pytest.approx(math.sqrt((0.5625 + 2.25 + 25) / 5))
    assert [figures[name] for name in ("a50", "a90", "a95", "a99")] == [0.75, 5, 5, 5]  # places 2, 4, 4, 4
    masked = eth3d.score_pair(disparity, truth, np.arange(10)[None] < 2)
    assert masked["coverage"] == 100 and masked["bad-0.5"] == 50


def test_eth3d_without_an_estimate_is_the_worst():
    figures = eth3d.score_pair(np.full((1, 3), NAN), np.float32([[1, 2, NAN]]))
    assert (figures["coverage"], figures["bad-4"], figures["avgerr"], figures["a99"]) == (0, 100, INF, INF)
    assert eth3d.score_pair(np.zeros((1, 2)), np.full((1, 2), NAN)) is None
    with pytest.raises(InputError, match="truth must have the size of the map"):
        eth3d.score_pair(np.zeros((1, 2)), np.zeros((1, 3)))
    with pytest.raises(InputError, match="mask must have the size of the truth"):
        eth3d.score_pair(np.zeros((1, 2)), np.zeros((1, 2)), np.ones((2, 2)))


def test_eth3d_gives_pairs_the_same_weight():
    figures = {"a": {"pixels": 9.0, "bad-1": 2.0}, "b": {"pixels": 1.0, "bad-1": 4.0}, "c": None}
    assert eth3d.average(figures) == {"bad-1": 3.0} and eth3d.average({"c": None}) is None


def frame(benchmark, name="Motorcycle"):
    return Frame(name, Path("l"), Path("r"), max_disparity=64, benchmark=benchmark)


def test_a_map_is_scored_dense_and_sparse():
    occ = np.float32([[1, 1, 1, 1, *[NAN] * 6]])
    truth = {"occ": occ, "noc": np.float32([[1, 1, 1, *[NAN] * 7]]), "objects": None}
    disparity, measured = np.float32([[1, 9, 1, 9, *[1] * 6]]), np.array([[True, False, *[True] * 8]])
    result = assess(frame(Benchmark("eth3d")), truth, disparity, measured)
    assert result.official["dense"]["nonocc"]["coverage"] == 100
    assert result.official["dense"]["nonocc"]["bad-4"] == pytest.approx(100 / 3)
    assert result.official["sparse"]["nonocc"]["coverage"] == pytest.approx(200 / 3)
    assert result.official["sparse"]["nonocc"]["bad-4"] == 0 and result.official["sparse"]["all"]["pixels"] == 4
    assert result.score.noc.all.filled.outliers == 1 and result.measures.main.measured == 2
    middlebury_result = assess(frame(Benchmark("middlebury")), truth, disparity, measured).official
    assert middlebury_result["sparse"]["nonocc"]["total_bad-4"] == pytest.approx(100 / 3)
    assert middlebury_result["sparse"]["nonocc"]["bad-4"] == 0
    assert assess(frame(None), truth, disparity, measured).official is None
    without_mask = assess(frame(Benchmark("eth3d")), {**truth, "noc": None}, disparity).official
    assert without_mask["dense"]["nonocc"] is None and without_mask["dense"]["all"]["bad-4"] == 50
    assert assess(frame(Benchmark("eth3d")), {**truth, "occ": None}, disparity).official is None


def test_averages_follow_the_benchmark():
    official = {
        "dense": {"nonocc": {"pixels": 1.0, "bad-2": 8.0}, "all": None},
        "sparse": {"nonocc": None, "all": None},
    }
    other = {"dense": {"nonocc": {"pixels": 1.0, "bad-2": 2.0}, "all": None}, "sparse": {"nonocc": None, "all": None}}
    figures = {"Vintage": official, "Pipes": other, "x": None}
    assert average_official("middlebury", figures)["dense"]["nonocc"]["bad-2"] == (0.5 * 8 + 2) / 1.5
    assert average_official("eth3d", figures)["dense"]["nonocc"]["bad-2"] == 5
    assert average_official("eth3d", {"x": None}) is None


@pytest.mark.data
@pytest.mark.parametrize(("name", "folder"), [("eth3d", "eth3d"), ("middlebury", "middlebury/2014")])
def test_real_masks_say_what_counts(name, folder):
    if not (DATA / folder).is_dir():
        pytest.skip(f"no {folder} in {DATA}; set STEREOKIT_DATA")
    for frame in datasets.load_frames(name, DATA / folder):
        mask = cv2.imread(str(frame.left.with_name("mask0nocc.png")), cv2.IMREAD_GRAYSCALE)
        assert set(np.unique(mask)) <= {0, 128, 255}
        truth = {"noc": frame.load_noc(), "occ": frame.load_occ(), "objects": None}
        figures = assess(frame, truth, truth["occ"] + np.float32(0.75)).official["dense"]
        assert figures["nonocc"]["pixels"] == (np.isfinite(truth["occ"]) & (mask == 255)).sum()
        assert figures["all"]["pixels"] == np.isfinite(truth["occ"]).sum() > figures["nonocc"]["pixels"]
        # 0.75 px is an error of 0.75 px in ETH3D, and of 3 px at the full size of these quarter-size pairs
        assert figures["nonocc"]["avgerr"] == pytest.approx(0.75 if name == "eth3d" else 3.0, abs=1e-3)
        assert figures["all"]["bad-1"] == (0 if name == "eth3d" else 100)
