"""The contenders of ``stereokit bench --device cuda``: a match of images of the host, and of images on the device.

A call ends when its map is complete: on the host, or on the device after waiting for the stream. The first call
compiles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.cuda.driver import require_device
from stereokit.matching import Matcher
from stereokit_evaluation.bench.baselines import BASELINES, Call, label

__all__ = ["contenders", "maker"]

Gray = NDArray[np.uint8]
HOST, RESIDENT = "host images", "device images"


def _resident(image: Gray) -> Any:
    """Return a copy of an image on the device."""
    from stereokit.cuda.kernel import cuda  # numba.cuda is imported late

    return cuda.to_device(image)


def _wait() -> None:
    """Wait for the default stream."""
    from stereokit.cuda.kernel import cuda

    cuda.default_stream().synchronize()


def _on_host(method: str, levels: int, scale: float) -> Call:
    matcher = Matcher(method, max_disparity=levels, scale=scale, device="cuda")
    return lambda left, right: matcher(left, right).disparity


def _on_device(method: str, levels: int, scale: float) -> Call:
    matcher = Matcher(method, max_disparity=levels, scale=scale, device="cuda")
    device_images: list[Any] = []

    def call(left: Gray, right: Gray) -> Any:
        if not device_images:  # in the first call, which is not timed
            device_images.extend(_resident(image) for image in (left, right))
        result = matcher.on_device(*device_images)
        _wait()
        return result.disparity

    return call


def contenders(methods: Sequence[str], scale: float) -> dict[str, Callable[[int], Call]]:
    """Return the contenders by name: each takes the number of levels and returns the call.

    At half size, images on the device are left out: PyTorch refines their maps, and so would be the time.

    Raises
    ------
    DeviceError
        If there is no GPU that can be used.
    """
    require_device()
    half = ", half size" if scale != 1 else ""
    builders: dict[str, Callable[[int], Call]] = {}
    for method in methods:
        for location, build in ((HOST, _on_host), (RESIDENT, _on_device)):
            if scale == 1 or location == HOST:
                name = f"{label(method)}{half}, GPU, {location}"
                builders[name] = lambda levels, build=build, method=method: build(method, levels, scale)  # type: ignore[misc]
    return builders


def maker(builders: dict[str, Callable[[int], Call]]) -> Callable[[str, int, int], Call]:
    """Return the factory of calls: it takes a contender's name, the levels and the threads."""

    def make(key: str, levels: int, threads: int) -> Call:
        return builders[key](levels) if key in builders else BASELINES[key].make(levels)

    return make
