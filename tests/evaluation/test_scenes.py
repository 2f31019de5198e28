"""Synthetic scenes against plain loops over the patches, and against numbers worked out by hand."""

from __future__ import annotations

import sys

import numpy as np
import pytest

pytest.importorskip("skimage")

from stereokit.errors import OptionError, StereokitError
from stereokit_evaluation.synthetic import scenes, textures
from stereokit_evaluation.synthetic.geometry import Camera, Patch, covers, occlusion, plane_of, rasterise
from stereokit_evaluation.synthetic.scenes import CAMERA_HEIGHT_M, generate
from stereokit_evaluation.synthetic.textures import Decal, Look, Texture, paint

PLAIN = {"noise": 0.0, "gain": 1.0, "offset": 0.0, "blur": 0.0, "hard_cases": False}
GREY = Look((128.0, 128.0, 128.0))


@pytest.fixture(scope="module")
def scene():
    return generate(3, 310, 94, 40)


def small_world():
    """Return a ground, a slanted wall, a cut-out board and a pole: what the loops below go over."""
    mask = np.ones((5, 6), bool)
    mask[1:3, 2:5] = False
    turn = np.radians(25)
    patches = [
        Patch((-9, 1.5, 30), (1, 0, 0), (0, 0, -1), 18, 29.5, GREY),
        Patch((2.5, -3, 20), (0, 0, -1), (0, 1, 0), 22, 4.5, GREY),
        Patch((-2.0, -1, 5), (np.cos(turn), 0, np.sin(turn)), (0, 1, 0), 2.1, 2.2, GREY, 1, mask),
        Patch((0.31, -2, 3.3), (1, 0, 0), (0, 1, 0), 0.2, 3.5, GREY, 2),
        Patch((-1, -1, -4), (1, 0, 0), (0, 1, 0), 2, 2, GREY, 3),
    ]
    return patches, Camera(22.3, 18.6, 10.2, 0.5)


def hit(patch, direction, start):
    """Cut a ray with a patch in space: its depth, or None."""
    u, v = np.array(patch.u_axis, float), np.array(patch.v_axis, float)
    solved = np.linalg.solve(np.stack([u, v, -np.array(direction)], 1), np.array(start) - np.array(patch.origin))
    a, b, depth = solved
    if depth <= 0 or not (0 <= a < patch.width_m and 0 <= b < patch.height_m):
        return None
    if patch.mask is not None:
        rows, columns = patch.mask.shape
        if not patch.mask[int(b / patch.height_m * rows), int(a / patch.width_m * columns)]:
            return None
    return depth


def nearest(patches, camera, x, y, shift):
    """Cast a ray through pixel (x, y) of the camera at X = `shift`: depth and number of the nearest patch."""
    best, number = np.inf, 0
    direction = ((x - camera.cx) / camera.focal, (y - camera.cy) / camera.focal, 1.0)
    for index, patch in enumerate(patches):
        depth = hit(patch, direction, (shift, 0.0, 0.0))
        if depth is not None and depth < best:
            best, number = depth, index + 1
    return best, number


@pytest.mark.parametrize("right", [False, True])
def test_both_views_and_the_occlusion_are_those_of_rays_in_space(right):
    patches, camera = small_world()
    width, height = 37, 23
    planes = [plane_of(patch, camera, right=right) for patch in patches]
    surface, disparity = rasterise(planes, np.arange(width, dtype=float), np.arange(height, dtype=float))
    bf = camera.focal * camera.baseline_m
    for y in range(height):
        for x in range(width):
            depth, number = nearest(patches, camera, x, y, camera.baseline_m if right else 0.0)
            assert surface[y, x] == number, (x, y)
            assert disparity[y, x] == pytest.approx(bf / depth, abs=1e-9)
    assert set(np.unique(surface)) == {0, 1, 2, 3, 4}  # what is behind the cameras is not drawn
    if right:
        return
    hidden = occlusion([plane_of(patch, camera, right=True) for patch in patches], disparity)
    for y in range(height):
        for x in range(width):
            place = x - disparity[y, x]
            depth, _ = nearest(patches, camera, place, y, camera.baseline_m)
            expected = place < 0 or bf / depth > disparity[y, x] + 1e-6
            assert hidden[y, x] == expected, (x, y)
    assert 20 < hidden.sum() < hidden.size / 2


def test_a_patch_between_the_cameras_or_edge_on_is_invisible_where_it_must_be():
    camera = Camera(20, 10, 10, 0.5)
    between = Patch((0.25, -1, 1), (0, 0, 1), (0, 1, 0), 4, 2, GREY)
    assert plane_of(between, camera) is None
    edge_on = Patch((0.0, -1, 1), (0, 0, 1), (0, 1, 0), 4, 2, GREY)
    assert plane_of(edge_on, camera) is None


