"""The vector type, lanes of one scalar type in one LLVM value, and the pieces of code that all rooms emit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import models, register_model

__all__ = [
    "I32",
    "LANES",
    "PAIRED",
    "PART",
    "Vector",
    "call_ir",
    "lanes_ir",
    "on_arm",
    "on_x86",
    "splat_ir",
    "vector_bits",
]

LANES = 64
"""Disparity levels of one vector value."""


def on_x86() -> bool:
    """Return whether code is made for 64-bit x86."""
    return bool(binding.get_process_triple().startswith("x86_64"))


def on_arm() -> bool:
    """Return whether code is made for 64-bit ARM."""
    return bool(binding.get_process_triple().startswith(("aarch64", "arm64")))


PART = 16 if on_arm() else LANES
"""Lanes of 32 bits that a kernel works on at a time where it needs many vectors at once: 64 take half of ARM's
registers."""

PAIRED = on_x86()
"""Whether the two ``int16`` of a pair lie side by side, for an instruction that multiplies pairs; or apart."""

I32 = ir.IntType(32)
"""LLVM's type of the indices of lanes."""


class Vector(types.Type):  # type: ignore[misc]
    """The numba type of `lanes` values of one scalar type."""

    def __init__(self, scalar: Any, lanes: int = LANES) -> None:
        self.scalar = scalar
        self.lanes = lanes
        super().__init__(name=f"Vector({lanes} x {scalar})")

    @property
    def is_float(self) -> bool:
        """Whether the lanes are floating point."""
        return isinstance(self.scalar, types.Float)

    @property
    def llvm(self) -> ir.VectorType:
        """The LLVM type."""
        return ir.VectorType(self.element, self.lanes)

    @property
    def element(self) -> ir.Type:
        """The LLVM type of one lane."""
        return ir.FloatType() if self.is_float else ir.IntType(self.scalar.bitwidth)

    @property
    def suffix(self) -> str:
        """The type's name in those of LLVM's intrinsics."""
        return f"v{self.lanes}{'f32' if self.is_float else f'i{self.scalar.bitwidth}'}"


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


def splat_ir(builder: Any, scalar: Any, kind: Vector) -> Any:
    """Emit a vector of one scalar."""
    empty = ir.Constant(kind.llvm, ir.Undefined)
    first = builder.insert_element(empty, scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, empty, ir.Constant(ir.VectorType(I32, kind.lanes), [0] * kind.lanes))


def lanes_ir(builder: Any, x: Any, y: Any, lanes: Sequence[int]) -> Any:
    """Emit a vector of some lanes of `x` and, counted on from its last, of `y`."""
    return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(I32, len(lanes)), list(lanes)))


def call_ir(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    """Emit a call of the LLVM function `name`."""
    signature = ir.FunctionType(result, [a.type for a in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, name), args)
