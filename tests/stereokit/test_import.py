"""What importing the library does: nothing but what it needs."""

from __future__ import annotations

import json

import pytest

import stereokit


def test_importing_loads_neither_torch_nor_cuda_nor_skimage(run_python):
    names = json.loads(run_python("-c", "import json, sys, stereokit; print(json.dumps(sorted(sys.modules)))"))
    heavy = ("torch", "skimage", "numba.cuda", "stereokit_refiners", "stereokit_evaluation")
    assert "numpy" in names
    loaded = [name for name in names if any(name == h or name.startswith(h + ".") for h in heavy)]
    assert not loaded


def test_importing_is_silent_and_starts_nothing(run_python):
    code = (
        "import threading, numpy, random, warnings\n"
        "warnings.simplefilter('error')\n"
        "before = numpy.random.get_state()[1].tolist(), random.getstate(), numpy.geterr()\n"
        "import stereokit\n"
        "assert threading.active_count() == 1\n"
        "assert before == (numpy.random.get_state()[1].tolist(), random.getstate(), numpy.geterr())\n"
    )
    assert run_python("-c", code) == ""


def test_matching_needs_no_other_package(run_python):
    code = (
        "import sys, numpy, stereokit\n"
        "image = numpy.arange(300, dtype=numpy.uint8).reshape(15, 20)\n"
        "stereokit.match(image, image, 'census+sgm', max_disparity=16)\n"
        "assert not {'torch', 'skimage', 'stereokit_refiners', 'stereokit_evaluation'} & set(sys.modules)\n"
    )
    run_python("-c", code)


@pytest.mark.parametrize("name", stereokit.__all__)
def test_every_public_name_exists(name):
    assert getattr(stereokit, name) is not None
    assert name == "__version__" or not name.startswith("_")


def test_public_names_are_sorted_and_told_apart():
    assert len(set(stereokit.__all__)) == len(stereokit.__all__)
    assert {"match", "Matcher", "Disparity", "Calibration", "warmup"} <= set(stereokit.__all__)
