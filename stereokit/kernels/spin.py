"""Wait for another thread for a moment, and share out work, without help from the interpreter.

A stage at half size lasts a few hundred microseconds; to hand its tasks out and to wait for them through the
interpreter's queues and locks takes 50 to 80. Who looks at a word in memory instead sees its change within a
microsecond. That uses a processor, so it must not last: after a few microseconds the processor is offered to others
between two looks, after a few hundred who waits sleeps between two looks, and after some milliseconds `spin_while`
returns.

`claim`, `publish` and `wait_until` let kernels that run side by side work on rows of which each needs the one before.
Who claims a row works on it until it is done, and waits for rows alone that were claimed earlier: so some thread
always gets on, however few there are.
"""

from __future__ import annotations

import os
from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from stereokit.kernels.jit import inline, kernel

__all__ = ["LOOKS_AWAKE", "WORDS_APART", "claim", "publish", "spin_while", "wait_until"]

WORDS_APART = 8
"""Elements of int64 from one word to the next that another thread writes: they share no cache line."""

_BUSY_LOOKS = 256
"""Looks, each some tens of nanoseconds, before the processor is offered to others between looks."""
LOOKS_AWAKE = 300
"""Looks before the first sleep between two: some tens of microseconds where nobody else wants the processor. A sleep
may last three times as long as it is asked to."""
_SLEEPS = 60
"""Sleeps of `spin_while`, some milliseconds in all."""
_SLEEP_MICROSECONDS = 50


@intrinsic
def _look(typing: Any, words: Any, index: Any) -> Any:
    """Return an element as other threads have left it."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load_atomic(builder.gep(data, [args[1]]), "seq_cst", 8)

    return types.int64(words, types.intp), generate


@intrinsic
def _pause(typing: Any, looks: Any) -> Any:
    """Wait a moment, longer after many `looks`; on Windows it yields the processor to nobody."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def call(name: str, result: Any) -> None:
            builder.call(cgutils.get_or_insert_function(builder.module, ir.FunctionType(result, []), name), [])

        if os.name == "posix":
            many = builder.icmp_signed(">", args[0], ir.Constant(args[0].type, _BUSY_LOOKS))
            with builder.if_then(many, likely=False):
                call("sched_yield", ir.IntType(32))
        if binding.get_process_triple().startswith("x86_64"):
            call("llvm.x86.sse2.pause", ir.VoidType())
        return context.get_dummy_value()

    return types.void(types.int64), generate


@intrinsic
def claim(typing: Any, words: Any, index: Any) -> Any:
    """Return an element and raise it by 1: no two threads get the same number."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", builder.gep(data, [args[1]]), ir.Constant(ir.IntType(64), 1), "seq_cst")

    return types.int64(words, types.intp), generate


@intrinsic
def publish(typing: Any, words: Any, index: Any, value: Any) -> Any:
    """Set an element; who sees its new value sees all that this thread wrote before."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        builder.store_atomic(args[2], builder.gep(data, [args[1]]), "seq_cst", 8)
        return context.get_dummy_value()

    return types.void(words, types.intp, types.int64), generate


@intrinsic
def _sleep(typing: Any, microseconds: Any) -> Any:
    """Leave the processor to others for a while; on Windows, where it is left to the system, at once."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if os.name == "posix":
            kind = ir.FunctionType(ir.IntType(32), [ir.IntType(32)])
            sleep = cgutils.get_or_insert_function(builder.module, kind, "usleep")
            builder.call(sleep, [builder.trunc(args[0], ir.IntType(32))])
        return context.get_dummy_value()

    return types.void(types.int64), generate


@inline
def _wait(looks: int, awake: int) -> None:
    """Wait for a moment after so many looks."""
    if looks < awake:
        _pause(looks)
    else:
        _sleep(_SLEEP_MICROSECONDS)


@kernel
def spin_while(words: NDArray[Any], index: int, value: int, awake: int) -> bool:
    """Wait while element `index` of the int64 `words` has this value; return False if it still has it at the end.

    It looks so many times without sleeping between looks.
    """
    for looks in range(awake + _SLEEPS):
        if _look(words, index) != value:
            return True
        _wait(looks, awake)
    return False


@kernel
def wait_until(words: NDArray[Any], index: int, value: int) -> None:
    """Wait until element `index` of the int64 `words` is at least `value`."""
    looks = 0
    while _look(words, index) < value:
        _wait(looks, LOOKS_AWAKE)
        looks += 1
