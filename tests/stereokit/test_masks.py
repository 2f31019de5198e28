"""Pixels without evidence: masked, transparent, of no data or of a black border, they are never measured nor filled."""

from __future__ import annotations

import tracemalloc
import warnings

import cv2
import numpy as np
import pytest

import stereokit
from stereokit import Matcher
from stereokit.errors import InputError
from stereokit.images.blank import blank_pixels
from stereokit.images.evidence import black_border
from stereokit.io import read_image, read_pair, write_image
from stereokit.large.border import find_border
from stereokit.large.sources import open_source
from stereokit.notices import collecting

HEIGHT, WIDTH, DISPARITY = 60, 160, 7
_NOISE = cv2.GaussianBlur(np.random.default_rng(1).normal(128, 80, (HEIGHT, WIDTH + 40)), (0, 0), 0.9)
TEXTURE = _NOISE.clip(1, 255).astype(np.uint8)
LEFT, RIGHT = TEXTURE[:, 20 : 20 + WIDTH], TEXTURE[:, 20 + DISPARITY : 20 + DISPARITY + WIDTH]
Y, X = np.mgrid[:HEIGHT, :WIDTH]
OPTIONS = {"max_disparity": 32}


def wedges(share):
    """Return usable pixels of both views: wedges of other shapes at both sides, about `share` of the image."""
    wide = 2 * share * WIDTH
    left = (X >= wide * 0.6 * (1 - Y / HEIGHT)) & (X < WIDTH - wide * 0.4 * Y / HEIGHT)
    right = (X >= wide * 0.5 * Y / HEIGHT) & (X < WIDTH - wide * 0.5 * (1 - Y / HEIGHT))
    return left, right


def blackened(image, usable):
    return np.where(usable, image, 0).astype(image.dtype)


def quietly(matcher, *pair, **masks):
    with collecting():
        return matcher(*pair, **masks)


@pytest.mark.parametrize("method", ["S1", "S2", "S3", "S4"])
@pytest.mark.parametrize("share", [0.1, 0.3])
def test_black_wedges_are_what_masks_are(method, share):
    left, right = wedges(share)
    assert 0.6 * share < 1 - left.mean() < 1.4 * share
    pair = blackened(LEFT, left), blackened(RIGHT, right)
    for options in ({}, {"fill": None}, {"min_disparity": -9}, {"scale": 0.5}, {"confidence": True}):
        matcher = Matcher(method, **OPTIONS, **options)
        result = quietly(matcher, *pair)
        masked = quietly(matcher, LEFT, RIGHT, mask=left, right_mask=right)
        np.testing.assert_array_equal(result.disparity, masked.disparity)
        assert not result.valid[~left].any() and np.isnan(result.disparity[~left]).all()
        assert np.isfinite(result.disparity[left]).all() or options == {"fill": None}
        inner = left & (X > 40) & (X < WIDTH - 40)
        assert np.median(np.abs(result.disparity[inner & result.valid] - DISPARITY)) < 0.5
        if options == {"confidence": True}:
            assert not result.confidence[~left].any()


@pytest.mark.parametrize("method", ["S2", "S4"])
def test_what_is_masked_does_not_matter(method):
    """Whatever stands under the mask, in any type, the map is the same."""
    left, right = wedges(0.2)
    matcher = Matcher(method, **OPTIONS)
    for kind, junk in ((np.uint8, 255), (np.uint16, 65535), (np.float32, np.nan), (np.float32, -1e30)):
        views = [view.astype(kind) for view in (LEFT, RIGHT)]
        spoiled = [np.where(mask, view, junk).astype(kind) for view, mask in zip(views, (left, right), strict=True)]
        one = quietly(matcher, *views, mask=left, right_mask=right)
        other = quietly(matcher, *spoiled, mask=left, right_mask=right)
        np.testing.assert_array_equal(one.disparity, other.disparity)
        np.testing.assert_array_equal(one.valid, other.valid)


