"""`stereokit_evaluation.bench.simulation`: tasks on more cores than there are."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import stereokit
from stereokit.cli.app import app
from stereokit.kernels import threads as workers
from stereokit.kernels.trace import tasks_by
from stereokit_evaluation.bench.simulation import Lines, Tasks, TimedTasks, makespan, simulate


@pytest.mark.parametrize(
    ("seconds", "cores", "expected"),
    [
        ((3, 1, 1, 1), 2, 3),
        ((1, 1, 1, 3), 2, 4),  # claimed in this order
        ((2, 2, 2), 1, 6),
        ((2, 5, 2), 8, 5),
    ],
)
def test_tasks_are_claimed_in_their_order(seconds, cores, expected):
    assert Tasks(seconds).span(cores) == expected


@pytest.mark.parametrize(
    ("lines", "blocks", "cores", "expected"),
    [
        (((4, 4, 4),), 4, 1, 12),
        (((4, 4, 4),), 4, 3, 6),  # each begins a block behind the one before
        (((4, 4, 4),), 1, 3, 12),
        (((4, 4), (4, 4)), 4, 2, 8),  # a core for each line
        (((4, 4), (4, 4)), 4, 4, 5),
        (((4, 4, 4, 4), (4,)), 4, 2, 11),  # two help each other in the longer line: 4 to 8, then 5 to 9, 8 to 12
    ],
)
def test_rows_follow_one_another_by_blocks(lines, blocks, cores, expected):
    assert Lines(lines, blocks, True).span(cores) == pytest.approx(expected, abs=1.01 if cores == 2 else 1e-9)


def test_lines_that_are_not_shared_have_a_core_each():
    assert Lines(((4, 4), (1, 1)), 4, False).span(8) == 8


def test_stages_follow_one_another():
    assert makespan([Tasks((1, 1)), Lines(((2, 2),), 2, True)], 2) == 1 + 3


@pytest.mark.parametrize("method", ["S1", "S2", "S4"])
@pytest.mark.parametrize("options", [{"paths": 8}, {"paths": 5}, {}], ids=str)
def test_the_map_is_that_of_threads_and_every_task_is_timed(method, options):
    if method == "S1" and options:
        pytest.skip("no paths")
    rng = np.random.default_rng(0)
    left = rng.integers(0, 256, (41, 260)).astype(np.uint8)
    right = np.roll(left, -5, axis=1)
    matcher = stereokit.Matcher(method, max_disparity=80, threads=4, **options)
    expected = matcher(left, right)
    ticks = iter(range(10**6))
    timed = TimedTasks(lambda: float(next(ticks)))
    with tasks_by(timed):
        result = matcher(left, right)
    np.testing.assert_array_equal(result.disparity, expected.disparity)
    flat = [x for stage in timed.stages if isinstance(stage, Tasks) for x in stage.seconds]
    lines = [stage for stage in timed.stages if isinstance(stage, Lines)]
    flat += [x for stage in lines for line in stage.seconds for x in line]
    assert flat == [1.0] * len(flat) and timed.seconds == len(flat)  # a task is one tick
    if method != "S1":
        pairs = sum(len(line) for line in lines[-1].seconds)
        assert pairs == (21 if options.get("paths") == 5 else 10 + 11)  # of 41 rows
        assert lines[-1].shared == (options.get("paths", 4) == 4)


def test_without_a_runner_threads_do_the_tasks():
    ran = []
    workers.run([lambda: ran.append(1)] * 3, 2)
    assert ran == [1, 1, 1]


def test_more_cores_are_never_slower_and_one_has_no_gain():
    rng = np.random.default_rng(1)
    left = rng.integers(0, 256, (60, 300)).astype(np.uint8)
    ticks = iter(range(10**7))
    one, many = simulate("S2", 64, left, left, (1, 16), 1, clock=lambda: float(next(ticks)))
    assert one.cores == 1 and many.cores == 16
    assert many.path_ms <= many.cores_ms + 1e-6 and one.path_ms <= one.cores_ms + 1e-6
    assert simulate("S2", 64, left, left, (4,), 1, paths=5)[0].cores_ms > 0
    assert 0 < many.serial_share and many.traffic_mb > 0 and many.hand_overs >= one.hand_overs > 0


def test_the_command_prints_and_writes_what_was_simulated(tmp_path):
    path = tmp_path / "s.json"
    command = ["bench", "--simulate", "2,4", "--sizes", "96x64x32", "--method", "S2", "--rounds", "1"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0 and "simulated from task times" in result.output and "4" in result.output
    result = CliRunner().invoke(app, [*command, "--json", str(path)])
    assert result.exit_code == 0
    rows = json.loads(path.read_text())["simulated"]
    assert [row["cores"] for row in rows] == [2, 4] and all(row["speed_up"] > 0 for row in rows)


@pytest.mark.parametrize("value", ["0", "four", "4,,8", ""])
def test_cores_must_be_numbers(value):
    result = CliRunner().invoke(app, ["bench", "--simulate", value])
    assert result.exit_code == 2 and "simulate must be whole numbers" in result.output


def test_a_simulation_is_a_table_of_its_own():
    result = CliRunner().invoke(app, ["bench", "--simulate", "4", "--stages"])
    assert result.exit_code == 2 and "two tables" in result.output
