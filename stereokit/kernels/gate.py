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
from numba.extending import intrinsic
from numpy.typing import NDArray

from stereokit.kernels.jit import kernel

__all__ = ["meet", "new_gate", "open_for_good"]

_PATIENCE = 256
"""Looks at the gate before the processor is offered to others, each some tens of nanoseconds."""


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
def _pause(typing: Any, others: Any) -> Any:
    """Wait a moment; if `others`, let another thread have the processor, where the system has a call for that."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if os.name == "posix":
            with builder.if_then(args[0], likely=False):
                function = ir.FunctionType(ir.IntType(32), [])
                builder.call(_declare(builder.module, function, "sched_yield"), [])
        if binding.get_process_triple().startswith("x86_64"):
            function = ir.FunctionType(ir.VoidType(), [])
            builder.call(_declare(builder.module, function, "llvm.x86.sse2.pause"), [])
        return context.get_dummy_value()

    return types.void(types.boolean), generate


def _declare(module: Any, function: Any, name: str) -> Any:
    return module.globals.get(name) or ir.Function(module, function, name)


@kernel
def meet(gate: NDArray[np.int64], members: int) -> bool:
    """Wait until all `members` have come as often as the caller; return False if the gate was opened for good."""
    wanted = (_count(gate, 0) // members + 1) * members
    looks = 0
    while _look(gate, 0) < wanted:
        if _look(gate, 1) != 0:
            return False
        looks += 1
        _pause(looks > _PATIENCE)
    return _look(gate, 1) == 0
