"""The planner: exact ends, no collisions, the clearance asked for, and the same path for a seed."""

import dataclasses
import math
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from paths import ROOT

from roboarm_nmp import envs
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.arm_env import RoboArmEnv
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.robots.panda import PANDA
from roboarm_nmp.envs.robots.rotations import rotation_angle
from roboarm_nmp.envs.scenes.primitives import Scene
from roboarm_nmp.envs.subgoals import subgoals
from roboarm_nmp.planning.planner import (
    PLANNERS,
    Planner,
    PlanningError,
)
from roboarm_nmp.utils.bullet import pybullet as p

# Configurations on `wall`: two without contact, and three in collision.
READY = np.array([1.0, -0.5, 0.0, -1.8, 0.0, 1.5, 0.0], np.float32)
TURNED = np.array([1.3, -0.2, 0.3, -1.5, 0.3, 1.8, 0.3], np.float32)
INTO_THE_WALL = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 1.5, 0.0], np.float32)
INTO_THE_TABLE = np.array([1.0, 1.2, 0.0, -1.6, 0.0, 2.0, 0.0], np.float32)
INTO_ITSELF = np.array([1.0, -0.5, 0.0, -1.8, 0.0, -0.08, 0.0], np.float32)


@pytest.fixture(scope="module")
def worlds():
    """Task -> environment."""
    worlds = {task: envs.make(task) for task in ("no_obstacles", "wall", "double_walls")}
    yield worlds
    for env in worlds.values():
        env.close()


def interpolate(path, step):
    """Configurations (rad) along a path, at most `step` apart in the normalised space."""
    corners = PANDA.normalise(path.astype(np.float64))
    points = [corners[0]]
    for here, there in zip(corners[:-1], corners[1:], strict=True):
        pieces = int(np.linalg.norm(there - here) / step) + 1
        points += [here + (there - here) * i / pieces for i in range(1, pieces + 1)]
    return PANDA.denormalise(np.array(points))


def length(path):
    return np.linalg.norm(np.diff(PANDA.normalise(path), axis=0), axis=1).sum()


def is_path_of(path, start, goal):
    assert path.dtype == np.float32 and path.ndim == 2 and path.shape[1] == 7
    return path[0].tobytes() == start.tobytes() and path[-1].tobytes() == goal.tobytes()


# --- Paths


def test_paths_have_the_exact_ends_of_the_query_and_no_collision(worlds):
    env, queries = worlds["double_walls"], load_queries("double_walls")
    planner = Planner(env)
    bent = 0
    for seed, (start, goal, _) in enumerate(queries[:12], 1):
        path = planner.plan(start, goal, seed=seed)
        assert is_path_of(path, start, goal)
        assert ((path >= PANDA.lower) & (path <= PANDA.upper)).all()
        assert not any(env.in_collision(point) for point in interpolate(path, 0.01))
        direct = np.stack([start, goal])
        bent += any(env.in_collision(point) for point in interpolate(direct, 0.01))
    assert bent >= 5  # many straight lines collide


def test_finished_paths_touch_nothing_anywhere():
    queries = load_queries("random_boxes_hard", "validation")[:40]
    env = envs.make("random_boxes_hard")
    planner = Planner(env)
    for seed, query in enumerate(queries):
        states = PANDA.normalise(planner.plan(*query, seed=seed).astype(np.float64)).clip(-1, 1)
        checker = CollisionChecker(query.scene)
        assert checker.is_motion_free(states[:-1], states[1:], resolution=0.001).all()
        assert checker.is_motion_free(states[:-1], states[1:], continuous=True).all()
    env.close()


def test_planner_follows_a_change_of_scene(worlds):
    env, (start, goal, _) = envs.make("no_obstacles"), load_queries("wall")[4]
    planner = Planner(env)
    assert any(worlds["wall"].in_collision(c) for c in interpolate(np.stack([start, goal]), 0.01))
    planner.plan(start, goal, seed=1)
    env.set_scene(worlds["wall"].scene)
    path = planner.plan(start, goal, seed=1)
    assert not any(worlds["wall"].in_collision(c) for c in interpolate(path, 0.01))
    env.close()


