"""The result does not depend on the processor: kernels compiled for lesser ones give the same bits.

numba compiles for what ``NUMBA_CPU_NAME`` and ``NUMBA_CPU_FEATURES`` say; each setting runs in a process of
its own.
"""

from __future__ import annotations

import platform

import llvmlite.binding
import pytest

SCRIPT = """
import hashlib
import numpy as np
import stereokit
from stereokit.aggregation import sgm

rng = np.random.default_rng(0)
left = rng.integers(0, 256, (21, 45), dtype=np.uint8)
right = (np.roll(left, -5, axis=1) // 2 + rng.integers(0, 40, left.shape)).astype(np.uint8)
for near, method in [(near, method) for near in (sgm.NEAR, 0) for method in stereokit.METHODS.values()]:
    sgm.NEAR = near  # 0: all is streamed, as with images that are larger than the caches
    result = stereokit.Matcher(method, max_disparity=16, confidence=True, threads=1)(left, right)
    digest = hashlib.sha256()
    for array in (result.disparity, result.valid, result.confidence):
        digest.update(array.tobytes())
    print(method, digest.hexdigest())
"""


@pytest.fixture(scope="module")
def native(run_python):
    return run_python("-c", SCRIPT)


def test_a_processor_without_any_extension_gives_the_same_bits(run_python, native):
    assert run_python("-c", SCRIPT, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="") == native


def test_a_processor_with_avx2_and_no_more_gives_the_same_bits(run_python, native):
    if platform.machine() not in ("x86_64", "AMD64") or not llvmlite.binding.get_host_cpu_features().get("avx2"):
        pytest.skip("needs a processor with AVX2")
    assert run_python("-c", SCRIPT, NUMBA_CPU_NAME="haswell", NUMBA_CPU_FEATURES="") == native


def test_all_four_methods_are_compared(native):
    assert len(native.splitlines()) == 8


def test_sums_that_are_streamed_give_the_same_bits(native):
    lines = native.splitlines()
    assert lines[:4] == lines[4:]
