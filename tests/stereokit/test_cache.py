"""Where compiled kernels are kept, and what happens where they cannot be."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numba
import numpy as np
import pytest

import stereokit
import stereokit_refiners
from stereokit.errors import StereokitWarning
from stereokit.kernels import cache
from stereokit.kernels.jit import kernel_sources

USE = """
    import warnings
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        import numpy as np
        import stereokit
        from stereokit.postprocess.fill import fill
        from stereokit_refiners.outputs import Direct
        filled = fill(np.array([[np.nan, 3, np.nan]], np.float32))
        full = Direct().map(np.full((1, 1, 4), 0.5, np.float32), np.zeros((1, 1), np.float32), 2, 2)
    assert filled.tolist() == [[3, 3, 3]] and full.tolist() == [[128, 128]] * 2
    lines = [str(w.message) for w in caught if issubclass(w.category, stereokit.StereokitWarning)]
    print(stereokit.__file__, lines, sep="\\n")
    """


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """Copy the packages to a place where no cache can be made beside them, not even by root."""
    root = tmp_path_factory.mktemp("package")
    for module in (stereokit, stereokit_refiners):
        source = Path(module.__file__).parent
        shutil.copytree(source, root / source.name, ignore=shutil.ignore_patterns("__pycache__", "weights"))
    for folder in [path for path in root.rglob("*") if path.is_dir()]:
        (folder / "__pycache__").write_text("not a folder")
    return root


def use(package, tmp_path, numba_cache):
    """Run `USE` without a cache of the user's; return the warnings."""
    (tmp_path / "file").touch()
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    environment |= {"PYTHONPATH": str(package), "HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    if numba_cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(numba_cache)
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(USE)],
        env=environment, cwd=package, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    place, warnings = done.stdout.splitlines()
    assert Path(place).is_relative_to(package)
    return eval(warnings)


