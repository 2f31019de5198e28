"""Whole matches through the interpreter: ``device="cuda"`` gives the CPU's maps, in every pixel and bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba_cuda")

from ptx.interpreter.emulated import EmulatedQueue
from ptx.interpreter.harness import Buffer
from stereokit import Matcher, match_large, matching
from stereokit.cuda import pipeline as cuda_pipeline
from stereokit.errors import DeviceError, InputError
from stereokit.large import matching as large_matching
from stereokit.large.plan import plan
from stereokit.result import Disparity
from stereokit_refiners.linear import Linear

LEVELS = {"max_disparity": 14, "threads": 1}


class _Queue(EmulatedQueue):
    """A queue whose copies last, as those of a caller do."""

    copies = 0

    def copy(self, array: Any) -> Any:
        self.copies += 1
        return self.upload(f"copy {self.copies}", array.values)


@pytest.fixture
def queues(monkeypatch):
    """Make the matcher believe in a GPU whose launches go to the interpreter; return its queues."""
    queues: list[_Queue] = []

    def new_queue(stream: Any) -> _Queue:
        queues.append(_Queue())
        return queues[-1]

    monkeypatch.setattr(cuda_pipeline, "new_queue", new_queue)
    monkeypatch.setattr(matching, "require_device", lambda: None)
    return queues


def _pair(height: int, width: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a textured plane four pixels off, with a patch that matches nothing and a flat one."""
    rng = np.random.default_rng(seed)
    left = rng.integers(0, 256, (height, width), dtype=np.uint8)
    right = np.roll(left, -4, axis=1)
    left[2:5, width // 2 : width // 2 + 9] = rng.integers(0, 256, (3, 9))
    left[-3:, 5:12] = 90
    return left, right


def _same(left: Any, right: Any, method: str, /, **options: Any) -> None:
    want = Matcher(method, device="cpu", **LEVELS, **options)(left, right)
    matcher = Matcher(method, device="cuda", **LEVELS, **options)
    assert matcher.device == "cuda"
    result = matcher(left, right)
    for name in ("disparity", "valid", "confidence", "right"):
        np.testing.assert_array_equal(getattr(result, name), getattr(want, name), name)
    assert result.valid.any()


@pytest.mark.parametrize("method", ["S1", "S2", "S3", "S4"])
def test_the_four_matchers(queues, method):
    _same(*_pair(11, 35), method, confidence=True)
    assert len(queues) == 1


@pytest.mark.parametrize("options", [{"mode": "sum"}, {"passes": 2, "sigma_s": 3, "sigma_v": 2}], ids=["sum", "rf"])
@pytest.mark.parametrize("shape", [(1, 40), (12, 31)])
def test_the_domain_transform(queues, shape, options):
    _same(*_pair(*shape) if shape[0] > 1 else _flat_row(shape[1]), "S1", confidence=True, **options)


def _flat_row(width: int) -> tuple[np.ndarray, np.ndarray]:
    left = np.random.default_rng(1).integers(0, 256, (1, width), dtype=np.uint8)
    return left, np.roll(left, -4, axis=1)


def test_nan_half_size_and_the_right_view(queues):
    left, right = (image.astype(np.float32) + 0.25 for image in _pair(13, 40))
    left[3, 4:7] = np.nan
    right[8, 20] = np.inf
    _same(left, right, "S2", scale=0.5, right=True, speckle=0.02, fill="background", paths=8)


@pytest.mark.parametrize("options", [{"confidence": True, "smooth": 0}, {"scale": 0.5}], ids=["full", "half"])
@pytest.mark.parametrize("method", ["S2", "S4"])
def test_masks_borders_and_areas_without_texture(queues, method, options):
    left, right = _pair(18, 48)
    for image in (left, right):
        image[:16, 14:38] = 120
    left[:, :5] = 0  # a black border
    masks = {"mask": np.arange(48)[None] + 0 * left < 44, "right_mask": np.arange(48)[None] + 0 * left > 2}
    want = Matcher(method, device="cpu", **LEVELS, **options)(left, right, **masks)
    result = Matcher(method, device="cuda", **LEVELS, **options)(left, right, **masks)
    for name in ("disparity", "valid", "confidence"):
        np.testing.assert_array_equal(getattr(result, name), getattr(want, name), name)
    assert result.valid.any() and not result.valid[:6, 24:28].any() and np.isfinite(result.disparity[:6, 24:28]).all()
    assert np.isnan(result.disparity[:, :5]).all() and np.isnan(result.disparity[:, 44:]).all()


def test_what_is_left_out(queues):
    left, right = _pair(7, 24)
    _same(left, right, "S2", smooth=0, smp=False, speckle=0, fill=None, median=0, subpixel=False, uniqueness=10)


def test_blank_images(queues):
    blank = np.full((4, 9), 7, np.uint8)
    matcher = Matcher("S4", device="cuda", **LEVELS)
    want = Matcher("S4", device="cpu", **LEVELS)(blank, blank)
    np.testing.assert_array_equal(matcher(blank, blank).disparity, want.disparity)


class _Recorder:
    """A refiner that records its input."""

    needs_candidates = True

    def __call__(self, coarse: Any, left: Any, *, threads: int = 1) -> Any:
        self.coarse = coarse
        return Disparity(np.zeros(left.shape, np.float32), np.ones(left.shape, bool))


@pytest.mark.parametrize("method", ["S1", "S2"])
def test_candidates(queues, method):
    recorders = {device: _Recorder() for device in ("cpu", "cuda")}
    for device, refiner in recorders.items():
        Matcher(method, device=device, scale=0.5, refiner=refiner, **LEVELS)(*_pair(9, 31))
    for name in ("disparity", "valid", "confidence", "candidates"):
        np.testing.assert_array_equal(*(getattr(refiner.coarse, name) for refiner in recorders.values()))


def test_one_queue_serves_call_after_call_and_sizes(queues):
    matcher = Matcher("S2", device="cuda", **LEVELS)
    host = Matcher("S2", device="cpu", **LEVELS)
    for shape in ((6, 24), (5, 20)):
        pair = _pair(*shape)
        np.testing.assert_array_equal(matcher(*pair).disparity, host(*pair).disparity)
    assert len(queues) == 1


def test_costs_without_a_twin_are_refused(queues):
    with pytest.raises(DeviceError, match="window of zncc must be at most 11 on device 'cuda', got 13"):
        Matcher("S4", device="cuda", window=13)
    assert Matcher("S4", device="cpu", window=13).device == "cpu"


@pytest.fixture
def host_as_device(queues, monkeypatch):
    """Take images of the host for images of the device."""

    def from_device(name: str, image: Any) -> Any:
        channels = 1 if image.ndim == 2 else 3
        return cuda_pipeline._Image(np.ascontiguousarray(image).ravel(), image.dtype, channels, image.shape[:2])

    def flat(array: Any) -> Buffer:
        values = array.values if isinstance(array, Buffer) else np.asarray(array).ravel()
        out = Buffer(values.size, values.dtype)
        out.values[:], out.known[:] = values, 1
        return out

    monkeypatch.setattr(cuda_pipeline, "_from_device", from_device)
    monkeypatch.setattr(cuda_pipeline, "stream_of", lambda stream: stream)
    monkeypatch.setattr(cuda_pipeline, "_reshaped", lambda array, shape: array.values.reshape(shape))
    monkeypatch.setattr(cuda_pipeline, "_flat", flat)


def test_images_of_the_device(host_as_device):
    left, right = (np.repeat(image[:, :, None], 3, axis=2) for image in _pair(8, 26))
    options = {**LEVELS, "right": True, "confidence": True}
    result = Matcher("S2", device="cuda", **options).on_device(left, right, stream=0)
    want = Matcher("S2", device="cpu", **options)(left, right)
    np.testing.assert_array_equal(result.disparity, want.disparity)
    np.testing.assert_array_equal(result.valid != 0, want.valid)
    np.testing.assert_array_equal(result.confidence, want.confidence)
    np.testing.assert_array_equal(result.right, want.right)


@pytest.mark.parametrize("refiner", ["linear", "cnn", "pyramid"])
def test_images_of_the_device_at_half_size(host_as_device, refiner):
    pytest.importorskip("torch")
    pair = _pair(9, 27)
    options = {**LEVELS, "scale": 0.5, "refiner": refiner, "right": True, "confidence": refiner != "cnn"}
    if refiner != "linear":
        pytest.importorskip("stereokit_kitti_weights")
        options["weights"] = "kitti"
    result = Matcher("S2", device="cuda", **options).on_device(*pair, stream=0)
    exact = {} if refiner == "linear" else {"backend": "torch"}
    want = Matcher("S2", device="cpu", **options, **exact)(*pair)
    for name in ("disparity", "right"):
        np.testing.assert_allclose(getattr(result, name), getattr(want, name), rtol=0, atol=2e-3)
    np.testing.assert_array_equal(np.asarray(result.valid) != 0, want.valid)
    if refiner == "cnn":
        assert result.confidence is None
    else:
        np.testing.assert_allclose(result.confidence, want.confidence, rtol=0, atol=1e-6)


@pytest.mark.parametrize("low", [5, -7])
def test_nothing_lies_below_an_odd_minimum_at_half_size(host_as_device, low):
    pytest.importorskip("torch")
    left, _ = _pair(9, 27)
    pair = left, np.roll(left, 1 - low, axis=1)  # a pixel below
    options = {"min_disparity": low, "max_disparity": low + 16, "scale": 0.5, "right": True}
    want = Matcher("S2", device="cpu", **options)(*pair)
    matcher = Matcher("S2", device="cuda", **options)
    np.testing.assert_array_equal(matcher(*pair).disparity, want.disparity)
    result = matcher.on_device(*pair, stream=0)
    for name in ("disparity", "right"):
        assert getattr(want, name).min() == getattr(result, name).min() == low
        np.testing.assert_allclose(getattr(result, name), getattr(want, name), rtol=0, atol=2e-3)


@pytest.mark.parametrize(("refiner", "scale"), [("stereokit", 1), ("stereokit", 0.5), ("auto", 1), ("auto", 0.5)])
def test_the_general_refiner_on_the_device(host_as_device, refiner, scale):
    pytest.importorskip("torch")
    pair = _pair(17, 41)
    low = -3 if refiner == "stereokit" else 0
    options = {**LEVELS, "min_disparity": low, "scale": scale, "right": True, "confidence": True}
    want = Matcher("S2", device="cpu", refiner=refiner, backend="torch", **options)(*pair)
    result = Matcher("S2", device="cuda", refiner=refiner, **options).on_device(*pair, stream=0)
    for name in ("disparity", "right"):
        np.testing.assert_allclose(getattr(result, name), getattr(want, name), rtol=0, atol=1e-3)
    np.testing.assert_array_equal(np.asarray(result.valid) != 0, want.valid)
    np.testing.assert_allclose(result.confidence, want.confidence, rtol=0, atol=1e-4)
    plain = Matcher("S2", device="cpu", refiner="linear", **options)(*pair)
    assert np.abs(want.disparity - plain.disparity).max() > 0.02 < np.abs(want.right - plain.right).max()


def test_a_gpu_refines_no_map_that_says_where_to_search(host_as_device):
    pytest.importorskip("torch")
    pair = _pair(17, 41)
    options = {"max_disparity": 64, "refiner": "stereokit", "backend": "torch", "threads": 1}
    assert Matcher("S2", device="cpu", **options).settings.refines_search
    want = Matcher("S2", device="cpu", search="full", **options)(*pair)
    result = Matcher("S2", device="cuda", **options).on_device(*pair, stream=0)
    np.testing.assert_allclose(result.disparity, want.disparity, rtol=0, atol=1e-3)


def test_auto_upscales_small_images_linearly_on_the_device(host_as_device):
    pytest.importorskip("torch")
    pair = _pair(9, 27)
    for scale in (1, 0.5):
        maps = [
            Matcher("S2", device="cuda", scale=scale, refiner=refiner, **LEVELS).on_device(*pair, stream=0)
            for refiner in ("auto", "linear")
        ]
        np.testing.assert_array_equal(*(result.disparity for result in maps))
        want = Matcher("S2", device="cpu", scale=scale, refiner="linear", **LEVELS)(*pair)
        np.testing.assert_array_equal(maps[1].disparity, want.disparity)


class _DeviceRecorder:
    """A refiner on the device that records its calls, and returns a ramp from -100 to 100."""

    def __init__(self, **attributes: Any) -> None:
        self.calls: list[tuple[Any, Any, dict[str, Any]]] = []
        vars(self).update(attributes)

    def __call__(self, coarse: Any, left: Any, *, threads: int = 1, **keywords: Any) -> Any:
        raise AssertionError

    def on_device(self, coarse: Any, left: Any, stream: Any, **keywords: Any) -> Any:
        self.calls.append((coarse, left.copy(), {name: np.copy(value) for name, value in keywords.items()}))
        values = np.linspace(-100, 100, left.size, dtype=np.float32).reshape(left.shape)
        return values, np.ones(left.shape, np.uint8), None


@pytest.mark.parametrize("scale", [1, 0.5])
def test_refiners_on_the_device_get_what_they_ask_for(host_as_device, scale):
    left, right = _pair(9, 27)
    refiner = _DeviceRecorder(needs_right=True, any_scale=True, needs_candidates=True)
    options = {"min_disparity": -5, "max_disparity": 9, "scale": scale, "right": True, "threads": 1}
    result = Matcher("S2", device="cuda", refiner=refiner, **options).on_device(left, right, stream=0)
    views = (left, right), (right[:, ::-1], left[:, ::-1])  # the second as a camera behind a mirror sees them
    assert len(refiner.calls) == 2
    for (coarse, one, keywords), pair in zip(refiner.calls, views, strict=True):
        np.testing.assert_array_equal(one, pair[0])
        np.testing.assert_array_equal(keywords.pop("right"), pair[1])
        assert keywords == {"scale": scale}
        shape = tuple(round(side * scale + 0.1) for side in (9, 27))
        assert coarse.disparity.shape == coarse.confidence.shape == shape and coarse.candidates.shape == (2, *shape)
    for disparity in (result.disparity, result.right):  # held to the range of the levels
        assert (disparity.min(), disparity.max()) == (-5, 8)
    np.testing.assert_array_equal(result.right, result.disparity[:, ::-1])


@pytest.mark.parametrize(
    ("attributes", "scale", "keywords"),
    [({}, 0.5, {}), ({"any_scale": True}, 0.5, {}), ({"any_scale": True}, 1, {"scale": 1})],
)
def test_other_refiners_on_the_device_are_called_with_the_left_image_alone(host_as_device, attributes, scale, keywords):
    refiner = _DeviceRecorder(**attributes)
    result = Matcher("S2", device="cuda", refiner=refiner, scale=scale, **LEVELS).on_device(*_pair(9, 27), stream=0)
    assert [call[2] for call in refiner.calls] == [keywords]
    assert (result.disparity.min(), result.disparity.max()) == (-100, 100)


@pytest.mark.parametrize("scale", [1, 0.5])
def test_refiners_of_the_host_are_not_for_the_device(queues, monkeypatch, scale):
    pair = _pair(9, 27)
    monkeypatch.delattr(Linear, "on_device")
    with pytest.raises(DeviceError, match="refiner must be one with on_device for images on the device"):
        Matcher("S2", device="cuda", scale=scale, refiner="linear").on_device(*pair)


@pytest.mark.parametrize("scale", [1, 0.5])
def test_gaps_are_not_refined_on_the_device(queues, scale):
    with pytest.raises(DeviceError, match="fill must not be None for images on the device with a refiner"):
        Matcher("S2", device="cuda", scale=scale, refiner="linear", fill=None).on_device(*_pair(9, 27))


def test_images_of_the_device_must_be_what_kernels_take(queues):
    matcher = Matcher("S2", device="cuda", **LEVELS)
    image = np.zeros((4, 9), np.uint8)
    with pytest.raises(InputError, match="must both lie on the device or both on the host, but left does not"):
        matcher.on_device(image, image)
    with pytest.raises(DeviceError, match="device must be 'cuda' for images on the device, got 'cpu'"):
        Matcher("S2", device="cpu").on_device(image, image)


def test_volumes_beyond_the_index_are_refused(queues, monkeypatch):
    matcher = Matcher("S2", device="cuda", max_disparity=2048)
    image = np.zeros((3000, 3000), np.uint8)
    monkeypatch.setattr(_Queue, "launch", lambda *_: None)
    with pytest.raises(DeviceError, match=r"levels of all pixels must be fewer than 2\*\*34 on the device"):
        matcher(image, image)


@pytest.mark.parametrize("options", [{}, {"fill": None, "median": 0}, {"fill": "background", "median": 3}])
def test_windows_of_a_large_image_are_filled_and_filtered_as_a_whole(queues, monkeypatch, tmp_path, options):
    def narrow(height, width, reach_y, reach_x, available, needed):
        return plan(height, width, reach_y, reach_x, 11 * 90, lambda rows, columns: rows * columns)

    monkeypatch.setattr(large_matching, "plan", narrow)
    left, right = _pair(11, 120)
    maps = {}
    for device in ("cpu", "cuda"):
        path = tmp_path / f"{device}.npy"
        done = match_large(left, right, path, "S2", overlap=4, device=device, **LEVELS, speckle=0.01, **options)
        assert done.windows > 1 and done.matcher.device == device
        maps[device] = np.load(path)
    np.testing.assert_array_equal(maps["cuda"], maps["cpu"])


@pytest.mark.parametrize("method", ["S1", "S2", "S3", "S4"])
def test_the_memory_of_a_match_is_known_before_it(queues, method):
    matcher = Matcher(method, device="cuda", **LEVELS)
    matcher(*_pair(11, 35))
    used = sum(array.values.nbytes for array in queues[0].arrays.values())
    extra = 2 * 11 * 35  # masks of pixels without evidence, which this pair has none of
    assert used <= matcher.nbytes(11, 35) <= used + extra
    assert matcher.nbytes(44, 70) > 6 * matcher.nbytes(11, 35)
