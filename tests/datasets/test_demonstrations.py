"""Demonstration files: round trip, replay; errors of bad files name them."""

import dataclasses
import math

import h5py
import numpy as np
import pytest
from paths import LIBRARY

from roboarm_nmp import envs
from roboarm_nmp.datasets import format as dataset_format
from roboarm_nmp.datasets.demonstrations import QUANTUM, describe, load_demos, write_demos
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.following import follow
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.subgoals import SUBGOAL_SPACING, subgoals
from roboarm_nmp.planning.planner import Planner


@pytest.fixture(scope="module")
def made():
    """Plans on `wall`, their executions, and the seeds of the plans."""
    env = envs.make("wall")
    planner, rng = Planner(env), np.random.default_rng(11)
    seeds = [3, 2**32 - 1, 5, 6, 7]
    plans = [planner.plan(*env.sample_query(rng), seed=seed) for seed in seeds]
    executions = [follow(env, plan) for plan in plans]
    env.close()
    return plans, executions, seeds


def columns(executions, seeds):
    return {
        "plan_seed": seeds,
        "digest": [execution.digest for execution in executions],
        "collided": [execution.collided for execution in executions],
    }


@pytest.fixture
def path(tmp_path, made):
    return write(tmp_path / "demos.h5", made)


def write(path, made, task="wall", parameters=None):
    plans, executions, seeds = made
    states = [execution.states for execution in executions]
    write_demos(
        path,
        task,
        4,
        plans,
        states,
        columns(executions, seeds),
        "made by a test",
        {"options": {"attempts": 3}} if parameters is None else parameters,
    )
    return path


def hand_made():
    """Arguments of `write_demos`: random plans on `no_obstacles`, executions far from them."""
    rng = np.random.default_rng(0)

    def configurations(rows):
        return rng.uniform(-0.9, 0.9, (rows, 7))

    return {
        "task": "no_obstacles",
        "seed": 0,
        "plans": [PANDA.denormalise(configurations(n)).astype(np.float32) for n in (2, 3, 4)],
        "executions": [configurations(rows).astype(np.float32) for rows in (3, 2, 4)],
        "columns": {"plan_seed": [1, 2, 3], "digest": [4, 5, 6], "collided": [0, 1, 0]},
        "made_by": "made by a test",
        "parameters": {},
    }


# --- Reading and writing


def test_round_trip_is_exact_up_to_rounding(path, made):
    plans, executions, seeds = made
    demos = load_demos(path)
    assert (demos.task, demos.seed, demos.made_by) == ("wall", 4, "made by a test")
    assert demos.parameters["options"] == {"attempts": 3}
    assert len(demos) == len(list(demos)) == 5
    for i, (demo, plan, execution) in enumerate(zip(demos, plans, executions, strict=True)):
        assert demo.plan.dtype == demo.states.dtype == demo.actions.dtype == np.float32
        assert demo.plan.tobytes() == plan.tobytes()
        assert demo.start.tobytes() == demos.start[i].tobytes() == plan[0].tobytes()
        assert demo.goal.tobytes() == demos.goal[i].tobytes() == plan[-1].tobytes()
        np.testing.assert_allclose(
            demo.states, execution.states, rtol=0, atol=QUANTUM / 2 + 1e-6
        )  # fails for other shapes, too
        assert demo.digest == demos.digest[i] == execution.digest
        assert demos.plan_seed[i] == seeds[i]
        assert bool(demos.collided[i]) == execution.collided
        rows = slice(demos.offsets[i], demos.offsets[i + 1])
        np.testing.assert_array_equal(demos.states[rows], demo.states)
        np.testing.assert_array_equal(demos.actions[rows][:-1], demo.actions)
        rows = slice(demos.plan_offsets[i], demos.plan_offsets[i + 1])
        np.testing.assert_array_equal(demos.plan[rows], plan)
    assert demos.offsets[0] == 0 and demos.offsets[-1] == len(demos.states) == len(demos.actions)


def test_demonstrations_are_indexed_like_queries(path):
    demos = load_demos(path)
    assert demos[-1].digest == demos[4].digest and demos[np.int64(1)].digest == demos[1].digest
    for index in (slice(1, 4), [4, 0], np.arange(5) > 2):
        for one, i in zip(demos[index], np.arange(5)[index], strict=True):
            for name in ("start", "goal", "plan", "states", "actions", "digest"):
                np.testing.assert_array_equal(getattr(one, name), getattr(demos[i], name))
            assert one.scene == demos[i].scene
    assert describe(demos[:2])["steps"] == np.mean([len(demos[i].actions) for i in (0, 1)])
    with pytest.raises(IndexError, match="demonstration 5 of 5"):
        demos[5]


def naive_subgoals(plan):
    """Sub-goals (normalised) by the book: each straight piece in the fewest equal steps."""
    corners = (2 * plan.astype(np.float64) - PANDA.upper - PANDA.lower) / (
        PANDA.upper - PANDA.lower
    )
    points = [corners[0]]
    for here, there in zip(corners[:-1], corners[1:], strict=True):
        pieces = 1
        while np.linalg.norm(there - here) / pieces > 0.95 * 0.03:
            pieces += 1
        points += [here + (there - here) * k / pieces for k in range(1, pieces + 1)]
    return np.array(points)


