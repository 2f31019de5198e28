"""Refining with the base package alone: graphs written without the package onnx, run by OpenCV."""

from __future__ import annotations

import textwrap
import threading

import cv2
import numpy as np
import pytest
from refining import NAMES, coarse_of, image_of, random_content

from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.runtimes import opencv
from stereokit_refiners.runtimes.onnx import head_graph, map_graph
from stereokit_refiners.runtimes.onnx_file import Node, model_bytes
from stereokit_refiners.weights import NETWORKS, shipped

BASE_ONLY = """
    import sys, warnings

    for name in ("openvino", "onnxruntime", "torch", "onnx"):
        sys.modules[name] = None
    import importlib.util

    real = importlib.util.find_spec
    importlib.util.find_spec = lambda name, *rest: None if sys.modules.get(name, 0) is None else real(name, *rest)
    warnings.simplefilter("error")
    import cv2, numpy as np, stereokit

    left = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (96, 160), dtype=np.uint8), (0, 0), 1.5)
    right = np.roll(left, -6, axis=1)
    matcher = stereokit.Matcher("S2", max_disparity=32, scale=0.5, refiner="stereokit", threads=1)
    before = cv2.getNumThreads()
    found = matcher(left, right).disparity
    assert matcher.refine.backend == "opencv" and cv2.getNumThreads() == before
    assert np.abs(np.median(found[:, 20:]) - 6) < 0.1 and found.shape == left.shape
    print("refined")
"""


def test_the_base_package_alone_refines(run_python):
    assert run_python("-c", textwrap.dedent(BASE_ONLY)).strip() == "refined"


@pytest.mark.parametrize("name", [*NAMES, "evidence"])
def test_graphs_are_valid_onnx(name):
    onnx = pytest.importorskip("onnx")
    content = shipped(name) if name == "evidence" else random_content(name)
    network = NETWORKS[name]
    for size in ((None, None), (16, 24)):
        model = onnx.load_from_string(head_graph(network, content.arrays, *size))
        onnx.checker.check_model(model, full_check=True)
        assert [value.name for value in model.graph.input] == list(network.inputs)
    if "disparity" in network.inputs:
        onnx.checker.check_model(onnx.load_from_string(map_graph(network, content.arrays, "residual")), full_check=True)


def test_every_kind_of_value_is_written_as_onnx_reads_it():
    onnx = pytest.importorskip("onnx")
    arrays = {
        "floats": np.array([[1.5, -2, np.inf]], np.float32),
        "wholes": np.array([-(2**62), -1, 0, 300, 2**31], np.int64),
        "empty": np.zeros((0, 3), np.float32),
        "scalar": np.float32(7)[()] * np.ones((), np.float32),
        "view": np.arange(12, dtype=np.float32).reshape(3, 4)[:, ::2],
    }
    attributes = {"whole": -3, "float": 0.1, "text": "linear", "wholes": [0, 127, 128, -1], "none": []}
    node = Node("Op", ["a", ""], ["b"], attributes)
    model = onnx.load_from_string(model_bytes([node], arrays, {"a": [1, "h", None]}, {"b": [300]}))
    assert model.ir_version == 9 and [o.version for o in model.opset_import] == [18]
    for tensor in model.graph.initializer:
        np.testing.assert_array_equal(onnx.numpy_helper.to_array(tensor), arrays[tensor.name])
    (read,) = model.graph.node
    assert (read.op_type, list(read.input), list(read.output)) == ("Op", ["a", ""], ["b"])
    actual = {a.name: onnx.helper.get_attribute_value(a) for a in read.attribute}
    assert actual["whole"] == -3 and actual["float"] == pytest.approx(0.1) and actual["text"] == b"linear"
    assert list(actual["wholes"]) == [0, 127, 128, -1] and list(actual["none"]) == []
    dims = model.graph.input[0].type.tensor_type.shape.dim
    assert [d.WhichOneof("value") for d in dims] == ["dim_value", "dim_param", None] and dims[1].dim_param == "h"
    assert model.graph.output[0].type.tensor_type.shape.dim[0].dim_value == 300


def test_opencvs_threads_are_put_back_also_after_an_error():
    before = cv2.getNumThreads()
    other = before + 1
    try:
        for count in (1, other):
            with opencv.opencv_threads(count):
                assert cv2.getNumThreads() == count
                with opencv.opencv_threads(3):  # the first of those under way decides
                    assert cv2.getNumThreads() == count
                assert cv2.getNumThreads() == count
            assert cv2.getNumThreads() == before
        with pytest.raises(RuntimeError), opencv.opencv_threads(other):
            raise RuntimeError
        assert cv2.getNumThreads() == before
    finally:
        cv2.setNumThreads(before)


def test_calls_side_by_side_give_the_same_bits_and_leave_the_threads_alone():
    size, before = (45, 70), cv2.getNumThreads()
    refiner = LearnedRefiner.of(random_content("pyramid", last=0.5), backend="opencv")
    cases = [(coarse_of(size, seed), image_of(size, seed)) for seed in range(4)]
    expected = [refiner(*case).disparity for case in cases]
    actual: list[object] = [None] * len(cases)

    def work(k):
        actual[k] = [refiner(*cases[k], threads=1 + k % 2).disparity for _ in range(3)]

    workers = [threading.Thread(target=work, args=(k,)) for k in range(len(cases))]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for maps, one in zip(actual, expected, strict=True):
        for other in maps:
            np.testing.assert_array_equal(other, one)
    assert cv2.getNumThreads() == before
