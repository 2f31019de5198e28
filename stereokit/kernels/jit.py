"""The one home of numba's flags.

Every kernel is compiled on first use for the types that it meets, cached on disk (`stereokit.kernels.cache`), releases
the interpreter lock so that plain threads run it side by side, and divides as numpy does (no zero-division
exception inside loops). There is no ``fastmath``: results must not depend on the processor. There is no
``parallel=True`` either: kernels are serial over a range of rows or columns, and `stereokit.kernels.threads` runs
several of them at once, which is safe from any number of calling threads and compiles in half the time.

Numba files a compiled kernel under the name of its function and looks only at the file which that stands in, not
at the functions that are compiled into it. So each name carries a digest of every module that makes kernels and of
all that these import: after an upgrade, or an edit to any of them, nothing stale is ever loaded.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Callable, Iterable
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.registry import CPUDispatcher as Dispatcher
from numba.extending import overload

from stereokit.kernels.cache import cache_of

__all__ = ["CHECKED", "FINGERPRINT", "by_types", "inline", "kernel", "kernel_sources"]

F = TypeVar("F", bound=Callable[..., Any])


CHECKED = os.environ.get("STEREOKIT_CHECKED", "0") not in ("", "0")
"""Whether kernels check each access to an array; one outside of it ends the process. For tests: slow to compile."""


_ROOT = Path(__file__).parents[1]
_FROM = re.compile(rb"^ *from ([.\w]+) +import +(\([^)]*\)|[^\n]*)", re.MULTILINE)
_IMPORT = re.compile(rb"^ *import +([^\n]+)", re.MULTILINE)


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256(b"checked" if CHECKED else b"")
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _modules_below(folder: Path) -> list[Path]:
    """Return the modules of a package; an editor's lock files, which begin with a dot, are none."""
    return [path for path in folder.rglob("*.py") if not path.name.startswith(".") and path.is_file()]


def _places(module: str, path: Path) -> list[Path]:
    """Return where a module may lie that a file imports: in this package, its own, or its own folder."""
    levels = len(module) - len(module.lstrip("."))
    parts = [part for part in module.split(".") if part]
    if levels or not parts:
        return [parent.joinpath(*parts) for parent in list(path.parents)[levels - 1 : levels]]
    if parts[0] == _ROOT.name:
        return [_ROOT.joinpath(*parts[1:])]
    package = [Path(place) for place in getattr(sys.modules.get(parts[0]), "__path__", ())]
    own = package if any(path.is_relative_to(place) for place in package) else []
    return [path.parent.joinpath(*parts), *(place.joinpath(*parts[1:]) for place in own)]


@lru_cache(maxsize=1024)
def _imports(path: Path) -> frozenset[Path]:
    """Return the modules that a module imports, of this package, its own, and its own folder."""
    text = path.read_bytes()
    files: set[Path] = set()
    wanted = [(module.decode(), names.decode()) for module, names in _FROM.findall(text)]
    for line in _IMPORT.findall(text):
        wanted += [(name.split(" as ")[0].strip(), "") for name in line.decode().split(",")]
    for module, names in wanted:
        if re.fullmatch(r"\.*[\w.]*", module):
            for place in _places(module, path):
                each = [place, *(place / name for name in re.findall(r"\w+", names))]
                files |= {file for one in each for file in (one.with_suffix(".py"), one / "__init__.py")}
    return frozenset(file for file in files if file.is_file())


def _with_imports(paths: Iterable[Path]) -> set[Path]:
    sources: set[Path] = set()
    waiting = set(paths)
    while waiting:
        sources |= waiting
        waiting = set().union(*map(_imports, waiting)) - sources
    return sources


@lru_cache(maxsize=1)
def kernel_sources() -> frozenset[Path]:
    """Return the modules that this package's compiled code may depend on: those with kernels, and their imports."""
    return frozenset(
        _with_imports(path for path in _modules_below(_ROOT) if b"stereokit.kernels.jit" in path.read_bytes())
    )


FINGERPRINT = _digest(_modules_below(_ROOT))
"""A digest of the package's source: it changes with anything that a result may depend on."""


@lru_cache(maxsize=1024)
def _stamp(file: str) -> str:
    """Return a digest of what the kernels of a file may depend on."""
    path = Path(file)
    own = set() if path.is_relative_to(_ROOT) or not path.is_file() else _with_imports([path])
    return _digest(kernel_sources() | own)


# Without numba's runtime (``_nrt``) no array is counted in and out of every helper, which costs more than the work of
# a pixel; for the same reason kernels cannot allocate: buffers come in as arguments. Nobody calls kernels from C, nor
# helpers from Python: without the wrappers for that, in each of which the whole code stands again, a fifth less is
# compiled.
_FLAGS: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "_nrt": False, "boundscheck": CHECKED, "no_cfunc_wrapper": True,
}  # fmt: skip


def kernel(function: F) -> F:
    """Compile `function` as a kernel that Python code calls."""
    function.__qualname__ = f"{function.__qualname__}_{_stamp(function.__code__.co_filename)}"
    compiled: F = numba.njit(**_FLAGS)(function)
    if hasattr(compiled, "_cache"):  # not where NUMBA_DISABLE_JIT is set
        compiled._cache = cache_of(function)
    return compiled


def inline(function: F) -> F:
    """Compile `function` as a helper that kernels call and that is always inlined into them."""
    compiled: F = numba.njit(forceinline=True, no_cpython_wrapper=True, **_FLAGS)(function)
    if isinstance(compiled, Dispatcher):  # not where NUMBA_DISABLE_JIT is set
        compiled.__class__ = _Helper
    return compiled


class _Helper(Dispatcher):  # type: ignore[misc]
    """A compiled helper, which has no code for a call from Python: that would end the process."""

    def __call__(self, *_: Any, **__: Any) -> Any:
        """Refuse."""
        raise TypeError(f"{self.__name__} is a helper of kernels; only compiled code may call it")


def by_types(choose: F) -> F:
    """Make a helper whose code depends on the types of its arguments, always inlined into the kernels that call it.

    `choose` is called with numba's types when a kernel is compiled, and returns the function to compile for them.
    """

    @wraps(choose)
    def stub(*arguments: Any) -> Any:
        raise NotImplementedError("compiled code only")

    overload(stub, strict=False, jit_options={"forceinline": True, "no_cfunc_wrapper": True})(choose)
    return stub  # type: ignore[return-value]