def test_actions_lead_to_the_next_subgoal_and_are_clipped(path):
    demos = load_demos(path)
    clipped = 0
    for i, demo in enumerate(demos):
        points = naive_subgoals(demo.plan)
        for t, action in enumerate(demo.actions):
            wanted = points[min(t + 1, len(points) - 1)] - demo.states[t]
            size = np.sqrt((wanted**2).sum())
            if size > 0.03:
                wanted = wanted * 0.03 / size
                clipped += 1
            np.testing.assert_allclose(action, wanted, rtol=0, atol=1e-6)
        assert not demos.actions[demos.offsets[i + 1] - 1].any()
    assert np.linalg.norm(demos.actions, axis=1).max() <= 0.03 + 1e-6
    assert 0 < clipped < 0.5 * len(demos.actions)


def test_subgoals_speed_up_and_slow_down_between_waypoints():
    steps = 5
    robot = dataclasses.replace(PANDA, acceleration_steps=steps)
    state = np.zeros(7)
    for length in (1e-4, 0.1, 1.0):
        path = robot.denormalise([state, state + length / math.sqrt(7), state])
        points = subgoals(path, robot)
        there = len(points) // 2
        np.testing.assert_allclose(points[there], state + length / math.sqrt(7), atol=1e-12)
        np.testing.assert_allclose(points, points[::-1], atol=1e-12)  # braking mirrors speeding up
        moved = np.linalg.norm(np.diff(points, axis=0), axis=1)[:there]
        assert moved.max() <= SUBGOAL_SPACING + 1e-12
        speeds = np.concatenate([[0.0], moved, [0.0]])
        assert np.abs(np.diff(speeds)).max() <= SUBGOAL_SPACING / steps + 1e-12
        # One step less would not do.
        less = [min(i + 1, there - 1 - i, steps) for i in range(there - 1)]
        assert sum(less) * SUBGOAL_SPACING / steps < length


def test_statistics_equal_those_by_hand(tmp_path):
    arguments = hand_made()
    arguments["parameters"] = {"counts": {"queries_given_up": 1, "attempts": 5, "collided": 2}}
    write_demos(tmp_path / "demos.h5", **arguments)
    numbers = describe(load_demos(tmp_path / "demos.h5"))
    half, lengths, ratios = (PANDA.upper - PANDA.lower) / 2, [], []
    for states, plan in zip(arguments["executions"], arguments["plans"], strict=True):
        moves = np.diff(states.astype(np.float64), axis=0)
        lengths.append(np.linalg.norm(moves * half, axis=1).sum())
        straight = np.linalg.norm((plan[-1] - plan[0].astype(np.float64)) / half)
        ratios.append(np.linalg.norm(moves, axis=1).sum() / straight)
    expected = {
        "demonstrations": 3,
        "steps": (2 + 1 + 3) / 3,
        "steps_95": 2.9,
        "path_length": np.mean(lengths),
        "length_ratio": np.mean(ratios),
        "waypoints": (2 + 3 + 4) / 3,
        "with_contacts": 1,
        "solved": 3 / 4,
        "queries_given_up": 1,
        "attempts": 5,
        "collided": 2,
    }
    assert numbers == pytest.approx(expected, rel=1e-3)


# --- Rejected when writing


def the_same_query_twice(arguments):
    arguments["plans"][2][[0, -1]] = arguments["plans"][0][[0, -1]]


def a_test_query(arguments):
    start, goal, _ = load_queries("no_obstacles", "test")[17]
    arguments["plans"][1][0], arguments["plans"][1][-1] = start, goal


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (the_same_query_twice, "1 queries are in it twice"),
        (a_test_query, "1 queries are test queries of no_obstacles"),
    ],
)
def test_bad_demonstrations_are_not_written(path, change, complaint):
    before = path.read_bytes()
    arguments = hand_made()
    change(arguments)
    with pytest.raises(DatasetError, match=complaint) as caught:
        write_demos(path, **arguments)
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before


# --- Bad files


def sign_again(path):
    """Give a changed file the checksum it should have."""
    with h5py.File(path, "r+") as file:
        attributes = {
            name: dataset_format.attribute(file, name) for name in dataset_format.ATTRIBUTES
        }
        arrays = {name: file[name][()] for name in dataset_format.DEMO_ARRAYS}
        file.attrs["checksum"] = np.bytes_(dataset_format.checksum(attributes, arrays))


def a_row_too_many(path):
    with h5py.File(path, "r+") as file:
        file["length"][1] += 1
    sign_again(path)


def test_lengths_that_do_not_add_up_are_rejected(path):
    a_row_too_many(path)
    with pytest.raises(DatasetError, match=f"{path}: .*the lengths do not add up"):
        load_demos(path)


# --- Files of the project


FILES = sorted((LIBRARY / "datasets" / "demos").glob("*.h5"))


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_demonstrations_of_the_project_repeat(file):
    demos = load_demos(file.stem)
    assert len(demos) == 10_000 and not demos.collided.any()
    env = envs.make(file.stem)
    for i in np.random.default_rng(0).choice(len(demos), 3, replace=False):
        execution = follow(env, demos[i].plan, demos[i].scene)
        assert execution.reached and not execution.collided
        np.testing.assert_allclose(execution.states, demos[i].states, rtol=0, atol=demos.quantum)
    env.close()
