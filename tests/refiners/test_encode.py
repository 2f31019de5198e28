"""What a network is shown, against the formulas as written in loops."""

from __future__ import annotations

import numpy as np
import oracles
import pytest

from stereokit.errors import OptionError
from stereokit_refiners.encode import FORMS, check_form, encode, half_image

ALL = ("disparity", "image", "valid", "phases")


def given(rows, columns, dtype=np.uint8, seed=0):
    rng = np.random.default_rng(seed)
    disparity = (rng.random((rows, columns)) * 90 - 10).astype(np.float32)
    left = rng.integers(0, 256, (2 * rows, 2 * columns)).astype(dtype)
    return disparity, rng.random((rows, columns)) < 0.5, left


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("size", [(3, 5), (1, 1), (1, 6), (6, 1)])
@pytest.mark.parametrize("form", FORMS)
def test_every_input_against_its_formula(form, size, dtype):
    rows, columns = size
    disparity, valid, left = given(rows, columns, dtype)
    kept = disparity.copy(), valid.copy(), left.copy()
    found = encode(ALL, form, disparity, valid, left)
    assert list(found) == list(ALL)
    gray = (lambda v: v / 255) if form == "literal" else (lambda v: 4 * (v / 255 - 0.4))
    for y in range(rows):
        for x in range(columns):
            d = float(disparity[y, x])
            assert found["disparity"][0, y, x] == pytest.approx(
                d / 256 if form == "literal" else d / 16 - 1.5, abs=1e-6
            )
            assert found["valid"][0, y, x] == (1 if valid[y, x] else -1)
            four = [float(left[2 * y + i, 2 * x + j]) for i in (0, 1) for j in (0, 1)]
            assert found["image"][0, y, x] == pytest.approx(gray(sum(four) / 4), abs=2e-6)
            for k in range(4):
                assert found["phases"][k, y, x] == pytest.approx(gray(four[k]), abs=2e-6)
    for name, channels in {"disparity": 1, "image": 1, "valid": 1, "phases": 4}.items():
        assert found[name].shape == (channels, rows, columns)
        assert found[name].dtype == np.float32
        assert found[name].flags.c_contiguous
    for before, after in zip(kept, (disparity, valid, left), strict=True):
        np.testing.assert_array_equal(before, after)


def test_only_what_is_asked_for_is_made():
    disparity, valid, left = given(4, 4)
    assert list(encode(("valid", "disparity"), "residual", disparity, valid, left)) == ["valid", "disparity"]


def test_half_image_is_the_mean_of_four_without_rounding():
    left = np.random.default_rng(1).integers(0, 256, (8, 14)).astype(np.uint8)
    found = half_image(left)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, oracles.halve(left), atol=1e-4)
    assert half_image(left[:2, :2]).shape == (1, 1)


def test_strided_images_are_read_where_they_are():
    disparity, valid, left = given(4, 6)
    wide = np.zeros((8, 24), np.uint8)
    wide[:, ::2] = left
    plain, strided = (encode(ALL, "residual", disparity, valid, image) for image in (left, wide[:, ::2]))
    for name in ALL:
        np.testing.assert_array_equal(plain[name], strided[name])


def test_forms_are_checked():
    assert [check_form(form) for form in FORMS] == list(FORMS)
    with pytest.raises(OptionError, match=r"^form must be one of residual, literal, got 'printed'$"):
        check_form("printed")
