"""The training loop: what it computes, that a kill changes nothing, what stops it, two processes at once."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import subprocess
import sys

import numpy as np
import oracles
import pytest
from limits import HANG_S
from refining import NAMES, one_line, random_arrays

torch = pytest.importorskip("torch")

from stereokit import Disparity  # noqa: E402
from stereokit.errors import OptionError, StereokitError  # noqa: E402
from stereokit_refiners.learned import LearnedRefiner  # noqa: E402
from stereokit_refiners.training import loop  # noqa: E402
from stereokit_refiners.training.loop import PRESETS, History, Settings, Source, bad_pixels, fit, predict  # noqa: E402
from stereokit_refiners.training.samples import Sample  # noqa: E402
from stereokit_refiners.weights import NETWORKS, WeightFile  # noqa: E402

TINY = {"steps": 7, "batch": 1, "rows": 8, "columns": 16, "evaluate_every": 2, "half": False, "seed": 3}


def settings(**arguments):
    return Settings(**{**TINY, **arguments})


def sample_of(seed=0, size=(24, 40), offset=6.0, known=0.8):
    """Return a random map whose truth is the upscaled map plus `offset`; `size` is that of the image."""
    rng = np.random.default_rng(seed)
    rows, columns = -(-size[0] // 2), -(-size[1] // 2)
    slope = np.linspace(0, 8, columns)[None] + rng.random((rows, 1)) * 4 + 6
    coarse = np.rint(slope * 256).astype(np.uint16)
    truth = np.repeat(np.repeat(coarse, 2, 0), 2, 1).astype(np.float64) * 2 + offset * 256
    truth[rng.random(truth.shape) > known] = 0
    truth[size[0] :] = truth[:, size[1] :] = 0
    left = rng.integers(0, 256, (2 * rows, 2 * columns)).astype(np.uint8)
    left[size[0] :] = left[size[0] - 1]
    left[:, size[1] :] = left[:, size[1] - 1 : size[1]]
    seen = (truth > 0) & (rng.random(truth.shape) < 0.9)
    confidence = rng.integers(0, 256, (rows, columns)).astype(np.uint8)
    confidence[rng.random((rows, columns)) > 0.9] = 0
    candidates = rng.integers(0, 40 * 256, (2, rows, columns)).astype(np.uint16)
    return Sample(coarse, confidence, candidates, left, truth.astype(np.uint16), seen, size)


def coarse_map(sample):
    """Return what a matcher gave for a sample, before it was packed."""
    confidence = sample.confidence.astype(np.float32) / 255
    coarse, candidates = (array.astype(np.float32) / 256 for array in (sample.coarse, sample.candidates))
    return Disparity(coarse, confidence > 0, confidence, candidates=candidates)


SAMPLES = [sample_of(seed) for seed in range(3)]
SOURCES = [Source(SAMPLES)]


def assert_same(one, other):
    assert set(one) == set(other)
    for name, array in one.items():
        np.testing.assert_array_equal(other[name], array, err_msg=name)


def differ(one, other):
    return any((other[name] != array).any() for name, array in one.items())


# --- settings ------------------------------------------------------------------------------------------------------


def test_the_papers_recipe():
    """Section IV of the paper: 160 frames, 1000 epochs, batch 1, Adam(0.99, 0.999), 5e-4, times 0.97 in 10 epochs."""
    paper = Settings(**PRESETS["paper"])
    assert paper.steps == 1000 * 160
    assert paper.batch == 1
    assert paper.betas == (0.99, 0.999)
    assert paper.learning_rate == 5e-4
    assert (paper.output_mode, paper.loss, paper.finish, paper.divergence) == ("direct", "l1", None, 256)
    assert (paper.decay, paper.clip, paper.ema, paper.patience) == (0, 0, 0, 0)
    for step, times in ((0, 0), (1599, 0), (1600, 1), (3200, 2), (159_999, 99)):
        assert loop._rate_factor(paper, step) == pytest.approx(0.97**times)


def test_the_default_schedule_warms_up_and_ends_near_nothing():
    chosen = Settings(steps=1000, learning_rate=2e-3)
    rates = [chosen.learning_rate * loop._rate_factor(chosen, step) for step in range(1000)]
    assert rates[0] < 0.02 * max(rates)
    assert max(rates) == pytest.approx(2e-3, rel=0.05)
    assert np.argmax(rates) < 110
    assert all(later <= earlier for earlier, later in itertools.pairwise(rates[110:]))
    assert 0 < rates[-1] < 0.01 * max(rates)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"output_mode": "printed"}, "output_mode must be one of residual, direct, got 'printed'"),
        ({"loss": "l2"}, "loss must be one of l1, bounded, d1, got 'l2'"),
        ({"finish": "l2"}, "loss must be one of l1, bounded, d1, got 'l2'"),
        ({"schedule": "step"}, "schedule must be cosine or paper, got 'step'"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"batch": -1}, "batch must be at least 1, got -1"),
        ({"evaluate_every": 0}, "evaluate_every must be at least 1, got 0"),
        ({"rows": 12}, "rows and columns must be multiples of 8, got 12 and 16"),
        ({"columns": 20}, "rows and columns must be multiples of 8, got 8 and 20"),
    ],
)
def test_settings_are_checked(arguments, message):
    with pytest.raises(OptionError) as caught:
        settings(**arguments)
    assert one_line(caught.value) == message


@pytest.mark.parametrize(
    "arguments",
    [
        {"steps": 2.5}, {"batch": 1.5}, {"learning_rate": -1.0}, {"learning_rate": float("nan")}, {"ema": 1.5},
        {"ema": -0.1}, {"decay": -1.0}, {"clip": -1.0}, {"patience": -1}, {"patience": 1.5}, {"divergence": -1.0},
        {"betas": (0.9, 1.5)}, {"betas": 0.9}, {"seed": -1}, {"seed": 1.5}, {"half": "yes"}, {"evaluate_every": 2.5},
    ],
    ids=str,
)  # fmt: skip
def test_settings_that_no_training_could_use_are_refused_before_it_starts(arguments):
    with pytest.raises(StereokitError) as caught:
        settings(**arguments)
    assert next(iter(arguments)) in one_line(caught.value)


# --- the pieces ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("occluded", [False, True])
def test_bad_pixels_are_those_of_kitti(occluded):
    sample = sample_of(5, (23, 39))
    rng = np.random.default_rng(0)
    truth = sample.truth[:23, :39] / 256
    scale = rng.choice([1.0, 3.0, 6.0], truth.shape)
    truth_map = np.where(truth > 0, truth * scale, 0)
    big = np.zeros(sample.truth.shape, np.uint16)
    big[:23, :39] = np.rint(truth_map * 256)
    sample = dataclasses.replace(sample, truth=big)
    truth = big[:23, :39] / 256
    error = rng.choice([0, 2.9, 3.0, 3.1, 5.0, 12.0], truth.shape) * rng.choice([-1, 1], truth.shape)
    estimate = (truth + error).astype(np.float32)
    wanted = truth if occluded else np.where(sample.seen[:23, :39], truth, 0)
    actual = bad_pixels(estimate, sample, occluded=occluded)
    assert actual == oracles.outliers(estimate, wanted)
    assert 0 < actual[0] < actual[1]


def test_exactly_3_pixels_and_exactly_5_percent_are_good():
    def counts(true, error):
        truth = np.full((2, 2), round(true * 256), np.uint16)
        one = Sample(np.zeros((1, 1), np.uint16), np.full((1, 1), 255, np.uint8), np.zeros((2, 1, 1), np.uint16),
                     np.zeros((2, 2), np.uint8), truth, np.ones((2, 2), bool), (2, 2))  # fmt: skip
        return bad_pixels(np.full((2, 2), true + error, np.float32), one)

    assert counts(20, 3.0) == (0, 4)
    assert counts(20, 3.0078125) == (4, 4)
    assert counts(80, 4.0) == (0, 4)
    assert counts(80, 4.0078125) == (4, 4)
    assert counts(80, 3.5) == (0, 4)


@pytest.mark.parametrize("size", [(24, 40), (23, 37)])
@pytest.mark.parametrize(("name", "mode"), [(n, "residual") for n in NAMES] + [("stereovae", "direct")])
def test_predict_is_what_the_refiner_computes(name, mode, size):
    pytest.importorskip("safetensors")
    arrays, sample = random_arrays(name, 1), sample_of(1, size)
    module = loop.restored(NETWORKS[name], arrays)
    actual = predict(module, mode, sample)
    assert actual.shape == size
    assert actual.dtype == np.float32
    refiner = LearnedRefiner.of(WeightFile(name, mode, arrays), backend="torch")
    coarse = coarse_map(sample)
    image = np.ascontiguousarray(sample.left[: size[0], : size[1]])
    np.testing.assert_allclose(actual, refiner(coarse, image).disparity, rtol=0, atol=2e-3)


def test_predict_leaves_the_module_as_it_was():
    module = loop.Module(NETWORKS["stereovae"]).train()
    first = predict(module, "residual", SAMPLES[0])
    assert module.training
    np.testing.assert_array_equal(predict(module, "residual", SAMPLES[0]), first)


def test_the_score_is_pooled_not_averaged(monkeypatch):
    small, large = sample_of(1, (8, 8)), sample_of(2, (24, 40))
    monkeypatch.setattr(loop, "predict", lambda module, output_mode, sample, half: sample)
    monkeypatch.setattr(loop, "bad_pixels", lambda estimate, sample: (6, 8) if sample is small else (10, 92))
    assert loop._score(None, settings(), [small, large]) == pytest.approx(16.0)
    assert loop._score(None, settings(), []) is None


def test_batches_are_functions_of_seed_step_and_rank():
    network, chosen = NETWORKS["pyramid"], settings(batch=2)

    def draw(step, rank=0, seed=3):
        return loop._draw(network, SOURCES, dataclasses.replace(chosen, seed=seed), step, rank)

    first = draw(5)
    assert {k: tuple(v.shape) for k, v in first.items()} == {
        "disparity": (2, 1, 8, 16), "confidence": (2, 1, 8, 16), "phases": (2, 4, 8, 16),
        "candidates": (2, 2, 8, 16), "values": (2, 2, 8, 16), "coarse": (2, 1, 8, 16),
        "truth": (2, 1, 16, 32), "weight": (2, 1, 16, 32),
    }  # fmt: skip
    for shown, pixels in (("candidates", "values"), ("disparity", "coarse")):  # of one map, in one order
        np.testing.assert_allclose(first[shown], first[pixels] / 16 - 1.5, atol=1e-5)
    for name, tensor in draw(5).items():
        assert torch.equal(tensor, first[name])
    for other in (draw(6), draw(5, rank=1), draw(5, seed=4)):
        assert not torch.equal(other["phases"], first["phases"])


def test_sources_give_their_shares():
    sources = [Source([sample_of(0, offset=1)], 3.0), Source([sample_of(1, offset=50)], 1.0), Source(SAMPLES, 0.0)]
    drawn = [loop._draw(NETWORKS["cnn"], sources, settings(), step) for step in range(200)]
    far = [float((b["truth"] - torch.nn.functional.interpolate(b["coarse"], scale_factor=2))[b["weight"] > 0].mean())
           for b in drawn]  # fmt: skip
    share = np.mean(np.array(far) > 25)
    assert abs(share - 0.25) < 0.1
    assert {round(v) for v in far} == {1, 50}


def test_the_loss_is_the_weighted_mean_and_the_divergence():
    network, chosen = NETWORKS["stereovae"], settings(divergence=2.0, finish="bounded", steps=9)
    rng = np.random.default_rng(0)
    batch = loop._draw(network, SOURCES, chosen, 0)
    heads = {"map": torch.from_numpy(rng.normal(0, 0.1, (1, 4, 8, 16)).astype(np.float32)),
             "mean": torch.full((1, 1, 2, 4), 0.5), "log_sigma": torch.full((1, 1, 2, 4), -0.2)}  # fmt: skip
    coarse, truth, weight = (batch[n][0, 0].numpy().astype(np.float64) for n in ("coarse", "truth", "weight"))
    estimate = oracles.double(coarse, 16, 32) + 4 * oracles.phases_to_pixels(heads["map"][0].numpy())
    error = np.abs(estimate - truth)
    divergence = oracles.divergence(0.5, np.exp(-0.2))
    for step, pixels in ((0, error), (5, error), (6, 4 * error / (error + 3) + 0.1 * error)):
        expected = (pixels * weight).sum() / weight.sum() + 2 * divergence
        assert float(loop._loss(chosen, network, heads, batch, step)) == pytest.approx(expected, rel=1e-5)


# --- the loop ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_the_loss_falls_on_a_trivial_problem(name):
    """The truth is the map plus six pixels."""
    chosen = settings(steps=60, learning_rate=4e-3, schedule="paper", ema=0.8, evaluate_every=20, batch=2, rows=16,
                      clip=5.0)  # fmt: skip
    arrays, history = fit(NETWORKS[name], SOURCES, SAMPLES, chosen)
    losses = [row[1] for row in history.rows]
    assert [row[0] for row in history.rows] == [20, 40, 60]
    assert losses[-1] < 0.5 * losses[0]
    assert losses[-1] < 3
    assert history.rows[-1][2] < 60
    assert all(np.isfinite(array).all() and array.dtype == np.float32 for array in arrays.values())


@pytest.mark.parametrize("half", [False, True])
def test_the_same_seed_is_the_same_training(half):
    network, chosen = NETWORKS["stereovae"], settings(half=half)
    first, history = fit(network, SOURCES, SAMPLES, chosen)
    again, other_history = fit(network, SOURCES, SAMPLES, chosen)
    assert_same(first, again)
    assert history.rows == other_history.rows
    other, _ = fit(network, SOURCES, SAMPLES, dataclasses.replace(chosen, seed=4))
    assert differ(first, other)


def test_training_does_not_depend_on_what_torch_drew_before():
    first, _ = fit(NETWORKS["stereovae"], SOURCES, [], settings())
    torch.manual_seed(99)
    torch.randn(10)
    assert_same(first, fit(NETWORKS["stereovae"], SOURCES, [], settings())[0])


def test_start_weights_are_where_it_starts():
    start = random_arrays("cnn", 8)
    arrays, _ = fit(NETWORKS["cnn"], SOURCES, [], settings(learning_rate=0.0), start=start)
    for name, array in start.items():
        np.testing.assert_allclose(arrays[name], array, rtol=1e-6, atol=0)
    moved, _ = fit(NETWORKS["cnn"], SOURCES, [], settings(), start=start)
    assert differ(arrays, moved)


def test_the_average_is_the_exponential_moving_one():
    network = NETWORKS["cnn"]
    same = {"schedule": "paper", "learning_rate": 1e-2}  # so that the first steps do not depend on how many follow
    initial = loop.Module(network, torch.Generator().manual_seed(3)).arrays()
    trained = [fit(network, SOURCES, [], settings(steps=n, ema=0.0, **same))[0] for n in (1, 2, 3)]
    actual, _ = fit(network, SOURCES, [], settings(steps=3, ema=0.15, **same))
    for name, array in initial.items():
        average = array.astype(np.float64)
        for step, weights in enumerate(trained):
            keep = min(0.15, (step + 1) / (step + 10))  # shorter at first
            average = keep * average + (1 - keep) * weights[name]
        np.testing.assert_allclose(actual[name], average, rtol=1e-5, atol=1e-7)
    assert differ(actual, trained[-1])


@pytest.mark.parametrize("patience", [0, 3])
@pytest.mark.parametrize("stop_at", [1, 2, 4, 6, 7])
def test_a_run_that_was_stopped_at_any_step_goes_on_as_if_nothing_had_happened(stop_at, patience, tmp_path):
    network, chosen, path = NETWORKS["stereovae"], settings(patience=patience), tmp_path / "c" / "checkpoint.pt"
    expected, history = fit(network, SOURCES, SAMPLES, chosen)

    def stop(step, loss, score):
        if step == stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(network, SOURCES, SAMPLES, chosen, checkpoint=path, save_every_s=-1, progress=stop)
    seen = []
    actual, resumed = fit(network, SOURCES, SAMPLES, chosen, checkpoint=path, save_every_s=-1,
                         progress=lambda *a: seen.append(a[0]))  # fmt: skip
    assert_same(expected, actual)
    assert seen == list(range(stop_at, 8))  # what was not saved is done again, and nothing else
    assert [(r[0], r[2]) for r in resumed.rows] == [(r[0], r[2]) for r in history.rows]


@pytest.mark.parametrize("stop_at", [2, 3, 5])
def test_the_curves_of_a_resumed_run_are_those_of_one_that_was_not(stop_at, tmp_path):
    """Stopped between two looks: the mean loss of the next look must include the steps before the stop."""
    network, chosen, path = NETWORKS["cnn"], settings(evaluate_every=3), tmp_path / "checkpoint.pt"
    _, history = fit(network, SOURCES, [], chosen)

    def stop(step, loss, score):
        if step == stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(network, SOURCES, [], chosen, checkpoint=path, save_every_s=-1, progress=stop)
    _, resumed = fit(network, SOURCES, [], chosen, checkpoint=path)
    assert resumed.rows == history.rows


def test_a_finished_run_is_not_run_again(tmp_path):
    path = tmp_path / "checkpoint.pt"
    first, history = fit(NETWORKS["cnn"], SOURCES, SAMPLES, settings(), checkpoint=path)
    steps = []
    again, other = fit(
        NETWORKS["cnn"], SOURCES, SAMPLES, settings(), checkpoint=path, progress=lambda *a: steps.append(a)
    )
    assert_same(first, again)
    assert steps == []
    assert other.rows == history.rows


@pytest.mark.parametrize(
    "changed", [{"seed": 4}, {"steps": 8}, {"loss": "d1"}, {"betas": (0.8, 0.999)}, {"half": True}], ids=str
)
def test_a_checkpoint_of_other_settings_is_refused(changed, tmp_path):
    path = tmp_path / "checkpoint.pt"
    fit(NETWORKS["cnn"], SOURCES, [], settings(steps=1), checkpoint=path)
    original = path.read_bytes()
    with pytest.raises(OptionError, match=r"checkpoint .* is of other settings; remove it or choose another folder"):
        fit(NETWORKS["cnn"], SOURCES, [], settings(**{"steps": 1, **changed}), checkpoint=path)
    with pytest.raises(OptionError, match="other settings"):
        fit(NETWORKS["stereovae"], SOURCES, [], settings(steps=1), checkpoint=path)
    assert path.read_bytes() == original


@pytest.mark.parametrize("what", ["samples", "validation", "start"])
def test_a_checkpoint_of_other_data_is_refused(what, tmp_path):
    """Otherwise weights are said to be trained on, or to have never seen, what they were not."""
    path = tmp_path / "checkpoint.pt"
    fit(NETWORKS["cnn"], SOURCES, SAMPLES[:1], settings(steps=1), checkpoint=path)
    sources = [Source([sample_of(70)])] if what == "samples" else SOURCES
    looked_at = SAMPLES[1:] if what == "validation" else SAMPLES[:1]
    start = random_arrays("cnn") if what == "start" else None
    with pytest.raises(StereokitError, match="checkpoint"):
        fit(NETWORKS["cnn"], sources, looked_at, settings(steps=1), start=start, checkpoint=path)


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04 cut"])
def test_a_broken_checkpoint_is_refused_in_one_line(content, tmp_path):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(content)
    with pytest.raises(StereokitError, match="checkpoint") as caught:
        fit(NETWORKS["cnn"], SOURCES, [], settings(steps=1), checkpoint=path)
    one_line(caught.value)
    assert path.read_bytes() == content


def test_a_checkpoint_never_runs_code(tmp_path):
    import os

    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "exploded"),)

    torch.save({"settings": Bomb()}, tmp_path / "checkpoint.pt")
    with pytest.raises(Exception):  # noqa: B017  (of which kind is another test's matter)
        fit(NETWORKS["cnn"], SOURCES, [], settings(steps=1), checkpoint=tmp_path / "checkpoint.pt")
    assert not (tmp_path / "exploded").exists()


def scripted(monkeypatch, scores):
    """Let the looks say `scores`; return the averages that were looked at."""
    left, looked_at = iter(scores), []

    def look(module, settings, samples):
        looked_at.append({name: array.copy() for name, array in module.arrays().items()})
        return next(left)

    monkeypatch.setattr(loop, "_score", look)
    return looked_at


def test_early_stopping_returns_the_best(monkeypatch):
    chosen = settings(steps=40, evaluate_every=2, patience=3)
    looked_at = scripted(monkeypatch, [9.0, 5.0, 7.0, 5.0, 6.0])
    arrays, history = fit(NETWORKS["cnn"], SOURCES, SAMPLES, chosen)
    assert [row[::2] for row in history.rows] == [(2, 9.0), (4, 5.0), (6, 7.0), (8, 5.0), (10, 6.0)]
    assert_same(arrays, looked_at[1])
    assert differ(arrays, looked_at[-1])


def test_a_better_look_starts_patience_anew(monkeypatch):
    chosen = settings(steps=14, evaluate_every=2, patience=2)
    looked_at = scripted(monkeypatch, [9.0, 9.5, 5.0, 7.0, 4.0, 4.5, 4.5])
    arrays, history = fit(NETWORKS["cnn"], SOURCES, SAMPLES, chosen)
    assert len(history.rows) == 7
    assert_same(arrays, looked_at[4])


def test_without_patience_the_last_average_is_returned(monkeypatch):
    looked_at = scripted(monkeypatch, [1.0, 9.0, 9.0, 9.0])
    arrays, history = fit(NETWORKS["cnn"], SOURCES, SAMPLES, settings())
    assert [row[0] for row in history.rows] == [2, 4, 6, 7]
    assert_same(arrays, looked_at[-1])


def test_the_best_survives_a_stop(monkeypatch, tmp_path):
    chosen, path = settings(steps=12, evaluate_every=2, patience=9), tmp_path / "checkpoint.pt"

    def stop(step, loss, score):
        if step == 6:
            raise KeyboardInterrupt

    looked_at = scripted(monkeypatch, [5.0, 2.0, 8.0])
    with pytest.raises(KeyboardInterrupt):
        fit(NETWORKS["cnn"], SOURCES, SAMPLES, chosen, checkpoint=path, save_every_s=-1, progress=stop)
    scripted(monkeypatch, [7.0, 7.0, 7.0, 7.0])
    arrays, _ = fit(NETWORKS["cnn"], SOURCES, SAMPLES, chosen, checkpoint=path)
    assert_same(arrays, looked_at[1])


def test_sources_without_samples_are_refused():
    for sources in ([], [Source([])], [Source(SAMPLES), Source([])]):
        with pytest.raises(OptionError, match=r"^sources must hold at least one sample each, got an empty one$"):
            fit(NETWORKS["cnn"], sources, [], settings())


def test_crops_without_any_truth_do_no_harm():
    blank = dataclasses.replace(SAMPLES[0], truth=np.zeros_like(SAMPLES[0].truth))
    arrays, history = fit(NETWORKS["stereovae"], [Source([blank])], [blank], settings(steps=3))
    assert all(np.isfinite(array).all() for array in arrays.values())
    assert history.rows[-1][2] is None


def test_progress_is_told_every_step():
    messages = []
    fit(NETWORKS["cnn"], SOURCES, SAMPLES, settings(), progress=lambda *a: messages.append(a))
    assert [step for step, _, _ in messages] == list(range(1, 8))
    assert all(np.isfinite(loss) for _, loss, _ in messages)
    assert messages[0][2] is None and messages[1][2] is not None


def test_the_history_is_a_csv_file():
    rows = list(csv.reader(io.StringIO(History([(2, 1.5, None), (4, 1.25, 7.0)]).csv().decode())))
    assert rows == [["step", "loss", "d1_noc_percent"], ["2", "1.5", ""], ["4", "1.25", "7.0"]]


def test_calibration_after_training_gives_int8():
    pytest.importorskip("openvino")
    arrays, _ = fit(NETWORKS["stereovae"], SOURCES, [], settings())
    ranges = loop.calibrated(loop.restored(NETWORKS["stereovae"], arrays), "residual", SOURCES)
    content = WeightFile("stereovae", "residual", arrays, ranges)
    sample = SAMPLES[0]
    coarse = coarse_map(sample)
    exact, rough = (
        LearnedRefiner.of(content, backend="openvino", precision=p)(coarse, sample.left).disparity
        for p in ("fp32", "int8")
    )
    assert 0 < np.abs(exact - rough).max() < 0.5


def test_a_form_that_the_network_lacks_is_refused():
    """The pyramid's head has 57 channels: it has no literal form."""
    with pytest.raises(StereokitError, match="direct"):
        fit(NETWORKS["pyramid"], SOURCES, [], settings(output_mode="direct"))