# --- Sets of goals, goal poses


def test_path_to_a_set_ends_at_a_goal_that_is_free(worlds):
    goals = np.stack([INTO_THE_WALL, TURNED + np.float32(0.8), TURNED, INTO_THE_TABLE])
    planner = Planner(worlds["wall"])
    path = planner.plan(READY, goals, seed=1)
    assert is_path_of(path, READY, goals[2]) or is_path_of(path, READY, goals[1])
    assert path.tobytes() == planner.plan(READY, goals, seed=1).tobytes()
    # A set of one is that goal; whatever comes first, the nearest goal is preferred.
    alone = planner.plan(READY, goals[2:3], seed=1)
    assert alone.tobytes() == planner.plan(READY, TURNED, seed=1).tobytes()
    near, far = READY + np.float32(0.02), np.array([-1.5, -0.5, 0, -1.8, 0, 1.5, 0], np.float32)
    assert is_path_of(planner.plan(READY, np.stack([far, near]), seed=2), READY, near)


@pytest.mark.parametrize(
    ("goals", "complaint"),
    [
        (
            np.stack([INTO_THE_WALL, INTO_ITSELF]),
            "none of the 2 goals is possible: the nearest one is in c",
        ),
        (np.zeros((2, 6)), "a set of goals has shape"),
    ],
)
def test_set_without_a_possible_goal_is_rejected(worlds, goals, complaint):
    with pytest.raises(ValueError, match=complaint):
        Planner(worlds["wall"]).plan(READY, goals, seed=1)


def test_path_to_a_goal_pose_is_followed_without_contact(worlds):
    env, reached = worlds["wall"], 0
    planner = Planner(env)
    for seed, query in enumerate(load_queries("wall", "validation")[:5]):
        pose = PANDA.end_effector_pose(query.goal)
        path = planner.plan(query.start, seed=seed, goal_pose=pose)
        assert path[0].tobytes() == query.start.tobytes()
        end = PANDA.end_effector_pose(path[-1])
        assert np.linalg.norm(end[:3] - pose[:3]) <= 1e-4
        assert rotation_angle(end[3:], pose[3:]) <= 1e-3
        env.reset_specific(query.start, path[-1])
        for target in subgoals(path, PANDA)[1:]:
            info = env.step(target - env.world.read_arm()[0])[-1]
        reached += info["ee_distance"] < 0.02 and not info["collision_so_far"]
    assert reached >= 4


def test_pose_without_a_free_configuration_is_a_planning_error(worlds):
    planner = Planner(worlds["wall"])
    into_the_wall = PANDA.end_effector_pose(INTO_THE_WALL)
    for pose in (np.r_[3.0, into_the_wall[1:]], np.r_[into_the_wall[:2], -0.5, 0, 0, 0, 1]):
        with pytest.raises(PlanningError, match="no collision-free configuration has the goal"):
            planner.plan(READY, seed=1, goal_pose=pose)


# --- The same path for a seed


def test_seed_gives_the_same_path_whatever_was_planned_before(worlds):
    planner = Planner(worlds["double_walls"])
    queries = load_queries("double_walls")
    first = planner.plan(*queries[0], seed=7)
    checks = planner.checks
    others = [planner.plan(*queries[i], seed=7 + i) for i in (3, 1)]
    again = planner.plan(*queries[0], seed=7)
    assert again.tobytes() == first.tobytes() and planner.checks == checks
    fresh = Planner(worlds["double_walls"])
    assert fresh.plan(*queries[1], seed=8).tobytes() == others[1].tobytes()