def test_half_and_all_masked():
    matcher = Matcher("S2", **OPTIONS)
    result = quietly(matcher, LEFT, RIGHT, mask=X >= WIDTH // 2)
    assert not result.valid[:, : WIDTH // 2].any() and np.isnan(result.disparity[:, : WIDTH // 2]).all()
    assert result.valid[:, WIDTH // 2 + 20 :].mean() > 0.9
    np.testing.assert_array_equal(
        matcher(LEFT, RIGHT, mask=np.ones(LEFT.shape, bool)).disparity, matcher(LEFT, RIGHT).disparity
    )
    nothing = np.zeros(LEFT.shape, bool)
    for method, options in (("S1", {}), ("S2", {"scale": 0.5}), ("S3", {"fill": None}), ("S4", {"right": True})):
        with pytest.warns(stereokit.PairWarning, match="no pixel is usable"):
            result = Matcher(method, **OPTIONS, **options)(LEFT, RIGHT, mask=nothing, right_mask=nothing)
        assert not result.valid.any() and np.isnan(result.disparity).all()
        assert result.right is None or np.isnan(result.right).all()
    with collecting() as lines:
        result = Matcher("S2", **OPTIONS)(LEFT.astype(np.float32), RIGHT.astype(np.float32), mask=nothing)
    assert np.isnan(result.disparity).all() and lines


def test_the_right_view_s_map_has_the_right_mask():
    result = quietly(Matcher("S2", right=True, **OPTIONS), LEFT, RIGHT, right_mask=X < 100)
    assert np.isnan(result.right[:, 100:]).all() and np.isfinite(result.right[:, :100]).all()
    assert np.isfinite(result.disparity).all()


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.ones((HEIGHT, WIDTH - 1), bool), ["size of the images", str((HEIGHT, WIDTH - 1))]),
        (np.ones((HEIGHT, WIDTH), np.uint8), ["bool", "uint8", "mask > 0"]),
        (np.ones((HEIGHT, WIDTH, 3), bool), ["size of the images"]),
        ([[True] * WIDTH] * HEIGHT, ["array", "bool"]),
        ("mask.png", ["array", "mask.png"]),
    ],
)
def test_a_mask_that_is_none_is_refused_in_one_line(mask, words, tmp_path):
    for name in ("mask", "right_mask"):
        with pytest.raises(InputError) as caught:
            stereokit.match(LEFT, RIGHT, **OPTIONS, **{name: mask})
        message = str(caught.value)
        assert name in message and all(word in message for word in words) and "\n" not in message
    if not isinstance(mask, str):
        with pytest.raises(InputError, match="mask"):
            stereokit.match_large(LEFT, RIGHT, tmp_path / "map.npy", mask=mask, **OPTIONS)


def test_match_and_map_take_masks():
    left, right = wedges(0.2)
    matcher = Matcher("S2", threads=2, **OPTIONS)
    expected = quietly(matcher, LEFT, RIGHT, mask=left, right_mask=right).disparity
    with collecting():
        one = stereokit.match(LEFT, RIGHT, "S2", mask=left, right_mask=right, **OPTIONS)
        many = list(matcher.map([(LEFT, RIGHT)] * 3, mask=left, right_mask=right))
    for result in (one, *(result.disparity for result in many)):
        np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize("method", ["S2", "S4"])
@pytest.mark.parametrize("fill", ["nearest", None])
def test_match_large_honours_masks_and_borders(method, fill, tmp_path):
    left, right = wedges(0.2)
    flat = LEFT.copy()
    flat[20:45, 60:100] = 200
    cases = {
        "mask": ((flat, RIGHT), {"mask": left, "right_mask": right}),
        "border": ((blackened(flat, left), blackened(RIGHT, right)), {}),
    }
    write_image(tmp_path / "mask.png", left.astype(np.uint8) * 255)
    np.save(tmp_path / "mask.npy", right)
    cases["files"] = ((flat, RIGHT), {"mask": tmp_path / "mask.png", "right_mask": tmp_path / "mask.npy"})
    with collecting():
        expected = stereokit.match(flat, RIGHT, method, mask=left, right_mask=right, fill=fill, **OPTIONS)
        for pair, masks in cases.values():
            stereokit.match_large(*pair, tmp_path / "map.npy", method, fill=fill, **OPTIONS, **masks)
            np.testing.assert_array_equal(np.load(tmp_path / "map.npy"), expected)


