"""Weight files: what is written is read, what is not such a file is refused in one line, and nothing is run."""

from __future__ import annotations

import json
import os
import pickle

import numpy as np
import pytest
from refining import NAMES, one_line, random_arrays, random_content, tuned_to_kitti

import stereokit
from stereokit.errors import FileError, OptionError, StereokitError
from stereokit_refiners import weights
from stereokit_refiners.weights import NETWORKS, WeightFile, collection_file, find, network_named, read, shipped, write

safetensors_numpy = pytest.importorskip("safetensors.numpy")

METADATA = {"format": "stereokit-refiner/2", "network": "cnn", "output_mode": "residual", "ranges": "{}", "notes": "{}"}


def raw(path, arrays=None, **metadata):
    """Write a safetensors file as anybody could."""
    arrays = random_arrays("cnn") if arrays is None else arrays
    path.write_bytes(safetensors_numpy.save(arrays, metadata={**METADATA, **metadata}))
    return path


def refused(path, *parts):
    with pytest.raises(FileError) as caught:
        read(path)
    text = one_line(caught.value)
    for part in parts:
        assert part in text, text


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_is_read(name, tmp_path):
    ranges = {NETWORKS[name].layers[0].name: [2.5, *range(NETWORKS[name].layers[0].outputs - 1)]}
    ranges = {key: [float(bound) for bound in bounds] for key, bounds in ranges.items()}
    content = WeightFile(name, "residual", random_arrays(name), ranges, {"seed": 3, "words": ["a", None]})
    path = tmp_path / "w.safetensors"
    write(path, content)
    actual = read(path)
    assert (actual.network, actual.output_mode) == (name, "residual")
    assert actual.ranges == ranges
    assert actual.notes == {"seed": 3, "words": ["a", None]}
    assert set(actual.arrays) == set(content.arrays)
    for key, array in content.arrays.items():
        np.testing.assert_array_equal(actual.arrays[key], array)
    assert actual.fingerprint == content.fingerprint
    assert [p.name for p in tmp_path.iterdir()] == ["w.safetensors"]
    assert path.stat().st_size < 1_000_000


def test_the_same_content_has_the_same_fingerprint(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / name, random_content("cnn"))
    assert read(tmp_path / "a").fingerprint == read(tmp_path / "b").fingerprint


def test_a_missing_file(tmp_path):
    refused(tmp_path / "no.safetensors", "weights must name a file", "no.safetensors", "not there")
    refused(tmp_path, "weights must name a file")


@pytest.mark.parametrize("content", [b"", b"just text, no weights", b"\xff" * 64, b"\x00" * 4096])
def test_a_file_that_is_no_safetensors(tmp_path, content):
    path = tmp_path / "text.safetensors"
    path.write_bytes(content)
    refused(path, "weights must be a safetensors file", "text.safetensors")


def test_a_cut_file(tmp_path):
    path = raw(tmp_path / "cut.safetensors")
    path.write_bytes(path.read_bytes()[:-100])
    refused(path, "weights must be a safetensors file")


class _Bomb:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (self.target,)


def test_loading_never_runs_code(tmp_path):
    target = tmp_path / "exploded"
    path = tmp_path / "bomb.safetensors"
    path.write_bytes(pickle.dumps(_Bomb(str(target))))
    refused(path, "weights must be a safetensors file")
    assert not target.exists()
    torch = pytest.importorskip("torch")
    torch.save({"weights": _Bomb(str(target))}, path)
    refused(path, "weights must be a safetensors file")
    assert not target.exists()


@pytest.mark.parametrize(
    ("metadata", "parts"),
    [
        ({"format": "stereokit-refiner/3"}, ["stereokit-refiner/2", "stereokit-refiner/3"]),
        ({"format": ""}, ["format"]),
        ({"network": "resnet"}, ["no network named 'resnet'", "cnn, evidence, pyramid, stereovae"]),
        ({"network": ""}, ["no network named ''"]),
        ({"network": "stereovae"}, ["weights must be those of 'stereovae'", "lacks 'D_1.bias'"]),
        ({"output_mode": "printed"}, ["must be one of residual, direct", "'printed'"]),
        ({"output_mode": ""}, ["must be one of residual, direct", "''"]),
        ({"ranges": "not json"}, ["ranges and notes as JSON"]),
        ({"ranges": "[1, 2]"}, ["ranges and notes as JSON"]),
        ({"ranges": '{"FE_1": "wide"}'}, ["ranges and notes as JSON"]),
        ({"ranges": '{"FE_1": null}'}, ["ranges and notes as JSON"]),
        ({"ranges": '{"FE_1": 2.5}'}, ["ranges and notes as JSON"]),
        ({"ranges": '{"FE_1": ["wide"]}'}, ["ranges and notes as JSON"]),
        ({"notes": "7"}, ["ranges and notes as JSON"]),
        ({"notes": '{"disparities": 128}'}, ["disparities", "two numbers", "128"]),
        ({"notes": '{"disparities": [64, 0]}'}, ["disparities", "[64, 0]"]),
        ({"notes": '{"disparities": [0, "far"]}'}, ["disparities", "far"]),
        ({"notes": '{"disparities": [0, NaN]}'}, ["disparities", "nan"]),
    ],
)
def test_wrong_metadata(tmp_path, metadata, parts):
    refused(raw(tmp_path / "w.safetensors", **metadata), *parts)


