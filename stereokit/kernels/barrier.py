"""Where the threads of one call wait for each other between two stages, without help from the interpreter.

A stage at half size lasts a few hundred microseconds; to hand its tasks out and to wait for them through the
interpreter's queues and locks takes 50 to 80. A gate is a counter of arrivals that all watch: the last to come lets
everyone through within a microsecond. Those who wait longer than a moment offer their processor to others.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel

__all__ = ["meet", "new_gate", "open_for_good"]

_I32 = ir.IntType(32)
_PATIENCE = 256
"""Looks at the gate, each some tens of nanoseconds, before the processor is offered to others between looks."""
_LONG_PATIENCE = 50_000
"""Looks after which the waiting thread sleeps between them: some tens of milliseconds."""


def new_gate() -> NDArray[np.int64]:
    """Return a gate that nobody has come to."""
    return np.zeros(2, np.int64)


def open_for_good(gate: NDArray[np.int64]) -> None:
    """Let everyone through, now and later: somebody will not come."""
    gate[1] = 1


def _element(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    return builder.gep(data, [args[1]])


@intrinsic
def _count(typing: Any, gate: Any, index: Any) -> Any:
    """Add one to an element; return what it was. Everything before is visible to who sees the new value."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        one = ir.Constant(ir.IntType(64), 1)
        return builder.atomic_rmw("add", _element(context, builder, signature, args), one, "seq_cst")

    return types.int64(gate, types.intp), generate


@intrinsic
def _look(typing: Any, gate: Any, index: Any) -> Any:
    """Return an element as other threads have left it."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(_element(context, builder, signature, args), "seq_cst", 8)

    return types.int64(gate, types.intp), generate


@intrinsic
def _pause(typing: Any, looks: Any) -> Any:
    """Wait a moment, longer after many `looks`; on Windows the processor is kept."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def call(name: str, result: Any, *values: Any) -> None:
            kind = ir.FunctionType(result, [value.type for value in values])
            builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)

        if os.name == "posix":
            with builder.if_then(builder.icmp_signed(">", args[0], ir.Constant(args[0].type, _PATIENCE)), likely=False):
                call("sched_yield", _I32)
            many = builder.icmp_signed(">", args[0], ir.Constant(args[0].type, _LONG_PATIENCE))
            with builder.if_then(many, likely=False):
                call("usleep", _I32, ir.Constant(_I32, 50))
        if binding.get_process_triple().startswith("x86_64"):
            call("llvm.x86.sse2.pause", ir.VoidType())
        return context.get_dummy_value()

    return types.void(types.int64), generate


@kernel
def meet(gate: NDArray[np.int64], members: int) -> bool:
    """Wait until all `members` have come as often as the caller; return False if the gate was opened for good."""
    wanted = (_count(gate, 0) // members + 1) * members
    looks = 0
    while _look(gate, 0) < wanted:
        if _look(gate, 1) != 0:
            return False
        looks += 1
        _pause(looks)
    held: bool = _look(gate, 1) == 0
    return held
