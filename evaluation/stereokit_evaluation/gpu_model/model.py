"""The modelled time of a match on a GPU: bytes and instructions of every launch, and a bound on its time.

The launches are those of the real pipeline (`stereokit.cuda.pipeline`), which runs on a queue that records them and
computes nothing. `work_of` gives the reads, writes and loops of each kernel from its arguments; the tests compare them
with the interpreter's counts (`tests/ptx/test_model.py`). Instructions are those of the assembled code, loop by loop
(`stereokit_evaluation.gpu_model.sass`).

The time of a launch is the longest of

- **memory**: bytes moved, by the bandwidth. Of an array that a kernel reads again and again, a sweep counts once:
  caches hold windows and lines, but no volumes;
- **units**: the instructions of the busiest multiprocessor's warps, by the rate of the busiest execution unit;
- **waiting**: the time of one warp alone, as often as warps take turns: each instruction waits for the one before it,
  and each pass of a loop for memory, unless the kernel prefetches;

and a launch's own time is added. Sources and assumptions: `stereokit_evaluation.gpu_model.machines`.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from stereokit.cuda.dry import DryQueue, SizedArray
from stereokit_evaluation.gpu_model.machines import ASSUMED, Machine
from stereokit_evaluation.gpu_model.sass import Code, warps_that_fit
from stereokit_evaluation.gpu_model.work import Work, work_of

if TYPE_CHECKING:
    from stereokit.matching import Matcher

__all__ = ["Launch", "Time", "Work", "modelled", "record", "work_of"]


@dataclass(frozen=True)
class Launch:
    """A launch of a kernel.

    Attributes
    ----------
    kernel : stereokit.cuda.kernel.Kernel
    blocks : int
    work : Work
        Its reads, writes and loops.
    read, written : int
        Bytes moved between the memory and the chip.
    """

    kernel: Any
    blocks: int
    work: Work
    read: int
    written: int

    @property
    def moved(self) -> int:
        """Bytes read and written."""
        return self.read + self.written

    @property
    def warps(self) -> int:
        """Warps of all blocks."""
        return self.blocks * int(self.kernel.block) // 32


def named(kernel: Any, arguments: Iterable[Any]) -> SimpleNamespace:
    """Return the arguments of a launch by the names of the kernel's parameters."""
    names = inspect.signature(kernel.function).parameters
    return SimpleNamespace(**dict(zip(names, arguments, strict=True)))


class _Recorder(DryQueue):
    """A queue that records launches."""

    def __init__(self) -> None:
        super().__init__()
        self.launches: list[Launch] = []

    def launch(self, kernel: Any, blocks: int, *arguments: Any) -> None:
        """Record a launch."""
        values = named(kernel, arguments)
        work = work_of(kernel, blocks, values)
        nbytes = [
            sum(
                round(min(count, work.sweeps.get(name, 1) * getattr(values, name).nbytes))
                for name, count in side.items()
            )
            for side in (work.reads, work.writes)
        ]
        self.launches.append(Launch(kernel, blocks, work, *nbytes))


def record(matcher: Matcher, width: int, height: int) -> list[Launch]:
    """Return the launches of a match of grey 8-bit images that lie on the device; needs numba-cuda but no GPU.

    Parameters
    ----------
    matcher : stereokit.Matcher
        Of any device.
    width, height : int
        Size of an image, pixels, before it is halved.

    Raises
    ------
    DeviceError
        If a stage has no CUDA kernels.
    """
    from stereokit.cuda.pipeline import CudaPipeline  # numba.cuda is imported late

    queue = _Recorder()
    pixels = width * height
    images = SizedArray(2 * pixels, np.uint8)
    pipeline = CudaPipeline(matcher.settings)
    pipeline.run(queue, images, np.dtype(np.uint8), images[:pixels], None, (height, width))
    return queue.launches


@dataclass(frozen=True)
class Time:
    """The modelled milliseconds of a launch, and their parts.

    Attributes
    ----------
    memory, units, waiting : float
        Bounds; the longest holds.
    launch : float
        From this launch to the next.
    """

    memory: float
    units: float
    waiting: float
    launch: float

    @property
    def ms(self) -> float:
        """The longest bound and the launch."""
        return max(self.memory, self.units, self.waiting) + self.launch

    @property
    def bound(self) -> str:
        """The name of the longest bound."""
        return max(("memory", "units", "waiting"), key=lambda name: getattr(self, name))


def executed(launch: Launch, code: Code) -> Counter[str]:
    """Return the instructions of one warp of a launch by unit."""
    work = launch.work
    return code.executed(work.passes, work.accesses, work.every)


def modelled(launch: Launch, code: Code, registers: int, machine: Machine) -> Time:
    """Return the modelled time of a launch on a machine.

    Parameters
    ----------
    launch : Launch
    code : Code
        Of the kernel on this machine.
    registers : int
        Of a thread of it.
    machine : Machine
    """
    counts = executed(launch, code)
    total = sum(counts.values())
    clocks_per_ms = 1e6 * machine.ghz
    warps = -(-launch.blocks // machine.multiprocessors) * launch.kernel.block // 32  # of the busiest multiprocessor
    slots = total / 4  # four schedulers
    units = warps * max(slots, *(counts[unit] * 32 / rate for unit, rate in machine.rates.items()))
    resident, _ = warps_that_fit(registers, launch.kernel.block, machine.architecture)
    turns = -(-warps // resident)
    alone = ASSUMED["dependent"] * total + (ASSUMED["shuffle"] - ASSUMED["dependent"]) * counts["shuffle"]
    asking = machine.latency * max(launch.work.passes, 1)
    waiting = turns * (max(alone, asking) if launch.work.ahead else alone + asking)
    return Time(
        launch.moved / (ASSUMED["of_bandwidth"] * machine.gb_per_s) / 1e6,
        units / clocks_per_ms,
        waiting / clocks_per_ms,
        machine.launch_us / 1e3,
    )
