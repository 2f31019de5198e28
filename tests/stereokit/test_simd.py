"""Every public name of `stereokit.kernels.simd` against a plain loop over lanes, in exact arithmetic.

So are their stand-ins in `cpu.lanes`, with which tests interpret kernels.
"""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest
from cpu import lanes

from stereokit.kernels import simd
from stereokit.kernels.jit import inline, kernel

INTEGERS = (np.uint8, np.int8, np.uint16, np.int16, np.int32)
EXTREMES = (0, 1, -1, 127, 128, -128, 255, 256, 2**15 - 1, 2**15, -(2**15), 2**16 - 1, 2**31 - 1, -(2**31))
COUNT = simd.LANES


@pytest.fixture(params=["compiled", "interpreted"])
def run(request):
    """Return a function that runs a kernel of this file."""

    def compiled(function, *arguments):
        function(*arguments)

    def interpreted(function, *arguments):
        names = {"np": np, "simd": lanes}
        for step in (_add_pair, _scale, _copy_part):
            names[step.__name__] = FunctionType(step.py_func.__code__, names)
        with np.errstate(all="ignore"):
            FunctionType(function.py_func.__code__, names)(*arguments)

    return compiled if request.param == "compiled" else interpreted


def wrap(value, dtype):
    """Return an integer as its low bits in a type hold it."""
    bits = 8 * np.dtype(dtype).itemsize
    value %= 2**bits
    return value - 2**bits if np.dtype(dtype).kind == "i" and value >= 2 ** (bits - 1) else value


def integers(dtype, seed):
    """Return lanes of a type: random ones, and all pairs of extremes somewhere among two seeds."""
    info = np.iinfo(dtype)
    values = np.random.default_rng(seed).integers(info.min, info.max, COUNT, dtype, endpoint=True)
    extremes = [wrap(value, dtype) for value in EXTREMES]
    values[:16] = np.resize(extremes if seed == 0 else extremes[::-1], 16)
    values[16:32] = np.resize(extremes, 16) if seed == 0 else np.resize(extremes[3:], 16)
    return values


def floats(seed):
    """Return float32 lanes with zeros of both signs, infinities, NaN and the smallest numbers."""
    values = np.random.default_rng(seed).normal(0, 100, COUNT).astype(np.float32)
    special = [0.0, -0.0, math.inf, -math.inf, math.nan, 1e-45, -1e-45, 3e38]
    values[:8] = special
    values[8:16] = special if seed == 0 else special[::-1]
    return values


def loop(rule, *lanes, dtype):
    """Apply a rule to Python numbers, lane by lane."""
    return np.array([wrap(rule(*map(int, values)), dtype) for values in zip(*lanes, strict=True)], dtype)


@kernel
def _integer_lanes(a, b, shift, out):
    x, y = simd.load(a, 0), simd.load(b, 0)
    simd.store(out, 0, simd.add(x, y))
    simd.store(out, 64, simd.subtract(x, y))
    simd.store(out, 128, simd.multiply(x, y))
    simd.store(out, 192, simd.add_saturated(x, y))
    simd.store(out, 256, simd.minimum(x, y))
    simd.store(out, 320, simd.maximum(x, y))
    simd.store(out, 384, simd.xor(x, y))
    simd.store(out, 448, simd.bitwise_or(x, y))
    simd.store(out, 512, simd.count_bits(x))
    simd.store(out, 576, simd.shift_left(x, shift))
    simd.store(out, 640, simd.shift_right(x, shift))
    simd.store(out, 704, simd.shift_up(x, y))
    simd.store(out, 768, simd.shift_down(x, y))
    simd.store(out, 832, simd.splat(simd.lowest(x)))
    simd.store(out, 896, simd.splat(simd.first_lane(x)))


@pytest.mark.parametrize("dtype", INTEGERS)
@pytest.mark.parametrize("shift", [0, 3])
def test_operations_on_integers(run, dtype, shift):
    a, b = integers(dtype, 0), integers(dtype, 1)
    info, bits = np.iinfo(dtype), 8 * np.dtype(dtype).itemsize
    out = np.empty(15 * COUNT, dtype)
    run(_integer_lanes, a, b, shift, out)
    rules = {
        "add": lambda x, y: x + y,
        "subtract": lambda x, y: x - y,
        "multiply": lambda x, y: x * y,
        "add_saturated": lambda x, y: min(max(x + y, info.min), info.max),
        "minimum": min,
        "maximum": max,
        "xor": lambda x, y: x ^ y,
        "bitwise_or": lambda x, y: x | y,
        "count_bits": lambda x, _: bin(x % 2**bits).count("1"),
        "shift_left": lambda x, _: x << shift,
        "shift_right": lambda x, _: x >> shift,
    }
    results = out.reshape(15, COUNT)
    for name, result in zip(rules, results, strict=False):
        np.testing.assert_array_equal(result, loop(rules[name], a, b, dtype=dtype), name)
    up, down, lowest, first = results[11:]
    np.testing.assert_array_equal(up, [a[-1], *b[:-1]], "shift_up")
    np.testing.assert_array_equal(down, [*a[1:], b[0]], "shift_down")
    np.testing.assert_array_equal(lowest, [min(map(int, a))] * COUNT, "lowest")
    np.testing.assert_array_equal(first, [a[0]] * COUNT, "first_lane")