PLANS = """
    import zlib
    import roboarm_nmp
    from roboarm_nmp.planning.planner import Planner
    from roboarm_nmp.datasets.queries import load_queries

    planner, digest = Planner(roboarm_nmp.make("random_boxes_hard")), 0
    for seed, query in enumerate(load_queries("random_boxes_hard", "validation")[:50]):
        digest = zlib.crc32(planner.plan(*query, seed=seed).tobytes(), digest)
    print("plans:", digest)
"""


@pytest.mark.slow
def test_processors_with_and_without_avx512_give_the_same_paths(tmp_path):
    older = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma"}
    answers = set()
    for change in ({}, older | {"NUMBA_CACHE_DIR": str(tmp_path)}):
        result = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(PLANS)],
            cwd=ROOT,
            env=os.environ | change,
            capture_output=True,
            text=True,
            check=True,
        )
        answers.add(result.stdout.splitlines()[-1])
    assert len(answers) == 1


SEARCHES = """
    import sys, zlib
    import roboarm_nmp
    from roboarm_nmp.planning.planner import Planner
    from roboarm_nmp.datasets.queries import load_queries

    env, queries = roboarm_nmp.make("wall"), load_queries("wall")
    for name in sys.argv[2:]:
        for seed in range(int(sys.argv[1])):
            Planner(env, "RRT").plan(*queries[8], seed=50 + seed)
        planner = Planner(env, name, max_checks=8000, simplify=0)
        path = planner.plan(*queries[0], seed=5)
        print("search:", name, planner.checks, zlib.crc32(path.tobytes()))
"""


def test_seed_gives_the_same_search_in_another_process():
    names = ["RRTConnect", "LBKPIECE1", "RRTstar", "BITstar"]
    searches = []
    for arguments in (["0", *names], ["1", *reversed(names)]):
        result = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(SEARCHES), *arguments],
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        assert result.returncode == 0, result.stderr
        searches.append(sorted(x for x in result.stdout.splitlines() if x.startswith("search:")))
    assert searches[0] == searches[1] and len(searches[0]) == len(names)


# --- Planners


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_solves_an_easy_query(worlds, name):
    env = worlds["no_obstacles"]
    start, goal, _ = load_queries("no_obstacles")[0]
    # FMT and BFMT first connect a thousand samples; the "stars" use all of their limit.
    planner = Planner(env, name, max_checks=100_000 if "FMT" in name else 3000)
    path = planner.plan(start, goal, seed=1, time_limit=math.inf)
    assert is_path_of(path, start, goal)
    assert not any(env.in_collision(point) for point in interpolate(path, 0.02))
    assert length(path) < 1.2 * length(np.stack([start, goal]))  # simplified


@pytest.mark.parametrize("simplify", [1, 0])
def test_own_planner_checks_configurations_and_gives_the_path(worlds, simplify):
    env, asked = worlds["wall"], []

    def over_the_top(is_valid, start, goal, rng):
        top = PANDA.normalise([0.0, -0.3, 0.0, -0.2, 0.0, 1.5, 0.0])
        asked.extend([is_valid(top), is_valid(PANDA.normalise(INTO_THE_WALL)), rng.integers(2**40)])
        assert is_valid.checks == 2 and not is_valid.exhausted()
        return [start, top, goal]

    planner = Planner(env, over_the_top, simplify=simplify)
    path = planner.plan(READY, TURNED, seed=3)
    assert is_path_of(path, READY, TURNED)
    search = int(np.random.default_rng(3).integers(1, 2**32))  # the seed of the first search
    assert asked == [True, False, np.random.default_rng(search).integers(2**40)]
    if simplify:
        assert planner.checks > 2
    else:
        assert planner.checks == 2
        np.testing.assert_allclose(path[1], [0.0, -0.3, 0.0, -0.2, 0.0, 1.5, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        (lambda start, goal: [start[:6], goal[:6]], r"shape \(2, 6\)"),
        (lambda start, goal: [start, start * np.nan, goal], r"leaves \[-1, 1\]\^7"),
    ],
)
def test_bad_path_of_an_own_planner_is_rejected(worlds, answer, complaint):
    start, goal, _ = load_queries("no_obstacles")[0]
    planner = Planner(worlds["no_obstacles"], lambda is_valid, *query: answer(*query[:2]))
    with pytest.raises(ValueError, match=complaint):
        planner.plan(start, goal, seed=1)


