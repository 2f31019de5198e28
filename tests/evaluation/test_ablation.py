"""The ablation of the general refiner: what is taken away has no influence on exported weights, and runs resume."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

import stereokit  # noqa: E402
from stereokit.errors import FileError, OptionError  # noqa: E402
from stereokit_evaluation.commands import ablation as command  # noqa: E402
from stereokit_evaluation.common.scripts import exit_status  # noqa: E402
from stereokit_evaluation.data.frame import Frame  # noqa: E402
from stereokit_evaluation.training import ablation, domains  # noqa: E402
from stereokit_evaluation.training.ablation import VARIANTS, Variant, absolute_input, trained  # noqa: E402
from stereokit_refiners.learned import LearnedRefiner  # noqa: E402
from stereokit_refiners.networks.evidence import CHANNELS, Evidence  # noqa: E402
from stereokit_refiners.networks.layers import Layer  # noqa: E402
from stereokit_refiners.runtimes.evidence import Hypotheses, hypotheses  # noqa: E402
from stereokit_refiners.runtimes.features import network_input  # noqa: E402
from stereokit_refiners.runtimes.mixture import mixture  # noqa: E402
from stereokit_refiners.runtimes.torch import runner  # noqa: E402
from stereokit_refiners.training import evidence  # noqa: E402
from stereokit_refiners.weights import read, shipped, write  # noqa: E402

SIZE = 8, 8
INPUTS = sum(CHANNELS.values())
UNSEEN = {
    "all": set(),
    "no cost": {*range(40, 44), *range(44, 68)},
    "no surface": set(range(68, 89)),
    "no grey": set(range(16)),
    "no candidates": {*range(32, 40), *range(60, 68), *range(80, 88)},
    "no extremes": {*range(24, 32), *range(52, 60), *range(72, 80)},
    "no less and more": set(range(44, 52)),
    "half width": set(),
    "no relief": set(range(20, 24)),
}
"""Channels of the input, in the order in which `runtimes.features` writes them."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Return weights by variant, after a few steps that would move whatever is not held."""
    folder = tmp_path_factory.mktemp("weights")
    _sample(folder / "samples")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "compile", lambda function: function)
        for name in UNSEEN:
            path = folder / f"{name}.safetensors"
            trained(VARIANTS[name], 1, folder / "samples", path, steps=6, batch=1, size=SIZE)
    return {name: read(folder / f"{name}.safetensors") for name in UNSEEN}


def _sample(folder):
    rng = np.random.default_rng(0)
    fields = {
        name: rng.integers(-40, 41, (channels, *SIZE)).astype(dtype)
        for name, (channels, dtype) in evidence._FIELDS.items()
    }
    fields["kind"] = np.ones((16, *SIZE), np.uint8)
    folder.mkdir()
    np.save(folder / "a_00_S2_000.npy", evidence.packed(fields))


def head_of(content, inputs):
    return runner(Evidence(), content.arrays)({"evidence": inputs})


@pytest.mark.parametrize("name", UNSEEN)
def test_exported_weights_do_not_see_what_is_taken_away_and_see_all_else(weights, name):
    rng = np.random.default_rng(1)
    inputs = rng.integers(-80, 81, (INPUTS, *SIZE)).astype(np.int8)
    run = runner(Evidence(), weights[name].arrays)
    expected = run({"evidence": inputs})
    for channel in range(INPUTS):
        other = inputs.copy()
        other[channel] = rng.integers(-80, 81, SIZE)
        assert np.array_equal(run({"evidence": other}), expected) == (channel in UNSEEN[name]), channel


def test_weights_to_begin_with_lose_what_is_taken_away_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function: function)
    _sample(tmp_path / "samples")
    write(tmp_path / "start.safetensors", shipped("evidence"))
    content = trained(
        VARIANTS["no grey"], 0, tmp_path / "samples", tmp_path / "weights.safetensors", steps=1, batch=1, size=SIZE,
        start=tmp_path / "start.safetensors", rate=1e-6,
    )  # fmt: skip
    for key, array in shipped("evidence").arrays.items():
        expected = array.copy()
        if key == "stem.weight":
            expected[:, :16] = 0
        np.testing.assert_allclose(content.arrays[key], expected, atol=1e-4)


