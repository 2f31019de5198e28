"""Operations on vectors lane by lane, conversions between their types, and reductions of all lanes."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

from stereokit.kernels.simd.shuffle import low_bytes_ir
from stereokit.kernels.simd.types import (
    I32,
    LANES,
    PAIRED,
    Vector,
    call_ir,
    lanes_ir,
    on_arm,
    on_x86,
    splat_ir,
    vector_bits,
)

__all__ = [
    "add",
    "add_firsts",
    "add_pairs",
    "add_saturated",
    "add_scaled",
    "bits_of",
    "bitwise_or",
    "convert",
    "count_bits",
    "count_ones",
    "first_bit",
    "lowest",
    "mark_less",
    "mask_equal",
    "maximum",
    "minimum",
    "multiply",
    "multiply_high_doubled",
    "select",
    "shift_left",
    "shift_right",
    "subtract",
    "without_three",
    "xor",
]


def _binary(name: str, doc: str, integer: Any, floating: Any = None) -> Any:
    def define(typing: Any, a: Any, b: Any) -> Any:
        if not isinstance(a, Vector) or a != b or (a.is_float and floating is None):
            return None

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return (floating if a.is_float else integer)(builder, a, *args)

        return a(a, b), generate

    define.__name__ = name
    define.__doc__ = doc
    return intrinsic(define)


def _llvm(unsigned: str, signed: str = "") -> Any:
    def build(builder: Any, kind: Vector, x: Any, y: Any) -> Any:
        name = signed if signed and kind.scalar.signed else unsigned
        return call_ir(builder, f"llvm.{name}.{kind.suffix}", kind.llvm, [x, y])

    return build


def _min_float(builder: Any, kind: Vector, x: Any, y: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", x, y), x, y)


def _max_float(builder: Any, kind: Vector, x: Any, y: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", x, y), x, y)


def _high_doubled(builder: Any, kind: Vector, x: Any, y: Any) -> Any:
    if on_arm():  # one instruction, which LLVM would not choose by itself; it saturates for -2**15 twice alone
        eight = ir.VectorType(ir.IntType(16), 8)
        return _by_parts(builder, lambda *v: call_ir(builder, "llvm.aarch64.neon.sqdmulh.v8i16", eight, v), 8, x, y)
    x = builder.shl(x, ir.Constant(kind.llvm, [1] * kind.lanes))
    wide = ir.VectorType(I32, kind.lanes)
    product = builder.mul(builder.sext(x, wide), builder.sext(y, wide))  # with the shift: one instruction on most
    return builder.trunc(builder.lshr(product, ir.Constant(wide, [16] * kind.lanes)), kind.llvm)


def _by_parts(builder: Any, build: Any, count: int, *vectors: Any) -> Any:
    """Emit what `build` makes of each `count` lanes of the vectors, side by side again."""
    starts = range(0, vectors[0].type.count, count)
    parts = [build(*(lanes_ir(builder, v, v, range(at, at + count)) for v in vectors)) for at in starts]
    while len(parts) > 1:
        lanes = range(2 * parts[0].type.count)
        parts = [lanes_ir(builder, parts[k], parts[k + 1], lanes) for k in range(0, len(parts), 2)]
    return parts[0]


add = _binary("add", "Return a + b, wrapping.", lambda b, k, x, y: b.add(x, y), lambda b, k, x, y: b.fadd(x, y))
subtract = _binary(
    "subtract", "Return a - b, wrapping.", lambda b, k, x, y: b.sub(x, y), lambda b, k, x, y: b.fsub(x, y)
)
multiply = _binary(
    "multiply", "Return a * b, wrapping.", lambda b, k, x, y: b.mul(x, y), lambda b, k, x, y: b.fmul(x, y)
)
multiply_high_doubled = _binary(
    "multiply_high_doubled", "Return (2 * a * b) >> 16 of int16 lanes, rounded down; 2 * a must fit.", _high_doubled
)
add_saturated = _binary(
    "add_saturated", "Return a + b, clamped to the type's largest value.", _llvm("uadd.sat", "sadd.sat")
)
minimum = _binary("minimum", "Return the smaller of a and b.", _llvm("umin", "smin"), _min_float)
maximum = _binary("maximum", "Return the larger of a and b.", _llvm("umax", "smax"), _max_float)
xor = _binary("xor", "Return the exclusive or of the bits.", lambda b, k, x, y: b.xor(x, y))
bitwise_or = _binary("bitwise_or", "Return the bits set in a or in b.", lambda b, k, x, y: b.or_(x, y))


@intrinsic
def mark_less(typing: Any, a: Any, b: Any, bit: Any) -> Any:
    """Return `bit` (a ``uint8``) in the ``uint8`` lanes where a < b, and 0 elsewhere."""
    result = Vector(types.uint8)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x, y, value = args
        lower = builder.icmp_unsigned("<", x, y)
        zero = ir.Constant(result.llvm, [0] * LANES)
        return builder.select(lower, splat_ir(builder, value, result), zero)

    return result(a, b, types.uint8), generate


@intrinsic
def count_bits(typing: Any, value: Any) -> Any:
    """Return the number of bits set in each lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return call_ir(builder, f"llvm.ctpop.{value.suffix}", value.llvm, [args[0]])

    return value(value), generate


