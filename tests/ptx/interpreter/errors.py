"""Errors of kernels, by name. Each message says which instruction and which thread."""

from __future__ import annotations

__all__ = [
    "BadShuffle",
    "Deadlock",
    "DivergentBarrier",
    "KernelError",
    "Misaligned",
    "OutOfBounds",
    "Race",
    "Trap",
    "Uninitialised",
    "UnknownInstruction",
]


class KernelError(Exception):
    """A kernel did what no GPU allows, or what none defines."""


class UnknownInstruction(KernelError):
    """The interpreter lacks an instruction or one of its forms."""


class OutOfBounds(KernelError):
    """A read or write outside its array."""


class Misaligned(KernelError):
    """An address that is no multiple of the size of the access."""


class Race(KernelError):
    """Two accesses to the same bytes, at least one of them a write, that nothing puts in order."""


class Uninitialised(KernelError):
    """A read of memory that nobody has written."""


class BadShuffle(KernelError):
    """A shuffle or vote with a lane that cannot take part: it has returned, or is not in the mask."""


class DivergentBarrier(KernelError):
    """A barrier that some threads of the block cannot reach."""


class Deadlock(KernelError):
    """Lanes that wait for lanes that never come, or a loop without end."""


class Trap(KernelError):
    """The kernel executed ``trap``."""
