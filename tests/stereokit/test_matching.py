"""The pipeline: what every method promises, and that fused and staged matching agree bit for bit."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import oracles
import pytest
from numba.core.dispatcher import Dispatcher

import stereokit
from stereokit import Disparity, Matcher, OptionError, aggregate, cost_volume, match, select
from stereokit import settings as settings_module
from stereokit.postprocess import fill, median, remove_speckles, single_matching_phase

METHODS = list(stereokit.METHODS.values())
PLAIN = {"smooth": 0, "uniqueness": 0, "speckle": 0, "border_cost": 1.0}
"""No smoothing before and no clean-up after matching but what a test asks for."""
RAW = {**PLAIN, "smp": False, "fill": None, "median": 0, "confidence": True}
"""No post-processing at all: what selection gives."""
COST = {"census": {"window": "9x7"}, "zncc": {"window": 5, "steps": 63}}
AGGREGATION = {
    "census+sgm": {"p1": 7, "p2": 85, "paths": 8},
    "zncc+sgm": {"p1": 0.3, "p2": 85 / 63, "paths": 8},
    "census+dt": {"sigma_s": 20, "sigma_r": 30, "sigma_v": 8},
    "zncc+dt": {"sigma_s": 20, "sigma_r": 30, "sigma_v": 8},
}
"""Said in full, because defaults differ from one method to another and stages do not know of methods. With penalties up
to 85 the sums of three brackets are bytes, as with the defaults, so that no other kernels need be compiled."""


def shifted(shift, shape=(24, 60), seed=0):
    """Return a pair of noise whose disparity is `shift` wherever both see it (it wraps around)."""
    left = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return left, np.roll(left, -shift, axis=1)


def staged(left, right, method, minimum, maximum, border_cost=1.0, subpixel=True, cost=None, aggregation=None):
    """Return disparity, cost and confidence from the three public stages."""
    cost_name, aggregation_name = method.split("+")
    levels = {"min_disparity": minimum, "max_disparity": maximum, "border_cost": border_cost}
    volume = cost_volume(left, right, cost_name, **levels, **{**COST[cost_name], **(cost or {})})
    options = {**AGGREGATION[method], **(aggregation or {})}
    maker = {"census": stereokit.Census, "zncc": stereokit.Zncc}[cost_name](**{**COST[cost_name], **(cost or {})})
    total = aggregate(volume, left, aggregation_name, cost=maker, **options)
    return select(total, min_disparity=minimum, subpixel=subpixel)


def in_full(method, **options):
    """Return the options of a `Matcher` of which none is left to a default that matters."""
    return {**COST[method.split("+")[0]], **AGGREGATION[method], **options}


def assert_fused_is_staged(left, right, method, minimum, maximum, border_cost=1.0, cost=None, **aggregation):
    levels = {"min_disparity": minimum, "max_disparity": maximum, "border_cost": border_cost}
    options = in_full(method, **{**RAW, **levels, **(cost or {}), **aggregation})
    fused = Matcher(method, **options)(left, right)
    disparity, _, confidence = staged(
        left, right, method, minimum, maximum, border_cost, cost=cost, aggregation=aggregation
    )
    if left.size == 1:  # a single pixel has no texture, which the stages do not ask for
        assert np.isnan(fused.disparity).all() and not fused.valid.any() and not fused.confidence.any()
        return
    np.testing.assert_array_equal(fused.disparity, disparity)
    np.testing.assert_array_equal(fused.confidence, confidence)
    assert fused.valid.all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", [(9, 13), (8, 20), (1, 17), (17, 1), (1, 1), (2, 3)])
@pytest.mark.parametrize(("minimum", "count"), [(0, 16), (0, 1), (-7, 12), (3, 64), (-30, 65), (40, 5)])
def test_fused_is_staged(random_pair, method, shape, minimum, count):
    left, right = random_pair(*shape, seed=1)
    for border_cost in (1.0, 0.5, None):
        assert_fused_is_staged(left, right, method, minimum, minimum + count, border_cost)


@pytest.mark.parametrize("method", ["census+sgm", "zncc+sgm"])
@pytest.mark.parametrize("paths", [4, 5, 8])
def test_fused_is_staged_for_every_number_of_paths(random_pair, method, paths):
    left, right = random_pair(9, 21, seed=2)
    assert_fused_is_staged(left, right, method, -3, 20, paths=paths)


@pytest.mark.parametrize("method", ["census+dt", "zncc+dt"])
@pytest.mark.parametrize("options", [{"mode": "sum"}, {"passes": 3}, {"sigma_s": 5.0, "sigma_r": 90.0}])
def test_fused_is_staged_for_every_domain_transform(random_pair, method, options):
    left, right = random_pair(9, 21, seed=3)
    assert_fused_is_staged(left, right, method, -3, 20, **options)


def test_fused_is_staged_for_other_windows(random_pair):
    left, right = random_pair(9, 21, seed=4)
    assert_fused_is_staged(left, right, "census+sgm", 0, 16, cost={"window": "5x5"}, p1=3, p2=60)
    assert_fused_is_staged(left, right, "zncc+dt", 0, 16, cost={"window": 9})


@pytest.mark.parametrize("method", ["census+sgm", "zncc+sgm"])
def test_the_whole_chain_against_loops(random_pair, method):
    left, right = random_pair(9, 14, seed=5)
    name = method.split("+")[0]
    p1, p2 = {"census": (7, 86), "zncc": (0.3, 2.0)}[name]
    scale = {"census": 1, "zncc": 63}[name]
    if name == "census":
        volume = oracles.census(left, right, -2, 8)
    else:
        volume = np.floor(63 * oracles.zncc(left, right, -2, 8) + 0.5).astype(int)
    directions = oracles.DIRECTIONS[8]
    total = oracles.sgm(volume, round(p1 * scale), round(p2 * scale), directions, left, 8, 0.5)
    disparity, cost, _ = oracles.select(total, -2)
    expected = oracles.fill(oracles.single_matching_phase(disparity.astype(np.float32), cost), "background")
    options = {
        "p1": p1,
        "p2": p2,
        "edge": 8,
        "edge_factor": 0.5,
        "smp": True,
        "fill": "background",
        "median": 0,
    }
    levels = {"min_disparity": -2, "max_disparity": 6}
    result = Matcher(method, **in_full(method, **PLAIN, **levels, **options))(left, right)
    np.testing.assert_allclose(result.disparity, expected, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("mode", ["background", "nearest"])
def test_post_processing_is_consistency_speckles_filling_median(random_pair, method, mode):
    left, right = random_pair(16, 40, seed=6)
    disparity, cost, confidence = staged(left, right, method, 0, 16)
    options = {
        "confidence": True,
        "fill": mode,
        "median": 3,
        "smp": True,
        "speckle": 0.01,
        "max_disparity": 16,
    }
    result = Matcher(method, **in_full(method, **{**PLAIN, **options}))(left, right)
    consistent = remove_speckles(single_matching_phase(disparity, cost), 6)  # 0.01 of 640 pixels
    np.testing.assert_array_equal(result.valid, ~np.isnan(consistent))
    np.testing.assert_array_equal(result.disparity, median(fill(consistent, mode), 3))
    np.testing.assert_array_equal(result.confidence, np.where(result.valid, confidence, 0))
    assert 0 < result.density < 1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("percent", [0.5, 10, 100])
def test_uniqueness_is_a_margin_below_which_pixels_are_invalid(random_pair, method, percent):
    left, right = random_pair(12, 40, seed=15)
    disparity, _, confidence = staged(left, right, method, -2, 14)
    options = {**RAW, "uniqueness": percent, "min_disparity": -2, "max_disparity": 14}
    result = Matcher(method, **in_full(method, **options))(left, right)
    np.testing.assert_array_equal(result.valid, confidence >= np.float32(percent / 100))
    np.testing.assert_array_equal(result.disparity, np.where(result.valid, disparity, np.nan))
    np.testing.assert_array_equal(result.confidence, np.where(result.valid, confidence, 0))


@pytest.mark.parametrize("scale", [1, 0.5])
@pytest.mark.parametrize("method", [*METHODS, "s1", " Zncc + SGM "])
@pytest.mark.parametrize(("minimum", "maximum"), [(0, 16), (-5, 9), (2, 33)])
def test_contract(random_pair, method, scale, minimum, maximum):
    left, right = random_pair(23, 47, seed=7)
    matcher = Matcher(method, scale=scale, min_disparity=minimum, max_disparity=maximum, confidence=True, right=True)
    result = matcher(left, right)
    assert isinstance(result, Disparity)
    assert matcher.method in METHODS
    assert (matcher.scale, matcher.min_disparity, matcher.max_disparity) == (scale, minimum, maximum)
    for array in (result.disparity, result.confidence, result.right):
        assert array.dtype == np.float32
        assert array.shape == (23, 47)
        assert np.isfinite(array).all()
    assert result.valid.dtype == bool
    assert result.valid.shape == (23, 47)
    for array in (result.disparity, result.right):
        assert array.min() >= minimum - 1
        assert array.max() <= maximum
    assert result.confidence.min() >= 0
    assert result.confidence.max() <= 1
    assert (result.confidence[~result.valid] == 0).all()
    again = matcher(left, right)
    other = match(left, right, method, scale=scale, min_disparity=minimum, max_disparity=maximum)
    np.testing.assert_array_equal(result.disparity, again.disparity)
    np.testing.assert_array_equal(result.right, again.right)
    np.testing.assert_array_equal(result.disparity, other)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1, 0.5])
def test_without_fill_invalid_pixels_are_nan_and_only_those(random_pair, method, scale):
    left, right = random_pair(23, 47, seed=8)
    for nothing in (None, "none"):
        result = Matcher(method, scale=scale, max_disparity=16, fill=nothing)(left, right)
        np.testing.assert_array_equal(np.isnan(result.disparity), ~result.valid)
        assert not result.valid.all()
        assert result.confidence is None
        assert result.right is None


@pytest.mark.parametrize("method", METHODS)
def test_a_shifted_image_returns_its_shift(method):
    left, right = shifted(9)
    result = Matcher(method, max_disparity=32, subpixel=False)(left, right)
    assert (result.disparity[:, 18:-4] == 9).all()
    assert result.valid[:, 18:-4].mean() > 0.99  # a filter as wide as dt's may lose a match to one beyond the border
    left, right = shifted(-6)
    result = Matcher(method, min_disparity=-12, max_disparity=8, subpixel=False)(left, right)
    assert (result.disparity[:, 4:46] == -6).all()


@pytest.mark.parametrize("method", METHODS)
def test_the_right_map_is_the_left_map_of_the_mirrored_pair(random_pair, method):
    left, right = shifted(5, seed=9)
    matcher = Matcher(method, max_disparity=16, right=True)
    result = matcher(left, right)
    mirrored = matcher(right[:, ::-1], left[:, ::-1])
    np.testing.assert_array_equal(result.right, mirrored.disparity[:, ::-1])
    np.testing.assert_array_equal(result.disparity, mirrored.right[:, ::-1])
    assert abs(result.right[:, 8:40] - 5).max() < 1


def test_the_right_map_of_floats_with_bad_pixels(random_pair):
    left, right = (image.astype(np.float32) * 3 for image in shifted(5, seed=10))
    left[3, 30], right[9, 20] = np.nan, np.inf
    result = Matcher("zncc+sgm", max_disparity=16, right=True, fill=None, median=0)(left, right)
    assert np.isnan(result.right[9, 20])
    assert np.isnan(result.disparity[3, 30])
    known = result.right[:, 8:40]
    assert abs(known[~np.isnan(known)] - 5).max() < 1
    assert np.isnan(known).mean() < 0.02


DULL = {
    "one pixel": (1, 1),
    "one row": (1, 40),
    "one column": (40, 1),
    "narrower than the range": (9, 12),
    "wider than the range": (9, 70),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1, 0.5])
@pytest.mark.parametrize("shape", DULL.values(), ids=DULL)
@pytest.mark.parametrize("content", ["constant", "noise"])
def test_maps_are_dense_whatever_the_images(method, scale, shape, content):
    left = right = np.full(shape, 77, np.uint8)
    if content == "noise":
        left, right = shifted(0, shape)
    result = Matcher(method, max_disparity=32, scale=scale, confidence=True)(left, right)
    assert ((result.confidence >= 0) & (result.confidence <= 1)).all()
    assert np.count_nonzero(np.isnan(result.disparity)) == 0
    assert result.disparity.min() >= -1
    assert result.disparity.max() <= 32


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("levels", [(5, 32), (40, 60), (-60, -40)])
def test_maps_are_dense_or_the_smallest_disparity(random_pair, method, levels):
    """Without one valid pixel there is nothing to fill from: the map is the smallest disparity everywhere."""
    left, right = random_pair(9, 30, seed=11)
    result = Matcher(method, min_disparity=levels[0], max_disparity=levels[1])(left, right)
    assert not np.isnan(result.disparity).any()
    if not result.valid.any():
        assert (result.disparity == levels[0]).all()


@pytest.mark.parametrize("method", METHODS)
def test_one_matcher_takes_images_of_any_size(random_pair, method):
    matcher = Matcher(method, max_disparity=16)
    for shape in [(9, 30), (3, 5), (20, 41), (9, 30)]:
        left, right = random_pair(*shape, seed=12)
        expected = Matcher(method, max_disparity=16)(left, right).disparity
        np.testing.assert_array_equal(matcher(left, right).disparity, expected)
        wide = (left.astype(np.uint16) * 16, right.astype(np.uint16) * 16)
        assert matcher(*wide).disparity.shape == shape


@pytest.mark.parametrize("method", METHODS)
def test_half_size_keeps_full_size_pixels(method):
    left, right = shifted(12, (40, 120), 13)
    left, right = (np.kron(image[::2, ::2], np.ones((2, 2), np.uint8)) for image in (left, right))
    disparity = match(left, right, method, max_disparity=32, scale=0.5)
    assert disparity.shape == (40, 120)
    assert abs(np.median(disparity[:, 40:]) - 12) < 0.5


class Keeping:
    """A refiner that keeps what it was given, and gives back a map with a confidence of 0.25."""

    def __call__(self, coarse, left, *, threads=1):
        self.coarse = coarse
        shape = left.shape
        return Disparity(np.zeros(shape, np.float32), np.ones(shape, bool), np.full(shape, 0.25, np.float32))


class Needing(Keeping):
    needs_confidence = True


class Declining(Keeping):
    needs_confidence = False


@pytest.mark.parametrize("method", METHODS)
def test_a_refiner_that_needs_a_confidence_is_given_it(random_pair, method):
    left, right = random_pair(30, 50, seed=15)
    options = {"max_disparity": 16, "scale": 0.5}
    kinds = [(kind(), confidence) for kind in (Keeping, Declining, Needing) for confidence in (False, True)]
    for refiner, confidence in kinds:
        result = Matcher(method, refiner=refiner, confidence=confidence, **options)(left, right)
        assert (refiner.coarse.confidence is None) == (not confidence and not isinstance(refiner, Needing))
        if confidence:
            assert (result.confidence == 0.25).all()
        else:
            assert result.confidence is None  # whatever the refiner returns
    coarse_maps = [refiner.coarse for refiner, _ in kinds]
    for coarse in coarse_maps:
        np.testing.assert_array_equal(coarse.disparity, coarse_maps[0].disparity)
        np.testing.assert_array_equal(coarse.valid, coarse_maps[0].valid)
        if coarse.confidence is not None:
            assert coarse.confidence.shape == (15, 25) and coarse.confidence.dtype == np.float32
            np.testing.assert_array_equal(coarse.confidence, coarse_maps[-1].confidence)
    assert (coarse_maps[-1].confidence[~coarse_maps[-1].valid] == 0).all()
    assert 0 <= coarse_maps[-1].confidence.min() < coarse_maps[-1].confidence.max() <= 1


class Choosing(Keeping):
    needs_candidates = True


@pytest.mark.parametrize("method", METHODS)
def test_a_refiner_that_needs_candidates_is_given_what_the_costs_alone_say(random_pair, method):
    left, right = random_pair(31, 50, seed=17)
    options = {"max_disparity": 20, "min_disparity": -4, "scale": 0.5, "uniqueness": 2}
    refiner, plain, raw = Choosing(), Needing(), Keeping()
    result = Matcher(method, refiner=refiner, **options)(left, right)
    assert result.confidence is None and result.candidates is None
    Matcher(method, refiner=plain, **options)(left, right)
    assert plain.coarse.candidates is None
    for name in ("disparity", "valid", "confidence"):
        np.testing.assert_array_equal(getattr(refiner.coarse, name), getattr(plain.coarse, name))
    unfiltered = {"smp": False, "speckle": 0, "median": 0, "fill": None, "uniqueness": 0}
    Matcher(method, refiner=raw, **{**options, **unfiltered})(left, right)
    best, rival = refiner.coarse.candidates
    assert refiner.coarse.candidates.dtype == np.float32 and best.shape == (16, 25)
    np.testing.assert_array_equal(best, raw.coarse.disparity)
    assert (np.abs(rival - best) > 1).all()
    assert ((rival >= -2) & (rival < 10)).all() and (rival == np.round(rival)).all()


def test_the_right_view_is_refined_with_its_own_confidence(random_pair):
    left, right = random_pair(30, 50, seed=16)
    seen = []

    class All(Needing):
        def __call__(self, coarse, left, *, threads=1):
            seen.append(coarse)
            return super().__call__(coarse, left)

    result = Matcher("census+sgm", max_disparity=16, scale=0.5, refiner=All(), right=True)(left, right)
    assert result.confidence is None and result.right is not None
    flipped = Matcher("census+sgm", max_disparity=16, scale=0.5, refiner=All())
    flipped(right[:, ::-1].copy(), left[:, ::-1].copy())
    assert len(seen) == 3
    np.testing.assert_array_equal(seen[1].confidence, seen[2].confidence)
    assert (seen[0].confidence != seen[1].confidence).any()


def test_a_matcher_says_what_it_does():
    text = repr(Matcher("S2", max_disparity=16, paths=4))
    assert "census+sgm" in text
    assert "max_disparity=16" in text
    assert "paths=4" in text
    assert stereokit.METHODS == {"S1": "census+dt", "S2": "census+sgm", "S3": "zncc+dt", "S4": "zncc+sgm"}


@pytest.mark.parametrize("shift", [2100, -2100])
def test_disparities_of_thousands_of_pixels(shift):
    left, right = shifted(shift, (9, 2300))
    disparity = match(left, right, "census+sgm", min_disparity=shift - 5, max_disparity=shift + 6, subpixel=False)
    seen = slice(2115, -15) if shift > 0 else slice(15, 180)
    assert (disparity[:, seen] == shift).mean() > 0.99


def signatures():
    """Return how many signatures each kernel of the package is compiled for."""
    modules = [module for name, module in sys.modules.items() if name.startswith("stereokit.")]
    kernels = {f"{module.__name__}.{key}": value for module in modules for key, value in list(vars(module).items())}
    return {name: len(value.signatures) for name, value in kernels.items() if isinstance(value, Dispatcher)}


def test_after_a_warmup_nothing_is_compiled(random_pair):
    stereokit.warmup("S2", max_disparity=16)
    ready = signatures()
    assert ready["stereokit.aggregation.paths.visits.first_visit"] > 0
    Matcher("S2", max_disparity=16)(*random_pair(30, 40))
    assert signatures() == ready


def test_twelve_megapixels():
    # Penalties below 86 keep the sums of SGM in bytes: 0.8 GB for the one volume that it holds.
    left, right = shifted(11, (3000, 4000), 14)
    options = {"p1": 10, "p2": 80, "paths": 8, "subpixel": False, "median": 0, "smooth": 0}
    result = Matcher("census+sgm", max_disparity=16, **options)(left, right)
    assert (result.disparity[:, 20:-8] == 11).mean() > 0.999
    assert (result.disparity[[0, 1499, 1500, 2999], 20:-8] == 11).all()


@pytest.mark.data
@pytest.mark.parametrize("method", METHODS)
def test_a_real_pair_is_matched(data_root, method):
    """Under a quarter of the pixels of Middlebury's Cones, hidden ones included, may be off by more than two."""
    folder = data_root / "middlebury/2003/cones"
    files = [next(folder.glob(f"{name}.*"), None) for name in ("im2", "im6", "disp2")]
    if None in files:
        pytest.skip(f"no Middlebury Cones in {data_root}; set STEREOKIT_DATA")
    left, right = (cv2.imread(str(path))[:, :, ::-1] for path in files[:2])
    truth = cv2.imread(str(files[2]), cv2.IMREAD_GRAYSCALE) / 4
    error = abs(match(left, right, method, max_disparity=64) - truth)[truth > 0]
    assert (error > 2).mean() < 0.25