@pytest.mark.parametrize("rows", [1, 2, 3, 7, 40, 100])
def test_borders_of_blocks_are_those_of_the_image(rows):
    """Of wedges, frames, blobs and sprinkles of zeros, in one to forty blocks: those that the whole image has."""
    rng = np.random.default_rng(rows)
    kinds = set()
    for number in range(40):
        height, width = (int(size) for size in rng.integers(1, 41, 2))
        image = rng.integers(1, 256, (height, width), np.uint8)
        y, x = np.mgrid[:height, :width]
        for _ in range(rng.integers(0, 5)):
            a, b, c = rng.normal(0, 1, 3)
            image[a * y + b * x > (abs(a) * height + abs(b) * width) * (0.5 + 0.3 * c)] = 0
        image[rng.random(image.shape) < rng.choice([0, 0.1, 0.6])] = rng.choice([0, 9])
        if number % 3 == 0:
            image = np.dstack([image, image, rng.choice([0, 1]) * image])
        expected = black_border(image)
        border = find_border(open_source("left", image), rows * width * 32)
        kinds.add((expected is None, rows < height))
        if expected is None:
            assert border is None
            continue
        for _ in range(4):
            y0, x0 = int(rng.integers(0, height)), int(rng.integers(0, width))
            y1, x1 = int(rng.integers(y0, height)) + 1, int(rng.integers(x0, width)) + 1
            part = border.window(y0, y1, x0, x1)
            np.testing.assert_array_equal(np.zeros((y1 - y0, x1 - x0), bool) if part is None else part,
                                          expected[y0:y1, x0:x1])  # fmt: skip
    assert {(True, rows < 40), (False, rows < 40)} <= kinds


def test_black_specks_take_no_memory():
    """Of a fifth of the pixels that are black, here and there, none is kept in mind."""
    image = np.random.default_rng(0).integers(0, 5, (1000, 1000), np.uint8)
    image[:, :30] = 0
    tracemalloc.start()
    border = find_border(open_source("left", image), 2**20)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert border.window(0, 1000, 0, 30).all() and peak < 4e6


def test_a_black_object_is_no_border_in_a_window(tmp_path, monkeypatch):
    """Blocks of few rows cut through a black square inside the image and through thin parts of a wedge."""
    left, right = wedges(0.1)
    pair = [blackened(view, usable) for view, usable in ((LEFT, left), (RIGHT, right))]
    pair[0][20:45, 60:100] = 0
    monkeypatch.setattr("stereokit.large.intensity.BLOCK_NBYTES", 5 * WIDTH)
    monkeypatch.setattr("stereokit.large.matching.BLOCK_NBYTES", 5 * WIDTH)
    with collecting():
        expected = stereokit.match(*pair, **OPTIONS)
        stereokit.match_large(*pair, tmp_path / "map.npy", **OPTIONS)
    assert np.isfinite(expected[20:45, 60:100]).all() and np.isnan(expected[~left]).all()
    np.testing.assert_array_equal(np.load(tmp_path / "map.npy"), expected)


def test_transparent_pixels_are_masked(tmp_path):
    left, right = wedges(0.2)
    for name, view, usable in (("left", LEFT, left), ("right", RIGHT, right)):
        junk = np.where(usable, view, 77)
        rgba = np.dstack([junk, junk, junk, usable * 255]).astype(np.uint8)
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), rgba)
    pair = read_pair(tmp_path / "left.png", tmp_path / "right.png", alpha=True)
    assert pair[0].shape == (HEIGHT, WIDTH, 4) and read_image(tmp_path / "left.png").shape == (HEIGHT, WIDTH, 3)
    result = quietly(Matcher("S2", **OPTIONS), *pair).disparity
    expected = quietly(Matcher("S2", **OPTIONS), LEFT, RIGHT, mask=left, right_mask=right).disparity
    np.testing.assert_array_equal(result, expected)
    with collecting():
        stereokit.match_large(tmp_path / "left.png", tmp_path / "right.png", tmp_path / "map.npy", "S2", **OPTIONS)
    np.testing.assert_array_equal(np.load(tmp_path / "map.npy"), expected)
    opaque = np.dstack([LEFT, LEFT, LEFT, np.full_like(LEFT, 255)])
    assert cv2.imwrite(str(tmp_path / "opaque.png"), opaque)
    assert read_image(tmp_path / "opaque.png", alpha=True).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("method", ["S1", "S2", "S3", "S4"])
