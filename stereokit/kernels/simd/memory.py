"""Loads and stores of vectors, with the bounds checks of a checked build."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stereokit.kernels.jit import CHECKED
from stereokit.kernels.simd.types import I32, LANES, PAIRED, PART, Vector, call_ir, on_x86, splat_ir

__all__ = [
    "aligned",
    "load",
    "load_pairs",
    "load_part",
    "prefetch",
    "splat",
    "splat_at",
    "splat_pair_at",
    "splat_part",
    "splat_part_at",
    "store",
    "store_pair",
    "stream",
    "stream_fence",
]


def _element(context: Any, builder: Any, kind: Any, array: Any, offset: Any, count: int) -> Any:
    """Return the address of element `offset`, the first of `count`; a checked build traps where one is outside."""
    content = context.make_array(kind)(context, builder, array)
    if CHECKED:
        last = builder.sub(content.nitems, ir.Constant(content.nitems.type, count))
        inside = builder.and_(
            builder.icmp_signed(">=", offset, ir.Constant(offset.type, 0)), builder.icmp_signed("<=", offset, last)
        )
        with cgutils.if_unlikely(builder, builder.not_(inside)):
            call_ir(builder, "llvm.trap", ir.VoidType(), [])
    return builder.gep(content.data, [offset])


def _pointer(context: Any, builder: Any, kind: Any, array: Any, offset: Any, lanes: int = LANES) -> Any:
    element = _element(context, builder, kind, array, offset, lanes)
    return builder.bitcast(element, ir.PointerType(Vector(kind.dtype, lanes).llvm))


def _load(name: str, doc: str, lanes: int) -> Any:
    def define(typing: Any, array: Any, offset: Any) -> Any:
        size = array.dtype.bitwidth // 8

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.load(_pointer(context, builder, signature.args[0], args[0], args[1], lanes), align=size)

        return Vector(array.dtype, lanes)(array, types.intp), generate

    define.__name__ = name
    define.__doc__ = doc
    return intrinsic(define)


load = _load("load", "Return `LANES` elements of the flat `array` from `offset` on.", LANES)
load_part = _load("load_part", "Return `PART` elements of the flat `array` from `offset` on.", PART)


@intrinsic
def store(typing: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write the lanes of `value` into the flat `array` from `offset` on."""
    if not isinstance(value, Vector) or value.scalar != array.dtype:
        return None
    size = array.dtype.bitwidth // 8

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], args[0], args[1], value.lanes)
        builder.store(args[2], pointer, align=size)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


@intrinsic
def prefetch(typing: Any, array: Any, offset: Any) -> Any:
    """Ask for the 64 bytes around element `offset` of the flat `array`, which may lie behind its end, in the caches."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        where = builder.bitcast(builder.gep(data, [args[1]]), ir.PointerType(ir.IntType(8)))
        hints = [ir.Constant(I32, value) for value in (0, 2, 1)]  # to read, into the second level, data
        call_ir(builder, "llvm.prefetch.p0", ir.VoidType(), [where, *hints])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@intrinsic
def stream(typing: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write the lanes of `value` past the caches into the flat `array`, whose element `offset` is 64-byte aligned.

    For what is not read again before the caches have lost it: memory is written without being read first. Another
    thread sees it after `stream_fence`. Processors without such stores write as `store` does.
    """
    if value != Vector(array.dtype):
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], args[0], args[1])
        written = builder.store(args[2], pointer, align=64)
        written.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(I32, 1)]))
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


