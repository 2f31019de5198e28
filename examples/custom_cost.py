"""Add a third cost, the absolute difference of grey values, and match a random pair with it.

A cost is one compiled function that fills one row of the cost volume. Registered under a name, it runs in
every aggregation: "difference+sgm", "difference+dt".
"""

import numba
import numpy as np

import stereokit


@numba.njit(nogil=True)
def difference(left, right, y, min_disparity, out):
    """Compare column x of the left row with column x - d of the right one, for all levels of disparity."""
    for x in range(out.shape[0]):
        for level in range(out.shape[1]):
            x_right = x - level - min_disparity
            if 0 <= x_right < right.shape[1]:
                out[x, level] = min(abs(np.int32(left[y, x]) - np.int32(right[y, x_right])), 60)


stereokit.COSTS.register("difference")(stereokit.RowCost(difference, cost_max=60, name="difference"))

left = np.random.default_rng(0).integers(0, 256, (60, 160), dtype=np.uint8)
right = np.roll(left, -7, axis=1)  # every pixel moves seven to the left
for method in ("difference+sgm", "difference+dt"):
    disparity = stereokit.match(left, right, method, max_disparity=16)
    print(f"{method}: median disparity {np.median(disparity):.1f} px")
