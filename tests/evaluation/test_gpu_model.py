"""The model of GPUs: loops of assembled code, bounds by hand numbers, the command and what it refuses."""

from __future__ import annotations

import json
from collections import Counter
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from stereokit import Matcher
from stereokit.cli.app import app
from stereokit.cuda.driver import has_device
from stereokit.errors import DeviceError
from stereokit_evaluation.common.sizes import Size
from stereokit_evaluation.gpu_model import model as gpu_model
from stereokit_evaluation.gpu_model import sass
from stereokit_evaluation.gpu_model import table as gpu_report
from stereokit_evaluation.gpu_model.machines import MACHINES, Machine, libsgm_bytes
from stereokit_evaluation.gpu_model.model import Launch, modelled
from stereokit_evaluation.gpu_model.sass import Code, Resources, outer_loops, parse_sass, warps_that_fit
from stereokit_evaluation.gpu_model.work import Work

SASS = """
        .section        .text.kernel
.text.kernel:
        /*0000*/                   IMAD.MOV.U32 R1, RZ, RZ, c[0x0][0x28] ;
        /*0010*/              @!P0 EXIT ;
.L_x_0:
        /*0020*/                   LDG.E.U8.SYS R2, [R4] ;
        /*0030*/                   LDG.E.U8.SYS R3, [R4+0x1] ;
.L_x_1:
        /*0040*/                   SHFL.UP P1, R5, R2, 0x1, RZ ;
        /*0050*/               @P1 BRA `(.L_x_1) ;
        /*0060*/                   STG.E.SYS [R6], R5 ;
        /*0070*/                   STG.E.SYS [R6+0x4], R5 ;
        /*0080*/               @P2 BRA `(.L_x_0) ;
        /*0090*/                   FADD R1, R1, R2 ;
        /*00a0*/                   EXIT ;
.L_x_2:
        /*00b0*/                   BRA `(.L_x_2);
        /*00c0*/                   NOP;
"""


def bench(*words):
    return CliRunner().invoke(app, ["bench", *map(str, words)])


# code


def test_loops_and_units_of_assembled_code():
    code = parse_sass(SASS)
    assert len(code.units) == 12
    assert code.loops == ((2, 9),)  # the loop inside it and the branch to itself are none
    assert Counter(code.units) == {"multiply": 1, "other": 5, "memory": 4, "shuffle": 1, "float": 1}
    assert code.hot() == (2, 9)


def test_unrolled_passes_are_told_by_their_accesses():
    code = parse_sass(SASS)
    outside = Counter({"multiply": 1, "other": 3, "float": 1})
    twice = code.executed(10, 2, False)  # the source loads and stores once in a pass, the code twice
    assert twice == outside + Counter({"memory": 20, "shuffle": 5, "other": 10})
    assert sum(code.executed(10, None, False).values()) == 5 + 10 * 7
    assert code.executed(0, None, True)["memory"] == 0


def test_the_hot_loop_is_the_dearest_or_all_of_them():
    units = ("memory", *["other"] * 3, "memory", "memory", *["other"] * 4)
    code = Code(units, ((0, 4), (4, 10)))
    assert code.hot() == (4, 10)
    assert code.hot(1) == (0, 4)  # one pass is 4 instructions there, and 3 in the longer one
    assert sum(code.executed(2, 1, False).values()) == 8
    assert sum(code.executed(2, 3, True).values()) == 20
    assert Code(("other",) * 5, ()).executed(7, 2, False) == {"other": 5}


def test_overlapping_loops_are_one():
    assert outer_loops([(9, 2), (5, 4), (3, 3), (12, 8), (20, 15), (1, 7)]) == ((2, 13), (15, 21))


def test_occupancy():
    assert warps_that_fit(32, 128, "sm_90") == (64, 64)
    assert warps_that_fit(33, 128, "sm_90") == (48, 64)  # 40 registers: 12 blocks of 4 warps
    assert warps_that_fit(128, 128, "sm_87") == (16, 48)


# time

MACHINE = Machine("hand", "sm_90", 2, 1.0, 100.0, 128, 500, 10.0, "by hand")