@intrinsic
def stream_fence(typing: Any) -> Any:
    """Let what was streamed be seen before anything that this thread writes from here on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if on_x86():
            call_ir(builder, "llvm.x86.sse.sfence", ir.VoidType(), [])
        else:
            builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


def _words(context: Any, builder: Any, kind: Any, array: Any, start: Any, count: Any, k: Any, lanes: int) -> list[Any]:
    """Return the addresses of the first and the second words of `lanes` pairs, of which `count` begin at `start`."""
    content = context.make_array(kind)(context, builder, array)
    if CHECKED:
        for place, size in ((builder.add(start, k), lanes), (builder.add(start, count), 0)):
            _element(context, builder, kind, array, place, size)
    words = builder.bitcast(builder.gep(content.data, [start]), ir.PointerType(ir.IntType(16)))
    first = builder.gep(words, [k])
    return [first, builder.gep(first, [count])]


@intrinsic
def store_pair(typing: Any, array: Any, start: Any, count: Any, k: Any, first: Any, second: Any) -> Any:
    """Write pair `k` of ``int16`` into the flat ``int32`` `array`, whose elements from `start` on hold `count` pairs.

    A pair's words lie in one element, the first in its low half, or all first words before all second ones: as the
    processor multiplies them best.
    """
    if array.dtype != types.int32 or first != types.int16 or second != first:
        return None

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, start, count, k, first, second = args
        kind = signature.args[0]
        if PAIRED:
            low = builder.zext(first, I32)
            high = builder.shl(builder.zext(second, I32), ir.Constant(I32, 16))
            builder.store(builder.or_(low, high), _element(context, builder, kind, array, builder.add(start, k), 1))
        else:
            for word, to in zip(
                (first, second), _words(context, builder, kind, array, start, count, k, 1), strict=True
            ):
                builder.store(word, to, align=2)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, types.intp, first, second), generate


@intrinsic
def load_pairs(typing: Any, array: Any, start: Any, count: Any, k: Any) -> Any:
    """Return `PART` pairs from pair `k` on, of the `count` that `store_pair` put into `array` from `start` on."""
    word = Vector(types.int16, PART)
    result = Vector(types.int32, PART) if PAIRED else types.UniTuple(word, 2)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, start, count, k = args
        kind = signature.args[0]
        if PAIRED:
            return builder.load(_pointer(context, builder, kind, array, builder.add(start, k), PART), align=4)
        places = _words(context, builder, kind, array, start, count, k, PART)
        words = [builder.load(builder.bitcast(place, ir.PointerType(word.llvm)), align=2) for place in places]
        return context.make_tuple(builder, result, words)

    return result(array, types.intp, types.intp, types.intp), generate


@intrinsic
def splat_pair_at(typing: Any, array: Any, offset: Any) -> Any:
    """Return `PART` pairs that are all the one in element `offset` of an ``int32`` `array`, its low half first."""
    word = Vector(types.int16, PART)
    result = Vector(types.int32, PART) if PAIRED else types.UniTuple(word, 2)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        element = _element(context, builder, signature.args[0], args[0], args[1], 1)
        both = builder.load(element)
        if PAIRED:
            return splat_ir(builder, both, result)
        halves = [builder.trunc(half, word.element) for half in (both, builder.lshr(both, ir.Constant(I32, 16)))]
        return context.make_tuple(builder, result, [splat_ir(builder, half, word) for half in halves])

    return result(array, types.intp), generate


def _splat(name: str, doc: str, lanes: int) -> Any:
    def define(typing: Any, scalar: Any) -> Any:
        kind = Vector(scalar, lanes)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return splat_ir(builder, args[0], kind)

        return kind(scalar), generate

    define.__name__ = name
    define.__doc__ = doc
    return intrinsic(define)


def _splat_at(name: str, doc: str, lanes: int) -> Any:
    def define(typing: Any, array: Any, offset: Any) -> Any:
        kind = Vector(array.dtype, lanes)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            element = _element(context, builder, signature.args[0], args[0], args[1], 1)
            return splat_ir(builder, builder.load(element), kind)

        return kind(array, types.intp), generate

    define.__name__ = name
    define.__doc__ = doc
    return intrinsic(define)


splat = _splat("splat", "Return a vector whose lanes are all `scalar`, of the scalar's own type.", LANES)
splat_part = _splat("splat_part", "Return `PART` lanes that are all `scalar`, of the scalar's own type.", PART)
splat_at = _splat_at(
    "splat_at",
    "Return a vector whose lanes are all element `offset` of the flat `array`; `offset` is not negative.",
    LANES,
)
splat_part_at = _splat_at(
    "splat_part_at",
    "Return `PART` lanes that are all element `offset` of the flat `array`; `offset` is not negative.",
    PART,
)


def aligned(shape: tuple[int, ...], dtype: Any) -> np.ndarray[Any, Any]:
    """Return an uninitialised C-contiguous array whose first element lies on a 64-byte boundary."""
    count = int(np.prod(shape))
    size = np.dtype(dtype).itemsize
    raw = np.empty(count * size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    part: np.ndarray[Any, Any] = raw[start : start + count * size].view(dtype).reshape(shape)
    return part
