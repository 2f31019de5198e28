"""Flaws, one at a time, that the checks of the kernels must see: a check that passes on one is too weak.

A careful reader may miss each of them: a barrier or a guard too few, an index that is off only at odd sizes or past
the last line, an overflow at the largest costs, a rounding.
"""

from __future__ import annotations

from typing import Any

from planting import Mutant

__all__ = ["MUTANTS", "OUTCOMES", "SIZES"]

_RACE, _BOUNDS, _UNWRITTEN = "race", "out of bounds", "uninitialised read"
_BARRIER, _SHUFFLE = "bad barrier", "bad shuffle"
_ROUNDING, _OVERFLOW, _BORDER, _RULE = "rounding", "overflow", "border", "wrong rule"

OUTCOMES = {
    _RACE: {"race"},
    _BOUNDS: {"out of bounds"},
    _UNWRITTEN: {"uninitialised", "wrong result"},  # registers that nobody wrote are garbage
    _BARRIER: {"divergent barrier"},
    _SHUFFLE: {"bad shuffle", "wrong result"},  # a lane that is there but the wrong one gives a wrong value
    _ROUNDING: {"wrong result"},
    _OVERFLOW: {"wrong result"},
    _BORDER: {"wrong result"},
    _RULE: {"wrong result"},
}
"""Outcomes by which a mutant of each kind may be caught."""

SIZES: dict[str, dict[str, Any]] = {
    "dt.check_rf": {"shapes": ((9, 33, 8), (17, 1, 1))},
    "dt.check_sum": {"shapes": ((9, 33, 8),)},
    "dt.check_rf_of_many_levels": {"shapes": ((3, 27, 130),)},
    "dt.check_sum_in_bands": {"shapes": ((3, 27, 40),)},
    "post.check_smp": {"shapes": ((5, 33),)},
    "post.check_speckle": {"shapes": ((9, 33),)},
    "post.check_fill": {"shapes": ((9, 33),)},
    "post.check_median": {"shapes": ((6, 32),)},
}
"""Sizes at which a check runs here, some of those of the tests."""

