"""Inputs by planes: what numpy makes of them, in compiled loops."""

from __future__ import annotations

import numpy as np
import pytest

from stereokit_refiners.runtimes.planes import planar


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 7, 9), (90, 3, 1), (3, 1, 17)])
def test_channels_come_to_lie_together(shape, threads):
    channels, rows, columns = shape
    innermost = np.random.default_rng(0).integers(-128, 128, (rows, columns, channels), dtype=np.int8)
    array = np.moveaxis(innermost, 2, 0)
    for each in (array, np.ascontiguousarray(array), array[:, ::-1], array.astype(np.float32)):
        out = planar(each, threads)
        assert out.dtype == np.float32 and out.flags.c_contiguous and out.flags.writeable
        np.testing.assert_array_equal(out, each[None])