@kernel
def _float_lanes(a, b, out, bits):
    x, y = simd.load(a, 0), simd.load(b, 0)
    simd.store(out, 0, simd.add(x, y))
    simd.store(out, 64, simd.subtract(x, y))
    simd.store(out, 128, simd.multiply(x, y))
    simd.store(out, 192, simd.minimum(x, y))
    simd.store(out, 256, simd.maximum(x, y))
    simd.store(bits, 0, simd.bits_of(x))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_operations_on_floats_are_single_and_of_ieee(run):
    a, b = floats(0), floats(1)
    out, bits = np.empty(5 * COUNT, np.float32), np.empty(COUNT, np.int32)
    run(_float_lanes, a, b, out, bits)
    single = [(np.float32(x), np.float32(y)) for x, y in zip(a, b, strict=True)]
    rows = out.reshape(5, COUNT)
    np.testing.assert_array_equal(rows[0], [x + y for x, y in single], "add")
    np.testing.assert_array_equal(rows[1], [x - y for x, y in single], "subtract")
    np.testing.assert_array_equal(rows[2], [x * y for x, y in single], "multiply")
    np.testing.assert_array_equal(rows[3], [x if x < y else y for x, y in single], "minimum")
    np.testing.assert_array_equal(rows[4], [x if x > y else y for x, y in single], "maximum")
    np.testing.assert_array_equal(bits, [struct.unpack("i", struct.pack("f", x))[0] for x in a], "bits_of")


def test_a_product_is_rounded_before_it_is_added(run):
    """A contracted multiplication and addition would keep the last bits."""
    a = np.full(COUNT, np.float32(1) + np.float32(2**-12), np.float32)
    out = np.empty(COUNT, np.float32)
    run(_product_and_sum, a, np.full(COUNT, np.float32(-1), np.float32), out)
    product = np.float32(a[0]) * np.float32(a[0])
    np.testing.assert_array_equal(out, [product + np.float32(-1)] * COUNT)


@kernel
def _product_and_sum(a, b, out):
    x = simd.load(a, 0)
    simd.store(out, 0, simd.add(simd.multiply(x, x), simd.load(b, 0)))


@kernel
def _high_words(a, b, out):
    simd.store(out, 0, simd.multiply_high_doubled(simd.load(a, 0), simd.load(b, 0)))


