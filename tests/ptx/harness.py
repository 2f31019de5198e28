"""Runs a kernel of the project on the CPU: numpy arrays stand for device arrays and are changed in place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ptx.machine import Machine
from ptx.memory import Region
from ptx.parser import parse
from ptx.translate import Translation

__all__ = ["CAPABILITY", "Buffer", "Report", "run", "translation_of"]

CAPABILITY = (8, 7)
"""For which GPU the kernels that are executed are compiled: Orin."""

_TRANSLATIONS: dict[Any, Translation] = {}


class Buffer:
    """A device array whose bytes count as unknown until a kernel writes them.

    Attributes
    ----------
    values : ndarray
        Flat, garbage at first.
    known : (bytes,) uint8
        1 for each byte that was written.
    """

    def __init__(self, size: int, dtype: Any) -> None:
        bytes_ = size * np.dtype(dtype).itemsize
        self.values = np.random.default_rng(bytes_).integers(0, 256, bytes_, np.uint8).view(dtype)
        self.known = np.zeros(bytes_, np.uint8)

    def view(self, dtype: Any) -> Buffer:
        """Return the same memory as another type."""
        other = Buffer.__new__(Buffer)
        other.values, other.known = self.values.view(dtype), self.known
        return other


@dataclass(frozen=True)
class Report:
    """What a launch did."""

    instructions: int  # of threads, counted in whole straight runs
    read: tuple[int, ...]  # bytes of each array argument, as the threads asked for them
    written: tuple[int, ...]


def translation_of(kernel: Any) -> Translation:
    """Return a kernel, compiled and translated once; `kernel` may be PTX text."""
    key = kernel if isinstance(kernel, str) else id(kernel)
    if key not in _TRANSLATIONS:
        text = kernel if isinstance(kernel, str) else kernel.ptx(CAPABILITY)
        made = Translation(parse(text))
        made.kernel = kernel  # keeps the key's object alive
        _TRANSLATIONS[key] = made
    return _TRANSLATIONS[key]


def run(
    kernel: Any, blocks: int, *arguments: Any, seed: int | None = None, block: int | None = None,
    max_runs: int = 1_000_000,
) -> Report:  # fmt: skip
    """Run a kernel.

    Parameters
    ----------
    kernel : stereokit.kernels.cuda.Kernel or str
        The kernel, or PTX text whose parameters are plain pointers and numbers.
    blocks : int
        Blocks of the grid.
    *arguments
        Flat numpy arrays, `Buffer`, and numbers.
    seed : int, optional
        Run threads in a random order; without, all threads go step by step.
    block : int, optional
        Threads of a block; those of the kernel by default.
    max_runs : int, optional
        Straight runs of instructions after which a loop counts as endless.

    Returns
    -------
    Report
        Instructions and bytes.

    Raises
    ------
    KernelError
        One of `ptx.errors`, at the first thing that is wrong.
    """
    made = translation_of(kernel)
    plain = isinstance(kernel, str)
    parameters: list[Any] = []
    regions: list[Region] = []
    places: dict[int, int] = {}
    order: list[Region] = []
    for number, argument in enumerate(arguments):
        if not isinstance(argument, np.ndarray | Buffer):
            parameters.append(argument)
            continue
        values = argument.values if isinstance(argument, Buffer) else argument
        if values.ndim != 1 or not values.flags.c_contiguous:
            raise ValueError(f"argument {number} must be a flat array, got shape {values.shape}")
        start = values.__array_interface__["data"][0]
        if start not in places:
            places[start] = len(regions)
            known = argument.known if isinstance(argument, Buffer) else None
            regions.append(Region(f"argument {number}", values.view(np.uint8), known))
        at = places[start]
        if regions[at].values.size != values.nbytes:
            raise ValueError(f"argument {number} overlaps an earlier one of another size")
        order.append(regions[at])
        address = Machine.address(at)
        if plain:
            parameters.append(address)
        else:
            parameters += [0, 0, values.size, values.itemsize, address, values.size, values.itemsize]
    _check(kernel, arguments)
    machine = Machine(made, blocks, block or kernel.block, parameters, regions, seed, max_runs)
    machine.run()
    return Report(machine.instructions, tuple(r.read for r in order), tuple(r.written for r in order))


def _check(kernel: Any, arguments: tuple[Any, ...]) -> None:
    """Raise TypeError where arguments are not of the kernel's signature, as numba would."""
    if isinstance(kernel, str):
        return
    if len(arguments) != len(kernel.signature):
        raise TypeError(f"{kernel.name} takes {len(kernel.signature)} arguments, got {len(arguments)}")
    for number, (kind, argument) in enumerate(zip(kernel.signature, arguments, strict=True)):
        values = argument.values if isinstance(argument, Buffer) else argument
        if hasattr(kind, "dtype") != isinstance(values, np.ndarray):
            raise TypeError(f"argument {number} of {kernel.name} must be {kind}, got {type(argument).__name__}")
        if hasattr(kind, "dtype") and values.dtype != np.dtype(str(kind.dtype)):
            raise TypeError(f"argument {number} of {kernel.name} must be {kind}, got {values.dtype}")
