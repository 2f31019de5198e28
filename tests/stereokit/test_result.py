"""The result of a match: what it checks, its colours and what it passes on."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from stereokit import io
from stereokit.calibration import Calibration
from stereokit.errors import FileError, InputError, OptionError
from stereokit.io import read_disparity
from stereokit.result import Disparity, color_range, colorize

NAN = np.nan
MAP = np.array([[10, 20, NAN], [40, 5, 1]], np.float32)
VALID = np.array([[1, 1, 0], [1, 0, 0]], bool)


def test_a_result_keeps_its_arrays_and_counts_measured_pixels():
    result = Disparity(MAP, VALID, np.ones((2, 3), np.float32), MAP)
    assert result.disparity is MAP
    assert result.density == 0.5
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.disparity = MAP
    assert Disparity(MAP, VALID).confidence is None
    assert Disparity(MAP, VALID).right is None


@pytest.mark.parametrize(
    ("field", "array", "message"),
    [
        ("disparity", MAP.astype(np.float64), "disparity must be float32, got float64"),
        ("disparity", MAP[0], "disparity must be"),
        ("disparity", MAP[:0], "disparity must be"),
        ("disparity", MAP.tolist(), "disparity must be a numpy array, got list"),
        ("valid", VALID.astype(np.uint8), "valid must be bool, got uint8"),
        ("valid", VALID[:1], "valid must have the shape"),
        ("confidence", MAP[:1], "confidence must have the shape"),
        ("right", VALID.astype(np.int16), "right must be float32"),
    ],
)
def test_wrong_arrays_are_named(field, array, message):
    with pytest.raises(InputError, match=message):
        Disparity(**{"disparity": MAP, "valid": VALID, field: array})


def test_depth_and_points_come_from_the_calibration():
    result = Disparity(MAP, VALID)
    calibration = Calibration(fx=100, fy=100, cx0=0, cy=0, baseline_m=0.1)
    np.testing.assert_allclose(result.depth(calibration, filled=True), [[1, 0.5, NAN], [0.25, 2, 10]])
    np.testing.assert_array_equal(np.isfinite(result.depth(calibration)), result.valid & np.isfinite(result.disparity))
    assert result.points(calibration).shape == (2, 3, 3)


@pytest.mark.parametrize("suffix", [".png", ".pfm", ".npy", ".tiff"])
def test_save_follows_the_suffix(tmp_path, suffix):
    Disparity(MAP, VALID).save(tmp_path / f"d{suffix}")
    np.testing.assert_array_equal(read_disparity(tmp_path / f"d{suffix}"), MAP)


def test_save_refuses_other_suffixes(tmp_path):
    with pytest.raises(FileError, match=r"\.png, \.pfm, \.npy, \.tiff"):
        Disparity(MAP, VALID).save(tmp_path / "d.gif")


def test_turbo_runs_from_blue_to_red_and_invalid_is_black():
    colors = colorize(np.array([[0, 50, 100, -7, 200, NAN, np.inf]], np.float32), 0, 100)
    assert colors.shape == (1, 7, 3)
    assert colors.dtype == np.uint8
    # Ends of the published table (Mikhailov 2019): 0.18995, 0.07176, 0.23217; 0.4796, 0.01583, 0.01055
    assert np.abs(colors[0, 0].astype(int) - [48, 18, 59]).max() <= 1
    assert np.abs(colors[0, 2].astype(int) - [122, 4, 3]).max() <= 1
    assert colors[0, 1, 1] > 240  # the middle is green
    np.testing.assert_array_equal(colors[0, 3], colors[0, 0])
    np.testing.assert_array_equal(colors[0, 4], colors[0, 2])
    assert (colors[0, 5:] == 0).all()


def test_the_automatic_range_ignores_the_last_percent():
    disparity = np.arange(1000, dtype=np.float32).reshape(20, 50)
    disparity[-1, -1] = 1e6
    np.testing.assert_array_equal(colorize(disparity), colorize(disparity, 0, float(np.percentile(disparity, 99))))
    result = Disparity(disparity, np.ones_like(disparity, bool))
    np.testing.assert_array_equal(result.color(), colorize(disparity))
    np.testing.assert_array_equal(result.color(min=10, max=30), colorize(disparity, 10, 30))


@pytest.mark.parametrize("value", [NAN, 0, -5, 3])
def test_flat_and_empty_maps_have_colours(value):
    assert colorize(np.full((2, 3), value, np.float32)).shape == (2, 3, 3)


def test_bad_ranges_and_maps_are_refused():
    for low, high in ((5, 5), (5, 1), (NAN, 1), (0, np.inf)):
        with pytest.raises(OptionError, match="above low"):
            colorize(MAP, low, high)
    with pytest.raises(InputError, match="disparity must be"):
        colorize(np.ones((2, 2), int))


def test_inputs_stay_as_they_are():
    strided = np.tile(MAP, (2, 2))[::2, ::-1]
    original = strided.copy()
    colorize(strided)
    np.testing.assert_array_equal(strided, original)


def test_numpy_takes_a_result_as_its_map():
    disparity = np.array([[1.5, np.nan], [40.25, 3]], np.float32)
    result = Disparity(disparity, np.isfinite(disparity))
    assert np.asarray(result) is disparity
    np.testing.assert_array_equal(np.array(result), disparity)
    assert not np.shares_memory(np.array(result), disparity)
    assert np.asarray(result, np.float64).dtype == np.float64
    assert np.nanmax(result) == 40.25
    np.testing.assert_array_equal(np.stack([result, result])[1], disparity)
    if np.lib.NumpyVersion(np.__version__) >= "2.0.0":
        assert np.asarray(result, copy=False) is disparity
        with pytest.raises(ValueError, match="without a copy"):
            np.asarray(result, dtype=np.float64, copy=False)
    assert result.__array__(np.float32, copy=False) is disparity
    assert not np.shares_memory(result.__array__(copy=True), disparity)


def test_a_result_is_told_in_one_line():
    disparity = np.array([[1.5, np.nan], [40.25, 3]], np.float32)
    result = Disparity(disparity, np.isfinite(disparity), confidence=np.zeros((2, 2), np.float32))
    assert repr(result) == "Disparity(2x2, 1.5 .. 40.2 px, 75.0 % measured, confidence)"
    nothing = Disparity(np.full((1, 3), np.nan, np.float32), np.zeros((1, 3), bool))
    assert repr(nothing) == "Disparity(1x3, no disparity, 0.0 % measured)"


def test_the_automatic_range_holds_negative_and_far_disparities():
    spread = np.linspace(0, 127, 4000, dtype=np.float32).reshape(40, 100)
    for low in (-64, -200, 512, 3000):
        values = spread + low
        colors = colorize(values)
        assert len(np.unique(colors.reshape(-1, 3), axis=0)) > 200
        assert color_range(values) == pytest.approx((low + 1.27, low + 125.73), abs=0.1)
    assert color_range(spread) == (0, pytest.approx(125.73, abs=0.1))  # as ever: 0 is dark blue
    assert color_range(np.full((2, 2), NAN, np.float32)) == (0, 1)
    assert color_range(np.full((2, 2), 7, np.float32)) == (0, 7)
    assert color_range(np.full((2, 2), -7, np.float32)) == (-7, -6)


@pytest.mark.parametrize("value", [300.5, 256.0, -0.25])
def test_a_png_refuses_what_it_cannot_say(tmp_path, value):
    values = np.array([[1, value, NAN]], np.float32)
    result = Disparity(values, np.isfinite(values))
    for write in (result.save, lambda path, **options: io.write_disparity(path, values, **options)):
        with pytest.raises(InputError, match=r"255\.996 px .* clip=True"):
            write(tmp_path / "a.png")
        assert not any(tmp_path.iterdir())
        write(tmp_path / "a.png", clip=True)
        end = 65535 / 256 if value > 0 else 1 / 256
        np.testing.assert_array_equal(io.read_disparity(tmp_path / "a.png"), np.float32([[1, end, NAN]]))
        (tmp_path / "a.png").unlink()
        write(tmp_path / "a.pfm")
        np.testing.assert_array_equal(io.read_disparity(tmp_path / "a.pfm"), values)
        (tmp_path / "a.pfm").unlink()


def test_a_notebook_shows_the_map_in_colours():
    """The picture is `color`, whatever has no value black."""
    disparity = np.array([[1, 2, np.nan], [4, 8, 16]], np.float32)
    result = Disparity(disparity, np.isfinite(disparity))
    picture = cv2.imdecode(np.frombuffer(result._repr_png_(), np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    assert np.array_equal(picture, result.color())
    assert not picture[0, 2].any()