@intrinsic
def count_ones(typing: Any, value: Any) -> Any:
    """Return the number of bits set in one ``uint32``, as ``int32``; loops over it become vector code."""
    if value != types.uint32:
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return call_ir(builder, "llvm.ctpop.i32", I32, [args[0]])

    return types.int32(types.uint32), generate


@intrinsic
def convert(typing: Any, value: Any, like: Any) -> Any:
    """Return `value` with its lanes converted to the scalar type of `like` (a scalar; its value is unused).

    Integers wrap or widen, floats are cut towards zero: they must lie within the integer's range.
    """
    target = Vector(like, value.lanes)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source = args[0]
        if value.is_float and not target.is_float:
            wide = builder.fptosi(source, ir.VectorType(I32, value.lanes))
            return wide if target.scalar.bitwidth == 32 else builder.trunc(wide, target.llvm)
        if target.is_float and not value.is_float:
            return (builder.sitofp if value.scalar.signed else builder.uitofp)(source, target.llvm)
        if target.scalar.bitwidth > value.scalar.bitwidth:
            return (builder.sext if value.scalar.signed else builder.zext)(source, target.llvm)
        if target.scalar.bitwidth == 8 and value.scalar.bitwidth == 32:
            return low_bytes_ir(builder, source)
        if target.scalar.bitwidth < value.scalar.bitwidth:
            return builder.trunc(source, target.llvm)
        return source

    return target(value, like), generate


@intrinsic
def bits_of(typing: Any, value: Any) -> Any:
    """Return the bits of ``float32`` lanes as ``int32``."""
    result = Vector(types.int32, value.lanes)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], result.llvm)

    return result(value), generate


def _frozen(builder: Any, x: Any) -> Any:
    """Emit `x` itself, but as a whole: LLVM puts no other sum in its place, such as one that it must negate first."""
    frozen = ir.Instruction(builder.block, x.type, "freeze", [x])
    builder._insert(frozen)
    return frozen


