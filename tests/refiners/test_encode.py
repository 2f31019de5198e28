"""What a network is shown, against the formulas as written in loops."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
from refining import one_line

from stereokit.errors import OptionError
from stereokit_refiners.runtimes.encode import encode, half_image

ALL = ("disparity", "image", "confidence", "candidates", "phases")


def arguments(rows, columns, dtype=np.uint8, seed=0):
    rng = np.random.default_rng(seed)
    disparity = (rng.random((rows, columns)) * 90 - 10).astype(np.float32)
    left = rng.integers(0, 256, (2 * rows, 2 * columns)).astype(dtype)
    confidence = rng.random((rows, columns), np.float32)
    confidence[rng.random((rows, columns)) < 0.3] = 0
    candidates = (rng.random((2, rows, columns)) * 90 - 10).astype(np.float32)
    return disparity, left, confidence, candidates


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("size", [(3, 5), (1, 1), (1, 6), (6, 1)])
@pytest.mark.parametrize("unit", [False, True])
def test_every_input_against_its_formula(unit, size, dtype):
    rows, columns = size
    disparity, left, confidence, candidates = arrays = arguments(rows, columns, dtype)
    original = [array.copy() for array in arrays]
    actual = encode(ALL, unit, disparity, left, confidence, candidates)
    assert list(actual) == list(ALL)
    gray = (lambda v: v / 255) if unit else (lambda v: 4 * (v / 255 - 0.4))
    for y in range(rows):
        for x in range(columns):
            pixels = [*candidates[:, y, x], disparity[y, x]]
            scaled = [float(d) / 256 if unit else float(d) / 16 - 1.5 for d in pixels]
            assert actual["disparity"][0, y, x] == pytest.approx(scaled[2], abs=1e-6)
            assert list(actual["candidates"][:, y, x]) == pytest.approx(scaled[:2], abs=1e-6)
            assert actual["confidence"][0, y, x] == pytest.approx(4 * float(confidence[y, x]) - 2, abs=1e-6)
            four = [float(left[2 * y + i, 2 * x + j]) for i in (0, 1) for j in (0, 1)]
            assert actual["image"][0, y, x] == pytest.approx(gray(sum(four) / 4), abs=2e-6)
            for k in range(4):
                assert actual["phases"][k, y, x] == pytest.approx(gray(four[k]), abs=2e-6)
    for name, channels in {"disparity": 1, "image": 1, "confidence": 1, "candidates": 2, "phases": 4}.items():
        assert actual[name].shape == (channels, rows, columns)
        assert actual[name].dtype == np.float32
        assert actual[name].flags.c_contiguous
    for before, after in zip(original, arrays, strict=True):
        np.testing.assert_array_equal(before, after)


def test_only_what_is_asked_for_is_made():
    names = ("confidence", "disparity")
    assert list(encode(names, False, *arguments(4, 4))) == list(names)


@pytest.mark.parametrize("unit", [False, True])
def test_what_was_not_measured_is_minus_2_and_what_is_certain_2(unit):
    confidence = np.float32([[0, 0.5, 1]])
    actual = encode(("confidence",), unit, np.zeros((1, 3), np.float32), np.zeros((2, 6), np.uint8), confidence)
    np.testing.assert_array_equal(actual["confidence"], [[[-2, 0, 2]]])


@pytest.mark.parametrize("missing", ["confidence", "candidates"])
def test_what_is_missing_is_refused_only_where_it_is_looked_at(missing):
    disparity, left, confidence, candidates = arguments(4, 4)
    evidence = {"confidence": confidence, "candidates": candidates}
    names = tuple(name for name in ALL if name != missing)
    without, beside = (encode(names, False, disparity, left, **{**evidence, missing: m}) for m in
                       (None, evidence[missing]))  # fmt: skip
    for name in names:
        np.testing.assert_array_equal(without[name], beside[name])
    with pytest.raises(OptionError) as caught:
        encode(ALL, False, disparity, left, **{**evidence, missing: None})
    rule = f"coarse must come with {missing} for this refiner, as stereokit.Matcher gives it, got none"
    assert one_line(caught.value) == rule


def test_half_image_is_the_mean_of_four_without_rounding():
    left = np.random.default_rng(1).integers(0, 256, (8, 14)).astype(np.uint8)
    actual = half_image(left)
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, oracles.halve(left), atol=1e-4)
    assert half_image(left[:2, :2]).shape == (1, 1)


def test_strided_images_are_read_where_they_are():
    disparity, left, *evidence = arguments(4, 6)
    wide = np.zeros((8, 24), np.uint8)
    wide[:, ::2] = left
    plain, strided = (encode(ALL, False, disparity, image, *evidence) for image in (left, wide[:, ::2]))
    for name in ALL:
        np.testing.assert_array_equal(plain[name], strided[name])
