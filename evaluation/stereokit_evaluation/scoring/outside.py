"""Methods of others beside ours: a Python function, a program, and finished maps.

Each is called with a frame and its images, and returns a `stereokit.result.Disparity`. What goes wrong on a frame is a
`stereokit.errors.StereokitError` with one line, and costs that frame.

* A *function* is named ``module:function``. It gets both images as they are stored, and ``max_disparity`` if it has a
  parameter of that name; it returns a map (H, W) in pixels, or an object with ``disparity`` and perhaps ``valid``.
* A *program* is a command line with ``{left}``, ``{right}`` and ``{out}``, split as a shell would, but run without one.
  It finds the images under the first two, and leaves its map under the third, a ``.pfm``; ``{out.png}``, ``{out.npy}``
  and ``{out.tiff}`` are other formats. ``{max_disparity}`` is the range. Its time is that of the whole process.
* *Finished maps* lie in a folder (`map_of`), or in one for each data set below it.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import inspect
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereokit.errors import FileError, InputError, OptionError, StereokitError, one_line
from stereokit.io import DISPARITY_SUFFIXES, READABLE_SUFFIXES, read_disparity, write_image
from stereokit.result import Disparity
from stereokit_evaluation.data.frame import Frame

__all__ = [
    "FunctionMethod",
    "MapFolder",
    "OutsideMethod",
    "Program",
    "checked_map",
    "is_function",
    "map_folder",
    "map_of",
    "named",
    "outside_function",
    "outside_methods",
    "program",
]

_MAPS = (*DISPARITY_SUFFIXES, ".tif")
_OUT = re.compile(r"\{out(\.[a-z]+)?\}")
_PATIENCE_S = 2.0  # between asking a program to end and ending it


class OutsideMethod(Protocol):
    """A method of others."""

    @property
    def name(self) -> str:
        """The name in tables."""
        ...

    @property
    def kind(self) -> str:
        """``"function"``, ``"program"`` or ``"maps"``."""
        ...

    def identity(self) -> dict[str, Any]:
        """Return everything that its maps depend on, except the images."""
        ...

    def __call__(self, frame: Frame, left: NDArray[Any], right: NDArray[Any]) -> Disparity:
        """Return the map of a frame, whose images come as they are stored."""
        ...


@dataclass(frozen=True, eq=False)
class FunctionMethod:
    """A function of two images."""

    name: str
    function: Callable[..., Any]
    max_disparity: int
    kind = "function"

    def identity(self) -> dict[str, Any]:
        """Return the name, the range, and a digest of the source file and of the modules beside it that it uses."""
        try:
            file = inspect.getsourcefile(inspect.unwrap(self.function))
        except TypeError:  # an object with __call__, or a compiled function
            file = getattr(sys.modules.get(type(self.function).__module__), "__file__", None)
        place = f"{getattr(self.function, '__module__', '')}:{getattr(self.function, '__qualname__', '')}"
        source = {
            "source": _digest(file),
            "modules": _modules_beside(getattr(self.function, "__module__", "") or "", file),
        }
        return {"function": place, "levels": self.max_disparity, **source}

    def __call__(self, frame: Frame, left: NDArray[Any], right: NDArray[Any]) -> Disparity:
        """Return the function's map."""
        return self.timed(left, right)[0]

    def timed(
        self, left: NDArray[Any], right: NDArray[Any], clock: Callable[[], float] = time.perf_counter
    ) -> tuple[Disparity, float]:
        """Return the map and the seconds of the call; its images are copies, so that writing to them harms no other."""
        range_ = {"max_disparity": self.max_disparity} if _takes(self.function, "max_disparity") else {}
        own_left, own_right = left.copy(), right.copy()
        start = clock()
        try:
            result = self.function(own_left, own_right, **range_)
        except SystemExit as error:  # a script that ends itself must not end a long run
            raise InputError(f"{self.name} ended Python: SystemExit: {error}") from error
        disparity = checked_map(self.name, result, left.shape[:2])
        return disparity, clock() - start


