"""Puts a flawed copy of a module in the place of the real one, in memory, and asks a check whether it sees the flaw.

Modules that import the flawed one, directly or through others, are imported anew while the flaw lasts, and so are the
checks, so that kernels and the host code that launches them are those of the flawed module. Everything else stays:
the CPU's stages, which the checks compare with, are never touched. Afterwards the real modules, the attributes of
their packages and the list of kernels are what they were.
"""

from __future__ import annotations

import ast
import importlib
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from ptx import harness
from ptx.emulated import EmulatedQueue
from ptx.errors import KernelError, UnknownInstruction
from stereokit.cuda.kernel import KERNELS

__all__ = ["SCHEDULES", "Mutant", "StaleMutant", "Uncompiled", "how_caught", "planted"]

SCHEDULES = (None,)
"""Seeds of the queues that a check gets, in this order; a mutant is caught by the first that fails.

Lockstep finds them all: whether two accesses race does not depend on the order in which they happen to come.
"""


class StaleMutant(Exception):
    """The text that a mutant replaces is not in its module, or is there more than once."""


class Uncompiled(Exception):
    """A kernel of a mutant does not compile, or not to what the interpreter knows: no catch."""


@dataclass(frozen=True)
class Mutant:
    """A flaw.

    Attributes
    ----------
    name : str
        What it does.
    module : str
        Where, below ``stereokit``.
    old, new : str
        Text of the module, which must be there once, and what replaces it.
    kind : str
        The class of the bug.
    check : str
        What shall find it: ``post.check_smp`` is that function of ``ptx.bodies_post``.
    """

    name: str
    module: str
    old: str
    new: str
    kind: str
    check: str


class _Queue(EmulatedQueue):
    """A queue that tells what does not compile from what goes wrong when it runs."""

    def launch(self, what: Any, blocks: int, *arguments: Any) -> None:
        try:
            harness.translation_of(what)
        except Exception as error:
            raise Uncompiled(f"{what.name} cannot be compiled: {error}") from error
        super().launch(what, blocks, *arguments)


def how_caught(mutant: Mutant, **options: Any) -> str:
    """Return how the check fails on the mutant, "wrong result" or a class of `ptx.errors` in words; "" if it passes.

    Any other exception is an error of the mutant, never a catch, and passes through.

    Parameters
    ----------
    mutant : Mutant
        The flaw. One whose old text and new text are equal shows whether the check passes on the real module.
    **options
        Further arguments of the check, such as sizes.

    Raises
    ------
    StaleMutant
        If the old text does not occur exactly once.
    Uncompiled
        If a kernel does not compile.
    UnknownInstruction
        If the interpreter lacks an instruction.
    """
    bodies, _, name = mutant.check.partition(".")
    bodies = f"ptx.bodies_{bodies}"
    importlib.import_module(bodies)
    with planted(f"stereokit.{mutant.module}", mutant.old, mutant.new):
        check = getattr(importlib.import_module(bodies), name)
        for seed in SCHEDULES:
            try:
                check(_Queue(seed), **options)
            except UnknownInstruction:
                raise
            except KernelError as error:
                return re.sub(r"(?<=.)(?=[A-Z])", " ", type(error).__name__).lower()
            except AssertionError:
                return "wrong result"
    return ""


@contextmanager
def planted(module: str, old: str, new: str) -> Iterator[None]:
    """Import a module with a flaw in it for a while.

    Parameters
    ----------
    module : str
        Name of the module.
    old, new : str
        Text that must be there once, and what replaces it.

    Raises
    ------
    StaleMutant
        If `old` does not occur exactly once.
    """
    importlib.import_module(module)
    path = Path(str(sys.modules[module].__file__))
    source = path.read_text(encoding="utf-8")
    if source.count(old) != 1:
        raise StaleMutant(f"old text must occur once in {module}, got {source.count(old)} times: {old!r}")
    names = _users(module)
    kept = {name: sys.modules[name] for name in names}
    filed = dict(KERNELS)
    try:
        _remove(names)
        for kernel in _kernels_of(names):
            del KERNELS[kernel.name]
        _execute(module, path, source.replace(old, new))
        yield
    finally:
        now = _users(module) | names  # and what was imported meanwhile
        _remove(now)
        for name, real in kept.items():
            _put(name, real)
        for kernel in _kernels_of(now):
            if KERNELS.pop(kernel.name) is not filed.get(kernel.name):
                harness.forget(kernel)
        others = {name: kernel for name, kernel in KERNELS.items() if name not in filed}
        KERNELS.clear()
        KERNELS.update(filed | others)


def _kernels_of(modules: set[str]) -> list[Any]:
    return [kernel for kernel in KERNELS.values() if kernel.function.__module__ in modules]


def _put(name: str, module: ModuleType) -> None:
    parent, _, child = name.rpartition(".")
    sys.modules[name] = module
    setattr(sys.modules[parent], child, module)


def _remove(names: set[str]) -> None:
    for name in names:
        parent, _, child = name.rpartition(".")
        sys.modules.pop(name, None)
        vars(sys.modules[parent]).pop(child, None)


def _execute(name: str, path: Path, source: str) -> None:
    made = ModuleType(name)
    made.__file__ = str(path)
    made.__package__ = name.rpartition(".")[0]
    _put(name, made)
    exec(compile(source, f"<a mutant of {path}>", "exec", dont_inherit=True), vars(made))


def _users(module: str) -> set[str]:
    """Return a module and all loaded ones of the project and of the checks that import it when they are imported."""
    found = {module}
    loaded = {
        name: _imports(Path(str(held.__file__)))
        for name, held in list(sys.modules.items())
        if re.match(r"stereokit(\.|$)|ptx\.bodies_", name) and getattr(held, "__file__", None)
    }
    while more := {name for name, imports in loaded.items() if name not in found and imports & found}:
        found |= more
    return found


@cache
def _imports(path: Path) -> frozenset[str]:
    """Return the names of modules, and of what may be modules, that a file imports at its top level."""
    names: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(names)
