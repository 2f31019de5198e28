"""Devices without a GPU: what is said, what falls back, and what is not imported."""

from __future__ import annotations

import ctypes
import importlib.util
import textwrap

import pytest

from stereokit import Matcher
from stereokit.cuda import driver
from stereokit.errors import DeviceError, InputError, OptionError, StereokitError


@pytest.fixture
def no_driver(monkeypatch):
    """Take the driver away, if there is one."""

    def fail(name):
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", fail)
    driver._driver.cache_clear()
    yield
    driver._driver.cache_clear()


class _Driver:
    """A driver of one GPU, or of none."""

    def __init__(self, count: int = 1) -> None:
        self.count = count

    def cuInit(self, flags):
        return 0

    def cuDeviceGetCount(self, count):
        count._obj.value = self.count
        return 0

    def cuDeviceGet(self, device, number):
        return 0

    def cuDeviceGetName(self, name, size, device):
        name.value = b"Emulated 9000"
        return 0

    def cuDeviceGetAttribute(self, value, attribute, device):
        value._obj.value = {75: 8, 76: 7}[attribute]
        return 0


@pytest.fixture
def with_driver(monkeypatch):
    """Return a function that gives this machine a driver of so many GPUs."""

    def give(count):
        monkeypatch.setattr(ctypes, "CDLL", lambda name: _Driver(count))
        driver._driver.cache_clear()

    yield give
    driver._driver.cache_clear()


def test_cuda_without_a_driver_says_what_to_do(no_driver):
    with pytest.raises(DeviceError) as caught:
        Matcher("S2", device="cuda")
    message = str(caught.value)
    assert message == (
        "device 'cuda' cannot be used here: no NVIDIA driver is installed; "
        "it needs an NVIDIA GPU, its driver and pip install 'stereokit[cuda]'"
    )
    assert isinstance(caught.value, OptionError) and isinstance(caught.value, StereokitError)


def test_auto_is_the_cpu_in_silence(no_driver, recwarn, capsys):
    matcher = Matcher("S2", device="auto", max_disparity=8)
    assert matcher.device == "cpu"
    assert not recwarn.list and capsys.readouterr() == ("", "")


def test_a_driver_without_a_gpu(with_driver):
    with_driver(0)
    assert not driver.has_device()
    with pytest.raises(DeviceError, match="the NVIDIA driver finds no GPU"):
        driver.require_device()
    assert driver.describe() == "none (the NVIDIA driver finds no GPU)"


def test_a_gpu_without_numba_cuda(with_driver, monkeypatch):
    with_driver(1)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(DeviceError, match=r"numba-cuda is not installed; .* pip install 'stereokit\[cuda\]'"):
        Matcher("S2", device="cuda")
    assert Matcher("S2", device="auto").device == "cpu"


def test_a_gpu_is_described(with_driver, monkeypatch):
    with_driver(1)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert driver.has_device()
    assert driver.describe() == "Emulated 9000, compute capability 8.7"


def test_auto_is_the_cpu_also_where_there_is_a_gpu(with_driver, monkeypatch):
    with_driver(1)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert driver.has_device()
    matcher = Matcher("S2", max_disparity=8)  # "auto" is the default
    assert matcher.device == "cpu"
    with pytest.raises(DeviceError, match="device must be 'cuda' for images on the device"):
        matcher.on_device(None, None)


@pytest.mark.parametrize("wrong", ["gpu", None, 0, "CUDA"])
def test_other_devices_are_refused(wrong):
    with pytest.raises(OptionError, match="device must be 'auto', 'cpu' or 'cuda'"):
        Matcher("S2", device=wrong)


def test_images_of_a_gpu_are_not_taken_for_images_of_the_host():
    class OnDevice:
        __cuda_array_interface__ = {}  # noqa: RUF012

    with pytest.raises(
        InputError, match=r"left must lie in host memory here, got an array on a GPU; see Matcher\.on_device"
    ):
        Matcher("S2", device="cpu")(OnDevice(), OnDevice())


def test_neither_matching_nor_asking_for_a_gpu_imports_numba_cuda(run_python):
    code = """
        import sys
        import numpy as np
        import stereokit
        from stereokit.cuda.driver import describe, has_device
        describe()
        if not has_device():
            matcher = stereokit.Matcher("S2", device="auto")
            try:
                stereokit.Matcher("S2", device="cuda")
            except stereokit.StereokitError:
                pass
            print([name for name in sys.modules if name.startswith(("numba.cuda", "cuda."))])
    """
    assert run_python("-c", textwrap.dedent(code)).strip() in ("[]", "")


def test_a_matcher_of_the_gpu_cannot_be_unpickled_without_one(no_driver):
    state = Matcher("S2", device="cpu").__getstate__() | {"device": "cuda"}
    with pytest.raises(DeviceError, match="no NVIDIA driver is installed"):
        Matcher.__new__(Matcher).__setstate__(state)


def test_levels_of_half_size_cover_those_of_full_size():
    for low, high in ((0, 1), (-3, 2), (-1, 64), (5, 6)):
        levels = Matcher("S2", min_disparity=low, max_disparity=high, scale=0.5).settings.matched_levels
        assert levels.minimum * 2 <= low
        assert (levels.minimum + levels.count) * 2 >= high