def test_a_mask_is_looked_up_cell_by_cell():
    mask = np.array([[True, False]])
    plane = plane_of(Patch((-1, -1, 10), (1, 0, 0), (0, 1, 0), 2, 2, GREY, 1, mask), Camera(10, 0, 0, 0.1))
    x = np.array([[-1.5, -1.0, -0.5, -0.001, 0.0, 0.5, 1.0]])
    assert covers(plane, x, np.array([[0.0]])).tolist() == [[False, True, True, True, False, False, False]]


def test_ground_plane(scene):
    ground = scene.surface == 1
    assert ground.mean() > 0.1
    y = np.broadcast_to(np.arange(94.0)[:, None], ground.shape)
    expected = (y - (0.46 * 94 - 0.5)) * scene.baseline_m / CAMERA_HEIGHT_M
    np.testing.assert_allclose(scene.disparity[ground], expected[ground], rtol=1e-6)
    full = generate(0)
    # 0.54 m baseline, 1.65 m above ground, row 374, horizon 0.46 * 375 - 0.5 = 172: 202 * 0.54 / 1.65
    assert full.surface[-1, 621] == 1 and full.disparity[-1, 621] == pytest.approx(66.109, abs=1e-3)


def test_disparity_is_the_plane_of_the_surface(scene):
    rows, columns = np.indices(scene.surface.shape)
    a, b, c = scene.planes[scene.surface - 1].transpose(2, 0, 1)
    expected = np.where(scene.surface > 0, a * columns + b * rows + c, 0.0)
    np.testing.assert_allclose(scene.disparity, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_right_view_warped_by_the_truth_is_the_left_view(seed):
    scene = generate(seed, 621, 188, **PLAIN)
    height, width = scene.disparity.shape
    place = np.arange(width)[None] - scene.disparity
    first = np.clip(np.floor(place).astype(int), 0, width - 2)
    share = np.clip(place - first, 0, 1)[..., None]
    line = np.arange(height)[:, None]
    right = scene.right.astype(float)
    warped = right[line, first] * (1 - share) + right[line, first + 1] * share
    error = np.abs(warped - scene.left).mean(axis=2)
    seen = ~scene.occluded
    # Samples at surface edges mix two surfaces, and linear interpolation blurs: a few pixels differ by much.
    assert np.median(error[seen]) < 2.0 and np.percentile(error[seen], 90) < 9.0
    wrong = np.roll(warped, 2, axis=1)
    assert np.median(np.abs(wrong - scene.left).mean(axis=2)[seen]) > 2 * np.median(error[seen])
    assert np.percentile(error[scene.occluded], 75) > 3 * np.percentile(error[seen], 75)


def test_both_truths_agree_where_nothing_is_hidden(scene):
    height, width = scene.disparity.shape
    agree = total = 0
    for y in range(height):
        for x in range(width):
            place = round(x - float(scene.disparity[y, x]))
            if not scene.occluded[y, x] and 0 <= place < width:
                total += 1
                agree += abs(float(scene.disparity_right[y, place]) - float(scene.disparity[y, x])) < 1.0
    assert total > 0.85 * height * width and agree > 0.97 * total


def test_masks_and_maps_are_consistent(scene):
    shape = (94, 310)
    assert scene.left.shape == scene.right.shape == (*shape, 3)
    assert scene.left.dtype == scene.right.dtype == np.uint8
    assert scene.disparity.dtype == scene.disparity_right.dtype == scene.occ.dtype == scene.noc.dtype == np.float32
    for name in ("occluded", "textureless", "specular", "brightness"):
        mask = getattr(scene, name)
        assert mask.shape == shape and mask.dtype == np.bool_
    assert scene.objects.dtype == np.uint8 and scene.objects.max() >= 4
    sky = scene.surface == 0
    assert (
        (scene.disparity[sky] == 0).all()
        and (scene.objects[sky] == 0).all()
        and (scene.objects[scene.surface == 1] == 0).all()
    )
    assert 0 <= scene.disparity.min() and scene.disparity.max() <= 39 and scene.disparity_right.max() <= 39
    np.testing.assert_array_equal(np.isnan(scene.occ), sky)
    np.testing.assert_array_equal(np.isnan(scene.noc), sky | scene.occluded)
    assert scene.occluded[np.arange(310)[None] - scene.disparity < 0].all()
    assert 0.01 < scene.occluded.mean() < 0.3


def test_hard_cases_appear_and_can_be_left_out():
    hard = [generate(seed, 310, 94) for seed in range(2)]
    for name in ("textureless", "specular", "brightness"):
        assert any(getattr(scene, name).any() for scene in hard)
        assert not getattr(generate(0, 310, 94, hard_cases=False), name).any()


def test_the_same_seed_gives_the_same_scene(scene):
    again, other = generate(3, 310, 94, 40), generate(4, 310, 94, 40)
    for name in ("left", "right", "disparity", "disparity_right", "occluded", "objects", "specular"):
        np.testing.assert_array_equal(getattr(scene, name), getattr(again, name))
    assert (scene.left != other.left).mean() > 0.5
    silent = generate(3, 310, 94, 40, noise=0.0)
    np.testing.assert_array_equal(scene.disparity, silent.disparity)
    # two views of noise 2 make 2 grey levels of spread
    assert np.std(scene.left.astype(float) - silent.left) == pytest.approx(2.0, rel=0.1)


def test_gain_and_offset_change_the_right_view_only():
    plain, changed = (
        generate(1, 64, 40, **PLAIN),
        generate(1, 64, 40, **{**PLAIN, "gain": 0.5, "offset": 10.0}),
    )
    np.testing.assert_array_equal(plain.left, changed.left)
    np.testing.assert_allclose(changed.right, plain.right * 0.5 + 10, atol=0.76)  # each rounded once


@pytest.mark.parametrize(
    ("size", "max_disparity"),
    [((1, 1), 128), ((1, 9), 2), ((9, 1), 16), ((8, 8), 128), ((33, 17), 2), ((20, 75), 16), ((161, 97), 24)],
)
def test_any_size_and_range(size, max_disparity):
    scene = generate(5, *size, max_disparity)
    assert scene.left.shape == (size[1], size[0], 3) and scene.disparity.shape == (size[1], size[0])
    assert scene.specular.shape == scene.occluded.shape == (size[1], size[0])
    assert np.isfinite(scene.disparity).all()
    assert max(scene.disparity.max(), scene.disparity_right.max()) <= max_disparity - 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"width": 0}, "width must be a whole number of at least 1, got 0"),
        ({"height": 2.5}, "height must be a whole number of at least 1, got 2.5"),
        ({"max_disparity": 1}, "max_disparity must be a whole number of at least 2, got 1"),
        ({"noise": -1.0}, "noise must be finite and at least 0, got -1.0"),
        ({"gain": float("nan")}, "gain must be finite and at least 0, got nan"),
        ({"offset": float("inf")}, "offset must be finite, got inf"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(OptionError) as error:
        generate(**{"seed": 0, "width": 8, "height": 8, **options})
    assert str(error.value) == message


def test_without_the_photographs_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage", None)
    textures.photograph.cache_clear()
    with pytest.raises(StereokitError, match=r"pip install stereokit\[scenes\]"):
        textures.photograph("brick")


def test_a_texture_is_linear_between_pixels_and_averages_far_away():
    image = np.array([[0, 40, 80, 120], [0, 40, 80, 120]], np.uint8)
    texture = Texture(image, 4.0, 2.0)
    u = np.array([0.5, 1.0, 1.25, 3.5, 9.0, -3.0])
    near = texture(u, np.full(6, 1.0), np.full(6, 0.1))
    np.testing.assert_allclose(near, [0, 20, 30, 120, 120, 0], atol=1)
    tile = Texture(image, 4.0, 2.0, tile=True)  # mirrored: 0 40 80 120 120 80 40 0, then again
    np.testing.assert_allclose(
        tile(np.array([4.5, 7.5, 8.5, 9.5]), np.full(4, 0.5), np.zeros(4)), [120, 0, 0, 40], atol=1
    )
    noise = np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8)
    far = Texture(noise, 4.0, 4.0, tile=True)(np.array([3.3]), np.array([0.1]), np.array([1e9]))
    np.testing.assert_allclose(far, [noise.mean()], atol=8)