def test_own_planner_checks_many_configurations_at_once(worlds):
    asked = []

    def batched(is_valid, start, goal, rng):
        points = rng.uniform(-1, 1, (50, 7))
        free = is_valid.free(points)
        assert is_valid.checks == 50
        assert free.tolist() == [is_valid(point) for point in points]
        before, free_points = is_valid.checks, points[free]
        motions = is_valid.motions_free(start, free_points)
        assert is_valid.checks >= before + len(free_points)
        one_by_one = [is_valid.motion_free(tuple(start), tuple(point)) for point in free_points]
        assert motions.tolist() == one_by_one
        asked.extend([free.mean(), motions.mean()])
        return [start, free_points[motions.argmax()], goal]

    Planner(worlds["wall"], batched, simplify=0).plan(READY, TURNED, seed=3)
    assert 0 < asked[0] < 1 and 0 < asked[1] < 1


# --- Long searches

# Queries of the original problems of MotionBenchMaker that need more than one search of RRT-Connect
# with constant margins and 30,000 checks.
HARD = {"benchmaker_bookshelf_thin": (5, 88), "benchmaker_bookshelf_tall": (8,)}


def test_hard_queries_are_solved():
    for task, numbers in HARD.items():
        env = envs.make(task)
        planner = Planner(env)
        queries = load_queries(task, "original")
        for number in numbers:
            path = planner.plan(*queries[number], seed=[3, number], time_limit=60.0)
            assert is_path_of(path, queries[number].start, queries[number].goal)
            assert not any(env.in_collision(point) for point in interpolate(path, 0.01))
        env.close()


def test_max_checks_holds_for_all_searches_of_a_plan_together():
    env = envs.make("double_walls", horizon=12)  # so short that every path is too long
    start, goal, _ = load_queries("double_walls")[0]
    limits = []

    def search(is_valid, start, goal, rng):
        while not is_valid.exhausted() and is_valid.checks < 40:
            is_valid(start)
        limits.append(is_valid.checks)
        return None if is_valid.exhausted() else [start, goal]

    planner = Planner(env, search, simplify=0, max_checks=100)
    path = planner.plan(start, goal, seed=1)
    assert limits == [40, 40, 20] and planner.checks == 100
    assert is_path_of(path, start, goal)  # what the earlier searches have found
    env.close()


def test_geometry_source_replaces_the_obstacles_of_the_scene(worlds):
    env, seen = worlds["wall"], []

    def empty(scene):
        seen.append(scene)
        return CollisionChecker(Scene())

    start, goal, _ = load_queries("wall")[4]
    path = Planner(env, geometry_source=empty).plan(start, goal, seed=1)
    assert len(path) == 2 and any(env.in_collision(point) for point in interpolate(path, 0.01))
    assert seen and all(scene is env.scene for scene in seen)


# --- Clearance


@pytest.fixture(scope="module")
def box():
    """An environment with nothing but the box of `wall`."""
    env = envs.RoboArmEnv(Scene(envs.TASKS["wall"].scene.obstacles, table=None, floor=None))
    yield env
    env.close()


def distance(env, configuration):
    """Of the arm from the box, m, by PyBullet's query for closest points; at most 0.2."""
    env.world.arm.set_configuration(configuration)
    (body,) = {0, 1} - {env.body}
    points = p.getClosestPoints(env.body, body, 0.2, physicsClientId=env.client)
    return min((point[8] for point in points), default=0.2)


def nearest(env, path):
    return min(distance(env, point) for point in interpolate(path, 0.01))


