"""Vector values for numba: 64 lanes of one integer or float type, written once for every processor.

A `Vector` is a numba type whose value is one LLVM vector, ``<64 x i8>`` and so on. LLVM splits or widens it to
what the processor has (two registers of AVX2, four of NEON or SSE), so there is one source and the same result
everywhere: the integer operations are exact and the float ones are single IEEE operations, never contracted.

The functions of this module can be called from compiled code only. They take flat arrays and offsets in
elements. Nothing checks bounds but a build with ``STEREOKIT_CHECKED=1``, whose accesses outside of an array end the
process.

Layout of a row of costs or path costs (one row of the image, `W` pixels, `D` disparity levels padded to
``P = 64 * ceil(D / 64)``)::

    offset  0 .. P-1        P .. 2P-1       ...    (W-1)P .. WP-1
            pixel x = 0     pixel x = 1            pixel x = W-1
            d = 0 1 2 ...   d = 0 1 2 ...
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from stereokit.kernels.jit import CHECKED

__all__ = [
    "LANES",
    "Vector",
    "add",
    "add_saturated",
    "aligned",
    "bits_of",
    "choose",
    "convert",
    "count_bits",
    "count_ones",
    "either",
    "first_bit",
    "first_lane",
    "less_bit",
    "load",
    "lowest",
    "lowest_of_4",
    "mask_equal",
    "maximum",
    "minimum",
    "multiply",
    "multiply_high",
    "multiply_pairs",
    "prefetch",
    "shift_down",
    "shift_left",
    "shift_right",
    "shift_up",
    "splat",
    "splat_at",
    "store",
    "stream",
    "stream_end",
    "subtract",
    "vector_bits",
    "xor",
]

LANES = 64
"""Disparity levels that one vector value holds."""

_I32 = ir.IntType(32)


class Vector(types.Type):  # type: ignore[misc]
    """The numba type of `LANES` values of one scalar type."""

    def __init__(self, scalar: Any) -> None:
        self.scalar = scalar
        super().__init__(name=f"Vector({LANES} x {scalar})")

    @property
    def is_float(self) -> bool:
        """Whether the lanes are floating point."""
        return isinstance(self.scalar, types.Float)

    @property
    def llvm(self) -> ir.VectorType:
        """The LLVM type."""
        return ir.VectorType(self.element, LANES)

    @property
    def element(self) -> ir.Type:
        """The LLVM type of one lane."""
        return ir.FloatType() if self.is_float else ir.IntType(self.scalar.bitwidth)

    @property
    def suffix(self) -> str:
        """How LLVM's intrinsics name the type."""
        return f"v{LANES}{'f32' if self.is_float else f'i{self.scalar.bitwidth}'}"


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Vector) -> None:
        super().__init__(manager, kind, kind.llvm)


def vector_bits() -> int:
    """Return the width in bits of the processor's widest vectors that the compiler will use."""
    features = binding.get_host_cpu_features()
    if features.get("avx512bw"):
        return 512
    if features.get("avx2"):
        return 256
    return 128


def _splat_ir(builder: Any, scalar: Any, kind: Vector) -> Any:
    empty = ir.Constant(kind.llvm, ir.Undefined)
    first = builder.insert_element(empty, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, empty, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES))


