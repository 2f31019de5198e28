"""Blocks of `LANES` lanes as several vectors of `PART` lanes each, for kernels that need many registers."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic

from stereokit.kernels.jit import by_types
from stereokit.kernels.simd.types import LANES, PART, Vector, splat_ir

__all__ = ["each_part", "splat_parts"]


@intrinsic
def splat_parts(typing: Any, scalar: Any) -> Any:
    """Return the parts of a block, a tuple, whose lanes are all `scalar`, of the scalar's own type."""
    kind = Vector(scalar, PART)
    result = types.UniTuple(kind, LANES // PART)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_tuple(builder, result, [splat_ir(builder, args[0], kind)] * (LANES // PART))

    return result(scalar), generate


@by_types
def each_part(step: Any, parts: Any, lane: Any, context: Any) -> Any:
    """Return what `step` makes of each part: ``step(part, lane, context)``, `lane` counted on from part to part.

    One part is done with before the next begins, so that they need not all have registers at once. Compiled code only.
    """
    if len(parts) == 1:
        return lambda step, parts, lane, context: (step(parts[0], lane, context),)
    return lambda step, parts, lane, context: (
        (step(parts[0], lane, context),) + each_part(step, parts[1:], lane + PART, context)  # noqa: RUF005 (numba)
    )