def test_highlights_move_and_brightness_changes_in_the_right_view_only():
    bright = Decal("brightness", 0, 0, 2, 2, gain=0.5, offset=5.0)
    glint = Decal("specular", 2, 0, 6, 2, colour=(100.0, 100.0, 100.0), u=3, v=1, radius_u=0.5, radius_v=0.5, shift_u=1)
    look = Look((100.0, 100.0, 100.0), decals=(bright, glint))
    u, v, zero = np.array([1.0, 3.0, 4.0]), np.ones(3), np.zeros(3)
    left = paint(look, u, v, zero, zero, right=False)[:, 0]
    right = paint(look, u, v, zero, zero, right=True)[:, 0]
    faint = 100 * np.exp(-4.0)
    np.testing.assert_allclose(left, [100, 200, 100 + faint], rtol=1e-5)
    np.testing.assert_allclose(right, [55, 100 + faint, 200], rtol=1e-5)


def test_scenes_are_about_as_hard_as_kitti():
    """A plain block matcher on one channel finds most of the seen pixels: the pair is a stereo pair."""
    import cv2

    scene = generate(0, 621, 188, 64)
    grey = [cv2.copyMakeBorder(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), 0, 0, 64, 0, cv2.BORDER_REPLICATE)
            for i in (scene.left, scene.right)]  # fmt: skip
    matcher = cv2.StereoSGBM_create(0, 64, 5, 200, 800, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    disparity = matcher.compute(*grey)[:, 64:].astype(np.float32) / 16
    measured = (disparity >= 0) & np.isfinite(scene.noc)
    error = np.abs(disparity - scene.disparity)[measured]
    assert measured.mean() > 0.75 and (error > 3).mean() < 0.08 and np.median(error) < 0.25


def test_scene_module_lists_what_is_public():
    assert scenes.__all__ == ["CAMERA_HEIGHT_M", "Scene", "generate"]
