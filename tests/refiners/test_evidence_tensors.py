"""The general refiner on torch tensors is the one of the compiled loops, to the bit where no exponential is in it."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from refining import coarse_of, image_of, one_line

from stereokit.errors import OptionError, StereokitError
from stereokit.result import Disparity

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from stereokit_refiners.auto import SMALLEST, AutoRefiner  # noqa: E402
from stereokit_refiners.general import EvidenceRefiner  # noqa: E402
from stereokit_refiners.linear import Linear  # noqa: E402
from stereokit_refiners.networks.evidence import GAINS, LOGITS  # noqa: E402
from stereokit_refiners.runtimes import evidence, evidence_tensors, features  # noqa: E402
from stereokit_refiners.runtimes.mixture import mixture  # noqa: E402
from stereokit_refiners.runtimes.tensors import TensorRefiner  # noqa: E402

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
FIELDS = ("base", "step", "apart", "coarse", "half", "others", "cost", "gains")
SIZES = [(1, 1), (3, 70), (33, 31), (61, 75), (96, 128)]


@pytest.fixture(params=DEVICES)
def device(request):
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return request.param


def _coarse(size, step, low, high, seed=0):
    """Return a map of random values, full-size pixels from `low` to `high`, in coarse pixels; some are beside it."""
    rng = np.random.default_rng([seed, step, *size])
    shape = -(-size[0] // step), -(-size[1] // step)
    disparity, *candidates = ((low + (high - low) * rng.random((3, *shape))) / step).astype(np.float32)
    confidence = rng.choice([0, 1, 0.5, 0.123, 0.987], shape).astype(np.float32)
    valid = rng.random(shape) < 0.8
    return Disparity(disparity, valid, confidence, candidates=np.stack(candidates) - np.float32(1 / 3))


def _scene(size, step, seed=0):
    """Return a map with steps of four, flat areas and whole values, and the pair that it is of."""
    rng = np.random.default_rng([seed, step])
    shape = -(-size[0] // step), -(-size[1] // step)
    disparity = (np.indices(shape)[1] * step // 24 % 3 * 4 / step).astype(np.float32)
    right = np.kron(rng.integers(0, 256, (-(-size[0] // 3), -(-size[1] // 3))), np.ones((3, 3))).astype(np.uint8)
    right = right[: size[0], : size[1]]
    left = np.roll(right, 4, axis=1)
    left[:, :40] = right[:, :40] = 90
    # Two pixels above all around, and where the first candidate leads two below: all bits differ.
    left[20:22, 20:22] = right[20:22, 20:22] = [[255, 90], [90, 200]]
    right[20:22, 12:14] = [[0, 90], [90, 40]]
    candidates = np.stack([disparity + np.float32(8 / step), np.roll(disparity, 5, 1)])
    return Disparity(disparity, np.ones(shape, bool), np.ones(shape, np.float32), candidates=candidates), left, right


def _on(device, *arrays):
    return [torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays]


def _resident(coarse, device="cpu"):
    """Return a coarse map on a device, as `stereokit.cuda.pipeline.DeviceDisparity` has it, which needs numba-cuda."""
    names = ("disparity", "valid", "confidence", "candidates")
    tensors = _on(device, coarse.disparity, coarse.valid.view(np.uint8), coarse.confidence, coarse.candidates)
    return SimpleNamespace(**dict(zip(names, tensors, strict=True)))


def _check_same(coarse, left, right, step, device):
    want = evidence.hypotheses(coarse.disparity, coarse.candidates, left, right, step)
    result = evidence_tensors.hypotheses(*_on(device, coarse.disparity, coarse.candidates, left, right), step)
    for name in FIELDS:
        value = getattr(result, name)
        value = value.cpu().numpy() if isinstance(value, torch.Tensor) else value
        np.testing.assert_array_equal(value, getattr(want, name), name)
    planes = evidence_tensors.network_input(result, *_on(device, coarse.confidence, left), left.shape[1])
    expected = features.network_input(want, coarse.confidence, left, left.shape[1])
    np.testing.assert_array_equal(planes.cpu().numpy(), expected)
    return want, result


@pytest.mark.parametrize("bounds", [(0, 40), (-77.3, -60), (-9, 9), (5, 2047)])
@pytest.mark.parametrize("step", [1, 2, 4])
@pytest.mark.parametrize("size", SIZES)
def test_values_and_the_networks_input_are_the_same(size, step, bounds, device):
    _check_same(_coarse(size, step, *bounds), image_of(size, 1), image_of(size, 2), step, device)


@pytest.mark.parametrize("step", [1, 2, 4])
def test_values_and_the_networks_input_of_a_scene_are_the_same(step, device):
    want, _ = _check_same(*_scene((45, 130), step), step, device)
    assert want.gains.min() == -127 and np.ptp(want.half) == 8


def _window_mean(plane, reach):
    """Return the mean over windows, (h, w) float32, each sum one after the other: down, then along."""
    side = 2 * reach + 1
    down = np.cumsum(np.stack([_moved(plane, k - reach, 0) for k in range(side)]), axis=0, dtype=np.float32)[-1]
    along = np.cumsum(np.stack([_moved(down, 0, k - reach) for k in range(side)]), axis=0, dtype=np.float32)[-1]
    return along * np.float32(1 / side**2)


def _moved(plane, i, j):
    y, x = (np.clip(np.arange(side) + by, 0, side - 1) for side, by in zip(plane.shape, (i, j), strict=True))
    return plane[y][:, x]


def test_sums_of_floats_are_in_the_order_of_the_compiled_loops(device):
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (160, 96)).astype(np.uint8)
    image[64:] = 203  # the spread is that of rounding
    half = (rng.integers(0, 2**23, (80, 48)) / 4096).astype(np.float32)
    blocks = image.reshape(40, 4, 24, 4).astype(np.int64)
    mean, square = (_window_mean((b.sum((1, 3)) / 16).astype(np.float32), 4) for b in (blocks, blocks**2))
    spread = np.sqrt(np.maximum(square - mean * mean, np.float32(0)))
    a, b, c, d = (half[i::2, j::2] for j in (0, 1) for i in (0, 1))
    want = mean, np.float32(40) / (spread + np.float32(3)), _window_mean((((a + b) + c) + d) * np.float32(0.25), 8)
    for result, expected in zip(evidence_tensors._averages(*_on(device, image, half)), want, strict=True):
        np.testing.assert_array_equal(result.cpu().numpy(), expected)


@pytest.mark.parametrize("step", [1, 2, 4])
def test_the_mixture_is_the_same_but_for_exponentials(step, device):
    coarse = _coarse((45, 70), step, -5, 60)
    want, result = _check_same(coarse, image_of((45, 70), 1), image_of((45, 70), 2), step, device)
    shape = want.coarse.shape[0] // 4, want.coarse.shape[1] // 4, LOGITS + GAINS + 4
    head = (np.random.default_rng(step).normal(size=shape) * 3).astype(np.float32)
    full, sure = evidence_tensors.mixture(_on(device, head)[0].permute(2, 0, 1), result, 45, 70)
    expected, likely = mixture(head, want, 45, 70)
    np.testing.assert_allclose(full.cpu().numpy(), expected, rtol=0, atol=1e-4)
    np.testing.assert_allclose(sure.cpu().numpy(), likely, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("step", "passes"), [(1, 1), (2, 1), (4, 1), (1, None), (2, 2)])
@pytest.mark.parametrize("size", [(16, 16), (61, 75), (96, 128)])
def test_on_tensors_the_refiner_gives_the_map_of_arrays(size, step, passes, device):
    coarse, left, right = _coarse(size, step, -4, 30, seed=3), image_of(size, 1), image_of(size, 2)
    refiner = EvidenceRefiner(backend="torch", precision="fp32", refinements=passes)
    want = refiner(coarse, left, right=right, scale=1 / step)
    arrays = _resident(coarse, device)
    one, other = _on(device, left, right)
    full, valid, sure = refiner.on_device(arrays, one, 0, right=other, scale=1 / step)
    assert (full.dtype, valid.dtype, sure.dtype) == (torch.float32, torch.uint8, torch.float32)
    assert all(part.is_contiguous() and part.shape == size for part in (full, valid, sure))
    assert valid.data_ptr() != arrays.valid.data_ptr()
    # Torch's convolutions may have 10 bits on a GPU; and a second pass rounds the map of the first to 1/256 pixel.
    tolerance = 1e-3 if device == "cpu" and passes == 1 else 0.05
    np.testing.assert_allclose(full.cpu().numpy(), want.disparity, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(valid.cpu().numpy() != 0, want.valid)
    np.testing.assert_allclose(sure.cpu().numpy(), want.confidence, rtol=0, atol=tolerance)
    assert np.abs(full.cpu().numpy() - Linear()(coarse, left, scale=1 / step).disparity).max() > 1


@pytest.mark.parametrize("step", [1, 2, 4])
def test_nothing_depends_on_values_that_the_host_would_have_to_know(step):
    """Tensors of torch's device "meta" have no values: a copy to the host or a shape by values is an error there."""
    size = (45, 70)
    coarse = _resident(_coarse(size, step, -5, 60), "meta")
    left, right = _on("meta", image_of(size, 1), image_of(size, 2))
    refiner = EvidenceRefiner(backend="torch")
    for part in refiner.on_device(coarse, left, 0, right=right, scale=1 / step):
        assert part.device.type == "meta" and part.shape == size


