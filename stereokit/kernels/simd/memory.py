"""Loads and stores of vectors, with the bounds checks of a checked build."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stereokit.kernels.jit import CHECKED
from stereokit.kernels.simd.types import I32, LANES, Vector, call_ir, splat_ir

__all__ = ["aligned", "load", "prefetch", "splat", "splat_at", "store", "stream", "stream_fence"]


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
    if not isinstance(value, Vector) or value.scalar != array.dtype:
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
        if binding.get_process_triple().startswith("x86_64"):
            call_ir(builder, "llvm.x86.sse.sfence", ir.VoidType(), [])
        else:
            builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def splat(typing: Any, scalar: Any) -> Any:
    """Return a vector whose lanes are all `scalar`, of the scalar's own type."""
    kind = Vector(scalar)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return splat_ir(builder, args[0], kind)

    return kind(scalar), generate


@intrinsic
def splat_at(typing: Any, array: Any, offset: Any) -> Any:
    """Return a vector whose lanes are all element `offset` of the flat `array`; `offset` is not negative."""
    kind = Vector(array.dtype)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        element = _element(context, builder, signature.args[0], args[0], args[1], 1)
        return splat_ir(builder, builder.load(element), kind)

    return kind(array, types.intp), generate


def aligned(shape: tuple[int, ...], dtype: Any) -> np.ndarray[Any, Any]:
    """Return an uninitialised C-contiguous array whose first element lies on a 64-byte boundary."""
    count = int(np.prod(shape))
    size = np.dtype(dtype).itemsize
    raw = np.empty(count * size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    part: np.ndarray[Any, Any] = raw[start : start + count * size].view(dtype).reshape(shape)
    return part