def test_identity_is_what_a_map_depends_on():
    matcher = Matcher("S4", max_disparity=32, threads=1)
    identity = matcher.identity()
    assert json.loads(json.dumps(identity)) == identity
    assert identity == Matcher("zncc+sgm", max_disparity=32, threads=2, device="cpu").identity()
    assert not {"threads", "device"} & set(identity)
    others = ({"p1": 0.5}, {"median": 3}, {"fill": None}, {"min_disparity": -1}, {"scale": 0.5}, {"window": 7})
    identities = [Matcher("S4", **{"max_disparity": 32, **options}).identity() for options in others]
    assert all(other != identity for other in identities)


def test_the_old_name_of_the_border_cost_still_works():
    assert Matcher("S2", outside=None).identity() == Matcher("S2", border_cost=None).identity()
    assert Matcher("S2").replaced(outside=0.25).settings.border_cost == 0.25
    image = np.arange(64, dtype=np.uint8).reshape(4, 16)
    volumes = [
        stereokit.cost_volume(image, image, max_disparity=4, **{name: 0.25}) for name in ("outside", "border_cost")
    ]
    np.testing.assert_array_equal(*volumes)
    assert not np.array_equal(volumes[0], stereokit.cost_volume(image, image, max_disparity=4))
    with pytest.raises(OptionError, match="outside is the old name of border_cost, got both"):
        Matcher("S2", outside=1, border_cost=1)


