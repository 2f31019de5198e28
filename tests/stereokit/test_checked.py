"""A checked build (``STEREOKIT_CHECKED=1``): an access outside of an array ends the process, one inside does not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap

import pytest

ACCESSES = {
    "load": "first_lane(load(array, at))",
    "store": "store(array, at, splat(array[0]))",
    "stream": "stream(array, at, splat(array[0]))",
    "splat_at": "first_lane(splat_at(array, at))",
}
CODE = """
import sys
import numba, numpy as np
from stereokit.kernels.simd import aligned, first_lane, load, splat, splat_at, store, stream
array = aligned((256,), np.uint8)
array[:] = 0
@numba.njit
def touch(array, at):
    {access}
touch(array, {at})
print("inside")
"""


def outcome(access: str, at: int, checked: str) -> tuple[int, str]:
    code = textwrap.dedent(CODE).format(access=ACCESSES[access], at=at)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, "STEREOKIT_CHECKED": checked}
    )
    return done.returncode, done.stdout.strip()


@pytest.mark.parametrize("access", ACCESSES)
def test_an_access_outside_ends_the_process(access):
    last = 255 if access == "splat_at" else 192
    assert outcome(access, last, "1") == (0, "inside")
    code, said = outcome(access, -64 if access == "store" else 256, "1")
    assert code in (-signal.SIGILL, -signal.SIGTRAP, -signal.SIGABRT), (access, code)
    assert said == ""


def test_without_checks_nothing_is_checked():
    assert outcome("load", 193, "0") == (0, "inside")  # within the memory that `aligned` took


def test_plain_indices_are_checked_too(tmp_path):
    script = tmp_path / "look.py"
    script.write_text(
        "import numpy as np\n"
        "from stereokit.kernels.jit import kernel\n"
        "@kernel\n"
        "def look(array, at):\n"
        "    return array[at]\n"
        "try:\n"
        "    look(np.zeros(4, np.uint8), 4)\n"
        "except IndexError:\n"
        "    print('refused')\n"
    )
    environment = {**os.environ, "STEREOKIT_CHECKED": "1"}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "refused", done.stderr
