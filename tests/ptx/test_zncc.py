"""The kernels of the ZNCC costs, executed from their PTX."""

from __future__ import annotations

import numpy as np
import pytest

from ptx.checks import costs as checks
from ptx.interpreter.emulated import EmulatedQueue
from stereokit.costs import Zncc
from stereokit.costs.rows import Levels
from stereokit.costs.zncc_cuda import LARGEST_WINDOW, check
from stereokit.errors import DeviceError


@pytest.mark.parametrize("seed", [None, 1, 2, 3])
def test_two_strips(seed):
    checks.check_zncc(EmulatedQueue(seed))


def test_large_products_and_rounding():
    checks.check_zncc_of_16_bits(EmulatedQueue())
    checks.check_zncc_rounding(EmulatedQueue())


@pytest.mark.parametrize("seed", [None, 1, 2, 3])
def test_masks_and_border_pixels(seed):
    checks.check_zncc_with_masks(EmulatedQueue(seed))


@pytest.mark.parametrize("window", range(3, LARGEST_WINDOW + 1, 2))
def test_windows(window):
    checks.check_volume(EmulatedQueue(), Zncc(window), (6, 33), Levels(0, 8), dtype=np.uint16)


@pytest.mark.parametrize(("shape", "levels", "outside"), checks.SIZES)
def test_sizes_and_levels(shape, levels, outside):
    checks.check_volume(EmulatedQueue(), Zncc(5), shape, levels, outside)


def test_windows_of_larger_images_take_the_range_of_the_whole():
    checks.check_zncc_within_larger_ranges(EmulatedQueue())


def test_a_window_that_no_register_holds_is_refused():
    with pytest.raises(DeviceError, match="window of zncc must be at most 11 on device 'cuda', got 13"):
        check(Zncc(13))
