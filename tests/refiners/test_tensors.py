"""The refiner of torch tensors is the refiner."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from refining import NAMES, coarse_of, image_of, one_line, random_content, weight_file

from stereokit.errors import FileError, InputError, OptionError, StereokitError

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from stereokit_refiners.learned import LearnedRefiner  # noqa: E402
from stereokit_refiners.linear import Linear  # noqa: E402
from stereokit_refiners.runtimes.tensors import TensorRefiner  # noqa: E402

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
TOLERANCE_PX = 2e-3


@pytest.fixture(params=DEVICES)
def device(request):
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return request.param


@pytest.mark.parametrize("size", [(32, 48), (33, 47), (1, 1), (1, 9), (2, 3)])
@pytest.mark.parametrize(
    ("name", "mode"), [(name, "residual") for name in NAMES] + [("stereovae", "direct"), ("cnn", "direct")]
)
def test_tensors_give_what_arrays_give(name, mode, size, device):
    content, coarse, left = random_content(name, output_mode=mode), coarse_of(size), image_of(size)
    expected = LearnedRefiner.of(content, backend="torch")(coarse, left).disparity
    refiner = TensorRefiner(content, device)
    arguments = [
        torch.from_numpy(array).to(device) for array in (coarse.disparity, coarse.confidence, left, coarse.candidates)
    ]
    original = [tensor.clone() for tensor in arguments]
    actual = refiner(*arguments)
    assert actual.shape == size and actual.dtype == torch.float32 and actual.is_contiguous()
    assert actual.device.type == device
    np.testing.assert_allclose(actual.cpu().numpy(), expected, rtol=0, atol=TOLERANCE_PX)
    assert all(torch.equal(a, b) for a, b in zip(arguments, original, strict=True))
    again = refiner(coarse.disparity, coarse.confidence, left, coarse.candidates)  # arrays of the host are taken too
    assert torch.equal(again, actual)


@pytest.mark.parametrize("name", NAMES)
def test_tensors_below_zero_give_what_arrays_give(name):
    content, coarse, left = random_content(name), coarse_of((33, 47), low=-40, high=-5), image_of((33, 47))
    expected = LearnedRefiner.of(content, backend="torch")(coarse, left).disparity
    actual = TensorRefiner(content, "cpu")(coarse.disparity, coarse.confidence, left, coarse.candidates)
    np.testing.assert_allclose(actual.numpy(), expected, rtol=0, atol=TOLERANCE_PX)


def test_only_networks_that_look_at_the_confidence_and_candidates_need_them():
    coarse, left = coarse_of((16, 24)), image_of((16, 24))
    for name in ("cnn", "stereovae"):
        refiner = TensorRefiner(random_content(name), "cpu")
        arguments = refiner(coarse.disparity, coarse.confidence, left)
        assert torch.equal(refiner(coarse.disparity, None, left), arguments)
        assert torch.equal(refiner(coarse.disparity, None, left, coarse.candidates), arguments)
    refiner = TensorRefiner(random_content("pyramid"), "cpu")
    with pytest.raises(InputError, match=r"^confidence must be given for refiner 'pyramid', got None$"):
        refiner(coarse.disparity, None, left, coarse.candidates)
    with pytest.raises(InputError, match=r"^candidates must be given for refiner 'pyramid', got None$"):
        refiner(coarse.disparity, coarse.confidence, left)
    rule = r"^candidates must be two maps of the shape of coarse \(8, 12\), got \(1, 8, 12\)$"
    with pytest.raises(InputError, match=rule):
        refiner(coarse.disparity, coarse.confidence, left, coarse.candidates[:1])


def test_the_device_needs_torch(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "stereokit_refiners.runtimes.tensors")
    coarse = coarse_of((16, 24))
    for refiner in (Linear(), LearnedRefiner.of(random_content("cnn"))):
        with pytest.raises(StereokitError, match="refiners on the GPU need torch, which is not installed"):
            refiner.on_device(coarse, image_of((16, 24)), 0)


def test_a_file_is_taken_by_its_path(tmp_path):
    path = weight_file(tmp_path, "cnn")
    arguments = coarse_of((16, 16)).disparity, coarse_of((16, 16)).confidence, image_of((16, 16))
    assert torch.equal(TensorRefiner(path, "cpu")(*arguments), TensorRefiner(random_content("cnn"), "cpu")(*arguments))
    with pytest.raises(FileError, match="weights must name a file"):
        TensorRefiner(str(tmp_path / "none.safetensors"), "cpu")
    with pytest.raises(FileError):
        TensorRefiner("resnet", "cpu")


def test_devices_that_torch_lacks_are_refused():
    for name in ("warp", "cuda:99"):
        with pytest.raises(OptionError, match=rf"^device must be one that torch has, got '{name}'") as caught:
            TensorRefiner(random_content("cnn"), name)
        one_line(caught.value)


def test_sizes_that_do_not_fit_are_refused():
    refiner = TensorRefiner(random_content("cnn"), "cpu")
    coarse, confidence, left = torch.zeros(8, 8), torch.ones(8, 8), torch.zeros(16, 16, dtype=torch.uint8)
    for arguments in (
        (coarse[:7], confidence, left),
        (coarse, confidence, left[None]),
        (coarse, confidence[:7], left),
        (left, confidence, left),
    ):
        with pytest.raises(InputError) as caught:
            refiner(*arguments)
        one_line(caught.value)