def launch(blocks, read=0, **work):
    return Launch(SimpleNamespace(name="k", block=128), blocks, Work({}, {}, **work), read, 0)


def test_bounds_by_hand():
    code = Code(("integer",) * 100, ())
    time = modelled(launch(3, read=75_000_000), code, 32, MACHINE)
    assert time.memory == pytest.approx(1.0)  # 75 MB at 75 % of 100 GB/s
    assert time.units == pytest.approx(8 * 100 * 32 / 64 / 1e6)  # two blocks, 8 warps, on the busier of two
    assert time.waiting == pytest.approx((100 * 4 + 500) / 1e6)  # all warps fit: one turn
    assert (time.bound, time.ms) == ("memory", pytest.approx(1.01))


def test_schedulers_bound_what_no_unit_does():
    code = Code(("integer", "other", "other", "other"), ())
    assert modelled(launch(2), code, 32, MACHINE).units == pytest.approx(4 * 4 / 4 / 1e6)


def test_warps_take_turns_and_shuffles_wait():
    code = Code(("shuffle",) * 10, ())
    time = modelled(launch(64), code, 128, MACHINE)  # 128 warps, 16 of them at a time
    assert time.waiting == pytest.approx(8 * (10 * 24 + 500) / 1e6)
    assert modelled(launch(64, ahead=True), code, 128, MACHINE).waiting == pytest.approx(8 * 500 / 1e6)


def test_libsgm_writes_and_reads_each_path():
    assert libsgm_bytes(1024 * 440, 128, 4) == 8 * 1024 * 440 * 128


def test_machines_have_what_the_model_needs():
    for machine in MACHINES:
        assert machine.architecture in sass.ARCHITECTURES and machine.source
        assert set(machine.rates) == set(sass.UNITS)


# launches


@pytest.fixture
def kernels():
    pytest.importorskip("numba_cuda")


@pytest.mark.parametrize("levels", [16, 64, 128, 200])
@pytest.mark.parametrize("scale", [1, 0.5])
@pytest.mark.parametrize("method", ["S1", "S2", "S3", "S4"])
def test_every_launch_of_a_default_match_is_known(kernels, method, scale, levels):
    matcher = Matcher(method, max_disparity=levels, scale=scale, device="cpu")
    launches = gpu_model.record(matcher, 301, 120)
    assert len(launches) > 10
    assert all(one.blocks >= 1 and one.moved > 0 for one in launches)


def test_what_is_not_known_is_refused(kernels):
    matcher = Matcher("S1", mode="sum", device="cpu")
    with pytest.raises(DeviceError, match="kernel must be one of a default match to be modelled, got 'dt_edges_sum'"):
        gpu_model.record(matcher, 301, 120)


@pytest.mark.parametrize("method", ["S2", "S4"])
def test_full_size_moves_at_most_half_more_than_libsgm(kernels, method):
    size = Size("K", 1242, 375, 128)
    matcher, launches = gpu_report.launches_of([method], size, 1)[method]
    match = gpu_report.Match(method, size, 1, 128, 4, launches, [], {})
    assert match.pixels == 1242 * 375 and matcher.aggregation.paths == 4
    assert 1.3 < match.of_libsgm < 1.5
    assert match.moved < 1.6 * libsgm_bytes(match.pixels, 128, 4)  # of all other launches too


# command


@pytest.fixture
def assembled(monkeypatch, kernels):
    """Let every kernel be ten instructions, without a compiler."""
    monkeypatch.setattr(sass, "tool", lambda name: name)
    code = Code(("memory",) * 2 + ("integer",) * 8, ())
    monkeypatch.setattr(gpu_report, "code_of", lambda ptx, architecture: (code, Resources(32, 0, 0)))
    from stereokit.cuda.kernel import Kernel

    monkeypatch.setattr(Kernel, "ptx", lambda kernel, capability: "")


