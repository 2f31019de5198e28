"""The contract of `stereokit_refiners.contract`, for every learned refiner: with random weights, and tuned to KITTI."""

from __future__ import annotations

import dataclasses
import pickle
import threading

import numpy as np
import oracles
import pytest
from refining import (
    LEARNED,
    NAMES,
    NAN,
    coarse_of,
    flat_ranges,
    half_of,
    image_of,
    one_line,
    random_content,
    sure,
    tuned_to_kitti,
    weight_file,
)

import stereokit
from stereokit import Disparity
from stereokit.errors import OptionError, StereokitError
from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.weights import NETWORKS

SIZES = [(32, 48), (33, 47), (1, 1), (1, 9), (9, 1), (2, 3), (18, 30), (31, 16)]


@pytest.fixture(params=[f"random {name}" for name in NAMES] + [f"kitti {name}" for name in NAMES])
def refiner(request):
    """Return each architecture with random weights, and tuned to KITTI."""
    origin, name = request.param.split()
    if origin == "random":
        return LearnedRefiner.of(random_content(name), precision="fp32" if "openvino" in LEARNED else "auto")
    tuned_to_kitti(name)
    return stereokit.REFINERS.get(name)(weights="kitti")


@pytest.fixture(params=NAMES)
def exact(request):
    """Return each architecture with random weights in fp32."""
    return LearnedRefiner.of(random_content(request.param), precision="fp32")


@pytest.mark.parametrize("size", SIZES)
def test_shapes_types_and_untouched_inputs(refiner, size):
    coarse, left = coarse_of(size, gaps=0.1), image_of(size)
    original = [np.copy(a) for a in (*vars(coarse).values(), left) if a is not None]
    fine = refiner(coarse, left)
    for array, dtype in ((fine.disparity, np.float32), (fine.valid, np.bool_), (fine.confidence, np.float32)):
        assert array.shape == size
        assert array.dtype == dtype
    for before, after in zip(original, (a for a in (*vars(coarse).values(), left) if a is not None), strict=True):
        np.testing.assert_array_equal(before, after)
    for mine in (fine.disparity, fine.valid, fine.confidence):
        for theirs in (coarse.disparity, coarse.valid, coarse.confidence, coarse.candidates, left):
            assert not np.shares_memory(mine, theirs)


@pytest.mark.parametrize("name", NAMES)
def test_refiners_say_what_they_need_beside_the_map(name):
    refiner = LearnedRefiner.of(random_content(name))
    for needs, what in ((refiner.needs_confidence, "confidence"), (refiner.needs_candidates, "candidates")):
        assert needs is (what in NETWORKS[name].inputs)
        assert needs is (name == "pyramid")


@pytest.mark.parametrize("missing", ["confidence", "candidates"])
def test_a_bare_map_is_refined_without_or_refused(refiner, missing):
    coarse, left = coarse_of((18, 30)), image_of((18, 30))
    bare = dataclasses.replace(coarse, **{missing: None})
    if not getattr(refiner, f"needs_{missing}"):
        fine = refiner(bare, left)
        assert (fine.confidence is None) == (missing == "confidence") and fine.candidates is None
        np.testing.assert_array_equal(fine.disparity, refiner(coarse, left).disparity)
        return
    with pytest.raises(OptionError) as caught:
        refiner(bare, left)
    rule = f"coarse must come with {missing} for this refiner, as stereokit.Matcher gives it, got none"
    assert one_line(caught.value) == rule


@pytest.mark.parametrize("what", ["confidence", "candidates"])
def test_confidence_and_candidates_decide_where_they_are_looked_at_and_nowhere_else(exact, what):
    coarse, left = coarse_of((32, 48)), image_of((32, 48))
    changed = getattr(coarse, what).copy()
    changed[..., 4:8, 4:8] = 1 - changed[..., 4:8, 4:8]
    other = dataclasses.replace(coarse, **{what: changed})
    moved = exact(other, left).disparity != exact(coarse, left).disparity
    assert moved.any() == getattr(exact, f"needs_{what}")


