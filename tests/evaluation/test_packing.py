"""Maps in a page: exact to the step, whatever they hold."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stereokit.errors import InputError
from stereokit_evaluation.report.packing import STEPS, pack_map, pack_mask, unpack_map, unpack_mask

SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9))
VALUES = st.one_of(st.floats(-50, 2000, width=32), st.just(float("nan")), st.just(float("inf")))


@given(arrays(np.float32, SHAPES, elements=VALUES))
def test_a_map_comes_back_to_half_a_step(disparity):
    packed = json.loads(json.dumps(pack_map(disparity)))
    back = unpack_map(packed)
    known = np.isfinite(disparity)
    assert back.shape == disparity.shape and (np.isfinite(back) == known).all()
    assert np.abs(back - disparity)[known].max(initial=0) <= 0.5 / STEPS + 1e-3


@given(arrays(np.bool_, SHAPES))
def test_a_mask_comes_back(mask):
    assert (unpack_mask(pack_mask(mask), mask.shape) == mask).all()


def test_the_whole_range_of_16_bits_wraps_and_comes_back():
    disparity = np.array([[0, 4094, 0, 4094], [4094, 0, 4094, 0]], np.float32)
    assert (unpack_map(pack_map(disparity)) == disparity).all()


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match="must span less than 4095"):
        pack_map(np.array([[0.0, 5000.0]]))
    with pytest.raises(InputError, match=r"must have shape \(H, W\)"):
        pack_map(np.zeros(3))


def test_a_smooth_map_is_small():
    rows, columns = np.mgrid[:100, :200]
    assert len(pack_map(rows * 0.25 + columns * 0.125)["data"]) < 2000