def _hypotheses(seed=0):
    rng = np.random.default_rng(seed)
    rows, columns = 4 * SIZE[0], 4 * SIZE[1]
    half = rows // 2, columns // 2
    return Hypotheses(
        3, 2, (rng.random((rows, columns)) * 20).astype(np.float32), (rng.random(half) * 20).astype(np.float32),
        (rng.random((4, *half)) * 20).astype(np.float32), np.zeros(half, np.uint8),
        rng.integers(-20, 21, (6, *half)).astype(np.int8), np.zeros((3, *SIZE), np.float32),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "gone"),
    [("all", ()), ("no candidates", (2, 3)), ("no extremes", (0, 1)), ("no less and more", ())],
)
def test_a_value_without_weight_never_appears(weights, name, gone):
    rng = np.random.default_rng(2)
    head = head_of(weights[name], rng.integers(-80, 81, (INPUTS, *SIZE)).astype(np.int8))
    values = _hypotheses()
    values.gains[:] = 127  # all that evidence can say for them
    rows, columns = values.coarse.shape
    expected = mixture(head, values, rows, columns)[0]
    for k in range(4):
        others = values.others.copy()
        others[k] += 1000
        moved = mixture(head, replace(values, others=others), rows, columns)[0]
        assert np.array_equal(moved, expected) == (k in gone), k
    further = mixture(head, replace(values, step=4), rows, columns)[0]  # "less" and "more" are two pixels away then
    assert np.array_equal(further, expected) == (name == "no less and more")


@pytest.mark.parametrize("name", ["all", "no cost"])
def test_without_cost_no_evidence_is_added(weights, name):
    head = head_of(weights[name], np.random.default_rng(3).integers(-80, 81, (INPUTS, *SIZE)).astype(np.int8))
    values = _hypotheses()
    rows, columns = values.coarse.shape
    before, after = (mixture(head, v, rows, columns)[0] for v in (values, replace(values, gains=-values.gains)))
    assert np.array_equal(before, after) == (name == "no cost")


def test_half_width_is_a_network_of_that_width(weights):
    wide = Evidence()

    class Narrow(Evidence):
        layers = tuple(
            Layer(
                layer.name, layer.inputs if layer.name == "stem" else layer.inputs // 2,
                layer.outputs if layer.name == "head" else layer.outputs // 2, layer.kernel, layer.stride,
            )
            for layer in wide.layers
        )  # fmt: skip

    widths = {layer.name: (layer.outputs, layer.inputs) for layer in Narrow.layers}
    assert {outputs for outputs, _ in widths.values()} == {8, 12, 24, 32, wide.layers[-1].outputs}
    arrays = {}
    for key, array in weights["half width"].arrays.items():
        outputs, inputs = widths[key.partition(".")[0]]
        arrays[key] = array[:outputs, :inputs] if key.endswith("weight") else array[:outputs]
    inputs = np.random.default_rng(4).integers(-80, 81, (INPUTS, *SIZE)).astype(np.int8)
    narrow = runner(Narrow(), arrays)({"evidence": inputs})
    np.testing.assert_allclose(head_of(weights["half width"], inputs), narrow, atol=1e-4)


def test_absolute_disparities_move_the_input_and_relative_ones_do_not():
    rng = np.random.default_rng(5)
    left, right = rng.integers(0, 256, (2, 64, 96), dtype=np.uint8)
    confidence = rng.random((32, 48)).astype(np.float32)
    wanted = {}
    for disparity in (24, 32):  # at half size
        coarse = np.full((32, 48), disparity, np.float32)
        shifted = np.roll(right, -2 * disparity, 1)  # so that evidence stays what it is, but for the borders
        values = hypotheses(coarse, np.stack([coarse, coarse + 1]), left, shifted, 2)
        relative = network_input(values, confidence, left, 96).copy()
        absolute = absolute_input(values, confidence, left, 96)
        assert not relative[20:24].any()
        np.testing.assert_array_equal(np.delete(absolute, range(20, 24), 0), np.delete(relative, range(20, 24), 0))
        wanted[disparity] = absolute[20:24]
    assert (wanted[32] == 40).all()  # 64 pixels are a unit
    assert (wanted[24] == round(80 * 48 / 112)).all()