@dataclass(frozen=True, eq=False)
class Program:
    """A program that reads two images and writes a map.

    Attributes
    ----------
    name : str
    words : tuple of str
        The command line, with ``{left}``, ``{right}``, ``{out}`` and ``{max_disparity}``.
    max_disparity : int
    time_limit : float or None
        Seconds for one pair.
    """

    name: str
    words: tuple[str, ...]
    max_disparity: int
    time_limit: float | None = None
    kind = "program"

    def identity(self) -> dict[str, Any]:
        """Return the words, the range, and digests of those that name files: the program itself, a script."""
        files = [shutil.which(self.words[0]), *(word for word in self.words[1:] if Path(word).is_file())]
        return {"program": list(self.words), "levels": self.max_disparity, "files": [_digest(file) for file in files]}

    def __call__(self, frame: Frame, left: NDArray[Any], right: NDArray[Any]) -> Disparity:
        """Return the map that the program writes."""
        return self.timed(frame, left, right)[0]

    def timed(self, frame: Frame, left: NDArray[Any], right: NDArray[Any]) -> tuple[Disparity, float]:
        """Return the map and the seconds of the process, from its start to its end."""
        with tempfile.TemporaryDirectory(prefix="stereokit-") as folder:
            home = Path(folder)
            places = {
                "{left}": _image_file(frame.left, home / "left.png", left),
                "{right}": _image_file(frame.right, home / "right.png", right),
                "{max_disparity}": str(self.max_disparity),
            }
            text = next(match for word in self.words if (match := _OUT.search(word)))
            out = home / f"out{text[1] or '.pfm'}"
            places[text[0]] = str(out)
            words = [_replaced(word, places) for word in self.words]
            start = time.perf_counter()
            _run(self.name, words, self.time_limit)
            seconds = time.perf_counter() - start
            if not out.is_file():
                raise FileError(f"{self.name} wrote no map to {text[0]}")
            try:
                disparity = read_disparity(out)
            except StereokitError as error:
                raise FileError(f"{self.name}: {one_line(str(error)).replace(str(home) + os.sep, '')}") from error
            return checked_map(self.name, disparity, left.shape[:2]), seconds


@dataclass(frozen=True, eq=False)
class MapFolder:
    """Finished maps in a folder."""

    name: str
    folder: Path
    kind = "maps"

    def identity(self) -> dict[str, Any]:
        """Return the folder; what a map depends on is its file, see `digest_of`."""
        return {"maps": self.name}

    def digest_of(self, frame: Frame) -> str:
        """Return a digest of the frame's file.

        Raises
        ------
        FileError
            If there is none.
        """
        return _digest(map_of(self.folder, frame.name))

    def __call__(self, frame: Frame, left: NDArray[Any], right: NDArray[Any]) -> Disparity:
        """Return the map of a frame."""
        return checked_map(self.name, read_disparity(map_of(self.folder, frame.name)), left.shape[:2])


def outside_methods(
    functions: Sequence[str],
    commands: Sequence[str],
    predictions: Sequence[str],
    *,
    max_disparity: int,
    time_limit: float | None = None,
    dataset: str | None = None,
) -> list[OutsideMethod]:
    """Return the methods of others that a command line names, in this order.

    Parameters
    ----------
    functions, commands, predictions : sequence of str
        As `outside_function`, `program` and `map_folder` take them.
    max_disparity : int
        Disparities to search.
    time_limit : float, optional
        Of programs, seconds for one pair.
    dataset : str, optional
        The data set, for folders of maps.

    Raises
    ------
    OptionError, FileError
        If one cannot be used, or two have the same name.
    """
    if time_limit is not None and not commands:
        raise OptionError(f"time_limit must go with command, got {time_limit:g} alone")
    methods: list[OutsideMethod] = [outside_function(text, max_disparity) for text in functions]
    methods += [program(text, max_disparity, time_limit) for text in commands]
    methods += [map_folder(text, dataset) for text in predictions]
    names = [method.name for method in methods]
    for name in names:
        if names.count(name) > 1:
            raise OptionError(f"methods must have different names, got {name!r} twice; use NAME=...")
    return methods


def is_function(text: str) -> bool:
    """Return whether a method's name is that of a function, ``module:function`` or ``NAME=module:function``."""
    return re.fullmatch(r"([^=]+=)?\s*[A-Za-z_][\w.]*:[A-Za-z_][\w.]*", text.strip()) is not None