RANKS = """
import sys
sys.path[:0] = sys.argv[2:]
import os, numpy as np, torch
from test_training import NETWORKS, SAMPLES, SOURCES, fit, settings
torch.distributed.init_process_group("gloo")
rank, world = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
folder = sys.argv[1]
from pathlib import Path
arrays, history = fit(NETWORKS["stereovae"], SOURCES, SAMPLES, settings(steps=4), rank=rank, world=world,
                      checkpoint=Path(folder) / f"checkpoint-{rank}.pt")
np.savez(f"{folder}/rank-{rank}.npz", **arrays)
torch.distributed.destroy_process_group()
"""


def test_two_processes_train_one_network(tmp_path):
    from pathlib import Path

    import stereokit
    import stereokit_refiners

    script = tmp_path / "ranks.py"
    script.write_text(RANKS)
    here = Path(__file__).parent
    packages = [here, here.parent, *(Path(m.__file__).parents[1] for m in (stereokit, stereokit_refiners))]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script),
               str(tmp_path), *map(str, packages)]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False)
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "rank-0.npz") as zero, np.load(tmp_path / "rank-1.npz") as one:
        first, second = dict(zero), dict(one)
    assert_same(first, second)
    alone, _ = fit(NETWORKS["stereovae"], SOURCES, SAMPLES, settings(steps=4))
    assert differ(first, alone)  # half of the crops were the other's
    assert (tmp_path / "checkpoint-0.pt").exists()
    assert not (tmp_path / "checkpoint-1.pt").exists()