@pytest.mark.parametrize("down", [1, 40])
def test_disparities_below_zero_are_refined_like_those_above(exact, down):
    coarse, left = coarse_of((33, 47), gaps=0.1, low=0.2), image_of((33, 47))
    above = dataclasses.replace(coarse, disparity=coarse.disparity.copy(), candidates=np.abs(coarse.candidates))
    above.disparity[:2] = above.candidates[0, 0, 0] = 0  # so that both have the same lowest level
    below = dataclasses.replace(above, disparity=above.disparity - np.float32(down), candidates=above.candidates - down)
    actual, expected = exact(below, left), exact(above, left)
    np.testing.assert_allclose(actual.disparity, expected.disparity - 2 * down, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(actual.valid, expected.valid)


@pytest.mark.parametrize("size", [(33, 47), (1, 9)])
def test_the_same_call_gives_the_same_bits_with_any_threads(refiner, size):
    coarse, left = coarse_of(size, gaps=0.1), image_of(size)
    first = refiner(coarse, left, threads=1)
    for threads in (1, 2, 3):
        again = refiner(coarse, left, threads=threads)
        np.testing.assert_array_equal(again.disparity, first.disparity)
        np.testing.assert_array_equal(again.valid, first.valid)
        np.testing.assert_array_equal(again.confidence, first.confidence)


def test_results_of_earlier_calls_stay(refiner):
    first = refiner(coarse_of((16, 16)), image_of((16, 16))).disparity
    original = first.copy()
    refiner(coarse_of((16, 16), 1), image_of((16, 16), 1))
    np.testing.assert_array_equal(first, original)


def test_four_threads_at_once(refiner):
    sizes = [(20, 30), (33, 17), (20, 30), (9, 40)]
    expected = [refiner(coarse_of(s, k), image_of(s, k)).disparity for k, s in enumerate(sizes)]
    actual = [None] * 4

    def work(k):
        for _ in range(3):
            actual[k] = refiner(coarse_of(sizes[k], k), image_of(sizes[k], k)).disparity

    workers = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for k in range(4):
        np.testing.assert_array_equal(actual[k], expected[k])


@pytest.mark.parametrize("size", [(33, 47), (31, 18), (9, 9), (1, 9)])
def test_odd_sizes_are_the_image_extended_by_hand_and_cut(exact, size):
    rows, columns = size
    coarse, left = coarse_of(size, low=0.0, high=6.0), image_of(size)  # begins as maps of the training do
    height, width = half_of(size)
    stride = NETWORKS[exact._file.network].stride
    below, beside = -height % stride, -width % stride
    by_hand = Disparity(
        np.pad(coarse.disparity, ((0, below), (0, beside)), mode="edge"),
        np.pad(coarse.valid, ((0, below), (0, beside)), mode="edge"),
        np.pad(coarse.confidence, ((0, below), (0, beside)), mode="edge"),
        candidates=np.pad(coarse.candidates, ((0, 0), (0, below), (0, beside)), mode="edge"),
    )
    whole = 2 * (height + below), 2 * (width + beside)
    extended = np.pad(left, ((0, whole[0] - rows), (0, whole[1] - columns)), mode="edge")
    expected = exact(by_hand, extended).disparity
    assert expected.shape == whole
    np.testing.assert_array_equal(exact(coarse, left).disparity, expected[:rows, :columns])


def test_gaps_stay_gaps_and_the_network_sees_them_filled(exact):
    size = (24, 40)
    coarse, left = coarse_of(size, 3, gaps=0.2), image_of(size)
    fine = exact(coarse, left)
    y, x = np.indices(size)
    gap = np.isnan(coarse.disparity)[y // 2, x // 2]
    assert gap.any() and not gap.all()
    np.testing.assert_array_equal(np.isnan(fine.disparity), gap)
    np.testing.assert_array_equal(fine.valid, coarse.valid[y // 2, x // 2])
    np.testing.assert_array_equal(fine.confidence, coarse.confidence[y // 2, x // 2])
    filled = oracles.fill(coarse.disparity, "nearest").astype(np.float32)
    dense = dataclasses.replace(coarse, disparity=filled)
    np.testing.assert_array_equal(exact(dense, left).disparity[~gap], fine.disparity[~gap])


def test_a_pixel_called_valid_that_is_a_gap_is_not_valid(exact):
    coarse = coarse_of((16, 16))
    disparity = coarse.disparity.copy()
    disparity[3, 4] = NAN
    fine = exact(sure(disparity), image_of((16, 16)))
    assert not fine.valid[6:8, 8:10].any()
    assert fine.valid.sum() == 16 * 16 - 4


def test_a_map_of_gaps_only_stays_one(exact):
    nothing = sure(np.full((8, 8), NAN, np.float32), np.zeros((8, 8), bool))
    fine = exact(nothing, image_of((16, 16)))
    assert np.isnan(fine.disparity).all()
    assert not fine.valid.any()


@pytest.mark.parametrize("value", [-37.5, 0.0, 1000.0])
def test_far_negative_and_huge_disparities_are_finite_and_follow(exact, value):
    size = (16, 24)
    flat = sure(np.full(half_of(size), value, np.float32))
    fine = exact(flat, np.full(size, 100, np.uint8))
    assert np.isfinite(fine.disparity).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [-37.5, 12.0, 1000.0])
def test_a_network_that_says_nothing_leaves_a_flat_map_as_it_is(name, value):
    content = random_content(name, last=0.0)
    last = NETWORKS[name].layers[-1].name
    content.arrays[f"{last}.bias"][:] = 0
    refiner = LearnedRefiner.of(content, precision="fp32")
    flat = sure(np.full((8, 12), value, np.float32))
    np.testing.assert_allclose(refiner(flat, image_of((16, 24))).disparity, 2 * value, rtol=1e-5)


def test_a_map_that_is_not_half_the_image_is_refused(exact):
    with pytest.raises(OptionError, match=r"coarse map must be half the size of left \(20, 30\), got \(9, 15\)"):
        exact(coarse_of((18, 30)), image_of((20, 30)))


@pytest.mark.parametrize("name", NAMES)
def test_pickled_refiners_of_a_file_are_the_same(name, tmp_path):
    refiner = LearnedRefiner(weight_file(tmp_path, name), precision="fp32")
    again = pickle.loads(pickle.dumps(refiner))
    assert again == refiner
    assert again.fingerprint == refiner.fingerprint
    coarse, left = coarse_of((16, 24)), image_of((16, 24))
    np.testing.assert_array_equal(again(coarse, left).disparity, refiner(coarse, left).disparity)


def test_pickled_refiners_of_weights_in_memory_are_the_same():
    refiner = LearnedRefiner.of(random_content("cnn"))
    again = pickle.loads(pickle.dumps(refiner))
    assert again.fingerprint == refiner.fingerprint


def test_refiners_of_other_weights_in_memory_are_not_equal():
    one, other = (LearnedRefiner.of(random_content("cnn", seed)) for seed in (0, 1))
    assert one.fingerprint != other.fingerprint
    assert one != other


def test_fingerprints_say_what_the_result_depends_on(tmp_path):
    path = weight_file(tmp_path, "cnn")
    first = LearnedRefiner(path)
    assert first.fingerprint == LearnedRefiner(path).fingerprint
    assert first.fingerprint == LearnedRefiner.of(random_content("cnn")).fingerprint
    others = [
        random_content("cnn", 1),
        random_content("cnn", output_mode="direct"),
        random_content("cnn", ranges=flat_ranges("cnn", 2)),
    ]
    actual = {LearnedRefiner.of(content, precision="auto").fingerprint for content in others} | {first.fingerprint}
    assert len(actual) == 4
    assert first.fingerprint.endswith(f"-{first.backend}-{first.precision}")


# --- what is refused -----------------------------------------------------------------------------------------------


def test_backends_are_checked(tmp_path):
    path = weight_file(tmp_path, "cnn")
    with pytest.raises(
        OptionError, match=r"^backend must be one of auto, openvino, onnxruntime, torch, opencv, got 'tensorrt'$"
    ) as caught:
        LearnedRefiner(path, backend="tensorrt")
    one_line(caught.value)
    with pytest.raises(OptionError, match=r"^precision must be one of auto, fp32, bf16, int8, got 'fp16'$"):
        LearnedRefiner(path, precision="fp16")


@pytest.mark.parametrize("backend", ["onnxruntime", "torch", "opencv"])
@pytest.mark.parametrize("precision", ["bf16", "int8"])
def test_low_precision_needs_openvino(backend, precision):
    if backend not in LEARNED:
        pytest.skip(f"needs {backend}")
    with pytest.raises(OptionError, match=rf"^precision must be fp32 with backend '{backend}', got '{precision}'$"):
        LearnedRefiner.of(random_content("cnn"), backend=backend, precision=precision)
    assert LearnedRefiner.of(random_content("cnn"), backend=backend).precision == "fp32"


def test_int8_needs_ranges():
    pytest.importorskip("openvino")
    with pytest.raises(OptionError, match="precision must not be int8 with weights that were not calibrated for it"):
        LearnedRefiner.of(random_content("cnn"), backend="openvino", precision="int8")
    rough = LearnedRefiner.of(random_content("cnn", ranges=flat_ranges("cnn", 6)), backend="openvino", precision="int8")
    assert np.isfinite(rough(coarse_of((16, 16)), image_of((16, 16))).disparity).all()


def test_the_refiner_file_needs_weights():
    with pytest.raises(
        OptionError, match=r"^refiner 'file' needs weights, the path of a \.safetensors file, got none$"
    ):
        LearnedRefiner()


@pytest.mark.parametrize("name", NAMES)
def test_weights_of_another_network_are_refused_by_name(name, tmp_path):
    other = next(n for n in NAMES if n != name)
    with pytest.raises(OptionError, match=rf"weights of refiner '{name}' must be its own, got those of '{other}'"):
        stereokit.REFINERS.get(name)(weights=weight_file(tmp_path, other))
    assert stereokit.REFINERS.get(name)(weights=weight_file(tmp_path, name)).architecture == name


def test_a_runtime_that_is_not_there_is_named(monkeypatch):
    import importlib.util

    real = importlib.util.find_spec
    gone = {"openvino", "onnxruntime", "torch"}
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n in gone else real(n, *a))
    for backend, extra in {"openvino": "refiners", "onnxruntime": "onnx", "torch": "train"}.items():
        with pytest.raises(StereokitError, match=rf"^backend '{backend}' is not installed: .*stereokit\[{extra}\]'$"):
            LearnedRefiner.of(random_content("cnn"), backend=backend)
    assert LearnedRefiner.of(random_content("cnn")).backend == "opencv"
    monkeypatch.delattr("cv2.dnn")
    with pytest.raises(
        StereokitError, match=r"^backend 'opencv' is not installed: pip install opencv-python-headless$"
    ):
        LearnedRefiner.of(random_content("cnn"), backend="opencv")
    with pytest.raises(
        StereokitError, match=r"^learned refiners need OpenCV's dnn, which this build lacks, or another "
    ):
        LearnedRefiner.of(random_content("cnn"))