def outside_function(text: str, max_disparity: int) -> FunctionMethod:
    """Import ``module:function`` or ``NAME=module:function``, from the working folder too.

    Raises
    ------
    OptionError
        If it cannot be imported or cannot be called.
    """
    name, target_name = named("method", text) if "=" in text else (text.strip(), text.strip())
    module_name, _, path = target_name.partition(":")
    try:
        with _working_folder_first():
            target: Any = importlib.import_module(module_name)
            for part in path.split("."):
                target = getattr(target, part)
    except (Exception, SystemExit) as error:  # whatever a module of others does when it is imported
        reason = one_line(f"{type(error).__name__}: {error}")
        raise OptionError(f"method must name a function that can be imported, got {text!r}: {reason}") from error
    if not callable(target):
        raise OptionError(f"method must name a function, got {text!r}, which is {type(target).__name__}")
    return FunctionMethod(name, target, max_disparity)


def program(text: str, max_disparity: int, time_limit: float | None = None) -> Program:
    """Return the program of ``--command NAME=PROGRAM {left} {right} {out}``; nothing is run.

    Raises
    ------
    OptionError
        If a placeholder is missing, the text cannot be split, or there is no such program.
    """
    name, line = named("command", text)
    try:
        words = shlex.split(line)
    except ValueError as error:
        raise OptionError(f"command must be a line that a shell could split, got {line!r}: {error}") from error
    for place in ("{left}", "{right}"):
        if not any(place in word for word in words):
            raise OptionError(f"command must have {{left}}, {{right}} and {{out}}, got {line!r} without {place}")
    outs = {match[0] for word in words for match in _OUT.finditer(word)}
    if len(outs) != 1:
        raise OptionError(f"command must have {{left}}, {{right}} and one {{out}}, got {line!r}")
    suffix = _OUT.fullmatch(outs.pop())
    if suffix is not None and suffix[1] is not None and suffix[1] not in _MAPS:
        raise OptionError(f"command must write one of {', '.join(_MAPS)}, got {{out{suffix[1]}}}")
    if shutil.which(words[0]) is None:
        raise OptionError(f"command must begin with a program that can be run, got {words[0]!r}")
    if time_limit is not None and not (0 < time_limit < float("inf")):
        raise OptionError(f"time_limit must be a number of seconds above 0, got {time_limit!r}")
    return Program(name, tuple(words), max_disparity, time_limit)


def map_folder(text: str, dataset: str | None = None) -> MapFolder:
    """Return the maps of ``--predictions NAME=DIR``, or of ``DIR``, which is called "predictions".

    Parameters
    ----------
    text : str
    dataset : str, optional
        Of this data set: maps lie in ``DIR/DATASET`` if there is such a folder.

    Raises
    ------
    FileError
        If there is no such folder.
    """
    name, place = named("predictions", text) if "=" in text else ("predictions", text)
    base = Path(place)
    if not base.is_dir():
        raise FileError(f"predictions must be a folder, got {place!r}, which is not")
    below = base / dataset if dataset is not None else base
    return MapFolder(name, below if below.is_dir() else base)


def named(option: str, text: str) -> tuple[str, str]:
    """Return the parts of ``NAME=VALUE``.

    Raises
    ------
    OptionError
        If one is missing.
    """
    name, separator, value = text.partition("=")
    name, value = name.strip(), value.strip()
    if not separator or not name or not value or "/" in name:
        raise OptionError(f"{option} must be NAME=VALUE with no / in the name, got {text!r}")
    return name, value


def map_of(folder: Path, name: str) -> Path:
    """Return the file of a frame's map.

    It is ``NAME.png`` (16 bits as in KITTI, 0 unknown), ``.pfm``, ``.npy``, ``.tiff`` or ``.tif``. For a name with
    folders, such as ``2003/cones``, the last part alone will do.

    Raises
    ------
    FileError
        If there is none.
    """
    for stem in (name, name.rpartition("/")[2]):
        for ending in _MAPS:
            if (path := folder / f"{stem}{ending}").exists():
                return path
    raise FileError(f"no map {name}{', '.join(_MAPS)} in {str(folder)!r}")


