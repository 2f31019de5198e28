"""Before a runtime is trusted with a network its map of a small scene is compared with plain numpy's."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from refining import (
    LEARNED,
    NAMES,
    coarse_of,
    encoded_of,
    image_of,
    random_arrays,
    random_content,
    tuned_to_kitti,
)

from stereokit.errors import StereokitError, StereokitWarning
from stereokit_refiners.learned import LearnedRefiner
from stereokit_refiners.runtimes import choice, reference
from stereokit_refiners.weights import NETWORKS

SIZE = (32, 48)


@pytest.fixture(autouse=True)
def untrusted(monkeypatch):
    """Let no runtime be trusted yet."""
    monkeypatch.setattr(choice, "_sound", {})


@pytest.fixture
def broken(monkeypatch):
    """Return a function that breaks runtimes: their maps are off by two pixels."""
    real = choice._compile

    def of(*names):
        def compile_(content, backend, precision, *rest):
            run = real(content, backend, precision, *rest)
            if backend not in names and f"{backend} {precision}" not in names:
                return run
            # A head counts in steps of 4 pixels.
            return lambda inputs, use=np.array: run(inputs, lambda head: use(head + np.float32(0.5)))

        monkeypatch.setattr(choice, "_compile", compile_)

    return of


def refined(backend="auto", name="cnn", precision="fp32"):
    refiner = LearnedRefiner.of(random_content(name), backend=backend, precision=precision)
    return refiner, refiner(coarse_of(SIZE), image_of(SIZE)).disparity


@pytest.mark.parametrize("name", NAMES)
def test_plain_numpy_is_torchs_network(name):
    torch = pytest.importorskip("torch")
    from stereokit_refiners.runtimes.torch import runner

    inputs, arrays = encoded_of(name, 16, 32), random_arrays(name, last=1.0)
    actual = reference.forward(NETWORKS[name], arrays, inputs)
    expected = runner(NETWORKS[name], arrays)(inputs)
    assert actual.shape == expected.shape and actual.dtype == np.float32 and torch is not None
    np.testing.assert_allclose(actual, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize("precision", ["fp32", "bf16", "int8"])
@pytest.mark.parametrize("name", NAMES)
def test_networks_tuned_to_kitti_pass_with_room(name, precision):
    content = tuned_to_kitti(name)
    for backend in LEARNED if precision == "fp32" else {"openvino"} & set(LEARNED):
        run = choice._compile(content, backend, precision, *reference.input_size(content), 1)
        assert reference.mistake(content, run) < reference.TOLERANCES_PX[precision] / 2


def test_a_sound_runtime_is_checked_once_and_says_nothing(monkeypatch):
    calls = []
    monkeypatch.setattr(choice, "mistake", lambda *arguments: calls.append(arguments) or reference.mistake(*arguments))
    for seed in (0, 1):
        refiner = LearnedRefiner.of(random_content("cnn", seed), precision="fp32")
        refiner(coarse_of(SIZE), image_of(SIZE))
    assert len(calls) == 1


@pytest.mark.skipif(len(LEARNED) < 2, reason="needs two runtimes")
def test_a_wrong_runtime_gives_way_to_another_with_one_warning(broken):
    first, second = LEARNED[:2]
    expected = refined(second)[1]
    choice._sound.clear()
    broken(first)
    rule = (
        rf"^network 'cnn' is run by {second} in fp32, since on this machine {first} in fp32 is off by 2 px on average$"
    )
    with pytest.warns(StereokitWarning, match=rule) as messages:
        refiner, actual = refined(first)
    assert len(messages) == 1
    np.testing.assert_array_equal(actual, expected)
    assert refiner.fingerprint.endswith(f"-{second}-fp32")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(refined(first)[1], expected)


def test_a_wrong_precision_gives_way_to_fp32_of_the_same_runtime(broken):
    pytest.importorskip("openvino")
    expected = refined("openvino")[1]
    broken("openvino bf16")
    with pytest.warns(
        StereokitWarning, match="is run by openvino in fp32, since on this machine openvino in bf16 is off"
    ):
        refiner, actual = refined("openvino", precision="bf16")
    np.testing.assert_array_equal(actual, expected)
    assert refiner.fingerprint.endswith("-openvino-fp32")


def test_if_all_are_wrong_there_is_no_map_but_one_line(broken):
    broken(*LEARNED)
    one = r"\w+ in fp32 is off by 2 px on average"
    rule = rf"^no runtime here computes network 'cnn' rightly: {one}(; {one})*$"
    with pytest.raises(StereokitError, match=rule) as caught:
        refined()
    assert "\n" not in str(caught.value)


def test_not_a_number_is_wrong_too(monkeypatch):
    content = random_content("cnn")
    head = np.full((*reference.SCENE_SIZE, 4), np.nan, np.float32)
    assert reference.mistake(content, lambda inputs, use: use(head)) == np.inf
