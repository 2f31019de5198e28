"""Runs a kernel of the project on the CPU: numpy arrays stand for device arrays and are changed in place."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ptx.interpreter.machine import Machine
from ptx.interpreter.memory import Region
from ptx.interpreter.parser import parse
from ptx.interpreter.translate import Translation

__all__ = ["CAPABILITY", "Buffer", "Report", "forget", "run", "translation_of"]

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

    @classmethod
    def _of(cls, values: np.ndarray, known: np.ndarray) -> Buffer:
        buffer = cls.__new__(cls)
        buffer.values, buffer.known = values, known
        return buffer

    def view(self, dtype: Any) -> Buffer:
        """Return the same memory as another type."""
        return self._of(self.values.view(dtype), self.known)

    def __getitem__(self, part: slice) -> Buffer:
        """Return a run of the elements, the same memory."""
        first, last, step = part.indices(self.values.size)
        if step != 1:
            raise ValueError(f"want a slice without step, got {part}")
        width = self.values.itemsize
        return self._of(self.values[first:last], self.known[first * width : last * width])

    @property
    def size(self) -> int:
        """Elements."""
        return self.values.size

    @property
    def dtype(self) -> np.dtype:
        """Type of the elements."""
        return self.values.dtype


@dataclass(frozen=True)
class Report:
    """Counts of a launch."""

    instructions: int  # of threads, counted in whole straight runs
    issued: int  # the same of warps
    read: tuple[int, ...]  # bytes of each array argument, as the threads asked for them
    written: tuple[int, ...]


def translation_of(kernel: Any) -> Translation:
    """Return a kernel, compiled and translated once; `kernel` may be PTX text."""
    key = kernel if isinstance(kernel, str) else id(kernel)
    if key not in _TRANSLATIONS:
        text = kernel if isinstance(kernel, str) else kernel.ptx(CAPABILITY)
        translation = Translation(parse(text))
        translation.kernel = kernel  # keeps the key's object alive
        _TRANSLATIONS[key] = translation
    return _TRANSLATIONS[key]


def forget(kernel: Any) -> None:
    """Drop what was translated of a kernel."""
    _TRANSLATIONS.pop(id(kernel), None)


def run(
    kernel: Any, blocks: int, *arguments: Any, seed: int | None = None, block: int | None = None,
    max_runs: int = 1_000_000,
) -> Report:  # fmt: skip
    """Run a kernel.

    Parameters
    ----------
    kernel : stereokit.cuda.kernel.Kernel or str
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
        One of `ptx.interpreter.errors`, at the first thing that is wrong.
    """
    translation = translation_of(kernel)
    plain = isinstance(kernel, str)
    _check(kernel, arguments)
    regions, places = _regions(arguments)
    parameters: list[Any] = []
    for number, argument in enumerate(arguments):
        if number not in places:
            parameters.append(argument)
            continue
        values = argument.values if isinstance(argument, Buffer) else argument
        at, offset = places[number]
        address = Machine.address(at) + offset
        if plain:
            parameters.append(address)
        else:
            parameters += [0, 0, values.size, values.itemsize, address, values.size, values.itemsize]
    machine = Machine(translation, blocks, block or kernel.block, parameters, regions, seed, max_runs)
    machine.run()
    order = [regions[places[number][0]] for number in sorted(places)]
    return Report(machine.instructions, machine.issued, tuple(r.read for r in order), tuple(r.written for r in order))


def _root(values: np.ndarray) -> np.ndarray:
    while isinstance(values.base, np.ndarray):
        values = values.base
    return values


def _regions(arguments: tuple[Any, ...]) -> tuple[list[Region], dict[int, tuple[int, int]]]:
    """Return the memory of all array arguments, and for each of these its region and its first byte in there.

    An array is a region of its own, so that no access may leave it, unless another argument overlaps it.
    """
    spans: dict[int, list[tuple[int, int, int]]] = {}
    roots: dict[int, tuple[np.ndarray, Any]] = {}
    for number, argument in enumerate(arguments):
        if not isinstance(argument, np.ndarray | Buffer):
            continue
        values = argument.values if isinstance(argument, Buffer) else argument
        if values.ndim != 1 or not values.flags.c_contiguous:
            raise ValueError(f"argument {number} must be a flat array, got shape {values.shape}")
        root = _root(values)
        start = values.__array_interface__["data"][0] - root.__array_interface__["data"][0]
        spans.setdefault(id(root), []).append((start, start + values.nbytes, number))
        known = argument.known if isinstance(argument, Buffer) else None
        roots[id(root)] = root, None if known is None else _root(known)
    regions: list[Region] = []
    places: dict[int, tuple[int, int]] = {}
    for key, members in spans.items():
        root, known = roots[key]
        root = root.reshape(-1).view(np.uint8)
        distinct = sorted({(first, last) for first, last, _ in members})
        overlap = any(b[0] < a[1] for a, b in itertools.pairwise(distinct))
        for first, last in [(0, root.size)] if overlap else distinct:
            inside = [member for member in members if first <= member[0] < max(last, first + 1) and member[1] <= last]
            name = " and ".join(f"argument {number}" for _, _, number in inside)
            for start, _, number in inside:
                places[number] = len(regions), start - first
            regions.append(Region(name, root[first:last], None if known is None else known[first:last]))
    return regions, places


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