def checked_map(name: str, result: Any, shape: Sequence[int]) -> Disparity:
    """Return what a method gave as a result: infinite and negative disparities are unknown.

    Raises
    ------
    InputError
        If it is no map of numbers of the size `shape`.
    """
    disparity = np.asarray(getattr(result, "disparity", result))
    if disparity.dtype.kind not in "fiu" or disparity.shape != tuple(shape):
        raise InputError(
            f"{name} must give a map of numbers of the size of the left image, {tuple(shape)}, got "
            f"{disparity.dtype} {disparity.shape}"
        )
    values = disparity.astype(np.float32)
    known = np.isfinite(values) & (values >= 0)
    values[~known] = np.nan
    valid = getattr(result, "valid", None)
    if valid is None:
        return Disparity(values, known)
    valid = np.asarray(valid)
    if valid.shape != values.shape:
        raise InputError(f"{name} must give valid of the size of its map, {values.shape}, got {valid.shape}")
    return Disparity(values, known & valid.astype(bool))


def _run(name: str, words: Sequence[str], limit: float | None) -> None:
    """Run a program to its end; what it started ends with it, also at an interrupt."""
    with tempfile.TemporaryFile() as complaints:
        try:
            process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=complaints, start_new_session=True
            )
        except OSError as error:
            raise FileError(f"{name} could not be started: {one_line(str(error))}") from error
        try:
            status = process.wait(limit)
        except BaseException as error:
            _end(process)
            if isinstance(error, subprocess.TimeoutExpired):
                raise FileError(f"{name} did not end within {limit:g} s") from error
            raise
        if status == 0:
            return
        complaints.seek(0, os.SEEK_END)
        complaints.seek(max(0, complaints.tell() - 4096))
        lines = [line for line in complaints.read().decode(errors="replace").splitlines() if line.strip()]
        reason = f": {one_line(lines[-1].strip())}" if lines else ""
        how = f"with status {status}" if status > 0 else f"by signal {-status}"
        raise FileError(f"{name} ended {how}{reason}")


def _end(process: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
        except OSError:  # it ended by itself
            pass
        try:
            process.wait(_PATIENCE_S)
            return
        except subprocess.TimeoutExpired:
            continue


def _replaced(word: str, places: dict[str, str]) -> str:
    pattern = "|".join(re.escape(place) for place in places)
    return re.sub(pattern, lambda match: places[match[0]], word)


def _image_file(source: Any, place: Path, image: NDArray[Any]) -> str:
    if isinstance(source, Path) and source.suffix.lower() in READABLE_SUFFIXES:
        return str(source.resolve())
    write_image(place, image)
    return str(place)


def _takes(function: Callable[..., Any], name: str) -> bool:
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # a compiled function may have none
        return False
    return any(p.name == name or p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters)


@contextmanager
def _working_folder_first() -> Iterator[None]:
    before = list(sys.path)
    sys.path.insert(0, os.getcwd())
    try:
        yield
    finally:
        sys.path[:] = before


def _modules_beside(name: str, file: str | Path | None) -> dict[str, str]:
    """Return digests of the Python files that a module imports, and they in turn, from its own folder or package.

    Read from the text of ``import`` statements, wherever they stand; installed packages but its own are left out.
    """
    if file is None or not Path(file).is_file():
        return {}
    first = Path(file).resolve()
    root = first.parents[min(name.count(".") + (first.name == "__init__.py"), len(first.parents) - 1)]
    home = root / name.partition(".")[0] if root.name in ("site-packages", "dist-packages") else root
    digests, waiting = {first: ""}, [first]
    while waiting:
        for place in _imported_files(waiting.pop(), root):
            if place not in digests and place.is_relative_to(home):
                digests[place] = _digest(place)
                waiting.append(place)
    return {place.relative_to(root).as_posix(): digest for place, digest in sorted(digests.items()) if digest}


def _imported_files(file: Path, root: Path) -> Iterator[Path]:
    """Yield the files that a Python file's ``import`` statements may mean, below `root` or beside it."""
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [root.joinpath(*alias.name.split(".")) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = file.parents[node.level - 1] if 0 < node.level <= len(file.parents) else root
            base = base.joinpath(*(node.module or "").split("."))
            names = [base, *(base / alias.name for alias in node.names)]
        else:
            continue
        for stem in names:
            yield from (place for place in (stem.with_name(f"{stem.name}.py"), stem / "__init__.py") if place.is_file())


def _digest(file: str | Path | None) -> str:
    if file is None or not Path(file).is_file():
        return ""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:16]