def test_what_has_no_texture_is_not_measured_but_filled(method):
    """A grey square of other brightness in a textured plane: its inside tells nothing, what is around it does."""
    left, right = LEFT.copy(), RIGHT.copy()
    left[15:45, 70:110] = 180
    right[15:45, 70 - DISPARITY : 110 - DISPARITY] = 180
    reach = Matcher(method, **OPTIONS).settings.reach
    result = Matcher(method, **OPTIONS)(left, right)
    inside = np.zeros(left.shape, bool)
    inside[15 + reach[1] : 45 - reach[1], 70 + reach[0] : 110 - reach[0]] = True
    assert inside.any() and not result.valid[inside].any()
    assert np.isfinite(result.disparity).all() and np.abs(result.disparity[inside] - DISPARITY).max() < 1.5
    np.testing.assert_array_equal(np.isnan(result.measured), ~result.valid)
    np.testing.assert_array_equal(result.measured[result.valid], result.disparity[result.valid])
    bare = Matcher(method, fill=None, **OPTIONS)(left, right)
    np.testing.assert_array_equal(np.isfinite(bare.disparity), bare.valid)
    np.testing.assert_array_equal(bare.valid, result.valid)


def test_a_letterbox_of_grey_is_not_measured_at_the_nearest_disparity():
    left, right = LEFT.copy(), RIGHT.copy()
    for view in (left, right):
        view[:, :30] = 90
    for method in ("S2", "S4"):
        result = quietly(Matcher(method, **OPTIONS), left, right)
        assert not result.valid[:, :24].any()


def plain_blank(gray, across, down):
    height, width = gray.shape
    out = np.zeros(gray.shape, bool)
    for y in range(height):
        for x in range(width):
            part = gray[max(y - down, 0) : y + down + 1, max(x - across, 0) : x + across + 1]
            out[y, x] = part.min() == part.max()
    return out


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_blank_pixels_are_those_with_equal_surroundings(kind):
    rng = np.random.default_rng(5)
    for _ in range(40):
        height, width = rng.integers(1, 26, 2)
        gray = rng.integers(0, 256, (height, width)).astype(kind) * (257 if kind == np.uint16 else 1)
        for _ in range(rng.integers(0, 4)):
            y, x = rng.integers(0, height), rng.integers(0, width)
            gray[y : y + rng.integers(1, 16), x : x + rng.integers(1, 16)] = rng.integers(0, 2)
        across, down = (int(side) for side in rng.integers(0, 6, 2))
        result = blank_pixels(gray, across, down, int(rng.integers(1, 9)))
        expected = plain_blank(gray, across, down)
        np.testing.assert_array_equal(np.zeros(gray.shape, bool) if result is None else result, expected)


def test_black_borders_are_thick_connected_and_at_a_side():
    assert black_border(LEFT) is None and black_border(np.zeros((9, 9), np.uint8)) is None
    usable, _ = wedges(0.2)
    for image in (blackened(LEFT, usable), np.dstack([blackened(LEFT, usable)] * 3)):
        np.testing.assert_array_equal(black_border(image), ~usable)
        np.testing.assert_array_equal(black_border(image.astype(np.float32)), ~usable)
    inner = LEFT.copy()
    inner[20:40, 40:60] = 0  # black, but within the image
    small = LEFT.copy()
    small[:7, :9] = 0  # 63 pixels
    thin = LEFT.copy()
    thin[:2, :] = 0  # at the side a line of two rows is thick: there is nothing beyond it
    speckled = np.where((X + Y) % 2 == 0, LEFT, 0).astype(np.uint8)
    assert all(black_border(image) is None for image in (inner, small, speckled))
    np.testing.assert_array_equal(black_border(thin), np.broadcast_to(Y < 2, thin.shape))
    colored = np.dstack([np.zeros_like(LEFT), np.zeros_like(LEFT), np.full_like(LEFT, 3)])
    assert black_border(colored) is None
    assert black_border(np.zeros((4, 3), np.uint8)) is None  # three columns of grey are no colours


def test_maps_without_any_such_pixel_are_as_dense_as_before():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for options in ({}, {"scale": 0.5}, {"min_disparity": -3}):
            result = Matcher("S4", **OPTIONS, **options)(LEFT, RIGHT)
            assert np.isfinite(result.disparity).all() and result.density > 0.75