def test_samples_are_the_first_of_each_pair_and_of_the_kinds(tmp_path, monkeypatch):
    names = ["road-1-f_00_S2_010", "street-2-f_01_S1_000", "street-2-f_02_S1_000", "room-3-f_00_S4_100"]

    def generated(count, cache, assets, each):
        assert (count, assets, each) == (4, None, 2)
        for name in names:
            (cache / "samples-x").mkdir(exist_ok=True)
            (cache / "samples-x" / f"{name}.npy").touch()
        return cache / "samples-x"

    monkeypatch.setattr(ablation, "_generated_samples", generated)

    def listed(name):
        folder = ablation.samples_of(VARIANTS[name], 4, 2, tmp_path)
        return {names.index(path.stem) for path in folder.glob("*.npy")}

    assert listed("all") == {0, 1, 3}
    assert listed("streets") == {0, 1}
    assert listed("no streets") == {3}
    with pytest.raises(OptionError, match="pairs must be so many that some are of garden, got 4"):
        ablation.samples_of(Variant(kinds=("garden",)), 4, 2, tmp_path)


@pytest.fixture(scope="module")
def matched():
    """Return a pair whose truth is known on every third row."""
    rng = np.random.default_rng(6)
    right = cv2.GaussianBlur(rng.integers(0, 256, (96, 160)).astype(np.uint8), (0, 0), 1.0)
    truth = np.full((96, 160), np.nan, np.float32)
    truth[::3, 12:] = 9
    left = np.roll(right, 9, axis=1)
    return domains._matched("kitti2015", Frame("a", lambda: left, lambda: right, noc=lambda: truth, max_disparity=30))


def test_a_map_is_that_of_the_pipeline(matched):
    refiner = LearnedRefiner.of(shipped("evidence"), backend="torch", precision="fp32")
    match = stereokit.Matcher("S2", max_disparity=32, scale=0.5, refiner=refiner)
    expected = match(matched.left, matched.right).disparity
    np.testing.assert_array_equal(domains.refined(shipped("evidence"), matched), expected)
    assert matched.bounds == (0, 31)


def test_figures_are_those_of_plain_loops(matched):
    other = replace(matched, truth=matched.truth + 2)
    pairs = [matched, other, replace(other, name="eth3d")]
    figures = domains.scores(shipped("evidence"), pairs)
    error = []
    for pair in pairs[:2]:
        estimate = domains.refined(shipped("evidence"), pair)
        for y in range(96):
            for x in range(160):
                if np.isfinite(pair.truth[y, x]):
                    error.append((abs(float(estimate[y, x]) - float(pair.truth[y, x])), float(pair.truth[y, x])))
    size = len(error)
    row = figures["kitti2015"]
    assert row["bad-1"] == pytest.approx(100 * sum(e > 1 for e, _ in error) / size, abs=1e-4)
    assert row["bad-2"] == pytest.approx(100 * sum(e > 2 for e, _ in error) / size, abs=1e-4)
    assert row["d1"] == pytest.approx(100 * sum(e > 3 and e > 0.05 * t for e, t in error) / size, abs=1e-4)
    assert row["epe"] == pytest.approx(sum(e for e, _ in error) / size, abs=1e-4)
    assert 40 < row["bad-1"] < 60 < figures["eth3d"]["bad-1"]


def test_the_mean_is_geometric():
    figures = {"a": {"d1": 2.0, "epe": 1.0}, "b": {"d1": 6.0, "epe": 8.0}}
    reference = {"a": {"d1": 1.0, "epe": 1.0}, "b": {"d1": 12.0, "epe": 4.0}}
    assert domains.geometric_mean(figures, reference) == pytest.approx((2 * 1 * 0.5 * 2) ** 0.25)


