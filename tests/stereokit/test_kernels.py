"""Helpers below the stages."""

from __future__ import annotations

import numpy as np
import pytest

from stereokit.kernels.jit import inline, kernel
from stereokit.kernels.workspace import Workspace


def test_a_workspace_makes_a_value_again_for_another_key():
    workspace, calls = Workspace(), []

    def make():
        calls.append(len(calls))
        return calls[-1]

    assert [workspace.cached("a", key, make) for key in (1, 1, 2, 2, 1)] == [0, 0, 1, 1, 2]


@inline
def _next(value):
    return value + 1


@kernel
def _advance(values):
    values[0] = _next(values[0])


def test_kernels_call_helpers_and_nobody_else_does():
    """Compiled for a kernel, a helper has no code for a call from Python, which would end the process."""
    values = np.zeros(1)
    _advance(values)
    assert values[0] == 1
    with pytest.raises(TypeError, match="_next is a helper of kernels"):
        _next(1.0)
