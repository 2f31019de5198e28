"""A second copy of stereokit whose kernels are plain Python, for as long as a ``with`` block lasts.

Nothing is compiled: `stereokit.kernels.jit` makes kernels of functions as they are, and `cpu.lanes` stands for
`stereokit.kernels.simd`. One module of the copy may have a flaw. The real package comes back at the end.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

import numba
import numpy as np
from planting import Mutant, flawed

from cpu import lanes

__all__ = ["interpreted"]


def _same(function: Any) -> Any:
    return function


def _kind_of(value: Any) -> Any:
    """Return a stand-in for the type of a value, with the attributes that helpers choose by."""
    if isinstance(value, lanes.Lanes):
        return SimpleNamespace(scalar=value.scalar)
    if isinstance(value, np.ndarray):
        return SimpleNamespace(dtype=numba.from_dtype(value.dtype))
    if hasattr(value, "_fields"):
        return SimpleNamespace(instance_class=type(value))
    return value


def _by_types(choose: Any) -> Any:
    return lambda *arguments: choose(*map(_kind_of, arguments))(*arguments)


def _spin_while(words: Any, index: int, value: int, awake: int) -> bool:
    for _ in range(1000):
        if words[index] != value:
            return True
        time.sleep(0)
    return False


_one_claim = threading.Lock()


def _claim(words: Any, index: int) -> int:
    with _one_claim:
        words[index] += 1
        return int(words[index]) - 1


def _publish(words: Any, index: int, value: int) -> None:
    words[index] = value


def _wait_until(words: Any, index: int, value: int) -> None:
    while words[index] < value:
        time.sleep(0)


def _stand_ins() -> dict[str, ModuleType]:
    jit, spin = ModuleType("stereokit.kernels.jit"), ModuleType("stereokit.kernels.spin")
    vars(jit).update(CHECKED=True, FINGERPRINT="", kernel=_same, inline=_same, by_types=_by_types)
    vars(spin).update(
        WORDS_APART=1, LOOKS_AWAKE=1, claim=_claim, publish=_publish, spin_while=_spin_while, wait_until=_wait_until
    )
    return {jit.__name__: jit, spin.__name__: spin, "stereokit.kernels.simd": lanes}


class _Planter(importlib.abc.MetaPathFinder):
    """Loads the module of a mutant with the flaw."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant

    def find_spec(self, name: str, path: Sequence[str] | None, target: Any = None) -> Any:
        if name != f"stereokit.{self.mutant.module}":
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        assert spec is not None and spec.origin is not None
        spec.loader = _Loader(name, spec.origin, self.mutant)
        return spec


class _Loader(importlib.machinery.SourceFileLoader):
    def __init__(self, name: str, path: str, mutant: Mutant) -> None:
        super().__init__(name, path)
        self.mutant = mutant

    def get_code(self, fullname: str) -> Any:
        source = self.get_data(self.path).decode()
        return compile(flawed(source, self.mutant), f"<a mutant of {self.path}>", "exec", dont_inherit=True)


@contextmanager
def interpreted(mutant: Mutant | None = None) -> Iterator[None]:
    """Make ``import stereokit`` give a copy that Python interprets, with a flaw if one is named.

    Raises
    ------
    planting.StaleMutant
        If the mutant's pattern does not match once.
    """
    real = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "stereokit"}
    finder = None if mutant is None else _Planter(mutant)
    try:
        for name in real:
            del sys.modules[name]
        sys.modules.update(_stand_ins())
        if finder is not None:
            sys.meta_path.insert(0, finder)
        importlib.import_module("stereokit")
        with np.errstate(all="ignore"):
            yield
    finally:
        if finder is not None:
            sys.meta_path.remove(finder)
        for name in [name for name in sys.modules if name.split(".")[0] == "stereokit"]:
            del sys.modules[name]
        sys.modules.update(real)