SETTINGS = {"pairs": 1, "samples": 1, "steps": 1, "batch": 1, "rows": 32, "columns": 32, "rate": 0.001, "start": None}


@pytest.fixture
def trainings(monkeypatch, matched):
    """Return the variants and seeds that are trained, in order; training is no more than that."""
    done = []

    def fake(variant, seed, samples, output, **options):
        name = next(name for name, one in VARIANTS.items() if one is variant)
        if (name, seed) == ("no grey", 9):
            raise KeyboardInterrupt
        done.append((name, seed))
        return shipped("evidence")

    monkeypatch.setattr(command, "trained", fake)
    monkeypatch.setattr(command, "samples_of", lambda variant, pairs, samples, cache: cache)
    monkeypatch.setattr(command, "matched_pairs", lambda data: [replace(matched, full=matched.full + 1)])
    return done


def test_a_run_that_goes_on_repeats_nothing(tmp_path, trainings):
    output = tmp_path / "out.json"
    with pytest.raises(KeyboardInterrupt):
        command.measure(output, SETTINGS, [("all", 0), ("no cost", 0), ("no grey", 9)], tmp_path, tmp_path)
    assert trainings == [("all", 0), ("no cost", 0)]
    assert [run["variant"] for run in json.loads(output.read_text())["runs"]] == ["all", "no cost"]
    document = command.measure(output, SETTINGS, [("all", 0), ("all", 1), ("no cost", 0)], tmp_path, tmp_path)
    assert trainings == [("all", 0), ("no cost", 0), ("all", 1)]
    assert document == json.loads(output.read_text())
    again = command.measure(output, SETTINGS, [("all", 1)], tmp_path, tmp_path)
    assert again == document and len(trainings) == 3
    with pytest.raises(OptionError, match="output must be of the same settings"):
        command.measure(output, {**SETTINGS, "steps": 2}, [("all", 0)], tmp_path, tmp_path)


def test_the_command_trains_all_variants_of_a_seed_before_the_next(tmp_path, trainings, capsys):
    words = ["--data", str(tmp_path), "--cache", str(tmp_path / "cache"), "-o", str(tmp_path / "out.json")]
    command.main([*words, "--seeds", "1,3", "--variants", "all,no grey"])
    assert trainings == [("all", 1), ("no grey", 1), ("all", 3), ("no grey", 3)]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 and lines[1].split()[:2] == ["all", "2"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--variants", "no noise"], "variants must be of all, no cost, .*, got 'no noise'"),
        (["--seeds", "1,x"], "seeds must be whole numbers with commas between them, got '1,x'"),
        (["--rows", "40"], "rows must be a multiple of 32, got 40"),
        (["--steps", "0"], "steps must be"),
        (["--data", "nowhere"], "data must be a folder, got 'nowhere'"),
    ],
)
def test_bad_options_are_named(tmp_path, words, message):
    needed = ["--data", str(tmp_path), "--cache", str(tmp_path / "cache"), "-o", str(tmp_path / "out.json")]
    with pytest.raises((OptionError, FileError), match=message):
        command.main([*needed, *words])


def test_the_table_has_mean_and_range():
    runs = [{"variant": "all", "seed": seed, "mean": mean} for seed, mean in enumerate((0.9, 0.8, 0.85))]
    assert command.table({"runs": runs})[1].split() == ["all", "3", "0.8500", "0.8000", "0.9000"]


def test_a_mistake_is_one_line_and_status_2(tmp_path, capsys):
    def mistaken():
        raise OptionError("steps must be at least 1, got 0")

    assert exit_status(lambda: None) == 0
    assert exit_status(mistaken) == 2 and capsys.readouterr().err == "error: steps must be at least 1, got 0\n"
    words = ("--data", str(tmp_path / "none"), "--cache", str(tmp_path / "cache"), "-o", str(tmp_path / "out.json"))
    module = "stereokit_evaluation.commands.ablation"
    done = subprocess.run([sys.executable, "-m", module, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.startswith("error: data must be a folder, got ")
    assert len(done.stderr.splitlines()) == 1 and not list(tmp_path.iterdir())
