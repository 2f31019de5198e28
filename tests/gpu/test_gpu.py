"""On a real GPU: what the interpreter runs on small images, full images, streams, tensors and memory."""

from __future__ import annotations

import importlib
import inspect
import json
import pkgutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stereokit import Matcher
from stereokit.aggregation.sgm import Sgm
from stereokit.costs import Census, Zncc
from stereokit.costs.rows import Levels
from stereokit.cuda.driver import describe, has_device
from stereokit.errors import DeviceError

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not has_device(), reason=f"no GPU to run on: {describe()}"),
]

SHAPE = (375, 1242)


@pytest.fixture
def queue():
    from stereokit.cuda.stream import DeviceQueue

    return DeviceQueue()


def _pair(shape: tuple[int, int] = SHAPE) -> tuple[np.ndarray, np.ndarray]:
    """Return a textured pair in which disparity grows from the left to the right."""
    rng = np.random.default_rng(0)
    height, width = shape
    wide = rng.integers(0, 256, (height, width + 64), dtype=np.uint8)
    columns = np.arange(width)
    return wide[:, columns], wide[:, columns + 64 * columns // width]


def test_checks(queue):
    """Run each check of the interpreter's that needs nothing but a queue."""
    from ptx import checks

    ran = 0
    for info in pkgutil.iter_modules(checks.__path__):
        for name, check in vars(importlib.import_module(f"ptx.checks.{info.name}")).items():
            if name.startswith("check_"):
                parameters = inspect.signature(check).parameters.values()
                if sum(parameter.default is parameter.empty for parameter in parameters) == 1:
                    check(queue)
                    ran += 1
    assert ran > 10


@pytest.mark.parametrize("cost", [Census("5x5"), Census("9x7"), Zncc(3), Zncc(5), Zncc(11)], ids=str)
def test_costs_of_a_full_image(queue, cost):
    from ptx.checks.costs import check_volume

    check_volume(queue, cost, SHAPE, Levels(0, 128))


@pytest.mark.parametrize(("paths", "count"), [(4, 128), (5, 64), (8, 128), (4, 300)])
def test_paths_of_a_full_image(queue, paths, count):
    from ptx.checks.sgm import check_paths

    check_paths(queue, Sgm(15, 85, paths=paths), SHAPE, count, uniqueness=2.0)


@pytest.mark.parametrize("method", ["S1", "S2", "S3", "S4"])
def test_matchers_on_full_images(method):
    pair = _pair()
    options = {"max_disparity": 128, "confidence": True, "right": True}
    result, want = (Matcher(method, device=device, **options)(*pair) for device in ("cuda", "cpu"))
    for name in ("disparity", "valid", "confidence", "right"):
        np.testing.assert_array_equal(getattr(result, name), getattr(want, name), name)


def test_calls_from_many_threads():
    matcher = Matcher("S2", device="cuda", max_disparity=64)
    pair = _pair((120, 300))
    want = matcher(*pair).disparity
    with ThreadPoolExecutor(4) as executor:
        for result in executor.map(lambda _: matcher(*pair).disparity, range(16)):
            np.testing.assert_array_equal(result, want)


def test_tensors_go_in_and_out_without_a_copy():
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("PyTorch was built without CUDA")
    left, right = _pair((120, 300))
    matcher = Matcher("S4", device="cuda", max_disparity=64)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        tensors = torch.as_tensor(left, device="cuda"), torch.as_tensor(right, device="cuda")
        result = matcher.on_device(*tensors, stream=stream)
        disparity = torch.as_tensor(result.disparity, device="cuda")
    stream.synchronize()
    assert disparity.data_ptr() == result.disparity.__cuda_array_interface__["data"][0]
    np.testing.assert_array_equal(disparity.cpu().numpy(), matcher(left, right).disparity)


@pytest.mark.parametrize("refiner", ["linear", "stereovae", "pyramid"])
def test_maps_are_refined_where_they_are(refiner):
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("PyTorch was built without CUDA")
    pair = _pair((121, 301))
    options = {"max_disparity": 64, "scale": 0.5, "refiner": refiner, "confidence": True}
    if refiner != "linear":
        pytest.importorskip("stereokit_kitti_weights")
        options["weights"] = "kitti"
    exact = {} if refiner == "linear" else {"backend": "torch"}
    want = Matcher("S4", device="cpu", **options, **exact)(*pair)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        tensors = [torch.as_tensor(image, device="cuda") for image in pair]
        result = Matcher("S4", device="cuda", **options).on_device(*tensors, stream=stream)
    stream.synchronize()
    np.testing.assert_allclose(result.disparity.cpu().numpy(), want.disparity, rtol=0, atol=0.05)
    np.testing.assert_array_equal(result.valid.cpu().numpy() != 0, want.valid)


@pytest.mark.parametrize("scale", [1, 0.5])
@pytest.mark.parametrize("refiner", ["stereokit", "auto"])
def test_the_general_refiner_works_where_maps_are(refiner, scale):
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("PyTorch was built without CUDA")
    pair = _pair((121, 301))
    options = {"max_disparity": 80, "scale": scale, "refiner": refiner, "confidence": True, "right": True}
    want = Matcher("S2", device="cpu", search="full", backend="torch", **options)(*pair)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        tensors = [torch.as_tensor(image, device="cuda") for image in pair]
        result = Matcher("S2", device="cuda", **options).on_device(*tensors, stream=stream)
        maps = [torch.as_tensor(part, device="cuda") for part in (result.disparity, result.right, result.confidence)]
        valid = torch.as_tensor(result.valid, device="cuda")
    stream.synchronize()
    np.testing.assert_array_equal(valid.cpu().numpy() != 0, want.valid)
    for part, expected in zip(maps, (want.disparity, want.right, want.confidence), strict=True):
        # Convolutions may have 10 bits there: near an edge a weight then sways between values that are far apart.
        assert (np.abs(part.cpu().numpy() - expected) > 0.05).mean() < 0.01


def test_the_general_refiner_waits_for_nothing():
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("PyTorch was built without CUDA")
    tensors = [torch.as_tensor(image, device="cuda") for image in _pair((121, 301))]
    matcher = Matcher("S2", device="cuda", max_disparity=64, scale=0.5, refiner="stereokit")
    matcher.on_device(*tensors)  # loads the weights
    torch.cuda.set_sync_debug_mode("error")
    try:
        matcher.on_device(*tensors)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_too_large_a_volume_names_what_is_needed_and_free():
    matcher = Matcher("S2", device="cuda", max_disparity=2048, paths=8)
    image = np.zeros((2800, 2900), np.uint8)  # seven volumes of 16.6 GB
    with pytest.raises(DeviceError, match=r"out of device memory: '[\w.]+' needs \d+ bytes, \d+ of \d+ are free"):
        matcher(image, image)


def test_the_bench_times_host_and_device_images():
    from typer.testing import CliRunner

    from stereokit.cli.app import app

    words = "bench --device cuda --sizes 160x60x32 --method S4 --rounds 2 --no-peers --json -"
    done = CliRunner().invoke(app, words.split())
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)["results"]
    assert [row["contender"].rpartition(", ")[2] for row in rows] == ["host images", "device images"]
    assert all(row["median_ms"] > 0 for row in rows)
