"""Calibration from rendered boards: the cameras that drew them come out, and bad pairs are named."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
import rigs

from stereokit.errors import InputError, OptionError
from stereokit.rig.boards import Board, parse_length
from stereokit.rig.calibrate import calibrate, rows_picture

SIZE = (480, 360)
CHESS, CHARUCO = Board(9, 6, 0.025), Board(7, 5, 0.036, 0.027)
DISTANCES = {"pinhole 5": 0.45, "pinhole 8": 0.45, "fisheye": 0.24}


@functools.cache
def drawn(lens, kind, count, legacy=False):
    """Return the rig that drew the pairs, and pairs of rendered images."""
    truth = rigs.rig_of(lens)
    truth.k = tuple(np.diag([1.5, 1.5, 1]) @ k for k in truth.k)
    if kind == "chess":
        draw, center = rigs.chessboard(9, 6, 0.025)
    else:
        draw, center = rigs.charuco(7, 5, 0.036, 0.027, legacy=legacy)
    pairs = []
    for number in range(count):
        pose = rigs.board_pose(number, count, center, DISTANCES[lens])
        pairs.append((f"{number:02d}", *(rigs.board_image(truth, side, pose, draw, SIZE) for side in (0, 1))))
    return truth, pairs


def check(done, truth, focal_share=0.004, center_px=2.0, baseline_share=0.004, degrees=0.1):
    rig = done.rig
    for camera, k in zip((rig.left, rig.right), truth.k, strict=True):
        assert camera.matrix[0, 0] == pytest.approx(k[0, 0], rel=focal_share)
        assert camera.matrix[1, 1] == pytest.approx(k[1, 1], rel=focal_share)
        assert np.abs(camera.matrix[:2, 2] - k[:2, 2]).max() < center_px
        assert camera.size == SIZE
    assert rig.baseline_m == pytest.approx(np.linalg.norm(truth.t), rel=baseline_share)
    apart = np.linalg.norm(cv2.Rodrigues(rig.rotation @ truth.r.T)[0])
    assert np.degrees(apart) < degrees
    # What matters in the end: true points lie in one row, and at their true depth.
    points = np.random.default_rng(0).uniform([-0.15, -0.12, 0.6], [0.2, 0.12, 1.0], (400, 3))
    rectified = rig.rectification()
    seen = []
    for side in (0, 1):
        pixels = rigs.project(truth, side, points)
        camera = (rig.left, rig.right)[side]
        undistort = cv2.fisheye.undistortPoints if truth.fisheye else cv2.undistortPoints
        seen.append(
            undistort(
                pixels.reshape(-1, 1, 2), camera.matrix, camera.distortion,
                R=rectified.turns[side], P=rectified.projections[side][:, :3],
            ).reshape(-1, 2)
        )  # fmt: skip
    assert np.abs(seen[0][:, 1] - seen[1][:, 1]).max() < 0.5
    depth = rectified.calibration.fx * rectified.calibration.baseline_m / (seen[0][:, 0] - seen[1][:, 0])
    truth_depth = (points @ rectified.turns[0].T)[:, 2]
    assert np.median(np.abs(depth / truth_depth - 1)) < 0.01


@pytest.mark.parametrize("lens", ["pinhole 5", "fisheye"])
def test_a_chessboard_gives_the_cameras_back(lens):
    truth, pairs = drawn(lens, "chess", 12)
    done = calibrate(pairs, CHESS, model="fisheye" if truth.fisheye else "pinhole")
    check(done, truth)
    assert done.reprojection_px < 0.1 and done.epipolar_px < 0.1
    assert done.epipolar_px <= done.epipolar_max_px < 0.5
    used = [pair for pair in done.pairs if not pair.reason]
    assert len(used) >= 8 and all(pair.reprojection_px < 0.5 and pair.epipolar_px < 0.6 for pair in used)
    assert [pair.name for pair in done.pairs] == [name for name, _, _ in pairs]
    assert all("board not found in " in pair.reason for pair in done.pairs if pair.reason)  # they leave the image


@pytest.mark.parametrize("legacy", [False, True])
def test_a_charuco_board_may_be_hidden_in_part(legacy):
    truth, pairs = drawn("pinhole 5", "charuco", 12, legacy)
    hidden = []
    for number, (name, left, right) in enumerate(pairs):
        left = left.copy()
        if number % 3 == 0:
            left[: SIZE[1] // 2 - 10, : SIZE[0] // 2 - 20] = 90
        hidden.append((name, left, right))
    done = calibrate(hidden, CHARUCO)
    check(done, truth, focal_share=0.01, center_px=4, baseline_share=0.01, degrees=0.3)
    assert sum(not pair.reason for pair in done.pairs) >= 9


def test_a_fisheye_with_a_charuco_board():
    truth, pairs = drawn("fisheye", "charuco", 12)
    done = calibrate(pairs, CHARUCO, model="fisheye")
    assert done.rig.left.model == "fisheye"
    check(done, truth, focal_share=0.01, center_px=4, baseline_share=0.01, degrees=0.5)


def test_bad_pairs_are_named_and_left_out():
    truth, pairs = drawn("pinhole 5", "chess", 12)
    good = {name: [left, right] for name, left, right in pairs}
    good["00"][1] = cv2.GaussianBlur(good["00"][1], (0, 0), 4)
    good["04"][0] = np.full_like(good["04"][0], 120)
    moved = good["08"][1]
    good["08"][1] = np.roll(moved, 9, axis=0)  # the board was moved between the two shots
    done = calibrate([(name, *images) for name, images in good.items()], CHESS)
    reasons = {pair.name: pair.reason for pair in done.pairs}
    assert reasons["00"].startswith(("blurred in right: edges are", "board not found in right"))
    assert reasons["04"] == "board not found in left"
    assert reasons["08"].startswith("disagrees with the others: reprojection error ")
    check(done, truth)
    assert any("only" in line and "pairs were used" in line for line in done.doubts)


def test_edges_of_a_blurred_board_are_wide():
    _, pairs = drawn("pinhole 5", "chess", 12)
    blurred = [(name, cv2.GaussianBlur(left, (0, 0), 2.6), right) for name, left, right in pairs]
    with pytest.raises(InputError, match=r"at least 4 pairs must show the board well.*blurred in left"):
        calibrate(blurred, CHESS)


def test_a_few_parallel_boards_in_the_middle_are_doubted():
    truth, _ = drawn("pinhole 5", "chess", 12)
    draw, center = rigs.chessboard(9, 6, 0.025)
    pairs = []
    for number in range(5):
        turn = cv2.Rodrigues(np.array([0.02 * number, 0.05, 0.1 * number]))[0]
        pose = turn, np.array([0.06, 0.0, 0.5 + 0.03 * number]) - turn @ center
        pairs.append((str(number), *(rigs.board_image(truth, side, pose, draw, SIZE) for side in (0, 1))))
    lines = " | ".join(calibrate(pairs, CHESS).doubts)
    for words in ("only 5 pairs were used", "% of the left image; hold it into the corners", "tilted by"):
        assert words in lines


def test_what_cannot_be_calibrated_says_why():
    _, pairs = drawn("pinhole 5", "chess", 12)
    with pytest.raises(
        InputError, match=r"got 0 of 3: 3 board not found in left and right; 8x5 counts the inner corners.*9x6 sq"
    ):
        calibrate(pairs[:3], Board(8, 5, 0.025))
    with pytest.raises(InputError, match="got 1 of 1"):
        calibrate(pairs[:1], CHESS)
    with pytest.raises(InputError, match="at least one pair of images"):
        calibrate([], CHESS)
    name, left, right = pairs[0]
    with pytest.raises(InputError, match="one size, got 480x360 and, in pair '00', 240x180"):
        calibrate([(name, left, right[::2, ::2])], CHESS)
    with pytest.raises(OptionError, match=r"to the left of the left one .*exchanged"):
        calibrate([(name, right, left) for name, left, right in pairs], CHESS)
    for options, words in (
        ({"model": "omni"}, "model must be"),
        ({"coefficients": 6}, "one of 4, 5, 8, 12, 14, got 6"),
    ):
        with pytest.raises(OptionError, match=words):
            calibrate(pairs, CHESS, **options)


def test_boards_are_checked():
    for arguments, words in (
        ((2, 6, 0.02), "columns must be from 3"), ((9, 6, 0), "square_m must be"),
        ((9, 6, 0.02, 0.03), "smaller than a square"),
        ((9, 6, 0.02, 0.01, "4X4_5"), "no dictionary named '4X4_5'; did you mean '4X4_50'"),
    ):  # fmt: skip
        with pytest.raises(OptionError, match=words):
            Board(*arguments)
    assert Board(9, 6, 0.02, 0.01, "DICT_5x5_100").points.shape == (40, 3)
    assert CHESS.points.shape == (54, 3) and CHESS.points[:, 0].max() == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("text", "metres"), [("25mm", 0.025), ("2.5 cm", 0.025), ("0.025m", 0.025), ("1in", 0.0254), (".5cm", 0.005)]
)
def test_lengths_have_units(text, metres):
    assert parse_length("square", text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["25", "mm", "-3mm", "0mm", "25 furlongs", ""])
def test_lengths_without_units_are_refused(text):
    with pytest.raises(OptionError, match="square must be a length with its unit, such as 25mm"):
        parse_length("square", text)


def test_the_picture_has_lines_along_the_rows():
    left, right = np.full((60, 80), 100, np.uint8), np.full((60, 80, 3), 50, np.uint8)
    picture = rows_picture(left, right, lines=5)
    assert picture.shape == (60, 160, 3) and picture.dtype == np.uint8
    changed = [y for y in range(60) if (picture[y, :80] != 100).any()]
    assert set(changed) >= {10, 20, 30, 40, 50} and len(changed) < 20
    assert np.abs(picture[10, 0].astype(int) - picture[10, 159]).max() < 40  # one colour, the ends smoothed
