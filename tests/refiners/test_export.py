"""``stereokit export``: what is written runs elsewhere and says what the refiner says; bad input writes nothing."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from refining import (
    NAMES,
    coarse_of,
    flat_ranges,
    half_of,
    image_of,
    network_map,
    random_content,
    tuned_to_kitti,
    weight_file,
)
from typer.testing import CliRunner

from stereokit import Disparity
from stereokit.cli.app import app
from stereokit_refiners.commands import export as module
from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.weights import NETWORKS

for _package in ("safetensors", "onnx", "onnxruntime"):
    pytest.importorskip(_package)

FORMS = [(name, "residual") for name in NAMES] + [("stereovae", "direct"), ("cnn", "direct")]
SIZES = [(32, 48), (16, 16), (64, 32)]


def run(*arguments):
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


def failed(result, *parts):
    """Check that a command ended with 2 and one line, which holds `parts`."""
    assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
    lines = [line for line in result.output.splitlines() if line.strip()]
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    for part in parts:
        assert part in lines[0], lines[0]


def feeds(content, size):
    coarse, left = coarse_of(size, 4), image_of(size, 4)
    case = {"coarse": coarse.disparity, "left": left.astype(np.float32), "confidence": coarse.confidence}
    case["candidates"] = coarse.candidates
    for name in {"confidence", "candidates"} - NETWORKS[content.network].inputs.keys():
        del case[name]
    refined = network_map(LearnedRefiner.of(content, precision="fp32"), coarse, left)
    return {name: array.reshape(1, -1, *array.shape[-2:]) for name, array in case.items()}, refined


@pytest.mark.parametrize(("name", "mode"), FORMS)
def test_onnx_files_are_the_refiner_at_any_size(name, mode, tmp_path):
    import onnx
    import onnxruntime

    weights, out = weight_file(tmp_path, name, output_mode=mode), tmp_path / "model.onnx"
    result = run("-o", out, "--refiner", weights)
    assert result.exit_code == 0, result.output
    onnx.checker.check_model(onnx.load(out), full_check=True)
    session = onnxruntime.InferenceSession(out, providers=["CPUExecutionProvider"])
    for size in SIZES:
        case, refined = feeds(random_content(name, output_mode=mode), size)
        (actual,) = session.run(["disparity"], case)
        assert actual.shape == (1, 1, *size)
        np.testing.assert_allclose(actual[0, 0], refined, rtol=0, atol=module.TOLERANCE_PX)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["model.onnx", weights.rpartition("/")[2]])


@pytest.mark.parametrize("name", NAMES)
def test_openvino_files_are_the_refiner_at_any_size(name, tmp_path):
    ov = pytest.importorskip("openvino")
    weights, out = weight_file(tmp_path, name), tmp_path / "model.xml"
    result = run("-o", out, "--refiner", weights, "--format", "openvino")
    assert result.exit_code == 0, result.output
    original = sorted(p.name for p in tmp_path.iterdir())
    assert original == sorted(["model.xml", "model.bin", weights.rpartition("/")[2]])
    core = ov.Core()
    compiled = core.compile_model(core.read_model(out), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    for size in SIZES[:2]:
        case, refined = feeds(random_content(name), size)
        actual = compiled(case)["disparity"]
        assert actual.shape == (1, 1, *size)
        np.testing.assert_allclose(actual[0, 0], refined, rtol=0, atol=module.TOLERANCE_PX)


def test_the_report(tmp_path):
    weights, out, report = weight_file(tmp_path, "cnn"), tmp_path / "m.onnx", tmp_path / "r.json"
    result = run("-o", out, "--refiner", weights, "--json", report)
    assert result.exit_code == 0, result.output
    assert str(out) in result.output.replace("\n", "")
    document = json.loads(report.read_text())
    assert set(document) == {"output", "format", "network", "output_mode", "weights", "largest_difference_px"}
    assert (document["network"], document["output_mode"], document["format"]) == ("cnn", "residual", "onnx")
    assert document["weights"] == random_content("cnn").fingerprint
    assert 0 <= document["largest_difference_px"] <= module.TOLERANCE_PX
    printed = run("-o", out, "--refiner", weights, "--json", "-")
    assert json.loads(printed.output) == document


def test_a_calibrated_file_is_exported_in_full_precision(tmp_path):
    """What leaves is float32, compared with the refiner in fp32, even where int8 would be chosen."""
    weights = weight_file(tmp_path, "cnn", ranges=flat_ranges("cnn", 4))
    result = run("-o", tmp_path / "m.onnx", "--refiner", weights)
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("name", NAMES)
def test_refiners_are_exported_by_name(name, tmp_path):
    tuned_to_kitti(name)
    assert run("-o", tmp_path / "m.onnx", "--refiner", name, "--weights", "kitti").exit_code == 0


@pytest.mark.parametrize("name", ["general", "stereokit", "evidence"])
def test_the_general_refiner_is_refused_in_one_line_that_says_why(name, tmp_path):
    failed(run("-o", tmp_path / "m.onnx", "--refiner", name), "got 'evidence'", "compiled loops")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("case", "parts"),
    [
        (["-o", "m.txt"], ["output must end in .onnx", "m.txt"]),
        (["-o", "m.onnx", "--format", "openvino"], ["output must end in .xml", "m.onnx"]),
        (["-o", "m.xml"], ["output must end in .onnx"]),
        (["-o", "m.trt", "--format", "tensorrt"], ["format must be one of onnx, openvino", "'tensorrt'"]),
        (["-o", "nowhere/m.onnx"], ["output must name a file in an existing folder", "nowhere"]),
        (["-o", "folder.onnx"], ["output must name a file in an existing folder"]),
        (["-o", "m.onnx", "--refiner", "none.safetensors"], ["weights must name a file", "none.safetensors"]),
        (["-o", "m.onnx", "--refiner", "text.safetensors"], ["weights must be a safetensors file"]),
        (["-o", "m.onnx", "--refiner", "linear"], ["must be one of stereovae, cnn, pyramid", "'linear'"]),
        (["-o", "m.onnx", "--refiner", "cnn-0.safetensors", "--json", "nowhere/r.json"], ["--json"]),
        (["-o", "m.onnx", "--refiner", "cnn-0.safetensors", "--json", "folder.onnx"], ["--json"]),
    ],
    ids=lambda value: " ".join(value) if value and value[0] == "-o" else "",
)
def test_bad_input_ends_with_one_line_and_writes_nothing(case, parts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    weight_file(tmp_path, "cnn")
    (tmp_path / "folder.onnx").mkdir()
    (tmp_path / "text.safetensors").write_text("no weights")
    before = sorted(tmp_path.rglob("*"))
    if "--refiner" not in case:
        case = [*case, "--refiner", "cnn-0.safetensors"]
    failed(run(*case), *parts)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_graph_that_is_not_the_refiner_is_not_written(tmp_path, monkeypatch):
    wrong = random_content("cnn", seed=5, last=0.5)
    real = module.onnx_model
    monkeypatch.setattr(module, "onnx_model", lambda content: real(wrong))
    out = tmp_path / "m.onnx"
    failed(
        run("-o", out, "--refiner", weight_file(tmp_path, "cnn")), "differs from the refiner by", "nothing was written"
    )
    assert not out.exists()


def with_swapped_candidates(content):
    first = content.arrays["head.weight"].shape[0] - 8  # the logits of the two candidates are the last, four each
    for array in (content.arrays["head.weight"], content.arrays["head.bias"]):
        array[first:] = np.concatenate([array[first + 4 :], array[first : first + 4]])


def with_unseen_candidates(content):
    content.arrays["stem.weight"][:, -2:] = 0


@pytest.mark.parametrize("flaw", [with_swapped_candidates, with_unseen_candidates])
def test_a_graph_that_takes_the_candidates_for_others_is_not_written(flaw, tmp_path, monkeypatch):
    """The check's own candidates are far from each other, so that such a mistake is no matter of rounding."""
    wrong, real, out = random_content("pyramid"), module.onnx_model, tmp_path / "m.onnx"
    flaw(wrong)
    assert module.largest_difference(random_content("pyramid"), real(wrong)) > 50 * module.TOLERANCE_PX
    monkeypatch.setattr(module, "onnx_model", lambda content: real(wrong))
    failed(run("-o", out, "--refiner", weight_file(tmp_path, "pyramid")), "differs from the refiner by")
    assert not out.exists()


