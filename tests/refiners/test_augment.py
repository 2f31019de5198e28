"""Pairs made of pairs: every pixel that both cameras are said to see looks the same in both, before and after."""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np
import pytest

from stereokit_refiners.training import augment
from stereokit_refiners.training.augment import Views, copy_paste, mirrored, photographed, rescaled

NAN = np.nan
SIZE = (100, 280)
FAR = 6


@dataclass(frozen=True)
class Box:
    """A flat thing that faces the cameras; columns are those of the left view."""

    y: int
    x: int
    height: int
    width: int
    d: int

    @property
    def place(self):
        return np.s_[self.y : self.y + self.height, self.x : self.x + self.width]


CAR = Box(30, 110, 48, 64, 20)
POLE = Box(20, 230, 70, 9, 40)


def scene(*boxes, size=SIZE, seed=0, sparse=0.25):
    """Return random dots of whole disparities: boxes before a wall, drawn from far to near into both views.

    The truth of the wall is known in places only, that of the boxes everywhere, as in KITTI 2015.
    """
    rng = np.random.default_rng(seed)
    height, width = size
    left, right = (rng.integers(0, 256, size).astype(np.uint8) for _ in range(2))
    truth = np.full(size, FAR)
    for box in sorted(boxes, key=lambda b: b.d):
        truth[box.place] = box.d
    nearest = np.full(size, -1)
    for y in range(height):
        for x in range(width):
            there = x - truth[y, x]
            if there >= 0 and truth[y, x] > nearest[y, there]:
                nearest[y, there] = truth[y, x]
                right[y, there] = left[y, x]
    y, x = np.indices(size)
    seen = (x >= truth) & (nearest[y, np.maximum(x - truth, 0)] == truth)
    occ = truth.astype(np.float32)
    occ[(rng.random(size) > sparse) & (truth == FAR)] = NAN
    return Views(left, right, np.where(seen, occ, np.float32(NAN)), occ)


def copied(views):
    return Views(*(getattr(views, f.name).copy() for f in fields(Views)))


def assert_equal(one, other):
    for f in fields(Views):
        a, b = getattr(one, f.name), getattr(other, f.name)
        assert a.dtype == b.dtype and a.shape == b.shape, f.name
        np.testing.assert_array_equal(a, b, err_msg=f.name)


def same(one, other):
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name), equal_nan=f.name in ("noc", "occ"))
               for f in fields(Views))  # fmt: skip


def assert_views(views, size):
    for name, dtype in (("left", np.uint8), ("right", np.uint8), ("noc", np.float32), ("occ", np.float32)):
        array = getattr(views, name)
        assert array.shape == size and array.dtype == dtype and array.flags.c_contiguous, name


def assert_photo_consistent(views):
    """Check that each pixel that both cameras see is the same dot in both views."""
    y, x = np.nonzero(np.isfinite(views.noc))
    d = views.noc[y, x]
    assert (d == np.rint(d)).all() and (x >= d).all()
    np.testing.assert_array_equal(views.left[y, x], views.right[y, x - d.astype(int)])
    np.testing.assert_array_equal(views.occ[y, x], d)


