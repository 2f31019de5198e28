"""Networks in OpenCV: what runs them where nothing is installed beyond the base package. fp32, on the processor.

OpenCV reads the same graph as ONNX Runtime, for one size. Its number of threads is a setting of the process: it is
changed for the time of a call and put back after.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.kernels.workspace import Pool
from stereokit_refiners.networks.layers import Network, Weights
from stereokit_refiners.runtimes.contract import Run
from stereokit_refiners.runtimes.onnx import head_graph
from stereokit_refiners.runtimes.planes import planar

__all__ = ["compiled", "opencv_threads"]


class _Threads:
    """How many calls are under way, and the number of threads to put back after the last of them."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.calls = 0
        self.before = 0


_threads = _Threads()


@contextmanager
def opencv_threads(count: int) -> Iterator[None]:
    """Let OpenCV use so many threads within.

    Of calls that overlap the first decides: a result never depends on the number, and OpenCV runs what comes while its
    threads are busy in the thread of the caller.
    """
    with _threads.lock:
        if _threads.calls == 0:
            _threads.before = cv2.getNumThreads()
            if _threads.before != count:
                cv2.setNumThreads(count)
        _threads.calls += 1
    try:
        yield
    finally:
        with _threads.lock:
            _threads.calls -= 1
            if _threads.calls == 0 and cv2.getNumThreads() != _threads.before:
                cv2.setNumThreads(_threads.before)


def compiled(network: Network, weights: Weights, rows: int, columns: int, threads: int) -> Run:
    """Compile for a size."""
    model = np.frombuffer(head_graph(network, weights, rows, columns), np.uint8)

    def loaded() -> Any:
        net = cv2.dnn.readNetFromONNX(model)
        net.setPreferableBackend(cv2.dnn.DNN_BACKEND_OPENCV)
        return net

    nets: Pool[Any] = Pool(loaded)

    def run(inputs: dict[str, NDArray[Any]], use: Callable[[NDArray[np.float32]], Any] = np.array) -> Any:
        with nets.take() as net, opencv_threads(threads):
            for name in network.inputs:
                net.setInput(planar(inputs[name], threads), name)
            return use(net.forward()[0])

    return run