@pytest.mark.parametrize("name", NAMES)
def test_graphs_ask_for_what_their_network_looks_at(name):
    import onnx

    channels = {"coarse": 1, "left": 1, "confidence": 1, "candidates": 2}
    for evidence in {"confidence", "candidates"} - NETWORKS[name].inputs.keys():
        del channels[evidence]
    graph = onnx.load_from_string(module.onnx_model(random_content(name))).graph
    sizes = {i.name: [d.dim_value or d.dim_param for d in i.type.tensor_type.shape.dim] for i in graph.input}
    large = {"left": ["2h", "2w"]}
    assert sizes == {key: [1, count, *large.get(key, ["h", "w"])] for key, count in channels.items()}


def test_a_graph_that_computes_nan_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "largest_difference", lambda content, model: float("nan"))
    out = tmp_path / "m.onnx"
    failed(run("-o", out, "--refiner", weight_file(tmp_path, "cnn")), "nothing was written")
    assert not out.exists()


@pytest.mark.parametrize("format", ["onnx", "openvino"])
def test_nothing_half_written_stays(format, tmp_path, monkeypatch):
    if format == "openvino":
        pytest.importorskip("openvino")
    ending = {"onnx": ".onnx", "openvino": ".xml"}[format]
    weights, out = weight_file(tmp_path, "cnn"), tmp_path / f"m{ending}"
    out.write_text("what was there before")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    real = module.os.replace

    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    failed(run("-o", out, "--refiner", weights, "--format", format), "cannot write", "No space left on device")
    monkeypatch.setattr("os.replace", real)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_an_interrupted_openvino_export_leaves_no_half(tmp_path, monkeypatch):
    """Killed between its two files: the .xml, which is written last, is missing or the old one."""
    pytest.importorskip("openvino")
    weights, out = weight_file(tmp_path, "cnn"), tmp_path / "m.xml"
    real, moved = module.os.replace, []

    def replace(source, target):
        if moved:
            raise OSError(5, "Input/output error")
        moved.append(str(target))
        real(source, target)

    monkeypatch.setattr("os.replace", replace)
    failed(run("-o", out, "--refiner", weights, "--format", "openvino"), "cannot write")
    assert moved == [str(tmp_path / "m.bin")]
    assert not out.exists()