@pytest.mark.parametrize("name", NAMES)
def test_weights_of_format_1_are_refused(name, tmp_path):
    """They fit by their shapes, but saw a mask where the network now sees the confidence."""
    path = raw(tmp_path / "old.safetensors", random_arrays(name), network=name, format="stereokit-refiner/1")
    with pytest.raises(FileError) as caught:
        read(path)
    expected = "weights must have the format 'stereokit-refiner/2', got 'stereokit-refiner/1'"
    assert one_line(caught.value) == f"{expected} in {str(path)!r}"
    with pytest.raises(FileError, match=expected):
        stereokit.Matcher("S2", scale=0.5, refiner=str(path))


@pytest.mark.parametrize("bounds", [[np.nan] * 32, [np.inf] * 32, [-1.0] * 32, [1.0] * 31, [], [1.0] * 33])
def test_ranges_that_are_no_ranges(tmp_path, bounds):
    """Not a number, negative, or not one for each of the 32 channels."""
    refused(raw(tmp_path / "w.safetensors", ranges=json.dumps({"FE_1": bounds})), "FE_1")


def test_ranges_of_no_activation(tmp_path):
    refused(raw(tmp_path / "w.safetensors", ranges='{"FE_9": [1.0]}'), "FE_9")


def test_a_file_without_metadata(tmp_path):
    path = tmp_path / "w.safetensors"
    path.write_bytes(safetensors_numpy.save(random_arrays("cnn")))
    refused(path, "weights must have the format 'stereokit-refiner/2', got None")


def test_wrong_arrays(tmp_path):
    path = tmp_path / "w.safetensors"
    good = random_arrays("cnn")
    refused(raw(path, {k: v for k, v in good.items() if k != "EN_1.bias"}), "'cnn'", "lacks 'EN_1.bias'")
    refused(raw(path, {**good, "more": np.zeros(3, np.float32)}), "'cnn'", "unknown 'more'")
    wrong = {**good, "EN_1.weight": np.ascontiguousarray(good["EN_1.weight"][:, :, :3, :3])}
    refused(raw(path, wrong), "'EN_1.weight' as float32 (16, 64, 5, 5)", "float32 (16, 64, 3, 3)")
    refused(raw(path, {**good, "Y.bias": good["Y.bias"].astype(np.float64)}), "'Y.bias'", "float64")
    for bad in (np.nan, np.inf, -np.inf):
        spoiled = good["D.bias"].copy()
        spoiled[3] = bad
        refused(raw(path, {**good, "D.bias": spoiled}), "weights must be finite", "'D.bias'")


def test_nothing_wrong_is_written(tmp_path):
    path = tmp_path / "w.safetensors"
    content = random_content("cnn")
    for arrays in (
        {},
        {k: v for k, v in content.arrays.items() if k != "Y.bias"},
        {**content.arrays, "Y.bias": np.full(1, np.nan, np.float32)},
    ):
        with pytest.raises(FileError) as caught:
            write(path, WeightFile("cnn", "residual", arrays))
        one_line(caught.value)
    with pytest.raises(FileError, match="no network named 'resnet'"):
        write(path, WeightFile("resnet", "residual", content.arrays))
    with pytest.raises(FileError, match="does not exist"):
        write(tmp_path / "nowhere" / "w.safetensors", content)
    assert not list(tmp_path.iterdir())


def test_an_output_mode_that_does_not_exist_is_not_written(tmp_path):
    with pytest.raises(StereokitError, match="output_mode"):
        write(tmp_path / "w.safetensors", WeightFile("cnn", "printed", random_arrays("cnn")))
    assert not list(tmp_path.iterdir())


