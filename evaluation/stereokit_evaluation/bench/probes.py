"""Probes in a new process: the memory that a call adds, and the time of the first call after the import.

``python -m stereokit_evaluation.bench.probes memory|first SPEC`` prints one JSON object. `SPEC` is JSON with ``key``
(see `stereokit_evaluation.bench.baselines`), ``levels``, ``threads`` and ``left`` and ``right``, the images' ``.npy``
files.

The peak is the kernel's own count for the process (``VmHWM``), reset just before the call. Without it, ``ru_maxrss`` is
used; it is not the first choice because on Linux a process inherits its parent's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the child imports as little as it can before the clock starts
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["ProbeError", "first_call", "image_files", "memory_added"]

_TIMEOUT_S = 900


class ProbeError(Exception):
    """A failure of the new process; the message is the last line of its standard error."""


@contextmanager
def image_files(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> Iterator[dict[str, str]]:
    """Yield the entries of the specification for two images, stored in temporary files."""
    import numpy as np

    with TemporaryDirectory(prefix="stereokit-bench-") as folder:
        paths = {"left": str(Path(folder, "left.npy")), "right": str(Path(folder, "right.npy"))}
        np.save(paths["left"], left)
        np.save(paths["right"], right)
        yield paths


def memory_added(key: str, levels: int, threads: int, images: dict[str, str]) -> float | None:
    """Return the memory in MB (10**6 bytes) that one call adds at its peak, None where the system has no count.

    Images are loaded, and the code is compiled on a tiny pair, before the count begins. Raises ProbeError.
    """
    added: int | None = _run_probe("memory", key, levels, threads, images)["bytes"]
    return None if added is None else added / 1e6


def first_call(key: str, levels: int, threads: int, images: dict[str, str]) -> dict[str, float]:
    """Return ``import_s`` and ``call_s``: seconds of ``import stereokit``, and from there to the first map.

    Raises ProbeError.
    """
    return _run_probe("first", key, levels, threads, images)


def _run_probe(probe: str, key: str, levels: int, threads: int, images: dict[str, str]) -> dict[str, Any]:
    import stereokit
    import stereokit_evaluation

    folders = [str(Path(file).resolve().parents[1]) for file in (stereokit.__file__, stereokit_evaluation.__file__)]
    path = os.pathsep.join([*dict.fromkeys(folders), *filter(None, [os.environ.get("PYTHONPATH")])])
    spec = json.dumps({"key": key, "levels": levels, "threads": threads, **images})
    try:
        process = subprocess.run(
            [sys.executable, "-m", "stereokit_evaluation.bench.probes", probe, spec],
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ProbeError(f"{probe} probe: {error}") from error
    if process.returncode != 0:
        lines = process.stderr.strip().splitlines()
        raise ProbeError(f"{probe} probe: {lines[-1] if lines else f'exit status {process.returncode}'}")
    result: dict[str, Any] = json.loads(process.stdout.splitlines()[-1])
    return result


def _memory(spec: dict[str, Any]) -> dict[str, int | None]:
    import cv2
    import numpy as np

    from stereokit_evaluation.bench.baselines import make

    cv2.setNumThreads(spec["threads"])
    left, right = np.load(spec["left"]), np.load(spec["right"])
    call = make(spec["key"], spec["levels"], spec["threads"])
    tiny = np.random.default_rng(0).integers(0, 256, (2, 24, spec["levels"] + 64), np.uint8)
    call(*tiny)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak to the present memory
    except OSError:
        pass
    before = _peak()
    result = call(left, right)
    after = _peak()
    del result
    return {"bytes": None if before is None or after is None else after - before}


def _peak() -> int | None:
    """Return the peak of this process' memory, in bytes."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _first(spec: dict[str, Any]) -> dict[str, float]:
    import numpy as np

    left, right = np.load(spec["left"]), np.load(spec["right"])
    begun = time.perf_counter()
    import stereokit

    imported = time.perf_counter()
    stereokit.Matcher(spec["key"], max_disparity=spec["levels"], threads=spec["threads"])(left, right)
    return {"import_s": imported - begun, "call_s": time.perf_counter() - imported}


if __name__ == "__main__":
    print(json.dumps({"memory": _memory, "first": _first}[sys.argv[1]](json.loads(sys.argv[2]))))
