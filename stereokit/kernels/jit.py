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
_IMPORT = re.compile(rb"^ *from (\w[.\w]*) +import +(\([^)]*\)|[^\n]*)", re.MULTILINE)


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256(b"checked" if CHECKED else b"")
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _folder(package: str) -> Path | None:
    """Return the folder of a package that is being imported, or None for what is none."""
    if package == _ROOT.name:
        return _ROOT
    places = getattr(sys.modules.get(package), "__path__", ())
    return next((Path(place) for place in places), None)


def _imports(path: Path, folders: Iterable[Path]) -> set[Path]:
    """Return the modules in these folders of packages that a module imports; what names nothing of them adds none."""
    files: set[Path] = set()
    roots = {folder.name: folder for folder in folders}
    for module, names in _IMPORT.findall(path.read_bytes()):
        package, *inner = module.decode().split(".")
        if package in roots:
            place = roots[package].joinpath(*inner)
            places = [place, *(place / name for name in re.findall(r"\w+", names.decode()))]
            files |= {file for each in places for file in (each.with_suffix(".py"), each / "__init__.py")}
    return {file for file in files if file.is_file()}


def kernel_sources(package: str = _ROOT.name) -> set[Path]:
    """Return the modules that compiled code of a package may depend on.

    They are those that use `stereokit.kernels`, and what they import of the package and of this one.
    """
    folder = _folder(package)
    folders = {_ROOT} if folder is None else {_ROOT, folder}
    sources: set[Path] = set()
    modules = set() if folder is None else set(folder.rglob("*.py"))
    waiting = {path for path in modules if b"stereokit.kernels.jit" in path.read_bytes()}
    while waiting:
        sources |= waiting
        waiting = set().union(*(_imports(path, folders) for path in waiting)) - sources
    return sources


FINGERPRINT = _digest(_ROOT.rglob("*.py"))
"""A digest of the package's source: it changes with anything that a result may depend on."""


@lru_cache
def _stamp(package: str) -> str:
    """Return a digest of what kernels of a package may depend on; of one module alone numba looks at that itself."""
    return _digest(kernel_sources(_ROOT.name) | kernel_sources(package))


# Without numba's runtime (``_nrt``) no array is counted in and out of every helper, which costs more than the work of
# a pixel; for the same reason kernels cannot allocate: buffers come in as arguments. Nobody calls kernels from C, nor
# helpers from Python: without the wrappers for that, in each of which the whole code stands again, a fifth less is
# compiled.
_FLAGS: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "_nrt": False, "boundscheck": CHECKED, "no_cfunc_wrapper": True,
}  # fmt: skip


def kernel(function: F) -> F:
    """Compile `function` as a kernel that Python code calls."""
    function.__qualname__ = f"{function.__qualname__}_{_stamp(function.__module__.partition('.')[0])}"
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
