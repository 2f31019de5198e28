"""Wait for another thread for a moment, without help from the interpreter.

A stage at half size lasts a few hundred microseconds; to hand its tasks out and to wait for them through the
interpreter's queues and locks takes 50 to 80. Who looks at a word in memory instead sees its change within a
microsecond. That uses a processor, so it must not last: after a few microseconds the processor is offered to others
between two looks, and after a few milliseconds the call returns.
"""

from __future__ import annotations

import os
from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel

__all__ = ["spin_while"]

_BUSY_LOOKS = 256
"""Looks, each some tens of nanoseconds, before the processor is offered to others between looks."""
_LOOKS = 8_000
"""Looks in all: a few milliseconds where nobody else wants the processor."""


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


@kernel
def spin_while(words: NDArray[Any], index: int, value: int) -> bool:
    """Wait while element `index` of the int64 `words` has this value; return False if it still has it at the end."""
    for looks in range(_LOOKS):
        if _look(words, index) != value:
            return True
        _pause(looks)
    return False
