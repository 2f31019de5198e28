"""Helpers below the stages."""

from __future__ import annotations

from stereokit.kernels.workspace import Workspace


def test_a_workspace_makes_a_value_again_for_another_key():
    workspace, calls = Workspace(), []

    def make():
        calls.append(len(calls))
        return calls[-1]

    assert [workspace.cached("a", key, make) for key in (1, 1, 2, 2, 1)] == [0, 0, 1, 1, 2]
