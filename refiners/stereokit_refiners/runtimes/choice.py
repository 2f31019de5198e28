"""What runs a network: the runtime and precision, checked before they are trusted, and compiled networks by size.

The runtime is what is installed: OpenVINO first, then ONNX Runtime, then torch, and OpenCV, which always is. The
precision is what the processor is fast at: int8 where it has the instructions and the weights were calibrated, else
bfloat16, else fp32.
Before a process trusts a runtime with a network, it compares a small map with that of plain numpy
(`stereokit_refiners.runtimes.reference`), and takes another runtime, with a warning, if they disagree. Networks
compiled for a size are kept, a few at a time.
"""

from __future__ import annotations

import importlib.util
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from stereokit.errors import OptionError, StereokitError
from stereokit.kernels.workspace import Pool, Workspace
from stereokit.notices import warn
from stereokit_refiners.runtimes.contract import Run
from stereokit_refiners.runtimes.reference import TOLERANCES_PX, input_size, mistake
from stereokit_refiners.weights import WeightFile, network_named

__all__ = ["BACKENDS", "PRECISIONS", "CompiledNetwork", "backend_named", "precision_named"]

BACKENDS = ("openvino", "onnxruntime", "torch", "opencv")
"""The fastest first; the last comes with the base package."""
PRECISIONS = ("fp32", "bf16", "int8")
_MOST_KEPT = 4  # sizes

K = TypeVar("K")
V = TypeVar("V")


def _installed() -> list[str]:
    """Return the runtimes that are there, the best first."""
    installed = [name for name in BACKENDS[:-1] if importlib.util.find_spec(name) is not None]
    return [*installed, "opencv"] if hasattr(cv2, "dnn") else installed


def backend_named(name: str) -> str:
    """Return the backend that an option stands for.

    Raises
    ------
    OptionError, StereokitError
        If there is no such backend, or it is not installed.
    """
    if name != "auto" and name not in BACKENDS:
        raise OptionError(f"backend must be one of auto, {', '.join(BACKENDS)}, got {name!r}")
    installed = _installed()
    if name == "auto":
        if not installed:
            raise StereokitError(
                "learned refiners need OpenCV's dnn, which this build lacks, or another runtime: pip install "
                "'stereokit[refiners]', or 'stereokit[onnx]' where OpenVINO has no wheel"
            )
        return installed[0]
    if name not in installed:
        way = {"openvino": "'stereokit[refiners]'", "onnxruntime": "'stereokit[onnx]'", "torch": "'stereokit[train]'"}
        raise StereokitError(
            f"backend {name!r} is not installed: pip install {way.get(name, 'opencv-python-headless')}"
        )
    return name


def precision_named(name: str, backend: str, content: WeightFile) -> str:
    """Return the precision that an option stands for; OptionError if the backend or the weights do not have it."""
    if name != "auto" and name not in PRECISIONS:
        raise OptionError(f"precision must be one of auto, {', '.join(PRECISIONS)}, got {name!r}")
    if backend != "openvino":
        if name not in ("auto", "fp32"):
            raise OptionError(f"precision must be fp32 with backend {backend!r}, got {name!r}")
        return "fp32"
    if name == "int8" and not content.ranges:
        raise OptionError("precision must not be int8 with weights that were not calibrated for it")
    if name != "auto":
        return name
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    if content.ranges and features.get("avx2"):  # with VNNI or without, faster than fp32
        return "int8"
    return "bf16" if features.get("avx512bf16") or features.get("amx-bf16") else "fp32"


_sound: dict[tuple[str, str, str], tuple[str, str]] = {}
_sound_lock = threading.Lock()


def _sound_way(content: WeightFile, backend: str, precision: str) -> tuple[str, str]:
    """Return the backend and precision to run a network with: those given, if they compute it rightly here.

    Checked once a process for each network, with the weights that come first.

    Raises
    ------
    StereokitError
        If no runtime that is installed does.
    """
    key = content.network, backend, precision
    with _sound_lock:
        if key not in _sound:
            wrong = []
            ways = [(backend, precision), *((b, "fp32") for b in _installed() if (b, "fp32") != (backend, precision))]
            for way in ways:
                off = mistake(content, _compile(content, *way, *input_size(content), 1))
                if off <= TOLERANCES_PX[way[1]]:
                    break
                wrong.append(f"{way[0]} in {way[1]} is off by {off:.3g} px on average")
            else:
                reasons = "; ".join(wrong)
                raise StereokitError(f"no runtime here computes network {content.network!r} rightly: {reasons}")
            if wrong:
                line = f"network {content.network!r} is run by {way[0]} in {way[1]}, since on this machine "
                warn(line + "; ".join(wrong))
            _sound[key] = way
        return _sound[key]


def _compile(content: WeightFile, backend: str, precision: str, rows: int, columns: int, threads: int) -> Run:
    network = network_named(content.network)
    if backend == "openvino":
        from stereokit_refiners.runtimes.openvino import compiled

        ranges = content.ranges if precision == "int8" else None
        return compiled(network, content.arrays, rows, columns, threads, precision, ranges)
    if backend == "onnxruntime":
        from stereokit_refiners.runtimes.onnx import session

        return session(network, content.arrays, threads)
    if backend == "opencv":
        from stereokit_refiners.runtimes.opencv import compiled as compiled_by_opencv

        return compiled_by_opencv(network, content.arrays, rows, columns, threads)
    from stereokit_refiners.runtimes.torch import runner

    return runner(network, content.arrays)


def _kept(those: OrderedDict[K, V], key: K, make: Callable[[], V]) -> V:
    """Return what is kept under a key, made if it is not there; the one that was asked for longest ago goes."""
    one = those.pop(key) if key in those else make()
    those[key] = one
    while len(those) > _MOST_KEPT:
        those.popitem(last=False)
    return one


class CompiledNetwork:
    """The compiled networks of one refiner, by size and threads; `backend` and `precision` are what runs them."""

    def __init__(self, content: WeightFile, backend: str, precision: str) -> None:
        self.content, self.backend, self.precision = content, backend, precision
        self._runs: OrderedDict[tuple[int, int, int], Run] = OrderedDict()
        self._pools: OrderedDict[tuple[int, ...], Pool[Workspace]] = OrderedDict()
        self._lock = threading.Lock()
        self.warned = False

    def settle(self) -> None:
        """Take the backend and precision that compute the network rightly here."""
        with self._lock:
            if not self._runs:
                self.backend, self.precision = _sound_way(self.content, self.backend, self.precision)

    def run(
        self, inputs: dict[str, NDArray[Any]], threads: int, use: Callable[[NDArray[np.float32]], Any] = np.array
    ) -> Any:
        """Return what `use` makes of the head for encoded inputs; see `stereokit_refiners.runtimes.contract.Run`."""
        rows, columns = next(iter(inputs.values())).shape[1:]
        key = (rows, columns, threads)
        self.settle()
        with self._lock:
            runner = _kept(self._runs, key, lambda: _compile(self.content, self.backend, self.precision, *key))
        return runner(inputs, use)

    def workspaces(self, *size: int) -> Pool[Workspace]:
        """Return the buffers for maps of a size."""
        with self._lock:
            return _kept(self._pools, size, lambda: Pool(Workspace))
