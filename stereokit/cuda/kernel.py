"""The one home of numba.cuda: compiler flags, the list of all CUDA kernels, and how they are launched.

Nothing else imports numba.cuda, and nothing imports this module before a GPU is asked for: ``*_cuda`` modules hold
the kernels, next to the CPU stage that each is the twin of, and `stereokit.cuda.pipeline` imports them late.
``numba.cuda`` is NVIDIA's numba-cuda; the one that comes with numba is deprecated and not used.

A kernel is a plain Python function with the types of its arguments::

    @kernel(array(u8), array(u32), i32, block=128)
    def census_bits(image, out, count):
        at = u32(cuda.grid(1))
        ...

The decorator returns a `Kernel`, files it in `KERNELS` and compiles nothing: `Kernel.ptx` compiles without a driver,
`Queue.launch` runs it. A family of kernels is a cached function that makes one (window or levels as a constant) with
``name="zncc_costs_5"``; the module makes the common ones at import, so that `KERNELS` has them all. Helpers are
compiled with `device`; functions of the CPU compiled with `stereokit.kernels.jit.inline` can be called as they are.

Rules that the kernels follow, because each was a trap once:

- arrays are flat and indexed by ``u32`` or ``u64``, which spares the check for negative indices; ``int32 + int32``
  is int64 in numba, so results are cast back;
- shuffles move 32 bits (`shuffle_*`) with all lanes of the warp alive: a line or pixel too many is clamped and its
  stores are predicated;
- there is no fastmath, division and square root are IEEE's, and no kernel has a float64. A product and a sum are
  contracted to one FMA; where that would differ from the CPU, ``cuda.libdevice.fmul_rn`` and ``fadd_rn`` forbid it;
- the sides of a local array and all loops over it are constants, so that it lives in registers.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
from llvmlite import ir
from numba import cuda, types
from numba.core import cgutils
from numba.cuda import dispatcher as _dispatcher
from numba.extending import intrinsic

__all__ = [
    "FULL",
    "KERNELS",
    "Kernel",
    "Queue",
    "array",
    "blocks_for",
    "cuda",
    "device",
    "f32",
    "i16",
    "i32",
    "kernel",
    "load2",
    "load4",
    "load_relaxed",
    "shuffle_down",
    "shuffle_from",
    "shuffle_up",
    "shuffle_xor",
    "store2",
    "store4",
    "u8",
    "u16",
    "u32",
    "u64",
]

u8, u16, u32, u64 = types.uint8, types.uint16, types.uint32, types.uint64
i16, i32, f32 = types.int16, types.int32, types.float32

FULL = np.uint32(0xFFFFFFFF)
"""All lanes of a warp."""


def array(dtype: Any) -> Any:
    """Return the type of a flat array of `dtype`."""
    return types.Array(dtype, 1, "C")


class Kernel:
    """A kernel that can be compiled for any GPU, with or without one at hand.

    Attributes
    ----------
    name : str
        Its key in `KERNELS`.
    function : callable
        The Python function.
    signature : tuple of numba types
        Types of its arguments.
    block : int
        Threads of a block, always the same: the kernel's arithmetic relies on it.
    """

    def __init__(self, name: str, function: Callable[..., None], signature: tuple[Any, ...], block: int) -> None:
        self.name = name
        self.function = function
        self.signature = signature
        self.block = block
        self._compiled: Any = None

    def ptx(self, capability: tuple[int, int] = (8, 7)) -> str:
        """Return the PTX of the kernel; needs no driver.

        numba compiles helpers for the GPU that is present, even within a kernel for another one, unless it is set here.
        """
        asked = _dispatcher.get_current_device
        _dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=capability)
        try:
            text: str = cuda.compile_ptx(self.function, self.signature, cc=capability, fastmath=False)[0]
        finally:
            _dispatcher.get_current_device = asked
        return text

    @property
    def compiled(self) -> Any:
        """The kernel compiled for the present GPU: ``compiled[blocks, threads, stream](...)`` launches it."""
        if self._compiled is None:
            # Without link-time optimisation, so that what runs is the PTX that `ptx` returns.
            self._compiled = cuda.jit(types.void(*self.signature), fastmath=False, lto=False)(self.function)
        return self._compiled

    def __repr__(self) -> str:
        return f"Kernel({self.name})"


KERNELS: dict[str, Kernel] = {}
"""All kernels of the modules that have been imported, by name."""


def kernel(*signature: Any, block: int = 128, name: str | None = None) -> Callable[[Callable[..., None]], Kernel]:
    """Return a decorator that makes a function of arguments of these types a kernel."""

    def register(function: Callable[..., None]) -> Kernel:
        key = name or function.__name__
        if key in KERNELS:
            raise ValueError(f"two kernels are called {key!r}")
        KERNELS[key] = Kernel(key, function, signature, block)
        return KERNELS[key]

    return register


def device(function: Callable[..., Any]) -> Any:
    """Compile `function` as a helper that is always inlined into the kernels that call it."""
    return cuda.jit(device=True, forceinline=True)(function)


def blocks_for(threads: int, block: int) -> int:
    """Return the number of blocks for at least so many threads."""
    return -(-threads // block)


class Queue(Protocol):
    """A stream of a GPU with the buffers that stay there, or a stand-in for tests.

    Launches are in order and nobody waits for them; only `fetch` does.
    """

    def array(self, name: str, size: int, dtype: Any) -> Any:
        """Return the resident flat array called `name`; its content is whatever it was."""

    def upload(self, name: str, values: np.ndarray[Any, Any]) -> Any:
        """Return the resident flat array called `name` with a copy of `values` in it."""

    def cached(self, name: str, key: Any, make: Callable[[], np.ndarray[Any, Any]]) -> Any:
        """Return the resident copy of a table, uploaded when `key` is not that of the last call."""

    def view(self, array: Any, dtype: Any) -> Any:
        """Return the same memory as an array of another type."""

    def launch(self, what: Kernel, blocks: int, *arguments: Any) -> None:
        """Run a kernel with so many blocks; scalars are converted to its signature."""

    def copy(self, array: Any) -> Any:
        """Return a new array on the device with the same content."""

    def fetch(self, array: Any) -> np.ndarray[Any, Any]:
        """Wait for all launches and return a copy of an array."""


@device
def shuffle_up(value, lanes):  # type: ignore[no-untyped-def]
    """Return the value of the lane that is `lanes` below, or the own value where there is none."""
    return cuda.shfl_up_sync(FULL, value, lanes)


@device
def shuffle_down(value, lanes):  # type: ignore[no-untyped-def]
    """Return the value of the lane that is `lanes` above, or the own value where there is none."""
    return cuda.shfl_down_sync(FULL, value, lanes)


@device
def shuffle_xor(value, mask):  # type: ignore[no-untyped-def]
    """Return the value of the lane whose number differs in the bits of `mask`."""
    return cuda.shfl_xor_sync(FULL, value, mask)


@device
def shuffle_from(value, lane):  # type: ignore[no-untyped-def]
    """Return the value of one lane."""
    return cuda.shfl_sync(FULL, value, lane)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any, lanes: int) -> Any:
    content = context.make_array(kind)(context, builder, array)
    element = builder.gep(content.data, [index])
    scalar = context.get_value_type(kind.dtype)
    return builder.bitcast(element, ir.VectorType(scalar, lanes).as_pointer()), ir.VectorType(scalar, lanes)


def _loader(lanes: int) -> Any:
    @intrinsic
    def load(typingctx, array, index):  # type: ignore[no-untyped-def]
        width = array.dtype.bitwidth // 8 * lanes

        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            pointer, _ = _pointer(context, builder, signature.args[0], arguments[0], arguments[1], lanes)
            vector = builder.load(pointer, align=width)
            parts = [builder.extract_element(vector, ir.Constant(ir.IntType(32), k)) for k in range(lanes)]
            return cgutils.pack_array(builder, parts)

        return types.UniTuple(array.dtype, lanes)(array, types.uint64), generate

    return load


def _storer(lanes: int) -> Any:
    @intrinsic
    def store(typingctx, array, index, values):  # type: ignore[no-untyped-def]
        width = array.dtype.bitwidth // 8 * lanes

        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            pointer, vector_type = _pointer(context, builder, signature.args[0], arguments[0], arguments[1], lanes)
            vector = ir.Constant(vector_type, ir.Undefined)
            for k in range(lanes):
                part = builder.extract_value(arguments[2], k)
                vector = builder.insert_element(vector, part, ir.Constant(ir.IntType(32), k))
            builder.store(vector, pointer, align=width)
            return context.get_dummy_value()

        return types.void(array, types.uint64, types.UniTuple(array.dtype, lanes)), generate

    return store


load2, load4 = _loader(2), _loader(4)
"""``load4(array, index)``: a tuple of 4 elements from `index` on, which is a multiple of 4, in one instruction."""

store2, store4 = _storer(2), _storer(4)
"""``store4(array, index, (a, b, c, d))``: write 4 elements from `index` on, a multiple of 4, in one instruction."""


@intrinsic
def load_relaxed(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Return an element of a uint32 array that other threads change by atomics meanwhile; never from a stale cache."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        content = context.make_array(signature.args[0])(context, builder, arguments[0])
        address = builder.ptrtoint(builder.gep(content.data, [arguments[1]]), ir.IntType(64))
        kind = ir.FunctionType(ir.IntType(32), [ir.IntType(64)])
        return builder.asm(kind, "ld.relaxed.gpu.global.u32 $0, [$1];", "=r,l,~{memory}", [address], True)

    return types.uint32(array, types.uint64), generate