def test_without_a_writable_cache_kernels_are_kept_among_the_temporary_files(package, tmp_path):
    (warning,) = use(package, tmp_path, tmp_path / "file")
    user = f"stereokit-{os.getuid()}" if hasattr(os, "getuid") else "stereokit"
    assert str(tmp_path / user) in warning and "NUMBA_CACHE_DIR" in warning
    contents = {path: path.read_bytes() for path in (tmp_path / user).rglob("*.nb*")}
    assert any("fill_rows" in path.name for path in contents) and any("_interleave" in path.name for path in contents)
    use(package, tmp_path, None)
    assert contents == {path: path.read_bytes() for path in (tmp_path / user).rglob("*.nb*")}  # not compiled again


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs users")
def test_without_any_place_kernels_are_compiled_and_not_kept(package, tmp_path):
    shared = tmp_path / f"stereokit-{os.getuid()}"
    shared.mkdir()
    shared.chmod(0o777)  # others could put code there
    (warning,) = use(package, tmp_path, None)
    assert "compiled again in every process" in warning and "NUMBA_CACHE_DIR" in warning
    assert not list(shared.iterdir())


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """Return a function that imports a kernel anew, as a new process would, with its cache in a folder."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    source = tmp_path / "own_kernel.py"
    source.write_text(
        "from stereokit.kernels.jit import kernel\n\n"
        "@kernel\ndef double(values, out):\n    for k in range(values.size):\n        out[k] = 2 * values[k]\n"
    )

    def load():
        spec = importlib.util.spec_from_file_location("own_kernel", source)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.double

    return load


def double(kernel, dtype=np.int64):
    """Call the kernel; return whether what was compiled came from the cache."""
    out = np.empty(3, dtype)
    kernel(np.array([1, 2, 3], dtype), out)
    assert out.tolist() == [2, 4, 6]
    return sum(kernel.stats.cache_hits.values()) == 1


DAMAGES = {
    "cut": lambda content: content[:200],
    "empty": lambda content: b"",
    "zeros": lambda content: bytes(len(content)),
    "zeros at the end": lambda content: content[: len(content) // 2] + bytes(len(content) - len(content) // 2),
    "text": lambda content: b"not a pickle\n" * 20,
    "another pickle": lambda content: b"\x80\x04N.",
}


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_counts_as_absent_and_is_written_again(kernels, tmp_path, suffix, damage):
    assert not double(kernels())
    assert double(kernels())
    (path,) = (tmp_path / "cache").rglob(f"*.{suffix}")
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert not double(kernels())
    assert double(kernels())


def test_code_that_was_changed_within_a_file_is_not_run(kernels, tmp_path):
    """A page of zeros within the machine code still unpickles."""
    double(kernels())
    (path,) = (tmp_path / "cache").rglob("*.nbc")
    content = bytearray(path.read_bytes())
    offset = content.index(b"\x7fELF") if b"\x7fELF" in content else len(content) // 2
    content[offset + 64 : offset + 128] = bytes(64)
    path.write_bytes(content)
    assert not double(kernels())
    assert double(kernels())


def test_a_cache_that_cannot_be_written_any_more_is_warned_of_once(kernels, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile._save_data", full)
    monkeypatch.setattr(cache, "_warned", False)
    with pytest.warns(StereokitWarning, match=r"No space left.*NUMBA_CACHE_DIR"):
        double(kernels())
    double(kernels())  # a second warning would be an error


def test_a_cache_that_can_only_be_read_is_read(kernels, monkeypatch):
    double(kernels())

    def read_only(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", read_only)  # with which numba and we look whether we may write
    monkeypatch.setattr(cache, "_warned", False)
    assert double(kernels())
    with pytest.warns(StereokitWarning, match="Permission denied"):  # what is not there cannot be kept
        assert not double(kernels(), np.float64)


def test_a_cache_that_cannot_be_read_is_left_alone(kernels, tmp_path):
    double(kernels())
    (path,) = (tmp_path / "cache").rglob("*.nbi")
    path.unlink()
    path.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "_warned", True)
        assert not double(kernels())


def test_names_of_kernels_change_with_what_is_compiled_and_nothing_else():
    """A kernel takes in helpers of other modules; the command line is none of them."""
    sources = {path.relative_to(Path(stereokit.__file__).parent).as_posix() for path in kernel_sources()}
    makers = {
        path.relative_to(Path(stereokit.__file__).parent).as_posix()
        for path in Path(stereokit.__file__).parent.rglob("*.py")
        if re.search(r"^@(inline|kernel|by_types)\b", path.read_text("utf-8"), re.MULTILINE)
        and not path.stem.endswith("_cuda")  # these are compiled in memory
    }
    assert {"costs/census.py", "aggregation/paths/visits.py", "aggregation/paths/steps.py"} <= makers <= sources
    simd = {f"kernels/simd/{name}.py" for name in ("__init__", "types", "memory", "arithmetic", "shuffle")}
    assert simd | {"images/check.py"} <= sources  # imported by these
    assert not sources & {"matching.py", "calibration.py", "cli/match.py", "result.py"}


HELPER = "from stereokit.kernels.jit import inline\n@inline\ndef times(x):\n    return {} * x\n"
KERNEL = "\n@kernel\ndef made(x):\n    return FACTOR * times(x)\n"
CALL = "from {} import made; print(made(7), made.__qualname__)"


@pytest.mark.parametrize(
    ("name", "imports"),
    [
        ("others/kernels.py", "from others.constants import FACTOR\nfrom others.helpers import times"),
        ("others/kernels.py", "from .constants import FACTOR\nfrom .helpers import times"),
        (
            "others/inner/kernels.py",
            "from ..constants import FACTOR\nfrom others import helpers as h\ntimes = h.times",
        ),
        (
            "others/kernels.py",
            "import others.constants as c\nimport os, others.helpers as h\nFACTOR = c.FACTOR; times = h.times",
        ),
        ("mine.py", "from constants import FACTOR\nfrom helpers import times"),
    ],
)
def test_kernels_of_others_change_with_their_helpers_and_constants(name, imports, tmp_path):
    """Numba looks at the file of the kernel itself; what is compiled into it may stand in others."""
    path = tmp_path / name
    package = tmp_path / "others" if "/" in name else tmp_path
    path.parent.mkdir(parents=True, exist_ok=True)
    if "/" in name:
        for folder in {package, path.parent}:
            (folder / "__init__.py").write_text("")
        (package / ".#kernels.py").symlink_to("nobody@host:1")  # an editor's lock file
    path.write_text(f"from stereokit.kernels.jit import kernel\n{imports}\n{KERNEL}")
    module = name.removesuffix(".py").replace("/", ".")

    def run(factor, times, unused=0):
        (package / "constants.py").write_text(f"FACTOR = {factor}\n")
        (package / "helpers.py").write_text(HELPER.format(times))
        (package / "unused.py").write_text(f"UNUSED = {unused}\n")
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        call = [sys.executable, "-c", CALL.format(module)]
        return subprocess.run(call, env=environment, capture_output=True, text=True, check=True).stdout.split()

    first = run(3, 2)
    assert first[0] == "42" and run(3, 2, unused=1) == first
    assert run(3, 5)[0] == "105"
    assert run(1, 5)[0] == "35"
