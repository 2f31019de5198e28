"""Training of the evidence refiner: what is stored, its loss, and a short run that learns."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from stereokit_refiners.networks.evidence import CHANNELS, GAINS, LOGITS  # noqa: E402
from stereokit_refiners.runtimes.evidence import hypotheses  # noqa: E402
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
    fields["input"] = rng.integers(-100, 100, (sum(CHANNELS.values()), 3, 5)) / training._INPUT_STEPS
    unpacked = training.unpacked(training.packed(fields))
    for name, array in fields.items():
        expected = np.rint(array * training._INPUT_STEPS) if name == "input" else array
        np.testing.assert_array_equal(unpacked[name], expected.transpose(1, 2, 0))


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

    half = np.mean([fields.coarse[i::2, j::2] for i in (0, 1) for j in (0, 1)], axis=0)

    def folded(plane, side):
        return training._folded(plane, side)

    inputs = [
        np.concatenate([folded(values - half, 2) for values in fields.others]),
        folded(fields.coarse - half.repeat(2, 0).repeat(2, 1), 4), training._gains(fields.around),
    ]  # fmt: skip
    tensors = [torch.from_numpy(part.astype(np.float32))[None] for part in (head.transpose(2, 0, 1), *inputs)]
    apart = torch.tensor([float(fields.apart)])
    less = training.mixture(*tensors, apart)[0].numpy()
    height, width = fields.coarse.shape
    full = less.reshape(4, 4, height // 4, width // 4).transpose(2, 0, 3, 1).reshape(height, width)
    full = (full + fields.coarse + fields.base)[: left.shape[0], : left.shape[1]]
    np.testing.assert_allclose(full, expected, atol=1e-3)


def test_samples_say_what_is_missing_and_who_sees_it():
    fields, outliers = _fields()
    assert 0 <= outliers < 0.3
    kinds = fields["kind"]
    assert set(np.unique(kinds)) == {1, 2}
    assert np.median(np.abs(fields["miss"][kinds == 1].astype(float))) < 0.3


def test_the_identity_costs_what_the_coarse_map_costs_and_harm_costs_more():
    fields = {name: torch.from_numpy(a[None]).permute(0, 3, 1, 2) for name, a in _fields()[0].items()}
    head = torch.zeros(1, LOGITS + GAINS + 4, *fields["miss"].shape[2:])
    head[:, :LOGITS] = -40
    sure = 0.05 * np.log(2)  # of logits of 0, whatever is right
    value, before = training.loss(head, fields, torch.ones(1))
    assert float(value.detach()) == pytest.approx(float(before) + sure, rel=1e-4)
    head[:, :4] = 40  # always a pixel less
    worse, same = training.loss(head, fields, torch.ones(1))
    assert float(same) == float(before)
    assert float(worse) > float(value)


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
    assert content.notes["steps"] == 22
    assert read(output).fingerprint == content.fingerprint
    assert set(content.ranges) > {"stem", "merge_0"}
