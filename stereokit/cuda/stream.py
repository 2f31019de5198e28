"""The real `stereokit.cuda.kernel.Queue`: one stream of the GPU and the buffers that stay there.

Host memory goes through pinned buffers, so that copies run on the stream like everything else.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.cuda.kernel import Kernel, cuda
from stereokit.errors import DeviceError

__all__ = ["DeviceQueue", "stream_of"]


def stream_of(stream: Any) -> Any:
    """Return numba's stream for what a caller has: one of numba, PyTorch or CuPy, or the address of a CUDA stream."""
    address = getattr(stream, "cuda_stream", getattr(stream, "ptr", stream))
    return cuda.external_stream(address) if isinstance(address, int) else stream


class DeviceQueue:
    """A stream and its resident buffers; may be used by one thread at a time.

    Parameters
    ----------
    stream : numba stream or None
        None makes a new one.
    """

    def __init__(self, stream: Any = None) -> None:
        self.stream = cuda.stream() if stream is None else stream
        self._arrays: dict[str, Any] = {}
        self._pinned: dict[str, NDArray[Any]] = {}
        self._copied: dict[str, Any] = {}  # events after which a pinned buffer may be written again
        self._keys: dict[str, Any] = {}
        self._configured: dict[tuple[str, int], Any] = {}

    def array(self, name: str, size: int, dtype: Any) -> Any:
        """Return the resident flat array called `name`; its content is whatever it was.

        Raises
        ------
        DeviceError
            If the device has not so much memory.
        """
        array = self._arrays.get(name)
        if array is None or array.size != size or array.dtype != np.dtype(dtype):
            self._arrays.pop(name, None)  # free the old one before the new one is made
            self._keys.pop(name, None)
            array = self._arrays[name] = self._new(name, size, dtype)
        return array

    def _new(self, name: str, size: int, dtype: Any) -> Any:
        try:
            return cuda.device_array(size, dtype)
        except Exception as error:  # of the driver: its class depends on the version of numba-cuda
            if "OUT_OF_MEMORY" not in str(error).upper():
                raise
            free, total = cuda.current_context().get_memory_info()
            raise DeviceError(
                f"out of device memory: {name!r} needs {size * np.dtype(dtype).itemsize} bytes, "
                f"{free} of {total} are free; try a smaller image, fewer levels or fewer paths"
            ) from None

    def _staging(self, name: str, size: int, dtype: Any) -> NDArray[Any]:
        array = self._pinned.get(name)
        if array is None or array.size != size or array.dtype != np.dtype(dtype):
            array = self._pinned[name] = cuda.pinned_array(size, dtype)
        return array

    def upload(self, name: str, values: NDArray[Any]) -> Any:
        """Return the resident flat array called `name` with a copy of `values` in it."""
        copied = self._copied.get(name)
        if copied is None:
            copied = self._copied[name] = cuda.event(timing=False)
        else:
            copied.synchronize()  # the pinned buffer may still be on its way
        staging = self._staging(name, values.size, values.dtype)
        np.copyto(staging, values.reshape(-1))
        array = self.array(name, values.size, values.dtype)
        array.copy_to_device(staging, stream=self.stream)
        copied.record(self.stream)
        return array

    def cached(self, name: str, key: Any, make: Callable[[], NDArray[Any]]) -> Any:
        """Return the resident copy of a table, uploaded when `key` is not that of the last call."""
        if name not in self._arrays or self._keys.get(name) != key:
            values = np.ascontiguousarray(make()).reshape(-1)
            array = self.array(name, values.size, values.dtype)
            self.stream.synchronize()  # what still reads the old table
            array.copy_to_device(values)
            self._keys[name] = key
        return self._arrays[name]

    def view(self, array: Any, dtype: Any) -> Any:
        """Return the same memory as an array of another type."""
        return array.view(dtype)

    def launch(self, what: Kernel, blocks: int, *arguments: Any) -> None:
        """Run a kernel with so many blocks; scalars are converted to its signature."""
        configured = self._configured.get((what.name, blocks))
        if configured is None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # numba warns of every grid of less than 128 blocks
                configured = what.compiled[blocks, what.block, self.stream]
            self._configured[what.name, blocks] = configured
        configured(*arguments)

    def copy(self, array: Any) -> Any:
        """Return a new array on the device with the same content."""
        out = self._new("result", array.size, array.dtype)
        out.copy_to_device(array, stream=self.stream)
        return out

    def fetch(self, array: Any) -> NDArray[Any]:
        """Wait for all launches and return a copy of an array."""
        staging = self._staging(f"fetch.{array.dtype}", array.size, array.dtype)
        array.copy_to_host(staging, stream=self.stream)
        self.stream.synchronize()
        out: NDArray[Any] = staging.copy()
        return out