def test_the_pyramid_has_no_direct_mode(tmp_path):
    """Its head has 65 channels, of which the direct rule would take the first four for the map."""
    with pytest.raises(StereokitError, match="direct"):
        write(tmp_path / "w.safetensors", random_content("pyramid", output_mode="direct"))


def test_a_file_that_stands_stays_when_writing_fails(tmp_path):
    path = tmp_path / "w.safetensors"
    write(path, random_content("cnn"))
    original = path.read_bytes()
    with pytest.raises(FileError):
        write(path, WeightFile("cnn", "residual", {}))
    assert path.read_bytes() == original


def test_files_that_call_the_output_mode_a_form_are_read(tmp_path):
    for form, mode in (("residual", "residual"), ("literal", "direct")):
        path = tmp_path / f"{form}.safetensors"
        metadata = {k: v for k, v in METADATA.items() if k != "output_mode"}
        path.write_bytes(safetensors_numpy.save(random_arrays("cnn"), metadata={**metadata, "form": form}))
        assert read(path).output_mode == mode


def test_architectures_by_name():
    assert list(NETWORKS) == ["stereovae", "cnn", "pyramid", "evidence"]
    assert network_named("cnn") is NETWORKS["cnn"]
    with pytest.raises(FileError, match=r"^no network named 'stereovea'; did you mean 'stereovae'\?"):
        network_named("stereovea")


@pytest.mark.parametrize("name", ["evidence", "cnn", "stereovae"])
def test_networks_that_come_with_weights_saw_no_frame_of_a_data_set(name):
    content = find(name, None)
    assert content.network == name and content.ranges and content.notes.get("frames", []) == []


def test_networks_that_come_without_weights_say_where_there_are_some():
    name = "pyramid"
    with pytest.raises(FileError) as caught:
        find(name, None)
    line = one_line(caught.value)
    for part in (
        f"refiner {name!r} needs weights",
        "pip install ./refiners/kitti",
        f"stereokit train --refiner {name}",
    ):
        assert part in line


def test_collections_are_found_by_name(tmp_path, monkeypatch):
    content = tuned_to_kitti("cnn")
    assert content.fingerprint == read(collection_file("kitti", "cnn")).fingerprint
    with pytest.raises(
        FileError, match=r"^weights 'kitti' are of cnn, evidence, pyramid, stereovae, got refiner 'file'$"
    ):
        find("", "kitti")
    with pytest.raises(FileError, match=r"^no weights named 'kity'; did you mean 'kitti'\?"):
        find("cnn", "kity")
    write(tmp_path / "kitti", content)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OptionError, match="must be its own"):  # the file of that name, in the folder at hand
        find("stereovae", "kitti")


def test_a_collection_says_of_which_networks_it_is(tmp_path, monkeypatch):
    tuned_to_kitti("cnn")
    for name in ("cnn", "pyramid"):
        write(tmp_path / f"{name}.safetensors", random_content(name))
    monkeypatch.setattr(weights, "files", lambda package: tmp_path)
    assert find("pyramid", "kitti").network == "pyramid"
    with pytest.raises(FileError, match=r"^weights 'kitti' are of cnn, pyramid, got refiner 'evidence'$"):
        find("evidence", "kitti")


@pytest.mark.parametrize("name", ["cnn", "evidence"])
def test_a_collection_that_is_not_installed_says_how_to_install_it_and_under_which_terms(name, monkeypatch):
    monkeypatch.setattr(weights, "entry_points", lambda group: ())
    with pytest.raises(FileError) as caught:
        find(name, "kitti")
    line = one_line(caught.value)
    assert "CC BY-NC-SA 3.0" in line and "pip install ./refiners/kitti" in line


@pytest.mark.parametrize(
    ("name", "tuned"),
    [(name, tuned) for name in ("evidence", *NAMES) for tuned in (False, True) if tuned or name != "pyramid"],
)
def test_weights_that_are_published(name, tuned):
    content = tuned_to_kitti(name) if tuned else shipped(name)
    assert tuned == any("kitti" in frame for frame in content.notes.get("frames", ()))
    assert content.network == name
    assert content.ranges, "int8 needs them"
    assert content.notes
    json.dumps(content.notes)


def test_shipped_weights_are_small():
    from importlib.resources import files

    folder = files("stereokit_refiners") / "weights"
    for path in folder.iterdir():
        if path.name.endswith(".safetensors"):
            assert len(path.read_bytes()) < 1_000_000
            read(str(path))