def test_what_the_general_refiner_needs_on_the_device():
    size = (32, 48)
    coarse, (left, right) = _resident(coarse_of(size)), _on("cpu", image_of(size, 1), image_of(size, 2))
    bare = SimpleNamespace(disparity=coarse.disparity, valid=coarse.valid, confidence=None, candidates=None)
    refiner = EvidenceRefiner(backend="torch")
    for arguments, keywords, message in (
        ((coarse, left, 0), {}, r"^right must have the size of left \(32, 48\) for this refiner, got none$"),
        ((coarse, left, 0), {"right": right[1:]}, r"^right must have the size of left .*, got \(31, 48\)$"),
        ((coarse, left, 0), {"right": right, "scale": 1}, r"^coarse map must be the size of left .*, got \(16, 24\)$"),
        ((bare, left, 0), {"right": right}, "^coarse must come with confidence and candidates for this refiner"),
    ):
        with pytest.raises(OptionError, match=message) as caught:
            refiner.on_device(*arguments, **keywords)
        one_line(caught.value)


def test_tensor_refiners_are_for_half_size_maps():
    rule = "^refiner must be one that sees a half-size map alone, got 'evidence', which Matcher.on_device runs on a GPU"
    with pytest.raises(OptionError, match=rule):
        TensorRefiner("evidence", "cpu")


