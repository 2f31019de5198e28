"""What all tests share: the environment, the folder of real data, a helper for fresh interpreters.

Compiled kernels are kept in ``.numba_cache`` in the repository unless ``NUMBA_CACHE_DIR`` is set, so that only
the first run compiles. Thread counts are held low before numpy loads: the machines that run tests are shared.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
os.environ.setdefault("NUMBA_CACHE_DIR", str(ROOT / ".numba_cache"))
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# A shell that runs the tests in its background has interrupts ignored, by children too; some tests send them.
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402
from limits import HANG_S  # noqa: E402

settings.register_profile("stereokit", derandomize=True, deadline=None, max_examples=20)
settings.load_profile("stereokit")

LONGEST = (
    "stereokit/test_portability", "arm/test_arm", "ptx/test_mutants", "ptx/test_end_to_end", "ptx/test_compile",
    "refiners/test_training", "evaluation/test_train", "evaluation/test_study", "evaluation/test_batch_dask",
    "stereokit/test_interrupts", "examples/test_examples", "test_docs", "test_contributing", "ptx/test_bench",
)  # fmt: skip
"""Files that take longest for their few tests. They come first, or one of two workers ends long before the other."""


def pytest_collection_modifyitems(items):
    def rank(item):
        return next((k for k, name in enumerate(LONGEST) if f"{name}.py::" in item.nodeid), len(LONGEST))

    items.sort(key=rank)


@pytest.fixture(autouse=True)
def pairs_need_not_be_good():
    """Let tests match noise, blank images and one image twice; what is warned of is tested with `pytest.warns`."""
    from stereokit.notices import PairWarning

    warnings.filterwarnings("ignore", category=PairWarning)


@pytest.fixture(scope="session")
def data_root():
    """Return the folder of real stereo pairs, or skip."""
    folder = Path(os.environ.get("STEREOKIT_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real stereo pairs in {folder}; set STEREOKIT_DATA")
    return folder


@pytest.fixture
def random_pair():
    """Return a function that makes a random grey pair of a size, type and seed."""

    def make(height, width, seed=0, dtype=np.uint8, high=256):
        rng = np.random.default_rng(seed)
        return tuple(rng.integers(0, high, (height, width)).astype(dtype) for _ in range(2))

    return make


@pytest.fixture(scope="session")
def run_python():
    """Return a function that runs python in a new process, packages at hand, and returns its output."""

    def run(*arguments, timeout=HANG_S, **environment):
        import stereokit
        import stereokit_refiners

        packages = {str(Path(module.__file__).parents[1]) for module in (stereokit, stereokit_refiners)}
        path = os.pathsep.join([*sorted(packages), *filter(None, [os.environ.get("PYTHONPATH")])])
        done = subprocess.run(
            [sys.executable, *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": path, **environment},
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run
