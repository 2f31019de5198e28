"""Cache of compiled kernels from one process to the next: numba's own, but no fault of it stops a kernel.

Its files lie where numba puts them: in the folder that ``NUMBA_CACHE_DIR`` names, beside the source, or in the
user's cache. Where none of these can be written, as in a read-only container, one that has them is read; kernels that
none has go to a folder of temporary files that is the user's alone, and where that cannot be either, they are compiled
again in every process. A file of the cache that is damaged (a full disk, a power cut) counts as absent, and is written
again.
"""

from __future__ import annotations

import glob
import hashlib
import os
import pickle
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, NullCache
from numba.core.serialize import dumps

from stereokit.notices import say, warn

__all__ = ["cache_of"]

_warned = _said = False


def _warn(message: str) -> None:
    """Warn once in a process, however many kernels there are."""
    global _warned
    if not _warned:
        _warned = True
        warn(f"{message}; NUMBA_CACHE_DIR can name a folder for them")


def _say_compiling(place: str) -> None:
    """Say once in a process that kernels are compiled, which may take many seconds."""
    global _said
    if not _said:
        _said = True
        say(f"compiling kernels for this processor, up to 20 seconds a method, {place}")


def _temporary_folder() -> Path | None:
    """Return a folder of temporary files that nobody else can write to, or None: what is in it will be executed."""
    user = os.getuid() if hasattr(os, "getuid") else None  # on Windows temporary files are the user's alone
    try:
        folder = Path(tempfile.gettempdir(), "stereokit" if user is None else f"stereokit-{user}")
        if folder.parent == Path.cwd():  # where there is no place for temporary files
            return None
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode) or (user is not None and (status.st_uid != user or status.st_mode & 0o077)):
            return None
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return None
    return folder


class _TemporaryLocator:
    """The last place for the files of a function: a folder of temporary files."""

    def __init__(self, function: Any, file: str, folder: Path) -> None:
        self._stamp = hashlib.sha256(Path(file).read_bytes()).hexdigest()
        self._line = function.__code__.co_firstlineno
        self._folder = folder / hashlib.sha256(os.path.abspath(file).encode()).hexdigest()[:16]

    @classmethod
    def from_function(cls, function: Any, file: str) -> _TemporaryLocator | None:
        """Return the locator of a function in a file, or None if there is no such place."""
        folder = _temporary_folder()
        if folder is None:
            return None
        try:
            locator = cls(function, file, folder)
            locator.ensure_cache_path()
        except OSError:
            return None
        _warn(f"compiled kernels are kept in {folder}, as no other folder for them can be written")
        return locator

    def ensure_cache_path(self) -> None:
        """Make the folder."""
        self._folder.mkdir(exist_ok=True)

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Return a digest of the source."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Return the line of the function, which differs among functions of one name."""
        return str(self._line)


class _ReadableLocator:
    """A place that has the files of a function but cannot be written to."""

    @classmethod
    def from_function(cls, function: Any, file: str) -> Any:
        """Return numba's own locator of the folder that has such files, or None."""
        for kind in CompileResultCacheImpl._locator_classes:
            with suppress(Exception):  # not all have a folder here
                locator = kind(function, file)
                folder = Path(locator.get_cache_path())
                if folder.is_absolute() and any(folder.glob(f"*{glob.escape(function.__qualname__)}-*.nbi")):
                    return locator
        return None


class _CheckedFiles(CompileResultCacheImpl):  # type: ignore[misc]
    """Numba's way of keeping compiled functions, with a digest: a damaged one might crash or compute something else."""

    _locator_classes = (*CompileResultCacheImpl._locator_classes, _ReadableLocator, _TemporaryLocator)

    def reduce(self, cres: Any) -> tuple[bytes, bytes]:
        """Return the content of a file: a digest and the compiled function."""
        content = dumps(super().reduce(cres))
        return hashlib.sha256(content).digest(), content

    def rebuild(self, target_context: Any, payload: tuple[bytes, bytes]) -> Any:
        """Return the compiled function of a file's content."""
        digest, content = payload
        if hashlib.sha256(content).digest() != digest:
            raise ValueError("damaged file of the cache")
        return super().rebuild(target_context, pickle.loads(content))


class _Cache(FunctionCache):  # type: ignore[misc]
    """Numba's cache of a function, but no file in it, and none that cannot be written, keeps the function from work."""

    _impl_class = _CheckedFiles

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function for a signature, or None."""
        try:
            code = super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling makes of damaged files
            with suppress(OSError):
                self.flush()  # an index that can be read, or nothing could be added
            code = None
        if code is None:
            _say_compiling(f"once: they are kept in {config.CACHE_DIR or self.cache_path}")
        return code

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the compiled function for a signature."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            self.disable()
            _warn(f"compiled kernels cannot be kept ({error})")


class _NoCache(NullCache):  # type: ignore[misc]
    """No cache."""

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """Return None: nothing is kept."""
        _say_compiling("in every process")


def cache_of(function: Any) -> Any:
    """Return the cache of a kernel: an object of numba's that looks for its compiled code and keeps it."""
    try:
        return _Cache(function)
    except (OSError, RuntimeError):  # numba found no place
        _warn("kernels are compiled again in every process, as no folder for them can be written")
        return _NoCache()