def _call(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    signature = ir.FunctionType(result, [a.type for a in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, name), args)


def _element(context: Any, builder: Any, kind: Any, array: Any, offset: Any, count: int) -> Any:
    """Return the address of element `offset`, the first of `count`; a checked build traps where one is outside."""
    content = context.make_array(kind)(context, builder, array)
    if CHECKED:
        last = builder.sub(content.nitems, ir.Constant(content.nitems.type, count))
        inside = builder.and_(
            builder.icmp_signed(">=", offset, ir.Constant(offset.type, 0)), builder.icmp_signed("<=", offset, last)
        )
        with cgutils.if_unlikely(builder, builder.not_(inside)):
            _call(builder, "llvm.trap", ir.VoidType(), [])
    return builder.gep(content.data, [offset])


def _pointer(context: Any, builder: Any, kind: Any, array: Any, offset: Any) -> Any:
    element = _element(context, builder, kind, array, offset, LANES)
    return builder.bitcast(element, ir.PointerType(Vector(kind.dtype).llvm))


@intrinsic
def load(typing: Any, array: Any, offset: Any) -> Any:
    """Return `LANES` elements of the flat `array` from `offset` on."""
    size = array.dtype.bitwidth // 8

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, signature.args[0], args[0], args[1]), align=size)

    return Vector(array.dtype)(array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write the lanes of `value` into the flat `array` from `offset` on."""
    if not isinstance(value, Vector) or value.scalar != array.dtype:
        return None
    size = array.dtype.bitwidth // 8

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, signature.args[0], args[0], args[1]), align=size)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


@intrinsic
def prefetch(typing: Any, array: Any, offset: Any) -> Any:
    """Ask for the 64 bytes around element `offset` of the flat `array`, which may lie behind its end, in the caches."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        where = builder.bitcast(builder.gep(data, [args[1]]), ir.PointerType(ir.IntType(8)))
        hints = [ir.Constant(_I32, value) for value in (0, 2, 1)]  # to read, into the second level, data
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), [where, *hints])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@intrinsic
def stream(typing: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write the lanes of `value` past the caches into the flat `array`, whose element `offset` is 64-byte aligned.

    For what is not read again before the caches have lost it: memory is written without being read first. Another
    thread sees it after `stream_end`. Processors without such stores write as `store` does.
    """
    if not isinstance(value, Vector) or value.scalar != array.dtype:
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], args[0], args[1])
        written = builder.store(args[2], pointer, align=64)
        written.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(_I32, 1)]))
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


@intrinsic
def stream_end(typing: Any) -> Any:
    """Let what was streamed be seen before anything that this thread writes from here on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if binding.get_process_triple().startswith("x86_64"):
            _call(builder, "llvm.x86.sse.sfence", ir.VoidType(), [])
        else:
            builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def splat(typing: Any, scalar: Any) -> Any:
    """Return a vector whose lanes all hold `scalar`, of the scalar's own type."""
    kind = Vector(scalar)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _splat_ir(builder, args[0], kind)

    return kind(scalar), generate


@intrinsic
def splat_at(typing: Any, array: Any, offset: Any) -> Any:
    """Return a vector whose lanes all hold element `offset` of the flat `array`; `offset` is not negative."""
    kind = Vector(array.dtype)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        element = _element(context, builder, signature.args[0], args[0], args[1], 1)
        return _splat_ir(builder, builder.load(element), kind)

    return kind(array, types.intp), generate


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
        return _call(builder, f"llvm.{name}.{kind.suffix}", kind.llvm, [x, y])

    return build


def _least_float(builder: Any, kind: Vector, x: Any, y: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", x, y), x, y)


def _most_float(builder: Any, kind: Vector, x: Any, y: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", x, y), x, y)


def _high(builder: Any, kind: Vector, x: Any, y: Any) -> Any:
    wide = ir.VectorType(_I32, LANES)
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
    "add_saturated", "Return a + b, held at the type's largest value.", _llvm("uadd.sat", "sadd.sat")
)
minimum = _binary("minimum", "Return the smaller of a and b.", _llvm("umin", "smin"), _least_float)
maximum = _binary("maximum", "Return the larger of a and b.", _llvm("umax", "smax"), _most_float)
xor = _binary("xor", "Return the exclusive or of the bits.", lambda b, k, x, y: b.xor(x, y))
either = _binary("either", "Return the bits set in a or in b.", lambda b, k, x, y: b.or_(x, y))


@intrinsic
def less_bit(typing: Any, a: Any, b: Any, bit: Any) -> Any:
    """Return `bit` (a ``uint8``) in the ``uint8`` lanes where a < b, and 0 elsewhere."""
    result = Vector(types.uint8)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x, y, value = args
        lower = builder.icmp_unsigned("<", x, y)
        zero = ir.Constant(result.llvm, [0] * LANES)
        return builder.select(lower, _splat_ir(builder, value, result), zero)

    return result(a, b, types.uint8), generate


@intrinsic
def count_bits(typing: Any, value: Any) -> Any:
    """Return the number of bits set in each lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, f"llvm.ctpop.{value.suffix}", value.llvm, [args[0]])

    return value(value), generate


@intrinsic
def count_ones(typing: Any, value: Any) -> Any:
    """Return the number of bits set in one ``uint32``, as ``int32``; loops over it become vector code."""
    if value != types.uint32:
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, "llvm.ctpop.i32", _I32, [args[0]])

    return types.int32(types.uint32), generate


def _low_bytes(builder: Any, value: Any) -> Any:
    """Cut ``int32`` lanes to bytes in two rounds of shuffles, which cost a third of what LLVM makes of a plain cut."""

    def shuffle(x: Any, y: Any, lanes: Any) -> Any:
        return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(_I32, len(lanes)), list(lanes)))

    def halves(parts: list[Any], bits: int) -> list[Any]:
        kind = ir.VectorType(ir.IntType(bits), LANES * 8 // bits)
        odd = 0 if sys.byteorder == "little" else 1
        lanes = range(odd, 2 * kind.count, 2)
        parts = [builder.bitcast(part, kind) for part in parts]
        return [shuffle(parts[k], parts[k + 1], lanes) for k in range(0, len(parts), 2)]

    quarters = [shuffle(value, value, range(at, at + LANES // 4)) for at in range(0, LANES, LANES // 4)]
    return halves(halves(quarters, 16), 8)[0]


@intrinsic
def convert(typing: Any, value: Any, like: Any) -> Any:
    """Return `value` with its lanes converted to the scalar type of `like` (a scalar; its value is unused).

    Integers wrap or widen, floats are cut towards zero: they must lie within the integer's range.
    """
    target = Vector(like)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source = args[0]
        if value.is_float and not target.is_float:
            wide = builder.fptosi(source, ir.VectorType(_I32, LANES))
            return wide if target.scalar.bitwidth == 32 else builder.trunc(wide, target.llvm)
        if target.is_float and not value.is_float:
            return (builder.sitofp if value.scalar.signed else builder.uitofp)(source, target.llvm)
        if target.scalar.bitwidth > value.scalar.bitwidth:
            return (builder.sext if value.scalar.signed else builder.zext)(source, target.llvm)
        if target.scalar.bitwidth == 8 and value.scalar.bitwidth == 32:
            return _low_bytes(builder, source)
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

    Processors of x86 have one instruction for it, of which LLVM must be told; others get the plain form.
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
            lanes = ir.Constant(ir.VectorType(_I32, count), list(range(at, at + count)))
            return builder.bitcast(builder.shuffle_vector(v, v, lanes), ir.VectorType(ir.IntType(16), 2 * count))

        starts = range(0, LANES, count)
        parts = [_call(builder, name, ir.VectorType(_I32, count), [part(x, at), part(y, at)]) for at in starts]
        while len(parts) > 1:
            size = 2 * parts[0].type.count
            lanes = ir.Constant(ir.VectorType(_I32, size), list(range(size)))
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
            return build(builder, value, args[0], _splat_ir(builder, amount, value))

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


def _shuffle(name: str, doc: str, lanes: list[int]) -> Any:
    def define(typing: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.shuffle_vector(*args, ir.Constant(ir.VectorType(_I32, LANES), lanes))

        return a(a, b), generate

    define.__name__ = name
    define.__doc__ = doc
    return intrinsic(define)


shift_up = _shuffle(
    "shift_up",
    "Return lane d - 1 at lane d; lane 0 takes the last lane of `a`, the block before.",
    [LANES - 1 + i for i in range(LANES)],
)
shift_down = _shuffle(
    "shift_down",
    "Return lane d + 1 at lane d; the last lane takes lane 0 of `b`, the block behind.",
    [i + 1 for i in range(LANES)],
)


@intrinsic
def lowest(typing: Any, value: Any) -> Any:
    """Return the smallest lane of an integer vector."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = "smin" if value.scalar.signed else "umin"
        return _call(builder, f"llvm.vector.reduce.{kind}.{value.suffix}", value.element, [args[0]])

    return value.scalar(value), generate


@intrinsic
def lowest_of_4(typing: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Return, for each of four ``uint8`` vectors, a vector whose lanes all hold its smallest lane.

    One tree for the four costs hardly more than one alone: the vectors are interleaved as they are halved.
    """
    result = types.UniTuple(a, 4)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def shuffle(x: Any, y: Any, lanes: list[int]) -> Any:
            return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(_I32, len(lanes)), lanes))

        def least(x: Any, y: Any) -> Any:
            n = x.type.count
            return _call(builder, f"llvm.umin.v{n}i8", ir.VectorType(ir.IntType(8), n), [x, y])

        def unpack(size: int, high: bool) -> list[int]:
            # Within each 16 byte part, alternate groups of `size` bytes of the two sources (x86 "unpack").
            lanes: list[int] = []
            for part in range(0, LANES, 16):
                for k in range(0, 8, size):
                    at = part + (8 if high else 0) + k
                    lanes += [at + i for i in range(size)] + [LANES + at + i for i in range(size)]
            return lanes

        def zip_least(x: Any, y: Any, size: int) -> Any:
            return least(shuffle(x, y, unpack(size, False)), shuffle(x, y, unpack(size, True)))

        first, second, third, fourth = args
        value = zip_least(zip_least(first, second, 1), zip_least(third, fourth, 1), 2)  # a b c d  a b c d ...
        for n in (32, 16):
            none = ir.Constant(value.type, ir.Undefined)
            value = least(shuffle(value, none, list(range(n))), shuffle(value, none, list(range(n, 2 * n))))
        for n in (8, 4):
            none = ir.Constant(value.type, ir.Undefined)
            value = least(value, shuffle(value, none, [(n + i) % 16 for i in range(16)]))
        none = ir.Constant(value.type, ir.Undefined)
        return context.make_tuple(builder, result, [shuffle(value, none, [n] * LANES) for n in range(4)])

    return result(a, b, c, d), generate


@intrinsic
def first_lane(typing: Any, value: Any) -> Any:
    """Return lane 0."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.extract_element(args[0], ir.Constant(_I32, 0))

    return value.scalar(value), generate


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
        return _call(builder, "llvm.cttz.i64", ir.IntType(64), [args[0], flag])

    return types.int64(types.uint64), generate


@intrinsic
def choose(typing: Any, condition: Any, a: Any, b: Any) -> Any:
    """Return a if `condition` else b, both ``int64``, without a branch."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(args[0], args[1], args[2])

    return types.int64(types.boolean, types.int64, types.int64), generate


def aligned(shape: tuple[int, ...], dtype: Any) -> np.ndarray[Any, Any]:
    """Return an uninitialised C-contiguous array whose first element lies on a 64-byte boundary."""
    count = int(np.prod(shape))
    size = np.dtype(dtype).itemsize
    raw = np.empty(count * size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    part: np.ndarray[Any, Any] = raw[start : start + count * size].view(dtype).reshape(shape)
    return part
