"""The queue of the GPU on a stand-in for numba.cuda: what it allocates, copies and waits for, and when memory ends."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba_cuda")

from stereokit.cuda import stream
from stereokit.errors import DeviceError


class _Array:
    """A device array in host memory."""

    def __init__(self, size: int, dtype: Any, log: list[str]) -> None:
        self.values = np.zeros(size, dtype)
        self.size, self.dtype, self.log = size, self.values.dtype, log

    def copy_to_device(self, source: Any, stream: Any = None) -> None:
        self.log.append("to device")
        self.values[:] = getattr(source, "values", source)

    def copy_to_host(self, target: np.ndarray, stream: Any = None) -> None:
        self.log.append("to host")
        target[:] = self.values


class _Cuda:
    """The part of numba.cuda that the queue uses; `log` lists the calls."""

    def __init__(self, room: int = 10**9) -> None:
        self.log: list[str] = []
        self.room = room

    def stream(self) -> Any:
        return SimpleNamespace(synchronize=lambda: self.log.append("wait for stream"))

    def event(self, timing: bool) -> Any:
        return SimpleNamespace(
            synchronize=lambda: self.log.append("wait for copy"), record=lambda stream: self.log.append("record")
        )

    def device_array(self, size: int, dtype: Any) -> _Array:
        if size * np.dtype(dtype).itemsize > self.room:
            raise RuntimeError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")
        self.log.append(f"allocate {size}")
        return _Array(size, dtype, self.log)

    def pinned_array(self, size: int, dtype: Any) -> np.ndarray:
        return np.zeros(size, dtype)

    def current_context(self) -> Any:
        return SimpleNamespace(get_memory_info=lambda: (self.room, 10**6))


@pytest.fixture
def fake(monkeypatch):
    fake = _Cuda()
    monkeypatch.setattr(stream, "cuda", fake)
    return fake


def test_arrays_stay_until_size_or_type_change(fake):
    queue = stream.DeviceQueue()
    first = queue.array("a", 10, np.uint8)
    assert queue.array("a", 10, np.uint8) is first
    assert queue.array("b", 10, np.uint8) is not first
    assert queue.array("a", 11, np.uint8) is not first
    assert queue.array("a", 11, np.uint16).dtype == np.uint16
    assert fake.log == ["allocate 10", "allocate 10", "allocate 11", "allocate 11"]


def test_the_end_of_memory_names_what_is_needed_and_free(fake):
    fake.room = 100
    with pytest.raises(DeviceError) as caught:
        stream.DeviceQueue().array("costs", 51, np.uint16)
    assert str(caught.value) == (
        "out of device memory: 'costs' needs 102 bytes, 100 of 1000000 are free; "
        "try a smaller image, fewer levels or fewer paths"
    )


def test_other_failures_of_the_driver_are_not_hidden(fake, monkeypatch):
    def fail(size: int, dtype: Any) -> None:
        raise RuntimeError("CUDA_ERROR_LAUNCH_FAILED")

    monkeypatch.setattr(fake, "device_array", fail, raising=False)
    with pytest.raises(RuntimeError, match="LAUNCH_FAILED"):
        stream.DeviceQueue().array("costs", 5, np.uint16)


def test_an_upload_waits_only_for_the_last_one_of_its_name(fake):
    queue = stream.DeviceQueue()
    values = np.arange(6, dtype=np.int32).reshape(2, 3)
    queue.upload("a", values)
    assert "wait for copy" not in fake.log
    array = queue.upload("a", values + 1)
    np.testing.assert_array_equal(array.values, values.ravel() + 1)
    assert fake.log == ["allocate 6", "to device", "record", "wait for copy", "to device", "record"]


def test_tables_are_uploaded_once_for_a_key(fake):
    queue = stream.DeviceQueue()
    calls: list[int] = []

    def make(value: int) -> Any:
        calls.append(value)
        return np.full((2, 2), value, np.int32)

    for value in (1, 1, 2, 2):
        array = queue.cached("table", value, lambda value=value: make(value))
        np.testing.assert_array_equal(array.values, [value] * 4)
    assert calls == [1, 2]


def test_fetched_and_copied_arrays_are_the_callers(fake):
    queue = stream.DeviceQueue()
    array = queue.upload("a", np.arange(5, dtype=np.float32))
    fetched, copied = queue.fetch(array), queue.copy(array)
    assert "wait for stream" in fake.log
    queue.upload("a", np.zeros(5, np.float32))
    queue.fetch(array)
    np.testing.assert_array_equal(fetched, np.arange(5))
    np.testing.assert_array_equal(copied.values, np.arange(5))


def test_launches_are_configured_once_and_without_warnings(fake):
    asked: list[Any] = []
    ran: list[Any] = []

    class Compiled:
        def __getitem__(self, key: Any) -> Any:
            asked.append(key[:2])
            warnings.warn("Grid size 2 will likely result in GPU under-utilization", UserWarning, stacklevel=1)
            return lambda *arguments: ran.append(arguments)

    queue = stream.DeviceQueue()
    what: Any = SimpleNamespace(name="k", block=128, compiled=Compiled())
    for value in (1, 2):
        queue.launch(what, 2, value)
    queue.launch(what, 3, 4)
    assert asked == [(2, 128), (3, 128)]
    assert ran == [(1,), (2,), (4,)]


def test_streams_of_others_are_known_by_their_address(monkeypatch):
    monkeypatch.setattr(stream, "cuda", SimpleNamespace(external_stream=lambda address: ("external", address)))
    own = object()
    assert stream.stream_of(SimpleNamespace(cuda_stream=17)) == ("external", 17)  # PyTorch
    assert stream.stream_of(SimpleNamespace(ptr=18)) == ("external", 18)  # CuPy
    assert stream.stream_of(19) == ("external", 19)
    assert stream.stream_of(own) is own
