"""Rectification against exact synthetic cameras: rows, depth, masks and calibration, for every lens model."""

from __future__ import annotations

import pickle
import threading

import cv2
import numpy as np
import pytest
import rigs

from stereokit.errors import InputError, OptionError
from stereokit.matching import Matcher
from stereokit.rig import Camera, StereoRig

ROWS_PX, DEPTH_SHARE = 0.1, 0.01
"""What the rows of a rectified pair may differ by, and the depth of what is matched in it by."""


def rig_of(name, size=rigs.SIZE):
    truth = rigs.rig_of(name)
    model = "fisheye" if truth.fisheye else "pinhole"
    left, right = (Camera(k, d, model, *size) for k, d in zip(truth.k, truth.d, strict=True))
    return truth, StereoRig(left, right, truth.r, truth.t)


def seen_points(truth, count=3000):
    """Return points in space that both raw cameras see, and where."""
    points = np.random.default_rng(0).uniform([-0.6, -0.5, 0.7], [0.6, 0.5, 3], (count, 3))
    pixels = [rigs.project(truth, side, points) for side in (0, 1)]
    inside = np.all([(p >= 2).all(1) & (p < np.array(rigs.SIZE) - 3).all(1) for p in pixels], axis=0)
    return points[inside], [p[inside] for p in pixels]


def positions(raw_rig, options, side):
    """Return where in the raw image each rectified pixel comes from, read off two rectified ramps."""
    x, y = np.meshgrid(np.arange(rigs.SIZE[0], dtype=np.float32), np.arange(rigs.SIZE[1], dtype=np.float32))
    return [raw_rig.rectify(ramp, ramp, **options)[side] for ramp in (x, y)]


