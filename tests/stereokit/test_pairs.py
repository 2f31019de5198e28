"""What is wrong with a pair: geometry that is known exactly, planes and slopes of noise, looked at from both sides."""

from __future__ import annotations

import json

import cv2
import numpy as np
import oracles
import pytest
from typer.testing import CliRunner

import stereokit
from stereokit import align_rows, check_pair
from stereokit.checks import PairWatch
from stereokit.cli.app import app
from stereokit.errors import InputError, OptionError
from stereokit.images.gray import gray_pair
from stereokit.io import write_image
from stereokit.pairs import KINDS
from stereokit.pairs.features import Matches
from stereokit.pairs.rows import fit_rows
from stereokit.pairs.signs import map_signs
from stereokit.result import Disparity

HEIGHT, WIDTH = 240, 400


def _noise(seed, height, width):
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(0, 1, (height, width)), (0, 0), sigma) * sigma for sigma in (1.2, 3, 7)]
    total = np.add.reduce(layers)
    return ((total - total.min()) / np.ptp(total) * 250 + 2).astype(np.uint8)


def scene(offset=0.0, roll=0.0, seed=0, shift=0):
    """Return two views of a slanted plane: disparities from 8 to 40 down the image, plus `shift`."""
    left = _noise(seed, HEIGHT, WIDTH + 120)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    angle = np.radians(roll)
    # The right view's pixel (x, y) shows what the unturned one has at (u, v).
    u = (x - WIDTH / 2) * np.cos(angle) + (y - offset - HEIGHT / 2) * np.sin(angle) + WIDTH / 2
    v = -(x - WIDTH / 2) * np.sin(angle) + (y - offset - HEIGHT / 2) * np.cos(angle) + HEIGHT / 2
    disparity = 8 + 32 * v / HEIGHT + shift
    right = cv2.remap(left, (u + disparity + 60).astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC)
    return np.ascontiguousarray(left[:, 60 : 60 + WIDTH]), right


def kinds(report):
    return {fault.kind for fault in report.faults}


def test_a_good_pair_has_no_faults():
    left, right = scene()
    for quick in (False, True):
        report = check_pair(left, right, max_disparity=64, quick=quick)
        assert report.faults == () and report.rows_known
        assert abs(report.row_offset) < 0.1 and abs(report.roll) < 0.03 and abs(report.scale - 1) < 1e-3
        assert report.points > 50 and report.agreement > 0.8
        assert 7 < report.disparities[0] < 12 and 36 < report.disparities[1] < 41
        assert 0.9 < report.brightness < 1.1 and report.blank < 1e-3


@pytest.mark.parametrize("kind", [np.uint16, np.float32, np.float64])
def test_any_type_tells_the_same(kind):
    left, right = (view.astype(kind) * kind(40) for view in scene(offset=3))
    assert kinds(check_pair(left, right, max_disparity=64)) == {"rows"}
    colors = check_pair(*(np.dstack([view] * 3) for view in (left, right)), max_disparity=64)
    assert colors.row_offset == pytest.approx(3, abs=0.15)


@pytest.mark.parametrize("offset", [-12.0, -2.0, -1.0, 1.0, 1.5, 6.0])
def test_row_offsets_are_measured(offset):
    report = check_pair(*scene(offset=offset), max_disparity=64)
    assert kinds(report) == {"rows"} and report.row_offset == pytest.approx(offset, abs=0.12)
    (fault,) = report.faults
    assert fault.serious and ("lower" if offset > 0 else "higher") in fault.message and "\n" not in fault.message
    assert ("--align" in fault.message) == (abs(offset) < 2)


@pytest.mark.parametrize("roll", [-2.0, -0.5, 0.4, 1.0])
def test_rolls_are_measured(roll):
    report = check_pair(*scene(roll=roll), max_disparity=64)
    assert "rows" in kinds(report) and report.roll == pytest.approx(roll, abs=0.06)
    assert f"{report.roll:+.2f} degrees" in report.faults[0].message


