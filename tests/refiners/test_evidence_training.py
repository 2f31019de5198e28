"""Training of the evidence refiner: what is stored, its loss, and a short run that learns."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from stereokit.errors import OptionError  # noqa: E402
from stereokit_refiners.networks.evidence import CHANNELS, GAINS, LOGITS  # noqa: E402
from stereokit_refiners.runtimes.evidence import hypotheses  # noqa: E402
from stereokit_refiners.runtimes.features import network_input  # noqa: E402
from stereokit_refiners.runtimes.mixture import mixture as compiled_mixture  # noqa: E402
from stereokit_refiners.training import evidence as training  # noqa: E402
from stereokit_refiners.weights import read  # noqa: E402


def _pair(seed=0, rows=96, columns=160):
    """Return a textured wall with a nearer square before it, its right view, the truth and what both cameras see."""
    rng = np.random.default_rng(seed)
    wall = cv2.GaussianBlur(rng.integers(0, 256, (rows, columns + 64), dtype=np.uint8), (0, 0), 1)
    square = cv2.GaussianBlur(rng.integers(0, 256, (rows, columns), dtype=np.uint8), (0, 0), 1)
    truth = np.full((rows, columns), 6, np.float32)
    truth[30:70, 60:100] = 15
    left = wall[:, :columns].copy()
    right = wall[:, 6 : columns + 6].copy()
    left[30:70, 60:100] = square[30:70, 60:100]
    right[30:70, 45:85] = square[30:70, 60:100]
    seen = np.ones((rows, columns), bool)
    seen[30:70, 51:60] = False
    seen[:, :6] = False
    return left, right, truth, seen


def _fields(step=2, seed=0):
    left, right, truth, seen = _pair(seed)
    record, outliers = training.make_sample(left, right, truth, seen, "S2", 1 / step)
    return training.unpacked(record), outliers


def test_what_is_packed_comes_back():
    rng = np.random.default_rng(0)
    fields = {
        name: (rng.normal(size=(channels, 3, 5)) * 2).astype(dtype) if dtype == np.float16 else
        rng.integers(0, 100, (channels, 3, 5)).astype(dtype)
        for name, (channels, dtype) in training._FIELDS.items()
    }  # fmt: skip
    fields["input"] = rng.integers(-127, 128, (sum(CHANNELS.values()), 3, 5)).astype(np.int8)
    unpacked = training.unpacked(training.packed(fields))
    for name, array in fields.items():
        np.testing.assert_array_equal(unpacked[name], array.transpose(1, 2, 0))


@pytest.mark.parametrize("step", [1, 2, 4])
def test_the_mixture_of_stored_samples_is_that_of_the_kernels(step):
    rng = np.random.default_rng(step)
    left, right, *_ = _pair()
    size = -(-left.shape[0] // step), -(-left.shape[1] // step)
    disparity, one, two = (rng.random((3, *size)) * 20 / step).astype(np.float32)
    fields = hypotheses(disparity, np.stack([one, two]), left, right, step)
    head = rng.normal(size=(fields.coarse.shape[0] // 4, fields.coarse.shape[1] // 4, LOGITS + GAINS + 4))
    head = head.astype(np.float32)
    expected = compiled_mixture(head, fields, *left.shape)[0]

    def folded(plane, side):
        return training._folded(plane, side)

    near = np.concatenate([folded(values - fields.half, 2) for values in fields.others])
    within = folded(fields.coarse - fields.half.repeat(2, 0).repeat(2, 1), 4)
    inputs = network_input(fields, rng.random(size).astype(np.float32), left, left.shape[1]).transpose(1, 2, 0)
    means = training.gains_around(inputs[None])[0].transpose(2, 0, 1)
    tensors = [
        torch.from_numpy(part.astype(np.float32))[None] for part in (head.transpose(2, 0, 1), means, near, within)
    ]
    full = training.mixture(*tensors, torch.tensor([float(fields.apart)]))[0].numpy()
    full = (full + fields.half.repeat(2, 0).repeat(2, 1) + fields.base)[: left.shape[0], : left.shape[1]]
    np.testing.assert_allclose(full, expected, atol=1e-3)


def test_samples_say_what_is_missing_and_who_sees_it():
    fields, outliers = _fields()
    assert 0 <= outliers < 0.3
    kinds = fields["kind"]
    assert set(np.unique(kinds)) == {1, 2}
    assert np.median(np.abs(fields["miss"][kinds == 1].astype(float))) < 0.3


def test_the_identity_costs_what_the_coarse_map_costs_and_harm_costs_more():
    stored = {name: a[None] for name, a in _fields()[0].items()}
    stored["means"] = training.gains_around(stored["input"])
    fields = {name: torch.from_numpy(a).permute(0, 3, 1, 2) for name, a in stored.items()}
    head = torch.zeros(1, LOGITS + GAINS + 4, *fields["miss"].shape[2:])
    head[:, :LOGITS] = -40
    sure = 0.2 * np.log(2)  # of logits of 0, whatever is right
    value, before = training.loss(head, fields, torch.ones(1))
    assert float(value.detach()) == pytest.approx(float(before) + sure, rel=1e-4)
    head[:, :4] = 40  # always a pixel less
    worse, same = training.loss(head, fields, torch.ones(1))
    assert float(same) == float(before)
    assert float(worse) > float(value)


@pytest.mark.parametrize(
    ("objective", "error", "value"),
    [("general", 1, 1 / 1.6 + 0.7 / 8 + 0.08), ("d1", 1, 3 / (1 + np.exp(4)) + 0.25), ("d1", 3, 1.5 + 0.75),
     ("d1", 50, 3 + 5)],
)  # fmt: skip
def test_what_an_error_counts(objective, error, value):
    assert float(training._badness(torch.tensor([float(error)]), objective)) == pytest.approx(value, rel=1e-5)


def test_a_growing_folder_is_drawn_by_how_much_is_wrong_and_files_alike(tmp_path):
    names = ["a_00_S2_000.npy", "b_00_S2_120.npy", "c_00_S2_300.npy"]
    for name in names:
        (tmp_path / name).touch()
    paths, shares = training.Source(tmp_path).listed()
    assert [path.name for path in paths] == names
    np.testing.assert_allclose(shares, [1, 1.5, 1.5])
    assert training.Source(paths).listed()[0] == paths
    np.testing.assert_allclose(training.Source(paths).listed()[1], [1, 2, 3])


def _marked(path, value, size=(16, 24)):
    fields = {name: np.zeros((channels, *size), dtype) for name, (channels, dtype) in training._FIELDS.items()}
    fields["kind"] += value
    np.save(path, training.packed(fields))
    return path


def test_steps_are_of_one_source_each_in_their_shares(tmp_path):
    sources = [
        training.Source([_marked(tmp_path / "a.npy", 1)], 0.75),
        training.Source([_marked(tmp_path / "b.npy", 2), _marked(tmp_path / "c.npy", 2)], 0.25),
    ]
    batches = training._batches(sources, 3, (8, 8), np.random.default_rng(0))
    kinds = [next(batches)["kind"] for _ in range(200)]
    assert all((kind == kind[0, 0, 0, 0]).all() for kind in kinds)
    assert 125 < sum(int(kind[0, 0, 0, 0]) == 1 for kind in kinds) < 175


def test_crops_larger_than_all_samples_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "_MOST_SMALL", 5)
    source = training.Source([_marked(tmp_path / "a.npy", 1)])
    with pytest.raises(OptionError, match="crops must fit into the samples, got 96x32 pixels"):
        next(training._batches([source], 1, (24, 8), np.random.default_rng(0)))


def test_a_short_run_learns_goes_on_and_gives_weights_that_are_read(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(torch, "compile", lambda function: function)
    pairs, samples = tmp_path / "pairs", tmp_path / "samples"
    pairs.mkdir()
    for seed in range(2):
        left, right, truth, seen = _pair(seed)
        np.savez(pairs / f"wall-{seed}.npz", left=left, right=right, truth=truth, seen=seen)
    monkeypatch.setattr(training, "_TOO_HARD", 1.1)
    training._store(pairs, samples, 1)
    assert len(list(samples.glob("*.npy"))) == 2
    output = tmp_path / "weights.safetensors"
    training.fit(samples, output, steps=20, batch=2, size=(16, 32), report=20)
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("20 loss ")
    content = training.fit(samples, output, steps=22, batch=2, size=(16, 32))  # goes on from the checkpoint
    other = training.fit(samples, tmp_path / "other.safetensors", steps=0, batch=2, size=(16, 32), start=output)
    for name, array in content.arrays.items():  # a file is for bytes, training for units
        np.testing.assert_allclose(other.arrays[name], array, rtol=1e-5)
    assert content.notes["steps"] == 22
    assert read(output).fingerprint == content.fingerprint
    assert set(content.ranges) > {"stem", "merge_1"}
