"""The kernels of the census costs, executed from their PTX."""

from __future__ import annotations

import numpy as np
import pytest

from ptx.checks import costs as checks
from ptx.interpreter.emulated import EmulatedQueue
from stereokit.costs import Census
from stereokit.costs.rows import Levels


@pytest.mark.parametrize("seed", [None, 1, 2, 3])
def test_one_word(seed):
    checks.check_census(EmulatedQueue(seed))


@pytest.mark.parametrize("seed", [None, 1, 2, 3])
def test_two_words_with_masks_and_border_pixels(seed):
    checks.check_census_of_two_words(EmulatedQueue(seed))


@pytest.mark.parametrize("window", ["5x5", "7x7", "9x7"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_windows_and_types(window, dtype):
    checks.check_volume(EmulatedQueue(), Census(window), (9, 33), Levels(0, 8), dtype=dtype)


@pytest.mark.parametrize(("shape", "levels", "outside"), checks.SIZES)
def test_sizes_and_levels(shape, levels, outside):
    checks.check_volume(EmulatedQueue(), Census("5x5"), shape, levels, outside)