CHANGES = {
    "mirrored": lambda rng, views: mirrored(views),
    "copy_paste": copy_paste,
    "rescaled": rescaled,
    "photographed": photographed,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("sparse", [0.25, 1.0])
def test_inputs_are_not_modified_and_the_same_random_state_is_the_same_pair(change, sparse):
    views = scene(CAR, POLE, sparse=sparse)
    original = copied(views)
    for seed in range(4):
        actual = change(np.random.default_rng(seed), views)
        assert_views(actual, actual.left.shape)
        assert_equal(change(np.random.default_rng(seed), views), actual)
        assert_equal(views, original)


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("size", [(64, 96), (65, 67), (3, 5), (1, 9), (9, 1), (1, 1)])
def test_pairs_without_any_truth_have_none_afterwards(change, size):
    rng = np.random.default_rng(0)
    views = Views(
        *(rng.integers(0, 256, size).astype(np.uint8) for _ in range(2)), *np.full((2, *size), NAN, np.float32)
    )
    for seed in range(3):
        actual = change(np.random.default_rng(seed), views)
        assert np.isnan(actual.noc).all() and np.isnan(actual.occ).all()
        assert_views(actual, actual.left.shape)


# --- mirrored ------------------------------------------------------------------------------------------------------


def mirrored_by_loops(noc):
    """Return the truth of the right view behind the mirror: the nearest, then what opened by a pixel; flipped."""
    height, width = noc.shape
    actual = [[None] * width for _ in range(height)]
    for y in range(height):
        for x in range(width):
            d = float(noc[y, x])
            if d != d:
                continue
            there = round(x - d)
            if 0 <= there < width and (actual[y][there] is None or d > actual[y][there]):
                actual[y][there] = d
    out = np.full(noc.shape, NAN, np.float32)
    for y in range(height):
        for x in range(width):
            value = actual[y][x]
            if value is None and 0 < x < width - 1:
                before, after = actual[y][x - 1], actual[y][x + 1]
                if before is not None and after is not None and abs(before - after) < 1.5:
                    value = 0.5 * (before + after)
            if value is not None:
                out[y, width - 1 - x] = value
    return out


def views_of(noc, occ=None, seed=0):
    rng = np.random.default_rng(seed)
    left, right = (rng.integers(0, 256, noc.shape).astype(np.uint8) for _ in range(2))
    return Views(left, right, noc, noc if occ is None else occ)


@pytest.mark.parametrize("size", [(12, 40), (1, 30), (30, 1), (5, 2), (5, 3)])
@pytest.mark.parametrize("spread", [0, 1, 8])
@pytest.mark.parametrize("known", [0.2, 0.8, 1.0])
def test_mirrored_truth_against_loops(size, spread, known):
    rng = np.random.default_rng([*size, spread])
    noc = (3 + spread * rng.random(size)).astype(np.float32)
    noc[rng.random(size) > known] = NAN
    actual = mirrored(views_of(noc))
    np.testing.assert_allclose(actual.noc, mirrored_by_loops(noc), rtol=1e-6)
    np.testing.assert_array_equal(actual.occ, actual.noc)  # what only the new left camera sees, nobody knows


def test_mirrored_views_change_sides():
    views = scene(CAR)
    actual = mirrored(views)
    np.testing.assert_array_equal(actual.left, views.right[:, ::-1])
    np.testing.assert_array_equal(actual.right, views.left[:, ::-1])
    twice = mirrored(actual)
    np.testing.assert_array_equal(twice.left, views.left)
    np.testing.assert_array_equal(twice.right, views.right)


@pytest.mark.parametrize("boxes", [(), (CAR,), (CAR, POLE)])
def test_a_mirrored_scene_is_seen_alike_by_both_cameras(boxes):
    views = scene(*boxes, sparse=1)
    actual = mirrored(views)
    assert_photo_consistent(actual)
    for box in boxes:
        y, x = np.nonzero(views.noc == box.d)
        np.testing.assert_array_equal(actual.noc[y, SIZE[1] - 1 - (x - box.d)], box.d)
    assert np.isfinite(actual.noc).sum() == np.isfinite(views.noc).sum()  # whole disparities: no cracks, no loss


def test_a_shift_is_the_same_shift_from_the_other_side():
    actual = mirrored(scene(sparse=1))
    assert (actual.noc[:, FAR:] == FAR).all()
    assert np.isnan(actual.noc[:, :FAR]).all()


def row(*values):
    return np.float32([values])


@pytest.mark.parametrize(
    ("noc", "expected"),
    [
        (row(NAN, NAN, NAN, 2, NAN, 4, NAN, NAN), row(NAN, 4, NAN, NAN, NAN, NAN, NAN, NAN)),  # both at 1: the nearer
        (row(NAN, NAN, NAN, 2, NAN, 4, 5, NAN), row(NAN, 5, NAN, NAN, NAN, NAN, NAN, NAN)),
        (row(1, NAN, 3, NAN, NAN, NAN, NAN, NAN), row(*[NAN] * 8)),  # out at the left
        (row(NAN, NAN, NAN, NAN, NAN, NAN, -1, -1), row(NAN, NAN, NAN, NAN, NAN, NAN, NAN, -1)),  # and at the right
        (row(0, NAN, NAN, NAN, NAN, NAN, NAN, 0), row(0, NAN, NAN, NAN, NAN, NAN, NAN, 0)),
        (row(NAN, 1, NAN, 1, NAN, NAN, NAN, 1), row(1, 1, 1, NAN, NAN, NAN, 1, NAN)),  # opened by one pixel, by three
        (row(NAN, 1, NAN, NAN, 2.4, NAN, NAN, NAN), row(1, 1.7, 2.4, NAN, NAN, NAN, NAN, NAN)),
        (row(NAN, 1, NAN, NAN, NAN, 3, NAN, NAN), row(1, NAN, 3, NAN, NAN, NAN, NAN, NAN)),  # two surfaces
    ],
    ids=["collision", "three", "left", "right", "border", "opened", "slanted", "edge"],
)
def test_where_pixels_go(noc, expected):
    actual = mirrored(views_of(noc)).noc[:, ::-1]
    np.testing.assert_allclose(actual, expected, rtol=1e-6)


# --- moved objects -------------------------------------------------------------------------------------------------


def copies_of(views, actual, box):
    """Return (shift, flipped) of every place where the left view shows the whole box."""
    places = []
    for flipped in (False, True):
        origin = mirrored(views) if flipped else views
        y, x = np.nonzero(origin.noc == box.d)
        top, left = y.min(), x.min()
        part = origin.left[top : y.max() + 1, left : x.max() + 1]
        strip = actual.left[top : y.max() + 1]
        for at in range(strip.shape[1] - part.shape[1] + 1):
            if np.array_equal(strip[:, at : at + part.shape[1]], part):
                places.append((at - left, flipped))
    return places


@pytest.mark.parametrize(
    "views", [scene(sparse=1), scene(CAR, POLE, sparse=1), scene(CAR, sparse=0.65)], ids=["wall", "objects", "mostly"]
)
def test_dense_truth_is_left_alone(views):
    for seed in range(5):
        assert_equal(copy_paste(np.random.default_rng(seed), views), views)


@pytest.mark.parametrize(
    "views", [scene(), scene(Box(30, 110, 30, 30, 20)), scene(POLE)], ids=["none", "small", "thin"]
)
def test_without_objects_nothing_moves(views):
    for seed in range(5):
        assert_equal(copy_paste(np.random.default_rng(seed), views), views)


def test_what_is_too_large_is_no_object(monkeypatch):
    monkeypatch.setattr(augment, "_LARGEST", CAR.height * CAR.width // 2)
    views = scene(CAR)
    for seed in range(5):
        assert_equal(copy_paste(np.random.default_rng(seed), views), views)


def test_at_most_as_many_copies_as_are_allowed():
    views = scene(CAR)
    assert_equal(copy_paste(np.random.default_rng(0), views, most=0), views)
    counts = set()
    for seed in range(12):
        actual = copy_paste(np.random.default_rng(seed), views, most=1)
        counts.add(len(set(copies_of(views, actual, CAR)) - {(0, False)}))
    assert counts == {0, 1}


@pytest.mark.parametrize("boxes", [(CAR,), (CAR, POLE), (CAR, Box(40, 30, 50, 60, 30), POLE)])
def test_after_moving_both_cameras_still_see_the_same(boxes):
    views = scene(*boxes)
    assert_photo_consistent(views)
    changed = 0
    for seed in range(12):
        actual = copy_paste(np.random.default_rng(seed), views)
        assert_views(actual, SIZE)
        assert_photo_consistent(actual)
        changed += not same(actual, views)
    assert changed >= 6


def test_a_copy_stands_on_the_same_rows_at_its_disparity_in_both_views():
    views, moved = scene(CAR), 0
    for seed in range(16):
        actual = copy_paste(np.random.default_rng(seed), views, most=1)
        new = set(copies_of(views, actual, CAR)) - {(0, False)}
        if not new:  # none was drawn, or it reaches out of the image
            continue
        ((shift, flipped),) = new
        moved += 1
        origin = mirrored(views) if flipped else views
        y, x = np.nonzero(origin.noc == CAR.d)
        assert (y.min(), y.max()) == (CAR.y, CAR.y + CAR.height - 1)
        np.testing.assert_array_equal(actual.left[y, x + shift], origin.left[y, x])
        there = x + shift - CAR.d
        seen = there >= 0
        np.testing.assert_array_equal(actual.right[y[seen], there[seen]], origin.right[y[seen], (x - CAR.d)[seen]])
        assert (actual.occ[y, x + shift] == CAR.d).all()
        assert (actual.noc[y[seen], (x + shift)[seen]] == CAR.d).all()
        assert np.isnan(actual.noc[y[~seen], (x + shift)[~seen]]).all()
        rows = np.nonzero((views.left != actual.left).any(axis=1))[0]
        assert CAR.y <= rows.min() and rows.max() < CAR.y + CAR.height
    assert moved >= 5


def test_copies_show_both_the_object_and_its_mirror_image():
    views = scene(CAR)
    actual = [copy_paste(np.random.default_rng(seed), views, most=1) for seed in range(20)]
    sides = {flipped for one in actual for shift, flipped in set(copies_of(views, one, CAR)) - {(0, False)}}
    assert sides == {False, True}


def test_copies_reach_out_of_the_image_at_both_sides():
    views, at_left, at_right = scene(CAR), 0, 0
    for seed in range(40):
        occ = copy_paste(np.random.default_rng(seed), views, most=1).occ == CAR.d
        at_left += occ[CAR.y + 10, 0]
        at_right += occ[CAR.y + 10, -1]
    assert at_left and at_right


@pytest.mark.parametrize("boxes", [(CAR,), (CAR, POLE)])
def test_what_a_copy_hides_from_the_right_camera_leaves_noc_and_stays_in_occ(boxes):
    views, lost, alike = scene(*boxes), 0, 0
    for seed in range(12):
        actual = copy_paste(np.random.default_rng(seed), views)
        background = (actual.left == views.left) & (actual.occ == FAR)
        np.testing.assert_array_equal(views.occ[background], actual.occ[background])
        gone = background & np.isfinite(views.noc) & np.isnan(actual.noc)
        lost += gone.sum()
        y, x = np.nonzero(gone)
        # There the right view now shows something else (one dot in 256 is the same by chance) ...
        alike += (actual.right[y, x - FAR] == views.right[y, x - FAR]).sum()
        # ... and where a pixel has not left, it still shows the same.
        original = background & np.isfinite(actual.noc)
        y, x = np.nonzero(original)
        np.testing.assert_array_equal(actual.right[y, x - FAR], views.right[y, x - FAR])
    assert lost > 500 and alike < 0.02 * lost


def test_a_copy_hides_nothing_nearer():
    """The copies that a scene without the pole has are left out where they would hide it, but for a fiftieth."""
    open_scene, with_pole = scene(CAR), scene(CAR, POLE)
    near = with_pole.occ == POLE.d
    left_out = there = 0
    for seed in range(40):
        free, barred = (copy_paste(np.random.default_rng(seed), v, most=1) for v in (open_scene, with_pole))
        hidden = near & (barred.occ != POLE.d)
        assert hidden.sum() <= 0.02 * CAR.height * CAR.width
        would_hide = (near & (free.occ == CAR.d)).sum() > 0.02 * CAR.height * CAR.width
        moved = (free.occ == CAR.d).sum() > (open_scene.occ == CAR.d).sum()
        left_out += moved and would_hide and same(barred, with_pole)
        there += moved and not would_hide and not same(barred, with_pole)
    assert left_out >= 2 and there >= 5


def test_a_copy_stands_before_what_is_farther():
    farther = Box(20, 10, 70, 40, 12)
    views = scene(CAR, farther)
    actual = [copy_paste(np.random.default_rng(seed), views) for seed in range(20)]
    assert any(((views.occ == farther.d) & (one.occ == CAR.d)).sum() > 200 for one in actual)


def test_objects_of_several_disparities_move_as_they_are():
    """A slanted object: each pixel keeps its own disparity."""
    views = scene(Box(30, 110, 48, 32, 20), Box(30, 142, 48, 32, 22))
    kinds = set()
    for seed in range(12):
        actual = copy_paste(np.random.default_rng(seed), views)
        assert_photo_consistent(actual)
        kinds |= {(v, int((actual.occ == v).sum()) > int((views.occ == v).sum())) for v in (20, 22)}
    assert {(20, True), (22, True)} <= kinds


# --- rescaled ------------------------------------------------------------------------------------------------------


def ramp(size, along):
    """Return a pair whose grey level is the place along an axis, and whose truth is that grey level."""
    values = np.indices(size)[along].astype(np.float32)
    return Views(values.astype(np.uint8), values.astype(np.uint8), values, values + 1)


@pytest.mark.parametrize("along", [0, 1])
def test_truth_and_image_keep_together_and_disparities_follow_the_width(along):
    views, sizes = ramp((120, 200), along), set()
    for seed in range(12):
        actual = rescaled(np.random.default_rng(seed), views)
        rows, columns = actual.left.shape
        sizes.add((rows, columns))
        assert_views(actual, (rows, columns))
        assert 0.6 * 120 - 1 <= rows <= 1.6 * 120 + 1 and 0.6 * 200 - 1 <= columns <= 1.6 * 200 + 1
        factor = columns / 200
        np.testing.assert_allclose(actual.occ - actual.noc, factor, rtol=1e-4)
        was = actual.noc / factor
        assert np.abs(was - np.rint(was)).max() < 1e-3  # taken from one pixel, never mixed
        step = (120 / rows, 200 / columns)[along]
        assert np.abs(was - actual.left).max() <= 0.5 * step + 1  # half a pixel, and rounding
        at = (np.indices(actual.noc.shape)[along] + 0.5) * step - 0.5
        assert np.abs(was - at).max() <= 0.5 + 0.01 * step
        np.testing.assert_array_equal(actual.left, actual.right)
    assert len(sizes) == 12
    assert len({round(100 * (r / 120) / (c / 200)) for r, c in sizes}) > 6  # width and height differ too


def test_rescaling_keeps_gaps_gaps():
    views = scene(CAR, POLE)
    for seed in range(6):
        actual = rescaled(np.random.default_rng(seed), views)
        factor = np.float32(actual.left.shape[1] / SIZE[1])
        known = actual.occ[np.isfinite(actual.occ)]
        assert {round(float(v)) for v in np.unique(known / factor)} == {FAR, CAR.d, POLE.d}
        assert abs(np.isfinite(actual.noc).mean() - np.isfinite(views.noc).mean()) < 0.03
        assert not (np.isfinite(actual.noc) & np.isnan(actual.occ)).any()


def test_nothing_gets_smaller_than_64_pixels():
    views = ramp((30, 40), 1)
    for seed in range(6):
        actual = rescaled(np.random.default_rng(seed), views)
        assert actual.left.shape == (64, 64)
        assert np.nanmax(actual.noc) == pytest.approx(39 * 64 / 40)


# --- photographed --------------------------------------------------------------------------------------------------


def test_exposure_leaves_the_truth_and_the_order_of_grey_levels():
    image = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 400, axis=1)
    views = Views(image, image.copy(), *np.full((2, 256, 400), 5, np.float32))
    levels = []
    for seed in range(12):
        actual = photographed(np.random.default_rng(seed), views)
        assert_views(actual, (256, 400))
        np.testing.assert_array_equal(actual.noc, views.noc)
        np.testing.assert_array_equal(actual.occ, views.occ)
        for view in (actual.left, actual.right):
            mean = view.mean(axis=1)
            assert (np.diff(cv2.blur(mean, (1, 9)).ravel()) > -0.5).all()  # noise apart, and clipped, never wrapped
            assert mean[-1] > 128 and mean[0] < 40
        levels.append((actual.left.mean(), actual.right.mean(), actual.left.std(axis=1).max()))
    left, right, noise = np.array(levels).T
    assert np.ptp(left) > 20 and (left != right).all() and np.abs(left - right).max() < 20
    assert np.ptp(noise) > 0.5 and noise.max() < 15


def test_noise_differs_between_the_views():
    flat = np.full((80, 80), 120, np.uint8)
    views = Views(flat, flat, *np.full((2, 80, 80), 5, np.float32))
    actual = [photographed(np.random.default_rng(seed), views) for seed in range(8)]
    correlations = []
    for one in actual:
        a, b = (view - view.mean() for view in (one.left, one.right))
        if a.std() > 0.5:
            correlations.append((a * b).mean() / (a.std() * b.std()))
    assert len(correlations) >= 3 and np.abs(correlations).max() < 0.1