def test_the_tables_say_modelled(assembled):
    done = bench("--model", "--method", "S4", "--method", "S1", "--sizes", "101x50x32", "--scale", 0.5)
    assert done.exit_code == 0, done.output
    tables = [line for line in done.stdout.splitlines() if line.lstrip().startswith("modelled: S")]
    assert [table.split()[1] for table in tables] == ["S1", "S4"][::-1]
    assert "101x50, matched at half size, 16 levels" in tables[0]
    heads = [line for line in done.stdout.splitlines() if line.lstrip().startswith("kernel")]
    assert all(line.count("modelled ms") == len(MACHINES) for line in heads) and len(heads) == 2
    assert "no GPU has run this" in done.stdout and "12.64" in done.stdout
    assert done.stdout.count("libSGM's path") == 1  # S4 only


def test_json_has_every_launch_and_its_sum(assembled):
    done = bench("--model", "--method", "S2", "--sizes", "101x50x32", "--json", "-")
    document = json.loads(done.stdout)
    (match,) = document["modelled"]
    assert (match["method"], match["levels"], match["scale"]) == ("census+sgm", 32, 1)
    names = {machine.name for machine in MACHINES}
    assert set(match["modelled_ms"]) == names
    for name in names:
        parts = [one["modelled_ms"][name] for one in match["launches"]]
        assert match["modelled_ms"][name] == pytest.approx(sum(part["all"] for part in parts))
        for part in parts:
            longest = max(part["memory"], part["units"], part["waiting"])
            assert part["all"] == pytest.approx(longest + part["launch"])
    assert match["bytes"] == sum(one["read"] + one["written"] for one in match["launches"])
    assert {one["name"] for one in document["published"]} >= {"libSGM, 4 paths"}
    assert document["versions"]["stereokit"]


def test_without_the_tools_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(sass, "tool", lambda name: None)
    done = bench("--model", "--sizes", "101x50x32")
    assert done.exit_code == 2 and not done.stdout
    assert "pip install 'stereokit[cuda-test]'" in done.stderr and done.stderr.count("\n") == 1
    assert "ptxas, nvdisasm" in done.stderr


def test_a_tool_that_fails_is_told_in_one_line(monkeypatch, tmp_path):
    tool = tmp_path / "ptxas"
    tool.write_text("#!/bin/sh\necho 'ptxas fatal: no such target' >&2\nexit 1\n")
    tool.chmod(0o755)
    monkeypatch.setattr(sass, "tool", lambda name: tool)
    with pytest.raises(DeviceError, match=r"^ptxas must take the kernel, but it says: ptxas fatal: no such target$"):
        sass.resources("", "sm_72")


def test_the_model_looks_at_no_images(tmp_path):
    for name in ("l.png", "r.png"):
        assert cv2.imwrite(str(tmp_path / name), np.zeros((40, 60), np.uint8))
    done = bench("--model", "--left", tmp_path / "l.png", "--right", tmp_path / "r.png")
    assert done.exit_code == 2 and "left must not come with model" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.skipif(has_device(), reason="there is a GPU")
def test_without_a_gpu_there_is_nothing_to_time():
    done = bench("--device", "cuda", "--sizes", "101x50x32")
    assert done.exit_code == 2 and not done.stdout
    assert done.stderr.startswith("error: device 'cuda' cannot be used here") and done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--device", "gpu"), "device must be 'cpu' or 'cuda', got 'gpu'"),
        (("--model", "--pipeline"), "model and pipeline are two tables, got both; choose one"),
        (("--model", "--device", "cuda"), "model and device cuda are two tables, got both; choose one"),
        (("--device", "cuda", "--stages"), "device cuda and stages are two tables, got both; choose one"),
        (("--model", "--scale", "0.3"), "scale must be 1 or 0.5, got 0.3"),
        (("--model", "--scale", "nan"), "scale must be 1 or 0.5, got nan"),
        (("--scale", "0.5"), "scale must come with model or device cuda, got 0.5 alone"),
        (("--model", "--sizes", "Q"), "sizes must be K, M, H or WxHxD"),
        (("--model", "--method", "S9"), "no method named 'S9'"),
        (("--model", "--json", "no/such/folder.json"), "json 'no/such/folder.json'"),
    ],
)
def test_bad_input_exits_with_2_and_one_line(words, message):
    done = bench(*words)
    assert done.exit_code == 2 and not done.stdout
    assert done.stderr.startswith("error: ") and message in done.stderr and done.stderr.count("\n") == 1