@pytest.mark.parametrize(
    "options", [{}, {"alpha": 1.0}, {"size": (400, 200), "alpha": 0.5}, {"crop": True, "alpha": 1.0}]
)
@pytest.mark.parametrize("name", rigs.LENSES)
def test_a_point_lies_in_one_row_and_its_disparity_is_its_depth(name, options):
    """Follow points through the images themselves: each rectified pixel says which raw pixel it shows."""
    truth, rig = rig_of(name)
    points, pixels = seen_points(truth)
    assert len(points) > 500
    camera = rig.rectified(**options)
    places = []
    for side in (0, 1):
        across, down = positions(rig, options, side)
        mask = (rig.rectification(**options).mask, rig.rectification(**options).right_mask)[side]
        rows, columns = np.nonzero(mask)
        # Nearest rectified pixel of each point, then one Newton step with the ramps' own slope.
        tree = cv2.flann_Index(np.float32(np.stack([across[mask], down[mask]], 1)), {"algorithm": 4})
        nearest, distance = tree.knnSearch(np.float32(pixels[side]), 1)
        row, column = rows[nearest[:, 0]], columns[nearest[:, 0]]
        inner = (row > 1) & (column > 1) & (row < mask.shape[0] - 2) & (column < mask.shape[1] - 2)
        row, column = row.clip(1, mask.shape[0] - 2), column.clip(1, mask.shape[1] - 2)
        jacobian = np.empty((len(row), 2, 2))
        for k, ramp in enumerate((across, down)):
            jacobian[:, k, 0] = (ramp[row, column + 1] - ramp[row, column - 1]) / 2
            jacobian[:, k, 1] = (ramp[row + 1, column] - ramp[row - 1, column]) / 2
        whole = np.all([mask[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
        good = inner & whole & (distance[:, 0] < 4)
        step = np.full((len(row), 2), np.nan)
        rest = pixels[side] - np.stack([across[row, column], down[row, column]], 1)
        step[good] = np.linalg.solve(jacobian[good], rest[good][..., None])[..., 0]
        places.append(np.stack([column + step[:, 0], row + step[:, 1]], 1))
    both = np.isfinite(places[0]).all(1) & np.isfinite(places[1]).all(1)
    assert both.mean() > 0.3
    rows_apart = np.abs(places[0][both, 1] - places[1][both, 1])
    assert rows_apart.max() < ROWS_PX
    depth = (points[both] @ rig.rectification(**options).turns[0].T)[:, 2]
    disparity = places[0][both, 0] - places[1][both, 0]
    expected = camera.fx * camera.baseline_m / depth - camera.doffs
    assert np.abs(disparity - expected).max() < ROWS_PX
    assert camera.baseline_m == pytest.approx(np.linalg.norm(truth.t), rel=1e-6)


@pytest.mark.parametrize("name", ["pinhole 5", "pinhole 14", "fisheye"])
def test_depth_of_a_known_scene(name):
    truth, rig = rig_of(name)
    left, right = rig.rectify(*rigs.raw_pair(truth))
    camera, made_by = rig.rectified(), rig.rectification()
    result = Matcher("S2", max_disparity=64)(left, right)
    expected = rigs.true_depth(made_by.turns[0], (camera.fx, camera.fy, camera.cx0, camera.cy), made_by.size)
    depth = result.depth(camera)
    known = result.valid & made_by.mask & np.isfinite(depth) & np.isfinite(expected)
    assert known.mean() > 0.7
    share = (depth[known] - expected[known]) / expected[known]
    assert abs(np.median(share)) < 0.2 * DEPTH_SHARE  # the geometry is right
    assert np.median(np.abs(share)) < DEPTH_SHARE  # and so is most of what is matched
    unrectified = Matcher("S2", max_disparity=64)(*rigs.raw_pair(truth))
    assert unrectified.density < result.density - 0.1  # the check can fail


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_types_and_channels_stay(kind, channels):
    _, rig = rig_of("pinhole 5")
    image = np.random.default_rng(0).integers(0, 200, (rigs.SIZE[1], rigs.SIZE[0], *channels)).astype(kind)
    before = image.copy()
    left, right = rig.rectify(image, image[::1], size=(200, 160))
    assert left.dtype == right.dtype == kind and left.shape == right.shape == (160, 200, *channels)
    np.testing.assert_array_equal(image, before)
    view = np.repeat(image, 2, axis=1)[:, ::2]
    np.testing.assert_array_equal(rig.rectify(view, view, size=(200, 160))[0], left)


def test_the_mask_is_where_the_sensors_saw_something():
    _, rig = rig_of("pinhole 5")
    white = np.full(rigs.SIZE[::-1], 255, np.uint8)
    for options in ({"alpha": 1.0}, {"alpha": 0.3, "size": (300, 260)}, {}):
        left, right = rig.rectify(white, white, **options)
        made_by = rig.rectification(**options)
        for image, mask in ((left, made_by.mask), (right, made_by.right_mask)):
            assert mask.shape == image.shape and mask.dtype == bool
            assert (image[mask] == 255).all()
            assert (image[~mask] < 255).mean() > 0.9 if (~mask).any() else True
    assert not rig.rectification(alpha=1.0).mask.all()


@pytest.mark.parametrize("name", rigs.LENSES)
def test_alpha_0_is_full_and_crop_takes_the_blank_away(name):
    _, rig = rig_of(name)
    assert rig.rectification(alpha=0.0).mask.mean() > 0.98
    whole, cropped = (rig.rectification(alpha=1.0, crop=crop) for crop in (False, True))
    assert cropped.mask.mean() > 0.97 > whole.mask.mean()
    for edge in (cropped.mask[0], cropped.mask[-1], cropped.mask[:, 0], cropped.mask[:, -1]):
        assert edge.all()
    assert cropped.size[0] * cropped.size[1] > 0.35 * whole.size[0] * whole.size[1]
    assert (cropped.calibration.width, cropped.calibration.height) == cropped.size
    truth = rigs.rig_of(name)
    images = rigs.raw_pair(truth)
    x0, y0 = (
        round(a - b)
        for a, b in ((whole.calibration.cx0, cropped.calibration.cx0), (whole.calibration.cy, cropped.calibration.cy))
    )
    for a, b in zip(whole(*images), cropped(*images), strict=True):
        np.testing.assert_array_equal(a[y0 : y0 + b.shape[0], x0 : x0 + b.shape[1]], b)


def test_what_lies_beyond_the_lens_model_is_no_evidence():
    """A strong k1 alone turns back at some angle: beyond it the image shows itself again, mirrored."""
    k = np.array([[260.0, 0, 160], [0, 260.0, 120], [0, 0, 1]])
    camera = Camera(k, (-0.3, 0, 0, 0), "pinhole", *rigs.SIZE)
    rig = StereoRig(camera, camera, np.eye(3), (-0.1, 0, 0))
    made_by = rig.rectification(focal=60.0)
    x, y = np.meshgrid((np.arange(320) - made_by.calibration.cx0) / 60, (np.arange(240) - made_by.calibration.cy) / 60)
    radius = np.hypot(x, y)
    turning = np.sqrt(1 / (3 * 0.3))  # where r (1 - 0.3 r^2) is largest
    assert not made_by.mask[radius > 1.01 * turning].any()
    raw = radius * (1 - 0.3 * radius**2)
    assert made_by.mask[(radius < 0.97 * turning) & (260 * raw < 118)].all()
    assert (~made_by.mask & (np.abs(260 * raw) < 118)).any()  # the ghost would have been there


def test_a_very_wide_fisheye_needs_a_focal_length():
    k = np.array([[60.0, 0, 160], [0, 60.0, 120], [0, 0, 1]])  # 300 degrees across
    camera = Camera(k, np.zeros(4), "fisheye", *rigs.SIZE)
    rig = StereoRig(camera, camera, np.eye(3), (-0.1, 0, 0))
    made_by = rig.rectification(focal=80.0)
    assert made_by.calibration.fx == 80 and made_by.mask.mean() > 0.9
    theta = np.arctan(np.abs(np.arange(320) - made_by.calibration.cx0) / 80)
    ramp = np.tile(np.arange(320, dtype=np.float32), (240, 1))
    row = rig.rectify(ramp, ramp, focal=80.0)[0][round(made_by.calibration.cy)]
    np.testing.assert_allclose(np.abs(row - 160), 60 * theta, atol=0.1)


def test_maps_are_made_once(monkeypatch):
    _, rig = rig_of("pinhole 5")
    calls = []
    real = cv2.initUndistortRectifyMap
    monkeypatch.setattr(cv2, "initUndistortRectifyMap", lambda *a: calls.append(1) or real(*a))
    image = np.zeros(rigs.SIZE[::-1], np.uint8)
    first = rig.rectification()
    threads = [threading.Thread(target=rig.rectify, args=(image, image)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(calls) == 2 and rig.rectification() is first
    rig.rectify(image, image, alpha=1.0)
    assert len(calls) == 4
    again = pickle.loads(pickle.dumps(rig))
    np.testing.assert_array_equal(again.rectify(image + 7, image)[0], rig.rectify(image + 7, image)[0])


def test_half_size_images_with_a_rig_of_half_size():
    truth, rig = rig_of("pinhole 5")
    left, right = rigs.raw_pair(truth)
    half = rig.scaled(0.5)
    assert half.size == (160, 120) and half.baseline_m == rig.baseline_m
    small = [cv2.resize(one, (160, 120), interpolation=cv2.INTER_AREA) for one in (left, right)]
    options = {"size": (160, 120)}
    of_small = half.rectify(*small)
    of_large = [cv2.resize(one, (160, 120), interpolation=cv2.INTER_AREA) for one in rig.rectify(left, right)]
    assert half.rectified().fx == pytest.approx(rig.rectified(**options).fx, rel=2e-2)
    assert np.median(np.abs(of_small[0].astype(int) - of_large[0])) < 16


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"alpha": 2}, "alpha must be a number from 0 to 1, got 2"),
        ({"alpha": -0.5}, "alpha must be"), ({"alpha": "all"}, "alpha must be"),
        ({"size": (0, 10)}, "width must be from 8"), ({"size": 640}, r"size must be \(width, height\), got 640"),
        ({"size": (640, 10.5)}, "height must be an integer"), ({"focal": 0}, "focal must be a number"),
    ],
)  # fmt: skip
def test_options_are_checked(options, words):
    with pytest.raises(OptionError, match=words):
        rig_of("pinhole 5")[1].rectification(**options)


def test_images_are_checked():
    _, rig = rig_of("pinhole 5")
    good = np.zeros(rigs.SIZE[::-1], np.uint8)
    with pytest.raises(InputError, match=r"raw images of 320x240 pixels, got left of 160x120; use StereoRig.scaled"):
        rig.rectify(good[::2, ::2], good)
    with pytest.raises(InputError, match="got right of 320x239"):
        rig.rectify(good, good[:-1])
    for bad in (good.astype(np.int32), good.astype(bool), good[0], np.array(["a"])):
        with pytest.raises(InputError, match="left must be an image of uint8, uint16, float32, float64"):
            rig.rectify(bad, good)


def test_lenses_that_do_not_go_together():
    size = rigs.SIZE
    pinhole, fisheye = Camera(rigs.K1, (), "pinhole", *size), Camera(rigs.K1, np.zeros(4), "fisheye", *size)
    with pytest.raises(OptionError, match="one lens model, got pinhole and fisheye"):
        StereoRig(pinhole, fisheye, np.eye(3), (-0.1, 0, 0)).rectification()
    with pytest.raises(OptionError, match="images of one size, got 320x240 and 640x480"):
        StereoRig(pinhole, Camera(rigs.K1, (), "pinhole", 640, 480), np.eye(3), (-0.1, 0, 0))
    for wrong, words in (({"width": 3}, "go together"), ({"model": "ds"}, "model must be 'pinhole' or 'fisheye'")):
        with pytest.raises(OptionError, match=words):
            Camera(rigs.K1, **wrong)
    wide = Camera([[60.0, 0, 160], [0, 60, 120], [0, 0, 1]], np.zeros(4), "fisheye", *size)  # 300 degrees across
    with pytest.raises(OptionError, match=r"lenses are too wide, or their distortion is wrong.*choose focal"):
        StereoRig(wide, wide, np.eye(3), (-0.1, 0, 0)).rectification()
    folded = Camera(rigs.K1, (-500.0, 0, 0, 0), "pinhole", *size)
    with pytest.raises(OptionError, match="hardly a pixel of it lies within the raw images"):
        StereoRig(folded, folded, np.eye(3), (-0.1, 0, 0)).rectification()
