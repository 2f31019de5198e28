"""Executes a kernel on a grid of threads, on the CPU.

Every thread has its own place in the program, as GPUs since Volta allow. Without a seed the threads that are furthest
behind go first, all together, so that they meet again after a branch; the whole grid runs as one and is fast. With a
seed, threads, warps or lanes are picked at random, which finds what depends on the order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ptx.interpreter.errors import (
    BadShuffle,
    Deadlock,
    DivergentBarrier,
    KernelError,
    OutOfBounds,
    Trap,
    UnknownInstruction,
)
from ptx.interpreter.memory import BASE, MIDDLE, SLOT, Region, Threads
from ptx.interpreter.parser import KINDS, LOCAL, SHARED
from ptx.interpreter.translate import EXIT, Translation, is_barrier, is_warp_operation, shuffle_table

__all__ = ["Machine"]

_RUNS, _AT_BARRIER, _IN_WARP, _DONE = range(4)
_FULL = np.uint32(0xFFFFFFFF)


class Machine:
    """One launch of a kernel.

    Parameters
    ----------
    translation : Translation
        The kernel.
    blocks, block : int
        Blocks of the grid and threads of a block; both along x.
    parameters : list
        Value of each parameter of the kernel.
    regions : list of Region
        The global arrays; array k has the address ``address(k)``.
    seed : int or None
        Of the random schedule.
    max_runs : int
        Straight runs of instructions after which a loop counts as endless.
    """

    def __init__(
        self, translation: Translation, blocks: int, block: int, parameters: list[Any], regions: list[Region],
        seed: int | None = None, max_runs: int = 1_000_000,
    ) -> None:  # fmt: skip
        program = translation.program
        self.translation = translation
        self.blocks, self.block, self.count = blocks, block, blocks * block
        self.threads = Threads(blocks, block)
        self.regions = list(regions)
        self.rng = None if seed is None else np.random.default_rng(seed)
        self.max_runs = max_runs
        self.values = {name: (kind, value) for (kind, name), value in zip(program.parameters, parameters, strict=True)}
        self.constants = {}
        for name, values in program.constants.items():
            self.constants[name] = self.address(len(self.regions))
            self.regions.append(Region(f"constant {name}", values.view(np.uint8), traced=False))
        garbage = np.random.default_rng(self.count)
        self.shared = self._own("shared memory", program.shared, blocks, garbage, True)
        self.local = self._own("local memory", program.local, self.count, garbage, False)
        self.everyone = np.arange(self.count, dtype=np.int32)
        self.registers = {name: np.zeros(self.count, kind) for name, kind in program.registers.items()}
        self.instructions = 0  # of threads
        self.issued = 0  # of warps, whose lanes part where they branch

    @staticmethod
    def _own(name: str, size: int, owners: int, garbage: Any, traced: bool) -> Region:
        size = -(-size // 16) * 16
        values = garbage.integers(0, 256, size * owners, np.uint8)
        return Region(name, values, np.zeros(size * owners, np.uint8), owners, traced)

    @staticmethod
    def address(number: int) -> int:
        """Return the first address of array `number`."""
        return BASE + (number << SLOT) + MIDDLE

    # ------------------------------------------------------------------ the schedule
    def run(self) -> None:
        """Execute the kernel to its end."""
        with np.errstate(all="ignore"):
            self._run()

    def _run(self) -> None:
        code = self.translation.program.code
        self.at = np.zeros(self.count, np.int32)
        self.state = np.zeros(self.count, np.int8)
        together: int | None = 0  # where all threads are, while they are at one place
        for _ in range(self.max_runs):
            if together is not None:
                place, lanes = together, None
            else:
                picked = self._pick()
                if picked is None:
                    if (self.state == _DONE).all():
                        return
                    self._stuck()
                place, lanes = picked
            if lanes is not None and lanes.size == self.count:
                lanes = None
            together = None
            if place == len(code):
                self._settle(lanes, EXIT)
                continue
            one = code[place]
            if is_barrier(one):
                self._barrier(place, lanes)
                continue
            entry_whole = False
            if is_warp_operation(one):
                lanes = self._gather(place, lanes)
                if lanes is not None and lanes.size == 0:
                    continue
                entry_whole = True
            function, meets, length = self.translation.function(place)
            number = self.count if lanes is None else lanes.size
            self.instructions += length * number
            self.issued += length * self._warps(lanes)
            if meets:
                out = function(self, self.registers, lanes, number, entry_whole or self._whole(lanes))
            else:
                out = function(self, self.registers, lanes, number)
            if isinstance(out, tuple):
                mask, yes, no = out
                if mask.all():
                    out = yes
                elif not mask.any():
                    out = no
                else:
                    self._settle(lanes, np.where(mask, np.int32(yes), np.int32(no)))
                    continue
            if lanes is None and out != EXIT and self.rng is None:
                together = out
                self.at[:] = out
            else:
                self._settle(lanes, out)
        raise Deadlock(f"no end after {self.max_runs} runs of instructions")

    def _settle(self, lanes: Any, places: Any) -> None:
        lanes = self.everyone if lanes is None else lanes
        self.at[lanes] = places
        gone = lanes[self.at[lanes] == EXIT]
        self.state[gone] = _DONE

    def _pick(self) -> tuple[int, Any] | None:
        ready = np.flatnonzero(self.state == _RUNS)
        if not ready.size:
            return None
        places = self.at[ready]
        chance = 0.0 if self.rng is None else self.rng.random()
        if self.rng is None or chance < 0.4:
            place = int(places.min())
            return place, ready[places == place]
        place = int(places[self.rng.integers(ready.size)])
        ready = ready[places == place]
        if chance < 0.8:  # some warps
            awake = self.rng.random(self.threads.warp_syncs.size)[self.threads.warp_of[ready]] < 0.5
        else:  # some lanes
            awake = self.rng.random(ready.size) < 0.5
        return place, ready[awake] if awake.any() else ready[:1]

    def _stuck(self) -> None:
        waiting = np.flatnonzero(self.state == _IN_WARP)
        if waiting.size:
            first = int(waiting[0])
            same_warp = self.threads.warp_of == self.threads.warp_of[first]
            if (self.state[same_warp] == _DONE).any():
                raise BadShuffle(f"{self._text(first)} names lanes that have returned: {self.threads.name(first)}")
            raise Deadlock(f"lanes of its warp never come to {self._text(first)}: {self.threads.name(first)}")
        first = int(np.flatnonzero(self.state == _AT_BARRIER)[0])
        same = self.threads.block_of == self.threads.block_of[first]
        places = sorted({self.translation.program.code[p].text for p in self.at[same & (self.state == _AT_BARRIER)]})
        gone = int((self.state[same] == _DONE).sum())
        raise DivergentBarrier(
            f"threads of block {self.threads.block_of[first]} wait at {len(set(self.at[same & (self.state == 1)]))} "
            f"barriers ({places[0]}), {gone} have returned"
        )

    def _text(self, thread: int) -> str:
        return f"`{self.translation.program.code[self.at[thread]].text}`"

    def _barrier(self, place: int, lanes: Any) -> None:
        one = self.translation.program.code[place]
        if one.guard or len(one.operands) > 1 or one.op[1] not in ("sync", "cta") or "red" in one.op:
            raise UnknownInstruction(one.text)
        lanes = self.everyone if lanes is None else lanes
        self.at[lanes] = place
        self.state[lanes] = _AT_BARRIER
        here = (self.state == _AT_BARRIER) & (self.at == place)
        arrived = np.bincount(self.threads.block_of[here], minlength=self.blocks)
        complete = np.flatnonzero(arrived == self.block)
        if complete.size:
            free = here & (arrived == self.block)[self.threads.block_of]
            self.state[free] = _RUNS
            self.at[free] = place + 1
            self.threads.barriers[complete] += 1
            self.threads.warp_syncs[np.unique(self.threads.warp_of[free])] += 1

    # ------------------------------------------------------------------ warps
    def _whole(self, lanes: Any) -> bool:
        """Return whether the lanes make up whole warps."""
        if lanes is None:
            return self.block % 32 == 0
        if lanes.size % 32 or self.block % 32:
            return False
        rows = lanes.reshape(-1, 32)
        return bool(((rows[:, 0] % 32 == 0) & (rows[:, 31] - rows[:, 0] == 31)).all())

    def _warps(self, lanes: Any) -> int:
        """Return the number of warps of the lanes, which are in order."""
        if lanes is None:
            return int(self.threads.warp_syncs.size)
        return 1 + int(np.count_nonzero(np.diff(self.threads.warp_of[lanes])))

    def _mask(self, place: int, lanes: Any) -> Any:
        one = self.translation.program.code[place]
        if one.op[0] == "activemask":
            return np.full(lanes.size, _FULL)
        operand = one.operands[-1]
        if operand.startswith("%"):
            return self.registers[operand[1:]][lanes]
        return np.full(lanes.size, np.uint32(int(operand, 0) & 0xFFFFFFFF))

    def _gather(self, place: int, lanes: Any) -> Any:
        """Return the lanes of warps that are complete here and go on together; let others wait or go by themselves."""
        lanes = self.everyone if lanes is None else lanes
        self.at[lanes] = place
        self.state[lanes] = _IN_WARP
        one = self.translation.program.code[place]
        warps = np.unique(self.threads.warp_of[lanes])
        waiting = np.flatnonzero((self.state == _IN_WARP) & (self.at == place))
        waiting = waiting[np.isin(self.threads.warp_of[waiting], warps)]
        masks = self._mask(place, waiting)
        per_warp = np.bincount(self.threads.warp_of[waiting], minlength=self.threads.warp_syncs.size)
        partial = np.bincount(
            self.threads.warp_of[waiting], weights=(masks != _FULL), minlength=self.threads.warp_syncs.size
        )
        whole = ((per_warp == 32) & (partial == 0))[self.threads.warp_of[waiting]]
        ready = waiting[whole]
        if ready.size:
            self.state[ready] = _RUNS
        rest = waiting[~whole]
        for warp in np.unique(self.threads.warp_of[rest]):
            here = rest[self.threads.warp_of[rest] == warp]
            self._partial(place, one, here, masks[~whole][self.threads.warp_of[rest] == warp])
        return None if ready.size == self.count else ready

    def _partial(self, place: int, one: Any, here: Any, masks: Any) -> None:
        """Let lanes of one warp meet by their masks, once all that a mask names are here."""
        if one.op[0] == "activemask":
            mask = np.bitwise_or.reduce(np.uint32(1) << self.threads.lane_of[here].astype(np.uint32))
            self.registers[one.operands[0][1:]][here] = mask
            self._go_on(here, place)
            return
        warp = np.flatnonzero(self.threads.warp_of == self.threads.warp_of[here[0]])
        lane = self.threads.lane_of[warp]
        for mask in np.unique(masks):
            group = here[masks == mask]
            bits = (int(mask) >> self.threads.lane_of[group].astype(np.int64)) & 1
            if not bits.all():
                raise BadShuffle(f"{self.threads.name(int(group[0]))} is not in its own mask {mask:#010x}: {one.text}")
            named = warp[(int(mask) >> lane.astype(np.int64)) & 1 == 1]
            gone = named[self.state[named] == _DONE]
            if gone.size or (self.block % 32 and int(mask) >> (int(lane.max()) + 1)):
                who = self.threads.name(int(gone[0])) if gone.size else "a lane past the block's end"
                raise BadShuffle(f"mask {mask:#010x} names lanes that are gone ({who}): {one.text}")
            if np.isin(named, group).all():
                self._meet(place, one, named)

    def _go_on(self, lanes: Any, place: int) -> None:
        self.state[lanes] = _RUNS
        self.at[lanes] = place + 1

    def _meet(self, place: int, one: Any, group: Any) -> None:
        """Compute a shuffle, vote or reduction of some lanes of a warp."""
        registers, lane = self.registers, self.threads.lane_of[group]

        def source(operand: str) -> Any:
            if operand.startswith("%"):
                return registers[operand[1:]][group]
            return np.full(group.size, np.uint32(int(operand, 0) & 0xFFFFFFFF))

        if one.op[0] == "shfl":
            to, _, also = one.operands[0].partition("|")
            values = np.zeros(32, np.uint32)
            values[lane] = source(one.operands[1]).view(np.uint32)
            table, valid = shuffle_table(one.op[2], source(one.operands[2]), source(one.operands[3]), lane)
            absent = np.flatnonzero(~np.isin(table, lane))
            if absent.size:
                who = self.threads.name(int(group[absent[0]]))
                raise BadShuffle(f"{who} reads lane {table[absent[0]]}, which is not in the mask: {one.text}")
            target = registers[to[1:]]
            target[group] = values[table].view(target.dtype)
            if also and also.strip() != "_":
                registers[also.strip()[1:]][group] = valid
        elif one.op[0] == "vote":
            votes = source(one.operands[1]).astype(bool)
            if one.op[2] == "ballot":
                result = np.bitwise_or.reduce(votes.astype(np.uint32) << lane.astype(np.uint32))
            else:
                result = {"all": votes.all(), "any": votes.any(), "uni": votes.all() or not votes.any()}[one.op[2]]
            registers[one.operands[0][1:]][group] = result
        elif one.op[0] == "redux":
            target = registers[one.operands[0][1:]]
            values = source(one.operands[1]).view(KINDS[one.op[-1]])
            target[group] = np.full(group.size, _REDUCE[one.op[2]].reduce(values)).view(target.dtype)
        elif one.op[:2] == ("bar", "warp"):
            self.threads.warp_syncs[self.threads.warp_of[group[0]]] += 1
        else:
            raise UnknownInstruction(one.text)
        self._go_on(group, place)

    # ------------------------------------------------------------------ what translated code calls
    def full(self, mask: Any) -> bool:
        """Return whether masks name all lanes."""
        return bool(np.all(mask == _FULL))

    def shuffle(self, mode: str, values: Any, b: Any, c: Any, number: int) -> tuple[Any, Any]:
        """Return shuffled values of whole warps, and whether each came from a lane in reach."""
        lane = np.tile(np.arange(32), number // 32)
        table, valid = shuffle_table(mode, b, c, lane)
        return values[np.arange(number) - lane + table], valid

    def vote(self, how: str, values: Any, number: int) -> Any:
        """Return a vote of whole warps."""
        rows = values.reshape(-1, 32)
        if how == "ballot":
            weights = np.uint32(1) << np.arange(32, dtype=np.uint32)
            return np.repeat((rows * weights).sum(axis=1, dtype=np.uint32), 32)
        yes = rows.all(axis=1), rows.any(axis=1)
        return np.repeat({"all": yes[0], "any": yes[1], "uni": yes[0] | ~yes[1]}[how], 32)

    def reduce(self, how: str, values: Any, number: int) -> Any:
        """Return a reduction of whole warps."""
        return np.repeat(_REDUCE[how].reduce(values.reshape(-1, 32), axis=1).astype(values.dtype), 32)

    def sync_warps(self, lanes: Any) -> None:
        """Order what the lanes of whole warps did before ``bar.warp.sync``."""
        lanes = self.everyone if lanes is None else lanes
        self.threads.warp_syncs[self.threads.warp_of[lanes[::32]]] += 1

    def special(self, name: str, lanes: Any, number: int) -> Any:
        """Return a special register."""
        which, _, axis = name.partition(".")
        if which == "laneid":
            values = self.threads.lane_of
        elif axis != "x":
            return np.full(number, np.uint32(which in ("ntid", "nctaid")))
        elif which in ("ntid", "nctaid"):
            return np.full(number, np.uint32(self.block if which == "ntid" else self.blocks))
        else:
            values = self.threads.in_block if which == "tid" else self.threads.block_of
        return (values if lanes is None else values[lanes]).astype(np.uint32)

    def parameter(self, name: str, kind: str) -> Any:
        """Return a parameter of the kernel."""
        declared, value = self.values[name]
        if declared in ("f32", "f64"):
            return np.array(value, KINDS[declared])[()].view(kind)
        return np.array(int(value) & (2 ** (8 * int(kind[1:])) - 1), f"u{kind[1:]}").view(kind)[()]

    def address_of(self, name: str) -> Any:
        """Return the address of a constant array."""
        return np.uint64(self.constants[name])

    def trap(self, place: int, lanes: Any) -> None:
        """Stop."""
        raise Trap(self.threads.name(int((self.everyone if lanes is None else lanes)[0])))

    def _locate(self, place: int, space: str, address: Any, size: int, thread: Any) -> tuple[Region, Any, Any]:
        """Return the region and the element indices that addresses mean."""

        def tell(position: int) -> str:
            return f"{self.threads.name(int(thread[position]))} at `{self.translation.program.code[place].text}`"

        signed = address.view(np.int64)
        if space == "generic":
            first = int(signed[0])
            space = "global" if first >= BASE else "local" if first >= LOCAL else "shared"
        if space in ("global", "const"):
            slot = (signed - BASE) >> SLOT
            number = int(slot[0])
            stray = slot != number
            if stray.any() or not 0 <= number < len(self.regions):
                which = int(np.flatnonzero(stray)[0]) if stray.any() else 0
                raise OutOfBounds(f"an address in no array, or accesses to two arrays at once: {tell(which)}")
            region, start, owner = self.regions[number], self.address(number), None
        elif space == "shared":
            region, start, owner = self.shared, SHARED, self.threads.block_of[thread]
        else:
            region, start, owner = self.local, LOCAL, thread
        return region, region.place(signed - start, size, owner, tell), tell

    def load(
        self, place: int, space: str, address: Any, kind: str, count: int, lanes: Any, where: Any, strong: bool
    ) -> Any:
        """Return the values that lanes read, ``(lanes,)`` or ``(lanes, count)``."""
        thread = self.everyone if lanes is None else lanes
        if where is not None:
            shape = (thread.size,) if count == 1 else (thread.size, count)
            out = np.zeros(shape, kind)
            if where.any():
                out[where] = self.load(place, space, address[where], kind, count, thread[where], None, strong)
            return out
        size = np.dtype(kind).itemsize * count
        region, index, tell = self._locate(place, space, address, size, thread)
        region.check_known(index, size, tell)
        if region.traced:
            region.touch(index, size, "strong read" if strong else "read", self.threads, thread, tell)
        region.read += size * thread.size
        return region.view(kind, count)[index]

    def store(
        self, place: int, space: str, address: Any, kind: str, count: int, values: Any, lanes: Any, number: int,
        where: Any, strong: bool,
    ) -> None:  # fmt: skip
        """Write values of lanes."""
        thread = self.everyone if lanes is None else lanes
        values = [np.broadcast_to(value, (number,)) for value in values]
        if where is not None:
            if not where.any():
                return
            address, thread, values = address[where], thread[where], [value[where] for value in values]
        size = np.dtype(kind).itemsize * count
        region, index, tell = self._locate(place, space, address, size, thread)
        if not region.values.flags.writeable:
            raise KernelError(f"a write to {region.name}, which is read-only: {tell(0)}")
        if region.traced:
            region.touch(index, size, "strong write" if strong else "write", self.threads, thread, tell)
        if region.known is not None:
            wide = min(size, 8)
            region.view(f"u{wide}", size // wide, True)[index] = int.from_bytes(b"\1" * wide, "little")
        region.written += size * thread.size
        region.view(kind, count)[index] = values[0] if count == 1 else np.stack(values, axis=1)

    def atomic(
        self, place: int, space: str, address: Any, kind: str, how: str, values: Any, lanes: Any, number: int,
        where: Any,
    ) -> Any:  # fmt: skip
        """Update memory by one lane after another, in a random order with a seed; return the values before."""
        thread = self.everyone if lanes is None else lanes
        values = [np.broadcast_to(value, (number,)) for value in values]
        old = np.zeros(number, kind)
        taking = np.arange(number) if where is None else np.flatnonzero(where)
        if not taking.size:
            return old
        size = np.dtype(kind).itemsize
        region, index, tell = self._locate(place, space, address[taking], size, thread[taking])
        region.check_known(index, size, tell)
        if region.traced:
            region.touch(index, size, "strong write", self.threads, thread[taking], tell)
        region.read += size * taking.size
        region.written += size * taking.size
        target = region.view(kind, 1)
        order = np.arange(taking.size) if self.rng is None else self.rng.permutation(taking.size)
        while order.size:  # each round takes the first in line at every address
            _, first = np.unique(index[order], return_index=True)
            now = order[first]
            where_now, lane_now = index[now], taking[now]
            before = target[where_now]
            old[lane_now] = before
            operands = [value[lane_now] for value in values]
            if how == "cas":
                target[where_now] = np.where(before == operands[0], operands[1], before)
            elif how == "exch":
                target[where_now] = operands[0]
            else:
                target[where_now] = _REDUCE[how](before, operands[0])
            order = np.delete(order, first)
        return old


_REDUCE = {
    "add": np.add, "min": np.minimum, "max": np.maximum, "and": np.bitwise_and, "or": np.bitwise_or,
    "xor": np.bitwise_xor,
}  # fmt: skip