def test_high_words_of_doubled_products_round_down(run):
    a, b = integers(np.int16, 0), integers(np.int16, 1)
    a >>= 1  # twice a must fit
    out = np.empty(COUNT, np.int16)
    run(_high_words, a, b, out)
    np.testing.assert_array_equal(out, loop(lambda x, y: (2 * x * y) // 2**16, a, b, dtype=np.int16))


@inline
def _add_pair(total, lane, context):
    pairs, start, count, factors, k = context
    words = simd.load_pairs(pairs, start, count, 3 + lane)
    total = simd.add_pairs(total, words, simd.splat_pair_at(factors, k))
    return simd.add_firsts(total, words, simd.splat_pair_at(factors, k + 1))


@inline
def _copy_part(part, lane, out):
    simd.store(out, lane, part)
    return part


@kernel
def _pairs(first, second, start, pairs, factors, k, out):
    for n in range(first.size):
        simd.store_pair(pairs, start, first.size, n, first[n], second[n])
    totals = simd.splat_parts(np.int32(1))
    totals = simd.each_part(_add_pair, totals, 0, (pairs, start, first.size, factors, k))
    simd.each_part(_copy_part, totals, 0, out)


@pytest.mark.parametrize("start", [0, 5])
@pytest.mark.parametrize("factor", [(2**15 - 1, -1), (-(2**15), 0), (3, -(2**15)), (-(2**15), -(2**15)), (-7, 9)])
def test_pairs_of_words_are_multiplied_and_added(run, start, factor):
    first, second = (np.resize(integers(np.int16, seed), 3 + COUNT + 2) for seed in (0, 1))
    pairs = np.full(start + first.size + 1, 77, np.int32)
    factors = np.array([1, wrap((factor[0] & 0xFFFF) | (factor[1] << 16), np.int32), -5 & 0xFFFF], np.int32)
    out = np.empty(COUNT, np.int32)
    run(_pairs, first, second, start, pairs, factors, 1, out)
    expected = loop(lambda x, y: 1 + x * (factor[0] - 5) + y * factor[1], first[3:-2], second[3:-2], dtype=np.int32)
    np.testing.assert_array_equal(out, expected)
    assert (pairs[:start] == 77).all() and pairs[-1] == 77


@inline
def _scale(total, lane, context):
    values, factors, k = context
    shifted = simd.add(simd.load_part(values, lane), simd.splat_part(np.int32(2)))
    return simd.add_scaled(total, shifted, simd.splat_part_at(factors, k))


@kernel
def _scaled(values, factors, k, out):
    totals = simd.each_part(_scale, simd.splat_parts(np.int32(-(2**31))), 0, (values, factors, k))
    simd.each_part(_copy_part, totals, 0, out)


@pytest.mark.parametrize("factor", [0, 1, -1, 2**15 - 1, -(2**15)])
def test_words_are_scaled_and_added(run, factor):
    values = integers(np.int16, 0).astype(np.int32) - 2
    out = np.empty(COUNT, np.int32)
    run(_scaled, values, np.array([5, factor & 0xFFFF], np.int32), 1, out)
    np.testing.assert_array_equal(out, loop(lambda x: -(2**31) + (x + 2) * factor, values, dtype=np.int32))


def test_a_block_is_made_of_whole_parts():
    assert simd.LANES % simd.PART == 0 and lanes.LANES % lanes.PART == 0 and lanes.PART < lanes.LANES


@kernel
def _comparisons(a, b, bit, marks, masks):
    x, y = simd.load(a, 0), simd.load(b, 0)
    simd.store(marks, 0, simd.mark_less(x, y, bit))
    masks[0] = simd.mask_equal(x, y)
    masks[1] = np.uint64(simd.first_bit(masks[0]))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_comparisons_of_lanes(run, dtype):
    a, b = integers(dtype, 0), integers(dtype, 1)
    a[[0, 1, 2]] = b[[0, 1, 2]] + 1  # none of the first is equal
    a[[5, 40, 63]] = b[[5, 40, 63]]
    marks, masks = np.empty(COUNT, np.uint8), np.empty(2, np.uint64)
    run(_comparisons, a, b, np.uint8(32), marks, masks)
    np.testing.assert_array_equal(marks, [32 if int(x) < int(y) else 0 for x, y in zip(a, b, strict=True)], "mark_less")
    equal = [k for k in range(COUNT) if a[k] == b[k]]
    assert int(masks[0]) == sum(2**k for k in equal)
    assert int(masks[1]) == equal[0] > 0
    run(_comparisons, np.zeros(COUNT, dtype), np.ones(COUNT, dtype), np.uint8(1), marks, masks)
    assert masks.tolist() == [0, 64]


@kernel
def _without_three(a, first, out):
    simd.store(out, 0, simd.without_three(simd.load(a, 0), first))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.int32])
@pytest.mark.parametrize("first", [-32768, -3, -2, -1, 0, 17, 61, 62, 63, 64, 32767])
def test_three_lanes_are_left_out(run, dtype, first):
    a, out = integers(dtype, 0), np.empty(COUNT, dtype)
    run(_without_three, a, first, out)
    expected = [np.iinfo(dtype).max if first <= k < first + 3 else a[k] for k in range(COUNT)]
    np.testing.assert_array_equal(out, expected)


@kernel
def _converted(values, out):
    simd.store(out, 0, simd.convert(simd.load(values, 0), out[0]))


@pytest.mark.parametrize(
    ("source", "target"),
    [
        (np.uint8, np.uint16),
        (np.uint8, np.int16),
        (np.uint8, np.float32),
        (np.uint16, np.uint8),
        (np.int16, np.uint8),
        (np.int8, np.uint8),
        (np.int8, np.int32),
        (np.int32, np.uint8),
        (np.int32, np.int8),
        (np.int32, np.int16),
        (np.int32, np.float32),
        (np.int32, np.int32),
    ],
)
def test_conversions_of_integers(run, source, target):
    values, out = integers(source, 0), np.zeros(COUNT, target)
    run(_converted, values, out)
    if target is np.float32:
        np.testing.assert_array_equal(out, [np.float32(int(value)) for value in values])
    else:
        np.testing.assert_array_equal(out, loop(lambda value: value, values, dtype=target))


@pytest.mark.parametrize("target", [np.int32, np.int16])
def test_floats_are_cut_towards_zero(run, target):
    values, out = np.linspace(-3000.9, 3000.9, COUNT, dtype=np.float32), np.zeros(COUNT, target)
    run(_converted, values, out)
    np.testing.assert_array_equal(out, [math.trunc(float(value)) for value in values])