MUTANTS = [
    # ------------------------------------------------------------------ images
    Mutant(
        "grey rounds halves down", "images.prepare_cuda", "u32(16384)", "u32(16383)", _ROUNDING, "inputs.check_grey"
    ),
    Mutant(
        "odd widths average a pixel of the next row", "images.prepare_cuda",
        "x1 = min(u32(x0 + u32(1)), u32(u32(width) - u32(1)))", "x1 = u32(x0 + u32(1))",
        _BOUNDS, "inputs.check_halved",
    ),
    Mutant(
        "weighted sums of columns in 32 bits", "images.prepare_cuda",
        "u64(weights[u32(k)]) * u64(rows[u32(u32(base + u32(other)) * u32(width) + x)])",
        "u64(u32(weights[u32(k)] * rows[u32(u32(base + u32(other)) * u32(width) + x)]))",
        _OVERFLOW, "inputs.check_blurred",
    ),
    Mutant(
        "ranges of warps are joined without a barrier", "images.prepare_cuda",
        "cuda.syncthreads()", "", _RACE, "inputs.check_ranges",
    ),
    Mutant(
        "the barrier of the ranges within a branch", "images.prepare_cuda",
        "if thread & u32(31) == 0:\n    ...\ncuda.syncthreads()",
        "if thread & u32(31) == 0:\n    ...\n    cuda.syncthreads()", _BARRIER, "inputs.check_ranges",
    ),
    Mutant(
        "every other warp leaves no range in shared memory", "images.prepare_cuda",
        "thread & u32(31) == 0", "thread & u32(63) == 0", _UNWRITTEN, "inputs.check_ranges", "ranges",
    ),
    # ------------------------------------------------------------------ costs
    Mutant(
        "a window reads the row below the image", "costs.census_cuda",
        "row = u32(u32(base + u32(clamped(y + dy, height - 1))) * u32(width))",
        "row = u32(u32(base + u32(clamped(y + dy, height))) * u32(width))", _BOUNDS, "costs.check_census",
    ),
    Mutant(
        "the last strip goes on into the next row", "costs.census_cuda",
        "min(i32(x0 + i32(STRIP)), width)", "i32(x0 + i32(STRIP))", _BOUNDS, "costs.check_census",
    ),
    Mutant(
        "a register of the second word is never loaded", "costs.census_cuda",
        "far[k - 1] = right[u32(u32(u32(height) * reach) + u - u32(k))]",
        "far[k - 1 if k < 3 else 1] = right[u32(u32(u32(height) * reach) + u - u32(k))]",
        _UNWRITTEN, "costs.check_census_of_two_words",
    ),
    Mutant(
        "a warp too few where the last strip is short", "costs.zncc_cuda",
        "height * -(-width // STRIP)", "height * (width // STRIP)", _UNWRITTEN, "costs.check_zncc",
    ),
    Mutant(
        "products of pixels in 16 bits", "costs.zncc_cuda",
        "gain = i32(mine * pixels[4 * j + k])", "gain = i32(i16(mine * pixels[4 * j + k]))",
        _OVERFLOW, "costs.check_zncc_of_16_bits",
    ),
    Mutant(
        "both factors are multiplied first", "costs.zncc_cuda",
        "f32(f32(f32(numerator) * scales[k]) * scale)", "f32(f32(numerator) * f32(scales[k] * scale))",
        _ROUNDING, "costs.check_zncc_rounding",
    ),
    Mutant(
        "pixels of a window leave the range", "costs.zncc_cuda",
        "min(max(i32(images[u32(y * u32(width) + u32(x))]), low), high)", "i32(images[u32(y * u32(width) + u32(x))])",
        _OVERFLOW, "costs.check_zncc_within_larger_ranges",
    ),
    # ------------------------------------------------------------------ path costs
    Mutant(
        "directions are looked up past the table", "aggregation.sgm_cuda",
        "i32(direction) + 1 < count and block >= _1", "block >= _1", _BOUNDS, "sgm.check_four_paths",
    ),
    Mutant(
        "all directions write the first one's costs", "aggregation.sgm_cuda",
        "u64(direction) * u64(_1)", "u64(0) * u64(_1)", _RACE, "sgm.check_four_paths",
    ),
    Mutant(
        "lines past the last one write it too", "aggregation.sgm_cuda",
        "alive = line < lines", "alive = line <= lines", _RACE, "sgm.check_four_paths", "sgm_paths",
    ),
    Mutant(
        "columns past the last one select too", "aggregation.sgm_cuda",
        "alive = x < width", "alive = x <= width", _RACE, "sgm.check_five_paths", "sgm_final",
    ),
    Mutant(
        "the smallest cost of the line before a wrap", "aggregation.sgm_cuda",
        "if wrapped:\n    low = i32(0)\n    ...", "if wrapped:\n    ...", _BORDER, "sgm.check_five_paths",
    ),
    Mutant(
        "a wrap to the left lands a pixel short", "aggregation.sgm_cuda",
        "i32(x - width) if dx > 0 else i32(x + width)", "i32(x - width) if dx > 0 else i32(x + width - 1)",
        _RACE, "sgm.check_five_paths",
    ),
    Mutant(
        "the first level of the next line follows the last", "aggregation.sgm_cuda",
        "        if place == i32(lanes - 1):\n            beyond = i32(_FAR)\n", "",
        _BORDER, "sgm.check_full_groups",
    ),
    Mutant(
        "an edge must exceed its threshold", "aggregation.sgm_cuda",
        "small = p1_edge if jump >= edge else p1\nlarge = p2_edge if jump >= edge else p2",
        "small = p1_edge if jump >= edge else p1\nlarge = p2_edge if jump > edge else p2",
        _RULE, "sgm.check_edges", "sgm_paths",
    ),
    Mutant(
        "the last path compares with the pixel after", "aggregation.sgm_cuda",
        "pixel = at\ngrey = i32(guide[at])",
        "pixel = at\ngrey = i32(guide[min(u32(at + u32(width)), u32(u32(height * width) - u32(1)))])",
        _RULE, "sgm.check_edges",
    ),
    Mutant(
        "totals of ten bits", "aggregation.sgm_cuda",
        "total[4 * j + 1] = i32(high_sum & u32(0xFFFF))", "total[4 * j + 1] = i32(high_sum & u32(0x3FF))",
        _OVERFLOW, "sgm.check_largest_path_costs",
    ),
    # ------------------------------------------------------------------ selection
    Mutant(
        "the smallest of 32 lanes misses half of them", "selection.wta_cuda",
        "shuffle_xor(value, 16)", "shuffle_xor(value, 8)", _SHUFFLE, "sgm.check_selection_of_many_levels",
    ),
    Mutant(
        "half a warp votes", "selection.wta_cuda",
        "lowest = lowest_of(best)\nvotes = u32(cuda.ballot_sync(FULL, best == lowest))",
        "lowest = lowest_of(best)\nvotes = u32(cuda.ballot_sync(u32(0xFFFF), best == lowest))",
        _SHUFFLE, "sgm.check_selection",
    ),
    Mutant(
        "pixels past the band's last are read", "selection.wta_cuda",
        "pixel = min(pixel, u32(u32(u32(height) * u32(band)) - u32(1)))", "pixel = u32(pixel)",
        _BOUNDS, "sgm.check_selection",
    ),
    Mutant(
        "the last level is interpolated with a pad", "selection.wta_cuda",
        "subpixel != 0 and level > 0 and level < levels - 1", "subpixel != 0 and level > 0 and level < levels",
        _BORDER, "sgm.check_selection",
    ),
    Mutant(
        "a neighbor of the winner counts as its rival", "selection.wta_cuda",
        "_1 < levels and away > 1 and values[k] < rival", "_1 < levels and away > 0 and values[k] < rival",
        _RULE, "sgm.check_selection",
    ),
    Mutant(
        "the neighbor above comes from the wrong lane", "selection.wta_cuda",
        "behind = values[k + 1] if k < count - 1 else above", "behind = values[k + 1] if k < count - 1 else below",
        _SHUFFLE, "sgm.check_selection",
    ),
    Mutant(
        "the rival is that of the group's first lane", "selection.wta_cuda",
        "other = shuffle_from(other, i32(base) + i32(cuda.ffs(u32(u32(votes >> base) & u32(group_bits)))) - 1)",
        "other = shuffle_from(other, i32(base))", _SHUFFLE, "sgm.check_selection",
    ),
    # ------------------------------------------------------------------ domain transform
    Mutant(
        "the way back rounds down", "aggregation.dt_cuda",
        "i32(value - i32(i32(i32(value - before) * weight) >> i32(15)))",
        "i32(value + i32(i32(i32(before - value) * weight) >> i32(15)))", _ROUNDING, "dt.check_rf",
    ),
    Mutant(
        "costs from 128 on are negative", "aggregation.dt_cuda",
        "i32(i32(word >> u32(24)) << fraction)", "i32(i32(i32(word) >> i32(24)) << fraction)",
        _OVERFLOW, "dt.check_rf",
    ),
    Mutant(
        "a segment starts from its own mark", "aggregation.dt_cuda",
        "u32(segment // u32(SEGMENT)) - u32(1)", "u32(segment // u32(SEGMENT))", _UNWRITTEN, "dt.check_rf",
    ),
    Mutant(
        "feedback from past the line's end", "aggregation.dt_cuda",
        "u32(n + u32(1)) < count", "n < count", _BOUNDS, "dt.check_rf",
    ),
    Mutant(
        "the last segment is walked past the line's end", "aggregation.dt_cuda",
        "min(u32(segment + u32(k)), last) * step", "u32(segment + u32(k)) * step", _BOUNDS, "dt.check_rf",
    ),
    Mutant(
        "lanes past the last column share its marks", "aggregation.dt_cuda",
        "threads = u32(cuda.gridsize(1))", "threads = u32(width * u32(quads))", _RACE, "dt.check_rf",
    ),
    Mutant(
        "a band's totals lie as far apart as the image's", "aggregation.dt_cuda",
        "threads = u32(band * quads)", "threads = u32(width * quads)",
        _BOUNDS, "dt.check_rf_of_many_levels", "dt_walk_totals",
    ),
    Mutant(
        "no mark before the last, short segment", "aggregation._lines_cuda",
        "return -(-pixels // SEGMENT) - 1", "return max(pixels // SEGMENT - 1, 0)", _BOUNDS, "dt.check_sum",
    ),
    Mutant(
        "product and sum are contracted", "aggregation.dt_sum_cuda",
        "cuda.libdevice.fadd_rn(value, cuda.libdevice.fmul_rn(weight, before))", "f32(value + weight * before)",
        _ROUNDING, "dt.check_sum",
    ),
    Mutant(
        "a band starts without the one on its right", "aggregation.dt_sum_cuda",
        "    if end < width:\n        b = state[thread]\n", "", _BORDER, "dt.check_sum_in_bands",
    ),
    # ------------------------------------------------------------------ post-processing
    Mutant(
        "bids before all places are cleared", "postprocess.smp_cuda",
        "while x < width:\n    bids[_1] = u64(0xFFFFFFFFFFFFFFFF)\n    x = u32(x + step)\ncuda.syncthreads()",
        "while x < width:\n    bids[_1] = u64(0xFFFFFFFFFFFFFFFF)\n    x = u32(x + step)", _RACE, "post.check_smp",
    ),
    Mutant("of equal costs the left one stays", "postprocess.smp_cuda", "u32(~x)", "x", _RULE, "post.check_smp"),
    Mutant(
        "a barrier for columns that are there", "postprocess.smp_cuda",
        "bids[_1] = u64(0xFFFFFFFFFFFFFFFF)", "bids[_1] = u64(0xFFFFFFFFFFFFFFFF)\ncuda.syncthreads()",
        _BARRIER, "post.check_smp",
    ),
    Mutant(
        "a root that another thread lowered is forgotten", "postprocess.speckle_cuda",
        "a = u32(cuda.atomic.min(parent, high, low))\napart = a != high",
        "a = u32(cuda.atomic.min(parent, high, low))\napart = False", _RULE, "post.check_speckle",
    ),
    Mutant(
        "parents are read as if nobody wrote them", "postprocess.speckle_cuda",
        "up = load_relaxed(parent, a)\nwhile up != a:\n    ...", "up = parent[a]\nwhile up != a:\n    ...",
        _RACE, "post.check_speckle", "_root_of",
    ),
    Mutant(
        "pixels are counted without atomics", "postprocess.speckle_cuda",
        "cuda.atomic.add(count, top, length)", "count[top] += length", _RACE, "post.check_speckle",
    ),
    Mutant(
        "lanes past the row return before the vote", "postprocess.speckle_cuda",
        "starts = _starts(disparity, lane, x, at, width, limit)\nif x < width:\n    ...",
        "if x >= width:\n    return\nstarts = _starts(disparity, lane, x, at, width, limit)\nif x < width:\n    ...",
        _SHUFFLE, "post.check_speckle",
    ),
    Mutant(
        "runs are united where only one side touches", "postprocess.speckle_cuda",
        "known = alike(above, corner, limit) and alike(left, corner, limit)", "known = alike(above, corner, limit)",
        _RULE, "post.check_speckle",
    ),
    Mutant(
        "rows that have pixels are copied over too", "postprocess.fill_cuda",
        "    if some[y] != u8(0):  # the whole block\n        return\n", "", _RACE, "post.check_fill",
    ),
    Mutant(
        "a gap's far end is looked for once", "postprocess.fill_cuda",
        "ahead < i32(chunk + 32)", "ahead < 0", _RULE, "post.check_fill_far",
    ),
    Mutant(
        "columns past the row are read", "postprocess.fill_cuda",
        "d = f32(np.nan)\nif x < width:\n    d = disparity[_1]",
        "d = f32(np.nan)\nif x <= width:\n    d = disparity[_1]", _BOUNDS, "post.check_fill",
    ),
    Mutant(
        "infinities start with plus", "postprocess.median_cuda",
        "_LOWEST if below else _HIGHEST", "_HIGHEST if below else _LOWEST", _RULE, "post.check_median",
    ),
    Mutant(
        "a thread past the last pixel looks for evidence", "postprocess.chain_cuda",
        "at < pixels and bad[at] != u8(0)", "at <= pixels and bad[at] != u8(0)", _BOUNDS, "post.check_chain",
    ),
]  # fmt: skip
