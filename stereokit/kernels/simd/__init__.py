"""Vector values for numba: 64 lanes of one integer or float type, written once for every processor.

A `Vector` is a numba type whose value is one LLVM vector, ``<64 x i8>`` and so on. LLVM splits or widens it to
what the processor has (two registers of AVX2, four of NEON or SSE), so there is one source and the same result
everywhere: the integer operations are exact and the float ones are single IEEE operations, never contracted.

Where 64 lanes of 32 bits would take too many registers, kernels take a block in parts of `PART` lanes (`each_part`,
`load_part`, ..), which is a block where registers are wide.

The functions of this package can be called from compiled code only. They take flat arrays and offsets in
elements. Nothing checks bounds but a build with ``STEREOKIT_CHECKED=1``, whose accesses outside of an array end the
process.

Layout of a row of costs or path costs (one row of the image, `W` pixels, `D` disparity levels padded to
``P = 64 * ceil(D / 64)``)::

    offset  0 .. P-1        P .. 2P-1       ...    (W-1)P .. WP-1
            pixel x = 0     pixel x = 1            pixel x = W-1
            d = 0 1 2 ...   d = 0 1 2 ...
"""

from __future__ import annotations

from stereokit.kernels.simd.arithmetic import (
    add,
    add_firsts,
    add_pairs,
    add_saturated,
    add_scaled,
    bits_of,
    bitwise_or,
    convert,
    count_bits,
    count_ones,
    first_bit,
    lowest,
    mark_less,
    mask_equal,
    maximum,
    minimum,
    multiply,
    multiply_high_doubled,
    select,
    shift_left,
    shift_right,
    subtract,
    without_three,
    xor,
)
from stereokit.kernels.simd.memory import (
    aligned,
    load,
    load_pairs,
    load_part,
    prefetch,
    splat,
    splat_at,
    splat_pair_at,
    splat_part,
    splat_part_at,
    store,
    store_pair,
    stream,
    stream_fence,
)
from stereokit.kernels.simd.parts import each_part, splat_parts
from stereokit.kernels.simd.shuffle import first_lane, lowest_of_4, shift_down, shift_up
from stereokit.kernels.simd.types import LANES, PART, Vector, vector_bits

__all__ = [
    "LANES",
    "PART",
    "Vector",
    "add",
    "add_firsts",
    "add_pairs",
    "add_saturated",
    "add_scaled",
    "aligned",
    "bits_of",
    "bitwise_or",
    "convert",
    "count_bits",
    "count_ones",
    "each_part",
    "first_bit",
    "first_lane",
    "load",
    "load_pairs",
    "load_part",
    "lowest",
    "lowest_of_4",
    "mark_less",
    "mask_equal",
    "maximum",
    "minimum",
    "multiply",
    "multiply_high_doubled",
    "prefetch",
    "select",
    "shift_down",
    "shift_left",
    "shift_right",
    "shift_up",
    "splat",
    "splat_at",
    "splat_pair_at",
    "splat_part",
    "splat_part_at",
    "splat_parts",
    "store",
    "store_pair",
    "stream",
    "stream_fence",
    "subtract",
    "vector_bits",
    "without_three",
    "xor",
]