def test_a_matcher_with_changes_leaves_the_first_as_it_was(random_pair):
    left, right = random_pair(20, 40)
    matcher = Matcher("S2", max_disparity=16)
    second = matcher.replaced(fill=None, median=0)
    assert (second.settings.fill, second.settings.median) == (None, 0)
    expected = Matcher("S2", max_disparity=16, fill=None, median=0)(left, right)
    np.testing.assert_array_equal(second(left, right).disparity, expected.disparity)
    assert (matcher.settings.fill, matcher.settings.median) == ("nearest", 5)
    with pytest.raises(OptionError, match="median must be 0, 3 or 5"):
        matcher.replaced(median=4)
    with pytest.raises(AttributeError):
        matcher.settings.fill = None


def test_matching_takes_weights_that_were_written_anew(tmp_path, monkeypatch):
    seen = []

    class Refiner:
        def __init__(self, weights):
            content = Path(weights).read_text()
            seen.append(content)
            self.value = float(content)

        def __call__(self, coarse, left, *, threads=1):
            return Disparity(np.full(left.shape, self.value, np.float32), np.ones(left.shape, np.bool_))

    monkeypatch.setattr(settings_module, "find_refiner", lambda path: (path, lambda: Refiner(path), []))
    path = tmp_path / "w.safetensors"
    image = np.zeros((8, 12), np.uint8)
    path.write_text("3")
    assert match(image, image, "S2", max_disparity=4, scale=0.5, refiner=str(path))[0, 0] == 3
    assert match(image, image, "S2", max_disparity=4, scale=0.5, refiner=str(path))[0, 0] == 3
    path.write_text("25")
    assert match(image, image, "S2", max_disparity=4, scale=0.5, refiner=str(path))[0, 0] == 25
    assert seen == ["3", "25"]
