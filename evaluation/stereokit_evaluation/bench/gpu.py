"""The contenders of ``stereokit bench --device cuda``: a match of images of the host, and of images on the device.

A call ends when its map is there: on the host, or on the device with the stream waited for. The first call compiles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereokit.cuda.driver import require_device
from stereokit.matching import Matcher
from stereokit_evaluation.bench.peers import PEERS, Call, label

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
    held: list[Any] = []

    def call(left: Gray, right: Gray) -> Any:
        if not held:  # in the first call, which is not timed
            held.extend(_resident(image) for image in (left, right))
        found = matcher.on_device(*held)
        _wait()
        return found.disparity

    return call


def contenders(methods: Sequence[str], scale: float) -> dict[str, Callable[[int], Call]]:
    """Return what is timed by name: each takes the number of levels and returns the call.

    At half size images of the device are left out: what refines them there is PyTorch's, and so would be the time.

    Raises
    ------
    DeviceError
        If there is no GPU that can be used.
    """
    require_device()
    half = ", half size" if scale != 1 else ""
    found: dict[str, Callable[[int], Call]] = {}
    for method in methods:
        for what, build in ((HOST, _on_host), (RESIDENT, _on_device)):
            if scale == 1 or what == HOST:
                name = f"{label(method)}{half}, GPU, {what}"
                found[name] = lambda levels, build=build, method=method: build(method, levels, scale)  # type: ignore[misc]
    return found


def maker(ours: dict[str, Callable[[int], Call]]) -> Callable[[str, int, int], Call]:
    """Return what makes the call of a contender, of ours or of a peer, from its name, the levels and threads."""

    def make(key: str, levels: int, threads: int) -> Call:
        return ours[key](levels) if key in ours else PEERS[key].make(levels)

    return make