def test_views_that_are_not_left_and_right():
    left, right = scene()
    other = _noise(9, HEIGHT, WIDTH)
    cases = {
        "exchanged": [(right, left), (left[::-1, ::-1], right[::-1, ::-1])],
        "same": [(left, left), (left, cv2.GaussianBlur(left, (0, 0), 0.5))],
        "mirrored": [(left, right[:, ::-1]), (left[:, ::-1], right), (left, right[::-1])],
        "rotated": [(left, right[::-1, ::-1])],
        "unrelated": [(left, other)],
    }
    for kind, pairs in cases.items():
        for one, two in pairs:
            assert kinds(check_pair(one, two, max_disparity=64)) == {kind}, kind
    for fault in check_pair(right, left, max_disparity=64).faults:
        assert "other way round" in fault.message
    assert kinds(check_pair(right, left, max_disparity=64, min_disparity=-64)) == set()


@pytest.mark.parametrize(
    ("levels", "end"), [((0, 24), "above"), ((24, 80), "below"), ((16, 32), "below and"), ((60, 90), "below")]
)
def test_the_range_that_would_fit(levels, end):
    low, high = levels
    (fault,) = check_pair(*scene(), min_disparity=low, max_disparity=high).faults
    assert fault.kind == "range" and end in fault.message
    words = dict(part.split("=") for part in fault.message.replace(",", "").split() if "=" in part)
    assert int(words["min_disparity"]) <= 10 and 38 <= int(words["max_disparity"]) <= max(high, 56)
    good = check_pair(*scene(), **{name: int(value) for name, value in words.items()})
    assert not good.faults


def test_light_sharpness_and_blank_areas_are_notes():
    left, right = scene()
    for changed, kind in (
        ((left, (right / 2).astype(np.uint8)), "exposure"),
        ((left, cv2.GaussianBlur(right, (0, 0), 2)), "sharpness"),
        ((np.where(np.arange(WIDTH) < 220, 128, left).astype(np.uint8), right), "blank"),
        ((np.where(np.arange(WIDTH) < 160, 255, left).astype(np.uint8), right), "saturated"),
    ):
        faults = check_pair(*changed, max_disparity=64).faults
        assert kind in {fault.kind for fault in faults}
        assert not any(fault.serious for fault in faults)
    assert set(KINDS) >= {"exposure", "rows"}


def test_what_cannot_be_told_is_not_told():
    flat = np.full((50, 60), 90, np.uint8)
    report = check_pair(flat, flat + 1)
    assert not report.rows_known and report.points == 0 and report.row_errors() == 0
    assert not any(fault.serious for fault in report.faults)
    for shape in ((1, 1), (3, 2), (2, 300)):
        rng = np.random.default_rng(0)
        report = check_pair(rng.integers(0, 256, shape, np.uint8), rng.integers(0, 256, shape, np.uint8))
        assert not report.rows_known


