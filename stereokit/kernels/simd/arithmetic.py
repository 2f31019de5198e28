"""Operations on vectors lane by lane, conversions between their types, and reductions of all lanes."""

from __future__ import annotations

from typing import Any

from llvmlite import binding, ir
from numba import config, types
from numba.extending import intrinsic

from stereokit.kernels.simd.shuffle import low_bytes_ir
from stereokit.kernels.simd.types import I32, LANES, Vector, call_ir, splat_ir, vector_bits

__all__ = [
    "add",
    "add_saturated",
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
    "multiply_high",
    "multiply_pairs",
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


def _high(builder: Any, kind: Vector, x: Any, y: Any) -> Any:
    wide = ir.VectorType(I32, LANES)
    product = builder.mul(builder.sext(x, wide), builder.sext(y, wide))  # with the shift: one instruction on most
    return builder.trunc(builder.lshr(product, ir.Constant(wide, [16] * LANES)), kind.llvm)


add = _binary("add", "Return a + b, wrapping.", lambda b, k, x, y: b.add(x, y), lambda b, k, x, y: b.fadd(x, y))
subtract = _binary(
    "subtract", "Return a - b, wrapping.", lambda b, k, x, y: b.sub(x, y), lambda b, k, x, y: b.fsub(x, y)
)
multiply = _binary(
    "multiply", "Return a * b, wrapping.", lambda b, k, x, y: b.mul(x, y), lambda b, k, x, y: b.fmul(x, y)
)
multiply_high = _binary("multiply_high", "Return (a * b) >> 16 of int16 lanes, rounded down.", _high)
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
    target = Vector(like)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source = args[0]
        if value.is_float and not target.is_float:
            wide = builder.fptosi(source, ir.VectorType(I32, LANES))
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
    result = Vector(types.int32)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], result.llvm)

    return result(value), generate


@intrinsic
def multiply_pairs(typing: Any, a: Any, b: Any) -> Any:
    """Return ``low(a) * low(b) + high(a) * high(b)`` of ``int32`` lanes that hold two ``int16`` each, wrapping.

    Processors of x86 have one instruction for it, which LLVM would not choose by itself; others get the plain form.
    """
    if a != Vector(types.int32) or b != a:
        return None
    kind = a.llvm

    def plain(builder: Any, x: Any, y: Any) -> Any:
        half = ir.Constant(kind, [16] * LANES)
        low = [builder.ashr(builder.shl(v, half), half) for v in (x, y)]
        high = [builder.ashr(v, half) for v in (x, y)]
        return builder.add(builder.mul(*low), builder.mul(*high))

    def by_parts(builder: Any, name: str, count: int, x: Any, y: Any) -> Any:
        def part(v: Any, at: int) -> Any:
            lanes = ir.Constant(ir.VectorType(I32, count), list(range(at, at + count)))
            return builder.bitcast(builder.shuffle_vector(v, v, lanes), ir.VectorType(ir.IntType(16), 2 * count))

        starts = range(0, LANES, count)
        parts = [call_ir(builder, name, ir.VectorType(I32, count), [part(x, at), part(y, at)]) for at in starts]
        while len(parts) > 1:
            size = 2 * parts[0].type.count
            lanes = ir.Constant(ir.VectorType(I32, size), list(range(size)))
            parts = [builder.shuffle_vector(parts[k], parts[k + 1], lanes) for k in range(0, len(parts), 2)]
        return parts[0]

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if not binding.get_process_triple().startswith("x86_64"):
            return plain(builder, *args)
        bits = vector_bits() if config.CPU_NAME is None else 128  # every x86_64 has 128
        name = {512: "llvm.x86.avx512.pmaddw.d.512", 256: "llvm.x86.avx2.pmadd.wd", 128: "llvm.x86.sse2.pmadd.wd"}[bits]
        return by_parts(builder, name, bits // 32, *args)

    return a(a, b), generate


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

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(builder.icmp_unsigned("==", *args), ir.IntType(64))

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
