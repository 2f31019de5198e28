"""Operations that move lanes: shifts by one lane, reductions of four vectors at once, single lanes."""

from __future__ import annotations

import sys
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from stereokit.kernels.simd.types import I32, LANES, call_ir

__all__ = ["first_lane", "low_bytes_ir", "lowest_of_4", "shift_down", "shift_up"]


def low_bytes_ir(builder: Any, value: Any) -> Any:
    """Cut ``int32`` lanes to bytes in two rounds of shuffles, which cost a third of what LLVM makes of a plain cut."""

    def shuffle(x: Any, y: Any, lanes: Any) -> Any:
        return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(I32, len(lanes)), list(lanes)))

    def halves(parts: list[Any], bits: int) -> list[Any]:
        kind = ir.VectorType(ir.IntType(bits), value.type.count * 8 // bits)
        odd = 0 if sys.byteorder == "little" else 1
        lanes = range(odd, 2 * kind.count, 2)
        parts = [builder.bitcast(part, kind) for part in parts]
        return [shuffle(parts[k], parts[k + 1], lanes) for k in range(0, len(parts), 2)]

    quarter = value.type.count // 4
    quarters = [shuffle(value, value, range(at, at + quarter)) for at in range(0, value.type.count, quarter)]
    return halves(halves(quarters, 16), 8)[0]


def _shuffle(name: str, doc: str, lanes: list[int]) -> Any:
    def define(typing: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.shuffle_vector(*args, ir.Constant(ir.VectorType(I32, LANES), lanes))

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
def lowest_of_4(typing: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Return, for each of four ``uint8`` vectors, a vector whose lanes are all its smallest lane.

    One tree for the four costs hardly more than one alone: the vectors are interleaved as they are halved.
    """
    result = types.UniTuple(a, 4)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def shuffle(x: Any, y: Any, lanes: list[int]) -> Any:
            return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(I32, len(lanes)), lanes))

        def least(x: Any, y: Any) -> Any:
            n = x.type.count
            return call_ir(builder, f"llvm.umin.v{n}i8", ir.VectorType(ir.IntType(8), n), [x, y])

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
        return builder.extract_element(args[0], ir.Constant(I32, 0))

    return value.scalar(value), generate
