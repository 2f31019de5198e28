"""Samples in files: what is stored is read, when it is asked for, and what is no sample is refused in one line."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from refining import one_line
from test_samples import assert_same, pair_of

from stereokit.errors import FileError
from stereokit_refiners.training import samples
from stereokit_refiners.training.samples import SampleFiles, cache_name, load_variant, make_variant, store_variant


@pytest.fixture(scope="module")
def pair():
    return pair_of()


@pytest.fixture(scope="module")
def stored(pair, tmp_path_factory):
    """Return the files of three variants."""
    folder = tmp_path_factory.mktemp("cache")
    return [store_variant(pair, "S2", 0, number, 32, folder) for number in range(3)]


@pytest.fixture
def path(stored, tmp_path):
    """Return a file of a sample that a test may break."""
    target = tmp_path / stored[0].name
    target.write_bytes(stored[0].read_bytes())
    return target


# --- the cache -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [0, 1, 2])
def test_what_is_cached_is_what_was_made(pair, number, tmp_path, monkeypatch):
    folder = tmp_path / "not" / "there"
    subject = load_variant(pair, "S2", 0, number, 32, folder)
    assert_same(subject, load_variant(pair, "S2", 0, number, 32))
    assert [p.name for p in folder.iterdir()] == [cache_name(pair, "S2", 0, number, 32)]
    monkeypatch.setattr(samples, "make_variant", None)  # from here on only the cache can answer
    assert_same(load_variant(pair, "S2", 0, number, 32, folder), subject)


def test_a_variant_is_stored_once_where_its_name_says(pair, tmp_path, monkeypatch):
    path = store_variant(pair, "S2", 0, 0, 32, tmp_path / "cache")
    assert path == tmp_path / "cache" / cache_name(pair, "S2", 0, 0, 32)
    content, time = path.read_bytes(), path.stat().st_mtime_ns
    monkeypatch.setattr(samples, "make_variant", None)
    assert store_variant(pair, "S2", 0, 0, 32, tmp_path / "cache") == path
    assert (path.read_bytes(), path.stat().st_mtime_ns) == (content, time)
    assert list(path.parent.iterdir()) == [path]


def test_a_variant_that_was_interrupted_leaves_nothing(pair, tmp_path, monkeypatch):
    def stopped(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(samples, "make_variant", stopped)
    with pytest.raises(KeyboardInterrupt):
        store_variant(pair, "S2", 0, 0, 32, tmp_path)
    monkeypatch.undo()
    monkeypatch.setattr("os.replace", stopped)
    with pytest.raises(KeyboardInterrupt):
        store_variant(pair, "S2", 0, 0, 32, tmp_path)
    assert not list(tmp_path.iterdir())


def test_names_in_the_cache_say_what_decides(pair, monkeypatch):
    name = cache_name(pair, "S2", 0, 1, 32)
    assert name == cache_name(pair, "s2", 0, 1, 32)
    others = [
        cache_name(pair_of(seed=1), "S2", 0, 1, 32),
        cache_name(pair, "S4", 0, 1, 32),
        cache_name(pair, "S2", 1, 1, 32),
        cache_name(pair, "S2", 0, 2, 32),
        cache_name(pair, "S2", 0, 1, 64),
    ]
    for what in ("FINGERPRINT", "_OWN"):  # the kernels, and the source that makes samples
        monkeypatch.setattr(samples, what, "other")
        others.append(cache_name(pair, "S2", 0, 1, 32))
        monkeypatch.undo()
    assert len({name, *others}) == 8


# --- shelves -------------------------------------------------------------------------------------------------------


def test_a_shelf_reads_what_was_stored(pair, stored):
    shelf = SampleFiles(stored)
    assert len(shelf) == 3
    for number, sample in enumerate(shelf):
        assert_same(sample, make_variant(pair, "S2", 0, number, 32))
    assert_same(shelf[-1], shelf[2])
    for index in (3, -4):
        with pytest.raises(IndexError):
            shelf[index]
    assert len(SampleFiles([])) == 0 and list(SampleFiles([])) == [] and not SampleFiles([])


def test_a_shelf_reads_each_time_and_only_what_is_asked_for(path):
    shelf = SampleFiles([path, path.with_name("none.npz")])
    first = shelf[0]
    assert shelf[0] is not first
    first.left[:] = 0
    assert shelf[0].left.any()
    path.unlink()
    with pytest.raises(FileError):
        shelf[0]


@pytest.mark.parametrize(
    "part", [slice(1, None), slice(None, None, 2), slice(None, None, -1), slice(0, 0), slice(5, 9)], ids=str
)
def test_slices_of_a_shelf_are_shelves(part, stored):
    shelf = SampleFiles(stored)
    actual = shelf[part]
    assert isinstance(actual, SampleFiles)
    assert len(actual) == len(stored[part])
    for sample, path in zip(actual, stored[part], strict=True):
        assert_same(sample, SampleFiles([path])[0])
    assert actual.digest == SampleFiles(stored[part]).digest


def test_a_slice_reads_nothing(tmp_path):
    assert len(SampleFiles([tmp_path / f"{k}.npz" for k in range(9)])[::2]) == 5


def test_a_shelf_keeps_its_own_list(stored):
    paths = list(stored)
    shelf = SampleFiles(paths)
    paths.pop()
    assert len(shelf) == 3


def test_digests_say_which_samples_and_not_where(stored, tmp_path):
    shelf = SampleFiles(stored)
    assert shelf.digest == SampleFiles([tmp_path / path.name for path in stored]).digest
    others = [stored[:2], stored[1:], stored[::-1], [*stored, stored[0]], [stored[0]], []]
    assert len({shelf.digest, *(SampleFiles(paths).digest for paths in others)}) == 7


def test_a_shelf_trains_as_its_samples_do(stored, tmp_path):
    pytest.importorskip("torch")
    from test_training import NETWORKS, fit, settings
    from test_training import assert_same as same_arrays

    from stereokit_refiners.training.loop import Source, calibrated, restored

    network, shelf = NETWORKS["pyramid"], SampleFiles(stored)
    original = list(shelf)
    checkpoint = tmp_path / "checkpoint.pt"
    arrays, history = fit(network, [Source(shelf)], shelf[:1], settings(steps=3), checkpoint=checkpoint)
    expected, other = fit(network, [Source(original)], original[:1], settings(steps=3))
    same_arrays(arrays, expected)
    assert history.rows == other.rows
    module = restored(network, arrays)
    assert calibrated(module, "residual", [Source(shelf)]) == calibrated(module, "residual", [Source(original)])
    again = fit(network, [Source(SampleFiles(stored))], shelf[:1], settings(steps=3), checkpoint=checkpoint)
    same_arrays(again[0], arrays)
    with pytest.raises(ValueError, match="checkpoint"):
        fit(network, [Source(shelf[:2])], shelf[:1], settings(steps=3), checkpoint=checkpoint)


# --- what is refused -----------------------------------------------------------------------------------------------


def refused(path):
    with pytest.raises(FileError) as caught:
        SampleFiles([path])[0]
    text = one_line(caught.value)
    assert text.startswith("cache must hold samples of this program, got ") and repr(str(path)) in text, text
    return text


def test_a_missing_file(tmp_path):
    with pytest.raises(FileError, match=r"no such file: .*none.npz"):
        SampleFiles([tmp_path / "none.npz"])[0]
    with pytest.raises(FileError, match="cannot read"):
        SampleFiles([tmp_path])[0]


@pytest.mark.parametrize(
    "content",
    [
        b"just text",
        b"PK\x03\x04 cut",
        b"\x00" * 4096,
        b"\x80\x04N.",
        b"",
    ],
)
def test_a_file_that_holds_no_sample(path, content):
    path.write_bytes(content)
    refused(path)


@pytest.mark.parametrize("keep", [0.01, 0.3, 0.7, 0.999])
def test_a_cut_file(path, keep):
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep)])
    refused(path)


@pytest.mark.parametrize("at", [0.1, 0.3, 0.5, 0.7])
def test_a_file_with_a_wrong_bit(path, at):
    content = bytearray(path.read_bytes())
    content[int(len(content) * at)] ^= 1
    path.write_bytes(content)
    assert "CRC" in refused(path)


@pytest.mark.parametrize("missing", ["confidence", "candidates"])
def test_a_sample_of_an_older_version(path, missing):
    sample = vars(SampleFiles([path])[0])
    np.savez(path, allow_pickle=False, **{k: np.asarray(v) for k, v in sample.items() if k != missing})
    assert missing in refused(path)


def test_a_sample_never_runs_code(path):
    sample = vars(SampleFiles([path])[0])
    np.savez(path, **{**sample, "left": np.array([{}], object)})
    assert "pickle" in refused(path)


def test_fields_are_all_there(pair, stored):
    assert {f.name for f in dataclasses.fields(SampleFiles(stored)[0])} == set(np.load(stored[0]).files)