def _pairs_on_x86(builder: Any, x: Any, y: Any) -> Any:
    """Emit the one instruction for products of pairs and their sum, which LLVM would not choose by itself."""
    bits = vector_bits() if config.CPU_NAME is None else 128  # every x86_64 has 128
    name = {512: "llvm.x86.avx512.pmaddw.d.512", 256: "llvm.x86.avx2.pmadd.wd", 128: "llvm.x86.sse2.pmadd.wd"}[bits]
    words = ir.VectorType(ir.IntType(16), bits // 16)

    def pairs(*parts: Any) -> Any:
        return call_ir(builder, name, ir.VectorType(I32, bits // 32), [builder.bitcast(part, words) for part in parts])

    return _by_parts(builder, pairs, bits // 32, x, y)


def _add_products(name: str, doc: str, of: slice) -> Any:
    def define(typing: Any, total: Any, pairs: Any, factors: Any) -> Any:
        if total.scalar != types.int32 or factors != pairs:
            return None

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            total, pairs, factors = args
            if PAIRED:
                return builder.add(total, _pairs_on_x86(builder, pairs, factors))
            # One instruction multiplies words and adds the products, each of the pair's own.
            words = [cgutils.unpack_tuple(builder, parts)[of] for parts in (pairs, factors)]
            for pair in zip(*words, strict=True):
                total = builder.add(total, builder.mul(*(builder.sext(word, total.type) for word in pair)))
            return total

        return total(total, pairs, factors), generate

    define.__name__ = name
    define.__doc__ = doc
    return intrinsic(define)


add_pairs = _add_products(
    "add_pairs",
    """Return `total`, ``int32``, with both products of each pair of ``int16`` added, wrapping.

    `pairs` come from `load_pairs`, `factors` from `splat_pair_at`.
    """,
    slice(2),
)
add_firsts = _add_products(
    "add_firsts", "Return what `add_pairs` does where the second of the `factors` is 0: fewer products.", slice(1)
)


@intrinsic
def add_scaled(typing: Any, total: Any, a: Any, b: Any) -> Any:
    """Return ``total + a * low(b)`` of ``int32`` lanes.

    The values of `a` fit ``int16``; the lanes of `b`, all the same, hold one in their low half and 0 in the high one.
    """
    if total.scalar != types.int32 or a != total or b != total:
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, a, b = args
        if on_x86():  # what goes into the sum of pairs is quicker than a product of 32 bits
            return builder.add(total, _pairs_on_x86(builder, a, b))
        half = ir.Constant(a.type, [16] * a.type.count)
        product = builder.mul(a, builder.ashr(builder.shl(b, half), half))
        return builder.add(_frozen(builder, total), product)

    return total(total, a, b), generate


def _shift(name: str, doc: str, build: Any) -> Any:
    def define(typing: Any, value: Any, count: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            amount = builder.trunc(args[1], value.element)
            return build(builder, value, args[0], splat_ir(builder, amount, value))

        return value(value, types.intp), generate

    define.__name__ = name
    define.__doc__ = doc
    return intrinsic(define)


shift_left = _shift("shift_left", "Return value << count.", lambda b, k, x, n: b.shl(x, n))
shift_right = _shift(
    "shift_right",
    "Return value >> count; the sign stays.",
    lambda b, k, x, n: (b.ashr if k.scalar.signed else b.lshr)(x, n),
)


@intrinsic
def select(typing: Any, condition: Any, a: Any, b: Any) -> Any:
    """Return a if `condition` else b, both ``int64``, without a branch."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(args[0], args[1], args[2])

    return types.int64(types.boolean, types.int64, types.int64), generate


@intrinsic
def mask_equal(typing: Any, a: Any, b: Any) -> Any:
    """Return a ``uint64`` whose bit d tells whether lane d of a and b are equal."""

    def on_neon(builder: Any, equal: Any) -> Any:
        # LLVM would bring each eight lanes to a general register and join the bytes there.
        byte, half = ir.IntType(8), ir.VectorType(ir.IntType(8), 16)
        bits = ir.Constant(ir.VectorType(byte, LANES), [1 << d % 8 for d in range(LANES)])
        marks = builder.and_(builder.sext(equal, bits.type), bits)
        parts = [lanes_ir(builder, marks, marks, range(at, at + 16)) for at in range(0, LANES, 16)]
        while parts[0].type == half and len(parts) > 1:
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [call_ir(builder, "llvm.aarch64.neon.addp.v16i8", half, list(pair)) for pair in pairs]
        mask = call_ir(builder, "llvm.aarch64.neon.addp.v16i8", half, [parts[0], parts[0]])
        return builder.extract_element(builder.bitcast(mask, ir.VectorType(ir.IntType(64), 2)), ir.Constant(I32, 0))

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        equal = builder.icmp_unsigned("==", *args)
        return on_neon(builder, equal) if on_arm() else builder.bitcast(equal, ir.IntType(64))

    return types.uint64(a, b), generate


@intrinsic
def first_bit(typing: Any, mask: Any) -> Any:
    """Return the position of the lowest set bit of a ``uint64``, 64 if there is none."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        flag = ir.Constant(ir.IntType(1), 0)
        return call_ir(builder, "llvm.cttz.i64", ir.IntType(64), [args[0], flag])

    return types.int64(types.uint64), generate


@intrinsic
def lowest(typing: Any, value: Any) -> Any:
    """Return the smallest lane of an integer vector."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = "smin" if value.scalar.signed else "umin"
        return call_ir(builder, f"llvm.vector.reduce.{kind}.{value.suffix}", value.element, [args[0]])

    return value.scalar(value), generate


@intrinsic
def without_three(typing: Any, value: Any, first: Any) -> Any:
    """Return an integer vector whose lanes `first` to ``first + 2``, as far as there are such, hold the largest value.

    `first` may be from -32768 to 32767.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector, start = args
        words = Vector(types.uint16)
        begin = splat_ir(builder, builder.trunc(start, words.element), words)
        behind = builder.sub(ir.Constant(words.llvm, list(range(LANES))), begin)
        is_one = builder.icmp_unsigned("<", behind, ir.Constant(words.llvm, [3] * LANES))
        bits = value.element.width
        most = 2 ** (bits - 1) - 1 if value.scalar.signed else 2**bits - 1
        return builder.select(is_one, ir.Constant(value.llvm, [most] * LANES), vector)

    return value(value, types.int64), generate
