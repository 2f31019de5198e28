"""Memory of the interpreted GPU: bounds, alignment, what was ever written, and who touched what in which order.

Two accesses of the same bytes, one of them a write, are a race unless something orders them: the same thread, a
barrier of the block between them, or ``bar.warp.sync`` for two lanes of a warp. Nothing orders two blocks. Atomics and
volatile accesses do not race with one another, but do with plain ones. A shuffle orders nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ptx.interpreter.errors import Misaligned, OutOfBounds, Race, Uninitialised

__all__ = ["BASE", "MIDDLE", "SLOT", "Region", "Threads"]

BASE, SLOT = 1 << 44, 40
MIDDLE = 1 << (SLOT - 1)
"""Array k begins at ``BASE + (k << SLOT) + MIDDLE``, so that no slip of an index leads from one into another."""

_MANY = -2
_LOG_LIMIT = 1 << 24


class Threads:
    """Who is who: block and warp of each thread of the grid, and how many barriers each has passed."""

    def __init__(self, blocks: int, block: int) -> None:
        number = np.arange(blocks * block, dtype=np.int32)
        self.block_of = number // block
        self.in_block = number % block
        warps = -(-block // 32)
        self.warp_of = self.block_of * warps + self.in_block // 32
        self.lane_of = self.in_block % 32
        self.barriers = np.zeros(blocks, np.int32)
        self.warp_syncs = np.zeros(blocks * warps, np.int32)
        self.block = block

    def name(self, thread: int) -> str:
        """Return a thread in words."""
        if thread < 0:
            return "several threads"
        return f"thread {self.in_block[thread]} of block {self.block_of[thread]}"


class _Trace:
    """The last accesses of one kind to each unit of a region: thread, warp, block, or `_MANY` of them, and when."""

    def __init__(self, units: int) -> None:
        self.thread, self.warp, self.block, self.syncs, self.barriers = (np.full(units, -1, np.int32) for _ in range(5))

    def refine(self, times: int, units: int) -> None:
        for name in ("thread", "warp", "block", "syncs", "barriers"):
            finer = np.full(units, -1, np.int32)
            repeated = np.repeat(getattr(self, name), times)[:units]
            finer[: repeated.size] = repeated
            setattr(self, name, finer)

    def conflicts(self, unit: Any, thread: Any, warp: Any, block: Any, syncs: Any, barriers: Any) -> Any:
        """Return the accesses that collide with earlier ones of other threads."""
        theirs = self.block[unit]
        touched = theirs != -1
        if not touched.any():
            return touched
        other_block = touched & (theirs != block)
        same = ~other_block & touched & (self.barriers[unit] == barriers)
        other_warp = same & (self.warp[unit] != warp)
        other_lane = same & ~other_warp & (self.thread[unit] != thread) & (self.syncs[unit] == syncs)
        return other_block | other_warp | other_lane

    def add(self, unit: Any, thread: Any, warp: Any, block: Any, syncs: Any, barriers: Any) -> Any:
        """Record accesses; return which units several threads touched just now."""
        their_block = self.block[unit]
        now_block = np.where((their_block == -1) | (their_block == block), block, _MANY)
        fresh = (their_block != block) | (self.barriers[unit] != barriers)
        their_warp = self.warp[unit]
        now_warp = np.where(fresh | (their_warp == warp), warp, _MANY)
        their_thread = self.thread[unit]
        alone = fresh | (self.syncs[unit] != syncs) | (their_thread == thread)
        now_thread = np.where(alone, thread, _MANY)
        self.barriers[unit], self.syncs[unit] = barriers, syncs
        self.thread[unit] = thread
        twice = self.thread[unit] != thread
        for owner, now in ((self.thread, now_thread), (self.warp, now_warp), (self.block, now_block)):
            owner[unit] = now
            owner[unit[owner[unit] != now]] = _MANY
        return twice


class Region:
    """A piece of memory: one array, or the shared or local memories of all blocks or threads one after another."""

    def __init__(self, name: str, values: Any, known: Any = None, owners: int = 1, traced: bool = True) -> None:
        self.name = name
        self.values = values  # bytes
        self.known = known  # 1 for each byte that was written, or None where all are
        self.size = values.size // owners  # bytes of an owner
        self.traced = traced
        self.read = self.written = 0  # bytes
        self._views: dict[tuple[str, int], Any] = {}
        self._grain = 0
        self._traces: dict[str, _Trace] = {}
        self._log: list[tuple[Any, ...]] = []
        self._logged = 0

    def view(self, kind: str, count: int, of_known: bool = False) -> Any:
        """Return the bytes as elements, or as rows of `count` elements."""
        key = kind + "k" * of_known, count
        if key not in self._views:
            data = self.known if of_known else self.values
            size = np.dtype(kind).itemsize * count
            whole = data[: data.size // size * size].view(kind)
            self._views[key] = whole if count == 1 else whole.reshape(-1, count)
        return self._views[key]

    def place(self, offset: Any, size: int, owner: Any, tell: Callable[[int], str]) -> Any:
        """Check byte offsets, signed, of accesses of `size` bytes and return the indices of elements of that size."""
        if offset.size and (int(offset.min()) < 0 or int(offset.max()) + size > self.size):
            first = int(np.flatnonzero((offset < 0) | (offset + size > self.size))[0])
            raise OutOfBounds(f"byte {int(offset[first])} of the {self.size} of {self.name}: {tell(first)}")
        if owner is not None:
            offset = offset + owner.astype(np.int64) * self.size
        if int(np.bitwise_or.reduce(offset)) & (size - 1) if offset.size else False:
            first = int(np.flatnonzero(offset & (size - 1))[0])
            raise Misaligned(f"byte {int(offset[first])} of {self.name} for {size} bytes: {tell(first)}")
        return offset // size

    def check_known(self, index: Any, size: int, tell: Callable[[int], str]) -> None:
        """Raise unless all these elements were written."""
        if self.known is None:
            return
        wide = min(size, 8)
        seen = self.view(f"u{wide}", size // wide, True)[index] == int.from_bytes(b"\1" * wide, "little")
        if not seen.all():
            first = int(np.flatnonzero(~(seen if size == wide else seen.all(axis=1)))[0])
            raise Uninitialised(f"byte {int(index[first]) * size} of {self.name} was never written: {tell(first)}")

    def _units(self, index: Any, size: int, who: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
        if not self._grain:
            self._grain = size
        if size < self._grain:
            self._fold()
            for trace in self._traces.values():
                trace.refine(self._grain // size, -(-self.values.size // size))
            self._grain = size
        times = size // self._grain
        if times == 1:
            return index, who
        unit = (index[:, None] * times + np.arange(times)).reshape(-1)
        return unit, tuple(np.repeat(part, times) for part in who)

    def _trace(self, kind: str) -> _Trace:
        if kind not in self._traces:
            self._traces[kind] = _Trace(-(-self.values.size // self._grain))
        return self._traces[kind]

    def _fold(self) -> None:
        """Record the reads that were put off until somebody writes."""
        log, self._log, self._logged = self._log, [], 0
        for unit, who in log:
            self._trace("read").add(unit, *who)

    def touch(
        self, index: Any, size: int, kind: str, threads: Threads, thread: Any, tell: Callable[[int], str]
    ) -> None:
        """Raise if accesses race with earlier ones; `kind` is "read", "write", "strong read" or "strong write"."""
        block, warp = threads.block_of[thread], threads.warp_of[thread]
        who = thread, warp, block, threads.warp_syncs[warp], threads.barriers[block]
        unit, who = self._units(index, size, who)
        against = {
            "read": ("write", "strong write"),
            "write": ("read", "write", "strong read", "strong write"),
            "strong read": ("write",),
            "strong write": ("read", "write"),
        }[kind]
        if "read" in against and self._log:
            self._fold()
        for other in against:
            if other in self._traces:
                bad = self._traces[other].conflicts(unit, *who)
                if bad.any():
                    first = int(np.flatnonzero(bad)[0])
                    them = threads.name(int(self._traces[other].thread[unit[first]]))
                    where = f"byte {int(unit[first]) * self._grain} of {self.name}"
                    raise Race(f"{kind} after {other} by {them}, {where}: {tell(first * index.size // unit.size)}")
        if kind == "read":
            self._log.append((unit, who))
            self._logged += unit.size
            if self._logged > _LOG_LIMIT:
                self._fold()
            return
        twice = self._trace(kind).add(unit, *who)
        if kind == "write" and twice.any():
            first = int(np.flatnonzero(twice)[0])
            where = f"byte {int(unit[first]) * self._grain} of {self.name}"
            raise Race(f"two threads write at once, {where}: {tell(first * index.size // unit.size)}")
