"""A flawed copy of a module takes the place of the real one, in memory, and a check is asked whether it sees the flaw.

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
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from planting import Mutant, flawed

from ptx.interpreter import harness
from ptx.interpreter.emulated import EmulatedQueue
from ptx.interpreter.errors import KernelError, UnknownInstruction
from stereokit.cuda.kernel import KERNELS

__all__ = ["SCHEDULES", "Uncompiled", "how_caught", "planted"]

SCHEDULES = (None,)
"""Seeds of the queues that a check gets, in this order; a mutant is caught by the first that fails.

Lockstep finds them all: whether two accesses race does not depend on the order in which they happen to come.
"""


class Uncompiled(Exception):
    """A kernel of a mutant does not compile, or not to what the interpreter knows: no catch."""


class _Queue(EmulatedQueue):
    """A queue that tells what does not compile from what goes wrong when it runs."""

    def launch(self, what: Any, blocks: int, *arguments: Any) -> None:
        try:
            harness.translation_of(what)
        except Exception as error:
            raise Uncompiled(f"{what.name} cannot be compiled: {error}") from error
        super().launch(what, blocks, *arguments)


def how_caught(mutant: Mutant, **options: Any) -> str:
    """Return the failure of the check on the mutant, in words; "" if it passes.

    It is "wrong result" or a class of `ptx.interpreter.errors` in words.

    Any other exception is an error of the mutant, never a catch, and passes through.

    Parameters
    ----------
    mutant : Mutant
        The flaw; ``post.check_smp`` as its check is that function of `ptx.checks.post`. One whose old and new code are
        equal shows whether the check passes on the real module.
    **options
        Further arguments of the check, such as sizes.

    Raises
    ------
    StaleMutant
        If the old code does not match once.
    Uncompiled
        If a kernel does not compile.
    UnknownInstruction
        If the interpreter lacks an instruction.
    """
    checks, _, name = f"ptx.checks.{mutant.check}".rpartition(".")
    importlib.import_module(checks)
    with planted(mutant):
        check = getattr(importlib.import_module(checks), name)
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
def planted(mutant: Mutant) -> Iterator[None]:
    """Import a module with a flaw in it for a while.

    Raises
    ------
    StaleMutant
        If the old code does not match once.
    """
    module = f"stereokit.{mutant.module}"
    importlib.import_module(module)
    path = Path(str(sys.modules[module].__file__))
    code = compile(flawed(path.read_text(encoding="utf-8"), mutant), f"<a mutant of {path}>", "exec", dont_inherit=True)
    names = _users(module)
    real_modules = {name: sys.modules[name] for name in names}
    real_kernels = dict(KERNELS)
    try:
        _remove(names)
        for kernel in _kernels_of(names):
            del KERNELS[kernel.name]
        _execute(module, path, code)
        yield
    finally:
        now = _users(module) | names  # and what was imported meanwhile
        _remove(now)
        for name, real in real_modules.items():
            _put(name, real)
        for kernel in _kernels_of(now):
            if KERNELS.pop(kernel.name) is not real_kernels.get(kernel.name):
                harness.forget(kernel)
        others = {name: kernel for name, kernel in KERNELS.items() if name not in real_kernels}
        KERNELS.clear()
        KERNELS.update(real_kernels | others)


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


def _execute(name: str, path: Path, code: Any) -> None:
    module = ModuleType(name)
    module.__file__ = str(path)
    module.__package__ = name.rpartition(".")[0]
    _put(name, module)
    exec(code, vars(module))


def _users(module: str) -> set[str]:
    """Return a module and all loaded ones of the project and of the checks that import it when they are imported."""
    users = {module}
    loaded = {
        name: _imports(Path(str(entry.__file__)))
        for name, entry in list(sys.modules.items())
        if re.match(r"stereokit(\.|$)|ptx\.checks\.", name) and getattr(entry, "__file__", None)
    }
    while more := {name for name, imports in loaded.items() if name not in users and imports & users}:
        users |= more
    return users


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