def test_the_general_refiner_on_the_device_needs_torch(monkeypatch):
    size = (32, 48)
    refiner = EvidenceRefiner()
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "stereokit_refiners.runtimes.evidence_tensors")
    monkeypatch.delitem(sys.modules, "stereokit_refiners.runtimes.tensors")
    with pytest.raises(StereokitError, match="refiners on the GPU need torch, which is not installed"):
        refiner.on_device(coarse_of(size), image_of(size), 0, right=image_of(size))


@pytest.mark.parametrize("scale", [1, 0.5, 0.25])
@pytest.mark.parametrize("size", [(SMALLEST, 33), (SMALLEST - 1, 40), (40, SMALLEST - 1)])
def test_auto_on_the_device_is_the_general_one_but_for_small_images(size, scale):
    coarse = _resident(_coarse(size, round(1 / scale), 0, 20))
    left, right = _on("cpu", image_of(size, 1), image_of(size, 2))
    auto, general = AutoRefiner(), EvidenceRefiner()
    result = auto.on_device(coarse, left, 0, right=right, scale=scale)
    if min(size) < SMALLEST:
        want = Linear().on_device(coarse, left, 0, scale=scale)
    else:
        want = general.on_device(coarse, left, 0, right=right, scale=scale)
    for one, other in zip(result, want, strict=True):
        assert torch.equal(one, other)
    object.__setattr__(auto, "general", None)
    for one, other in zip(
        auto.on_device(coarse, left, 0, scale=scale), Linear().on_device(coarse, left, 0, scale=scale), strict=True
    ):
        assert torch.equal(one, other)


@pytest.mark.parametrize("scale", [1, 0.5, 0.25])
def test_linear_upscaling_on_the_device_is_that_of_arrays(scale, device):
    size = (33, 46)
    coarse, left = _coarse(size, round(1 / scale), -7, 30), image_of(size)
    arrays = _resident(coarse, device)
    result = Linear().on_device(arrays, *_on(device, left), 0, scale=scale)
    want = Linear()(coarse, left, scale=scale)
    for one, other in zip(result, (want.disparity, want.valid, want.confidence), strict=True):
        np.testing.assert_array_equal(one.cpu().numpy(), other)
    origin = (arrays.disparity, arrays.valid, arrays.confidence)
    assert all(one.data_ptr() != other.data_ptr() for one, other in zip(result, origin, strict=True))