def test_paths_keep_the_clearance(box):
    wide, narrow = Planner(box, clearance=0.03), Planner(box, clearance=0.0)
    close = []
    # Of these, start and goal are 0.056 m and more from the box, which the straight line crosses.
    for seed, (start, goal, _) in enumerate(load_queries("wall")[4:7], 1):
        assert nearest(box, wide.plan(start, goal, seed=seed)) > 0.029
        close.append(nearest(box, narrow.plan(start, goal, seed=seed)))
    assert np.median(close) < 0.02


# --- Rejected


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"planner": "RRTConect"}, "unknown planner 'RRTConect': did you mean RRTConnect"),
        ({"clearance": math.nan}, r"clearance must be in \[0, 0.5\) m"),
        ({"limits": "wide"}, "limits must be 'urdf' or 'datasheet', got 'wide'"),
    ],
)
def test_bad_constructor_argument_is_rejected(worlds, arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        Planner(worlds["no_obstacles"], **arguments)


@pytest.mark.parametrize(
    ("start", "goal", "complaint"),
    [
        (INTO_THE_WALL, READY, "start is in collision: the arm with obstacle 0"),
        (READY, INTO_THE_TABLE, "goal is in collision: the arm with the table"),
        (READY + 9, READY, "start is outside the joint limits: joint 1 is 10.0000 rad"),
        (READY, READY + np.float32(np.inf), "goal must be finite"),
    ],
)
def test_bad_query_is_rejected(worlds, start, goal, complaint):
    with pytest.raises(ValueError, match=complaint):
        Planner(worlds["wall"]).plan(start, goal, seed=1)


def test_further_searches_shorten_a_path_and_batches_give_the_same_paths(worlds):
    queries = load_queries("double_walls", "validation")[:6]
    planner = Planner(worlds["double_walls"])
    single = [planner.plan(*query, seed=[4, i]) for i, query in enumerate(queries)]
    batch = planner.plan_batch(queries, seed=4, num_threads=3)
    assert [path.tobytes() for path in batch] == [path.tobytes() for path in single]
    better = [planner.plan(*query, seed=[4, i], optimise=5) for i, query in enumerate(queries)]
    lengths = [[length(path) for path in paths] for paths in (better, single)]
    assert (np.array(lengths[0]) <= lengths[1]).all() and sum(lengths[0]) < 0.97 * sum(lengths[1])


def test_search_ends_at_its_limits(worlds):
    start, goal, _ = load_queries("double_walls")[0]
    planner = Planner(worlds["double_walls"], max_checks=50)
    with pytest.raises(PlanningError, match=r"\(time_limit 9.0 s, max_checks 50\)"):
        planner.plan(start, goal, seed=1, time_limit=9.0)
    assert 50 <= planner.checks < 200
    planner = Planner(worlds["double_walls"])
    with pytest.raises(PlanningError, match=r"\(time_limit 1e-06 s, max_checks None\)"):
        planner.plan(start, goal, seed=1, time_limit=1e-6)


def test_plans_stay_inside_the_limits_of_the_datasheet(worlds):
    env = worlds["double_walls"]
    start, goal, scene = load_queries("double_walls", "validation")[2]
    path = Planner(env).plan(start, goal, seed=1)
    beyond = path.max(0) - np.maximum(start, goal)
    joint, upper = beyond.argmax(), PANDA.upper.copy()
    assert beyond[joint] > 0.1
    upper[joint] = path[:, joint].max() - beyond[joint] / 2  # the plan leaves these limits
    robot = dataclasses.replace(PANDA, datasheet_upper=upper, datasheet_lower=PANDA.lower)
    env = RoboArmEnv(dataclasses.replace(scene, robot=robot))
    inside = Planner(env, limits="datasheet").plan(start, goal, seed=1)
    assert (
        robot.is_within(inside, "datasheet").all() and not robot.is_within(path, "datasheet").all()
    )
    outside = goal.copy()
    outside[joint] = upper[joint] + 1e-3
    with pytest.raises(ValueError, match="goal is outside the datasheet position limits|collision"):
        Planner(env, limits="datasheet").plan(start, outside, seed=1)
    env.close()