def test_what_holds_nothing_is_not_white():
    nothing = np.full((30, 40), np.nan, np.float32)
    some = np.where(np.arange(40) < 20, np.nan, scene()[0][:30, :40].astype(np.float32))
    for pair in ((nothing, nothing), (some, nothing), (nothing, some)):
        assert kinds(check_pair(*pair)) == {"unusable"}
    black = check_pair(np.zeros((30, 40), np.uint8), np.ones((30, 40), np.uint8))
    assert (black.saturated, black.blank) == (0, 1) and kinds(black) == {"blank"}
    left, right = (view.astype(np.float32) for view in scene())
    left[:, : WIDTH // 2] = np.nan  # what is filled in there has no texture
    half = check_pair(left, right, max_disparity=64)
    assert half.blank < 0.05 and half.saturated < 0.05


def test_bad_input_is_one_line():
    left, right = scene()
    for error, words, call in (
        (InputError, "same size", lambda: check_pair(left, right[:, 1:])),
        (InputError, "None", lambda: check_pair(None, right)),
        (OptionError, "above min_disparity=5", lambda: check_pair(left, right, min_disparity=5, max_disparity=5)),
        (OptionError, "quick", lambda: check_pair(left, right, quick=1)),
    ):
        with pytest.raises(error, match=words) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_masked_pixels_have_no_features():
    """A picture of another scene under transparent pixels tells nothing."""
    left, right = scene(offset=2)
    half = np.arange(WIDTH) < WIDTH // 2
    rgba = [np.dstack([np.where(half, 7, view)] * 3 + [np.where(half, 0, 255) + 0 * view]) for view in (left, right)]
    report = check_pair(*(view.astype(np.uint8) for view in rgba), max_disparity=64)
    assert kinds(report) == {"rows"} and report.row_offset == pytest.approx(2, abs=0.2)


def test_rows_are_fitted_exactly_and_outliers_left():
    rng = np.random.default_rng(2)
    left = rng.uniform((0, 0), (600, 400), (200, 2))
    right = left - np.column_stack([rng.uniform(5, 60, 200), np.zeros(200)])
    middle = (left + right) / 2 - (299.5, 199.5)
    right[:, 1] += 1.5 + 0.01 * middle[:, 0] - 0.002 * middle[:, 1]
    right[:70] = rng.uniform((0, 0), (600, 400), (70, 2))
    rows = fit_rows(Matches(left, right, np.zeros(200)), 400, 600, 0.5)
    assert (rows.offset, rows.roll, rows.scale) == pytest.approx((1.5, 0.01, -0.002), abs=2e-3)
    assert rows.agreeing[70:].all() and rows.agreeing[:70].sum() < 5
    assert rows.worst(400, 600) == pytest.approx(1.5 + 3 + 0.4, abs=0.1)
    assert fit_rows(Matches(left[:11], right[:11], np.zeros(11)), 400, 600, 0.5) is None
    assert fit_rows(Matches(left[:1].repeat(20, 0), left[:1].repeat(20, 0), np.zeros(20)), 400, 600, 0.5) is None


def offset_of(pair, disparity, valid):
    return map_signs(pair, disparity, valid, 0, 64).offset


@pytest.mark.parametrize("offset", [-0.3, -0.1, 0.0, 0.2, 0.3])
def test_rows_are_measured_without_features(offset):
    left, right = scene(offset=offset)
    truth = np.broadcast_to(8 + 32 * np.arange(HEIGHT, dtype=np.float32)[:, None] / HEIGHT, left.shape)
    valid = np.arange(WIDTH)[None, :] > 50 + 0 * truth
    assert offset_of(gray_pair(left, right), truth, valid) == pytest.approx(offset, abs=0.12)
    pair = gray_pair(left.astype(np.float32) * 9.5, right.astype(np.float32) * 9.5)
    assert offset_of(pair, truth, valid) == pytest.approx(offset, abs=0.12)
    further = offset_of(gray_pair(*scene(offset=1 if offset > 0 else -1)), truth, valid)
    assert abs(further) > 0.4 and (further > 0) == (offset > 0)
    assert offset_of(gray_pair(left, right), truth, np.zeros_like(valid)) is None
    tiny = np.zeros((8, 9), np.uint8)
    assert offset_of(gray_pair(tiny, tiny), np.zeros((8, 9), np.float32), np.ones((8, 9), bool)) is None


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("stripes", [False, True])
def test_the_rows_of_few_points_are_those_of_the_oracle(dtype, stripes):
    """With stripes across, only the slope down tells, and the median is over the points that tell by it alone."""
    rng = np.random.default_rng(4)
    factor = 1 if dtype == np.uint8 else 150
    left = rng.integers(0, 256, (60, 90)) * factor
    if stripes:
        left[:] = np.repeat(rng.integers(0, 256, (60, 1)) * factor, 90, axis=1)
    left = cv2.GaussianBlur(left.astype(dtype), (0, 0), 1)
    right = cv2.warpAffine(left, np.array([[1, 0, -4.5], [0, 1, 0.4]]), (90, 60))
    disparity = rng.uniform(4, 5, left.shape).astype(np.float32)
    valid = rng.random(left.shape) < 0.8
    pair = gray_pair(left, right)
    scale = 1.0 if dtype == np.uint8 else 255 / (pair.span[1] - pair.span[0])
    shifts = oracles.row_shifts(pair.left, pair.right, disparity, valid, scale)
    regular = [shift for shift, is_regular in shifts if is_regular]
    assert len(shifts) == 200 and (len(regular) < 30) == stripes
    expected = np.median(regular if not stripes else [shift for shift, _ in shifts])
    assert offset_of(pair, disparity, valid) == pytest.approx(expected, abs=1e-4) and abs(expected) > 0.1
    few = valid & (np.arange(90) < 12)
    few[:, :9] = False
    shifts = oracles.row_shifts(pair.left, pair.right, disparity, few, scale)
    offset = offset_of(pair, disparity, few)
    assert 30 <= len(shifts) < 200 and offset == pytest.approx(
        np.median([shift for shift, is_regular in shifts if is_regular or stripes]), abs=1e-4
    )


def test_a_turned_view_shows_in_the_halves_of_the_map():
    truth = np.broadcast_to(8 + 32 * np.arange(HEIGHT, dtype=np.float32)[:, None] / HEIGHT, (HEIGHT, WIDTH))
    valid = np.arange(WIDTH)[None, :] > 50 + 0 * truth
    straight, turned = (
        map_signs(gray_pair(*scene(roll=roll)), np.ascontiguousarray(truth), valid, 0, 64) for roll in (0.0, 0.1)
    )
    assert straight.tilt < 0.1 and straight.spread < 0.1
    apart = np.tan(np.radians(0.1)) * (WIDTH - 50) / 2  # of the middles of the halves
    assert turned.tilt == pytest.approx(apart, abs=0.12) and abs(turned.offset) < 0.15


def test_shares_at_the_ends_of_the_range_and_at_zero():
    values = np.array([-0.2, 0.2, 5, 9, 9.4, 9.6, 30, 61.4, 61.6, 63], np.float32)
    disparity = np.ascontiguousarray(np.broadcast_to(np.repeat(values, 20), (50, 200)))
    pair = gray_pair(*(np.full((50, 200), value, np.uint8) for value in (9, 10)))
    valid = np.ones(disparity.shape, bool)
    valid[:, :20] = False  # -0.2
    signs = map_signs(pair, disparity, valid, 8, 64)
    assert signs.offset is None and (signs.spread, signs.tilt) == (0, 0)
    assert (signs.low, signs.high, signs.still) == pytest.approx((4 / 9, 2 / 9, 1 / 9), abs=0.03)
    empty = map_signs(pair, disparity, np.zeros_like(valid), 8, 64)
    assert (empty.low, empty.high, empty.still) == (0, 0, 0)


@pytest.mark.parametrize(("offset", "roll"), [(1.0, 0.0), (-1.3, 0.0), (0.5, 0.3)])
def test_small_offsets_are_aligned(offset, roll):
    left, right = scene(offset=offset, roll=roll)
    aligned, report = align_rows(left, right)
    assert report.row_offset == pytest.approx(offset, abs=0.12) and aligned.dtype == right.dtype
    after = check_pair(left, aligned, max_disparity=64)
    assert after.faults == () and after.row_errors() < 0.2
    wide, _ = align_rows(*(np.dstack([view.astype(np.float32)] * 3) for view in (left, right)))
    assert wide.shape == (HEIGHT, WIDTH, 3) and wide.dtype == np.float32


def test_what_is_not_aligned():
    left, right = scene()
    same, _ = align_rows(left, right)
    assert np.abs(same.astype(int) - right).mean() < 2
    for pair, words in (
        (scene(offset=5), "less than 2 px can be aligned: rectify"),
        ((left, np.full_like(left, 9)), "cannot be aligned: only 0 points"),
    ):
        with pytest.raises(InputError, match=words):
            align_rows(*pair)


@pytest.mark.parametrize(
    ("kind", "views", "levels"),
    [
        ("rows", scene(roll=0.4), (0, 64)),
        ("same", (scene()[0], cv2.GaussianBlur(scene()[0], (0, 0), 0.5)), (0, 64)),
        ("range", scene(), (0, 32)),
        ("range", scene(), (20, 84)),
    ],
)
def test_dense_maps_of_bad_pairs_have_signs(kind, views, levels):
    """Nothing is wrong with their density, nor with the median of their rows."""
    low, high = levels
    matcher = stereokit.Matcher("S2", min_disparity=low, max_disparity=high)
    pair = gray_pair(*views)
    result = matcher.match_gray(pair, 1)
    assert result.density > 0.5
    assert [fault.kind for fault in PairWatch().faults(pair, result, low, high)] == [kind]


def test_why_a_density_is_low():
    """The reason comes first; a pair that looks right is told of where hardly anything was measured."""
    left, right = scene()
    pair, blurred = gray_pair(left, right), gray_pair(cv2.GaussianBlur(left, (0, 0), 3), right)
    valid = np.random.default_rng(0).random(left.shape)
    for views, share, words in (
        (blurred, 0.2, "only 20 % of the pixels could be measured: the left view is the less sharp one"),
        (pair, 0.05, "only 5.0 % of the pixels could be measured, though rows and range look right"),
        (pair, 0.2, None),
    ):
        result = Disparity(np.zeros(left.shape, np.float32), valid < share)
        watch = PairWatch()
        for _ in range(4):  # the third time it is not looked at closely
            faults = watch.faults(views, result, 0, 64)
            assert [fault.message.startswith(words) for fault in faults if words] == ([True] if words else [])
            assert words is not None or faults == []
            if views is blurred:
                break


def test_a_matcher_warns_with_the_remedy():
    left, right = scene(offset=1)
    matcher = stereokit.Matcher("S2", max_disparity=64)
    with pytest.warns(stereokit.PairWarning, match=r"right view lies 1\.\d px lower.*--align|right view lies 0\.9 px"):
        bad = matcher(left, right)
    good = matcher(left, align_rows(left, right)[0])
    assert good.density > bad.density


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_the_command_tells_and_its_exit_status_says_it(tmp_path):
    for name, view in zip(("left", "right", "low"), (*scene(), scene(offset=1)[1]), strict=True):
        write_image(tmp_path / f"{name}.png", view)
    good = run("check", tmp_path / "left.png", tmp_path / "right.png", "--max-disparity", 64)
    assert good.exit_code == 0 and "Common" in good.output and "fault" not in good.output
    bad = run(
        "check", tmp_path / "left.png", tmp_path / "low.png", "--max-disparity", 64, "--json", tmp_path / "c.json"
    )
    assert bad.exit_code == 1 and "fault: rows do not meet" in bad.output
    report = json.loads((tmp_path / "c.json").read_text())
    assert report["faults"][0]["kind"] == "rows" and report["row_offset"] == pytest.approx(1, abs=0.12)
    assert run("check", tmp_path / "left.png", tmp_path / "none.png").exit_code == 2


def test_match_is_strict_or_aligns_on_demand(tmp_path):
    left, low = scene(offset=1)
    write_image(tmp_path / "left.png", left)
    write_image(tmp_path / "low.png", low)
    words = ("match", tmp_path / "left.png", tmp_path / "low.png", "-o", tmp_path / "d.pfm", "--max-disparity", 64)
    relaxed = run(*words)
    assert relaxed.exit_code == 0 and relaxed.output.count("warning: rows do not meet") == 1
    (tmp_path / "d.pfm").unlink()
    strict = run(*words, "--strict")
    assert strict.exit_code == 2 and "error: rows do not meet" in strict.output and not (tmp_path / "d.pfm").exists()
    aligned = run(*words, "--align", "--strict")
    assert (
        aligned.exit_code == 0 and "aligned: the right view lay +" in aligned.output and (tmp_path / "d.pfm").exists()
    )