@pytest.mark.parametrize("missing", ["onnxruntime", "openvino"])
def test_packages_that_are_missing_are_named(missing, tmp_path, monkeypatch):
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n == missing else real(n, *a))
    out = tmp_path / "m.xml"
    failed(run("-o", out, "--refiner", weight_file(tmp_path, "cnn"), "--format", "openvino"), f"export needs {missing}")
    assert not out.exists()


def test_the_difference_is_that_of_the_maps():
    content = random_content("cnn")
    model = module.onnx_model(content)
    assert module.largest_difference(content, model) < module.TOLERANCE_PX
    assert module.largest_difference(random_content("cnn", seed=1), model) > module.TOLERANCE_PX


def test_exported_graphs_take_maps_without_gaps_only_as_documented():
    """The pyramid sees the confidence: another confidence is another map."""
    import onnxruntime

    content = random_content("pyramid")
    session = onnxruntime.InferenceSession(module.onnx_model(content), providers=["CPUExecutionProvider"])
    size = (32, 32)
    coarse, left = coarse_of(size), image_of(size)
    maps = []
    for level in (1, 0.4, 0):
        confidence = np.full(half_of(size), level, np.float32)
        case = {"coarse": coarse.disparity, "confidence": confidence, "left": left.astype(np.float32)}
        case["candidates"] = coarse.candidates
        maps.append(session.run(None, {k: v.reshape(1, -1, *v.shape[-2:]) for k, v in case.items()})[0][0, 0])
        seen = Disparity(coarse.disparity, confidence > 0, confidence, candidates=coarse.candidates)
        refined = network_map(LearnedRefiner.of(content, precision="fp32"), seen, left)
        np.testing.assert_allclose(maps[-1], refined, rtol=0, atol=module.TOLERANCE_PX)
    for one, other in itertools.combinations(maps, 2):
        assert np.abs(one - other).max() > 0.01