@kernel
def _lowest_of_4(a, out):
    lows = simd.lowest_of_4(simd.load(a, 0), simd.load(a, 64), simd.load(a, 128), simd.load(a, 192))
    simd.store(out, 0, lows[0])
    simd.store(out, 64, lows[1])
    simd.store(out, 128, lows[2])
    simd.store(out, 192, lows[3])


def test_the_smallest_lane_of_each_of_four_vectors(run):
    rng = np.random.default_rng(2)
    out = np.empty(4 * COUNT, np.uint8)
    for at in range(COUNT):  # every lane is the smallest once
        values = rng.integers(4, 256, (4, COUNT)).astype(np.uint8)
        values[[0, 1, 2, 3], [(at + 17 * k) % COUNT for k in range(4)]] = [2, 0, 3, 1]
        run(_lowest_of_4, values.ravel(), out)
        np.testing.assert_array_equal(out.reshape(4, COUNT), np.repeat([[2], [0], [3], [1]], COUNT, axis=1))


@kernel
def _scalars(values, out):
    for k in range(values.size):
        out[k] = simd.count_ones(values[k])
        out[values.size + k] = simd.select(values[k] > 5, k, -k)


def test_operations_on_single_numbers(run):
    values = np.array([0, 1, 5, 6, 2**31, 2**32 - 1, 0xAAAAAAAA], np.uint32)
    out = np.empty(2 * values.size, np.int64)
    run(_scalars, values, out)
    assert out[: values.size].tolist() == [bin(value).count("1") for value in values.tolist()]
    assert out[values.size :].tolist() == [k if value > 5 else -k for k, value in enumerate(values.tolist())]


@kernel
def _moved(values, at, out):
    simd.prefetch(values, at + 10**6)
    simd.stream(out, 0, simd.load(values, at))
    simd.stream_fence()
    simd.store(out, 67, simd.splat_at(values, at + 1))
    simd.store(out, 131, simd.splat(values[at + 2]))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("at", [0, 1, 36])
def test_loads_and_stores_at_any_offset(run, dtype, at):
    values = np.random.default_rng(3).integers(0, 256, 100).astype(dtype)
    out = simd.aligned((200,), dtype)
    assert out.ctypes.data % 64 == 0 and out.flags.c_contiguous and out.shape == (200,)
    out[:] = 7
    run(_moved, values, at, out)
    expected = [*values[at : at + 64], 7, 7, 7, *[values[at + 1]] * 64, *[values[at + 2]] * 64, *[7] * 5]
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("aligned", [simd.aligned, lanes.aligned])
def test_aligned_arrays_of_every_shape(aligned):
    for shape in ((1,), (3, 5), (1, 2, 3)):
        array = aligned(shape, np.int16)
        assert array.shape == shape and array.dtype == np.int16 and array.ctypes.data % 64 == 0
    assert aligned((0,), np.float32).size == 0


@pytest.mark.parametrize("offset", [-1, 37, 10**6])
def test_stand_ins_check_bounds_and_alignment(offset):
    array = lanes.aligned((100,), np.uint8)
    vector = lanes.splat(np.uint8(1))
    for access in (lambda: lanes.load(array, offset), lambda: lanes.store(array, offset, vector)):
        with pytest.raises(lanes.OutOfBounds):
            access()
    with pytest.raises(lanes.OutOfBounds):
        lanes.splat_at(array, 100)
    with pytest.raises(lanes.Misaligned):
        lanes.stream(array, 1, vector)
    with pytest.raises(TypeError):
        lanes.store(array, 0, lanes.splat(np.int16(1)))


def test_the_type_of_vectors():
    from numba import types

    assert simd.Vector(types.uint8) == simd.Vector(types.uint8) != simd.Vector(types.int8)
    assert simd.Vector(types.float32).is_float and not simd.Vector(types.int32).is_float
    assert (simd.Vector(types.float32).suffix, simd.Vector(types.uint16).suffix) == ("v64f32", "v64i16")
    assert str(simd.Vector(types.int16).llvm) == "<64 x i16>" != str(simd.Vector(types.int16, 16).llvm)
    assert simd.Vector(types.int16, 16) == simd.Vector(types.int16, 16) != simd.Vector(types.int16)
    assert simd.vector_bits() in (128, 256, 512)


def test_no_public_name_is_left_out():
    used = set(re.findall(r"\bsimd\.(\w+)", Path(__file__).read_text("utf-8")))
    assert used >= set(simd.__all__) and all(hasattr(simd, name) for name in used)
    assert all(hasattr(lanes, name) for name in set(simd.__all__) - {"Vector", "vector_bits"})
