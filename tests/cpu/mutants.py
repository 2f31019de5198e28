"""Flaws, one at a time, that the checks of the CPU's kernels must see: a check that passes on one is too weak.

``python -m cpu.mutants`` in ``tests/`` plants each of them and prints the table of who caught it and how.
"""

from __future__ import annotations

import sys
import time

from planting import Mutant

from cpu.checks import CHECKS
from cpu.interpreter import interpreted
from cpu.lanes import Misaligned, OutOfBounds

__all__ = ["MUTANTS", "OUTCOMES", "how_caught"]

_BOUNDS, _UNWRITTEN, _OVERFLOW = "out of bounds", "uninitialised read", "overflow"
_ROUNDING, _BORDER, _RULE = "rounding", "border", "wrong rule"

OUTCOMES = {
    _BOUNDS: "out of bounds",
    _UNWRITTEN: "wrong result",  # unwritten memory is full of garbage
    _OVERFLOW: "wrong result",
    _ROUNDING: "wrong result",
    _BORDER: "wrong result",
    _RULE: "wrong result",
}
"""Outcome of the check on a mutant of each kind."""

MUTANTS = [
    # ------------------------------------------------------------------ penalties
    Mutant(
        "an edge must exceed its threshold", "aggregation.paths.penalties",
        "p2[x] = penalties.p2_edge if jump >= penalties.edge else penalties.p2",
        "p2[x] = penalties.p2_edge if jump > penalties.edge else penalties.p2",
        _RULE, "edges",
    ),
    Mutant(
        "differences of grey values in 8 bits", "aggregation.paths.penalties",
        "abs(np.int16(np.int16(here[x]) - np.int16(other[x])))", "abs(np.int16(np.int8(here[x] - other[x])))",
        _OVERFLOW, "edges",
    ),
    Mutant(
        "diagonal steps look straight up", "aggregation.paths.penalties",
        "guide[y2, first + shift : end + shift]", "guide[y2, first:end]", _RULE, "edges",
    ),
    # ------------------------------------------------------------------ paths
    Mutant(
        "the level below a block is its own last", "aggregation.paths.steps",
        "shift_up(below, here)", "shift_up(here, here)", _BORDER, "many_levels",
    ),
    Mutant(
        "the top block looks at the next pixel's levels", "aggregation.paths.steps",
        "if not top:\n    ...", "if True:\n    ...", _BOUNDS, "paths",
    ),
    Mutant(
        "path costs wrap", "aggregation.paths.steps",
        "add_saturated(cost, bracket)", "add(cost, bracket)", _OVERFLOW, "paths",
    ),
    Mutant(
        "a large jump costs nothing more", "aggregation.paths.steps",
        "minimum(minimum(step, here), p2)", "minimum(step, here)", _RULE, "close_penalties",
    ),
    Mutant(
        "slots to the left of the first", "aggregation.paths.steps",
        "if left < 0:\n    left += width", "", _BOUNDS, "paths",
    ),
    Mutant(
        "slots to the right of the last are those of nobody", "aggregation.paths.steps",
        "if right >= width:\n    right -= width", "", _BOUNDS, "paths",
    ),
    Mutant(
        "diagonals do not begin anew at the right border", "aggregation.paths.steps",
        "x == buffers.width - 1", "x == buffers.width", _BORDER, "paths",
    ),
    Mutant(
        "one diagonal has the smallest cost of the other", "aggregation.paths.steps",
        "buffers.lowest[slots.from_right] = first_lane(right)", "buffers.lowest[slots.from_right] = first_lane(left)",
        _RULE, "paths",
    ),
    Mutant(
        "the diagonals of a tall image leave their slots", "aggregation.paths.visits",
        "turn = k % width", "turn = k", _BOUNDS, "tall", "_sum_part",
    ),
    Mutant(
        "the way from the right has the jump of the next pixel", "aggregation.paths.visits",
        "min(xb + 1, width - 1)", "xb", _RULE, "edges",
    ),
    Mutant(
        "the middle column forgets the way from the left", "aggregation.paths.visits",
        "_step_along(buffers, padded, xb * padded, behind, low, x < xb)",
        "_step_along(buffers, padded, xb * padded, behind, low, x <= xb)", _BORDER, "tall",
    ),
    Mutant(
        "the second row of a pair has the penalties of the first", "aggregation.paths.visits",
        "enter_paths(buffers, slots, 8 * half * width + x)", "enter_paths(buffers, slots, x)", _RULE, "edges",
    ),
    Mutant(
        "a recovered cost counts once too often", "aggregation.paths.visits",
        "buffers.paths - 1 if recovers_costs(buffers) else buffers.paths", "buffers.paths", _RULE, "recovered",
    ),
    Mutant(
        "costs are recovered from the wrong neighbour", "aggregation.paths.visits",
        "before = y + step", "before = y - step", _RULE, "recovered",
    ),
    Mutant(
        "an odd last row brings a row behind it", "aggregation.sgm",
        "min(2, visits - k)", "2", _BOUNDS, "paths", "_last_visit",
    ),
    Mutant(
        "the second half's diagonals start where the first half's did", "aggregation.sgm",
        "finish_part(buffers, half, y, k0 + k + half, x0, x1, sums, both)",
        "finish_part(buffers, half, y, k + half, x0, x1, sums, both)", _RULE, "paths",
    ),
    Mutant(
        "the second row of a pair counts as the first", "aggregation.sgm",
        "finish_part(buffers, half, y, k0 + k + half, x0, x1, sums, both)",
        "finish_part(buffers, half, y, k0 + k, x0, x1, sums, both)", _RULE, "paths",
    ),
    Mutant(
        "every worker visits all rows", "aggregation.sgm",
        "last(sweep, k, parts[sweep], words[sweep])", "last(sweep, k, parts[sweep], words[sweep].copy())", _RULE,
        "shared",
    ),
    Mutant(
        "a band of columns begins a column too late", "aggregation.paths.visits",
        "range(x0, x1)", "range(x0 + min(x0, 1), x1)", _RULE, "shared", "_leave_row",
    ),
    Mutant(
        "four costs and a bracket in a byte that holds three", "aggregation.sgm",
        "4 * cost_max + most <= 255", "3 * cost_max + most <= 255", _OVERFLOW, "bytes",
    ),
    Mutant(
        "brackets and a path cost in a byte that holds the brackets", "aggregation.sgm",
        "cost_max if recovers else 0", "0", _OVERFLOW, "bytes",
    ),
    # ------------------------------------------------------------------ costs
    Mutant(
        "a plane's eight neighbours, of which six are there", "costs.census",
        "min(8 * plane + 8, dy.size)", "8 * plane + 8", _BOUNDS, "census",
    ),
    Mutant(
        "the reversed image's windows are not reversed", "costs.census",
        "partial(_transform, *right_image, dy, -dx, _1, _2, _3, _4)",
        "partial(_transform, *right_image, dy, dx, _1, _2, _3, _4)", _RULE, "census",
    ),
    Mutant(
        "an equal neighbour counts as darker", "costs.census",
        "mark_less(neighbour, centre, _1)", "xor(mark_less(centre, neighbour, _1), splat(_1))", _RULE, "census",
    ),
    Mutant(
        "a column too far to the right", "costs.census",
        "k = cells.width - 1 - x", "k = cells.width - x", _RULE, "census",
    ),
    Mutant(
        "the row that goes is added", "costs.zncc",
        "_write_pairs(rows, x0, x1, 0, row_in, row_out, n, -n)", "_write_pairs(rows, x0, x1, 0, row_in, row_out, n, n)",
        _RULE, "zncc",
    ),
    Mutant(
        "column sums of another part are taken over", "costs.zncc",
        "state[1] == x0 and state[2] == x1", "True", _RULE, "zncc",
    ),
    Mutant(
        "the row that goes is one too low on the way up", "costs.zncc",
        "row_in = np.int64(y)\nrow_out = last + window - 1", "row_in = np.int64(y)\nrow_out = last + window - 2",
        _RULE, "zncc",
    ),
    Mutant(
        "costs of many steps as signed bytes", "costs.zncc",
        "of_words if len(wide) > 0 else of_bytes", "of_bytes", _OVERFLOW, "zncc_of_many_steps",
    ),
    Mutant(
        "rho is rounded down", "costs.zncc",
        "bits_of(add(rho, splat_part(magic)))", "convert(rho, np.int32(0))", _ROUNDING, "zncc", "of_bytes",
    ),
    Mutant(
        "the padded image begins a column past the border", "costs.zncc",
        "max(-start if step > 0 else start - width + 1, 0)", "max(-start if step > 0 else start - width, 0)",
        _BOUNDS, "zncc",
    ),
    Mutant(
        "the oldest column is not in the window", "costs.zncc",
        "newest - (2 * rows.half + 1) * LANES", "newest - 2 * rows.half * LANES", _RULE, "zncc",
    ),
    Mutant(
        "the last column that looks past the border is not masked", "costs.rows",
        "max(0, cells.padded - 1 + cells.minimum)", "max(0, cells.padded - 2 + cells.minimum)",
        _BORDER, "census_of_full_blocks",
    ),
    Mutant(
        "invalid pixels of the left view have a cost", "costs.rows",
        "if cells.left_bad.size > 0:\n    ...", "", _RULE, "bad_pixels",
    ),
    Mutant(
        "all rows share the mask of the first", "costs.rows",
        "right = y * cells.stride + cells.width - 1 - x", "right = cells.width - 1 - x", _RULE, "bad_pixels",
    ),
    # ------------------------------------------------------------------ selection
    Mutant(
        "of equal costs the highest block wins", "selection.wta",
        "block = (len(blocks) - 1 - back) * LANES", "block = back * LANES", _RULE, "selection", "_best_level",
    ),
    Mutant(
        "of equal rivals the one in the highest block wins", "selection.wta",
        "block = (len(blocks) - 1 - back) * LANES", "block = back * LANES", _RULE, "selection", "_rival",
    ),
    Mutant(
        "the last level is interpolated with a pad", "selection.wta",
        "level < out.levels - 1", "level < out.levels", _BORDER, "selection",
    ),
    Mutant(
        "a neighbour of the winner counts as its rival", "selection.wta",
        "without_three(load(keys, at), level - 1)", "without_three(load(keys, at), level - 2)", _RULE, "selection",
    ),
    Mutant(
        "the second candidate replaces the first", "selection.wta",
        "out.candidates[out.candidates.size // 2 + to]", "out.candidates[to]", _RULE, "selection",
    ),
    # ------------------------------------------------------------------ domain transform
    Mutant(
        "bytes of the volume are cut", "aggregation.dt",
        "np.int16((1 << shift) >> 1)", "np.int16(0)", _ROUNDING, "rf",
    ),
    Mutant(
        "the way back rounds down", "aggregation.dt",
        "store(row, to, _feed_back_up(_1, _2, weight, normalised))",
        "store(row, to, _feed_back(_1, _2, weight, normalised))", _ROUNDING, "rf_of_flat_guides", "_filter_row",
    ),
    Mutant(
        "the way back has the jumps of the way there", "aggregation.dt",
        "_jump(guide, y, x + 1, y, x)", "_jump(guide, y, x, y, max(x - 1, 0))", _RULE, "rf",
    ),
    Mutant(
        "the way up begins with feedback from nothing", "aggregation.dt",
        "weights.column[_jump(guide, y + 1, x, y, x)] if back > 0 else none",
        "weights.column[_jump(guide, y + 1, x, y, x)] if back > 1 else none", _RULE, "rf",
    ),
    Mutant(
        "the way up sees no edges", "aggregation.dt",
        "_jump(guide, y + 1, x, y, x)", "_jump(guide, y, x, y, x)", _RULE, "sum",
    ),
    Mutant(
        "a second pass begins with the first one's bytes unscaled", "aggregation.dt",
        "shift_left(convert(load(costs, at), like), shift)", "convert(load(costs, at), like)", _RULE, "rf",
    ),
    Mutant(
        "columns begin with the state of the band before", "aggregation.dt",
        "state[:] = none", "", _UNWRITTEN, "sum",
    ),
    # ------------------------------------------------------------------ narrow searches
    Mutant(
        "the last expected level costs more", "aggregation.sgm",
        "below[:LANES] = above[LANES + 1 :] = UNEXPECTED", "below[:LANES] = above[LANES:] = UNEXPECTED",
        _BORDER, "narrow",
    ),
    Mutant(
        "levels out of line with the pixel before", "aggregation.paths.narrow",
        "bitwise_or(load(costs, place + shift), load(edges, LANES + shift))",
        "bitwise_or(load(costs, place), load(edges, LANES + shift))", _RULE, "narrow",
    ),
    Mutant(
        "levels that were not searched are free", "aggregation.paths.narrow",
        "bitwise_or(load(costs, place + shift), load(edges, LANES + shift))", "load(costs, place + shift)",
        _RULE, "narrow",
    ),
    Mutant(
        "shifts of more than a search", "aggregation.paths.narrow",
        "min(max(shift, -LANES), LANES)", "shift", _BOUNDS, "narrow",
    ),
    Mutant(
        "path costs keep their smallest", "aggregation.paths.narrow",
        "store(buffers.paths.state, LANES + slot * LANES, subtract(path_cost, smallest))",
        "store(buffers.paths.state, LANES + slot * LANES, path_cost)", _OVERFLOW, "narrow_worst",
    ),
    Mutant(
        "the up sweep looks at the row above", "aggregation.paths.narrow",
        "before = y - step", "before = y - 1", _RULE, "narrow",
    ),
    Mutant(
        "diagonal paths have the start of the pixel above", "aggregation.paths.narrow",
        "_shift(buffers, here, before - 1)", "_shift(buffers, here, before)", _RULE, "narrow",
    ),
    Mutant(
        "diagonal paths go on from the other side", "aggregation.paths.narrow",
        "_restart(buffers, slots.from_left)", "pass", _BORDER, "narrow",
    ),
    Mutant(
        "starts do not count in the costs", "costs.census",
        "width - 1 - x + np.int64(rows.starts[y * width + x])", "width - 1 - x", _RULE, "narrow",
    ),
    Mutant(
        "only the first level can leave the image", "costs.rows",
        "column - LANES + 1 < 0", "column < 0", _BORDER, "narrow",
    ),
    Mutant(
        "starts do not count in the map", "selection.wta",
        "minimum += np.int64(out.starts[to])", "pass", _RULE, "narrow",
    ),
    Mutant(
        "the column that leaves is the next one", "costs.zncc",
        "each_part(_narrow_slide, sums, 0, _Place(pixel, newest % window * LANES))",
        "each_part(_narrow_slide, sums, 0, _Place(pixel, (newest + 1) % window * LANES))", _RULE, "narrow_zncc",
    ),
    Mutant(
        "the oldest column stays in the window", "costs.zncc",
        "subtract(sums, load_part(place.pixel.rows.columns.sums, place.at + lane))", "sums", _RULE, "narrow_zncc",
    ),
    Mutant(
        "the last row of a window has a partner", "costs.zncc",
        "y + 2 * pair + 1 if pair < rows.half else -1", "y + 2 * pair + 1", _RULE, "narrow_zncc",
    ),
    # ------------------------------------------------------------------ post-processing
    Mutant(
        "of equal costs the smaller disparity stays", "postprocess.smp",
        "costs[x] <= lowest[to]", "costs[x] < lowest[to]", _RULE, "smp",
    ),
    Mutant(
        "owners of the row before", "postprocess.smp",
        "owner[:] = width", "", _UNWRITTEN, "smp",
    ),
    Mutant(
        "matches outside stay", "postprocess.smp",
        "is_loser[x] != 0 or columns[x] == width", "is_loser[x] != 0", _BORDER, "smp",
    ),
    Mutant(
        "matches are cut to whole columns", "postprocess.smp",
        "np.float32(x) - d + np.float32(0.5)", "np.float32(x) - d", _ROUNDING, "smp",
    ),
    Mutant(
        "the left border stays empty", "postprocess.fill",
        "row[:x] = row[x]", "pass", _BORDER, "fill",
    ),
    Mutant(
        "the farther end fills a gap", "postprocess.fill",
        "left if to_left < to_right else right", "right if to_left < to_right else left", _RULE, "fill",
    ),
    Mutant(
        "the higher of two middle values", "postprocess.median",
        "(np.int64(valid_count[y, x]) - 1) // 2", "np.int64(valid_count[y, x]) // 2", _RULE, "median",
    ),
    Mutant(
        "gaps are sorted first", "postprocess.median",
        "wide[np.isnan(wide)] = np.inf", "wide[np.isnan(wide)] = -np.inf", _RULE, "median",
    ),
    Mutant(
        "a band's median does not see the row above it", "postprocess.median",
        "max(y0 - half, 0)", "y0", _BORDER, "median",
    ),
    Mutant(
        "regions that join lose the pixels of one", "postprocess.speckle",
        "pixels[first] += pixels[second]", "pass", _RULE, "speckle",
    ),
    Mutant(
        "regions of just the size stay", "postprocess.speckle",
        "regions.pixels[root] <= size", "regions.pixels[root] < size", _RULE, "speckle",
    ),
    Mutant(
        "runs join only where one begins", "postprocess.speckle",
        "likes[x] & (breaks[x] | breaks_above[x] | (likes[x - 1] ^ np.uint8(1)))",
        "likes[x] & (breaks[x] | breaks_above[x])", _RULE, "speckle",
    ),
    Mutant(
        "the last run of a row has no end", "postprocess.speckle",
        "begin[fresh] = at + width", "pass", _BOUNDS, "speckle",
    ),
    Mutant(
        "bands are joined one row too low", "postprocess.speckle",
        "range(y * width, (y + 1) * width)", "range((y + 1) * width, (y + 2) * width)", _BOUNDS, "speckle",
    ),
]  # fmt: skip


def how_caught(mutant: Mutant | None, check: str = "") -> str:
    """Return the outcome of the check on the mutant, a value of `OUTCOMES`; "" if it passes.

    Any other exception is an error of the mutant, never a catch, and passes through.
    """
    with interpreted(mutant):
        try:
            CHECKS[check if mutant is None else mutant.check]()
        except (OutOfBounds, IndexError):
            return "out of bounds"
        except Misaligned:
            return "misaligned"
        except AssertionError:
            return "wrong result"
    return ""


def main() -> int:
    """Print the table; return how many mutants survive."""
    survivors = 0
    for mutant in MUTANTS:
        start = time.perf_counter()
        how = how_caught(mutant)
        survivors += not how
        print(
            f"{mutant.name:60} {mutant.module:28} {mutant.kind:19} {mutant.check:22} {how or 'SURVIVES':14} "
            f"{time.perf_counter() - start:4.1f} s",
            flush=True,
        )
    print(f"{len(MUTANTS) - survivors} of {len(MUTANTS)} caught")
    return survivors


if __name__ == "__main__":
    if sys.argv[1:]:
        sys.exit("usage: python -m cpu.mutants")
    sys.exit(main() > 0)
