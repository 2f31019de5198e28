"""Generated pairs against rays cast by plain arithmetic, light worked out by hand, and what was promised of them."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("skimage")

from stereokit.errors import OptionError
from stereokit_evaluation.synthetic import generated
from stereokit_evaluation.synthetic.bank import KINDS, PHOTOGRAPHS, SIZE, TOTAL, pyramid, texture
from stereokit_evaluation.synthetic.cutouts import CUTS, mask
from stereokit_evaluation.synthetic.generated import GeneratedPair, generate_pair, kind_of, pairs
from stereokit_evaluation.synthetic.meshes import blob, box, heightfield, lathe, rotation, sheet, tube
from stereokit_evaluation.synthetic.raster import MASK_SIZE, edge_functions, visible
from stereokit_evaluation.synthetic.render import Rig, render
from stereokit_evaluation.synthetic.sensors import Sensor, blurred, draw_sensors, expose
from stereokit_evaluation.synthetic.stage import Stage

PERFECT = Sensor(0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, contrast=0.5, quality=0)


def rig(width=48, height=36, largest=9.0, smallest=1.0, lift=0.0, roll=0.0):
    return Rig(width, height, largest, smallest, lift, roll, PERFECT, PERFECT)


def small_stage(*, offset=False, seed=5):
    """Return a floor that runs below the camera, a slanted wall, a bent cut-out sheet, a ball, and a rod."""
    stage = Stage(np.random.default_rng(seed), plain=0.0, field_of_view=1.1, offset=offset)
    stage.place = np.array([0.1, -1.0, 0.2])
    stage.look(0.1, -0.15, 0.05)
    stage.light = {"ambient": 0.7}
    stage.add(heightfield(np.zeros((2, 2)), 30, 30).moved(None, (0, 0, -5)), stage.paint("fractal", 1.0, 0.5, 0.8))
    stage.add(sheet(20, 12), stage.paint("cells", 2.0, 0.5, 0.8), None, rotation(0.4), (0, 0, 8))
    stage.add(
        sheet(1.2, 1.0, 1.0, steps=6), stage.paint("print", 0.5), "star", rotation(0.3, 0.2, 0.1), (-0.5, -1.2, 3)
    )
    stage.add(blob(0.5, steps=6), stage.paint("speckle", 0.5), None, rotation(0.2, 0.7), (0.8, -0.8, 4))
    stage.add(tube(np.array([[-2.0, 0, 4], [2.0, -2, 2.5]]), 0.03, 4), stage.paint("wood"))
    return stage


def cast(scene, start, direction):
    """Cut a ray with all triangles (Moeller and Trumbore, 1997): distances along it, inf where it misses."""
    a, b, c = (scene.mesh.points[scene.mesh.faces[:, k]] for k in range(3))
    across, down = b - a, c - a
    p = np.cross(direction, down)
    det = (across * p).sum(axis=1)
    det = np.where(np.abs(det) < 1e-14, np.nan, det)
    to = start - a
    u = (to * p).sum(axis=1) / det
    q = np.cross(to, across)
    v = (direction * q).sum(axis=1) / det
    t = (down * q).sum(axis=1) / det
    with np.errstate(invalid="ignore"):
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9)
    for m in np.flatnonzero(hit & (scene.mask >= 0)):
        corners = scene.mesh.uv[scene.mesh.faces[m], 2:]
        s, r = (1 - u[m] - v[m]) * corners[0] + u[m] * corners[1] + v[m] * corners[2]
        if not scene.masks[scene.mask[m]][
            int(np.floor(r * MASK_SIZE)) % MASK_SIZE, int(np.floor(s * MASK_SIZE)) % MASK_SIZE
        ]:
            hit[m] = False
    return np.where(hit, t, np.inf)


@pytest.mark.parametrize("offset", [False, True])
def test_truth_and_visibility_are_those_of_cast_rays(offset):
    stage, cameras = small_stage(offset=offset), rig()
    scene, pair = stage.triangles(), render(stage, cameras, np.random.default_rng(0))
    focal, cx, cy = 24 / np.tan(0.55), 23.5, 17.5
    rays = [np.array([(x - cx) / focal, (y - cy) / focal, 1.0]) for y in range(36) for x in range(48)]
    depth = np.array([cast(scene, np.zeros(3), ray).min() for ray in rays]).reshape(36, 48)
    inverse = 1 / depth
    if offset:
        slope = 8.0 / (inverse.max() - inverse.min())
        baseline, shift = slope / focal, slope * inverse.min() - 1.0
    else:
        baseline, shift = 9.0 / (focal * inverse.max()), 0.0
    truth = focal * baseline * inverse - shift
    near = np.abs(pair.truth - truth) < 1e-4
    assert near.mean() > 0.998  # a ray through the very edge of a triangle may fall on either side
    assert pair.truth.max() == pytest.approx(9.0, abs=1e-5)
    eye = np.array([baseline, 0.0, 0.0])
    visible = np.empty(depth.shape, bool)
    for k, ray in enumerate(rays):
        point = ray * depth.flat[k]
        first = cast(scene, eye, point - eye).min()
        visible.flat[k] = first > 1 - 1e-6 and k % 48 - truth.flat[k] >= 0
    assert 0.02 < (~visible).mean() < 0.5
    assert (visible == pair.seen)[near].mean() > 0.997


def test_a_ball_has_the_depth_of_a_sphere():
    ball = blob(1.0, steps=160).moved(None, (0.3, -0.2, 5))
    edges = edge_functions(ball.points, ball.faces)
    none = np.full(len(ball.faces), -1, np.int32)
    _, inverse = visible(
        ball.points, ball.faces, edges, ball.uv, none, np.ones((1, MASK_SIZE, MASK_SIZE), np.uint8),
        60.0, 15.5, 11.5, 0.0, 1.0, 32, 0.0, 1.0, 24,
    )  # fmt: skip
    checked = 0
    for y in range(24):
        for x in range(32):
            ray = np.array([(x - 15.5) / 60, (y - 11.5) / 60, 1.0])
            b, c = ray @ [0.3, -0.2, 5], 0.09 + 0.04 + 25 - 1
            root = b * b - (ray @ ray) * c
            if root > 0.5:  # away from the rim
                assert 1 / inverse[y, x] == pytest.approx((b - np.sqrt(root)) / (ray @ ray), abs=1e-3)
                checked += 1
            elif root < -0.05:
                assert inverse[y, x] == 0
    assert checked > 100


def test_the_right_view_shows_each_point_where_the_truth_says():
    """Reading the right view at x - truth gives the left view; half a pixel beside it does not."""
    stage = Stage(np.random.default_rng(2), plain=0.0, field_of_view=1.0)
    stage.light = {"ambient": 1.0}
    stage.add(sheet(30, 20), stage.paint("fractal", 4.0, 0.5, 1.2), None, rotation(0.5), (0, 0, 8))
    for lift in (0.0, 3.0):
        pair = render(stage, rig(160, 96, 14.0, lift=lift), np.random.default_rng(0))
        left, right = pair.left.astype(float), pair.right.astype(float)
        inner = np.zeros(left.shape, bool)
        inner[8:-8, 20:-4] = True
        y, x = np.nonzero(inner & pair.seen)

        def difference(offset, left=left, right=right, pair=pair, y=y, x=x, lift=lift):
            column = x - pair.truth[y, x].astype(float) + offset
            low = np.floor(column).astype(int)
            row = right[y + int(lift)]
            picked = np.arange(len(y))
            got = (1 - column + low) * row[picked, low] + (column - low) * row[picked, low + 1]
            return np.abs(got - left[y, x]).mean()

        assert difference(0.0) < 0.6 * difference(0.5)
        assert difference(0.0) < 0.6 * difference(-0.5)


def lit(material, light, *, turn=None, behind=None, later=None):
    """Return the pair of a sheet 2 m away."""
    stage = Stage(np.random.default_rng(1), plain=0.0, field_of_view=0.5)
    stage.light = light
    stage.later = later or {}
    if behind is not None:
        stage.add(sheet(40, 40), stage.paint("fractal", 1.0, behind, 0.0, detail=None), None, None, (0, 0, 6))
    stage.add(sheet(40, 40), stage.paint("fractal", 1.0, contrast=0.0, detail=None, **material), None, turn, (0, 0, 2))
    return render(stage, rig(16, 12, 2.0), np.random.default_rng(0))


def shade_of(monkeypatch, **options):
    """Return the light that reaches the left and the right camera, before exposure."""
    from stereokit_evaluation.synthetic import render as module

    caught = []
    original = module.shade
    monkeypatch.setattr(module, "shade", lambda *a: caught.append(original(*a)) or caught[-1])
    lit(**options)
    return caught


def test_a_matt_sheet_has_the_light_of_lambert(monkeypatch):
    sun = {"ambient": 0.2, "sun": 0.8, "sun_z": -1.0, "sun_x": 1.0}
    left, right = shade_of(monkeypatch, material={"albedo": 0.5}, light=sun)
    expected = 0.5 * (0.2 * 0.75 + 0.8 * np.sqrt(0.5))
    np.testing.assert_allclose(left, expected, rtol=1e-6)
    np.testing.assert_allclose(right, expected, rtol=1e-6)


def test_the_sun_of_another_time_lights_the_right_view_only(monkeypatch):
    left, right = shade_of(monkeypatch, material={"albedo": 0.5}, light={"ambient": 0.8}, later={"ambient": 0.4})
    np.testing.assert_allclose(left, 0.5 * 0.8 * 0.75, rtol=1e-6)
    np.testing.assert_allclose(right, 0.5 * 0.4 * 0.75, rtol=1e-6)


def test_a_pane_adds_what_is_behind_it_and_has_the_truth(monkeypatch):
    options = {"material": {"albedo": 0.2, "clear": 0.5}, "light": {"ambient": 1.0}, "behind": 0.8}
    behind, front, *_ = shade_of(monkeypatch, **options)
    np.testing.assert_allclose(behind, 0.8 * 0.75, rtol=1e-6)
    np.testing.assert_allclose(front, 0.2 * 0.75 + 0.5 * 0.8 * 0.75, rtol=1e-6)
    np.testing.assert_allclose(lit(**options).truth, 2.0, rtol=1e-6)


def test_a_highlight_lies_elsewhere_in_the_other_view(monkeypatch):
    material = {"albedo": 0.1, "gloss": 1.0, "sharpness": 6}
    light = {"lamp": 4.0, "lamp_z": 0.5, "lamp_x": 0.3}
    left, right = shade_of(monkeypatch, material=material, light=light)
    columns = [float((view.sum(axis=0) * np.arange(view.shape[1])).sum() / view.sum()) for view in (left, right)]
    assert np.argmax(left.max(axis=0)) != np.argmax(right.max(axis=0))
    assert columns[0] != pytest.approx(columns[1] + 4.0, abs=0.2)  # a texture would move by 2 pixels, 4 samples


def test_a_box_shades_the_ground(monkeypatch):
    from stereokit_evaluation.synthetic import render as module

    caught = []
    original = module.shade
    monkeypatch.setattr(module, "shade", lambda *a: caught.append(original(*a)) or caught[-1])
    stage = Stage(np.random.default_rng(1), field_of_view=0.8, shadows=4.0, shadow_centre=np.array([0.0, 0.0, 6.0]))
    stage.place = np.array([0.0, -2.0, 0.0])
    stage.look(0, -0.3, 0)
    stage.light = {"ambient": 0.2, "sun": 1.0, "sun_x": 1.0, "sun_y": -1.0}
    grey = stage.paint("fractal", 1.0, 0.5, 0.0, detail=None)
    stage.add(heightfield(np.zeros((2, 2)), 40, 40), grey)
    stage.add(box(1, 2, 1), grey, None, None, (0, -1, 6))
    render(stage, rig(64, 48, 4.0), np.random.default_rng(0))

    def at(point):
        """Return the light of the left view at a point of the world."""
        seen = (np.array(point, float) - stage.place) @ stage.turn
        x, y = np.array([31.5, 23.5]) + 32 / np.tan(0.4) * seen[:2] / seen[2]
        return caught[0][round(2 * y + 0.5), round(2 * x + 0.5)]

    up = 0.2 * 0.5 * (0.75 + 0.25)
    assert at((-1.2, 0, 6)) == pytest.approx(up, rel=1e-5)  # 0.7 m from the box, which is 2 m high, away from the sun
    assert at((1.2, 0, 6)) == pytest.approx(up + 0.5 * np.sqrt(0.5), rel=1e-5)


def test_a_camera_without_faults_rounds_the_light():
    light = np.repeat(np.repeat(np.array([[0.1, 0.5, 1.0, 3.0]], np.float32), 2, 0), 2, 1)
    picture = expose(light, np.zeros((2, 8)), PERFECT, np.random.default_rng(0))
    assert picture.tolist() == [[13, 64, 128, 128]]  # half the contrast; what is brighter than white is cut


def test_noise_has_the_variance_asked_for():
    camera = Sensor(0, 0, 0.5, 1.0, 0, 0.001, 0.01, 0, 1.0, 0.0, 1.0, 0)
    light = np.full((400, 400), 0.4, np.float32)
    picture = expose(light, np.zeros(light.shape), camera, np.random.default_rng(3))
    assert picture.mean() == pytest.approx(0.4 * 255, abs=0.2)
    assert picture.std() == pytest.approx(255 * np.sqrt(0.001 * 0.4 + 0.01**2), rel=0.03)


def test_a_blur_is_the_weighted_mean_of_the_neighbours():
    image = np.random.default_rng(0).random((7, 9))
    weights = np.exp(-0.5 * (np.arange(-3, 4) / 0.8) ** 2)
    weights /= weights.sum()
    padded = np.pad(image, 3, mode="edge")
    expected = [[(padded[r : r + 7, c : c + 7] * np.outer(weights, weights)).sum() for c in range(9)] for r in range(7)]
    np.testing.assert_allclose(blurred(image, 0.8), expected, rtol=1e-12)
    assert blurred(image, 0.1) is image


def test_cameras_of_one_rig_are_alike_and_mild_ones_more_so():
    def spread(harsh):
        drawn = [draw_sensors(np.random.default_rng(k), harsh) for k in range(200)]
        return np.std([np.log(left.exposure / right.exposure) for left, right in drawn])

    assert 0.01 < spread(0.0) < 0.06 < spread(1.0) < 0.25


@pytest.mark.parametrize("kind", KINDS)
def test_a_texture_is_made_from_its_number(kind):
    image = texture(kind, 1)
    assert image.shape == (SIZE, SIZE) and abs(float(image.mean()) - 128) < 6 and image.std() > 15
    texture.cache_clear()
    assert (texture(kind, 1) == image).all() and (texture(kind, 2) != image).any()


def test_levels_of_a_pyramid_are_means_of_four():
    fine, flat = texture("tiles", 3).astype(int), pyramid("tiles", 3)
    assert flat.size == TOTAL and (flat[: SIZE * SIZE].reshape(SIZE, SIZE) == fine).all()
    half = (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2] + 2) // 4
    assert (flat[SIZE * SIZE : SIZE * SIZE * 5 // 4].reshape(SIZE // 2, SIZE // 2) == half).all()


def test_only_photographs_that_are_free_are_used():
    assert all(terms.startswith(("CC0", "public domain")) for terms in PHOTOGRAPHS.values())
    assert not {"coins", "moon", "page", "immunohistochemistry", "stereo_motorcycle"} & set(PHOTOGRAPHS)


@pytest.mark.parametrize("kind", [*CUTS, "foliage", "blades"])
def test_a_cut_out_has_matter_and_holes(kind):
    shape = mask(kind, 0)
    assert shape.shape == (MASK_SIZE, MASK_SIZE) and 0.02 < shape.mean() <= 1 and set(np.unique(shape)) <= {0, 1}


def test_meshes_have_the_size_asked_for():
    for mesh, size in (
        (box(1, 2, 3), (1, 2, 3)),
        (sheet(2, 1), (2, 1, 0)),
        (blob(0.5), (1, 1, 1)),
        (lathe(np.array([0.5, 1.0]), np.array([0.0, 3.0])), (2, 3, 2)),
        (heightfield(np.array([[0.0, 1.0], [0.0, 0.5]]), 4, 5), (4, 1, 5)),
    ):
        np.testing.assert_allclose(np.ptp(mesh.points, axis=0), size, atol=0.02)
        np.testing.assert_allclose((mesh.normals**2).sum(axis=1), 1, atol=1e-9)
        assert mesh.faces.max() == len(mesh.points) - 1


@pytest.mark.parametrize("kind", generated.KINDS)
def test_a_pair_of_each_kind_keeps_its_promises(kind):
    pair = generate_pair(7, kind, size=(96, 64))
    assert pair.left.shape == pair.right.shape == pair.truth.shape == pair.seen.shape == (64, 96)
    assert (pair.left.dtype, pair.truth.dtype, pair.seen.dtype) == (np.uint8, np.float32, np.bool_)
    assert np.isfinite(pair.truth).all() and pair.truth.min() >= 0 and pair.truth.max() <= 24 + 1e-4
    assert not pair.seen[np.arange(96) < pair.truth].any()
    assert pair.left.std() > 1 and pair.seen.mean() > 0.4
    assert np.isnan(pair.noc[~pair.seen]).all() and (pair.occ[pair.truth > 0] > 0).all()
    again = generate_pair(7, kind, size=(96, 64))
    for name in ("left", "right", "truth", "seen"):
        assert getattr(pair, name).tobytes() == getattr(again, name).tobytes()


@pytest.mark.parametrize("size", [(1, 1), (2, 7), (33, 19)])
def test_any_size_renders(size):
    pair = generate_pair(3, "flying", size=size)
    assert pair.left.shape == size[::-1]


def test_seeds_draw_all_kinds():
    assert {kind_of(seed) for seed in range(40)} == set(generated.KINDS)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: generate_pair(-1), "seed must be a whole number of at least 0, got -1"),
        (lambda: generate_pair(0.5), "seed must be a whole number of at least 0, got 0.5"),
        (lambda: generate_pair(1, "moon"), "kind must be one of .*, got 'moon'"),
        (lambda: generate_pair(1, size=(0, 4)), "size must be a whole number of at least 1, got 0"),
        (lambda: list(pairs(-1)), "count must be a whole number of at least 0, got -1"),
    ],
)
def test_options_outside_their_rule_are_refused(call, message):
    with pytest.raises(OptionError, match=message):
        call()


def test_a_stopped_run_goes_on_where_it_was(tmp_path, monkeypatch):
    requests = []

    def quick(seed, kind=None):
        requests.append(seed)
        flat = np.full((2, 3), seed, np.uint8)
        return GeneratedPair(flat, flat, flat.astype(np.float32), flat > 0, kind or kind_of(seed), seed)

    monkeypatch.setattr(generated, "generate_pair", quick)
    first = list(pairs(2, 10, folder=tmp_path))
    both = list(pairs(4, 10, folder=tmp_path))
    assert requests == [10, 11, 12, 13] and [pair.seed for pair in both] == [10, 11, 12, 13]
    assert both[1].left.tobytes() == first[1].left.tobytes() and both[1].kind == kind_of(11)
    monkeypatch.setattr(generated, "_sources", lambda: "other")
    list(pairs(1, 10, folder=tmp_path))
    assert requests[-1] == 10  # what older code made is not taken
